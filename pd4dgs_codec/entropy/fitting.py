"""Encoder side: choose the cheapest prior for a histogram of symbols. Nothing here is normative.

Costs are exact: bits of the integer table itself plus the prior's description. Only the position part of exceptions is
an estimate. Gaussians are fitted by interval likelihood (moments lose 15-130 % at sigma / Q <= 0.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pd4dgs_codec.entropy.bits import order0_bits, symbol_counts
from pd4dgs_codec.entropy.priors import (
    CLASS_STEPS,
    FLOORS,
    K_MAX,
    MAX_WINDOW,
    Const,
    Gauss,
    Hist,
    Mixture,
    Normal,
    Prior,
    Window,
    header_bits,
    top_limit,
)
from pd4dgs_codec.entropy.tables import SI_MAX, SI_MIN, norm_cdf28, table_from_cdf28

Cost = Callable[[np.ndarray], np.ndarray]  #: int64 [K, D] parameters -> float64 [K] bits


@dataclass(frozen=True, eq=False)
class Histogram:
    values: np.ndarray  #: int64 [U], ascending
    counts: np.ndarray  #: int64 [U], positive

    @property
    def total(self) -> int:
        return int(self.counts.sum())

    @cached_property
    def gauss(self) -> Prior:
        """Kept, because both policies start from it."""
        return fit_gauss(self)


def histogram(symbols: np.ndarray) -> Histogram:
    """Of a non-empty channel."""
    return Histogram(*symbol_counts(symbols))


def pool(histograms: Sequence[Histogram]) -> Histogram:
    values, index = np.unique(np.concatenate([h.values for h in histograms]), return_inverse=True)
    counts = np.bincount(index, weights=np.concatenate([h.counts for h in histograms]))
    return Histogram(values, counts.astype(np.int64))


def exception_bits(number: np.ndarray, value_bytes: np.ndarray, totals: np.ndarray) -> np.ndarray:
    """Estimated bits of exception lists, float64 [C]: their length, then a position step and a distance each.

    number, value_bytes, totals: int64 [C], exceptions, their distances' bytes, and symbols per channel.
    """
    gap = totals / np.maximum(number, 1)
    step_bytes = 1 + (gap > 90) + (gap > 12000)
    return 8.0 * np.where(number > 0, 1 + (number >= 128) + step_bytes * number + value_bytes, 0)


def symbol_costs(prior: Prior, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per value: its bits under the prior (0 outside the window), and its bytes as an exception (0 inside)."""
    window = prior.window
    inside = (values >= window.kmin) & (values < window.end)
    bits = 24 + window.shift - np.log2(np.diff(prior.cum))
    entry = np.where(inside, (values - window.kmin) >> window.shift, 0)
    distance = 2 * np.where(values < window.kmin, window.kmin - values, values - window.end)
    value_bytes = 1 + (distance >= 1 << 7) + (distance >= 1 << 14) + (distance >= 1 << 21)
    return np.where(inside, bits[entry], 0), np.where(inside, 0, value_bytes)


def prior_bits(prior: Prior, h: Histogram) -> float:
    """Bits of coding the histogram's symbols under the prior, without its description."""
    bits, value_bytes = symbol_costs(prior, h.values)
    listed = exception_bits(h.counts @ (value_bytes > 0), h.counts @ value_bytes, h.counts.sum())
    return float(h.counts @ bits + listed)


def fit_gauss(h: Histogram) -> Prior:
    """The cheapest of const and gauss, the window chosen along with it."""
    if len(h.values) == 1:
        return Const(Window(int(h.values[0]), 1))
    candidates: list[Prior] = [_fit_gauss_in(h, w) for w in _windows(h)]
    mode = int(h.counts.argmax())
    if h.total - int(h.counts[mode]) <= 8:
        candidates.append(Const(Window(int(h.values[mode]), 1)))
    return _cheapest(candidates, h)


def fit_best(h: Histogram, effort: int) -> Prior:
    """The cheapest of all priors, on the window that suits the Gaussian best."""
    return _cheapest([h.gauss, *_richer_priors(h, h.gauss, effort)], h)


def _cheapest(priors: Sequence[Prior], h: Histogram) -> Prior:
    return min(priors, key=lambda p: prior_bits(p, h) + header_bits(p)) if len(priors) > 1 else priors[0]


def _richer_priors(h: Histogram, found: Prior, effort: int) -> list[Prior]:
    """Mixture and histogram on the window found, unless the empirical entropy leaves them nothing to gain."""
    if found.window.n == 1 or effort == 1:
        return []
    counts = _dense(h, found.window)
    seen = counts[counts > 0]
    entropy = order0_bits(seen) + found.window.shift * float(seen.sum())
    spare = prior_bits(found, h) - entropy
    priors: list[Prior] = []
    if spare > 40 + 0.72 * len(seen):  # a mixture's five more bytes; the entropy of a sample is low by log2(e) / 2 each
        priors.append(_fit_mixture(counts, found, effort))
    if spare > len(seen):  # a class costs a bit or more
        priors += _fit_histograms(counts, found.window)
    return priors


