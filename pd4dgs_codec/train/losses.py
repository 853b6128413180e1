"""The terms of the loss that ask for no picture, with their gradients: planes, rate, temporal mask consistency.

A step finds them on a thread beside the one that draws its picture. Their graph has leaves of its own: torch (2.13)
holds a leaf's lock while it asks for the interpreter's, so two threads whose graphs share a leaf can wait for each
other for ever.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pd4dgs_codec.model.hexplane import HexPlane
from pd4dgs_codec.model.masks import level_mask
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.plane_rate import proxy_bits
from pd4dgs_codec.model.plane_regularisers import regularisers
from pd4dgs_codec.model.rate import row_bits
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import ATTRIBUTES, MASK_THRESHOLD
from pd4dgs_codec.threads import aside
from pd4dgs_codec.train.config import Schedule, TrainConfig
from pd4dgs_codec.train.optimiser import PER_ANCHOR

Weighted = tuple[str, float, Tensor]  #: a term's name, weight and value


@dataclass
class Terms:
    """loss: their weighted sum. terms: unweighted, by name. gradients: of the loss by each parameter that it moves."""

    loss: float
    terms: dict[str, float]
    gradients: list[tuple[nn.Parameter, Tensor]]


class ModelLoss:
    """What of the loss depends on the model alone."""

    def __init__(self, config: TrainConfig, generator: torch.Generator):
        self.config, self.generator = config, generator
        self._neighbours: Neighbours | None = None

    def begin(self, model: Model, level: int, schedule: Schedule, place: int) -> Callable[[], Terms]:
        """Begins to find the terms of a step at `place`; what is returned waits for them. Meanwhile nobody else may
        draw from the generator or change the model."""
        planes = {layer: field.planes for layer, field in model.deformations.items() if layer <= level}
        parameters = [*(getattr(model, name) for name in PER_ANCHOR), *(own.grid for own in planes.values())]
        leaves = [parameter.detach().requires_grad_() for parameter in parameters]
        anchors, grids = dict(zip(PER_ANCHOR, leaves, strict=False)), leaves[len(PER_ANCHOR) :]

        def find() -> Terms:
            found: list[Weighted] = []
            for (layer, own), grid in zip(planes.items(), grids, strict=True):
                found += self._plane_terms(layer, own, grid, model.steps.planes(layer), schedule.pressure(place))
            if place >= schedule.progressive:
                found += self._mask_terms(model, level, anchors, schedule.separation(place))
            loss = sum((weight * value for _, weight, value in found), model.feature.new_zeros(()))
            by_leaf = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else ()
            gradients = [(p, g) for p, g in zip(parameters, by_leaf, strict=False) if g is not None]
            return Terms(float(loss.detach()), {name: float(value.detach()) for name, _, value in found}, gradients)

        return aside(find)

    def _plane_terms(
        self, layer: int, planes: HexPlane, grid: Tensor, step: float, pressure: float
    ) -> Iterator[Weighted]:
        name, weights = {1: ("global", self.config.global_planes), 2: ("local", self.config.local_planes)}[layer]
        for term, value in regularisers(grid, planes.layout).items():
            yield f"{name}_{term}", getattr(weights, term), value
        if weight := self.config.plane_rate * pressure:
            yield f"{name}_rate_proxy", weight, proxy_bits(grid, planes.layout, step)

    def _mask_terms(
        self, model: Model, level: int, anchors: Mapping[str, Tensor], separation: float
    ) -> Iterator[Weighted]:
        """The rate and the two terms of temporal mask consistency."""
        config, mask = self.config, level_mask(anchors["mask_logits"], level)
        if config.rate_scale:
            weight = config.lambdas[level] * config.rate_scale
            yield "rate", weight, rate_term(model, anchors, mask, config.rate_share, self.generator)
        if config.tmc_binary:
            yield "tmc_binary", config.tmc * config.tmc_binary_growth**separation, binary_term(mask)
        if config.tmc_smooth:
            if self._neighbours is None or self._neighbours.anchor_q is not model.anchor_q:
                self._neighbours = Neighbours(model.anchor_q)
            pairs, weights = self._neighbours.draw(config.tmc_tau, self.generator)
            yield "tmc_smooth", config.tmc, smooth_term(mask, pairs.to(mask.device), weights.to(mask.device))


def anchor_bits(model: Model, anchors: Mapping[str, Tensor], rows: Tensor, active: Tensor) -> Tensor:
    """Rbar [n]: the mean R over the scalars of each of the anchors `rows` (int64 [n], none twice, all active); priors
    are the moments over the anchors `active` (int64) of the same step class. anchors: the model's attributes by name,
    or others of their shapes."""
    classes = torch.full_like(model.step_class, -1, dtype=torch.int8)
    classes[active] = model.step_class[active].to(torch.int8)
    parts = [(anchors[name].flatten(1), getattr(model.steps, name)) for name in ATTRIBUTES]
    total = torch.stack([row_bits(values, classes, rows, step) for values, step in parts]).sum(0)
    return total / model.widths.channels


def rate_term(
    model: Model, anchors: Mapping[str, Tensor], mask: Tensor, share: float, generator: torch.Generator
) -> Tensor:
    """R_l = 1/|V| sum_i m_i Rbar_i, Rbar_i the mean bits over the scalars of anchor i, estimated on a random share
    of the anchors; the gradient reaches masks, attributes and the priors' moments. mask: m^(l) [N]; anchors: as in
    `anchor_bits`."""
    active = (mask.detach() > MASK_THRESHOLD).nonzero()[:, 0]
    if len(active) < 2:
        return mask.sum() * 0.0
    n = max(1, int(len(active) * share))
    rows = active[torch.randperm(len(active), generator=generator)[:n]]
    weighted = mask.index_select(0, rows) * anchor_bits(model, anchors, rows, active)
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
        self.anchor_q = anchor_q
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
