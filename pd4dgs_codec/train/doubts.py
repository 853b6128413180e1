"""Doubts about a trained model that its pictures give cause for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from pd4dgs_codec.data.view import View, thinned
from pd4dgs_codec.quality.image import mean_image_baseline
from pd4dgs_codec.train.phases.levels import block_errors, images, other_views, worst_block
from pd4dgs_codec.train.rollout import near_key
from pd4dgs_codec.train.state import TrainState

MEAN_OF = 50  #: training views at most in the mean picture
NEAR = 12  #: views near the key instant at most in which levels are compared


def doubts(state: TrainState, views: Sequence[View], psnr: Sequence[float]) -> list[str]:
    """Returns a line for each doubt. views: those that the model was measured on. psnr: its dB by level there."""
    found = []
    mean = mean_image_baseline(thinned(state.dataset.train, MEAN_OF), views)
    if mean is not None and max(psnr) < mean:
        what = "held-out" if state.dataset.test else "training"
        seen = f"{max(psnr):.2f} dB on {what} views, and the mean of the training pictures has {mean:.2f} dB"
        found.append(f"{seen}: do poses and pictures belong together (axes, order, another data set)?")
    return found + [lack for level in range(1, state.model.level + 1) if (lack := _lack(state, level))]


@torch.no_grad()
def _lack(state: TrainState, level: int) -> str:
    """The place where `level` shows least of what level 0 shows, in words; "" if it lacks nothing. The views are near
    the key instant, where level 0 has each object in its place."""
    found = []
    for index in near_key(state, other_views(state))[:NEAR] if state.key is not None else []:
        shown = state.views[index]
        below, own = (block_errors(shown, image) for image in images(state, shown, (0, level)))
        if lack := worst_block(shown, own, below):
            found.append((lack.own - lack.other, lack, shown.view.name))
    if not found:
        return ""
    _, lack, name = max(found)
    own_dB, dB = (-10 * math.log10(max(error, 1e-9)) for error in (lack.own, lack.other))
    at = f"around pixel {lack.at} of {name}: {own_dB:.1f} dB there, level 0 {dB:.1f} dB"
    return f"level {level} lacks what level 0 shows {at}; more views, a longer training or slower motion may help"
