"""Training of prefixes: steps that render only the most useful anchors, so that a file's first slices look whole.

A model that is always rendered with all anchors has holes where some are missing. In the last third of a run, some
steps of level 0 therefore render only its most useful anchors, in the order in which `pd4dgs-encode --slices` sends
them (nested dropout: Rippel, Gelbart and Adams, Learning ordered representations with nested dropout, 2014).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import View, thinned
from pd4dgs_codec.model.model import Model, to_scene
from pd4dgs_codec.model.sensitivity import utility, without
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.phases import Phase, long_enough
from pd4dgs_codec.train.rollout import STILL_ODDS
from pd4dgs_codec.train.state import TrainState

#: Training views whose pictures order the anchors.
VIEWS = 8
#: The fewest anchors of a prefix, about those of a first slice of 50 kB.
FEWEST = 1500
#: Share of the steps of level 0 that render a prefix; if it is the only level, STILL_ODDS.
SHARE = 0.5


class Prefixes(Phase):
    """Ranks the anchors of level 0 where planes and weights begin to be rounded, and draws prefixes from then on.

    rank: float64 [N], see `rank_anchors`; None before, or if level 0 has at most FEWEST anchors.
    """

    def __init__(self) -> None:
        self.rank: Tensor | None = None

    def due(self, state: TrainState) -> bool:
        """At `Schedule.rounding`, if a first slice would lack anchors."""
        trained = long_enough(state) and 0 in state.measured_levels() and not state.model.frozen
        return trained and state.reached(state.schedule.rounding) and state.active_anchors()[0] > FEWEST

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Logs nothing; the steps log the size of their prefix."""
        self.rank = workers.alike(lambda: rank_anchors(state.model, state.dataset.train))

    def draw(self, state: TrainState, level: int) -> Tensor | None:
        """bool [N]: the anchors that the next step, of `level`, renders; None for all of them."""
        share = SHARE if state.model.level else STILL_ODDS
        if self.rank is None or level or float(torch.rand((), generator=state.generator)) >= share:
            return None
        return draw_prefix(self.rank, state.generator).to(state.device)

    def stored(self) -> dict[str, Any]:
        """rank, empty if there is none."""
        return {"rank": torch.empty(0) if self.rank is None else self.rank}

    def restore(self, stored: Mapping[str, Any]) -> None:
        self.rank = stored["rank"] if len(stored["rank"]) else None
        if self.rank is not None and self.rank.shape != stored["densifier"]["opacity"].shape:
            raise ValueError(f"rank has shape {tuple(self.rank.shape)}, expected one number per anchor")


def rank_anchors(model: Model, views: Sequence[View]) -> Tensor:
    """float64 [N]: the utility of each anchor at level 0. Files store the highest first; the last FEWEST anchors of
    `utility` rank equal, and anchors that level 0 lacks have -inf."""
    absent = (model.masks(0).detach() <= MASK_THRESHOLD).cpu().numpy()
    scene = without(to_scene(model).prefix(0), np.flatnonzero(absent))
    scene = replace(scene, steps=scene.steps.scaled(1.0))  # binary32, as a file has them
    viewpoints = [(view.camera, view.time) for view in thinned(views, VIEWS)]
    rank = torch.full((len(absent),), -torch.inf, dtype=torch.float64)
    rank[torch.from_numpy(~absent)] = torch.from_numpy(utility(scene, viewpoints, fewest=FEWEST))
    return rank


def draw_prefix(rank: Tensor, generator: torch.Generator) -> Tensor:
    """bool [N]: the anchors of highest rank, their number log-uniform from FEWEST to all that are present."""
    present = int(rank.isfinite().sum())
    count = present * (FEWEST / present) ** float(torch.rand((), generator=generator))
    chosen = torch.zeros(len(rank), dtype=torch.bool)
    chosen[rank.argsort(descending=True, stable=True)[: round(count)]] = True
    return chosen
