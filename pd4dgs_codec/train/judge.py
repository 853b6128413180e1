"""Levels that do not pay: judged on views that training has not seen yet, and dropped for the rest of the run.

On the views it learns from every level gains: 1.5 dB on a scene where nothing moves, of which other views show -0.4.
"""

from __future__ import annotations

import torch

from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train.initialise import TIED
from pd4dgs_codec.train.optimiser import Optimiser

#: One training view in so many waits until the levels are judged, if these are enough and the run is long enough.
EVERY = 16
MIN_VIEWS = 4
#: dB that levels 1 and 2 must gain over the one below. Views kept back lie between those learnt from, and flatter a
#: level: on a scene where nothing moves by 0.5 to 0.7 dB, which cameras off the path do not confirm. Where things move
#: level 1 gains 1.4 dB and more. Level 2 ends at a tenth to two thirds of what it gains on them, for a tenth to a fifth
#: of the file, and without it the levels below gain more; docs/design.md has the runs.
MIN_GAIN_DB = {1: 0.9, 2: 0.6}
#: dB per megabyte of a level's planes and networks under which it goes all the same: elsewhere these bytes gain more.
MIN_GAIN_PER_MEGABYTE = 4.0
MIN_ITERATIONS = 500


def waiting_views(count: int, iterations: int) -> set[int]:
    """Indices of the training views (of `count`) that a run of `iterations` steps judges by; none if it judges not."""
    views = set(range(EVERY // 2, count, EVERY))
    return views if len(views) >= MIN_VIEWS and iterations >= MIN_ITERATIONS else set()


def levels_without_gain(psnr: list[float], sizes: list[float]) -> list[tuple[int, float]]:
    """(level, gain in dB over the level below) from the top down, as far as the gain is under that of MIN_GAIN_DB or
    MIN_GAIN_PER_MEGABYTE. psnr: per level, over views that training has not seen. sizes: about the bytes per level of
    its planes and networks."""
    found = []
    for level in range(len(psnr) - 1, 0, -1):
        gain = psnr[level] - psnr[level - 1]
        if gain >= max(MIN_GAIN_DB[level], MIN_GAIN_PER_MEGABYTE * sizes[level] / 1e6):
            break
        found.append((level, gain))
    return found


def field_bytes(field: DeformationField, plane_bits: float) -> float:
    """About what a deformation costs whose planes cost `plane_bits`: a byte for each weight besides."""
    return plane_bits / 8 + sum(p.numel() for part in (field.trunk, field.heads) for p in part.parameters())


def drop_level(model: Model, optimiser: Optimiser, level: int) -> None:
    """Takes the deformation of `level` out of the model and its optimiser, and ties its masks to the level below."""
    name = {1: "global_deformation", 2: "local_deformation"}[level]
    field = getattr(model, name)
    if field is not None:
        optimiser.forget(field)
        setattr(model, name, None)
    with torch.no_grad():
        model.mask_logits[:, level] = TIED
