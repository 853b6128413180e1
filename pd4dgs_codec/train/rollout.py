"""Which levels and views a step trains, and which pixels of a view teach a level.

With a key instant t*, level 0 is the scene at t*, to which the others add F(x, t) - F(x, t*). The levels then agree:
most steps train the highest level, from views whose times spread from t* (`phases.opening`). The first steps, in which
the deformation is still, see views near t* alone: in views of all times what moves would fade. Later a share of the
steps trains level 0: near t*, and from all views in the pixels that motion leaves as they are, so that what stands
still is complete without it.

The rollouts of the paper have no key instant: they teach level 0 the mean over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from pd4dgs_codec.model.picture import render
from pd4dgs_codec.train.phases.levels import held_back_views
from pd4dgs_codec.train.phases.opening import window, within
from pd4dgs_codec.train.schedule import CAPACITY_WEIGHTED, LOWEST, TOP, UNIFORM, Probabilities, rollout_probabilities
from pd4dgs_codec.train.state import TrainingView, TrainState

#: Share of the steps that train level 0 once the deformation moves, and of these the share near the key instant.
STILL_ODDS, NEAR_ODDS = 0.15, 1 / 3
#: The views near the key instant: this share of all, but at least so many.
NEAR_SHARE, NEAR_VIEWS = 1 / 12, 4
#: The largest difference of a colour between level 0 and the highest in pixels that motion leaves as they are.
STILL_CONTRAST = 0.15
#: Share of the steps that train level 1 where there is a level 2.
GLOBAL_ODDS = 0.1


def draw_levels(state: TrainState) -> tuple[tuple[int, ...], Probabilities]:
    """The levels of this step, ascending, and the probabilities of levels 0, 1, 2 that they were drawn with."""
    rollout, top = state.config.rollout, state.model.level
    if state.position < state.schedule.coarse_end:
        return (0,), LOWEST
    if rollout == "all":
        return tuple(range(top + 1)), (1.0, 1.0, 1.0)
    if rollout == "top":
        probabilities = TOP
    elif rollout == "key":
        probabilities = STILL_ODDS, GLOBAL_ODDS, 1 - STILL_ODDS - GLOBAL_ODDS
    elif rollout == "uniform" or state.position < state.schedule.progressive:
        probabilities = UNIFORM
    else:
        probabilities = CAPACITY_WEIGHTED if rollout == "fixed" else rollout_probabilities(state.rho)
    draw = float(torch.rand((), generator=state.generator))
    level = int(draw >= probabilities[0]) + int(draw >= probabilities[0] + probabilities[1])
    return (min(level, top),), probabilities


def next_view(state: TrainState, level: int) -> int:
    """The training view of the next picture at `level`: each in turn, in random order; views near the key instant at
    random."""
    near = [] if state.key is None else _near(state, level)
    if near:
        return near[int(torch.randint(len(near), (), generator=state.generator))]
    if not state.order:
        held_back = _held_back(state)
        drawn = torch.randperm(len(state.views), generator=state.generator).tolist()
        state.order = [index for index in drawn if index not in held_back]
    return state.order.pop()


def _near(state: TrainState, level: int) -> list[int]:
    """The views near the key instant of which the next picture is one; none if it may be of any view."""
    if level > 0 and window(state) >= 1:
        return []
    held_back = _held_back(state)
    among = [index for index in range(len(state.views)) if index not in held_back]
    if level > 0:
        views = within(state, among)
        return [] if len(views) == len(among) or len(views) < NEAR_VIEWS else views
    if state.practising:
        return []
    still = state.position < state.schedule.coarse_end
    drawn = still or float(torch.rand((), generator=state.generator)) < NEAR_ODDS
    return near_key(state, among) if drawn else []


def _held_back(state: TrainState) -> set[int]:
    """The training views that wait for the selection of levels."""
    return held_back_views(state) if state.position <= state.schedule.rounding else set()


def near_key(state: TrainState, among: list[int]) -> list[int]:
    """Those of the training views `among` that are nearest to the key instant."""
    key, views = state.key or 0.0, state.views.views
    nearest = sorted(among, key=lambda index: abs(views[index].time - key))
    return nearest[: max(NEAR_VIEWS, round(len(among) * NEAR_SHARE))]


def taught_views(state: TrainState, views: Sequence[TrainingView]) -> dict[int, list[TrainingView]]:
    """The views as they teach each of the trained levels."""
    return {level: [as_taught(state, view, level) for view in views] for level in state.trained_levels()}


def as_taught(state: TrainState, shown: TrainingView, level: int) -> TrainingView:
    """The view with the weights of the pixels that teach `level`: at level 0 of a scene with a key instant none where
    motion changes the picture."""
    if level > 0 or state.key is None or state.practising or state.position < state.schedule.coarse_end:
        return shown
    with torch.no_grad():
        place = shown.view.time, shown.view.camera, state.rounding(noisy=False)
        still, moved = (render(state.model, drawn, *place).image for drawn in (0, state.model.level))
    same = (still - moved).abs().amax(-1) < STILL_CONTRAST
    return replace(shown, weights=shown.weights * same)
