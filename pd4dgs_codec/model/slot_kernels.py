"""Numba kernels for the Gaussians that are seen: the last layers' outputs, and what Gaussians are made of, for the kept
slots alone. A slot is one of an anchor's ten Gaussians; about one in six is drawn.

Arguments everywhere, floats of one dtype: keep int64 [K], ascending, anchor * 10 + offset of each kept Gaussian;
hidden [n, H], H a multiple of LANES. The backward passes split the Gaussians over threads at anchors, each part owning
its rows of the result; sums over all Gaussians are kept per part and added in order, so that results are bitwise
reproducible for a fixed number of parts.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from pd4dgs_codec.render.simd import LANES, fma, kernel, load, splat, store, total
from pd4dgs_codec.scene import N_OFFSETS

#: Below this a quaternion is divided by it instead of by its norm, as `torch.nn.functional.normalize` does.
MIN_NORM = 1e-12


@kernel(inline=True)
def _part(keep: np.ndarray, part: int, parts: int) -> tuple[int, int]:
    """The range of `keep` that is part's own: no anchor is in two parts."""
    begin, end = len(keep) * part // parts, len(keep) * (part + 1) // parts
    while 0 < begin < len(keep) and keep[begin] // N_OFFSETS == keep[begin - 1] // N_OFFSETS:
        begin += 1
    while 0 < end < len(keep) and keep[end] // N_OFFSETS == keep[end - 1] // N_OFFSETS:
        end += 1
    return begin, end


@kernel(parallel=True)
def linear(out: np.ndarray, keep: np.ndarray, hidden: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> None:
    """out [K, w] = the outputs of a linear layer (weight [10 w, H], bias [10 w]) that belong to the kept slots."""
    width, inputs = out.shape[1], hidden.shape[1]
    zero = splat(hidden.dtype.type(0))
    for k in nb.prange(len(keep)):
        row = keep[k] // N_OFFSETS * inputs
        first = keep[k] % N_OFFSETS * width
        for o in range(width):
            value = zero
            for c in range(0, inputs, LANES):
                value = fma(load(hidden, row + c), load(weight, (first + o) * inputs + c), value)
            out[k, o] = total(value) + bias[first + o]


@kernel(parallel=True)
def linear_backward(
    grad_hidden: np.ndarray,
    grad_weight: np.ndarray,
    grad_bias: np.ndarray,
    keep: np.ndarray,
    g: np.ndarray,
    hidden: np.ndarray,
    weight: np.ndarray,
) -> None:
    """The transpose of `linear`. Results, given zeroed: grad_hidden [n, H], grad_weight [parts, 10 w, H] and grad_bias
    [parts, 10 w], summed into their first part."""
    width, inputs, parts = g.shape[1], hidden.shape[1], len(grad_weight)
    for part in nb.prange(parts):
        begin, end = _part(keep, part, parts)
        own = grad_weight[part]
        for k in range(begin, end):
            row = keep[k] // N_OFFSETS * inputs
            first = keep[k] % N_OFFSETS * width
            for o in range(width):
                grad_bias[part, first + o] += g[k, o]
            for c in range(0, inputs, LANES):
                h, value = load(hidden, row + c), load(grad_hidden, row + c)
                for o in range(width):
                    at = (first + o) * inputs + c
                    slope = splat(g[k, o])
                    value = fma(slope, load(weight, at), value)
                    store(own, at, fma(slope, h, load(own, at)))
                store(grad_hidden, row + c, value)
    for part in range(1, parts):
        grad_weight[0] += grad_weight[part]
        grad_bias[0] += grad_bias[part]


@kernel(parallel=True)
def assemble(
    means: np.ndarray,
    scales: np.ndarray,
    quats: np.ndarray,
    opacities: np.ndarray,
    gates: np.ndarray,
    keep: np.ndarray,
    position: np.ndarray,
    scaling: np.ndarray,
    offset: np.ndarray,
    opacity: np.ndarray,
    mask: np.ndarray,
    shape: np.ndarray,
    relative: np.ndarray,
) -> None:
    """What the kept Gaussians are made of.

    position [n, 3], scaling [n, 6] (extents: of the offsets, then of the Gaussians), offset and opacity of all slots
    [n * 10, 3] and [n * 10], mask [n]; shape [K, 7] (its last four the quaternion), relative [K, 3] sizes within 0..1.
    Results: means, scales [K, 3], quats [K, 4] unit, opacities, gates [K].
    """
    for k in nb.prange(len(keep)):
        slot = keep[k]
        n = slot // N_OFFSETS
        for i in range(3):
            means[k, i] = position[n, i] + offset[slot, i] * scaling[n, i]
            scales[k, i] = scaling[n, 3 + i] * relative[k, i]
        inverse = 1 / _norm(shape, k)
        for i in range(4):
            quats[k, i] = shape[k, 3 + i] * inverse
        opacities[k] = opacity[slot]
        gates[k] = mask[n]


@kernel(inline=True)
def _norm(shape: np.ndarray, k: int) -> Any:
    square = shape[k, 3] * shape[k, 3] + shape[k, 4] * shape[k, 4]
    square += shape[k, 5] * shape[k, 5] + shape[k, 6] * shape[k, 6]
    return max(math.sqrt(square), shape.dtype.type(MIN_NORM))


@kernel(parallel=True)
def assemble_backward(
    g_position: np.ndarray,
    g_scaling: np.ndarray,
    g_offset: np.ndarray,
    g_opacity: np.ndarray,
    g_mask: np.ndarray,
    g_shape: np.ndarray,
    keep: np.ndarray,
    scaling: np.ndarray,
    offset: np.ndarray,
    shape: np.ndarray,
    relative: np.ndarray,
    quats: np.ndarray,
    g_means: np.ndarray,
    g_scales: np.ndarray,
    g_quats: np.ndarray,
    g_opacities: np.ndarray,
    g_gates: np.ndarray,
    parts: int,
) -> None:
    """The transpose of `assemble`. Results, given zeroed but g_shape [K, 7], whose first three are the gradients before
    the sigmoid that gave `relative`."""
    for part in nb.prange(parts):
        begin, end = _part(keep, part, parts)
        for k in range(begin, end):
            slot = keep[k]
            n = slot // N_OFFSETS
            for i in range(3):
                g = g_means[k, i]
                g_position[n, i] += g
                g_offset[slot, i] = g * scaling[n, i]
                g_scaling[n, i] += g * offset[slot, i]
                g, size = g_scales[k, i], relative[k, i]
                g_scaling[n, 3 + i] += g * size
                g_shape[k, i] = g * scaling[n, 3 + i] * size * (1 - size)
            norm = _norm(shape, k)
            along = shape.dtype.type(0)
            if norm > shape.dtype.type(MIN_NORM):
                for i in range(4):
                    along += g_quats[k, i] * quats[k, i]
            for i in range(4):
                g_shape[k, 3 + i] = (g_quats[k, i] - along * quats[k, i]) / norm
            g_opacity[slot] = g_opacities[k]
            g_mask[n] += g_gates[k]
