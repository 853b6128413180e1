"""Pruning of anchors that pictures depend on little, once growing has ended: they leave the model, or layer 0.

Growing makes more anchors than a scene needs, and masks do not identify them: the rate term lowers all masks alike, and
a small mask does not mean a small error. The error of omitting an anchor is therefore measured in training views. Each
of many anchors in one place is redundant, but not all of them together: each of several rounds can prune only some
anchors, scattered over the scene, and the rest is measured again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import Rounding, mask_logits
from pd4dgs_codec.model.sensitivity import omission_error
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.phases import Phase, long_enough
from pd4dgs_codec.train.phases.levels import other_views
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS
from pd4dgs_codec.train.state import TrainingView, TrainState

#: Training views in which an anchor is measured; each round uses others.
VIEWS = 12
#: Mask of an anchor at a level that it has left: below the threshold, so that it is neither drawn there nor coded.
ABSENT = 1e-3

#: The mean squared error (30 dB) up to which a view's error counts towards the budget: otherwise views that are not
#: learnt yet would allow pruning the content that few views show.
LEARNT = 1e-3


class Prune(Phase):
    """One of PRUNING_ROUNDS rounds, which concerns only the anchors whose `round_of` it is.

    Removes anchors whose absence together adds at most a share of the squared error to level 0 and to the highest
    level, then removes from level 0 anchors whose absence adds at most as much there. Anchors that no view shows stay.
    If none would be left, all stay.
    """

    def __init__(self, turn: int):
        self.turn = turn

    def due(self, state: TrainState) -> bool:
        """At the round's position in `Schedule.prune`."""
        starts = state.schedule.prune if state.config.prune and long_enough(state) else range(0)
        return bool(starts) and state.reached(starts[self.turn])

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Prunes, and logs how many anchors left the model and how many left layer 0."""
        model, levels = state.model, state.measured_levels()
        share, before, order = state.config.prune / PRUNING_ROUNDS, len(model.anchor_q), other_views(state)
        views = state.views.spread(VIEWS, order, self.turn)
        errors = added_error(model, levels, views, state.rounding(noisy=False)).to(state.device)
        errors[:, round_of(model.anchor_q) != self.turn] = torch.inf
        errors[:, : model.frozen] = torch.inf
        redundant = least(errors.amax(0), share)
        keep = (~redundant | redundant.all()).nonzero()[:, 0]
        state.keep_anchors(keep)
        later = least(errors[0, keep], share)
        stays = (model.masks(0) > MASK_THRESHOLD) & ~later
        if levels[0] > 0 or model.level == 0 or not stays.any():
            later[:] = False
        else:
            _leave_level_0(model, later)
        record["left_model"] = record.get("left_model", 0) + before - len(keep)
        record["left_level_0"] = record.get("left_level_0", 0) + int(later.sum())


def added_error(model: Model, levels: Sequence[int], views: Sequence[TrainingView], rounding: Rounding) -> Tensor:
    """float64 [levels, N], on the CPU and equal in all workers: the squared error of omitting each anchor at these
    levels, summed over the views and relative to their present one, of which a view counts at most LEARNT. Infinite
    where no view shows the anchor."""

    def at(level: int) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        total, met, error = torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.bool), 0.0
        for view in views:
            viewpoint = (level, view.view.time, view.view.camera)
            added, near, image = omission_error(model, *viewpoint, generator, weights=view.weights, rounding=rounding)
            total, met = total + added, met | near
            error += min(view.squared_error(image), LEARNT)
        return torch.where(met, total / max(error, 1e-12), torch.inf).cpu()

    return workers.alike(lambda: torch.stack([at(level) for level in levels]))


def round_of(anchor_q: Tensor) -> Tensor:
    """int64 [N], 0 .. PRUNING_ROUNDS - 1: the round in which each anchor can be pruned. A hash of its voxel, so that it
    is the same in every round (Teschner et al., Optimized spatial hashing for collision detection, 2003)."""
    x, y, z = anchor_q.to(torch.int64).unbind(1)
    return (((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) >> 8) % PRUNING_ROUNDS


def least(errors: Tensor, share: float) -> Tensor:
    """bool [N]: the anchors of least error, whose sum is at most `share`. errors: float64 [N] >= 0, may be infinite."""
    order = errors.argsort(stable=True)
    found = torch.zeros(len(errors), dtype=torch.bool, device=errors.device)
    found[order[errors[order].cumsum(0) <= share]] = True
    return found


@torch.no_grad()
def _leave_level_0(model: Model, rows: Tensor) -> None:
    """Removes the anchors `rows` (bool [N]) from level 0; their masks at levels 1 and 2 stay."""
    masks = torch.stack([model.masks(level) for level in range(3)], dim=1)[rows]
    masks[:, 0] = ABSENT
    logits = torch.from_numpy(mask_logits(masks.cpu().numpy()))
    model.mask_logits[rows] = logits.to(model.mask_logits)
