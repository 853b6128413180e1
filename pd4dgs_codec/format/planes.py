"""Prediction of plane samples from their neighbours: predictors, their exact inverses, and the encoder's choice.

A plane is int32 [C, H, W]. A sample at row i, column j of a channel is predicted from its neighbours W = k[i, j-1],
N = k[i-1, j] and NW = k[i-1, j-1], and the residual k - prediction is coded. In row 0 N and NW are taken equal to W, in
column 0 W and NW are taken equal to N, and at (0, 0) all three are 0 (clause 11.3). All arithmetic is on integers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from pd4dgs_codec.entropy.bits import BIT, frequency_costs, symbol_counts
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.quantise import MAX_SYMBOL, magnitude

Array = np.ndarray

#: A channel that spans more values is too sparse for its frequencies to be an estimate.
WIDEST = 1 << 16


@dataclass(frozen=True)
class Predictor:
    """A predictor. `restore` undoes it by running sums; None if that takes a scan of the samples in order."""

    name: str
    predict: Callable[[Array, Array, Array], Array]  #: (W, N, NW) -> prediction
    restore: Callable[[Array], Array] | None = None  #: int64 residuals [C, H, W] -> samples
    of_one: bool = False  #: whether predict(W, 0, 0) is W, as a border needs


def _median(w: Array, n: Array, nw: Array) -> Array:
    """The median of W, N and W + N - NW: the LOCO-I predictor (Weinberger, Seroussi, Sapiro 2000)."""
    low, high = np.minimum(w, n), np.maximum(w, n)
    median: Array = low + high
    median -= nw
    np.minimum(median, high, out=median)
    np.maximum(median, low, out=median)
    return median


def _restore_left(r: Array) -> Array:
    r[:, :, 0] = np.cumsum(r[:, :, 0], axis=1)
    return np.cumsum(r, axis=2)


def _restore_up(r: Array) -> Array:
    r[:, 0, :] = np.cumsum(r[:, 0, :], axis=1)
    return np.cumsum(r, axis=1)


#: The ids are those of the bitstream. On time planes "up" is the previous instant.
PREDICTORS: dict[int, Predictor] = {
    0: Predictor("none", lambda w, n, nw: np.zeros_like(w), lambda r: r),
    1: Predictor("left", lambda w, n, nw: w, _restore_left),
    2: Predictor("up", lambda w, n, nw: n, _restore_up),
    3: Predictor("median", _median, of_one=True),
    4: Predictor("gradient", lambda w, n, nw: w + n - nw, lambda r: np.cumsum(np.cumsum(r, axis=1), axis=2)),
    5: Predictor("average", lambda w, n, nw: (w + n) >> 1),
}


def residual(predictor: int, k: Array) -> Array:
    """int32 [C, H, W] residuals of samples k under PREDICTORS[predictor]; may exceed MAX_SYMBOL in magnitude."""
    w, n, nw = np.zeros_like(k), np.zeros_like(k), np.zeros_like(k)
    w[:, :, 1:], n[:, 1:, :], nw[:, 1:, 1:] = k[:, :, :-1], k[:, :-1, :], k[:, :-1, :-1]
    n[:, 0, :] = nw[:, 0, :] = w[:, 0, :]
    w[:, 1:, 0] = nw[:, 1:, 0] = n[:, 1:, 0]
    r: Array = k - PREDICTORS[predictor].predict(w, n, nw)
    return r


def restore(planes: Sequence[tuple[int, Array]]) -> list[Array]:
    """The inverse of `residual` for many planes at once: [(predictor id, int32 [C, H, W] residuals)] -> int32 samples.

    C is the same throughout. Raises Malformed if a sample's magnitude exceeds MAX_SYMBOL.
    """
    result: list[Array] = [r for _, r in planes]
    scanned: dict[int, list[int]] = defaultdict(list)
    for index, (predictor, r) in enumerate(planes):
        undo = PREDICTORS[predictor].restore
        if undo is None:
            scanned[predictor].append(index)
        else:
            result[index] = undo(r.astype(np.int64))
    for predictor, members in scanned.items():
        restored = _scan([planes[i][1] for i in members], PREDICTORS[predictor])
        for i, k in zip(members, restored, strict=True):
            result[i] = k
    for (predictor, _), k in zip(planes, result, strict=True):
        if magnitude(k) > MAX_SYMBOL:
            name = PREDICTORS[predictor].name
            raise Malformed(f"plane sample over {MAX_SYMBOL} in magnitude after predictor {predictor} ({name})")
    return [k.astype(np.int32, copy=False) for k in result]


def _scan(planes: Sequence[Array], predictor: Predictor) -> list[Array]:
    """Undo `predictor` on int32 [C, H, W] along anti-diagonals: all cells with equal i + j are independent.

    Planes of like size go together, so that none has more than twice the diagonals of another: the steps are no more
    than 4 (H + W) of the largest however many planes there are, and memory stays linear in the cells.
    """
    result = list(planes)
    order = sorted(range(len(planes)), key=lambda i: -sum(planes[i].shape[1:]))
    while order:
        longest = sum(planes[order[0]].shape[1:])
        alike = [i for i in order if 2 * sum(planes[i].shape[1:]) >= longest]
        for i, k in zip(alike, _scan_together([planes[i] for i in alike], predictor), strict=True):
            result[i] = k
        order = order[len(alike) :]
    return result


def _scan_together(planes: Sequence[Array], predictor: Predictor) -> list[Array]:
    """`_scan` of planes by descending number of diagonals.

    Diagonals are the rows of a table, and the rows of all planes its columns: cell (i, j) stands in row i + j, in the
    column of i. So W stands above it, N above and one to the left, NW one further up, for all cells of a row at once,
    with no list of neighbours. Those that a border does not have are 0 here: before a plane's first row stands a column
    of zeros, and what is left of its first column was never written. Where that makes a difference, residuals at the
    borders are made to fit.
    Median and average never leave their neighbours' range, so a magnitude is at most (h + w) * max|r|: below 2^37
    always, and nearly always small enough for narrow lanes, which take a half or a quarter of the time. The table has
    at most 4.5 lanes a sample: 2.25 if a plane has as many rows as columns (the shorter side are the rows here), and
    twice that for planes that end early.
    """
    turned = [r if r.shape[1] <= r.shape[2] else r.swapaxes(1, 2) for r in planes]  # neither predictor tells W from N
    ends = np.cumsum([r.shape[1] + 1 for r in turned])
    zeros = ends - [r.shape[1] + 1 for r in turned]
    diagonals, channels = [sum(r.shape[1:]) - 1 for r in turned], len(turned[0])
    largest = max(magnitude(r) * sum(r.shape[1:]) for r in turned)
    lane = next(t for t in (np.int16, np.int32, np.int64) if 4 * largest <= np.iinfo(t).max)
    table = np.zeros((diagonals[0], int(ends[-1]), channels), lane)
    down, right, deep = table.strides[0] + table.strides[1], table.strides[0], table.strides[2]
    views = [
        np.lib.stride_tricks.as_strided(table[0, zero + 1 :], r.shape, (deep, down, right))
        for zero, r in zip(zeros.tolist(), turned, strict=True)
    ]
    for view, r in zip(views, turned, strict=True):
        view[...] = r.astype(lane)
        for border in () if predictor.of_one else (view[:, 0], view[:, :, 0]):  # running sums
            sums = np.cumsum(border, axis=1, dtype=lane)
            border[:, 1:] = sums[:, 1:] - predictor.predict(sums[:, :-1], *np.zeros((2, 1, 1), lane))
    rows, count = table.reshape(len(table), -1), len(turned)
    for d in range(1, len(table)):
        while diagonals[count - 1] <= d:
            count -= 1
        end, above = int(ends[count - 1]) * channels, rows[d - 1]
        rows[d, channels:end] += predictor.predict(
            above[channels:end], above[: end - channels], rows[d - 2, : end - channels]
        )
        table[d, zeros] = 0
    upright = (k if k.shape == r.shape else k.swapaxes(1, 2) for k, r in zip(views, planes, strict=True))
    return [np.ascontiguousarray(k).astype(np.int32) for k in upright]


# -- the encoder's choice ----------------------------------------------------------------------------------------------


def choose_predictor(k: Array) -> tuple[int, Array]:
    """(id, int32 residuals) of the predictor with the smallest estimated cost among those within MAX_SYMBOL."""
    _, predictor, _, r = min(_candidates((predictor, k) for predictor in PREDICTORS), key=lambda found: found[0])
    return predictor, r


def fill_plane(k: Array, given: Array) -> Array:
    """Samples int32 [C, H, W] equal to `k` where `given` bool [H, W], with values elsewhere that cost little: under the
    predictor that codes the plane cheapest, the residuals of all free samples are 0."""
    filled = ((predictor, _fill(k, given, predictor)) for predictor in PREDICTORS)
    return min(_candidates(filled), key=lambda found: found[0])[2]


def _candidates(planes: Iterable[tuple[int, Array]]) -> Iterator[tuple[float, int, Array, Array]]:
    """(estimated bits, predictor, samples, residuals) of the (predictor, samples) within MAX_SYMBOL. Predictor 0 always
    is: its residuals are the samples."""
    for predictor, k in planes:
        if magnitude(k) <= MAX_SYMBOL:
            r = residual(predictor, k)
            if magnitude(r) <= MAX_SYMBOL:
                yield _estimated_bits(r), predictor, k, r


@cache
def kernels() -> ModuleType | None:
    """The compiled loops, with the same results as those in numpy; None where numba is not installed."""
    try:
        return import_module("pd4dgs_codec.format.plane_kernels")
    except ImportError:
        return None


def _fill(k: np.ndarray, given: np.ndarray, predictor: int) -> np.ndarray:
    """`k` with predictions in place of the samples that are not given."""
    found = kernels()
    x = found.fill(k, given, predictor) if found and predictor in found.KNOWN else _filled(k, given, predictor)
    clipped: np.ndarray = np.clip(x, -1 - MAX_SYMBOL, 1 + MAX_SYMBOL).astype(np.int32)
    return clipped


def _filled(k: np.ndarray, given: np.ndarray, predictor: int) -> np.ndarray:
    """int64 [C, H, W] of `_fill`, by anti-diagonals."""
    _, h, w = k.shape
    x = k.astype(np.int64)
    for d in range(h + w - 1):
        i = np.arange(max(0, d - w + 1), min(h, d + 1))
        i = i[~given[i, d - i]]
        if not i.size:
            continue
        j = d - i
        left, up = x[:, i, np.maximum(j - 1, 0)], x[:, np.maximum(i - 1, 0), j]
        corner = x[:, np.maximum(i - 1, 0), np.maximum(j - 1, 0)]
        west, north = np.where(j > 0, left, up), np.where(i > 0, up, left)
        northwest = np.where((i > 0) & (j > 0), corner, np.where(i > 0, up, left))
        x[:, i, j] = PREDICTORS[predictor].predict(west, north, northwest) if d else 0
    return x


def _estimated_bits(residuals: np.ndarray) -> float:
    """Cost of residuals int32 [C, H, W]: per channel its order-0 entropy, and log2(n) / 2 per distinct value for the
    description of the distribution."""
    if residuals.size == 0:
        return 0.0
    channels = np.ascontiguousarray(residuals.reshape(len(residuals), -1))
    found = kernels()
    costs, distinct = found.order0(channels, WIDEST) if found else _order0(channels, WIDEST)
    described = int(np.maximum(distinct - 1, 0).sum())
    bits = float(costs.sum()) / BIT + 0.5 * described * float(np.log2(channels.shape[1]))
    for channel in channels[distinct == 0]:
        size = np.abs(channel.astype(np.int64) - np.median(channel)).mean() + 1
        bits += float(channel.size * np.log2(size) + 2 * channel.size)
    return bits


def _order0(channels: np.ndarray, widest: int) -> tuple[np.ndarray, np.ndarray]:
    """(order-0 entropy int64 [C] in units of 2^-20 bits, number of distinct values int64 [C]) of channels int32 [C, n];
    both are 0 for a channel over more than `widest`."""
    costs, distinct = np.zeros(len(channels), np.int64), np.zeros(len(channels), np.int64)
    for c, channel in enumerate(channels):
        if int(channel.max()) - int(channel.min()) <= widest:
            counts = symbol_counts(channel)[1]
            whole = channel.size * int(frequency_costs(np.array(channel.size)))
            costs[c], distinct[c] = int(counts @ frequency_costs(counts)) - whole, counts.size
    return costs, distinct
