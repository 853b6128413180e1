"""The parts of `Model.gaussians` on the CPU, each one autograd function with its gradient written out.

    pick   rows of the attributes, with noise or rounding      [n, 9 + D + 3 G]
    moved  them, or Gaussians, plus a deformation's residuals   [n, 9 + D + 3 G] or [K, 14]
    grown  the scaffold's networks: Gaussians of anchors        [K, 14]
    finish their activations and gates, as the rasteriser takes them

What belongs to an anchor, and what belongs to a Gaussian, is one row whose columns are the heads of its deformation in
the registry's order. The work is numba kernels: networks in `layer_kernels.py`, the rest in `slot_kernels.py`.
`Model.gaussians_reference` has the plain torch form of the whole; it was measured against in docs/training.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import layer_kernels
from pd4dgs_codec.draw import slot_kernels as kernels
from pd4dgs_codec.draw.simd import LANES, WIDE
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.hexplane import sample, sample_gradient
from pd4dgs_codec.model.mlp import MLP
from pd4dgs_codec.scene import LENGTH_HEADS, SCALING_DIM
from pd4dgs_codec.threads import kernel_threads

SCALING = slice(-SCALING_DIM, None)  #: the last columns of an anchor's row

Layer = tuple[Tensor, Tensor]  #: weight [out, in] and bias [out]


def supports(network: MLP, layers: int) -> bool:
    """Whether the functions here can evaluate the network: so many layers, hidden ones of whole vectors."""
    return len(network.layers) == layers and all(len(layer.bias) % LANES == 0 for layer in network.layers[:-1])


def supports_field(field: DeformationField) -> bool:
    """Whether `moved` can evaluate the field."""
    layers = [layer for _, head in field.named_heads() for layer in head.layers]
    return len(layers) == len(field.heads) and field.planes.grid.shape[1] % LANES == 0


def _rounded(parameters: Sequence[Tensor], step: float | None) -> list[Tensor]:
    """Multiples of `step`, if there is one; gradients pass straight through."""
    return [p if step is None else torch.div(p, step).round_().mul_(step) for p in parameters]


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.numpy() for tensor in tensors]


def _run(out: Tensor, x: Tensor, layers: Sequence[Layer]) -> tuple[Tensor, np.ndarray, Tensor]:
    """Adds what the layers make of x to out; gives the hidden activations, sizes and weights that `_run_back` takes."""
    sizes, weights = layer_kernels.pack([(w.numpy(), b.numpy()) for w, b in layers])
    hidden = x.new_empty(len(x), layer_kernels.hidden_width(sizes))
    layer_kernels.forward(*[*_arrays(out, hidden, x), sizes, weights, False])
    return hidden, sizes, torch.from_numpy(weights)


def _run_back(
    g: Tensor, g_hidden: Tensor | None, hidden: Tensor, x: Tensor, sizes: np.ndarray, weights: Tensor
) -> tuple[Tensor, list[Layer]]:
    """The gradients by x and by each layer, from that by what `_run` added, and by its activations, if they are used
    elsewhere."""
    g_x, sums = torch.empty_like(x), x.new_zeros(kernel_threads(), layer_kernels.sums_width(sizes))
    given = (g, hidden[:0] if g_hidden is None else g_hidden, hidden, x)
    layer_kernels.backward(*[*_arrays(g_x, sums, *given), sizes, weights.numpy()])
    found = layer_kernels.gradients(sums.numpy(), sizes)
    return g_x, [(torch.from_numpy(w), torch.from_numpy(b)) for w, b in found]


# -- attributes --------------------------------------------------------------------------------------------------------


def pick(
    attributes: tuple[Tensor, Tensor, Tensor],
    position: Tensor,
    rows: Tensor,
    steps: tuple[float, float, float],
    noise: tuple[Tensor, Tensor, Tensor] | None,
    rounding: bool,
    spacing: Tensor,
    centres: tuple[Tensor, Tensor, Tensor],
) -> Tensor:
    """[n, 9 + D + 3 G]: the anchors `rows` (int64 [n], none twice) with noise of so many steps, or rounded to steps.

    attributes: feature [N, D], offset [N, G, 3], scaling [N, 6]; steps, noise ([n, width] each) and
    centres [width] of the same; spacing [N]: what an anchor's steps are multiplied with.
    """
    row: Tensor = _Pick.apply(  # type: ignore[no-untyped-call]
        *attributes, position, rows, steps, noise, rounding, spacing, centres
    )
    return row


class _Pick(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        feature: Tensor,
        offset: Tensor,
        scaling: Tensor,
        position: Tensor,
        rows: Tensor,
        steps: tuple[float, float, float],
        noise: tuple[Tensor, Tensor, Tensor] | None,
        rounding: bool,
        spacing: Tensor,
        centres: tuple[Tensor, Tensor, Tensor],
    ) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shapes = [feature.shape, offset.shape, scaling.shape]
        parts = [position, feature, offset.flatten(1), scaling]
        out = feature.new_empty(len(rows), sum(part.shape[1] for part in parts))
        column = 0
        drawn = (None, *(noise or (None,) * 3))
        for part, step, own, centre in zip(parts, (0.0, *steps), drawn, (position[:1], *centres), strict=True):
            given = part[:0] if own is None else own.reshape(len(rows), -1)
            kernels.pick(
                out.numpy(), column, part.numpy(), rows.numpy(), given.numpy(), step, rounding and step > 0,
                spacing.numpy(), centre.flatten().numpy(),
            )  # fmt: skip
            column += part.shape[1]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        (rows,) = ctx.saved_tensors
        g = g.contiguous()
        gradients, column = [g.new_zeros(shape) for shape in ctx.shapes], 3
        for gradient in gradients:
            flat = gradient.flatten(1)
            kernels.pick_backward(flat.numpy(), g.numpy(), column, rows.numpy())
            column += flat.shape[1]
        return *gradients, None, None, None, None, None, None, None


# -- deformation -------------------------------------------------------------------------------------------------------


def moved(
    base: Tensor,
    field: DeformationField,
    widths: dict[str, int],
    t: float,
    plane_step: float | None,
    weight_step: float | None,
    follows: bool,
) -> Tensor:
    """base [n, sum of widths] plus the field's residuals at its points, the first three columns, and time t in 0..1.

    widths: of all heads, in the order of the columns; those that the field lacks stay. follows: whether the gradient by
    the points is wanted.
    """
    ends = dict(zip(widths, accumulate(widths.values()), strict=True))
    rows = [
        (slice(ends[name] - widths[name], ends[name]), field.unit if name in LENGTH_HEADS else 1.0)
        for name, _ in field.named_heads()
    ]
    networks = [field.trunk, *(head for _, head in field.named_heads())]
    parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
    settings = (field.planes, rows, 2 * len(field.trunk.layers), t, plane_step, weight_step, follows)
    out: Tensor = _Moved.apply(base, field.planes.grid, settings, *parameters)  # type: ignore[no-untyped-call]
    return out


class _Moved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, base: Tensor, grid: Tensor, settings: tuple[Any, ...], *parameters: Tensor) -> Tensor:
        planes, rows, trunk, t, plane_step, weight_step, _ = settings
        used = _rounded(parameters, weight_step)
        points = base[:, :3].clone()  # of one row, `contiguous` would be a view
        features, spatial, time_rows = sample(grid, planes.layout, planes.box, points, t, plane_step)
        weight, bias = base.new_zeros(base.shape[1], used[trunk].shape[1]), base.new_zeros(base.shape[1])
        for (columns, unit), w, b in zip(rows, used[trunk::2], used[trunk + 1 :: 2], strict=True):
            torch.mul(w, unit, out=weight[columns])
            torch.mul(b, unit, out=bias[columns])
        layers = [*zip(used[:trunk:2], used[1:trunk:2], strict=True), (weight, bias)]
        out = base.clone()
        hidden, sizes, packed = _run(out, features, layers)
        ctx.settings, ctx.sizes = settings, sizes
        ctx.save_for_backward(points, features, spatial, time_rows, hidden, packed)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        planes, rows, _, t, _, _, follows = ctx.settings
        points, features, spatial, time_rows, hidden, packed = ctx.saved_tensors
        g = g.contiguous()
        g_features, grads = _run_back(g, None, hidden, features, ctx.sizes, packed)
        g_grid, g_points = sample_gradient(g_features, spatial, time_rows, planes.layout, planes.box, points, t)
        if follows:
            g = g.clone()
            g[:, :3] += g_points
        last_weight, last_bias = grads.pop()
        found = [part for layer in grads for part in layer]
        for columns, unit in rows:
            found += [last_weight[columns] * unit, last_bias[columns] * unit]
        return g, g_grid, None, *found


# -- scaffold ----------------------------------------------------------------------------------------------------------


def grown(
    anchors: Tensor, mask: Tensor, centre: Tensor, networks: Sequence[MLP], step: float | None, faintest: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(Gaussians [K, 14], their gates [K], raw opacities [n, G], the slots kept int64 [K]) of anchors under mask [n],
    seen from centre [3]. networks: opacity, covariance, colour; step: of their weights, if rounded. Kept are
    the slots whose gated opacity is `faintest` at least."""
    parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
    found: tuple[Tensor, Tensor, Tensor, Tensor] = _Grown.apply(  # type: ignore[no-untyped-call]
        anchors, mask, centre, step, faintest, *parameters
    )
    return found


