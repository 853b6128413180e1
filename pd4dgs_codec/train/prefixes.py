"""Steps that see the first anchors alone, so that the first slices of a file show a whole picture, if a coarse one.

A model that only ever saw all of its anchors has holes where some are missing. So from where planes begin to be rounded
on, some steps render level 0 from its most useful anchors alone, in the order in which `pd4dgs-encode --slices` sends
them (nested dropout: Rippel, Gelbart and Adams, Learning ordered representations with nested dropout, 2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import View
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.utility import utility, without
from pd4dgs_codec.scene import MASK_THRESHOLD

#: Training views whose pictures order the anchors.
VIEWS = 12
#: Octaves below all of the anchors that the smallest prefix has.
OCTAVES = 4


def rank_anchors(model: Model, views: Sequence[View]) -> Tensor:
    """float64 [N]: what each anchor is worth at level 0, the highest first in a file; -inf if it is not there."""
    absent = (model.masks(0).detach() <= MASK_THRESHOLD).cpu().numpy()
    scene = without(to_scene(model).prefix(0), np.flatnonzero(absent))
    scene = replace(scene, steps=scene.steps.scaled(1.0))  # binary32, as a file has them
    stride = -(-len(views) // VIEWS)
    rank = torch.full((len(absent),), -torch.inf, dtype=torch.float64)
    rank[torch.from_numpy(~absent)] = torch.from_numpy(
        utility(scene, [(view.camera, view.time) for view in views[::stride]])
    )
    return rank


def draw_prefix(rank: Tensor, generator: torch.Generator) -> Tensor:
    """bool [N]: the anchors of highest rank, as many as 2^-u of those that are there, u uniform in 0..OCTAVES."""
    present = int(rank.isfinite().sum())
    share = 2.0 ** (-OCTAVES * float(torch.rand((), generator=generator)))
    chosen = torch.zeros(len(rank), dtype=torch.bool)
    chosen[rank.argsort(descending=True, stable=True)[: max(1, round(share * present))]] = True
    return chosen
