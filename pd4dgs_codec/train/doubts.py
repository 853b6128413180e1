"""Doubts about a trained model that its pictures give cause for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from pd4dgs_codec.data.view import View, thinned
from pd4dgs_codec.quality.image import mean_image_baseline
from pd4dgs_codec.train.phases.levels import images, other_views
from pd4dgs_codec.train.rollout import near_key
from pd4dgs_codec.train.state import TrainState

MEAN_OF = 50  #: training views at most in the mean picture
NEAR = 12  #: views near the key instant at most in which levels are compared
#: A level lacks what level 0 shows if its mean squared error in a block, a part PART of the shorter side, is over LACKS
#: and MORE times that of level 0.
PART, LACKS, MORE = 1 / 12, 0.02, 4.0


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
    worst, text = 0.0, ""
    for index in near_key(state, other_views(state))[:NEAR] if state.key is not None else []:
        shown = state.views[index]
        side = max(4, round(min(shown.image.shape[:2]) * PART))
        errors = [shown.exposed(image) - shown.image for image in images(state, shown, (0, level))]
        valid = shown.weights > 0
        below, own = (avg_pool2d((error.square().mean(-1) * valid)[None], side) for error in errors)
        lost = ((own - below) * ((own > LACKS) & (own > MORE * below)))[0].cpu().numpy()
        if lost.size and lost.max() > worst:
            worst = float(lost.max())
            row, column = (int(i) for i in np.unravel_index(lost.argmax(), lost.shape))
            at = f"around pixel ({round((column + 0.5) * side)}, {round((row + 0.5) * side)}) of {shown.view.name}"
            dB = [-10 * np.log10(max(float(mse[0, row, column]), 1e-9)) for mse in (own, below)]
            text = f"level {level} lacks what level 0 shows {at}: {dB[0]:.1f} dB there, level 0 {dB[1]:.1f} dB"
    return f"{text}; more views, a longer training or slower motion may help" if text else ""
