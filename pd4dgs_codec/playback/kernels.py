"""Numba kernels that evaluate networks for many points: linear layers with ReLU between them, in one pass.

A network lies in one array, float32: per layer the weights [inputs, outputs] and the bias [outputs], outputs padded
with zeros to a multiple of `WIDE`, which are the inputs of the next layer.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from pd4dgs_codec.render.simd import PRODUCT_ROWS, PRODUCT_VECTORS, WIDE, aligned, kernel, narrow_product, product

POINTS = 48  #: of a task: whole blocks of `product`, and what they are turned into stays in the cache


@kernel(inline=True)
def _layer(
    x: np.ndarray, y: np.ndarray, weights: np.ndarray, at: int, inputs: int, outputs: int, row: int, relu: bool
) -> None:
    """y = weights x + bias for POINTS rows of `row` numbers each; relu: what is negative becomes 0."""
    whole, bias = outputs - outputs % (PRODUCT_VECTORS * WIDE), at + inputs * outputs
    for first in range(0, POINTS * row, PRODUCT_ROWS * row):
        for o in range(0, whole, PRODUCT_VECTORS * WIDE):
            product(y, first + o, row, weights, bias + o, 0, x, first, row, 1, weights, at + o, outputs, inputs, relu)
        for o in range(whole, outputs, WIDE):
            narrow_product(
                y, first + o, row, weights, bias + o, 0, x, first, row, 1, weights, at + o, outputs, inputs, relu
            )


@kernel(parallel=True)
def forward(out: np.ndarray, x: np.ndarray, widths: np.ndarray, weights: np.ndarray, relu_last: bool) -> None:
    """out [n, at most the last width] += what the network makes of x [n, inputs]; widths int64 [layers + 1]: the
    inputs, then each layer's padded outputs. relu_last: after the last layer as well."""
    row, layers = widths.max(), len(widths) - 1
    for task in nb.prange((len(x) + POINTS - 1) // POINTS):
        first = task * POINTS
        count = min(POINTS, len(x) - first)
        a, b = aligned(POINTS * row, np.float32), aligned(POINTS * row, np.float32)
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
                out[first + p, i] += a[p * row + i]
