"""From anchors to the Gaussians that are seen, as autograd functions: kernels on the CPU (`slot_kernels.py`), else the
plain torch forms beside them.

A slot is one of an anchor's ten Gaussians; keep int64 [K], ascending, names those that are evaluated: anchor * 10 +
offset, anchors counted within the arguments.
"""

from __future__ import annotations

from typing import Any

import numba
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from pd4dgs_codec.model import slot_kernels as kernels
from pd4dgs_codec.render.simd import LANES
from pd4dgs_codec.scene import N_OFFSETS

#: means [K, 3], scales [K, 3], quats [K, 4] unit, opacities [K], gates [K].
Parts = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def slot_linear(hidden: Tensor, weight: Tensor, bias: Tensor, keep: Tensor) -> Tensor:
    """[K, w]: the outputs of a linear layer that belong to the kept slots. hidden [n, H], weight [10 w, H], bias
    [10 w], the w outputs of a slot side by side."""
    if hidden.device.type == "cpu" and hidden.shape[1] % LANES == 0:
        out: Tensor = _SlotLinear.apply(hidden, weight, bias, keep)  # type: ignore[no-untyped-call]
        return out
    return slot_linear_reference(hidden, weight, bias, keep)


def slot_linear_reference(hidden: Tensor, weight: Tensor, bias: Tensor, keep: Tensor) -> Tensor:
    """The plain torch form of `slot_linear`."""
    return F.linear(hidden, weight, bias).view(-1, len(bias) // N_OFFSETS).index_select(0, keep)


def assemble(
    position: Tensor, scaling: Tensor, offset: Tensor, opacity: Tensor, mask: Tensor, shape: Tensor, keep: Tensor
) -> Parts:
    """What the kept Gaussians are made of, before their gate.

    position [n, 3] world; scaling [n, 6] extents in scene units, of the offsets, then of the Gaussians; offset
    [n, 10, 3]; opacity [n, 10]; mask [n]; shape [K, 7]: logits of the scales relative to the extents, quaternion.
    """
    if position.device.type == "cpu":
        parts: Parts = _Assemble.apply(  # type: ignore[no-untyped-call]
            position, scaling, offset, opacity, mask, shape, keep
        )
        return parts
    return assemble_reference(position, scaling, offset, opacity, mask, shape, keep)


def assemble_reference(
    position: Tensor, scaling: Tensor, offset: Tensor, opacity: Tensor, mask: Tensor, shape: Tensor, keep: Tensor
) -> Parts:
    """The plain torch form of `assemble`."""
    owner = torch.div(keep, N_OFFSETS, rounding_mode="floor")
    per_anchor = torch.cat([position, scaling, mask[:, None]], dim=1)  # one gather for all of it
    centre, spread, base, gate = torch.split(per_anchor.index_select(0, owner), [3, 3, 3, 1], dim=1)
    means = centre + offset.view(-1, 3).index_select(0, keep) * spread
    scales = base * torch.sigmoid(shape[:, :3])
    quats = F.normalize(shape[:, 3:], dim=1)
    return means, scales, quats, opacity.flatten().index_select(0, keep), gate[:, 0]


class _SlotLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, hidden: Tensor, weight: Tensor, bias: Tensor, keep: Tensor) -> Tensor:
        hidden, weight = hidden.contiguous(), weight.contiguous()
        out = hidden.new_empty(len(keep), len(bias) // N_OFFSETS)
        kernels.linear(*(x.numpy() for x in (out, keep, hidden, weight, bias)))
        ctx.save_for_backward(hidden, weight, keep)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        hidden, weight, keep = ctx.saved_tensors
        parts = numba.get_num_threads()
        results = torch.zeros_like(hidden), weight.new_zeros(parts, *weight.shape), weight.new_zeros(parts, len(weight))
        kernels.linear_backward(*(x.numpy() for x in (*results, keep, g.contiguous(), hidden, weight)))
        return results[0], results[1][0], results[2][0], None


class _Assemble(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        position: Tensor,
        scaling: Tensor,
        offset: Tensor,
        opacity: Tensor,
        mask: Tensor,
        shape: Tensor,
        keep: Tensor,
    ) -> tuple[Tensor, ...]:
        n = len(keep)
        relative = torch.sigmoid(shape[:, :3])
        inputs = [x.contiguous() for x in (position, scaling, offset.view(-1, 3), opacity.flatten(), mask, shape)]
        outputs = tuple(position.new_empty(n, *width) for width in ((3,), (3,), (4,), (), ()))
        kernels.assemble(*(x.numpy() for x in (*outputs, keep, *inputs, relative)))
        ctx.shapes = [x.shape for x in (position, scaling, offset, opacity, mask)]
        ctx.save_for_backward(keep, inputs[1], inputs[2], inputs[5], relative, outputs[2])
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        keep, scaling, offset, shape, relative, quats = ctx.saved_tensors
        position, _, _, _, mask = ctx.shapes
        results = [scaling.new_zeros(s) for s in (position, scaling.shape, offset.shape, (len(offset),), mask)]
        results.append(torch.empty_like(shape))
        given = [g.contiguous() for g in gradients]
        arrays: list[Any] = [x.numpy() for x in (*results, keep, scaling, offset, shape, relative, quats, *given)]
        kernels.assemble_backward(*[*arrays, numba.get_num_threads()])
        return *(r.view(s) for r, s in zip(results, ctx.shapes, strict=False)), results[5], None
