"""The loops of `enclosure` and `reach` over single numbers, compiled by numba: the same to the bit as in numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

_compiled: Callable[[Callable[..., Any]], Callable[..., Any]] = njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def relu(value: np.ndarray, slope: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Stretch.relu` of float32 [n, width]."""
    zero, half = np.float32(0), np.float32(-0.5)
    new_value, new_slope, new_radius = np.empty_like(value), np.empty_like(value), np.empty_like(value)
    for i in range(value.shape[0]):
        for j in range(value.shape[1]):
            v, s, r = value[i, j], slope[i, j], radius[i, j]
            reach = abs(s) + r
            low, high = v - reach, v + reach
            share, shift = np.float32(1), zero
            if not low >= zero:
                share = zero
                if not high <= zero:
                    share = high / (high - low)
                    shift = half * share * low
            new_value[i, j] = share * v + shift
            new_slope[i, j] = share * s
            new_radius[i, j] = share * r + shift
    return new_value, new_slope, new_radius


@_compiled
def cubic(
    a: np.ndarray,
    e0: np.ndarray,
    e1: np.ndarray,
    f0: np.ndarray,
    f1: np.ndarray,
    h0: np.ndarray,
    h1: np.ndarray,
    middle: float,
    half: float,
    rows: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`enclosure._cubic` of float32 [n, C]."""
    shape = (len(rows), a.shape[1])
    value, slope, radius = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
    quarter, two_quarters, most = np.float32(0.25), np.float32(0.5), np.float32(0.75)
    for k in range(len(rows)):
        i = rows[k]
        for j in range(a.shape[1]):
            dx, dy, dz = e1[i, j] - e0[i, j], f1[i, j] - f0[i, j], h1[i, j] - h0[i, j]
            p, x, y, z = a[i, j], e0[i, j] + dx * middle, f0[i, j] + dy * middle, h0[i, j] + dz * middle
            dx, dy, dz = dx * half, dy * half, dz * half
            second, third = p * (dx * dy * z + dx * y * dz + x * dy * dz), p * dx * dy * dz
            value[k, j] = p * x * y * z + two_quarters * second
            slope[k, j] = p * (dx * y * z + x * dy * z + x * y * dz) + most * third
            radius[k, j] = two_quarters * abs(second) + quarter * abs(third)
    return value, slope, radius


@_compiled
def add_rectangles(
    change: np.ndarray, top: np.ndarray, bottom: np.ndarray, left: np.ndarray, right: np.ndarray
) -> None:
    """`reach._add_rectangles`."""
    for i in range(len(top)):
        change[top[i], left[i]] += 1
        change[bottom[i] + 1, right[i] + 1] += 1
        change[top[i], right[i] + 1] -= 1
        change[bottom[i] + 1, left[i]] -= 1


@_compiled
def counted(sums: np.ndarray, top: np.ndarray, bottom: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """`reach._counted`."""
    found = np.empty(len(top), np.bool_)
    for i in range(len(top)):
        t, b, l, r = top[i], bottom[i] + 1, left[i], right[i] + 1
        found[i] = sums[b, r] - sums[t, r] - sums[b, l] + sums[t, l] > 0
    return found


@_compiled
def cells(low: np.ndarray, high: np.ndarray, side: int, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """`reach._cells` of floats of one dtype [n], none NaN."""
    last, real = side - 1, low.dtype.type
    scale, margin = real(last), real(slack)
    first_cell, last_cell = np.empty(len(low), np.int64), np.empty(len(low), np.int64)
    for i in range(len(low)):
        first_cell[i] = min(max(np.int64(np.floor(low[i] * scale - margin)), 0), max(last - 1, 0))
        last_cell[i] = min(max(np.int64(np.floor(high[i] * scale + margin)) + 1, 0), last)
    return first_cell, last_cell


@_compiled
def wide(low: np.ndarray, high: np.ndarray, taken: np.ndarray, finest: np.ndarray, narrow: float) -> np.ndarray:
    """`reach._wide`, with `narrow` for NARROW."""
    found = np.zeros(len(low), np.bool_)
    for i in range(len(low)):
        for g in range(low.shape[1]):
            if taken[i, g]:
                for c in range(3):
                    if not (high[i, g, c] - low[i, g, c]) * finest[c] <= np.float32(narrow):
                        found[i] = True
    return found


@_compiled
def mean_ranges(
    out: np.ndarray,
    offset: np.ndarray,
    rows: np.ndarray,
    residuals: tuple[np.ndarray, np.ndarray, np.ndarray],
    spread: tuple[np.ndarray, np.ndarray, np.ndarray],
    centre: tuple[np.ndarray, np.ndarray, np.ndarray],
    start: np.ndarray,
    extent: np.ndarray,
) -> None:
    """`reach._mean_ranges` into out float32 [3, n, G, 3]: of offset [N, G, 3] at `rows` plus residuals [n, 3 G], each
    times spread [n, 3] plus centre [n, 3], in a box from start [3] of extent [3]."""
    zero, one = np.float32(0), np.float32(1)
    for i in range(len(rows)):
        for g in range(offset.shape[1]):
            for c in range(3):
                own, near, far = offset[rows[i], g, c], spread[1][i, c], spread[2][i, c]
                least, most = own + residuals[1][i, 3 * g + c], own + residuals[2][i, 3 * g + c]
                corners = least * near, least * far, most * near, most * far
                low = high = corners[0]
                for corner in corners[1:]:  # NaN, of 0 times infinity, is kept
                    low = corner if corner < low or corner != corner else low
                    high = corner if corner > high or corner != corner else high
                middle = (own + residuals[0][i, 3 * g + c]) * spread[0][i, c] + centre[0][i, c]
                middle = (middle - start[c]) / extent[c]
                low = (low + centre[1][i, c] - start[c]) / extent[c]
                high = (high + centre[2][i, c] - start[c]) / extent[c]
                # NaN stands for anywhere
                out[0, i, g, c] = min(middle, one) if middle > zero else zero
                out[1, i, g, c] = min(low, one) if low > zero else zero
                out[2, i, g, c] = max(high, zero) if high < one else one
