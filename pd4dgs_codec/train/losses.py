"""The terms of the loss besides the picture: rate, temporal mask consistency, planes. Each unweighted, by name."""

from __future__ import annotations

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.rate import row_bits
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import MASK_THRESHOLD


def anchor_bits(model: Model, rows: Tensor, active: Tensor) -> Tensor:
    """Rbar [n]: the mean R over the scalars of each of the anchors `rows` (int64 [n], none twice, all active); priors
    are the moments over the anchors `active` (int64) of the same step class."""
    classes = torch.full_like(model.step_class, -1, dtype=torch.int8)
    classes[active] = model.step_class[active].to(torch.int8)
    parts = (
        (model.feature, model.steps.feature),
        (model.scaling_log, model.steps.scaling_log),
        (model.offset.flatten(1), model.steps.offset),
    )
    total = torch.stack([row_bits(values, classes, rows, step) for values, step in parts]).sum(0)
    return total / model.widths.channels


def rate_term(model: Model, mask: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """R_l = 1/|V| sum_i m_i Rbar_i, Rbar_i the mean bits over the scalars of anchor i, estimated on a random share
    of the anchors; the gradient reaches masks, attributes and the priors' moments. mask: m^(l) [N]."""
    active = (mask.detach() > MASK_THRESHOLD).nonzero()[:, 0]
    if len(active) < 2:
        return mask.sum() * 0.0
    n = max(1, int(len(active) * share))
    rows = active[torch.randperm(len(active), generator=generator)[:n]]
    weighted = mask.index_select(0, rows) * anchor_bits(model, rows, active)
    return weighted.mean() * (len(active) / len(mask))


def binary_term(mask: Tensor) -> Tensor:
    """L_binary = -1/|V| sum (m log2 m + (1 - m) log2(1 - m)); m clamped inside the logarithms."""
    m = mask.clamp(1e-6, 1 - 1e-6)
    return -(m * m.log2() + (1 - m) * (1 - m).log2()).mean()


def smooth_term(mask: Tensor, pairs: Tensor, weights: Tensor) -> Tensor:
    """L_smooth = 1/|S| sum w_ij |m_i - m_j| over pairs int64 [2, S] with weights [S]."""
    if pairs.shape[1] == 0:
        return mask.sum() * 0.0
    return (weights * (mask.index_select(0, pairs[0]) - mask.index_select(0, pairs[1])).abs()).mean()


class Neighbours:
    """Draws pairs of near anchors: those that stand close along a space-filling (Morton) curve."""

    def __init__(self, anchor_q: Tensor):
        self.order = torch.from_numpy(morton_order(anchor_q.cpu().numpy()))
        self.places = anchor_q.cpu()[self.order].float().T.contiguous()  # [3, N], along the curve

    def draw(self, tau: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Pairs int64 [2, S] and their weights exp(-|x_i - x_j| / tau) [S], distances in voxels."""
        n = len(self.order)
        if n < 2:
            return torch.zeros(2, 0, dtype=torch.int64), torch.zeros(0)
        second = torch.arange(n) + torch.randint(1, min(9, n), (n,), generator=generator)
        first = (second < n).nonzero()[:, 0]
        second = second[first]
        distance = (self.places[:, first] - self.places[:, second]).square().sum(0).sqrt()
        return torch.stack([self.order[first], self.order[second]]), torch.exp(distance / -tau)
