"""Numba kernels between anchors and the Gaussians that are seen: rows of attributes, the last layers' outputs and what
Gaussians are made of, for the kept slots alone. A slot is one of an anchor's G Gaussians; about one in six is drawn.

Arguments everywhere, floats of one dtype: keep int64 [K], ascending, anchor * G + offset of each kept Gaussian; anchors
[n, 9 + D + 3 G], a row of position, feature [D], offsets [G, 3] and log scalings [6]; gaussians [K, 14], a row of mean,
scales, quaternion, opacity and colour; hidden [n, columns], of which H from `column` on are a layer's, H a multiple of
LANES. The backward passes split the Gaussians over threads at anchors, each part owning its rows of the result; sums
over all Gaussians are kept per part, for the caller to add in order, so that results are bitwise reproducible for a
fixed number of parts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pd4dgs_codec.draw.layer_kernels import multiply, up, whole
from pd4dgs_codec.draw.simd import (
    LANES,
    PRODUCT_ROWS,
    WIDE,
    Tasks,
    Vector,
    aligned,
    copy,
    fma,
    folded,
    kernel,
    load,
    parallel,
    splat,
    spread,
    store,
    wide_load,
    wide_splat,
)
from pd4dgs_codec.scene import SCALING_DIM

#: Below this a quaternion is divided by it instead of by its norm, as `torch.nn.functional.normalize` does.
MIN_NORM = 1e-12
#: First columns of the parts of a Gaussian's row.
SCALE, QUAT, OPACITY, COLOR = 3, 6, 10, 11
GAUSSIAN_WIDTH = COLOR + 3
KEPT = 1024  #: Gaussians that share scratch memory


@kernel(inline=True)
def _part(keep: np.ndarray, slots: int, part: int, parts: int) -> tuple[int, int]:
    """The range of `keep` that is part's own: no anchor is in two parts."""
    begin, end = len(keep) * part // parts, len(keep) * (part + 1) // parts
    while 0 < begin < len(keep) and keep[begin] // slots == keep[begin - 1] // slots:
        begin += 1
    while 0 < end < len(keep) and keep[end] // slots == keep[end - 1] // slots:
        end += 1
    return begin, end


@kernel(inline=True)
def _noisy(out: np.ndarray, to: int, values: np.ndarray, at: int, noise: np.ndarray, first: int, size: Vector) -> None:
    """LANES of `out` = those of `values` plus size times those of `noise`."""
    store(out, to, load(values, at) + load(noise, first) * size)


@parallel(lambda out, *_: len(out))
def pick(
    tasks: Tasks,
    out: np.ndarray,
    column: int,
    values: np.ndarray,
    rows: np.ndarray,
    noise: np.ndarray,
    step: float,
    rounding: bool,
    spacing: np.ndarray,
    centre: np.ndarray,
) -> None:
    """The columns of `out` from `column` on = values [N, w] at rows int64 [n], rounded to centre [w] and multiples of
    `step` times spacing [N] beside it, or with noise [n, w] times as much; noise [0, w] is none."""
    real, width = values.dtype.type, values.shape[1]
    for i in range(tasks[0], tasks[1]):
        size, to, at = real(step) * spacing[rows[i]], i * out.shape[1] + column, rows[i] * width
        if rounding:
            for c in range(width):
                value = values[rows[i], c]
                out[i, column + c] = centre[c] + np.rint((value - centre[c]) / size) * size
        elif len(noise) == 0:
            copy(out, to, values, at, width)
        elif width < LANES:
            for c in range(width):
                out[i, column + c] = values[rows[i], c] + noise[i, c] * size
        else:
            for c in range(0, width - LANES, LANES):
                _noisy(out, to + c, values, at + c, noise, i * width + c, splat(size))
            c = width - LANES
            _noisy(out, to + c, values, at + c, noise, i * width + c, splat(size))


@parallel(lambda grad, g, column, rows: len(rows))
def pick_backward(tasks: Tasks, grad: np.ndarray, g: np.ndarray, column: int, rows: np.ndarray) -> None:
    """The transpose of `pick`; grad [N, w] is given zeroed, no row comes twice."""
    width = grad.shape[1]
    for i in range(tasks[0], tasks[1]):
        copy(grad, rows[i] * width, g, i * g.shape[1] + column, width)


