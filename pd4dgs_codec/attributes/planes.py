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
        if k.size and max(int(k.max()), -int(k.min())) > MAX_SYMBOL:
            name = PREDICTORS[predictor].name
            raise Malformed(f"plane sample over {MAX_SYMBOL} in magnitude after predictor {predictor} ({name})")
    return [k.astype(np.int32, copy=False) for k in result]


def _scan(planes: Sequence[Array], predictor: Predictor) -> list[Array]:
    """Undo `predictor` on int32 [C, H, W] along anti-diagonals: all cells with equal i + j are independent.

    The cells of all planes stand in one list by diagonal, so there are at most H + W steps however many planes there
    are, and memory is linear in the cells. Median and average never leave their neighbours' range, so a magnitude is at
    most (h + w) * max|r|: below 2^37 always, and nearly always small enough for 32-bit lanes, which halve the time.
    """
    total = sum(h * w for _, h, w in (r.shape for r in planes))
    diagonal, first = np.empty(total, dtype=np.int16), 0
    near = np.empty((3, total + 1), dtype=np.int32)  # of each cell: the places of W, N and NW
    for r in planes:
        _, h, w = r.shape
        at = np.arange(first, first + h * w, dtype=np.int32).reshape(h, w)
        own = near[:, first : first + h * w].reshape(3, h, w)
        own[0], own[1], own[2] = at - 1, at - w, at - w - 1
        own[1:, 0], own[::2, 1:, 0] = own[0, 0], own[1, 1:, 0]
        own[:, 0, 0] = total  # the first cell has none: a row of zeros stands at the end
        diagonal[first : first + h * w] = np.add.outer(np.arange(h), np.arange(w)).ravel()
        first += h * w
    order = np.argsort(diagonal, kind="stable").astype(np.int32)
    rank = np.empty(total + 1, dtype=np.int32)
    rank[order], rank[total] = np.arange(total, dtype=np.int32), total
    ends = np.cumsum(np.bincount(diagonal)).tolist()
    west, north, corner = (rank[places[order]] for places in near)
    del near, order, diagonal  # what is left takes 34 bytes a cell, and twice a lane per sample
    largest = max(max(int(r.max()), -int(r.min())) * sum(r.shape[1:]) for r in planes)
    x = np.zeros((total + 1, planes[0].shape[0]), dtype=np.int32 if largest < 1 << 29 else np.int64)
    x[rank[:total]] = np.concatenate([r.reshape(len(r), -1) for r in planes], axis=1).T
    for a, b in zip([0, *ends], ends, strict=False):
        x[a:b] += predictor.predict(x[west[a:b]], x[north[a:b]], x[corner[a:b]])
    restored = x[rank[:total]].T
    parts = np.split(restored, np.cumsum([r[0].size for r in planes])[:-1], axis=1)
    return [np.ascontiguousarray(part).reshape(r.shape) for part, r in zip(parts, planes, strict=True)]
