"""Selection of levels: a level that gains too little on views not trained on yet is removed for the rest of the run.

On the views it is trained on every level gains: 1.5 dB on a static scene, of which other views show -0.4.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch.nn.functional import softplus

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.quality import TRAIN_MIN_DB, TRAIN_MIN_DB_PER_MEGABYTE
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.initialise import TIED
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.state import TrainState

#: One training view in so many is held back until levels are selected, if there are enough of them.
EVERY = 16
MIN_VIEWS = 4


class SelectLevels(phases.Phase):
    """Where planes and weights begin to be rounded, removes the levels that gain too little.

    left_out: the removed levels, each with its level, gain in dB and number of views.
    """

    def __init__(self) -> None:
        self.left_out: list[dict[str, Any]] = []

    def due(self, state: TrainState) -> bool:
        """At `Schedule.rounding`, if views are held back for it."""
        return state.reached(state.schedule.rounding) and bool(held_back_views(state))

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Logs the PSNR per level and what is left out."""
        views = [state.dataset.train[index] for index in sorted(held_back_views(state))]
        psnr = workers.alike(lambda: state.level_psnr(views))
        fields, bits = state.model.deformations, [0.0, *state.plane_bits()]
        weights = [sum(p.numel() for p in fields[i].weights) if i in fields else 0 for i in range(3)]  # a byte for each
        sizes = [count / 8 + number for count, number in zip(bits, weights, strict=True)]
        found = levels_without_gain(psnr, sizes)
        for level, _ in found:
            drop_level(state.model, state.optimiser, level)
        self.left_out = [{"level": level, "gain": gain, "views": len(views)} for level, gain in found]
        record |= {"judged_psnr": psnr, "left_out": self.left_out}

    def stored(self) -> dict[str, Any]:
        """left_out, as JSON."""
        return {"left_out": json.dumps(self.left_out)}

    def restore(self, stored: Mapping[str, Any]) -> None:
        """The inverse of `stored`."""
        self.left_out = list(json.loads(stored["left_out"]))


def held_back_views(state: TrainState) -> set[int]:
    """Indices of the training views by which levels are selected, unseen until then; none if nothing is selected or
    the length of the run is not known yet."""
    config = state.config
    selects = config.judge and config.max_layer > 0 and config.rollout != "top" and phases.long_enough(state)
    views = set(range(EVERY // 2, len(state.views), EVERY)) if selects else set()
    return views if len(views) >= MIN_VIEWS else set()


def levels_without_gain(psnr: Sequence[float], sizes: Sequence[float]) -> list[tuple[int, float]]:
    """(level, gain in dB over the level below) from the top down, as long as the gain is below TRAIN_MIN_DB or
    TRAIN_MIN_DB_PER_MEGABYTE. psnr: per level, over held-back views. sizes: about the bytes per level of its planes and
    networks."""
    found = []
    for level in range(len(psnr) - 1, 0, -1):
        gain = psnr[level] - psnr[level - 1]
        if gain >= max(TRAIN_MIN_DB[level], TRAIN_MIN_DB_PER_MEGABYTE * sizes[level] / 1e6):
            break
        found.append((level, gain))
    return found


def drop_level(model: Model, optimiser: Optimiser, level: int) -> None:
    """Removes the deformation of `level` from the model and its optimiser, and ties its masks to the level below. Most
    steps with a key instant have trained the masks of level 1, which then become those of level 0."""
    name = {1: "global_deformation", 2: "local_deformation"}[level]
    field = getattr(model, name)
    keyed = field is not None and field.key is not None
    if field is not None:
        optimiser.forget(field)
        setattr(model, name, None)
    with torch.no_grad():
        if keyed:
            model.mask_logits[:, level - 1] += softplus(model.mask_logits[:, level])
        model.mask_logits[:, level] = TIED
