"""Loss terms of a HexPlane's planes, with gradients, by numba kernels.

Regularisers, unweighted, each a sum over scales and planes. plane_smooth: mean squared second difference of the spatial
planes along each of their two axes. time_smooth: mean squared second difference of the time planes along time. time_l1:
mean |1 - g| of the time planes. (4DGaussians takes the spatial planes along one axis only.)

The rate is a smooth proxy for the bits of the planes' residuals r under one fixed predictor of the codec, before
rounding: the median on spatial planes, the previous instant on time planes. A Laplacian of mean magnitude m in steps Q
takes about log2(2 e m / Q) bits; 1 is added inside, so that only a residual of 0 is free. One half of the proxy takes
the mean over a channel's cells, the other half the mean over a cell's channels:

    sum over values of 1/2 log2(1 + 2 e mean_channel|r| / Q) + 1/2 log2(1 + 2 e mean_cell|r| / Q)

The first half makes channels small; the second empties whole cells, as the codec's classes of activity need. The first
value of a plane has no neighbour and is free. Weighting |r| by its cost follows Candes, Wakin and Boyd, Enhancing
sparsity by reweighted l1 minimization (2008).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw.hexplane import TIME_AXIS, PlaneLayout
from pd4dgs_codec.draw.simd import (
    LANES,
    Array,
    Tasks,
    Vector,
    copy,
    fma,
    fnma,
    kernel,
    load,
    parallel,
    select_gt,
    splat,
    store,
    total,
)
from pd4dgs_codec.scene import PLANES

TERMS = ("plane_smooth", "time_smooth", "time_l1")

Band = tuple[float, float, float, float, float]  #: five numbers in the middle of a row of a matrix

# Kernels run over lines, the rows of all planes (`PlaneLayout.lines`). Sums are kept per line, so that results do not
# depend on the number of threads.


@kernel(inline=True)
def _squares(grid: Array, start: int, stop: int, step: int) -> Any:
    """Returns the sum of squared second differences, `step` apart, over the flat range start..stop."""
    two = splat(grid.dtype.type(2))
    value = splat(grid.dtype.type(0))
    for k in range(start, stop, LANES):
        d = fnma(two, load(grid, k), load(grid, k - step) + load(grid, k + step))
        value = fma(d, d, value)
    return np.float64(total(value))


@parallel(lambda sums, *_: len(sums))
def _values(tasks: Tasks, sums: Array, grid: Array, lines: Array) -> None:
    """Fills sums [R, 3] with each line's part of the three terms."""
    channels = grid.shape[1]
    zero, one = splat(grid.dtype.type(0)), splat(grid.dtype.type(1))
    for r in range(tasks[0], tasks[1]):
        first, height, width, j, spatial = lines[r]
        start, step = (first + j * width) * channels, width * channels
        smooth, distance = 0.0, zero
        if 0 < j < height - 1:
            smooth += _squares(grid, start, start + step, step) / ((height - 2) * step)
        if spatial and width > 2:
            inner = _squares(grid, start + channels, start + step - channels, channels)
            smooth += inner / (height * (width - 2) * channels)
        if not spatial:
            for k in range(start, start + step, LANES):
                d = one - load(grid, k)
                distance = distance + select_gt(d, zero, d, zero - d)
        sums[r, 0], sums[r, 1] = (smooth, 0.0) if spatial else (0.0, smooth)
        sums[r, 2] = np.float64(total(distance)) / (height * step)


@kernel(inline=True)
def _band(i: int, n: int) -> Band:
    """Returns columns i - 2 .. i + 2 of row i of D^T D, where D takes the n - 2 second differences of n values."""
    if 2 <= i < n - 2:
        return 1.0, -4.0, 6.0, -4.0, 1.0
    before = 1.0 if i >= 2 else 0.0  # the difference centred at i - 1 exists
    here = 1.0 if 1 <= i < n - 1 else 0.0
    after = 1.0 if i < n - 2 else 0.0
    return before, -2 * (before + here), before + 4 * here + after, -2 * (here + after), after


@kernel(inline=True)
def _curve(grid: Array, k: int, i: int, n: int, step: int, band: Band, weight: float) -> Vector:
    """Returns weight times the dot product of `band` and the values around flat offset k, value i of n."""
    real = grid.dtype.type
    value = load(grid, k) * splat(real(weight * band[2]))
    value = fma(load(grid, k - min(i, 2) * step), splat(real(weight * band[0])), value)
    value = fma(load(grid, k - min(i, 1) * step), splat(real(weight * band[1])), value)
    value = fma(load(grid, k + min(n - 1 - i, 1) * step), splat(real(weight * band[3])), value)
    return fma(load(grid, k + min(n - 1 - i, 2) * step), splat(real(weight * band[4])), value)


