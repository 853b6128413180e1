"""Encoder: the predictor that codes a plane for the fewest bits, and what to put in cells that nothing reads."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from pd4dgs_codec.entropy.bits import BIT, frequency_costs, symbol_counts
from pd4dgs_codec.format.planes import PREDICTORS, residual
from pd4dgs_codec.format.quantise import MAX_SYMBOL, magnitude

#: A channel that spans more is too sparse for frequencies to tell anything.
WIDEST = 1 << 16


def fill_plane(k: np.ndarray, given: np.ndarray) -> np.ndarray:
    """int32 [C, H, W] samples like `k` where `given` bool [H, W], and free to take any value elsewhere, such that they
    cost little: under the predictor that then codes them cheapest the residuals of all free samples are 0."""
    best: tuple[float, np.ndarray] | None = None
    for predictor in PREDICTORS:
        filled = _fill(k, given, predictor)
        if magnitude(filled) > MAX_SYMBOL:
            continue
        r = residual(predictor, filled)
        if magnitude(r) > MAX_SYMBOL:
            continue
        bits = _estimated_bits(r)
        if best is None or bits < best[0]:
            best = (bits, filled)
    assert best is not None  # "none" always fits: free samples are 0
    return best[1]


@cache
def kernels() -> ModuleType | None:
    """The compiled loops, the same integers as those in numpy; None where numba is not installed."""
    try:
        return import_module("pd4dgs_codec.format.plane_kernels")
    except ImportError:
        return None


def _fill(k: np.ndarray, given: np.ndarray, predictor: int) -> np.ndarray:
    """`k` with the predictions of the samples before in the places that are not given."""
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


def choose_predictor(k: np.ndarray) -> tuple[int, np.ndarray]:
    """(id, int32 residuals) of the predictor with the smallest estimated cost among those within MAX_SYMBOL."""
    best: tuple[float, int, np.ndarray] | None = None
    for predictor in PREDICTORS:
        r = residual(predictor, k)
        if magnitude(r) > MAX_SYMBOL:
            continue
        bits = _estimated_bits(r)
        if best is None or bits < best[0]:
            best = (bits, predictor, r)
    assert best is not None  # "none" always fits: its residuals are the samples
    return best[1], best[2]


def _estimated_bits(residuals: np.ndarray) -> float:
    """Of residuals int32 [C, H, W]: per channel its order-0 entropy, plus half a log2(n) per distinct value, the price
    of describing the distribution."""
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
