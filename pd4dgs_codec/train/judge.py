"""Levels that do not pay: judged on views that training has not seen yet, and dropped for the rest of the run.

On the views it learns from every level gains: 1.5 dB on a scene where nothing moves, of which other views show -0.4.
"""

from __future__ import annotations

import torch

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train.initialise import TIED
from pd4dgs_codec.train.optimiser import Optimiser

#: One training view in so many waits until the levels are judged, if these are enough and the run is long enough.
EVERY = 16
MIN_VIEWS = 4
#: dB that levels 1 and 2 must gain over the one below. Views kept back lie between those learnt from, and flatter a
#: level: on a scene where nothing moves by 0.5 to 0.7 dB, which cameras off the path do not confirm. Where things move
#: level 1 gains 1.4 dB and more.
MIN_GAIN_DB = {1: 0.9, 2: 0.1}
MIN_ITERATIONS = 500


def waiting_views(count: int, iterations: int) -> set[int]:
    """Indices of the training views (of `count`) that a run of `iterations` steps judges by; none if it judges not."""
    views = set(range(EVERY // 2, count, EVERY))
    return views if len(views) >= MIN_VIEWS and iterations >= MIN_ITERATIONS else set()


def levels_without_gain(psnr: list[float]) -> list[tuple[int, float]]:
    """(level, gain in dB over the level below) from the top down, as far as the gain is under that of MIN_GAIN_DB.
    psnr: per level, over views that training has not seen."""
    found = []
    for level in range(len(psnr) - 1, 0, -1):
        gain = psnr[level] - psnr[level - 1]
        if gain >= MIN_GAIN_DB[level]:
            break
        found.append((level, gain))
    return found


def drop_level(model: Model, optimiser: Optimiser, level: int) -> None:
    """Takes the deformation of `level` out of the model and its optimiser, and ties its masks to the level below."""
    name = {1: "global_deformation", 2: "local_deformation"}[level]
    field = getattr(model, name)
    if field is not None:
        optimiser.forget(field)
        setattr(model, name, None)
    with torch.no_grad():
        model.mask_logits[:, level] = TIED
