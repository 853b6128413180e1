"""Loops of `planes` over single cells, compiled by numba, with the same results as in numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from pd4dgs_codec.entropy.fit_kernels import frequency_cost

_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = njit(cache=True, nogil=True)

#: The predictors that `fill` knows, by their numbers in the bitstream.
KNOWN = (0, 1, 2, 3, 4, 5)


@_compiled
def fill(k: np.ndarray, given: np.ndarray, predictor: int) -> np.ndarray:
    """`planes._fill` before it is clipped: int64 [C, H, W]."""
    channels, height, width = k.shape
    x = k.astype(np.int64)
    for c in range(channels):
        for i in range(height):
            for j in range(width):
                if given[i, j]:
                    continue
                if i == 0 and j == 0:
                    x[c, i, j] = 0
                    continue
                west = x[c, i, j - 1] if j > 0 else x[c, i - 1, j]
                north = x[c, i - 1, j] if i > 0 else west
                corner = x[c, i - 1, j - 1] if i > 0 and j > 0 else north
                if predictor == 0:
                    x[c, i, j] = 0
                elif predictor == 1:
                    x[c, i, j] = west
                elif predictor == 2:
                    x[c, i, j] = north
                elif predictor == 3:
                    low, high = min(west, north), max(west, north)
                    x[c, i, j] = max(low, min(high, low + high - corner))
                elif predictor == 4:
                    x[c, i, j] = west + north - corner
                else:
                    x[c, i, j] = (west + north) >> 1
    return x


@_compiled
def order0(channels: np.ndarray, widest: int) -> tuple[np.ndarray, np.ndarray]:
    """`planes._order0` of int32 [C, n]."""
    costs, distinct = np.zeros(len(channels), np.int64), np.zeros(len(channels), np.int64)
    counts = np.zeros(widest + 1, np.int64)
    for c in range(len(channels)):
        channel = channels[c]
        low, high = np.int64(channel[0]), np.int64(channel[0])
        for i in range(len(channel)):
            low, high = min(low, np.int64(channel[i])), max(high, np.int64(channel[i]))
        if high - low > widest:
            continue
        counts[: high - low + 1] = 0
        for i in range(len(channel)):
            counts[channel[i] - low] += 1
        for v in range(high - low + 1):
            if counts[v] > 0:
                costs[c] += counts[v] * frequency_cost(counts[v])
                distinct[c] += 1
        costs[c] -= len(channel) * frequency_cost(len(channel))
    return costs, distinct