def _windows(h: Histogram) -> list[Window]:
    """The full range, and narrower ones where far outliers stretch it.

    Inside the window an outlier costs 20 bits, as an exception 24 or more: trimming pays only for wide windows.
    """
    windows = [_window(int(h.values[0]), int(h.values[-1]))]
    if h.values[-1] - h.values[0] < 512:
        return windows
    below = np.cumsum(h.counts)
    median = h.values[np.searchsorted(below, below[-1] / 2)]
    order = np.argsort(-np.abs(h.values - median))  # farthest first
    trimmed = np.cumsum(h.counts[order])
    m = 1
    while m <= h.total // 16:
        cut = int(np.searchsorted(trimmed, m, side="right"))  # at most m symbols leave
        if cut:
            kept = h.values[order[cut:]]
            narrower = _window(int(kept.min()), int(kept.max()))
            if 2 * (narrower.end - narrower.kmin) < windows[-1].end - windows[-1].kmin:
                windows.append(narrower)
        m *= 2
    return windows


def _window(low: int, high: int) -> Window:
    shift = max(0, (high - low).bit_length() - (MAX_WINDOW.bit_length() - 1))
    if low == high:  # a table has two entries at least, and both must be symbols
        return Window(min(low, K_MAX - 1), 2)
    return Window(low, ((high - low) >> shift) + 1, shift)


def _dense(h: Histogram, window: Window) -> np.ndarray:
    """Counts per table entry, float64 [n]."""
    inside = (h.values >= window.kmin) & (h.values < window.end)
    entries = (h.values[inside] - window.kmin) >> window.shift
    return np.bincount(entries, weights=h.counts[inside], minlength=window.n)


def _coarsen(counts: np.ndarray, bits: int) -> tuple[np.ndarray, int]:
    """Sum neighbours until at most 2**bits entries are left; a wide Gaussian loses nothing by it."""
    shift = max(0, (len(counts) - 1).bit_length() - bits)
    if shift:
        counts = np.add.reduceat(counts, np.arange(0, len(counts), 1 << shift))
    return counts, shift


def _finer(mu8: int, si: int, shift: int) -> Normal:
    """A Gaussian fitted on coarsened counts, in the units of the full table."""
    return Normal((mu8 << shift) + 128 * ((1 << shift) - 1), min(si + 64 * shift, SI_MAX))


def _table_bits(cdf28: np.ndarray, counts: np.ndarray) -> np.ndarray:
    cum = table_from_cdf28(cdf28, FLOORS[-1])  # the higher floor keeps outliers from steering the fit
    bits: np.ndarray = (24 - np.log2(np.diff(cum))) @ counts
    return bits


