"""Selection of levels: a level of little use is removed for the rest of the run.

A level is compared with a level below on views held back from training, because every level gains on training views.
Before, the level below, which has had few steps of its own, takes over its anchors and trains alone: on a static scene
level 0 is then as good. Where level 0 clearly lacks what moves, no comparison is needed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, softplus

from pd4dgs_codec.model.picture import render
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.initialise import TIED
from pd4dgs_codec.train.schedule import COARSE_SHARE
from pd4dgs_codec.train.state import TrainingView, TrainState

#: One in EVERY training views is held back until levels are selected, if these are at least MIN_VIEWS: fewer say little
#: of a scene, here and wherever views are chosen by time.
EVERY, MIN_VIEWS = 16, 4
#: Standard errors by which a level must be better than the one that would take its place, and gradual opening better
#: than opening at once: few views are compared.
NEEDED = 2.0
#: A picture is visibly wrong if its mean squared error in a block, a part PART of the shorter side, is over LACKS. It
#: lacks what another picture shows if it is wrong there and its error is MORE times that of the other.
PART, LACKS, MORE = 1 / 12, 0.02, 4.0


class Lack(NamedTuple):
    """at: the middle of a block, column and row. own, other: mean squared errors there, of which `own` is too large."""

    at: tuple[int, int]
    own: float
    other: float


class SelectLevels(phases.Phase):
    """Removes the levels of little use: those that move, where the rate sets in or growing has ended, if level 0 alone
    shows nothing visibly wrong; any, where planes and weights begin to be rounded.

    practise: trains a level on trial for a number of steps. left_out: for each time that levels were removed, the
    highest one, the level that took its place, and the mean squared errors of both.
    """

    def __init__(self, practise: Callable[[int, int], None]) -> None:
        self._practise = practise
        self.left_out: list[dict[str, Any]] = []

    def due(self, state: TrainState) -> bool:
        """At `Schedule.progressive`, the first of `Schedule.prune` and `Schedule.rounding`, if views are held back."""
        starts = state.schedule.progressive, state.schedule.prune.start, state.schedule.rounding
        return any(map(state.reached, starts)) and bool(held_back_views(state))

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Removes levels, and logs `left_out`."""
        views = [state.views[index] for index in sorted(held_back_views(state))]
        late = state.position >= state.schedule.rounding
        wrong = workers.alike(lambda: any(_wrong(state, view, state.model.level if late else None) for view in views))
        if not wrong:
            self._try(state, 0, views, late)
        if late and state.model.level == 2:
            self._try(state, 1, views, late)
        record["left_out"] = self.left_out

    def _try(self, state: TrainState, below: int, views: Sequence[TrainingView], rated: bool) -> None:
        """Trains the level `below` with all anchors. Makes it the highest level if the levels above do not lower the
        squared error by more than its noise and their bits, which training weighs against an absolute error, if they
        are `rated`: planes that had no rate yet take up to three times as many. Otherwise restores the state, after
        half of the steps if as many with as much gain would not suffice: gains diminish."""
        top, before = state.model.level, state.snapshot()
        errors = workers.alike(lambda: [error(state, view, top) for view in views])
        bits = sum(state.plane_bits()[below:]) if rated else 0.0
        rate = 2 * math.sqrt(fmean(errors)) * state.config.plane_rate * bits
        with torch.no_grad():
            for above in range(below + 1, 3):  # the anchors of these levels, without their motion
                state.model.mask_logits[:, below] += softplus(state.model.mask_logits[:, above])
        suffices, lacks = False, list[float]()
        try:
            for half in range(3):
                if half:
                    self._practise(below, round(state.steps_in(COARSE_SHARE) / 2))
                instead = workers.alike(lambda: [error(state, view, below) for view in views])
                lacks.append(excess(instead, errors) - rate)
                if half == 1 and lacks[1] > lacks[0] - lacks[1]:
                    break
            suffices = lacks[-1] <= 0
        finally:  # a picture that is not finite ends the phase, and the level stays
            if not suffices:
                state.return_to(before)
        if suffices:
            for level in range(top, below, -1):
                drop_level(state, level)
            row = {"level": top, "kept": below, "error": fmean(errors), "instead": fmean(instead), "views": len(views)}
            self.left_out.append(row)

    def stored(self) -> dict[str, Any]:
        """left_out, as JSON."""
        return {"left_out": json.dumps(self.left_out)}

    def restore(self, stored: Mapping[str, Any]) -> None:
        self.left_out = list(json.loads(stored["left_out"]))