@parallel(lambda grad, grid, lines, *_: len(lines))
def _gradient(tasks: Tasks, grad: Array, grid: Array, lines: Array, factors: Array) -> None:
    """Fills grad [cells, C] with the gradient of sum(factors * terms)."""
    channels = grid.shape[1]
    zero, one = splat(grid.dtype.type(0)), splat(grid.dtype.type(1))
    for r in range(tasks[0], tasks[1]):
        first, height, width, j, spatial = lines[r]
        start, step = (first + j * width) * channels, width * channels
        band_j = _band(j, height)
        weight_j = 2 * factors[0 if spatial else 1] / (max(height - 2, 1) * step)
        weight_i = 2 * factors[0] / (height * max(width - 2, 1) * channels)
        if spatial:
            for i in range(width):
                band_i = _band(i, width)
                for k in range(start + i * channels, start + (i + 1) * channels, LANES):
                    value = _curve(grid, k, j, height, step, band_j, weight_j)
                    store(grad, k, value + _curve(grid, k, i, width, channels, band_i, weight_i))
        else:
            weight = splat(grid.dtype.type(factors[2] / (height * step)))
            for k in range(start, start + step, LANES):
                value = load(grid, k)
                sign = select_gt(value, one, weight, select_gt(one, value, zero - weight, zero))
                store(grad, k, sign + _curve(grid, k, j, height, step, band_j, weight_j))


class _Regularisers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, lines: Array) -> tuple[Tensor, ...]:
        sums = np.empty((len(lines), len(TERMS)))
        _values(sums, grid.numpy(), lines)
        ctx.lines = lines
        ctx.save_for_backward(grid)
        return tuple(grid.new_tensor(x) for x in sums.sum(0))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *factors: Tensor) -> tuple[Tensor, None]:
        (grid,) = ctx.saved_tensors
        grad = torch.empty_like(grid)
        _gradient(grad.numpy(), grid.detach().numpy(), ctx.lines, np.array([f.item() for f in factors]))
        return grad, None


def regularisers(grid: Tensor, layout: PlaneLayout) -> dict[str, Tensor]:
    """Returns the three regularisers of the planes grid [cells, C], on the CPU, by name."""
    padded = _padded(grid)
    values = _Regularisers.apply(padded, layout.lines)  # type: ignore[no-untyped-call]
    more = padded.shape[1] / grid.shape[1]  # the terms are means over the channels
    return {name: value * more for name, value in zip(TERMS, values, strict=True)}


def _padded(grid: Tensor) -> Tensor:
    """Adds channels of 1, whose terms are 0, up to whole vectors."""
    missing = -grid.shape[1] % LANES
    return F.pad(grid, (0, missing), value=1.0) if missing else grid


# -- rate --------------------------------------------------------------------------------------------------------------

_LN2 = math.log(2.0)


@kernel(inline=True)
def _neighbour(i: int, j: int, up: int, left: int, temporal: int) -> int:
    """Returns the distance back to the only neighbour of the value at row i, column j (not both 0), 0 if it has 3."""
    if i == 0:
        return left
    return up if temporal or j == 0 else 0


@kernel(inline=True)
def _median(w: Vector, n: Vector, plane: Vector) -> Vector:
    low, high = select_gt(w, n, n, w), select_gt(w, n, w, n)
    value = select_gt(plane, high, high, plane)
    return select_gt(value, low, value, low)


@kernel(inline=True)
def _residual(grid: Array, k: int, before: int, up: int, left: int) -> Vector:
    """Returns residuals at flat offset k; the neighbour lies `before`, or, if that is 0, three lie `up` and `left`."""
    if before:
        return load(grid, k) - load(grid, k - before)
    w, n = load(grid, k - left), load(grid, k - up)
    return load(grid, k) - _median(w, n, w + n - load(grid, k - up - left))


@parallel(lambda channel_sums, *_: len(channel_sums))
def _magnitudes(tasks: Tasks, channel_sums: Array, cell_sums: Array, grid: Array, starts: Array, sizes: Array) -> None:
    """Adds sums of |r| to channel_sums [P, C] and cell_sums [cells]. starts, sizes: see `_tables`."""
    channels, zero = grid.shape[1], splat(grid.dtype.type(0))
    for p in range(tasks[0], tasks[1]):
        height, width, temporal = sizes[p]
        sums = np.zeros(channels, grid.dtype)
        for i in range(height):
            for j in range(0 if i else 1, width):
                cell = starts[p] + i * width + j
                before = _neighbour(i, j, width * channels, channels, temporal)
                whole = zero
                for c in range(0, channels, LANES):
                    r = _residual(grid, cell * channels + c, before, width * channels, channels)
                    magnitude = select_gt(r, zero, r, zero - r)
                    store(sums, c, load(sums, c) + magnitude)
                    whole = whole + magnitude
                cell_sums[cell] = total(whole)
        copy(channel_sums, p * channels, sums, 0, channels)


