"""Encoder: the predictor that codes a plane for the fewest bits, and what to put in cells that nothing reads."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.attributes.planes import PREDICTORS, Predictor, residual
from pd4dgs_codec.attributes.quantise import MAX_SYMBOL
from pd4dgs_codec.entropy.bits import order0_bits, symbol_counts


def fill_plane(k: np.ndarray, given: np.ndarray) -> np.ndarray:
    """int32 [C, H, W] samples like `k` where `given` bool [H, W], and free to take any value elsewhere, such that they
    cost little: under the predictor that then codes them cheapest the residuals of all free samples are 0."""
    best: tuple[float, np.ndarray] | None = None
    for predictor in PREDICTORS:
        filled = _fill(k, given, PREDICTORS[predictor])
        if max(int(filled.max()), -int(filled.min())) > MAX_SYMBOL:
            continue
        r = residual(predictor, filled)
        if max(int(r.max()), -int(r.min())) > MAX_SYMBOL:
            continue
        bits = sum(_estimated_bits(channel) for channel in r.reshape(r.shape[0], -1))
        if best is None or bits < best[0]:
            best = (bits, filled)
    assert best is not None  # "none" always fits: free samples are 0
    return best[1]


def _fill(k: np.ndarray, given: np.ndarray, predictor: Predictor) -> np.ndarray:
    """`k` with the predictions of the samples before in the places that are not given, by anti-diagonals."""
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
        x[:, i, j] = predictor.predict(west, north, northwest) if d else 0
    return np.clip(x, -1 - MAX_SYMBOL, 1 + MAX_SYMBOL).astype(np.int32)


def choose_predictor(k: np.ndarray) -> tuple[int, np.ndarray]:
    """(id, int32 residuals) of the predictor with the smallest estimated cost among those within MAX_SYMBOL."""
    best: tuple[float, int, np.ndarray] | None = None
    for predictor in PREDICTORS:
        r = residual(predictor, k)
        if r.size and max(int(r.max()), -int(r.min())) > MAX_SYMBOL:
            continue
        bits = sum(_estimated_bits(channel) for channel in r.reshape(r.shape[0], -1))
        if best is None or bits < best[0]:
            best = (bits, predictor, r)
    assert best is not None  # "none" always fits: its residuals are the samples
    return best[1], best[2]


def _estimated_bits(channel: np.ndarray) -> float:
    """Order-0 entropy plus half a log2(n) per distinct value, the price of describing the distribution."""
    if channel.size == 0:
        return 0.0
    if int(channel.max()) - int(channel.min()) > 1 << 16:  # too sparse for frequencies to tell anything
        return float(channel.size * np.log2(np.abs(channel - np.median(channel)).mean() + 1) + 2 * channel.size)
    counts = symbol_counts(channel)[1]
    return order0_bits(counts) + 0.5 * (counts.size - 1) * float(np.log2(channel.size))
