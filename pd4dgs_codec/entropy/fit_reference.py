"""The inner loops of `fitting` and `sharing` in numpy: what an installation without numba runs, and what `fit_kernels`
is tested against.

A histogram is `dense` int64 [n], its counts per entry of a table. Costs are integers in units of 2^-20 bits (`BIT`).
Gaussians are fitted by interval likelihood (moments lose 15-130 % at sigma / Q <= 0.2). Nothing here is normative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.bits import BIT, frequency_costs, gaussian_bits_of, symbol_counts
from pd4dgs_codec.entropy.priors import CLASS_STEPS, FLOORS, top_limit
from pd4dgs_codec.entropy.tables import (
    OCTAVE,
    SI_MAX,
    SI_MIN,
    histogram_table,
    norm_cdf28,
    table_from_cdf28,
)

#: Counts are summed to 2^bits entries before a fit; a wide Gaussian loses nothing by it.
GAUSS_BITS, MIXTURE_BITS = 8, 10
GAUSS_ROUNDS = 12
#: A round that gains less ends the descent.
ENOUGH = BIT // 8
#: Widths that a histogram may give the Gaussian of its classes.
CLASS_WIDTHS = 64

gaussian_bits = gaussian_bits_of

Cost = Callable[[np.ndarray], np.ndarray]  #: int64 [K, D] parameters -> int64 [K]


def gauss(dense: np.ndarray) -> tuple[int, int, int, int, np.ndarray]:
    """The Gaussian that codes dense cheapest: (mu8, si, index of the floor, cost, costs of the entries int64 [n])."""
    counts, shift = _coarsen(dense, GAUSS_BITS)
    low, high = _bounds(len(counts))
    starts = np.clip(_moments(counts), low, high)
    x = _descend(counts, starts, lambda x: [max(1, int(2.0 ** (x[1] / 64) * 64)), 16], (low, high), GAUSS_ROUNDS)
    mu8, si = _finer(x, shift)
    return mu8, si, *_cheaper_floor(norm_cdf28(len(dense), mu8, si), dense)


def mixture(dense: np.ndarray, effort: int) -> tuple[int, int, int, int, int, int, int, np.ndarray]:
    """Two Gaussians: (mu8, si, mu8, si, weight of the second, index of the floor, cost, costs of the entries)."""
    counts, shift = _coarsen(dense, MIXTURE_BITS)
    low, high = _bounds(len(counts))

    def steps(x: np.ndarray) -> list[int]:
        first, second = (max(1, int(2.0 ** (si / 64) * 32)) for si in (x[1], x[3]))
        return [first, 16, second, 16, 8]

    bounds = np.append(np.tile(low, 2), 1), np.append(np.tile(high, 2), 255)
    x = _descend(counts, _expectation_maximisation(counts, 4 + 2 * effort), steps, bounds, 4 * effort)
    (mu1, si1), (mu2, si2), weight = _finer(x[:2], shift), _finer(x[2:4], shift), int(x[4])
    n = len(dense)
    cdf = ((256 - weight) * norm_cdf28(n, mu1, si1) + weight * norm_cdf28(n, mu2, si2)) >> 8
    return mu1, si1, mu2, si2, weight, *_cheaper_floor(cdf, dense)


def classes(dense: np.ndarray) -> tuple[int, int, int, int, int, int, int, np.ndarray, np.ndarray]:
    """The frequencies themselves, rounded to classes: (index of the step or -1 if none fits, differences, top,
    class_si16, class_mean16, cost of dense, cost of the classes, costs of the entries, classes int64 [n])."""
    n, taken = len(dense), dense > 0
    price = frequency_costs(np.maximum(dense, 1))
    octaves = np.where(taken, price - price[dense.argmax()], 0)
    least, best = 1 << 62, (-1, 0, 0, 0, 0, 0, 0, np.empty(n, np.int64), np.empty(n, np.int64))
    for number, step in enumerate(CLASS_STEPS):
        below = (octaves * 64 + step * BIT // 2) // (step * BIT)
        top = int(below.max()) + 1
        if top > top_limit(step):
            continue
        down = below * step
        costs = frequency_costs(np.diff(histogram_table(np.where(taken, OCTAVE[down & 63] >> (down >> 6), 0))))
        cost, found = int(dense @ costs), np.where(taken, top - below, 0)
        for differences in (0, 1):
            symbols = np.diff(found, prepend=0) + top if differences else found
            counts = np.bincount(symbols, minlength=2 * top + 1 if differences else top + 1)
            mean16 = 0 if differences else (32 * int(found.sum()) + n) // (2 * n)
            width, described = _class_width(counts, 256 * top if differences else 16 * mean16)
            size = 1 + (top >= 1 << 7)
            if not differences:
                size += 1 + (mean16 >= 1 << 7) + (mean16 >= 1 << 14)
            if cost + described + 8 * BIT * size < least:
                least = cost + described + 8 * BIT * size
                best = (number, differences, top, width, mean16, cost, described, costs, found)
    return best


def cost_matrix(
    values: np.ndarray, counts: np.ndarray, ends: np.ndarray, windows: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """Cost of each channel under each prior without its description, int64 [channels, priors].

    values, counts: int64, of all channels one after the other, which end at `ends` [channels]. windows: int64
    [priors, 4] of (kmin, n, shift, first of its entries in `costs`); costs int64: of all entries, low bits included.
    Symbols outside a window are listed: their number, and a position step and a distance each, an estimate.
    """
    starts = np.concatenate([[0], ends[:-1]])
    totals = np.add.reduceat(counts, starts)
    matrix = np.empty((len(ends), len(windows)), np.int64)
    for column, (kmin, n, shift, at) in enumerate(windows.tolist()):
        end = kmin + (n << shift)
        inside = (values >= kmin) & (values < end)
        each = np.where(inside, costs[at + np.where(inside, (values - kmin) >> shift, 0)], 0)
        distance = 2 * np.where(values < kmin, kmin - values, values - end)
        bytes_ = np.where(inside, 0, 1 + (distance >= 1 << 7) + (distance >= 1 << 14) + (distance >= 1 << 21))
        cost, number, value_bytes = np.add.reduceat(np.stack([each, ~inside, bytes_]) * counts, starts, axis=1)
        step_bytes = 1 + (totals > 90 * number) + (totals > 12000 * number)
        listed = 1 + (number >= 128) + step_bytes * number + value_bytes
        matrix[:, column] = cost + np.where(number > 0, 8 * BIT * listed, 0)
    return matrix


def assign(costs: np.ndarray, prices: np.ndarray) -> tuple[np.ndarray, int]:
    """Close priors one by one while that saves bits: (the owner of each channel int64 [channels], the total).

    costs: int64 [channels, priors]; prices: int64 [priors], of the descriptions.
    """
    open_ = np.arange(len(prices))
    while True:
        table = costs[:, open_]
        owner = table.argmin(axis=1)
        if len(open_) == 1:
            break
        first, second = np.partition(table, 1, axis=1)[:, :2].T
        lost = np.zeros(len(open_), np.int64)
        np.add.at(lost, owner, second - first)
        saved = prices[open_] - lost
        if saved.max() <= 0:
            break
        open_ = np.delete(open_, saved.argmax())
    return open_[owner], int(table.min(axis=1).sum() + prices[open_].sum())


def split_cost(channels: np.ndarray, classes: np.ndarray, count: int) -> Any:
    """Order-0 entropy of channels int64 [m, n], each split into the `count` classes int64 [n] of its places."""
    cost = 0
    for channel in channels:
        for k in range(count):
            part = channel[classes == k]
            if part.size:
                counts = symbol_counts(part)[1]
                cost += int(counts @ frequency_costs(counts)) - part.size * int(frequency_costs(np.array(part.size)))
    return cost


def _coarsen(dense: np.ndarray, bits: int) -> tuple[np.ndarray, int]:
    """(counts of at most 2^bits entries, how many bits of the entry's number they leave out)."""
    shift = max(0, (len(dense) - 1).bit_length() - bits)
    if shift:
        dense = np.add.reduceat(dense, np.arange(0, len(dense), 1 << shift))
    return dense, shift


def _finer(x: np.ndarray, shift: int) -> tuple[int, int]:
    """(mu8, si) fitted on coarsened counts, in the units of the full table."""
    return (int(x[0]) << shift) + 128 * ((1 << shift) - 1), min(int(x[1]) + 64 * shift, SI_MAX)


def _cheaper_floor(cdf: np.ndarray, dense: np.ndarray) -> tuple[int, int, np.ndarray]:
    """(index of the floor, cost of dense, costs of the entries)."""
    both = [frequency_costs(np.diff(table_from_cdf28(cdf, floor))) for floor in FLOORS]
    bits = [int(costs @ dense) for costs in both]
    floor = int(bits[1] < bits[0])
    return floor, bits[floor], both[floor]


def _bounds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(mu8, si) of a fit over n entries: the mean may leave the window by eight times its size, never more."""
    return np.array([-2048 * n, SI_MIN]), np.array([2048 * n, SI_MAX])


def _descend(
    counts: np.ndarray,
    starts: np.ndarray,
    steps_at: Callable[[np.ndarray], list[int]],
    bounds: tuple[np.ndarray, np.ndarray],
    rounds: int,
) -> np.ndarray:
    """From the cheapest start int64 [S, D] (D is 2 for a Gaussian, 5 for a mixture) downhill on integers: probe each
    axis both ways, then the joint parabola step; halve steps that stop paying."""
    n, (low, high) = len(counts), bounds

    def cost(p: np.ndarray) -> np.ndarray:
        cdf = norm_cdf28(n, p[:, 0], p[:, 1])
        if p.shape[1] == 5:
            cdf = ((256 - p[:, 4:]) * cdf + p[:, 4:] * norm_cdf28(n, p[:, 2], p[:, 3])) >> 8
        # the higher floor keeps outliers from steering the fit
        each = np.diff(table_from_cdf28(cdf, FLOORS[-1]))
        total: np.ndarray = np.asarray(frequency_costs(each) @ counts)
        return total

    f = cost(starts)
    x, fx = starts[f.argmin()], int(f.min())
    steps = np.array(steps_at(x))
    for _ in range(rounds):
        probes = np.clip(x + np.concatenate([np.diag(steps), -np.diag(steps)]), low, high)
        f = cost(probes)
        up, down = np.split(f, 2)
        curvature = up + down - 2 * fx
        newton = np.where(curvature > 0, steps * (down - up) / (2.0 * np.where(curvature > 0, curvature, 1)), 0)
        jump = np.clip(x + np.rint(np.clip(newton, -2 * steps, 2 * steps)).astype(np.int64), low, high)
        probes, f = np.vstack([probes, jump]), np.append(f, cost(jump[None]))
        best = int(f.argmin())
        gain = fx - int(f[best])
        if gain <= 0 and np.all(steps == 1):
            break
        if gain > 0:
            x, fx = probes[best], int(f[best])
            if gain < ENOUGH:
                break
        if best == len(f) - 1 or gain <= 0:
            steps = np.maximum(steps // 2, 1)
    found: np.ndarray = x
    return found


def _moments(counts: np.ndarray) -> np.ndarray:
    """Two starts, int64 [2, 2] of (mu8, si): by moments, and by quartiles, which outliers cannot move."""
    k, weights = np.arange(len(counts)), counts / counts.sum()
    mean = k @ weights
    sigma = np.sqrt(max((k - mean) ** 2 @ weights - 1 / 12, 0.01))
    lower, median, upper = np.interp((0.25, 0.5, 0.75), np.cumsum(weights) - weights / 2, k)
    robust = max((upper - lower) / 1.349, 0.1)
    return np.rint([[256 * mean, 64 * np.log2(sigma)], [256 * median, 64 * np.log2(robust)]]).astype(np.int64)


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
        weight = mass * (counts / mass.sum(axis=1, keepdims=True))
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


def _class_width(counts: np.ndarray, mu8: int) -> tuple[int, int]:
    """(class_si16, cost) of the cheapest Gaussian around mu8 for a histogram's own classes, counts int64 [n] of their
    symbols: from their spread downhill."""

    def cost(width: int) -> int:
        cdf = norm_cdf28(len(counts), mu8, 16 * width - 160)
        return int(frequency_costs(np.diff(table_from_cdf28(cdf, 1))) @ counts)

    spread = float((256.0 * np.arange(len(counts)) - mu8) ** 2 @ counts) / int(counts.sum())
    si = 64 * np.log2(max(np.sqrt(spread) / 256, 0.1))
    width = int(np.clip(np.rint((si + 160) / 16), 0, CLASS_WIDTHS - 1))
    least = cost(width)
    for step in (-1, 1):
        moved = False
        while 0 <= width + step < CLASS_WIDTHS and (there := cost(width + step)) < least:
            width, least, moved = width + step, there, True
        if moved:
            break
    return width, least
