"""Numba kernels of multi-layer perceptrons, linear layers with ReLU between them, for many points; and their gradient.

Points go through all layers in blocks that stay in the cache. Arguments of the kernels, all floats of one dtype: x
[n, inputs]; sizes int64 [layers, 2], the inputs and outputs of each layer, no more inputs than the layer before has
outputs; weights, the layers packed by `_pack`; hidden [n, `_hidden_width`], the activations after each layer but the
last, side by side, each padded with zeros to whole vectors.

Each part of a backward pass owns its sums, which are added in order: bits repeat for a fixed number of parts.
"""

from collections.abc import Sequence

import numpy as np

from pd4dgs_codec.draw.simd import (
    LANES,
    PRODUCT_ROWS,
    PRODUCT_VECTORS,
    WIDE,
    Array,
    Tasks,
    aligned,
    copy,
    kernel,
    load,
    narrow_product,
    parallel,
    product,
    select_gt,
    store,
    wide_load,
    wide_splat,
)
from pd4dgs_codec.threads import kernel_threads

POINTS = 48  #: points per block, a multiple of PRODUCT_ROWS
BLOCKS = 8  #: blocks that share scratch memory

Layer = tuple[Array, Array]  #: weight [outputs, inputs] and bias [outputs]


class Layers:
    """Linear layers with ReLU between them, and after the last if `relu_last`, packed for the kernels."""

    def __init__(self, layers: Sequence[Layer], relu_last: bool = False):
        self.outputs, self._relu_last = len(layers[-1][1]), relu_last
        self._sizes, self._weights = _pack(layers)

    def __call__(self, x: Array, outputs: int | None = None) -> Array:
        """Evaluates x float32 [n, inputs] to float32 [n, outputs]; columns beyond the last layer's outputs are 0."""
        out = np.zeros((len(x), self.outputs if outputs is None else outputs), np.float32)
        self.add(out, x)
        return out

    def add(self, out: Array, x: Array, keep: bool = False) -> Array:
        """Adds the outputs for x [n, inputs] to out [n, at most the last width], C-contiguous; returns the hidden
        activations for `backward` if `keep`, else an empty array."""
        hidden = np.empty((len(x), _hidden_width(self._sizes)) if keep else (0, 0), x.dtype)
        forward(out, hidden, np.ascontiguousarray(x), self._sizes, self._weights, self._relu_last)
        return hidden

    def backward(self, g: Array, x: Array, hidden: Array, g_hidden: Array | None = None) -> tuple[Array, list[Layer]]:
        """Returns the gradients by x and by each layer, from g [n, outputs] and, if the activations are also used
        elsewhere, from g_hidden, shaped as hidden. Not for relu_last."""
        g_x, sums = np.empty_like(x), np.zeros((kernel_threads(), _sums_width(self._sizes)), x.dtype)
        elsewhere = hidden[:0] if g_hidden is None else g_hidden
        backward(g_x, sums, g, elsewhere, hidden, x, self._sizes, self._weights)
        return g_x, _gradients(sums, self._sizes)


def _pack(layers: Sequence[Layer]) -> tuple[Array, Array]:
    """Packs layers for the kernels; returns (sizes, weights).

    weights: flat; per layer the transposed weight [inputs, padded outputs], bias, and weight [outputs, padded inputs].
    """
    parts = []
    for weight, bias in layers:
        outputs, inputs = weight.shape
        table = np.zeros((inputs + 1, whole(outputs, WIDE)), weight.dtype)
        table[:-1, :outputs], table[-1, :outputs] = weight.T, bias
        back = np.zeros((outputs, whole(inputs, WIDE)), weight.dtype)
        back[:, :inputs] = weight
        parts += [table.ravel(), back.ravel()]
    sizes = np.array([weight.shape[::-1] for weight, _ in layers], np.int64)
    weights: Array = np.concatenate(parts)
    return sizes, weights


