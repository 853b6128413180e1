"""Encoder: finds the cheapest prior for each channel, and priors that channels share. Nothing here is normative.

Costs are in units of 2^-20 bits and exact, from the integer table and the prior's description; only the cost of
exceptions is an estimate. Files are the same with and without numba.

Sharing starts with one prior per channel and removes priors whose description costs more than their channels lose under
other priors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import ModuleType

import numpy as np

from pd4dgs_codec.entropy.priors import (
    BIT,
    K_MAX,
    MAX_WINDOW,
    Normal,
    Prior,
    Window,
)

BLOCK = 256  #: channels planned together; keeps the cost matrix small
NEAR = 48  #: latest priors whose tokens take one byte, even behind a few new ones
WIDE = 1024  #: most distinct symbols of a channel that takes part in sharing; beyond, a prior's few bytes do not matter


# -- entropy -----------------------------------------------------------------------------------------------------------


def order0_bits(counts: np.ndarray) -> float:
    """Order-0 entropy of symbols that occur counts [U] times, all positive, in bits for all symbols together."""
    each = counts.astype(np.float64)
    total = each.sum()
    return float(total * np.log2(total) - (each * np.log2(each)).sum())


def entropy_bits(symbols: np.ndarray) -> float:
    """Order-0 entropy of integer symbols, in bits for all symbols together."""
    return order0_bits(histogram(symbols).counts) if symbols.size else 0.0


# -- fits --------------------------------------------------------------------------------------------------------------


@cache
def loops() -> ModuleType:
    """Imports the inner loops at the first fit: decoding imports this module too and must not load numba."""
    from pd4dgs_codec.entropy import fit_kernels

    return fit_kernels


@dataclass(frozen=True, eq=False)
class Histogram:
    values: np.ndarray  #: int64 [U], ascending
    counts: np.ndarray  #: int64 [U], positive

    @cached_property
    def total(self) -> int:
        return int(self.counts.sum())

    @property
    def rate_bits(self) -> float:
        """The sum of R(a), see `fit_kernels.gaussian_bits`."""
        return float(loops().gaussian_bits(self.values, self.counts))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A prior and its costs in 2^-20 bits. costs: int64 [n], of its table's entries. price: of its description.
    own: of the symbols that it was fitted to. token: of each use, beyond one byte."""

    prior: Prior
    costs: np.ndarray
    price: int
    own: int
    token: int = 0


def histogram(symbols: np.ndarray, times: np.ndarray | None = None) -> Histogram:
    """The histogram of a non-empty channel. times: int [N], how often each symbol counts; once if None."""
    low, high = int(symbols.min()), int(symbols.max())
    if high - low > 4 * symbols.size + 1024:  # too wide for an array of counts, which is faster than sorting
        values, index = np.unique(symbols, return_inverse=True)
        return Histogram(values.astype(np.int64), np.bincount(index, weights=times).astype(np.int64))
    counts = np.bincount(symbols.astype(np.int64) - low, weights=times).astype(np.int64)
    present = np.flatnonzero(counts)
    return Histogram(present + low, counts[present])


def pool(histograms: Sequence[Histogram]) -> Histogram:
    """The histogram of several channels together."""
    values, counts = ([getattr(h, name) for h in histograms] for name in ("values", "counts"))
    return histogram(np.concatenate(values), np.concatenate(counts))


def costs_of(histograms: Sequence[Histogram], priors: Sequence[Fitted]) -> np.ndarray:
    """Cost of coding each histogram's symbols under each prior, int64 [histograms, priors]; see `cost_matrix`. Tokens
    count as far as they take more than a byte."""
    windows = [p.prior.window for p in priors]
    first = np.cumsum([0, *(len(p.costs) for p in priors[:-1])])
    shapes = np.array([(w.kmin, w.n, at) for w, at in zip(windows, first.tolist(), strict=True)], np.int64)
    matrix: np.ndarray = loops().cost_matrix(
        np.concatenate([h.values for h in histograms]),
        np.concatenate([h.counts for h in histograms]),
        np.cumsum([len(h.values) for h in histograms]),
        shapes,
        np.concatenate([p.costs for p in priors]),
    )
    matrix += np.array([p.token for p in priors])
    return matrix


def fit_gauss(h: Histogram) -> Fitted:
    """Returns the cheaper of a constant and a Gaussian."""
    if len(h.values) == 1:
        return _const(h, 0)
    window = _fullest_window(h)
    mu8, si, cost, costs = loops().gauss(_dense(h, window))
    found = _fitted(Prior(window, (Normal(mu8, si),)), costs, cost + _beside(h, window))
    mode = int(h.counts.argmax())
    return min(found, _const(h, mode), key=_total) if h.total - int(h.counts[mode]) <= 8 else found


def fit_best(h: Histogram, effort: int) -> Fitted:
    """Returns the cheaper of `fit_gauss` and a mixture in its window, which is not tried where the empirical entropy
    shows that it cannot gain."""
    found = fit_gauss(h)
    window = found.prior.window
    if window.n == 1:
        return found
    dense, beside = _dense(h, window), _beside(h, window)
    seen = dense[dense > 0]
    spare = (found.own - beside) / BIT - order0_bits(seen)
    if spare <= 40 + 0.72 * len(seen):  # a mixture takes five more bytes; a sample's entropy is low by log2(e) / 2 each
        return found
    mu1, si1, mu2, si2, weight, cost, costs = loops().mixture(dense, effort)
    mixture = Prior(window, (Normal(mu1, si1), Normal(mu2, si2)), weight)
    return min(found, _fitted(mixture, costs, cost + beside), key=_total)