@parallel(lambda out, *_: len(out))
def inputs(tasks: Tasks, out: np.ndarray, distance: np.ndarray, anchors: np.ndarray, centre: np.ndarray) -> None:
    """out [n, D + 3] = the features and the direction from centre [3] of anchors; distance [n] from it, MIN_NORM at
    least."""
    width = out.shape[1] - 3
    for n in range(tasks[0], tasks[1]):
        x, y, z = anchors[n, 0] - centre[0], anchors[n, 1] - centre[1], anchors[n, 2] - centre[2]
        distance[n] = max(math.sqrt(x * x + y * y + z * z), anchors.dtype.type(MIN_NORM))
        for c in range(width):
            out[n, c] = anchors[n, 3 + c]
        out[n, width] = x / distance[n]
        out[n, width + 1] = y / distance[n]
        out[n, width + 2] = z / distance[n]


@parallel(lambda g_anchors, *_: len(g_anchors))
def inputs_backward(tasks: Tasks, g_anchors: np.ndarray, g: np.ndarray, out: np.ndarray, distance: np.ndarray) -> None:
    """The transpose of `inputs`, which gave `out` and `distance`; adds to g_anchors."""
    width = g.shape[1] - 3
    for n in range(tasks[0], tasks[1]):
        for c in range(width):
            g_anchors[n, 3 + c] += g[n, c]
        along = g.dtype.type(0)
        if distance[n] > g.dtype.type(MIN_NORM):
            for i in range(width, width + 3):
                along += g[n, i] * out[n, i]
        for i in range(3):
            g_anchors[n, i] += (g[n, width + i] - along * out[n, width + i]) / distance[n]


@kernel()
def seen(keep: np.ndarray, opacity: np.ndarray, mask: np.ndarray, faintest: float) -> int:
    """Writes to `keep` the slots whose opacity [n, G] times mask [n] is `faintest` at least; returns how many."""
    count, slots = 0, opacity.shape[1]
    for n in range(len(mask)):
        for o in range(slots):
            keep[count] = n * slots + o
            count += opacity[n, o] * mask[n] >= opacity.dtype.type(faintest)
    return count


def by_slot(weight: np.ndarray, bias: np.ndarray, slots: int) -> tuple[np.ndarray, np.ndarray]:
    """(weight [G, H, LANES], bias [G, LANES]) for `linear` of a layer (weight [G w, any], bias [G w]), w LANES at most;
    H is a multiple of LANES."""
    width, inputs = len(bias) // slots, weight.shape[1]
    table = np.zeros((slots, whole(inputs, LANES), LANES), weight.dtype)
    start = np.zeros((slots, LANES), bias.dtype)
    table[:, :inputs, :width] = weight.reshape(slots, width, inputs).swapaxes(1, 2)
    start[:, :width] = bias.reshape(slots, width)
    return table, start


