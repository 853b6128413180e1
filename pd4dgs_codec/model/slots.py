"""From anchors to the Gaussians that are seen, in plain torch; `fused.py` is what training on the CPU uses.

A slot is one of an anchor's G Gaussians; keep int64 [K], ascending, names those that are evaluated: anchor * G +
offset, anchors counted within the arguments.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

#: means [K, 3], scales [K, 3], quats [K, 4] unit, opacities [K], gates [K].
Parts = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def slot_linear(hidden: Tensor, weight: Tensor, bias: Tensor, keep: Tensor, slots: int) -> Tensor:
    """[K, w]: the outputs of a linear layer that belong to the kept slots. hidden [n, H], weight [G w, H], bias
    [G w], the w outputs of a slot side by side."""
    return F.linear(hidden, weight, bias).view(-1, len(bias) // slots).index_select(0, keep)


def assemble(
    position: Tensor, scaling: Tensor, offset: Tensor, opacity: Tensor, mask: Tensor, shape: Tensor, keep: Tensor
) -> Parts:
    """What the kept Gaussians are made of, before their gate.

    position [n, 3] world; scaling [n, 6] extents in scene units, of the offsets, then of the Gaussians; offset
    [n, G, 3]; opacity [n, G]; mask [n]; shape [K, 7]: logits of the scales relative to the extents, quaternion.
    """
    owner = torch.div(keep, offset.shape[1], rounding_mode="floor")
    per_anchor = torch.cat([position, scaling, mask[:, None]], dim=1)  # one gather for all of it
    centre, spread, base, gate = torch.split(per_anchor.index_select(0, owner), [3, 3, 3, 1], dim=1)
    means = centre + offset.reshape(-1, 3).index_select(0, keep) * spread
    scales = base * torch.sigmoid(shape[:, :3])
    quats = F.normalize(shape[:, 3:], dim=1)
    return means, scales, quats, opacity.flatten().index_select(0, keep), gate[:, 0]
