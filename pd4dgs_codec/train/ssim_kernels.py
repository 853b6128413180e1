"""Numba kernels of the picture's loss: separable Gaussian window, SSIM map and its gradient.

A row [W, 3] is walked as 3 W floats, so that the horizontal pass is a sum of shifts by 3 and both passes are contiguous
vectors. Images are padded with zeros by 5 pixels on each side and by some more on the right, so that no loop has a
border case. Threads split rows; sums are kept per row: results do not depend on the number of threads.

Padded images: [H + 10, stride], pixel (j, i) channel c at [j + 5, 15 + 3 i + c]. weights: [H, W]. taps: [11].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pd4dgs_codec.draw.simd import LANES, Tasks, fma, fnma, kernel, load, parallel, splat, store

C1, C2 = 0.01**2, 0.03**2
TAPS = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
TAPS /= TAPS.sum()
REACH = 5
SIDE = 3 * REACH


def lanes(width: int) -> int:
    """3 * width rounded up to whole vectors."""
    return -(-3 * width // LANES) * LANES


def pad(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] -> padded image."""
    height, width = image.shape[:2]
    out = np.zeros((height + 2 * REACH, lanes(lanes(width) // 3 + 2 * REACH + 1)), image.dtype)
    out[REACH:-REACH, SIDE : SIDE + 3 * width] = image.reshape(height, -1)
    return out


@kernel(inline=True)
def _across(row: np.ndarray, k: int, taps: np.ndarray) -> Any:
    """The horizontal window at lane k of an image row, from a flat padded row (offset included in k)."""
    value = load(row, k) * splat(taps[0])
    for o in range(1, len(taps)):
        value = fma(load(row, k + 3 * o), splat(taps[o]), value)
    return value


@parallel(lambda mean, *_: len(mean))
def target_moments(tasks: Tasks, mean: np.ndarray, variance: np.ndarray, image: np.ndarray, taps: np.ndarray) -> None:
    """mean, variance [H, lanes] of a padded image under the window."""
    stride = image.shape[1]
    zero = splat(image.dtype.type(0))
    rows = np.empty((2, stride), image.dtype)
    for j in range(tasks[0], tasks[1]):
        for k in range(0, stride, LANES):
            first = second = zero
            for o in range(len(taps)):
                a = load(image, (j + o) * stride + k)
                weighted = a * splat(taps[o])
                first = first + weighted
                second = fma(weighted, a, second)
            store(rows, k, first)
            store(rows, stride + k, second)
        for k in range(0, mean.shape[1], LANES):
            m = _across(rows, k, taps)
            store(mean, j * mean.shape[1] + k, m)
            store(variance, j * mean.shape[1] + k, fnma(m, m, _across(rows, stride + k, taps)))


@kernel(inline=True)
def _down(rows: np.ndarray, x: np.ndarray, y: np.ndarray, j: int, taps: np.ndarray) -> None:
    """rows [3, stride] = the vertical window of x, x^2 and x y at image row j."""
    stride = x.shape[1]
    zero = splat(x.dtype.type(0))
    for k in range(0, stride, LANES):
        first = second = cross = zero
        for o in range(len(taps)):
            a = load(x, (j + o) * stride + k)
            weighted = a * splat(taps[o])
            first = first + weighted
            second = fma(weighted, a, second)
            cross = fma(weighted, load(y, (j + o) * stride + k), cross)
        store(rows, k, first)
        store(rows, stride + k, second)
        store(rows, 2 * stride + k, cross)


@parallel(lambda slopes, sums, *_: len(sums))
def loss(
    tasks: Tasks,
    slopes: np.ndarray,
    sums: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    mean_y: np.ndarray,
    var_y: np.ndarray,
    weights: np.ndarray,
    taps: np.ndarray,
) -> None:
    """sums [H, 2] = per row the weighted sums of |x - y| and of 1 - SSIM.

    slopes [3, H + 10, stride], given zeroed = the weighted derivatives of SSIM by the windowed x, x^2 and x y, in the
    layout of a padded image.
    """
    height, width = weights.shape
    stride, n = x.shape[1], mean_y.shape[1]
    real = x.dtype.type
    one, two, c1, c2 = splat(real(1)), splat(real(2)), splat(real(C1)), splat(real(C2))
    rows, part = np.empty((3, stride), x.dtype), np.empty(n, x.dtype)
    weight = np.zeros(n, x.dtype)  # zero beyond the image, so that slopes stay zero there
    for j in range(tasks[0], tasks[1]):
        for i in range(3 * width):
            weight[i] = weights[j, i // 3]
        _down(rows, x, y, j, taps)
        for k in range(0, n, LANES):
            mx, my, w = _across(rows, k, taps), load(mean_y, j * n + k), load(weight, k)
            var_x = fnma(mx, mx, _across(rows, stride + k, taps))
            cov = fnma(mx, my, _across(rows, 2 * stride + k, taps))
            a1, a2 = two * mx * my + c1, two * cov + c2
            b1, b2 = mx * mx + my * my + c1, var_x + load(var_y, j * n + k) + c2
            inverse1, inverse2 = one / b1, one / b2
            w_inverse = w * inverse1 * inverse2
            w_ssim = w_inverse * a1 * a2
            store(part, k, w - w_ssim)
            at = (j + REACH) * stride + SIDE + k
            size = (height + 2 * REACH) * stride
            by_mean = two * (my * (a2 - a1) * w_inverse - mx * w_ssim * (inverse1 - inverse2))
            store(slopes, at, by_mean)
            store(slopes, at + size, splat(real(0)) - w_ssim * inverse2)
            store(slopes, at + 2 * size, two * a1 * w_inverse)
        absolute = dissimilarity = 0.0
        for i in range(3 * width):
            absolute += weight[i] * abs(x[j + REACH, SIDE + i] - y[j + REACH, SIDE + i])
            dissimilarity += part[i]
        sums[j, 0], sums[j, 1] = absolute, dissimilarity


@parallel(lambda grad, *_: len(grad))
def loss_backward(
    tasks: Tasks,
    grad: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    slopes: np.ndarray,
    factors: np.ndarray,
    taps: np.ndarray,
) -> None:
    """grad [H, W, 3] = d(factors[0] * L1 + factors[1] * (1 - SSIM)) / dx; the window is its own transpose."""
    height, width = weights.shape
    stride = x.shape[1]
    size = (height + 2 * REACH) * stride
    real = x.dtype.type
    zero, two, factor = splat(real(0)), splat(real(2)), splat(-factors[1])
    rows, result = np.empty((3, stride), x.dtype), np.empty(stride, x.dtype)
    for j in range(tasks[0], tasks[1]):
        for k in range(0, stride, LANES):
            for q in range(3):
                value = zero
                for o in range(len(taps)):
                    value = fma(load(slopes, q * size + (j + o) * stride + k), splat(taps[o]), value)
                store(rows, q * stride + k, value)
        at = (j + REACH) * stride + SIDE
        for k in range(0, 3 * width, LANES):
            by_second, by_cross = _across(rows, stride + k, taps), _across(rows, 2 * stride + k, taps)
            value = _across(rows, k, taps) + two * load(x, at + k) * by_second + load(y, at + k) * by_cross
            store(result, k, factor * value)
        for i in range(width):
            for c in range(3):
                k = 3 * i + c
                sign = np.sign(x[j + REACH, SIDE + k] - y[j + REACH, SIDE + k])
                grad[j, i, c] = result[k] + factors[0] * weights[j, i] * sign
