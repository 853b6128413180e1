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