class _Grown(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        anchors: Tensor,
        mask: Tensor,
        centre: Tensor,
        step: float | None,
        faintest: float,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        used = _rounded(parameters, step)
        w1, b1 = torch.cat(used[::4]), torch.cat(used[1::4])
        (w_opacity, w_shape, w_color), (b_opacity, b_shape, b_color) = used[2::4], used[3::4]
        n, slots = len(anchors), len(b_opacity)
        inputs, distance = anchors.new_empty(n, w1.shape[1]), torch.empty_like(mask)
        kernels.inputs(*_arrays(inputs, distance, anchors, centre))
        raw = anchors.new_zeros(n, slots)
        hidden, sizes, packed = _run(raw, inputs, [(w1, b1), (w_opacity, b_opacity)])
        raw.tanh_()
        keep = torch.empty(n * slots + 1, dtype=torch.int64)  # a place past the last, which is always written
        keep = keep[: kernels.seen(keep.numpy(), raw.numpy(), mask.numpy(), faintest)].clone()
        shape, color = (anchors.new_empty(len(keep), len(b) // slots) for b in (b_shape, b_color))
        columns = (w_opacity.shape[1], w_opacity.shape[1] + w_shape.shape[1])
        for out, column, w, b in ((shape, columns[0], w_shape, b_shape), (color, columns[1], w_color, b_color)):
            layer = kernels.by_slot(w.numpy(), b.numpy(), slots)
            kernels.linear(*[*_arrays(out, keep, hidden), column, *layer])
        relative, extent = torch.sigmoid(shape), torch.exp(anchors[:, SCALING].contiguous())
        color.sigmoid_()
        gaussians, gates = anchors.new_empty(len(keep), kernels.GAUSSIAN_WIDTH), anchors.new_empty(len(keep))
        kernels.assemble(*_arrays(gaussians, gates, keep, anchors, extent, raw, mask, shape, relative, color))
        ctx.columns, ctx.sizes = columns, sizes
        ctx.widths = [len(b) for b in used[1::4]]
        ctx.save_for_backward(
            anchors, keep, inputs, distance, hidden, raw, shape, relative, extent, gaussians, packed, w_shape, w_color,
        )  # fmt: skip
        ctx.mark_non_differentiable(raw, keep)
        return gaussians, gates, raw, keep

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor, g_gates: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        (
            anchors, keep, inputs, distance, hidden, raw, shape, relative, extent, gaussians, packed, w_shape, w_color,
        ) = ctx.saved_tensors  # fmt: skip
        parts = kernel_threads()
        g_anchors, g_raw = torch.zeros_like(anchors), torch.zeros_like(raw)
        g_mask, g_shape, g_color = anchors.new_zeros(len(anchors)), torch.empty_like(shape), g.new_empty(len(g), 3)
        results = (g_anchors, g_raw, g_mask, g_shape, g_color)
        given = (keep, anchors, extent, shape, relative, gaussians, g.contiguous(), g_gates.contiguous())
        kernels.assemble_backward(*[*_arrays(*results, *given), parts])

        g_hidden = torch.zeros_like(hidden)
        last = []
        for slope, column, w in ((g_shape, ctx.columns[0], w_shape), (g_color, ctx.columns[1], w_color)):
            grads = g.new_zeros(parts, *w.shape), g.new_zeros(parts, len(w))
            whole = torch.nn.functional.pad(w, (0, -w.shape[1] % WIDE))
            kernels.linear_backward(*[*_arrays(g_hidden, *grads, keep, slope, hidden), column, whole.numpy()])
            last.append(tuple(torch.from_numpy(parts_of.numpy().sum(0)) for parts_of in grads))
        g_inputs, (first, opacity) = _run_back(g_raw, g_hidden, hidden, inputs, ctx.sizes, packed)
        kernels.inputs_backward(*_arrays(g_anchors, g_inputs, inputs, distance))
        gradients = []
        for w, b, outer in zip(*(torch.split(part, ctx.widths) for part in first), (opacity, *last), strict=True):
            gradients += [w, b, *outer]
        return g_anchors, g_mask, None, None, None, *gradients


# -- Gaussians ---------------------------------------------------------------------------------------------------------


def finish(gaussians: Tensor, gates: Tensor, loose: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """means [K, 3], quats [K, 4], scales [K, 3], opacities [K], colors [K, 3] of Gaussians [K, 14] under gates [K].
    loose: residuals were added, so values go back to where they belong: scales >= 0, the others 0..1, quats unit."""
    found: tuple[Tensor, ...] = _Finish.apply(gaussians, gates, loose)  # type: ignore[no-untyped-call]
    means, quats, scales, opacities, colors = found
    return means, quats, scales, opacities, colors


class _Finish(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gaussians: Tensor, gates: Tensor, loose: bool) -> tuple[Tensor, ...]:
        outputs = tuple(gaussians.new_empty(len(gates), *width) for width in ((3,), (4,), (3,), (), (3,)))
        kernels.finish(*[*_arrays(*outputs, gaussians, gates), loose])
        ctx.loose = loose
        ctx.save_for_backward(gaussians, gates)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        gaussians, gates = ctx.saved_tensors
        results = torch.empty_like(gaussians), torch.empty_like(gates)
        given = (gaussians, gates, *(g.contiguous() for g in gradients))
        kernels.finish_backward(*[*_arrays(*results, *given), ctx.loose])
        return *results, None