@kernel(inline=True)
def _signed(weight: Vector, r: Vector) -> Vector:
    """Returns the weight with the sign of r, 0 where r is 0."""
    zero = r - r
    return select_gt(r, zero, weight, select_gt(zero, r, zero - weight, zero))


@kernel(inline=True)
def _add(grad: Array, k: int, value: Vector) -> None:
    store(grad, k, load(grad, k) + value)


@parallel(lambda grad, grid, by_channel, by_cell, starts, sizes: len(starts))
def _proxy_gradient(
    tasks: Tasks, grad: Array, grid: Array, by_channel: Array, by_cell: Array, starts: Array, sizes: Array
) -> None:
    """Adds the gradient of the sum of |r|, weighted by by_channel [P, C] + by_cell [cells], to grad [cells, C]."""
    channels, zero = grid.shape[1], splat(grid.dtype.type(0))
    for p in range(tasks[0], tasks[1]):
        height, width, temporal = sizes[p]
        up, left = width * channels, channels
        for i in range(height):
            for j in range(0 if i else 1, width):
                cell = starts[p] + i * width + j
                before = _neighbour(i, j, up, left, temporal)
                own = splat(by_cell[cell])
                for c in range(0, channels, LANES):
                    k = cell * channels + c
                    weight = load(by_channel, p * channels + c) + own
                    if before:
                        g = _signed(weight, load(grid, k) - load(grid, k - before))
                        _add(grad, k, g)
                        _add(grad, k - before, zero - g)
                        continue
                    w, n = load(grid, k - left), load(grid, k - up)
                    plane = w + n - load(grid, k - up - left)
                    median = _median(w, n, plane)
                    g = _signed(weight, load(grid, k) - median)
                    # the median's gradient goes to the neighbours that form it
                    west = select_gt(median, w, zero, select_gt(w, median, zero, g))
                    north = g - west
                    low, high = select_gt(w, n, n, w), select_gt(w, n, w, n)
                    corner = select_gt(plane, low, select_gt(high, plane, g, zero), zero)
                    _add(grad, k, g)
                    _add(grad, k - up, zero - north)
                    _add(grad, k - left, zero - west - corner)
                    _add(grad, k - up - left, corner)


class _Proxy(torch.autograd.Function):
    """(grid, layout, step, channels) -> bits; channels: of the planes, without those added by `_padded`."""

    @staticmethod
    def forward(ctx: Any, grid: Tensor, layout: PlaneLayout, step: float, channels: int) -> Tensor:
        starts, sizes = _tables(layout)
        channel_sums = np.zeros((len(starts), grid.shape[1]), grid.numpy().dtype)
        cell_sums = np.zeros(len(grid), grid.numpy().dtype)
        _magnitudes(channel_sums, cell_sums, grid.numpy(), starts, sizes)
        scale, cells = 2 * math.e / step, sizes[:, 0] * sizes[:, 1]
        by_channel = 1 + scale * channel_sums / cells[:, None]
        by_cell = 1 + scale * cell_sums / channels
        bits = 0.5 * float((cells[:, None] * np.log2(by_channel)).sum() + channels * np.log2(by_cell).sum())
        ctx.weights = 0.5 * scale / _LN2 / by_channel, 0.5 * scale / _LN2 / by_cell
        ctx.layout = layout
        ctx.save_for_backward(grid)
        return grid.new_tensor(bits)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, factor: Tensor) -> tuple[Tensor, None, None, None]:
        (grid,) = ctx.saved_tensors
        grad = torch.zeros_like(grid)
        by_channel, by_cell = ((factor.item() * w).astype(grad.numpy().dtype) for w in ctx.weights)
        _proxy_gradient(grad.numpy(), grid.detach().numpy(), by_channel, by_cell, *_tables(ctx.layout))
        return grad, None, None, None


def _tables(layout: PlaneLayout) -> tuple[Array, Array]:
    """Returns first cells int64 [P], and height, width, 1 if temporal int64 [P, 3], of the planes of all scales."""
    sizes = [(r[b], r[a], b == TIME_AXIS) for r in layout.reso for _, a, b in PLANES]
    return layout.start.ravel(), np.array(sizes, np.int64)


def proxy_bits(grid: Tensor, layout: PlaneLayout, step: float) -> Tensor:
    """Returns the proxy, in bits, of planes grid [cells, C], on the CPU, at a quantisation step. Its gradient reaches
    all values."""
    bits: Tensor = _Proxy.apply(_padded(grid), layout, step, grid.shape[1])  # type: ignore[no-untyped-call]
    return bits