def _refine(
    cost: Cost, x: np.ndarray, steps: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], rounds: int
) -> np.ndarray:
    """Descend on integers: probe each axis both ways, then the joint parabola step; halve steps that stop paying."""
    low, high = bounds
    fx = float(cost(x[None])[0])
    for _ in range(rounds):
        probes = np.clip(x + np.concatenate([np.diag(steps), -np.diag(steps)]), low, high)
        f = cost(probes)
        up, down = np.split(f, 2)
        curvature = up + down - 2 * fx
        newton = np.where(curvature > 0, steps * (down - up) / (2 * np.where(curvature > 0, curvature, 1)), 0)
        jump = np.clip(x + np.rint(np.clip(newton, -2 * steps, 2 * steps)).astype(np.int64), low, high)
        probes, f = np.vstack([probes, jump]), np.append(f, cost(jump[None]))
        best = int(f.argmin())
        if f[best] >= fx and np.all(steps == 1):
            break
        if f[best] < fx:
            x, fx = probes[best], float(f[best])
        if best == len(f) - 1 or f[best] >= fx:
            steps = np.maximum(steps // 2, 1)
    return x


def _moments(counts: np.ndarray) -> np.ndarray:
    """Two starts, int64 [2, 2] of (mu8, si): by moments, and by quartiles, which outliers cannot move."""
    k, weights = np.arange(len(counts)), counts / counts.sum()
    mean = k @ weights
    sigma = np.sqrt(max((k - mean) ** 2 @ weights - 1 / 12, 0.01))
    lower, median, upper = np.interp((0.25, 0.5, 0.75), np.cumsum(weights) - weights / 2, k)
    robust = max((upper - lower) / 1.349, 0.1)
    return np.rint([[256 * mean, 64 * np.log2(sigma)], [256 * median, 64 * np.log2(robust)]]).astype(np.int64)


def _bounds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(mu8, si) of a fit over n entries: the mean may leave the window by eight times its size, never more."""
    return np.array([-2048 * n, SI_MIN]), np.array([2048 * n, SI_MAX])


def _fit_gauss_in(h: Histogram, window: Window) -> Gauss:
    dense = _dense(h, window)
    counts, shift = _coarsen(dense, 8)
    n = len(counts)

    def cost(p: np.ndarray) -> np.ndarray:
        return _table_bits(norm_cdf28(n, p[:, 0], p[:, 1]), counts)

    starts = np.clip(_moments(counts), *_bounds(n))
    x = starts[int(cost(starts).argmin())]
    steps = np.array([max(1, int(2.0 ** (x[1] / 64) * 64)), 16])
    x = _refine(cost, x, steps, _bounds(n), 12)
    normal = _finer(int(x[0]), int(x[1]), shift)
    both = [Gauss(window, normal, floor) for floor in FLOORS]
    return min(both, key=lambda g: float(-np.log2(np.diff(g.cum)) @ dense))


def _fit_mixture(dense: np.ndarray, found: Prior, effort: int) -> Mixture:
    counts, shift = _coarsen(dense, 10)
    n = len(counts)

    def cost(p: np.ndarray) -> np.ndarray:
        c1, c2 = norm_cdf28(n, p[:, 0], p[:, 1]), norm_cdf28(n, p[:, 2], p[:, 3])
        return _table_bits(((256 - p[:, 4:]) * c1 + p[:, 4:] * c2) >> 8, counts)

    starts = _expectation_maximisation(counts, 4 + 2 * effort)
    x = starts[int(cost(starts).argmin())]
    widths = [max(1, int(2.0 ** (si / 64) * 32)) for si in (x[1], x[3])]
    steps = np.array([widths[0], 16, widths[1], 16, 8])
    low, high = _bounds(n)
    x = _refine(cost, x, steps, (np.append(np.tile(low, 2), 1), np.append(np.tile(high, 2), 255)), 4 * effort)
    first, second = _finer(int(x[0]), int(x[1]), shift), _finer(int(x[2]), int(x[3]), shift)
    both = [Mixture(found.window, first, second, int(x[4]), floor) for floor in FLOORS]
    return min(both, key=lambda m: float(-np.log2(np.diff(m.cum)) @ dense))


def _expectation_maximisation(counts: np.ndarray, rounds: int) -> np.ndarray:
    """Three starts run side by side: narrow and wide, left and right, a spike and the rest. int64 [3, 5] parameters."""
    k, total = np.arange(len(counts), dtype=np.float64), counts.sum()
    mean = k @ counts / total
    sigma = np.sqrt(max((k - mean) ** 2 @ counts / total, 0.05))
    mode = float(counts.argmax())
    mu = np.array([[mean, mean], [mean - sigma, mean + sigma], [mean, mode]])
    sd = np.array([[sigma / 2, 2 * sigma], [sigma / 2, sigma / 2], [sigma, 0.3]])
    share = np.array([[0.6, 0.4], [0.5, 0.5], [0.5, 0.5]])
    for _ in range(rounds):
        mass = _interval_mass(len(counts), mu, sd) * share[..., None]
        weight = mass / mass.sum(axis=1, keepdims=True) * counts
        size = np.maximum(weight.sum(axis=2), 1e-3)
        share = size / size.sum(axis=1, keepdims=True)
        mu = (weight @ k) / size
        spread = (weight * (k - mu[..., None]) ** 2).sum(axis=2) / size
        sd = np.sqrt(np.maximum(spread - 1 / 12, 0.02))
    mu8, si = np.rint(256 * mu), np.rint(64 * np.log2(sd))
    weight256 = np.clip(np.rint(256 * share[:, 1]), 1, 255)
    return np.stack([mu8[:, 0], si[:, 0], mu8[:, 1], si[:, 1], weight256], axis=1).astype(np.int64)


def _interval_mass(n: int, mu: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """float64 [..., n] masses, kept above zero so that every entry belongs to someone."""
    si = np.clip(np.rint(64 * np.log2(sd)), SI_MIN, SI_MAX).astype(np.int64)
    cum = table_from_cdf28(norm_cdf28(n, np.rint(256 * mu).astype(np.int64), si), 1)
    return np.diff(cum).astype(np.float64)


def _fit_histograms(counts: np.ndarray, window: Window) -> list[Prior]:
    """One histogram per class step and per way of coding the classes, those that can be represented."""
    priors: list[Prior] = []
    with np.errstate(divide="ignore"):
        octaves = np.log2(counts.max() / counts)
    for step in CLASS_STEPS:
        below = np.rint(np.where(counts > 0, octaves, 0) * 64 / step).astype(np.int64)
        top = int(below.max()) + 1
        if top > top_limit(step):
            continue
        classes = np.where(counts > 0, top - below, 0)
        for differences in (False, True):
            mean16 = 0 if differences else int(np.rint(16 * classes.mean()))
            draft = Hist(window, step, top, differences, 0, mean16, classes)
            priors.append(Hist(window, step, top, differences, _class_width(draft), mean16, classes))
    return priors


def _class_width(draft: Hist) -> int:
    """The cheapest of the coarse widths for coding the histogram's own classes."""
    n = len(draft.class_cum) - 1
    mu8 = 256 * draft.top if draft.differences else 16 * draft.class_mean16
    cum = table_from_cdf28(norm_cdf28(n, mu8, 16 * np.arange(64) - 160), 1)
    counts = np.bincount(draft.class_symbols, minlength=n)
    return int((-np.log2(np.diff(cum)) @ counts).argmin())
