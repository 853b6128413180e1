"""Selects the levels and views that a step trains, and the pixels of a view that train a level.

With a key instant t*, level 0 is the scene at t*, and higher levels add F(x, t) - F(x, t*). The levels then agree, so
most steps train the highest level, from views whose times spread from t* (`phases.opening`). The first steps have no
deformation yet and see only views near t*: with views of all times, moving objects would fade, unless bodies are
followed (`phases.follow`). Later a share of the steps trains level 0, from views near t* or from any view, without the
pixels that motion has changed, so that level 0 shows static content completely.

The paper's rollouts have no key instant: level 0 learns the mean over time.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from pd4dgs_codec.data.view import View
from pd4dgs_codec.train.phases.levels import MIN_VIEWS, other_views
from pd4dgs_codec.train.phases.opening import window, within
from pd4dgs_codec.train.schedule import NEAR_SHARE
from pd4dgs_codec.train.ssim import REACH
from pd4dgs_codec.train.state import TrainingView, TrainState

Probabilities = tuple[float, float, float]  #: of levels 0, 1, 2

#: Probabilities of the levels 0, 1, 2.
UNIFORM: Probabilities = (1 / 3, 1 / 3, 1 / 3)
CAPACITY_WEIGHTED: Probabilities = (0.15, 0.30, 0.55)
TOP: Probabilities = (0.0, 0.0, 1.0)
LOWEST: Probabilities = (1.0, 0.0, 0.0)
#: Weight of the past in the moving average rho.
RHO_DECAY = 0.95
#: Share of the steps after the coarse phase that train level 0, and the share of these near the key instant.
STILL_ODDS, NEAR_ODDS = 0.15, 1 / 3
#: Most views near the key instant, otherwise NEAR_SHARE of all. Where many cameras show each instant, more would be of
#: instants at which what moves is elsewhere.
MOST_NEAR = 60
#: Motion has changed a pixel if a colour differs by at least this between level 0 and the training image.
STILL_CONTRAST = 0.15
#: Share of the steps that train level 1 where there is a level 2.
GLOBAL_ODDS = 0.1


def draw_levels(state: TrainState) -> tuple[tuple[int, ...], Probabilities]:
    """The levels of this step, ascending, and the probabilities of levels 0, 1, 2 that they were drawn with."""
    rollout, top = state.config.rollout, state.model.level
    if state.coarse:
        return ((top,), TOP) if state.placing else ((0,), LOWEST)
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


def rollout_probabilities(rho: float) -> Probabilities:
    """pi(rho) = (1 - rho) (1/3, 1/3, 1/3) + rho (.15, .30, .55), of the levels 0, 1, 2."""
    low, mid, high = ((1 - rho) * u + rho * c for u, c in zip(UNIFORM, CAPACITY_WEIGHTED, strict=True))
    return low, mid, high


def updated_rho(rho: float, mask_0: Tensor, mask_2: Tensor) -> float:
    """0.95 rho + 0.05 mean(m^(2) - m^(0)) of two tensors of masks, within [0, 1]."""
    sample = float((mask_2 - mask_0).mean()) if len(mask_0) else 0.0
    return min(max(RHO_DECAY * rho + (1 - RHO_DECAY) * sample, 0.0), 1.0)


def next_view(state: TrainState, level: int) -> int:
    """Draws the training view of the next picture at `level`: a random one near the key instant where `_near` lists
    them, otherwise each in turn, in random order."""
    near = [] if state.key is None else _near(state, level)
    if near:
        return near[int(torch.randint(len(near), (), generator=state.generator))]
    if not state.order:
        shown, drawn = set(_shown(state)), torch.randperm(len(state.views), generator=state.generator).tolist()
        state.order = [index for index in drawn if index in shown]
    return state.order.pop()


def _near(state: TrainState, level: int) -> list[int]:
    """The views near the key instant from which the next one is drawn; none if any view may be drawn."""
    if level > 0 and window(state) >= 1:
        return []
    among = _shown(state)
    if level > 0:
        views = within(state, among)
        return [] if len(views) == len(among) or len(views) < MIN_VIEWS else views
    if state.practising:
        return []
    still = state.position < state.schedule.coarse_end or state.guiding
    drawn = still or float(torch.rand((), generator=state.generator)) < NEAR_ODDS
    return near_key(state, among) if drawn else []


def _shown(state: TrainState) -> list[int]:
    """The training views that steps draw: all once levels are selected, before that those that are not held back for
    it. A timed run may select levels a few positions behind `Schedule.rounding`, so its trial shows none of these."""
    selected = state.position > state.schedule.rounding and not state.practising
    return list(range(len(state.views))) if selected else other_views(state)


def near_key(state: TrainState, among: list[int]) -> list[int]:
    """The training views in `among` that are nearest to the key instant, the nearest first."""
    key, views = state.key or 0.0, state.views.views
    nearest = sorted(among, key=lambda index: abs(views[index].time - key))
    return nearest[: min(max(MIN_VIEWS, round(len(among) * NEAR_SHARE)), MOST_NEAR)]


def _is_near(state: TrainState, view: View) -> bool:
    """Whether a view is as near to the key instant as those of `near_key`."""
    key, farthest = state.key or 0.0, near_key(state, other_views(state))[-1]
    return abs(view.time - key) <= abs(state.views.views[farthest].time - key)


def without_motion(state: TrainState, shown: TrainingView, image: Tensor) -> TrainingView:
    """The view with the pixel weights that train level 0, of which `image` [H, W, 3] is its picture. In a scene with a
    key instant, pixels that motion has changed have weight 0, but views near it count whole: a body that level 0 lacks
    there could never return. In scenes of little else (`TrainState.guided`) the pixels around them have weight 0, too,
    since their SSIM depends on them: otherwise the faint edge of a body that has moved away would be erased, then the
    next edge, until the body is gone."""
    whole = state.key is None or state.practising or state.position < state.schedule.coarse_end
    if whole or _is_near(state, shown.view):
        return shown
    change = (image.detach() - shown.image).abs().amax(-1)
    if state.guided:
        change = max_pool2d(change[None], 2 * REACH + 1, 1, REACH)[0]
    return replace(shown, weights=shown.weights * (change < STILL_CONTRAST))
