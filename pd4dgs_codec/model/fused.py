"""The stages of `Model.gaussians` on the CPU, as autograd functions of the kernels in `draw.gaussians`.

    pick     rows of the attributes, with noise or rounding      [n, 9 + D + 3 G]
    grow     the scaffold's networks: the Gaussians of anchors    [K, 14]

A row has the position, then the attributes in their order. `reference` has the same stages in plain torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import gaussians as kernels
from pd4dgs_codec.draw.gaussians import Decoders, Functions
from pd4dgs_codec.model.networks import MLP, Quantisation, rounded
from pd4dgs_codec.scene import MIN_OPACITY, SCALING_DIM

TORCH = Functions(
    lambda x: torch.from_numpy(x).tanh().numpy(),
    lambda x: torch.from_numpy(x).sigmoid().numpy(),
    lambda x: torch.from_numpy(x).exp().numpy(),
)


def fusible(networks: Sequence[MLP]) -> bool:
    """Whether `grow` can evaluate the networks."""
    return kernels.fusible([[(layer.weight, layer.bias) for layer in net.layers] for net in networks])


def pick(attributes: Sequence[Tensor], position: Tensor, rows: Tensor, quantisation: Quantisation) -> Tensor:
    """Returns [n, 9 + D + 3 G]: the anchors `rows` (int64 [n], none twice), with noise or rounded. attributes: [N, ...]
    each, in the order of ATTRIBUTES. position: [N, 3]."""
    row: Tensor = _Pick.apply(position, rows, quantisation, *attributes)  # type: ignore[no-untyped-call]
    return row


class _Pick(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, position: Tensor, rows: Tensor, quantisation: Quantisation, *attributes: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shapes = [values.shape for values in attributes]
        steps, centres, spacing, noise, rounding = quantisation
        parts = [position, *(values.flatten(1) for values in attributes)]
        out = position.new_empty(len(rows), sum(part.shape[1] for part in parts))
        column = 0
        drawn = (None, *(noise or (None,) * len(attributes)))
        for part, step, own, centre in zip(parts, (0.0, *steps), drawn, (position[:1], *centres), strict=True):
            given = part[:0] if own is None else own
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
        return None, None, None, *gradients


def grow(
    anchors: Tensor, mask: Tensor, eye: Tensor, networks: Sequence[MLP], step: float | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Evaluates anchors with gates mask [n], seen from eye [3]. Returns Gaussians [K, 14] before the gate, their gates
    [K], opacities before the gate [n, G] and the kept slots int64 [K], whose gated opacity is at least MIN_OPACITY.
    networks: opacity, covariance, colour. step: of their weights, if they are rounded."""
    parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
    found: tuple[Tensor, Tensor, Tensor, Tensor] = _Grow.apply(  # type: ignore[no-untyped-call]
        anchors, mask, eye, step, *parameters
    )
    return found


class _Grow(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, anchors: Tensor, mask: Tensor, eye: Tensor, step: float | None, *parameters: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        used = [rounded(p, step) for p in parameters]
        layers = [(w.numpy(), b.numpy()) for w, b in zip(used[::2], used[1::2], strict=True)]
        features = anchors.shape[1] - 3 - 3 * len(layers[1][1]) - SCALING_DIM
        decoders = Decoders([layers[:2], layers[2:4], layers[4:]], features, TORCH)
        look = decoders.look(anchors.numpy(), eye.numpy())
        keep = kernels.seen(look.opacity, mask.numpy(), MIN_OPACITY)
        made = decoders.make(anchors.numpy(), mask.numpy(), look, keep)
        ctx.decoders, ctx.look, ctx.keep, ctx.made = decoders, look, keep, made
        ctx.save_for_backward(anchors)
        raw, kept = torch.from_numpy(look.opacity), torch.from_numpy(keep)
        ctx.mark_non_differentiable(raw, kept)
        return torch.from_numpy(made.gaussians), torch.from_numpy(made.gates), raw, kept

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor, g_gates: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        (anchors,) = ctx.saved_tensors
        given = (arrays.contiguous().numpy() for arrays in (g, g_gates))
        g_anchors, g_mask, layers = ctx.decoders.backward(anchors.numpy(), ctx.look, ctx.keep, ctx.made, *given)
        gradients = [torch.from_numpy(np.ascontiguousarray(part)) for layer in layers for part in layer]
        return torch.from_numpy(g_anchors), torch.from_numpy(g_mask), None, None, *gradients