def _total(fitted: Fitted) -> int:
    return fitted.own + fitted.price


def _const(h: Histogram, mode: int) -> Fitted:
    window = Window(int(h.values[mode]), 1)
    return _fitted(Prior(window), np.zeros(1, np.int64), _beside(h, window))


def _fitted(prior: Prior, costs: np.ndarray, own: int) -> Fitted:
    out = bytearray()
    prior.write(out)
    return Fitted(prior, costs, 8 * BIT * len(out), own)


def _dense(h: Histogram, window: Window) -> np.ndarray:
    """Counts per table entry, int64 [n]."""
    values, counts = h.values, h.counts
    if values[0] < window.kmin or values[-1] >= window.end:
        inside = (values >= window.kmin) & (values < window.end)
        values, counts = values[inside], counts[inside]
    dense = np.zeros(window.n, np.int64)
    np.add.at(dense, values - window.kmin, counts)
    return dense


def _beside(h: Histogram, window: Window) -> int:
    """Cost of the symbols outside the window as exceptions."""
    if window.kmin <= h.values[0] and h.values[-1] < window.end:
        return 0
    free = Fitted(Prior(window), np.zeros(window.n, np.int64), 0, 0)
    return int(costs_of([h], [free])[0, 0])


def _fullest_window(h: Histogram) -> Window:
    """Returns the full range of the symbols, or the fullest window of the largest size; others become exceptions."""
    low, high = int(h.values[0]), int(h.values[-1])
    if high - low >= MAX_WINDOW:
        ends = np.searchsorted(h.values, h.values + MAX_WINDOW)  # of a window that begins at each value
        inside = np.diff(np.concatenate([[0], np.cumsum(h.counts)])[np.stack([np.arange(len(ends)), ends])], axis=0)
        fullest = int(inside.argmax())
        low, high = int(h.values[fullest]), int(h.values[ends[fullest] - 1])
    if low == high:  # a table has at least two entries, and both must be symbols
        return Window(min(low, K_MAX - 1), 2)
    return Window(low, high - low + 1)


# -- sharing -----------------------------------------------------------------------------------------------------------

Fit = Callable[[Histogram], Fitted]


def plan_priors(
    histograms: Sequence[Histogram], fit: Fit, share: bool, known: Sequence[Fitted], room: int
) -> list[Fitted]:
    """Returns the prior of each channel; channels that share one get the same object. share: whether channels may share
    new priors. known: priors that were described earlier, at no cost now. room: most entries of all new tables, at
    least one per channel."""
    plan = fits = [fit(h) for h in histograms]
    far = len(known) - NEAR
    free = [replace(fitted, price=0, token=8 * BIT * (i < far)) for i, fitted in enumerate(known)]
    if free and plan:
        plan = [
            own if own.own + own.price < costs[best] else free[best]
            for own, costs in zip(plan, costs_of(histograms, free), strict=True)
            for best in [costs.argmin()]
        ]
    narrow = [c for c, h in enumerate(histograms) if len(h.values) <= WIDE]
    for start in range(0, len(narrow) if share else 0, BLOCK):
        block = narrow[start : start + BLOCK]
        shared = _shared([histograms[c] for c in block], [fits[c] for c in block], free)
        for c, prior in zip(block, shared, strict=True):
            plan[c] = prior
    return _within(room, histograms, plan, free, fit)


def _within(
    room: int, histograms: Sequence[Histogram], plan: list[Fitted], free: list[Fitted], fit: Fit
) -> list[Fitted]:
    """Returns the plan, changed if its new tables have more than `room` entries: then one prior for all their channels
    replaces the widest new ones, or known priors and constants do if there is no room for one."""
    known = {id(p.prior) for p in free}
    distinct = {id(p.prior): p for p in plan if id(p.prior) not in known}.values()
    ordered = sorted(distinct, key=lambda p: p.prior.window.n)
    ends = np.cumsum([p.prior.window.n for p in ordered])
    if not ordered or ends[-1] <= room:
        return plan
    kept = known | {id(p.prior) for p, end in zip(ordered, ends, strict=True) if end <= room - MAX_WINDOW}
    rest = [c for c, p in enumerate(plan) if id(p.prior) not in kept]
    if room < MAX_WINDOW:
        replaced = {}
        for c in rest:
            mode = int(histograms[c].counts.argmax())
            candidates = [*free, _const(histograms[c], mode)]
            replaced[c] = candidates[int(costs_of([histograms[c]], candidates)[0].argmin())]
    else:
        replaced = dict.fromkeys(rest, fit(pool([histograms[c] for c in rest])))
    return [replaced.get(c, p) for c, p in enumerate(plan)]


def _shared(histograms: Sequence[Histogram], plan: list[Fitted], free: list[Fitted]) -> list[Fitted]:
    if len(histograms) < 2:
        return plan
    priors = [*plan, *free]
    owner = loops().assign(costs_of(histograms, priors), np.array([p.price for p in priors]))
    return [priors[p] for p in owner]
