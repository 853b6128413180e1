"""Numba kernels that evaluate networks for many points: linear layers with ReLU between them, in one pass.

A network lies in one array, float32: per layer the weights [inputs, outputs] and the bias [outputs], outputs padded
with zeros to a multiple of `WIDTH`, which are the inputs of the next layer.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from pd4dgs_codec.render.simd import LANES, fma, kernel, load, select_gt, splat, store

WIDTH = 2 * LANES  #: outputs computed at once, each for four points: the sums stay in registers
POINTS = 32  #: points of a task


@kernel(inline=True)
def _layer(
    x: np.ndarray, y: np.ndarray, weights: np.ndarray, at: int, inputs: int, outputs: int, row: int, relu: bool
) -> None:
    """y = weights x + bias for POINTS rows of `row` numbers each; relu: what is negative becomes 0."""
    zero = splat(np.float32(0))
    for p in range(0, POINTS, 4):
        x0, x1, x2, x3 = p * row, (p + 1) * row, (p + 2) * row, (p + 3) * row
        for o in range(0, outputs, WIDTH):
            bias = at + inputs * outputs + o
            a0 = a1 = a2 = a3 = load(weights, bias)
            b0 = b1 = b2 = b3 = load(weights, bias + LANES)
            for i in range(inputs):
                place = at + i * outputs + o
                u, v = load(weights, place), load(weights, place + LANES)
                s = splat(x[x0 + i])
                a0, b0 = fma(s, u, a0), fma(s, v, b0)
                s = splat(x[x1 + i])
                a1, b1 = fma(s, u, a1), fma(s, v, b1)
                s = splat(x[x2 + i])
                a2, b2 = fma(s, u, a2), fma(s, v, b2)
                s = splat(x[x3 + i])
                a3, b3 = fma(s, u, a3), fma(s, v, b3)
            if relu:  # NaN passes
                a0, b0 = select_gt(zero, a0, zero, a0), select_gt(zero, b0, zero, b0)
                a1, b1 = select_gt(zero, a1, zero, a1), select_gt(zero, b1, zero, b1)
                a2, b2 = select_gt(zero, a2, zero, a2), select_gt(zero, b2, zero, b2)
                a3, b3 = select_gt(zero, a3, zero, a3), select_gt(zero, b3, zero, b3)
            store(y, x0 + o, a0)
            store(y, x0 + o + LANES, b0)
            store(y, x1 + o, a1)
            store(y, x1 + o + LANES, b1)
            store(y, x2 + o, a2)
            store(y, x2 + o + LANES, b2)
            store(y, x3 + o, a3)
            store(y, x3 + o + LANES, b3)


@kernel(parallel=True)
def forward(out: np.ndarray, x: np.ndarray, widths: np.ndarray, weights: np.ndarray, relu_last: bool) -> None:
    """out [n, at most the last width] of x [n, inputs]; widths int64 [layers + 1]: the inputs, then each layer's padded
    outputs. relu_last: after the last layer as well."""
    row, layers = widths[0], len(widths) - 1
    for layer in range(1, layers + 1):
        row = max(row, widths[layer])
    for task in nb.prange((len(x) + POINTS - 1) // POINTS):
        first = task * POINTS
        count = min(POINTS, len(x) - first)
        a, b = np.zeros(POINTS * row, np.float32), np.empty(POINTS * row, np.float32)
        for p in range(count):
            for i in range(x.shape[1]):
                a[p * row + i] = x[first + p, i]
        at = 0
        for layer in range(layers):
            inputs, outputs = widths[layer], widths[layer + 1]
            _layer(a, b, weights, at, inputs, outputs, row, relu_last or layer < layers - 1)
            at += (inputs + 1) * outputs
            a, b = b, a
        for p in range(count):
            for i in range(out.shape[1]):
                out[first + p, i] = a[p * row + i]
