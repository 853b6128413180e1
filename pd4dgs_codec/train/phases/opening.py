"""Opening of the time window: motion is learnt from the key instant outwards.

In views far from the key instant, moving objects are elsewhere, and no gradient leads there. Levels 1 and 2 therefore
first see views near the key instant, in a window of times that grows until it holds all. Meanwhile their planes are
linear between few instants, which carries steady motion on to later views. It does not carry on motion to and fro,
which is learnt less well in a narrow window. So the run tries both: it trains in a narrow window, then instead in all
views, compares both beyond the window, in views that the first has to predict, and goes on with the better one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from pd4dgs_codec.data.view import thinned
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.phases.levels import error, excess
from pd4dgs_codec.train.schedule import COARSE_SHARE, NEAR_SHARE
from pd4dgs_codec.train.state import TrainState

#: The planes' instants double from 3 to 17 while the window grows, at each of so many parts of it.
DOUBLINGS = 5
#: Most views in which they are compared, once to twice as far from the key instant as the window.
VIEWS = 24


class OpenTime(phases.Phase):
    """Decides once whether the window opens gradually or at once. practise: trains a level on trial."""

    def __init__(self, practise: Callable[[int, int], None]) -> None:
        self._practise = practise

    def due(self, state: TrainState) -> bool:
        """At the end of the coarse phase, if there is a window."""
        return state.reached(state.schedule.coarse_end) and window(state) < 1

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Trains the highest level in the window, then instead in all views, and goes on with the first branch if it is
        better beyond the noise. Logs the mean squared errors of both."""
        before, ends, errors = state.snapshot(), [], []
        try:
            for state.opened in (False, True):
                self._practise(state.model.level, state.steps_in(COARSE_SHARE / 2))
                errors.append(workers.alike(lambda: _errors_beyond(state)))
                ends.append(state.snapshot())
                state.return_to(before)
        except BaseException:
            state.opened = False
            state.return_to(before)
            raise
        record["opening_errors"] = [sum(own) / max(len(own), 1) for own in errors]
        state.opened = excess(errors[True], errors[False]) <= 0
        state.return_to(ends[state.opened])


def window(state: TrainState) -> float:
    """The window at this step, as a share of the longest time from the key instant; 1: all views, as in short runs and
    without a key instant."""
    if state.opened or state.key is None or not phases.long_enough(state):
        return 1.0
    return max((1 + state.practising) * NEAR_SHARE, state.schedule.opening(state.position))


def few_instants(state: TrainState) -> int | None:
    """How many instants the planes have at this step; None: all their cells along time."""
    share = window(state)
    return 2 ** min(max(int(share * DOUBLINGS + 0.5), 1), 4) + 1 if share < 1 else None


def within(state: TrainState, among: Sequence[int]) -> list[int]:
    """The training views in `among` whose times are in the window."""
    share = window(state)
    return [index for index in among if share >= 1 or _distance(state, index) <= share]


def _distance(state: TrainState, index: int) -> float:
    """The distance in time of a view from the key instant, as a share of the longest."""
    key = state.key or 0.0
    return abs(state.views.views[index].time - key) / max(key, 1 - key)


@torch.no_grad()
def _errors_beyond(state: TrainState) -> list[float]:
    """The mean squared errors of the highest level in views outside the window of the trial."""
    far = [i for i in range(len(state.views)) if 1 < _distance(state, i) / (2 * NEAR_SHARE) <= 2]
    views = [state.picture(index) for index in thinned(far, VIEWS)]
    return [error(state, view, state.model.level) for view in views]