@parallel(lambda out, *_: -(-len(out) // KEPT))
def linear(
    tasks: Tasks,
    out: np.ndarray,
    keep: np.ndarray,
    hidden: np.ndarray,
    column: int,
    weight: np.ndarray,
    bias: np.ndarray,
) -> None:
    """out [K, w] = the outputs of a linear layer, as `by_slot` has it, that belong to the kept slots."""
    slots, inputs, width = weight.shape[0], weight.shape[1], out.shape[1]
    zero, step = wide_splat(hidden.dtype.type(0)), WIDE // LANES
    outputs = aligned(LANES, hidden.dtype.type)
    for block in range(tasks[0], tasks[1]):
        for k in range(block * KEPT, min((block + 1) * KEPT, len(keep))):
            slot, row = keep[k] % slots, keep[k] // slots * hidden.shape[1] + column
            even = odd = zero
            for c in range(0, inputs, 2 * step):
                at = (slot * inputs + c) * LANES
                even = fma(spread(hidden, row + c), wide_load(weight, at), even)
                odd = fma(spread(hidden, row + c + step), wide_load(weight, at + WIDE), odd)
            store(outputs, 0, folded(even + odd) + load(bias, slot * LANES))
            for o in range(width):
                out[k, o] = outputs[o]


@parallel(lambda grad_hidden, grad_weight, *_: len(grad_weight))
def linear_backward(
    tasks: Tasks,
    grad_hidden: np.ndarray,
    grad_weight: np.ndarray,
    grad_bias: np.ndarray,
    keep: np.ndarray,
    g: np.ndarray,
    hidden: np.ndarray,
    column: int,
    weight: np.ndarray,
) -> None:
    """The transpose of `linear`; weight [G w, H in whole vectors]. Results, given zeroed: grad_hidden (as hidden) and
    of each part grad_weight [parts, G w, H] and grad_bias [parts, G w]."""
    width, inputs, parts, slots = g.shape[1], grad_weight.shape[2], len(grad_weight), len(weight) // g.shape[1]
    columns, rows, most, real = weight.shape[1], up(width, PRODUCT_ROWS), up(KEPT, PRODUCT_ROWS), hidden.dtype.type
    for part in range(tasks[0], tasks[1]):
        begin, end = _part(keep, slots, part, parts)
        members, counts = np.empty((slots, KEPT), np.int64), np.empty(slots, np.int64)
        slopes, taken, before = aligned(most * rows, real), aligned(KEPT * columns, real), aligned(most * columns, real)
        sums, none = aligned(slots * rows * columns, real), aligned(columns, real)
        for first in range(begin, end, KEPT):
            # slot by slot: a product of many rows keeps its sums in registers
            for slot in range(slots):
                counts[slot] = 0
            for k in range(first, min(first + KEPT, end)):
                slot = keep[k] % slots
                members[slot, counts[slot]] = k
                counts[slot] += 1
            for slot in range(slots):
                count, own, at = counts[slot], slot * rows * columns, slot * width * columns
                for p in range(count):
                    k = members[slot, p]
                    copy(taken, p * columns, hidden, keep[k] // slots * hidden.shape[1] + column, inputs)
                    for o in range(width):
                        slopes[p * rows + o] = g[k, o]
                        grad_bias[part, slot * width + o] += g[k, o]
                multiply(
                    sums, own, columns, sums, own, columns, slopes, 1, rows, taken, 0, columns, count, rows, columns,
                    False,
                )  # fmt: skip
                multiply(
                    before, 0, columns, none, 0, 0, slopes, rows, 1, weight, at, columns, width,
                    up(count, PRODUCT_ROWS), columns, False,
                )  # fmt: skip
                for p in range(count):
                    to = keep[members[slot, p]] // slots * hidden.shape[1] + column
                    for c in range(0, inputs, LANES):
                        store(grad_hidden, to + c, load(grad_hidden, to + c) + load(before, p * columns + c))
        for slot in range(slots):
            for o in range(width):
                row = slot * width + o
                copy(grad_weight, (part * slots * width + row) * inputs, sums, (slot * rows + o) * columns, inputs)


@parallel(lambda gaussians, *_: len(gaussians))
def assemble(
    tasks: Tasks,
    gaussians: np.ndarray,
    gates: np.ndarray,
    keep: np.ndarray,
    anchors: np.ndarray,
    extent: np.ndarray,
    opacity: np.ndarray,
    mask: np.ndarray,
    shape: np.ndarray,
    relative: np.ndarray,
    color: np.ndarray,
) -> None:
    """gaussians and gates [K] of the kept slots.

    extent [n, 6]: the exponentials of log scalings, of the offsets, then of the Gaussians; opacity [n, G]; mask [n];
    shape [K, 7], its last four the quaternion; relative [K, 7], its first three the sizes within 0..1; color [K, 3].
    """
    slots = opacity.shape[1]
    offset = anchors.shape[1] - SCALING_DIM - 3 * slots
    for k in range(tasks[0], tasks[1]):
        n, o = keep[k] // slots, keep[k] % slots
        for i in range(3):
            gaussians[k, i] = anchors[n, i] + anchors[n, offset + 3 * o + i] * extent[n, i]
            gaussians[k, SCALE + i] = extent[n, 3 + i] * relative[k, i]
            gaussians[k, COLOR + i] = color[k, i]
        inverse = 1 / _norm(shape, k, 3)
        for i in range(4):
            gaussians[k, QUAT + i] = shape[k, 3 + i] * inverse
        gaussians[k, OPACITY] = opacity[n, o]
        gates[k] = mask[n]


@kernel(inline=True)
def _norm(values: np.ndarray, k: int, first: int) -> Any:
    """That of the four values of row k from column `first` on, and no less than MIN_NORM."""
    square = values[k, first] * values[k, first] + values[k, first + 1] * values[k, first + 1]
    square += values[k, first + 2] * values[k, first + 2] + values[k, first + 3] * values[k, first + 3]
    return max(math.sqrt(square), values.dtype.type(MIN_NORM))


@kernel(inline=True)
def _unit_backward(out: np.ndarray, values: np.ndarray, g: np.ndarray, k: int, to: int, of: int, at: int) -> None:
    """Row k of `out` from column `to` on = the gradient by the four values from `of` on of what `_norm` divides, from
    that of the quotients, in g from `at` on."""
    norm = _norm(values, k, of)
    along = values.dtype.type(0)
    if norm > values.dtype.type(MIN_NORM):
        for i in range(4):
            along += g[k, at + i] * values[k, of + i]
        along /= norm * norm
    for i in range(4):
        out[k, to + i] = (g[k, at + i] - along * values[k, of + i]) / norm


@parallel(lambda *given: given[-1])
def assemble_backward(
    tasks: Tasks,
    g_anchors: np.ndarray,
    g_opacity: np.ndarray,
    g_mask: np.ndarray,
    g_shape: np.ndarray,
    g_color: np.ndarray,
    keep: np.ndarray,
    anchors: np.ndarray,
    extent: np.ndarray,
    shape: np.ndarray,
    relative: np.ndarray,
    gaussians: np.ndarray,
    g: np.ndarray,
    g_gates: np.ndarray,
    parts: int,
) -> None:
    """The transpose of `assemble`. Results, given zeroed but g_shape and g_color. Gradients are those before the tanh
    of opacities and the sigmoids that gave `relative` and the colours; g_anchors by log scalings, and no features."""
    slots, scaling = g_opacity.shape[1], anchors.shape[1] - SCALING_DIM
    offset = scaling - 3 * slots
    for part in range(tasks[0], tasks[1]):
        begin, end = _part(keep, slots, part, parts)
        for k in range(begin, end):
            n, o = keep[k] // slots, keep[k] % slots
            for i in range(3):
                slope = g[k, i]
                g_anchors[n, i] += slope
                g_anchors[n, offset + 3 * o + i] = slope * extent[n, i]
                g_anchors[n, scaling + i] += slope * anchors[n, offset + 3 * o + i] * extent[n, i]
                slope, size = g[k, SCALE + i] * extent[n, 3 + i], relative[k, i]
                g_anchors[n, scaling + 3 + i] += slope * size
                g_shape[k, i] = slope * size * (1 - size)
                value = gaussians[k, COLOR + i]
                g_color[k, i] = g[k, COLOR + i] * value * (1 - value)
            _unit_backward(g_shape, shape, g, k, 3, 3, QUAT)
            value = gaussians[k, OPACITY]
            g_opacity[n, o] = g[k, OPACITY] * (1 - value * value)
            g_mask[n] += g_gates[k]


@kernel(inline=True)
def _clamped(value: float) -> Any:
    """value within 0..1; NaN passes."""
    return value if value != value else min(max(value, 0), 1)


@parallel(lambda means, *_: len(means))
def finish(
    tasks: Tasks,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    gaussians: np.ndarray,
    gates: np.ndarray,
    loose: bool,
) -> None:
    """The parts of gaussians under gates [K]; loose: clamped and normalised first."""
    zero, one = gaussians.dtype.type(0), gaussians.dtype.type(1)
    for k in range(tasks[0], tasks[1]):
        inverse = one / _norm(gaussians, k, QUAT) if loose else one
        for i in range(4):
            quats[k, i] = gaussians[k, QUAT + i] * inverse
        for i in range(3):
            means[k, i] = gaussians[k, i]
            size, color = gaussians[k, SCALE + i], gaussians[k, COLOR + i]
            scales[k, i] = gates[k] * (zero if loose and size < zero else size)
            colors[k, i] = _clamped(color) if loose else color
        opacity = gaussians[k, OPACITY]
        opacities[k] = gates[k] * (_clamped(opacity) if loose else opacity)


@parallel(lambda g, *_: len(g))
def finish_backward(
    tasks: Tasks,
    g: np.ndarray,
    g_gates: np.ndarray,
    gaussians: np.ndarray,
    gates: np.ndarray,
    g_means: np.ndarray,
    g_quats: np.ndarray,
    g_scales: np.ndarray,
    g_opacities: np.ndarray,
    g_colors: np.ndarray,
    loose: bool,
) -> None:
    """The transpose of `finish`: g [K, 14], g_gates [K]."""
    zero, one = gaussians.dtype.type(0), gaussians.dtype.type(1)
    for k in range(tasks[0], tasks[1]):
        opacity = gaussians[k, OPACITY]
        inside = not loose or (opacity >= zero and opacity <= one)
        g[k, OPACITY] = g_opacities[k] * gates[k] if inside else zero
        by_gate = g_opacities[k] * (_clamped(opacity) if loose else opacity)
        for i in range(3):
            g[k, i] = g_means[k, i]
            size, color = gaussians[k, SCALE + i], gaussians[k, COLOR + i]
            inside = not loose or size > zero
            g[k, SCALE + i] = g_scales[k, i] * gates[k] if inside else zero
            by_gate += g_scales[k, i] * size if inside else zero
            inside = not loose or (color >= zero and color <= one)
            g[k, COLOR + i] = g_colors[k, i] if inside else zero
        g_gates[k] = by_gate
        if loose:
            _unit_backward(g, gaussians, g_quats, k, QUAT, QUAT, 0)
        else:
            for i in range(4):
                g[k, QUAT + i] = g_quats[k, i]
