"""Regularisers of a HexPlane's planes, unweighted, each a sum over scales and planes.

plane_smooth: mean squared second difference of the spatial planes along each of their two axes. time_smooth: mean
squared second difference of the time planes along time. time_l1: mean |1 - g| of the time planes. (4DGaussians takes
the spatial planes along one axis only.) Two numba passes over the planes, one for values and one for the gradient.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw.plane_layout import SPATIAL, TEMPORAL, PlaneLayout
from pd4dgs_codec.draw.simd import (
    LANES,
    Tasks,
    Vector,
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

TERMS = ("plane_smooth", "time_smooth", "time_l1")

Band = tuple[float, float, float, float, float]  #: five numbers in the middle of a row of a matrix

# The kernels walk lines, the rows of all planes: `PlaneLayout.lines`, int64 [R, 5] of first cell of the plane, height,
# width, row, 1 if spatial. Sums are kept per line: results do not depend on the number of threads.


@kernel(inline=True)
def _squares(grid: np.ndarray, start: int, stop: int, step: int) -> Any:
    """Sum of the squared second differences, over `step`, of the flat range start..stop."""
    two = splat(grid.dtype.type(2))
    value = splat(grid.dtype.type(0))
    for k in range(start, stop, LANES):
        d = fnma(two, load(grid, k), load(grid, k - step) + load(grid, k + step))
        value = fma(d, d, value)
    return np.float64(total(value))


@parallel(lambda sums, *_: len(sums))
def _values(tasks: Tasks, sums: np.ndarray, grid: np.ndarray, lines: np.ndarray) -> None:
    """sums [R, 3] = each line's part of the three terms."""
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
    """Row i, from column i - 2, of D^T D, where D takes the n - 2 second differences of n values."""
    if 2 <= i < n - 2:
        return 1.0, -4.0, 6.0, -4.0, 1.0
    before = 1.0 if i >= 2 else 0.0  # the difference centred at i - 1 exists
    here = 1.0 if 1 <= i < n - 1 else 0.0
    after = 1.0 if i < n - 2 else 0.0
    return before, -2 * (before + here), before + 4 * here + after, -2 * (here + after), after


@kernel(inline=True)
def _curve(grid: np.ndarray, k: int, i: int, n: int, step: int, band: Band, weight: float) -> Vector:
    """weight times the band's row applied around flat offset k, which is value i of n."""
    real = grid.dtype.type
    value = load(grid, k) * splat(real(weight * band[2]))
    value = fma(load(grid, k - min(i, 2) * step), splat(real(weight * band[0])), value)
    value = fma(load(grid, k - min(i, 1) * step), splat(real(weight * band[1])), value)
    value = fma(load(grid, k + min(n - 1 - i, 1) * step), splat(real(weight * band[3])), value)
    return fma(load(grid, k + min(n - 1 - i, 2) * step), splat(real(weight * band[4])), value)


@parallel(lambda grad, grid, lines, *_: len(lines))
def _gradient(tasks: Tasks, grad: np.ndarray, grid: np.ndarray, lines: np.ndarray, factors: np.ndarray) -> None:
    """grad [cells, C] = that of sum(factors * terms)."""
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
    def forward(ctx: Any, grid: Tensor, lines: np.ndarray) -> tuple[Tensor, ...]:
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
    """The three terms of the planes in grid [cells, C], by name."""
    if grid.device.type == "cpu" and grid.shape[1] % LANES == 0:
        values = _Regularisers.apply(grid, layout.lines)  # type: ignore[no-untyped-call]
        return dict(zip(TERMS, values, strict=True))
    return regularisers_reference(grid, layout)


def regularisers_reference(grid: Tensor, layout: PlaneLayout) -> dict[str, Tensor]:
    """The plain torch form of `regularisers`."""

    def bend(plane: Tensor, axis: int) -> Tensor:
        n = plane.shape[axis]
        if n < 3:
            return plane.new_zeros(())
        before, here, after = (plane.narrow(axis, first, n - 2) for first in range(3))
        return (before - 2 * here + after).square().mean()

    terms = {name: grid.new_zeros(()) for name in TERMS}
    for scale in layout.views(grid):
        for name, _, _ in SPATIAL:
            terms["plane_smooth"] = terms["plane_smooth"] + bend(scale[name], 0) + bend(scale[name], 1)
        for name, _, _ in TEMPORAL:
            terms["time_smooth"] = terms["time_smooth"] + bend(scale[name], 0)
            terms["time_l1"] = terms["time_l1"] + (1 - scale[name]).abs().mean()
    return terms
