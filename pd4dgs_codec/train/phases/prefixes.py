"""Training of prefixes: steps that render only the most useful anchors, so that a file's first slices look whole.

A model that was always rendered with all of its anchors has holes where some are missing. So in the last third of a run
some steps render level 0 from its most useful anchors only, in the order in which `pd4dgs-encode --slices` sends them
(nested dropout: Rippel, Gelbart and Adams, Learning ordered representations with nested dropout, 2014).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import View
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.sensitivity import utility, without
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.phases import Phase
from pd4dgs_codec.train.state import TrainState

#: Training views whose pictures order the anchors.
VIEWS = 12
#: The smallest prefix has 2^-OCTAVES of the anchors.
OCTAVES = 4


class Prefixes(Phase):
    """Ranks the anchors where planes and weights begin to be rounded; from then on draws prefixes for steps.

    rank: float64 [N], see `rank_anchors`; None before.
    """

    def __init__(self) -> None:
        self.rank: Tensor | None = None

    def due(self, state: TrainState) -> bool:
        """At `Schedule.rounding`, if the options ask for prefixes."""
        return state.config.prefixes > 0 and state.reached(state.schedule.rounding)

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Logs nothing; the steps log the size of their prefix."""
        self.rank = workers.alike(lambda: rank_anchors(state.model, state.dataset.train))

    def draw(self, state: TrainState) -> Tensor | None:
        """bool [N]: the anchors that the next step renders; None for all of them."""
        if self.rank is None or float(torch.rand((), generator=state.generator)) >= state.config.prefixes:
            return None
        return draw_prefix(self.rank, state.generator).to(state.device)

    def stored(self) -> dict[str, Any]:
        """rank, empty if there is none."""
        return {"rank": torch.empty(0) if self.rank is None else self.rank}

    def restore(self, stored: Mapping[str, Any]) -> None:
        """The inverse of `stored`."""
        self.rank = stored["rank"] if len(stored["rank"]) else None
        if self.rank is not None and self.rank.shape != stored["densifier"]["opacity"].shape:
            raise ValueError(f"a rank of shape {tuple(self.rank.shape)}, not one number for each anchor")


def rank_anchors(model: Model, views: Sequence[View]) -> Tensor:
    """float64 [N]: the utility of each anchor at level 0, the highest first in a file; -inf if absent there."""
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
    """bool [N]: the anchors of highest rank, a share 2^-u of those present, u uniform in 0..OCTAVES."""
    present = int(rank.isfinite().sum())
    share = 2.0 ** (-OCTAVES * float(torch.rand((), generator=generator)))
    chosen = torch.zeros(len(rank), dtype=torch.bool)
    chosen[rank.argsort(descending=True, stable=True)[: max(1, round(share * present))]] = True
    return chosen
