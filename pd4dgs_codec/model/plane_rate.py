"""What a HexPlane's planes cost: a smooth proxy for the gradient, and the exact R(a) of their coded residuals.

The proxy takes each plane's residuals r, before rounding, under one fixed predictor of the codec: the median on spatial
planes, the previous instant on time planes. b bits of a Laplacian of mean magnitude m in steps Q are about
log2(2 e m / Q); with 1 added inside, nothing is free of cost but nothing. Half of it looks at the mean over a channel's
cells, half at the mean over a cell's channels:

    sum over values of 1/2 log2(1 + 2 e mean_channel|r| / Q) + 1/2 log2(1 + 2 e mean_cell|r| / Q)

The first half makes channels small, the second empties whole cells, as the codec's classes of activity have it. The
first value of a plane has no neighbour; it is free. Weighting of |r| by what it costs follows Candes, Wakin and Boyd,
Enhancing sparsity by reweighted l1 minimization (2008).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw.plane_layout import TIME_AXIS, PlaneLayout
from pd4dgs_codec.draw.simd import LANES, Tasks, Vector, kernel, load, parallel, select_gt, splat, store, total
from pd4dgs_codec.format.plane_choice import choose_predictor
from pd4dgs_codec.format.quantise import quantise
from pd4dgs_codec.model.rate import channel_moments, rate_bits
from pd4dgs_codec.scene import PLANES, Planes

#: Of the planes in the order of `PLANES`: whether one axis is time.
_TEMPORAL = np.array([b == TIME_AXIS for _, _, b in PLANES])
_SIDES = np.array([(a, b) for _, a, b in PLANES])
_LN2 = math.log(2.0)


@kernel(inline=True)
def _neighbour(i: int, j: int, up: int, left: int, temporal: int) -> int:
    """How far before the value of row i, column j its only neighbour lies, not both in the first; 0: it has three."""
    if i == 0:
        return left
    return up if temporal or j == 0 else 0


@kernel(inline=True)
def _median(w: Vector, n: Vector, plane: Vector) -> Vector:
    low, high = select_gt(w, n, n, w), select_gt(w, n, w, n)
    value = select_gt(plane, high, high, plane)
    return select_gt(value, low, value, low)


@kernel(inline=True)
def _residual(grid: np.ndarray, k: int, before: int, up: int, left: int) -> Vector:
    """Of the values at flat offset k, whose only neighbours lie `before`, or, if that is 0, one `up` and one `left`."""
    if before:
        return load(grid, k) - load(grid, k - before)
    w, n = load(grid, k - left), load(grid, k - up)
    return load(grid, k) - _median(w, n, w + n - load(grid, k - up - left))


@parallel(lambda channel_sums, *_: len(channel_sums))
def _magnitudes(
    tasks: Tasks,
    channel_sums: np.ndarray,
    cell_sums: np.ndarray,
    grid: np.ndarray,
    starts: np.ndarray,
    sizes: np.ndarray,
) -> None:
    """channel_sums [P, C], cell_sums [cells] += sums of |r|. starts [P], sizes [P, 3]: height, width, 1 if temporal."""
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
        channel_sums[p] = sums


@kernel(inline=True)
def _signed(weight: Vector, r: Vector) -> Vector:
    """The weight with the sign of r, 0 where r is."""
    zero = r - r
    return select_gt(r, zero, weight, select_gt(zero, r, zero - weight, zero))


@kernel(inline=True)
def _add(grad: np.ndarray, k: int, value: Vector) -> None:
    store(grad, k, load(grad, k) + value)


@parallel(lambda grad, grid, by_channel, by_cell, starts, sizes: len(starts))
def _gradient(
    tasks: Tasks,
    grad: np.ndarray,
    grid: np.ndarray,
    by_channel: np.ndarray,
    by_cell: np.ndarray,
    starts: np.ndarray,
    sizes: np.ndarray,
) -> None:
    """grad [cells, C] += that of the sum of |r| weighted by by_channel [P, C] + by_cell [cells]."""
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
                    # it goes to those neighbours that the median is made of
                    west = select_gt(median, w, zero, select_gt(w, median, zero, g))
                    north = g - west
                    low, high = select_gt(w, n, n, w), select_gt(w, n, w, n)
                    corner = select_gt(plane, low, select_gt(high, plane, g, zero), zero)
                    _add(grad, k, g)
                    _add(grad, k - up, zero - north)
                    _add(grad, k - left, zero - west - corner)
                    _add(grad, k - up - left, corner)


class _ProxyBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, layout: PlaneLayout, step: float) -> Tensor:
        starts, sizes = _tables(layout)
        channel_sums = np.zeros((len(starts), grid.shape[1]), grid.numpy().dtype)
        cell_sums = np.zeros(len(grid), grid.numpy().dtype)
        _magnitudes(channel_sums, cell_sums, grid.numpy(), starts, sizes)
        scale, cells = 2 * math.e / step, sizes[:, 0] * sizes[:, 1]
        by_channel = 1 + scale * channel_sums / cells[:, None]
        by_cell = 1 + scale * cell_sums / grid.shape[1]
        bits = 0.5 * float((cells[:, None] * np.log2(by_channel)).sum() + grid.shape[1] * np.log2(by_cell).sum())
        ctx.weights = 0.5 * scale / _LN2 / by_channel, 0.5 * scale / _LN2 / by_cell
        ctx.layout = layout
        ctx.save_for_backward(grid)
        return grid.new_tensor(bits)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, factor: Tensor) -> tuple[Tensor, None, None]:
        (grid,) = ctx.saved_tensors
        grad = torch.zeros_like(grid)
        by_channel, by_cell = ((factor.item() * w).astype(grad.numpy().dtype) for w in ctx.weights)
        _gradient(grad.numpy(), grid.detach().numpy(), by_channel, by_cell, *_tables(ctx.layout))
        return grad, None, None


def _tables(layout: PlaneLayout) -> tuple[np.ndarray, np.ndarray]:
    """(first cells int64 [P], height, width and 1 if temporal int64 [P, 3]) of all planes of all scales."""
    sizes = [(r[b], r[a], t) for r in layout.reso for (a, b), t in zip(_SIDES, _TEMPORAL, strict=True)]
    return layout.start.ravel(), np.array(sizes, np.int64)


def proxy_bits(grid: Tensor, layout: PlaneLayout, step: float) -> Tensor:
    """The proxy, in bits, of planes grid [cells, C] at a quantisation step; its gradient reaches every value."""
    if grid.device.type == "cpu" and grid.shape[1] % LANES == 0:
        bits: Tensor = _ProxyBits.apply(grid, layout, step)  # type: ignore[no-untyped-call]
        return bits
    return proxy_bits_reference(grid, layout, step)


def proxy_bits_reference(grid: Tensor, layout: PlaneLayout, step: float) -> Tensor:
    """The plain torch form of `proxy_bits`."""
    scale, total = 2 * math.e / step, grid.new_zeros(())
    for planes in layout.views(grid):
        for name, _, b in PLANES:
            r = _residuals(planes[name], b == TIME_AXIS).abs()
            cells, channels = r.shape[0] * r.shape[1], r.shape[2]
            by_channel = torch.log2(1 + scale * r.mean((0, 1))).sum() * cells
            by_cell = torch.log2(1 + scale * r.mean(2)).sum() * channels
            total = total + 0.5 * (by_channel + by_cell)
    return total


def _residuals(x: Tensor, temporal: bool) -> Tensor:
    """Of a plane [H, W, C]; 0 for its first value."""
    first_row = torch.cat([torch.zeros_like(x[:1, :1]), x[:1, 1:] - x[:1, :-1]], dim=1)
    if temporal:
        return torch.cat([first_row, x[1:] - x[:-1]])
    w, n, nw = x[1:, :-1], x[:-1, 1:], x[:-1, :-1]
    low, high = torch.minimum(w, n), torch.maximum(w, n)
    inner = x[1:, 1:] - torch.maximum(low, torch.minimum(high, w + n - nw))
    return torch.cat([first_row, torch.cat([x[1:, :1] - x[:-1, :1], inner], dim=1)])


def exact_bits(planes: Planes, step: float) -> float:
    """The sum of R(a) of the residuals that the codec codes of float32 planes, in bits: one Gaussian per channel of a
    plane, as with `--priors gauss`, under the predictor that the codec picks."""
    total = 0.0
    for scale in planes:
        for name, _, _ in PLANES:
            _, residual = choose_predictor(quantise(scale[name], step, name))
            total += gaussian_bits(residual.reshape(len(residual), -1))
    return total


def gaussian_bits(channels: Iterable[np.ndarray]) -> float:
    """The sum of R(a) over integer channels, as the trainer computes it in float64: priors are a channel's moments."""
    total = 0.0
    for channel in channels:
        if channel.size:
            mu, sigma = channel_moments(torch.from_numpy(channel.astype(np.float64)))
            symbols, counts = (torch.from_numpy(x) for x in np.unique(channel, return_counts=True))
            total += float((rate_bits(symbols.double(), mu, sigma, 1.0) * counts).sum())
    return total
