"""The phases of a training run, as fractions of its length."""

from __future__ import annotations

import math

#: The views near the key instant: a share of all, and of the longest time from the key instant, which is the window of
#: `phases.opening` at first. Its trial has twice this window.
NEAR_SHARE = 1 / 12
#: Share of a run in which level 0 alone is trained, at first and before it is compared with higher levels.
COARSE_SHARE = 1 / 10
#: Share of a run with a key instant after which views of all times train motion, see `phases.opening`.
OPENING_SHARE = 1 / 2
#: Parts of a run: anchors grow after each, and are pruned after every other one.
PARTS = 100
#: Share of a run after which the rate terms set in, and after twice of which planes and weights are rounded.
THIRD = 1 / 3
#: Rounds in which anchors of little use are pruned; each anchor is a candidate in one round.
PRUNING_ROUNDS = 4


class Schedule:
    """The phases of a run of N iterations, as fractions of N (the paper's N is 30,000).

    iterations: N; None before a timed run has estimated it. Until then the run stays in its coarse phase: every later
    phase begins at infinity, and nothing is grown or pruned.
    coarse_end: before it only level 0 is trained; from it on, quantisation noise is added.
    moving: transparent anchors are pruned from here on; earlier, moving objects may be missing still.
    progressive: the terms of rate and masks and the average rho start here (T_progressive; T_warm is within the coarse
    phase).
    rho_every: iterations between updates of rho (K).
    rounding: planes and weights are rounded straight-through from here on.
    exact_rounding: the anchors' attributes are rounded straight-through from here on, instead of noise.
    grow: iterations after which anchors are grown and pruned.
    prune: iterations before which anchors of little use are pruned, once growing has ended.
    """

    def __init__(self, iterations: int | None):
        def at(fraction: float) -> float:
            return math.inf if iterations is None else round(iterations * fraction)

        self.iterations = iterations
        self.coarse_end, self.progressive, self.rho_every = at(COARSE_SHARE), at(THIRD), max(1, at(1 / PARTS))
        self.moving = at(2 * COARSE_SHARE)
        self.rounding, self.exact_rounding = at(2 * THIRD), at(9 / 10)
        self.grow = self.prune = range(0)
        if iterations is not None:
            every, twice = max(20, round(iterations / PARTS)), max(1, round(2 * iterations / PARTS))
            self.grow = range(twice + every, round(iterations / 2) + 1, every)
            self.prune = range(self.grow.stop, self.grow.stop + PRUNING_ROUNDS * twice, twice)

    def progress(self, iteration: int) -> float:
        """The share of the run, 0..1, that lies before `iteration`; 0 while N is not known."""
        return iteration / self.iterations if self.iterations else 0.0

    def opening(self, iteration: int) -> float:
        """Progress of opening the time window, 0..1, from the end of the coarse phase to OPENING_SHARE."""
        return min(max((self.progress(iteration) - COARSE_SHARE) / (OPENING_SHARE - COARSE_SHARE), 0.0), 1.0)

    def separation(self, iteration: int) -> float:
        """Progress of the masks' separation, 0..1, from the start of the mask terms to exact rounding."""
        return self._since_progressive(iteration, self.exact_rounding)

    def pressure(self, iteration: int) -> float:
        """Weight of the planes' rate, 0..1: rises from the start of the rate term until planes are rounded. The full
        weight at once would empty the planes before they have learnt anything."""
        return self._since_progressive(iteration, self.rounding)

    def _since_progressive(self, iteration: int, end: float) -> float:
        if self.iterations is None:
            return 0.0
        begin = self.progressive
        return min(max((iteration - begin) / max(1, end - begin), 0.0), 1.0)

    def phases_not_reached(self, iteration: int) -> list[str]:
        """Names of the phases that a run of `iteration` iterations never entered; none for a whole run."""
        if self.iterations is not None and iteration >= self.iterations:
            return []
        starts = {
            "levels 1 and 2": self.coarse_end,
            "rate and mask terms": self.progressive,
            "rounding of planes and weights": self.rounding,
            "exact rounding of attributes": self.exact_rounding,
            "the end of the learning-rate schedule": math.inf if self.iterations is None else self.iterations - 1,
        }
        return [name for name, start in starts.items() if iteration <= start]

    def reduction(self, iteration: int, share: float) -> int:
        """The reduction of training pictures: by 4, then by 2, over the first `share` of the run; 1 afterwards."""
        progress = self.progress(iteration)
        return 4 if progress < share / 2 else 2 if progress < share else 1
