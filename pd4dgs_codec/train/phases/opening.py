"""The opening of time: motion is learnt from the key instant outwards.

In views far from the key instant what moves is somewhere else, and no gradient leads there. So the levels that move see
views near the key instant first, in a window of times that grows until it holds all. Meanwhile their planes have few
instants and are linear in between: what moves steadily is then already where later views show it. What moves to and fro
is not, and learns less in a narrow window. Which of the two a scene is shows in a trial: the motion learnt in a narrow
window predicts views well outside it, or all views take part at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.phases.levels import gain_in, images
from pd4dgs_codec.train.state import TrainState

#: The window, as a share of the longest time from the key instant: at first, and in the trial.
FIRST, TRIAL = 1 / 12, 1 / 6
#: Instants of the planes while the window is below a share.
FEW_INSTANTS = ((0.3, 3), (0.5, 5), (0.7, 9), (1.0, 17))
#: Steps of the trial: a share of the run, and so many at least.
TRIAL_SHARE, MIN_TRIAL = 1 / 15, 75
#: Motion predicts if it gains so many dB over the still level 0 in whole pictures, so that what it misses counts, ...
MIN_GAIN = 4.2
#: ... of at most so many views whose distance from the key instant is so many times the window.
VIEWS, BEYOND = 12, (1.5, 2.0)


class OpenTime(phases.Phase):
    """Tries once whether motion is steady; if not, opens the window. practise: trains a level for so many steps."""

    def __init__(self, practise: Callable[[int, int], None]) -> None:
        self._practise = practise

    def due(self, state: TrainState) -> bool:
        """Where the levels that move begin to be trained, if there is a window."""
        return state.reached(state.schedule.coarse_end) and window(state) < 1

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Sets `TrainState.opened` where the motion of the highest level does not predict; the rest is as before."""
        before = state.snapshot()
        try:
            self._practise(state.model.level, max(MIN_TRIAL, state.steps_in(TRIAL_SHARE)))
            record["predicted_gain"] = gain = workers.alike(lambda: _predicted(state))
        finally:
            state.return_to(before)
        state.opened = gain < MIN_GAIN


def window(state: TrainState) -> float:
    """The window at this step, as a share of the longest time from the key instant; 1: all views. Short runs have
    none."""
    if state.opened or state.key is None or not phases.long_enough(state):
        return 1.0
    return max(TRIAL if state.practising else FIRST, state.schedule.opening(state.position))


def few_instants(state: TrainState) -> int | None:
    """How many instants the planes have at this step; None: all their cells along time."""
    share = window(state)
    return next((instants for below, instants in FEW_INSTANTS if share < below), None)


def within(state: TrainState, among: Sequence[int]) -> list[int]:
    """Those of the training views `among` whose times are in the window."""
    share = window(state)
    return [index for index in among if share >= 1 or _distance(state, index) <= share]


def _distance(state: TrainState, index: int) -> float:
    """Of a view from the key instant, as a share of the longest."""
    key = state.key or 0.0
    return abs(state.views.views[index].time - key) / max(key, 1 - key)


@torch.no_grad()
def _predicted(state: TrainState) -> float:
    """By how many dB the highest level is better than level 0 in views well outside the window of the trial."""
    least, most = (TRIAL * times for times in BEYOND)
    far = [index for index in range(len(state.views)) if least < _distance(state, index) <= most]
    views = [state.picture(index) for index in far[:: max(1, -(-len(far) // VIEWS))]]
    still, moved = ([images(state, view, (level,))[0] for view in views] for level in (0, state.model.level))
    return gain_in(views, [None] * len(views), still, moved)
