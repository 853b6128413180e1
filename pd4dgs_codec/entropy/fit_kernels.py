"""The inner loops of `fitting`: they fit priors, compute costs and choose shared priors. Nothing here is normative.

numba compiles the loops if it is installed. Otherwise Python runs the same source, some ten times slower, with numpy
for the innermost loops over a table. Costs are integers in units of 2^-20 bits (`BIT`), so that both choose the same.
`dense` int64 [n] is a histogram: counts per entry of a table. Gaussians are fitted by interval likelihood: fits by
moments lose 15 to 130 % at sigma / Q <= 0.2.

The first fit of an installation waits for the compilation, so slow constructs are avoided: assigning an array to a
slice takes five seconds to compile, `np.interp` two, and each constant argument compiles a function anew.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.ans import TOTAL
from pd4dgs_codec.entropy.priors import (
    BIT,
    FLOOR,
    LOG2,
    NORMAL,
    OCTAVE,
    SI_MAX,
    SI_MIN,
    frequency_costs,
    norm_cdf28_of_each,
)

try:
    from numba import njit

    NUMBA = True
except ImportError:
    NUMBA = False

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
_compiled: Decorator = njit(cache=True, nogil=True) if NUMBA else lambda function: function
_inlined: Decorator = njit(cache=True, nogil=True, forceinline=True) if NUMBA else lambda function: function

#: Counts are summed into at most 2^bits entries before a fit, at no loss for a wide Gaussian.
GAUSS_BITS, MIXTURE_BITS = 8, 10
GAUSS_ROUNDS = 12
#: Least gain of a round of the descent; a smaller gain ends it.
ENOUGH = BIT // 8
#: Least probability and least standard deviation, in units of Q, of R(a).
P_MIN, SIGMA_MIN = 1e-6, 2.0**-10


@_inlined
def frequency_cost(frequency: int) -> Any:
    """`priors.frequency_costs` of one frequency."""
    bits = np.float64(frequency).view(np.int64)
    i, f = (bits >> 40) & 4095, (bits >> 28) & 4095
    log2 = (((bits >> 52) - 1023) * BIT) + LOG2[i] + (((LOG2[i + 1] - LOG2[i]) * f) >> 12)
    return 24 * BIT - log2


@_compiled
def _cdf28(mu8: int, si: int, cdf: np.ndarray) -> None:
    """Writes the inner values of `priors.norm_cdf28_of_each` for one Gaussian into cdf int64 [n - 1]."""
    e, octave = si >> 6, OCTAVE[si & 63]
    nb = max(0, e - 8)
    shift, t = 23 + e - nb, 128 - mu8
    for k in range(len(cdf)):
        a = min(abs(t) >> nb, (1 << 21) - 1)
        z = min((a * octave) >> shift, 8 << 16)
        i, f = z >> 11, z & 2047
        v = NORMAL[i] + (((NORMAL[i + 1] - NORMAL[i]) * f) >> 11)
        cdf[k] = (1 << 27) - v if t < 0 else (1 << 27) + v
        t += 256


@_compiled
def _mixed(first: np.ndarray, second: np.ndarray, weight: int, cdf: np.ndarray) -> None:
    """Writes the mixture of two cdfs into a third. weight: of the second, in 1/256."""
    for k in range(len(cdf)):
        cdf[k] = ((256 - weight) * first[k] + weight * second[k]) >> 8


@_compiled
def _table_cost(cdf: np.ndarray, counts: np.ndarray) -> Any:
    """Cost of counts int64 [n] under the table of cdf int64 [n - 1]."""
    n = len(counts)
    cost, before, spread = 0, 0, TOTAL - n * FLOOR
    for k in range(n - 1):
        cum = ((cdf[k] * spread) >> 28) + FLOOR * (k + 1)
        if counts[k] > 0:
            cost += counts[k] * frequency_cost(cum - before)
        before = cum
    return cost + counts[n - 1] * frequency_cost(TOTAL - before)


@_compiled
def _entry_costs(cdf: np.ndarray) -> np.ndarray:
    """Costs int64 [n] of the entries of the table of cdf int64 [n - 1]."""
    n = len(cdf) + 1
    costs = np.empty(n, np.int64)
    before, spread = 0, TOTAL - n * FLOOR
    for k in range(n):
        cum = TOTAL if k == n - 1 else ((cdf[k] * spread) >> 28) + FLOOR * (k + 1)
        costs[k] = frequency_cost(cum - before)
        before = cum
    return costs


if not NUMBA:  # the loops over a table in numpy

    def _cdf28(mu8: int, si: int, cdf: np.ndarray) -> None:
        cdf[:] = norm_cdf28_of_each(*(np.array([v]) for v in (len(cdf) + 1, mu8, si)))[1:-1]

    def _mixed(first: np.ndarray, second: np.ndarray, weight: int, cdf: np.ndarray) -> None:
        cdf[:] = ((256 - weight) * first + weight * second) >> 8

    def _entry_costs(cdf: np.ndarray) -> np.ndarray:
        n = len(cdf) + 1
        cum = ((cdf * (TOTAL - n * FLOOR)) >> 28) + FLOOR * np.arange(1, n)
        return frequency_costs(np.diff(cum, prepend=0, append=TOTAL))

    def _table_cost(cdf: np.ndarray, counts: np.ndarray) -> Any:
        return _entry_costs(cdf) @ counts


@_compiled
def _coarsen(dense: np.ndarray, bits: int) -> tuple[np.ndarray, int]:
    """Returns (counts summed into at most 2^bits entries, the number of low bits dropped from an entry's index)."""
    n, shift = len(dense), 0
    while ((n - 1) >> shift) >= 1 << bits:
        shift += 1
    if shift == 0:
        return dense, 0
    counts = np.zeros(((n - 1) >> shift) + 1, np.int64)
    for k in range(n):
        counts[k >> shift] += dense[k]
    return counts, shift


@_compiled
def _cost_at(probe: np.ndarray, x: np.ndarray, kept: np.ndarray, scratch: np.ndarray, counts: np.ndarray) -> Any:
    """Cost of counts under the Gaussians of `probe`. kept: int64 [2, n - 1], cdfs of the Gaussians of x, reused where
    `probe` has the same. scratch: int64 [3, n - 1]."""
    first, second, mixed = kept[0], kept[1], scratch[2]
    if probe[0] != x[0] or probe[1] != x[1]:
        first = scratch[0]
        _cdf28(probe[0], probe[1], first)
    if len(probe) == 2:
        return _table_cost(first, counts)
    if probe[2] != x[2] or probe[3] != x[3]:
        second = scratch[1]
        _cdf28(probe[2], probe[3], second)
    _mixed(first, second, probe[4], mixed)
    return _table_cost(mixed, counts)


@_compiled
def _descend(
    counts: np.ndarray, x: np.ndarray, steps: np.ndarray, low: np.ndarray, high: np.ndarray, rounds: int
) -> np.ndarray:
    """Minimises the cost of counts from x int64 [2] (mu8, si) or [5] (mu8, si, mu8, si, weight). Each round probes
    every axis both ways, then the joint parabola step, and halves the steps if that was best or nothing gained."""
    dims, n = len(x), len(counts)
    x, steps = x.copy(), steps.copy()
    kept, scratch = np.empty((2, n - 1), np.int64), np.empty((3, n - 1), np.int64)
    up, down = np.empty(dims, np.int64), np.empty(dims, np.int64)
    probe, best = x.copy(), x.copy()
    for c in range(dims // 2):
        _cdf28(x[2 * c], x[2 * c + 1], kept[c])
    fx = _cost_at(x, x, kept, scratch, counts)
    for _ in range(rounds):
        least, at = np.int64(1) << 62, -1
        for number in range(2 * dims + 1):
            for axis in range(dims):
                move = 0
                if number == 2 * dims:
                    curvature = up[axis] + down[axis] - 2 * fx
                    newton = steps[axis] * (down[axis] - up[axis]) / (2.0 * curvature) if curvature > 0 else 0.0
                    move = np.int64(np.rint(min(max(newton, -2.0 * steps[axis]), 2.0 * steps[axis])))
                elif number % dims == axis:
                    move = steps[axis] if number < dims else -steps[axis]
                probe[axis] = min(max(x[axis] + move, low[axis]), high[axis])
            f = _cost_at(probe, x, kept, scratch, counts)
            if number < dims:
                up[number] = f
            elif number < 2 * dims:
                down[number - dims] = f
            if f < least:
                least, at = f, number
                for axis in range(dims):
                    best[axis] = probe[axis]
        gain = fx - least
        if gain <= 0 and (steps <= 1).all():
            break
        if gain > 0:
            for axis in range(dims):
                x[axis] = best[axis]
            fx = least
            if gain < ENOUGH:
                break
            for c in range(dims // 2):
                _cdf28(x[2 * c], x[2 * c + 1], kept[c])
        if at == 2 * dims or gain <= 0:
            for axis in range(dims):
                steps[axis] = max(steps[axis] // 2, 1)
    return x


@_compiled
def _quantile(weights: np.ndarray, share: float) -> float:
    """np.interp(share, np.cumsum(weights) - weights / 2, np.arange(n))."""
    total, before = 0.0, 0.0
    for i in range(len(weights)):
        total += weights[i]
        middle = total - weights[i] / 2
        if middle > share:
            return max(i - 1, 0) if i == 0 or before == share else 1.0 / (middle - before) * (share - before) + (i - 1)
        before = middle
    return len(weights) - 1.0


@_compiled
def gauss(dense: np.ndarray) -> tuple[int, int, int, np.ndarray]:
    """Fits the cheapest Gaussian: (mu8, si, cost of dense, costs of the entries int64 [n])."""
    counts, shift = _coarsen(dense, GAUSS_BITS)
    n = len(counts)
    weights = counts / counts.sum()
    mean = 0.0
    for i in range(n):
        mean += i * weights[i]
    spread = 0.0
    for i in range(n):
        spread += (i - mean) ** 2 * weights[i]
    sigma = math.sqrt(max(spread - 1 / 12, 0.01))
    median = _quantile(weights, np.float64(0.5))
    robust = max((_quantile(weights, np.float64(0.75)) - _quantile(weights, np.float64(0.25))) / 1.349, 0.1)
    low, high = np.array([-2048 * n, SI_MIN]), np.array([2048 * n, SI_MAX])
    cdf, x, least = np.empty(n - 1, np.int64), np.zeros(2, np.int64), np.int64(1) << 62
    for mu, sd in ((mean, sigma), (median, robust)):
        mu8 = min(max(np.int64(np.rint(256 * mu)), low[0]), high[0])
        si = min(max(np.int64(np.rint(64 * math.log2(sd))), low[1]), high[1])
        _cdf28(mu8, si, cdf)
        cost = _table_cost(cdf, counts)
        if cost < least:
            least = cost
            x[0], x[1] = mu8, si
    steps = np.array([max(1, np.int64(2.0 ** (x[1] / 64) * 64)), 16])
    x = _descend(counts, x, steps, low, high, np.int64(GAUSS_ROUNDS))
    mu8, si = (x[0] << shift) + 128 * ((1 << shift) - 1), min(x[1] + 64 * shift, SI_MAX)
    full = np.empty(len(dense) - 1, np.int64)
    _cdf28(mu8, si, full)
    return mu8, si, _table_cost(full, dense), _entry_costs(full)


@_compiled
def _expectation_maximisation(counts: np.ndarray, rounds: int) -> np.ndarray:
    """Fits mixtures int64 [3, 5] from three starts: narrow and wide, left and right, a spike and the rest."""
    n = len(counts)
    total, mean, mode = counts.sum(), 0.0, 0
    for i in range(n):
        mean += i * counts[i]
        if counts[i] > counts[mode]:
            mode = i
    mean /= total
    spread = 0.0
    for i in range(n):
        spread += (i - mean) ** 2 * counts[i]
    sigma = math.sqrt(max(spread / total, 0.05))
    mu = np.array([[mean, mean], [mean - sigma, mean + sigma], [mean, float(mode)]])
    sd = np.array([[sigma / 2, 2 * sigma], [sigma / 2, sigma / 2], [sigma, 0.3]])
    share = np.array([[0.6, 0.4], [0.5, 0.5], [0.5, 0.5]])
    mass, cdf, table_spread = np.empty((2, n)), np.empty(n - 1, np.int64), TOTAL - n
    size, first, second = np.empty(2), np.empty(2), np.empty(2)
    found = np.empty((3, 5), np.int64)
    for s in range(3):
        for _ in range(rounds):
            for c in range(2):
                si = min(max(np.int64(np.rint(64 * math.log2(sd[s, c]))), SI_MIN), SI_MAX)
                _cdf28(np.int64(np.rint(256 * mu[s, c])), si, cdf)
                before = 0
                for k in range(n):
                    cum = TOTAL if k == n - 1 else ((cdf[k] * table_spread) >> 28) + k + 1
                    mass[c, k] = (cum - before) * share[s, c]
                    before = cum
            size[:], first[:], second[:] = 0.0, 0.0, 0.0
            for k in range(n):
                if counts[k] > 0:
                    scale = counts[k] / (mass[0, k] + mass[1, k])
                    for c in range(2):
                        weight = mass[c, k] * scale
                        mass[c, k] = weight
                        size[c] += weight
                        first[c] += weight * k
            for c in range(2):
                size[c] = max(size[c], 1e-3)
                mu[s, c] = first[c] / size[c]
            for k in range(n):
                if counts[k] > 0:
                    for c in range(2):
                        second[c] += mass[c, k] * (k - mu[s, c]) ** 2
            for c in range(2):
                share[s, c] = size[c] / (size[0] + size[1])
                sd[s, c] = math.sqrt(max(second[c] / size[c] - 1 / 12, 0.02))
        for c in range(2):
            found[s, 2 * c] = np.int64(np.rint(256 * mu[s, c]))
            found[s, 2 * c + 1] = np.int64(np.rint(64 * math.log2(sd[s, c])))
        found[s, 4] = min(max(np.int64(np.rint(256 * share[s, 1])), 1), 255)
    return found


@_compiled
def mixture(dense: np.ndarray, effort: int) -> tuple[int, int, int, int, int, int, np.ndarray]:
    """Fits two Gaussians: (mu8, si, mu8, si, weight of the second, cost, costs of the entries)."""
    counts, shift = _coarsen(dense, MIXTURE_BITS)
    n = len(counts)
    first, second = np.empty(n - 1, np.int64), np.empty(n - 1, np.int64)
    starts = _expectation_maximisation(counts, 4 + 2 * effort)
    best, least = 0, np.int64(1) << 62
    for s in range(3):
        _cdf28(starts[s, 0], starts[s, 1], first)
        _cdf28(starts[s, 2], starts[s, 3], second)
        _mixed(first, second, starts[s, 4], first)
        cost = _table_cost(first, counts)
        if cost < least:
            best, least = s, cost
    x = starts[best].copy()
    steps = np.array([0, 16, 0, 16, 8])
    for c in range(2):
        steps[2 * c] = max(1, np.int64(2.0 ** (x[2 * c + 1] / 64) * 32))
    low = np.array([-2048 * n, SI_MIN, -2048 * n, SI_MIN, 1])
    high = np.array([2048 * n, SI_MAX, 2048 * n, SI_MAX, 255])
    x = _descend(counts, x, steps, low, high, 4 * effort)
    for c in range(2):
        x[2 * c] = (x[2 * c] << shift) + 128 * ((1 << shift) - 1)
        x[2 * c + 1] = min(x[2 * c + 1] + 64 * shift, SI_MAX)
    one, two = np.empty(len(dense) - 1, np.int64), np.empty(len(dense) - 1, np.int64)
    _cdf28(x[0], x[1], one)
    _cdf28(x[2], x[3], two)
    _mixed(one, two, x[4], one)
    return x[0], x[1], x[2], x[3], x[4], _table_cost(one, dense), _entry_costs(one)


@_compiled
def cost_matrix(
    values: np.ndarray, counts: np.ndarray, ends: np.ndarray, windows: np.ndarray, costs: np.ndarray
) -> np.ndarray:
    """Returns the cost of each channel under each prior, without its description: int64 [channels, priors].

    values, counts: int64, concatenated over channels, which end at `ends` [channels].
    windows: int64 [priors, 3] of (kmin, n, index of the first entry in `costs`). costs: int64, of all tables' entries.
    The cost of exceptions, symbols outside a window, is exact but for the gaps between them, which are an estimate.
    """
    matrix = np.empty((len(ends), len(windows)), np.int64)
    for column in range(len(windows)):
        kmin, n, at = windows[column]
        end = kmin + n
        first = 0
        for channel in range(len(ends)):
            cost, number, value_bytes, total = 0, 0, 0, 0
            for i in range(first, ends[channel]):
                value, count = values[i], counts[i]
                total += count
                if kmin <= value < end:
                    cost += count * costs[at + value - kmin]
                else:
                    distance = 2 * (kmin - 1 - value) + 1 if value < kmin else 2 * (value - end)
                    number += count
                    value_bytes += count * (1 + (distance >= 1 << 7) + (distance >= 1 << 14) + (distance >= 1 << 21))
            if number:
                step_bytes = 1 + (total > 90 * number) + (total > 12000 * number)
                cost += 8 * BIT * (1 + (number > 1 << 7) + (number > 1 << 14) + step_bytes * number + value_bytes)
            matrix[channel, column] = cost
            first = ends[channel]
    return matrix


@_compiled
def assign(costs: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """Removes priors one by one while that saves bits. Returns the prior of each channel, int64 [channels].

    costs: int64 [channels, priors]; prices: int64 [priors], of the descriptions.
    """
    channels, priors = costs.shape
    is_open = np.ones(priors, np.bool_)
    first, second = np.empty(channels, np.int64), np.empty(channels, np.int64)
    stale = np.ones(channels, np.bool_)
    saved, left = np.empty(priors, np.int64), priors
    while True:
        for p in range(priors):
            saved[p] = prices[p]
        for c in range(channels):
            if stale[c]:
                best, next_best = -1, -1
                for p in range(priors):
                    if is_open[p]:
                        if best < 0 or costs[c, p] < costs[c, best]:
                            best, next_best = p, best
                        elif next_best < 0 or costs[c, p] < costs[c, next_best]:
                            next_best = p
                first[c], second[c], stale[c] = best, next_best, False
            if left > 1:
                saved[first[c]] -= costs[c, second[c]] - costs[c, first[c]]
        closed, most = -1, np.int64(0)
        for p in range(priors):
            if is_open[p] and saved[p] > most:
                closed, most = p, saved[p]
        if left == 1 or closed < 0:
            break
        is_open[closed] = False
        left -= 1
        for c in range(channels):
            stale[c] = first[c] == closed or second[c] == closed
    return first


@_compiled
def gaussian_bits(values: np.ndarray, counts: np.ndarray) -> Any:
    """Sum of R(a) = -log2(Phi((k + 1/2 - mu) / sigma) - Phi((k - 1/2 - mu) / sigma)) over values k int64 [U] that occur
    counts [U] times, in bits.

    mu and sigma are the symbols' mean and standard deviation (units of Q, sigma >= 2**-10); each probability is at
    least 1e-6. Computed from the upper tail of |k - mu|, so that greater probabilities are exact to one part in 1e9.
    """
    total, mu, spread, bits = counts.sum(), 0.0, 0.0, 0.0
    for i in range(len(values)):
        mu += values[i] * (counts[i] / total)
    for i in range(len(values)):
        spread += (values[i] - mu) ** 2 * (counts[i] / total)
    scale = 1.0 / (max(math.sqrt(spread), SIGMA_MIN) * math.sqrt(2.0))
    for i in range(len(values)):
        distance = abs(values[i] - mu)
        p = 0.5 * (math.erfc((distance - 0.5) * scale) - math.erfc((distance + 0.5) * scale))
        bits -= counts[i] * math.log2(max(p, P_MIN))
    return bits
