"""Integer decorrelation of quantised HexPlane planes: a registry of causal predictors with exact inverses.

A plane is int32 [C, H, W]. A sample at row i, column j of a channel is predicted from its neighbours
W = k[i, j-1], N = k[i-1, j], NW = k[i-1, j-1]; the residual k - prediction is what is coded. In row 0 the neighbours N
and NW are taken equal to W, in column 0 W and NW are taken equal to N, and at (0, 0) all three are 0.
All arithmetic is on integers; >> rounds towards minus infinity.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.quantise import MAX_SYMBOL
from pd4dgs_codec.errors import Malformed

Array = np.ndarray


@dataclass(frozen=True)
class Predictor:
    """One registry entry. `restore` undoes the prediction by running sums; None means that a sequential scan is due."""

    name: str
    predict: Callable[[Array, Array, Array], Array]  #: (W, N, NW) -> prediction
    restore: Callable[[Array], Array] | None = None  #: int64 residuals [C, H, W] -> samples


def _median(w: Array, n: Array, nw: Array) -> Array:
    """The median of W, N and W + N - NW: the LOCO-I predictor (Weinberger, Seroussi, Sapiro 2000)."""
    low, high = np.minimum(w, n), np.maximum(w, n)
    median: Array = np.maximum(low, np.minimum(high, low + high - nw))
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
    3: Predictor("median", _median),
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

    Planes with the same predictor and shape are restored together: a scan costs a fixed price per diagonal.
    Raises Malformed if a sample's magnitude exceeds MAX_SYMBOL.
    """
    groups: dict[tuple[int, int, int], list[int]] = defaultdict(list)
    for index, (predictor, r) in enumerate(planes):
        _, h, w = r.shape
        groups[predictor, h, w].append(index)
    result: list[Array] = [r for _, r in planes]
    for (predictor, _, _), members in groups.items():
        r = np.concatenate([planes[i][1] for i in members]).astype(np.int64)
        entry = PREDICTORS[predictor]
        k = entry.restore(r) if entry.restore else _scan(r, entry)
        if k.size and max(int(k.max()), -int(k.min())) > MAX_SYMBOL:
            raise Malformed(f"plane sample over {MAX_SYMBOL} in magnitude after predictor {predictor} ({entry.name})")
        ends = np.cumsum([planes[i][1].shape[0] for i in members])
        for i, part in zip(members, np.split(k.astype(np.int32), ends[:-1]), strict=True):
            result[i] = part
    return result


def _scan(r: Array, predictor: Predictor) -> Array:
    """Undo `predictor` on int64 [C, H, W] along anti-diagonals: all samples with equal i + j are independent.

    Median and average never leave their neighbours' range, so a magnitude is at most (h + w) * max|r|: below 2^37
    always, and nearly always small enough for 32-bit lanes, which halve the time.
    """
    c, h, w = r.shape
    if r.size and max(int(r.max()), -int(r.min())) * (h + w) < 1 << 29:
        r = r.astype(np.int32)
    r[:, 0, :] = np.cumsum(r[:, 0, :], axis=1)
    r[:, 1:, 0] = np.cumsum(r[:, :, 0], axis=1)[:, 1:]
    sheared = np.zeros((c, h, h + w - 1), dtype=r.dtype)
    sc, sh, sw = sheared.strides
    square = np.lib.stride_tricks.as_strided(sheared, (c, h, w), (sc, sh + sw, sw))  # (i, j) -> (i, i + j)
    square[...] = r
    x = np.ascontiguousarray(sheared.transpose(2, 1, 0))  # [diagonal, row, channel]
    for d in range(2, h + w - 1):
        a, b = max(1, d - w + 1), min(h - 1, d - 1) + 1
        x[d, a:b] += predictor.predict(x[d - 1, a:b], x[d - 1, a - 1 : b - 1], x[d - 2, a - 1 : b - 1])
    sheared[...] = x.transpose(2, 1, 0)
    restored: Array = square.copy()
    return restored