def _hidden_width(sizes: Array) -> int:
    """Columns of `hidden`."""
    return sum(whole(int(outputs), WIDE) for outputs in sizes[:-1, 1])


def _sums_width(sizes: Array) -> int:
    """Columns of `sums` of `backward`."""
    return sum(
        whole(outputs, PRODUCT_ROWS) * whole(inputs, WIDE) + whole(outputs, WIDE) for inputs, outputs in sizes.tolist()
    )


def _gradients(sums: Array, sizes: Array) -> list[Layer]:
    """Adds the parts of `sums` and splits the result into the gradients by each layer."""
    whole_sums, found, at = sums.sum(0), [], 0
    for inputs, outputs in sizes.tolist():
        rows, columns = whole(outputs, PRODUCT_ROWS), whole(inputs, WIDE)
        weight = whole_sums[at : at + rows * columns].reshape(rows, columns)[:outputs, :inputs]
        at += rows * columns
        found.append((weight, whole_sums[at : at + outputs]))
        at += whole(outputs, WIDE)
    return found


def whole(count: int, step: int) -> int:
    """count rounded up to a multiple of step."""
    return -(-count // step) * step


up = kernel(inline=True)(whole)


@kernel(inline=True)
def multiply(
    y: Array, y_at: int, y_row: int, start: Array, start_at: int, start_row: int, a: Array, a_row: int,
    a_step: int, b: Array, b_at: int, b_row: int, count: int, rows: int, columns: int, relu: bool,
) -> None:  # fmt: skip
    """`product` for any multiple `rows` of PRODUCT_ROWS and `columns` of WIDE."""
    wide = columns - columns % (PRODUCT_VECTORS * WIDE)
    for r in range(0, rows, PRODUCT_ROWS):
        for c in range(0, wide, PRODUCT_VECTORS * WIDE):
            product(
                y, y_at + r * y_row + c, y_row, start, start_at + r * start_row + c, start_row, a, r * a_row, a_row,
                a_step, b, b_at + c, b_row, count, relu,
            )  # fmt: skip
        for c in range(wide, columns, WIDE):
            narrow_product(
                y, y_at + r * y_row + c, y_row, start, start_at + r * start_row + c, start_row, a, r * a_row, a_row,
                a_step, b, b_at + c, b_row, count, relu,
            )  # fmt: skip


@kernel(inline=True)
def _widest(sizes: Array) -> int:
    """The largest number in sizes; numba's own maximum takes seconds to compile."""
    found = 0
    for layer in range(len(sizes)):
        found = max(found, sizes[layer, 0], sizes[layer, 1])
    return found


@kernel(inline=True)
def _take(block: Array, row: int, values: Array, first: int, count: int, column: int, columns: int) -> None:
    """Copies values[first : first + count, column : column + columns] to the first columns of flat `block`, whose rows
    have `row` numbers."""
    for p in range(count):
        copy(block, p * row, values, (first + p) * values.shape[1] + column, columns)


@kernel(inline=True)
def _give(values: Array, first: int, count: int, column: int, columns: int, block: Array, row: int) -> None:
    """The inverse of `_take`."""
    for p in range(count):
        copy(values, (first + p) * values.shape[1] + column, block, p * row, columns)


@parallel(lambda out, *_: -(-len(out) // (POINTS * BLOCKS)))
def forward(tasks: Tasks, out: Array, hidden: Array, x: Array, sizes: Array, weights: Array, relu_last: bool) -> None:
    """Adds the network's outputs to out [n, at most the last outputs padded to whole vectors]; fills hidden unless it
    has no rows. relu_last: ReLU after the last layer as well."""
    row, layers, columns = up(_widest(sizes), WIDE), len(sizes), out.shape[1]
    vectors = columns - columns % LANES
    a, b = aligned(POINTS * row, x.dtype.type), aligned(POINTS * row, x.dtype.type)
    for task in range(tasks[0], tasks[1]):
        for first in range(task * POINTS * BLOCKS, min((task + 1) * POINTS * BLOCKS, len(x)), POINTS):
            count = min(POINTS, len(x) - first)
            _take(a, row, x, first, count, 0, x.shape[1])
            at = column = 0
            for layer in range(layers):
                inputs, outputs = sizes[layer]
                padded, relu = up(outputs, WIDE), relu_last or layer < layers - 1
                bias = at + inputs * padded
                multiply(b, 0, row, weights, bias, 0, a, row, 1, weights, at, padded, inputs, POINTS, padded, relu)
                at = bias + padded + outputs * up(inputs, WIDE)
                if len(hidden) > 0 and layer < layers - 1:
                    _give(hidden, first, count, column, padded, b, row)
                    column += padded
                a, b = b, a
            for p in range(count):
                at = (first + p) * columns
                for i in range(0, vectors, LANES):
                    store(out, at + i, load(out, at + i) + load(a, p * row + i))
                for i in range(vectors, columns):
                    out[first + p, i] += a[p * row + i]


@parallel(lambda g_x, sums, *_: len(sums))
def backward(
    tasks: Tasks,
    g_x: Array,
    sums: Array,
    g: Array,
    g_hidden: Array,
    hidden: Array,
    x: Array,
    sizes: Array,
    weights: Array,
) -> None:
    """The transpose of `forward` without relu_last, from g [n, last outputs] and, if it has rows, g_hidden, the part of
    the gradient by `hidden` that comes from elsewhere.

    Fills g_x [n, inputs] and sums [parts, `_sums_width`], given zeroed: per part and layer the gradient by its weights,
    then by its bias, in whole blocks.
    """
    row, layers, parts = up(_widest(sizes), WIDE), len(sizes), len(sums)
    blocks, real = (len(x) + POINTS - 1) // POINTS, x.dtype.type
    zero = wide_splat(real(0))
    for part in range(tasks[0], tasks[1]):
        own, size = sums[part], POINTS * row + WIDE  # whole blocks read past the last row
        slope, before, taken, none = aligned(size, real), aligned(size, real), aligned(size, real), aligned(row, real)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            first = block * POINTS
            count = min(POINTS, len(x) - first)
            if count < POINTS:
                for i in range(0, size, WIDE):
                    store(slope, i, zero)
                    store(taken, i, zero)
            _take(slope, row, g, first, count, 0, g.shape[1])
            at, total, column = len(weights), len(own), hidden.shape[1]
            for layer in range(layers - 1, -1, -1):
                inputs, outputs = sizes[layer]
                columns, padded = up(inputs, WIDE), up(outputs, WIDE)
                given = inputs if layer == 0 else up(sizes[layer - 1, 1], WIDE)
                column -= 0 if layer == 0 else given
                _take(taken, row, x if layer == 0 else hidden, first, count, 0 if layer == 0 else column, given)
                total -= padded
                for o in range(0, padded, WIDE):
                    value = wide_load(own, total + o)
                    for p in range(count):
                        value = value + wide_load(slope, p * row + o)
                    store(own, total + o, value)
                total -= up(outputs, PRODUCT_ROWS) * columns
                multiply(
                    own, total, columns, own, total, columns, slope, 1, row, taken, 0, row, POINTS, outputs, columns,
                    False,
                )  # fmt: skip
                at -= outputs * columns
                multiply(
                    before, 0, row, none, 0, 0, slope, row, 1, weights, at, columns, outputs, POINTS, columns, False
                )
                at -= (inputs + 1) * padded
                if layer > 0:
                    for p in range(count):
                        for i in range(0, given, WIDE):
                            value = wide_load(before, p * row + i) if i < columns else zero
                            if len(g_hidden) > 0:
                                value = value + wide_load(g_hidden, (first + p) * g_hidden.shape[1] + column + i)
                            store(slope, p * row + i, select_gt(wide_load(taken, p * row + i), zero, value, zero))
            _give(g_x, first, count, 0, g_x.shape[1], before, row)
