"""Opening of the time window: motion is learnt from the key instant outwards.

In views far from the key instant, moving objects are elsewhere, and no gradient leads there. Levels 1 and 2 therefore
first see views near the key instant, in a window of times that grows until it holds all. Meanwhile their planes are
linear between few instants, which carries steady motion on to later views. It does not carry on motion to and fro,
which is learnt less well in a narrow window. A trial decides: if the motion learnt in a narrow window does not predict
views well outside it, all views take part at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from pd4dgs_codec.data.view import thinned
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.phases.levels import gain_in, images
from pd4dgs_codec.train.state import TrainState

#: The window, as a share of the longest time from the key instant: at first, and in the trial.
FIRST, TRIAL = 1 / 12, 1 / 6
#: The planes' instants double from 3 to 17 while the window grows, at each of so many parts of it.
DOUBLINGS = 5
#: Steps of the trial: a share of the run, and the fewest.
TRIAL_SHARE, MIN_TRIAL = 1 / 15, 75
#: Motion predicts if it gains MIN_GAIN dB over the static level 0 in whole pictures, so that missed motion counts, and
#: half as much half way through the trial, ...
MIN_GAIN = 4.5
#: ... over at most VIEWS views whose distance from the key instant is BEYOND, from and to, times the window.
VIEWS, BEYOND = 24, (1.5, 2.0)


class OpenTime(phases.Phase):
    """Tests once whether motion is steady; if not, opens the window fully. practise: trains a level on trial."""

    def __init__(self, practise: Callable[[int, int], None]) -> None:
        self._practise = practise

    def due(self, state: TrainState) -> bool:
        """At the end of the coarse phase, if there is a window."""
        return state.reached(state.schedule.coarse_end) and window(state) < 1

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Sets `TrainState.opened` if the highest level does not predict motion in a trial, and undoes the trial."""
        before = state.snapshot()
        try:
            for needed in (MIN_GAIN / 2, MIN_GAIN):
                self._practise(state.model.level, max(MIN_TRIAL, state.steps_in(TRIAL_SHARE)) // 2)
                record["predicted_gain"] = gain = workers.alike(lambda: _predicted(state))
                state.opened = gain < needed
                if state.opened:
                    break
        finally:
            state.return_to(before)


def window(state: TrainState) -> float:
    """The window at this step, as a share of the longest time from the key instant; 1: all views, as in short runs and
    without a key instant."""
    if state.opened or state.key is None or not phases.long_enough(state):
        return 1.0
    return max(TRIAL if state.practising else FIRST, state.schedule.opening(state.position))


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
def _predicted(state: TrainState) -> float:
    """The gain in dB of the highest level over level 0 in views well outside the window of the trial."""
    least, most = (TRIAL * times for times in BEYOND)
    far = [index for index in range(len(state.views)) if least < _distance(state, index) <= most]
    views = [state.picture(index) for index in thinned(far, VIEWS)]
    still, moved = ([images(state, view, (level,))[0] for view in views] for level in (0, state.model.level))
    return gain_in(views, [None] * len(views), still, moved)
