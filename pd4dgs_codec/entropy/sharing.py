"""Encoder side: let channels share a prior where one description serves several. Nothing here is normative.

Start with one prior per channel, close the prior whose description costs more than its channels lose elsewhere, refit
the rest on what they now serve, and repeat: k-means with a price on each centre.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pd4dgs_codec.entropy.fitting import Fitted, Histogram, costs_of, loops, pool
from pd4dgs_codec.entropy.priors import FREE_ENTRIES, MAX_WINDOW, MORE_ENTRIES

BLOCK = 256  #: channels planned together; keeps the cost matrix small
WIDE = 1024  #: a channel with more distinct symbols spends too much on each for its prior's few bytes to matter

Fit = Callable[[Histogram], Fitted]


def plan_priors(
    histograms: Sequence[Histogram], fit: Fit, rounds: int, known: Sequence[Fitted] = (), entries: int = FREE_ENTRIES
) -> list[Fitted]:
    """The prior of each channel; channels that share one hold the same object. known: priors that need no description
    any more. entries: of all tables, beyond one per symbol, where nothing is known; fewer than MAX_WINDOW only if no
    channel's range takes more."""
    plan = [fit(h) for h in histograms]
    free = [replace(fitted, price=0) for fitted in known]
    if free and plan:
        plan = [
            own if own.own + own.price < costs[best] else free[best]
            for own, costs in zip(plan, costs_of(histograms, free), strict=True)
            for best in [costs.argmin()]
        ]
    narrow = [c for c, h in enumerate(histograms) if len(h.values) <= WIDE]
    for start in range(0, len(narrow), BLOCK):
        block = narrow[start : start + BLOCK]
        shared = _plan_block([histograms[c] for c in block], [plan[c] for c in block], free, fit, rounds)
        for c, prior in zip(block, shared, strict=True):
            plan[c] = prior
    return _within_limit(histograms, plan, free, fit, MORE_ENTRIES if free else entries)


def _within_limit(
    histograms: Sequence[Histogram], plan: list[Fitted], free: list[Fitted], fit: Fit, entries: int
) -> list[Fitted]:
    """The plan, its widest new priors replaced by one for all their channels where the tables would be larger
    than a section may define, or by known ones where there is no room for it."""
    known = {id(p.prior) for p in free}
    distinct = {id(p.prior): p for p in plan if id(p.prior) not in known}.values()
    ordered = sorted(distinct, key=lambda p: p.prior.window.n)
    ends = np.cumsum([p.prior.window.n for p in ordered])
    left = sum(int(h.counts.sum()) for h in histograms) + entries
    if not ordered or ends[-1] <= left:
        return plan
    kept = known | {id(p.prior) for p, end in zip(ordered, ends, strict=True) if end <= left - MAX_WINDOW}
    rest = [c for c, p in enumerate(plan) if id(p.prior) not in kept]
    if free and left < MAX_WINDOW:
        nearest = costs_of([histograms[c] for c in rest], free).argmin(axis=1)
        replaced = dict(zip(rest, [free[i] for i in nearest], strict=True))
    else:
        replaced = dict.fromkeys(rest, fit(pool([histograms[c] for c in rest])))
    return [replaced.get(c, p) for c, p in enumerate(plan)]


def _plan_block(
    histograms: Sequence[Histogram], plan: list[Fitted], free: list[Fitted], fit: Fit, rounds: int
) -> list[Fitted]:
    priors = [*plan, *free]
    if rounds == 0 or len(histograms) < 2:
        return plan
    pooled = pool(histograms)
    if len(pooled.values) <= 4 * max(len(h.values) for h in histograms):  # else they have nothing in common
        priors.append(fit(pooled))
    best, costs = 1 << 62, costs_of(histograms, priors)
    for last in range(rounds - 1, -1, -1):
        owner, total = loops().assign(costs, np.array([p.price for p in priors]))
        if total >= best:
            break
        best, plan = total, [priors[p] for p in owner]
        if last:
            used = np.unique(owner)
            merged = _refit(histograms, owner, fit)
            if not merged:
                break
            priors = [*(priors[p] for p in used), *merged]
            costs = np.hstack([np.ascontiguousarray(costs[:, used]), costs_of(histograms, merged)])
    return plan


def _refit(histograms: Sequence[Histogram], owner: np.ndarray, fit: Fit) -> list[Fitted]:
    """For each prior that serves several channels the one fitted to all of them."""
    members = [np.flatnonzero(owner == p).tolist() for p in np.unique(owner)]
    return [fit(pool([histograms[c] for c in shared])) for shared in members if len(shared) > 1]
