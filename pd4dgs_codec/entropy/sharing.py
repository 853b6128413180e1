"""Encoder side: let channels share a prior where one description serves several. Nothing here is normative.

Start with one prior per channel, close the prior whose description costs more than its channels lose elsewhere, refit
the rest on what they now serve, and repeat: k-means with a price on each centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pd4dgs_codec.entropy.fitting import Histogram, exception_bits, pool, symbol_costs
from pd4dgs_codec.entropy.priors import MAX_ENTRIES, MAX_WINDOW, Prior, header_bits

BLOCK = 256  #: channels planned together; keeps the cost matrix small
WIDE = 1024  #: a channel with more distinct symbols spends too much on each for its prior's few bytes to matter

Fit = Callable[[Histogram], Prior]


def plan_priors(histograms: Sequence[Histogram], fit: Fit, rounds: int) -> list[Prior]:
    """The prior of each channel; channels that share one hold the same object."""
    plan = [fit(h) for h in histograms]
    narrow = [c for c, h in enumerate(histograms) if len(h.values) <= WIDE]
    for start in range(0, len(narrow), BLOCK):
        block = narrow[start : start + BLOCK]
        shared = _plan_block([histograms[c] for c in block], [plan[c] for c in block], fit, rounds)
        for c, prior in zip(block, shared, strict=True):
            plan[c] = prior
    return _within_limit(histograms, plan, fit)


def _within_limit(histograms: Sequence[Histogram], plan: list[Prior], fit: Fit) -> list[Prior]:
    """The plan, its widest priors replaced by one for all their channels where the tables would pass MAX_ENTRIES."""
    distinct = sorted({id(p): p for p in plan}.values(), key=lambda p: p.window.n)
    ends = np.cumsum([p.window.n for p in distinct])
    if not distinct or ends[-1] <= MAX_ENTRIES:
        return plan
    kept = {id(p) for p, end in zip(distinct, ends, strict=True) if end <= MAX_ENTRIES - MAX_WINDOW}
    rest = [c for c, p in enumerate(plan) if id(p) not in kept]
    common = fit(pool([histograms[c] for c in rest]))
    return [p if id(p) in kept else common for p in plan]


def _plan_block(histograms: Sequence[Histogram], plan: list[Prior], fit: Fit, rounds: int) -> list[Prior]:
    priors = list(plan)
    if rounds == 0 or len(histograms) < 2:
        return plan
    pooled = pool(histograms)
    if len(pooled.values) <= 4 * max(len(h.values) for h in histograms):  # else they have nothing in common
        priors.append(fit(pooled))
    best = np.inf
    for _ in range(rounds):
        costs, prices = _cost_matrix(histograms, priors), np.array([header_bits(p) for p in priors])
        owner, total = _assign(costs, prices)
        if total >= best:
            break
        best, plan = total, [priors[p] for p in owner]
        priors = _refit(histograms, priors, owner, fit)
    return plan


def _cost_matrix(histograms: Sequence[Histogram], priors: Sequence[Prior]) -> np.ndarray:
    """Bits of each channel under each prior, float64 [channels, priors], descriptions left out."""
    values = np.concatenate([h.values for h in histograms])
    counts = np.concatenate([h.counts for h in histograms])
    totals = np.array([h.total for h in histograms])
    starts = np.cumsum([0, *(len(h.values) for h in histograms[:-1])])
    costs = np.empty((len(histograms), len(priors)))
    for column, prior in enumerate(priors):
        bits, value_bytes = symbol_costs(prior, values)
        sums = np.add.reduceat(np.stack([bits, value_bytes > 0, value_bytes]) * counts, starts, axis=1)
        costs[:, column] = sums[0] + exception_bits(sums[1], sums[2], totals)
    return costs


def _assign(costs: np.ndarray, prices: np.ndarray) -> tuple[np.ndarray, float]:
    """Close priors one by one while that saves bits; the owner of each channel, int [channels], and the total."""
    open_ = np.arange(len(prices))
    while True:
        table = costs[:, open_]
        owner = table.argmin(axis=1)
        if len(open_) == 1:
            break
        first, second = np.partition(table, 1, axis=1)[:, :2].T
        saved = prices[open_] - np.bincount(owner, weights=second - first, minlength=len(open_))
        if saved.max() <= 0:
            break
        open_ = np.delete(open_, saved.argmax())
    return open_[owner], float(table.min(axis=1).sum() + prices[open_].sum())


def _refit(histograms: Sequence[Histogram], priors: Sequence[Prior], owner: np.ndarray, fit: Fit) -> list[Prior]:
    """The priors in use, and for each that serves several channels the one fitted to all of them."""
    used: list[Prior] = []
    for p in sorted(set(owner.tolist())):
        used.append(priors[p])
        members = np.flatnonzero(owner == p)
        if len(members) > 1:
            used.append(fit(pool([histograms[c] for c in members.tolist()])))
    return used