def _wrong(state: TrainState, view: TrainingView, level: int | None) -> bool:
    """Whether level 0 lacks something in a view that `level` shows, or, without it, shows anything wrongly."""
    own = block_errors(view, images(state, view, (0,))[0])
    other = torch.zeros_like(own) if level is None else block_errors(view, images(state, view, (level,))[0])
    return worst_block(view, own, other) is not None


@torch.no_grad()
def block_errors(view: TrainingView, image: Tensor) -> Tensor:
    """[rows, columns], on the CPU: the mean squared errors of a picture [H, W, 3] of a view in blocks."""
    errors = (view.exposed(image) - view.image).square().mean(-1) * (view.weights > 0)
    return avg_pool2d(errors[None], block_side(view))[0].cpu()


def block_side(view: TrainingView) -> int:
    """The pixels of a block's side."""
    return max(4, round(min(view.image.shape[:2]) * PART))


def worst_block(view: TrainingView, own: Tensor, other: Tensor) -> Lack | None:
    """The block in which the errors `own` exceed the errors `other` most, if it lacks something."""
    lost = (own - other) * ((own > LACKS) & (own > MORE * other))
    if not lost.numel() or not lost.max() > 0:
        return None
    row, column = divmod(int(lost.argmax()), lost.shape[1])
    x, y = (round((k + 0.5) * block_side(view)) for k in (column, row))
    return Lack((x, y), float(own[row, column]), float(other[row, column]))


def excess(errors: Sequence[float], others: Sequence[float]) -> float:
    """By how much the mean error of some views exceeds that of others of these views and the noise; 0 without views."""
    worse = [own - other for own, other in zip(errors, others, strict=True)]
    noise = stdev(worse) / math.sqrt(len(worse)) if len(worse) > 1 else 0.0
    return fmean(worse) - NEEDED * noise if worse else 0.0


def error(state: TrainState, view: TrainingView, level: int) -> float:
    """The mean squared error of a view at a level."""
    return view.squared_error(images(state, view, (level,))[0].clamp(0, 1))


@torch.no_grad()
def images(state: TrainState, view: TrainingView, levels: Sequence[int]) -> list[Tensor]:
    """The pictures [H, W, 3] of a view at these levels, rounded as at this position, without noise."""
    rounding = state.rounding(noisy=False)
    return [render(state.model, level, view.view.time, view.view.camera, rounding).image for level in levels]


def held_back_views(state: TrainState) -> set[int]:
    """Indices of the training views that select levels and are unseen until then; none if no level is selected or the
    length of the run is not known yet."""
    config = state.config
    selects = not config.keep_layers and state.model.level and config.rollout != "top" and phases.long_enough(state)
    views = set(range(EVERY // 2, len(state.views), EVERY)) if selects else set()
    return views if len(views) >= MIN_VIEWS else set()


def other_views(state: TrainState) -> list[int]:
    """Indices of the training views that are not held back, ascending."""
    held_back = held_back_views(state)
    return [index for index in range(len(state.views)) if index not in held_back]


def drop_level(state: TrainState, level: int) -> None:
    """Removes the deformation of `level` from the model and its optimiser, and ties its masks to the level below."""
    model, name = state.model, {1: "global_deformation", 2: "local_deformation"}[level]
    field = getattr(model, name)
    if field is not None:
        state.optimiser.forget(field)
        setattr(model, name, None)
    with torch.no_grad():
        model.mask_logits[:, level] = TIED
