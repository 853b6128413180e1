"""Evaluates the Gaussians of anchors for a camera: culling, the scaffold's networks, and their numba kernels.

Playback and training on the CPU share these functions; `model.reference` has the plain torch form. An anchor has G
slots of one Gaussian each. About one in six is drawn, so all networks but opacity are evaluated for kept slots only.

Common arguments, floats of one dtype: keep int64 [K], ascending, anchor * G + offset of each kept Gaussian; anchors
[n, 9 + D + 3 G], per row position, feature [D], log scalings [6] and offsets [G, 3], the attributes in their order;
gaussians [K, 14], per row mean, scales, quaternion, opacity and colour; hidden [n, columns], of which a layer reads H,
a multiple of LANES, from `column` on. Backward passes split the Gaussians over threads between
anchors, so that each part owns its rows of the result. Sums over all Gaussians are kept per part and added in order:
results are bitwise reproducible for a fixed number of parts.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pd4dgs_codec.draw.layers import Layer, Layers, multiply, up, whole
from pd4dgs_codec.draw.simd import (
    LANES,
    PRODUCT_ROWS,
    WIDE,
    Array,
    Tasks,
    aligned,
    copy,
    fma,
    folded,
    kernel,
    load,
    parallel,
    spread,
    store,
    wide_load,
    wide_splat,
)
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.scene import SCALING_DIM, VIEW_DIM, Camera, Network, SceneInfo
from pd4dgs_codec.threads import kernel_threads

#: Assumed distance of an anchor's Gaussians from it, in multiples of its largest extent; in trained scenes one anchor
#: in 7,000 has a Gaussian farther away.
OFFSET_REACH = 2.0
#: Standard deviations from its mean at which a Gaussian of opacity 1 has alpha MIN_OPACITY: sqrt(2 ln 255) = 3.3290.
SIGMA_REACH = 3.33
#: Anchors farther outside the image than this share of its longer side plus their Gaussians' reach are not evaluated.
FRUSTUM_MARGIN = 0.15
#: Least distance of the near plane, scene units: the rasteriser divides by depths.
LEAST_NEAR = 1e-6
#: Least divisor of a quaternion or direction, as in `torch.nn.functional.normalize`.
MIN_NORM = 1e-12
#: First columns of the parts of a Gaussian's row.
SCALE, QUAT, OPACITY, COLOR = 3, 6, 10, 11
GAUSSIAN_WIDTH = COLOR + 3
KEPT = 1024  #: Gaussians that share scratch memory


def near_plane(info: SceneInfo) -> float:
    """Returns the distance of the near plane, scene units, at least LEAST_NEAR."""
    return max(float(info.near), LEAST_NEAR)


def check_time(t: float) -> None:
    """Raises RenderError unless a normalised time is finite; the planes clamp it to 0..1."""
    if not math.isfinite(t):
        raise RenderError(f"time is {t}, expected a number from 0 to 1")


def in_view(camera: Camera, viewmat: Any, position: Any, radius: Any, near: float) -> Any:
    """Returns bool [N]: whether Gaussians within radius [N] of position [N, 3], world, may reach the image. viewmat
    [4, 4] is the camera's. All arrays are float32, either numpy arrays or torch tensors."""
    across, down, depth = viewmat[:3, :3] @ position.T + viewmat[:3, 3:]
    fx, fy, cx, cy = (float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    z = depth.clip(min=float(near))
    x, y = fx * across / z + cx, fy * down / z + cy
    width, height = camera.width, camera.height
    margin = max(fx, fy) * radius / z + FRUSTUM_MARGIN * max(width, height)
    inside = (x > -margin) & (x < width + margin) & (y > -margin) & (y < height + margin)
    return inside & (depth + radius > 0)


class Functions(NamedTuple):
    """Activation functions of arrays. Training passes torch's, which differ in the last bit."""

    tanh: Callable[[Array], Array]
    sigmoid: Callable[[Array], Array]
    exp: Callable[[Array], Array]


NUMPY = Functions(np.tanh, lambda x: 1 / (1 + np.exp(-x)), np.exp)


class Look(NamedTuple):
    """The opacities of n anchors seen from an eye, and the activations that the other networks continue from."""

    inputs: Array  #: [n, D + 3], features and directions from the eye
    distance: Array  #: [n] from the eye
    opacity: Array  #: [n, G], before the gate
    hidden: tuple[tuple[Array, int], ...]  #: covariance, colour: hidden activations, their first column


class Made(NamedTuple):
    """The kept Gaussians before the gates multiply them, and the values that `Decoders.backward` needs."""

    gaussians: Array  #: [K, 14]
    gates: Array  #: [K]
    shape: Array  #: [K, 7], logits of the scales relative to the extents, quaternion
    relative: Array  #: [K, 7], sigmoid of shape
    extent: Array  #: [n, 6], of the offsets, then of the Gaussians, scene units


def fusible(networks: Sequence[Sequence[tuple[Any, Any]]]) -> bool:
    """Whether one matrix product can evaluate the first layers of all networks; `Decoders.backward` requires it."""
    return all(len(layers) == 2 and len(layers[0][1]) % LANES == 0 for layers in networks)


class Decoders:
    """The scaffold's opacity, covariance and colour networks, packed for the kernels. A network that does not take the
    view direction has weights of 0 for it here."""

    def __init__(self, given: Sequence[Network | Sequence[Layer]], features: int, functions: Functions = NUMPY):
        """features: D, the width of an anchor's feature."""
        networks = [_viewing(network, features) for network in given]
        self.slots = len(networks[0][-1][1])  #: Gaussians of an anchor
        self._features, self._functions = features, functions
        self._inputs = [network[0][0].shape[1] for network in given]
        self._heads = [SlotHead(network, self.slots) for network in networks[1:]]
        self._fused = fusible(networks)
        if self._fused:
            self._ends = np.cumsum([len(network[0][1]) for network in networks])[:-1]
            first = tuple(np.concatenate(parts) for parts in zip(*(network[0] for network in networks), strict=True))
            self._opacity = Layers([(first[0], first[1]), networks[0][1]])
        else:
            self._opacity = Layers(networks[0])

    def look(self, anchors: Array, eye: Array) -> Look:
        """Evaluates the opacities of anchors seen from `eye` [3], world."""
        x, distance = _seen_from(anchors, eye, self._features)
        opacity = np.zeros((len(anchors), self.slots), anchors.dtype)
        hidden = self._opacity.add(opacity, x, keep=self._fused)
        if self._fused:
            parts = [(hidden, int(column)) for column in self._ends]
        else:
            parts = [(head.hidden(x), 0) for head in self._heads]
        return Look(x, distance, self._functions.tanh(opacity), tuple(parts))

    def make(self, anchors: Array, mask: Array, look: Look, keep: Array) -> Made:
        """Evaluates the Gaussians of the kept slots; mask [n] gates the anchors."""
        shape, color = (head(keep, *hidden) for head, hidden in zip(self._heads, look.hidden, strict=True))
        _, sigmoid, exp = self._functions
        scaling = anchors[:, 3 + self._features : 3 + self._features + SCALING_DIM]
        relative, extent = sigmoid(shape), exp(np.ascontiguousarray(scaling))
        gaussians, gates = np.empty((len(keep), GAUSSIAN_WIDTH), anchors.dtype), np.empty(len(keep), anchors.dtype)
        assemble(gaussians, gates, keep, anchors, extent, look.opacity, mask, shape, relative, sigmoid(color))
        return Made(gaussians, gates, shape, relative, extent)

    def colors(self, anchors: Array, eye: Array, keep: Array) -> Array:
        """Returns the colours [K, 3] of the kept slots seen from `eye` [3], world."""
        x, _ = _seen_from(anchors, eye, self._features)
        color = self._heads[-1]
        return self._functions.sigmoid(color(keep, color.hidden(x)))

    def backward(
        self, anchors: Array, look: Look, keep: Array, made: Made, g: Array, g_gates: Array
    ) -> tuple[Array, Array, list[Layer]]:
        """Returns the gradients by anchors, by mask [n] and by each layer of each network, from the gradients g by the
        Gaussians and g_gates by their gates. The networks must be `fusible`."""
        parts = kernel_threads()
        g_anchors, g_opacity, g_mask = np.zeros_like(anchors), np.zeros_like(look.opacity), np.zeros_like(look.distance)
        g_shape, g_color = np.empty_like(made.shape), np.empty((len(g), 3), g.dtype)
        assemble_backward(
            g_anchors, g_opacity, g_mask, g_shape, g_color, keep, anchors, made.extent, made.shape, made.relative,
            made.gaussians, g, g_gates, parts,
        )  # fmt: skip
        ((hidden, _), _), last = look.hidden, []
        g_hidden = np.zeros_like(hidden)
        for slope, (_, column), head in zip((g_shape, g_color), look.hidden, self._heads, strict=True):
            weight, bias = head.last
            g_weight, g_bias = np.zeros((parts, *weight.shape), g.dtype), np.zeros((parts, len(bias)), g.dtype)
            padded = np.pad(weight, ((0, 0), (0, -weight.shape[1] % WIDE)))
            linear_backward(g_hidden, g_weight, g_bias, keep, slope, hidden, column, padded)
            last.append((g_weight.sum(0), g_bias.sum(0)))
        g_inputs, (first, opacity) = self._opacity.backward(g_opacity, look.inputs, hidden, g_hidden)
        inputs_backward(g_anchors, g_inputs, look.inputs, look.distance)
        cut = zip(*(np.split(part, self._ends) for part in first), self._inputs, strict=True)
        firsts = [(weight[:, :inputs], bias) for weight, bias, inputs in cut]
        return g_anchors, g_mask, [layer for pair in zip(firsts, [opacity, *last], strict=True) for layer in pair]


class SlotHead:
    """A network of w outputs per slot, w at most LANES, that is evaluated for the kept slots only."""

    def __init__(self, network: Sequence[Layer], slots: int):
        self.last, self._before, self._slots = network[-1], network[:-1], slots
        self._table = by_slot(*self.last, slots)

    @cached_property
    def _packed(self) -> Layers:
        """The layers before the last, packed on demand: training makes heads at each step, and fused ones need none."""
        return Layers(self._before, relu_last=True)

    def hidden(self, x: Array) -> Array:
        """Returns the inputs of the last layer for x [n, inputs], padded with zeros to the width of `linear`."""
        width = self._table[0].shape[1]
        if self._before:
            return self._packed(x, width)
        out = np.zeros((len(x), width), x.dtype)
        out[:, : x.shape[1]] = x
        return out

    def __call__(self, keep: Array, hidden: Array, column: int = 0) -> Array:
        """Returns the outputs of the kept slots, [K, w]."""
        out = np.empty((len(keep), len(self.last[1]) // self._slots), hidden.dtype)
        linear(out, keep, hidden, column, *self._table)
        return out


def _viewing(network: Sequence[Layer], features: int) -> list[Layer]:
    """Adds weights of 0 for the view direction to a network that does not take it."""
    (weight, bias), *rest = network
    return [(np.pad(weight, ((0, 0), (0, features + VIEW_DIM - weight.shape[1]))), bias), *rest]


def _seen_from(anchors: Array, eye: Array, features: int) -> tuple[Array, Array]:
    """Returns (out, distance) of `inputs`."""
    x, distance = np.empty((len(anchors), features + VIEW_DIM), anchors.dtype), np.empty(len(anchors), anchors.dtype)
    inputs(x, distance, anchors, eye)
    return x, distance


def finished(gaussians: Array, gates: Array) -> tuple[Array, ...]:
    """Returns means, quats, scales, opacities and colors of gaussians [K, 14]; gates multiply scales and opacities."""
    parts = np.split(gaussians, (SCALE, QUAT, OPACITY, COLOR), axis=1)
    means, scales, quats, opacities, colors = map(np.ascontiguousarray, parts)
    return means, quats, scales * gates[:, None], opacities[:, 0] * gates, colors


# -- kernels -----------------------------------------------------------------------------------------------------------


@kernel(inline=True)
def _part(keep: Array, slots: int, part: int, parts: int) -> tuple[int, int]:
    """Returns the range of `keep` of one part; no anchor is in two parts."""
    begin, end = len(keep) * part // parts, len(keep) * (part + 1) // parts
    while 0 < begin < len(keep) and keep[begin] // slots == keep[begin - 1] // slots:
        begin += 1
    while 0 < end < len(keep) and keep[end] // slots == keep[end - 1] // slots:
        end += 1
    return begin, end


@parallel(lambda out, *_: len(out))
def pick(
    tasks: Tasks,
    out: Array,
    column: int,
    values: Array,
    rows: Array,
    noise: Array,
    step: float,
    rounding: bool,
    spacing: Array,
    centre: Array,
) -> None:
    """Fills the columns of `out` from `column` on with values [N, w] at rows int64 [n]. The quantisation step of anchor
    i is step * spacing[i]. rounding: rounds to centre [w] plus multiples of it; else adds noise [n, w] in steps, or
    nothing if noise has no rows."""
    real, width = values.dtype.type, values.shape[1]
    for i in range(tasks[0], tasks[1]):
        size = real(step) * spacing[rows[i]]
        if rounding:
            for c in range(width):
                value = values[rows[i], c]
                out[i, column + c] = centre[c] + np.rint((value - centre[c]) / size) * size
        elif len(noise) == 0:
            copy(out, i * out.shape[1] + column, values, rows[i] * width, width)
        else:
            for c in range(width):
                out[i, column + c] = values[rows[i], c] + noise[i, c] * size


@parallel(lambda grad, g, column, rows: len(rows))
def pick_backward(tasks: Tasks, grad: Array, g: Array, column: int, rows: Array) -> None:
    """The transpose of `pick`: copies g to the rows `rows`, none twice, of grad [N, w], given zeroed."""
    width = grad.shape[1]
    for i in range(tasks[0], tasks[1]):
        copy(grad, rows[i] * width, g, i * g.shape[1] + column, width)


@parallel(lambda out, *_: len(out))
def inputs(tasks: Tasks, out: Array, distance: Array, anchors: Array, centre: Array) -> None:
    """Fills out [n, D + 3], the features of anchors and their directions from centre [3], and distance [n] from centre,
    at least MIN_NORM."""
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
def inputs_backward(tasks: Tasks, g_anchors: Array, g: Array, out: Array, distance: Array) -> None:
    """The transpose of `inputs`, given its results `out` and `distance`: adds to g_anchors."""
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
def seen(opacity: Array, mask: Array, faintest: float) -> Array:
    """Returns int64 [K]: the slots whose opacity [n, G] times mask [n] is at least `faintest`."""
    keep, count, slots = np.empty(opacity.size, np.int64), 0, opacity.shape[1]
    for n in range(len(mask)):
        for o in range(slots):
            keep[count] = n * slots + o
            count += opacity[n, o] * mask[n] >= opacity.dtype.type(faintest)
    found: Array = keep[:count].copy()
    return found


def by_slot(weight: Array, bias: Array, slots: int) -> tuple[Array, Array]:
    """Packs a layer (weight [G w, any], bias [G w], w at most LANES) for `linear`. Returns weight [G, H, LANES], H a
    multiple of LANES, and bias [G, LANES]."""
    width, inputs = len(bias) // slots, weight.shape[1]
    table = np.zeros((slots, whole(inputs, LANES), LANES), weight.dtype)
    start = np.zeros((slots, LANES), bias.dtype)
    table[:, :inputs, :width] = weight.reshape(slots, width, inputs).swapaxes(1, 2)
    start[:, :width] = bias.reshape(slots, width)
    return table, start


@parallel(lambda out, *_: -(-len(out) // KEPT))
def linear(tasks: Tasks, out: Array, keep: Array, hidden: Array, column: int, weight: Array, bias: Array) -> None:
    """Fills out [K, w] with the outputs for the kept slots of a linear layer, packed by `by_slot`."""
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
    grad_hidden: Array,
    grad_weight: Array,
    grad_bias: Array,
    keep: Array,
    g: Array,
    hidden: Array,
    column: int,
    weight: Array,
) -> None:
    """The transpose of `linear`, with weight [G w, H padded to whole vectors]. Fills grad_hidden, shaped as hidden, and
    per part grad_weight [parts, G w, H] and grad_bias [parts, G w]; all are given zeroed."""
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
    gaussians: Array,
    gates: Array,
    keep: Array,
    anchors: Array,
    extent: Array,
    opacity: Array,
    mask: Array,
    shape: Array,
    relative: Array,
    color: Array,
) -> None:
    """Fills gaussians and gates [K] of the kept slots.

    extent [n, 6]: the exponentials of log scalings, of the offsets, then of the Gaussians; opacity [n, G]; mask [n];
    shape [K, 7], its last four the quaternion; relative [K, 7], its first three the sizes within 0..1; color [K, 3].
    """
    slots = opacity.shape[1]
    offset = anchors.shape[1] - 3 * slots
    for k in range(tasks[0], tasks[1]):
        n, o = keep[k] // slots, keep[k] % slots
        for i in range(3):
            gaussians[k, i] = anchors[n, i] + anchors[n, offset + 3 * o + i] * extent[n, i]
            gaussians[k, SCALE + i] = extent[n, 3 + i] * relative[k, i]
            gaussians[k, COLOR + i] = color[k, i]
        inverse = 1 / _norm(shape, k)
        for i in range(4):
            gaussians[k, QUAT + i] = shape[k, 3 + i] * inverse
        gaussians[k, OPACITY] = opacity[n, o]
        gates[k] = mask[n]


@kernel(inline=True)
def _norm(shape: Array, k: int) -> Any:
    """Returns the norm of the quaternion in row k of shape [K, 7], at least MIN_NORM."""
    square = shape[k, 3] * shape[k, 3] + shape[k, 4] * shape[k, 4]
    square += shape[k, 5] * shape[k, 5] + shape[k, 6] * shape[k, 6]
    return max(math.sqrt(square), shape.dtype.type(MIN_NORM))


@kernel(inline=True)
def _unit_backward(g_shape: Array, shape: Array, g: Array, k: int) -> None:
    """Stores to row k of g_shape the gradient by the quaternion in shape, from g, the gradient by the unit one."""
    norm = _norm(shape, k)
    along = shape.dtype.type(0)
    if norm > shape.dtype.type(MIN_NORM):
        for i in range(4):
            along += g[k, QUAT + i] * shape[k, 3 + i]
        along /= norm * norm
    for i in range(4):
        g_shape[k, 3 + i] = (g[k, QUAT + i] - along * shape[k, 3 + i]) / norm


@parallel(lambda *given: given[-1])
def assemble_backward(
    tasks: Tasks,
    g_anchors: Array,
    g_opacity: Array,
    g_mask: Array,
    g_shape: Array,
    g_color: Array,
    keep: Array,
    anchors: Array,
    extent: Array,
    shape: Array,
    relative: Array,
    gaussians: Array,
    g: Array,
    g_gates: Array,
    parts: int,
) -> None:
    """The transpose of `assemble`: fills g_shape, g_color and, given zeroed, g_anchors, g_opacity and g_mask. Gradients
    of opacities, sizes and colours are by the values before tanh and sigmoid, those of scalings by the logarithms."""
    slots = g_opacity.shape[1]
    offset = anchors.shape[1] - 3 * slots
    scaling = offset - SCALING_DIM
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
            _unit_backward(g_shape, shape, g, k)
            value = gaussians[k, OPACITY]
            g_opacity[n, o] = g[k, OPACITY] * (1 - value * value)
            g_mask[n] += g_gates[k]
