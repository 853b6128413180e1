"""The terms of the loss that need no picture, with their gradients: planes, rate, masks.

The CPU computes them on a second thread while the step renders, which makes steps of levels 1 and 2 a tenth faster. On
a GPU they would be most of a step's operations, each too small to be worth its start. Their graph has leaves of its
own: torch (2.13) holds a leaf's lock while it waits for the interpreter's, so two threads whose graphs share a leaf can
deadlock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pd4dgs_codec.model.hexplane import HexPlane
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import level_mask
from pd4dgs_codec.model.rate import row_bits
from pd4dgs_codec.scene import ATTRIBUTES, MASK_THRESHOLD
from pd4dgs_codec.threads import aside
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.optimiser import PER_ANCHOR
from pd4dgs_codec.train.schedule import Schedule

INSIDE = (1e-6, 1 - 1e-6)  #: masks are clamped to this inside logarithms
Weighted = tuple[str, float, Tensor]  #: a term's name, weight and value


@dataclass
class Terms:
    """loss: the weighted sum. terms: unweighted, by name. gradients: the loss's, for each parameter that has one."""

    loss: float
    terms: dict[str, float]
    gradients: list[tuple[nn.Parameter, Tensor]]


class ModelLoss:
    """The part of the loss that depends on the model only."""

    def __init__(self, config: TrainConfig, generator: torch.Generator):
        self.config, self.generator = config, generator

    def begin(self, model: Model, level: int, schedule: Schedule, position: int) -> Callable[[], Terms]:
        """Starts to compute the terms of a step at `position` and returns a function that waits for them. Until that
        function returns, nothing else may draw from the generator or change the model."""
        planes = {layer: field.planes for layer, field in model.deformations.items() if layer <= level}
        parameters = [getattr(model, name) for name in PER_ANCHOR]
        parameters += [own.grid for own in planes.values()]
        leaves = {parameter: parameter.detach().cpu().requires_grad_() for parameter in parameters}

        def find() -> Terms:
            found: list[Weighted] = []
            for layer, own in planes.items():
                grid, step = leaves[own.grid], model.steps.planes(layer)
                found += self._plane_terms(layer, own, grid, step, schedule.pressure(position))
            if position >= schedule.progressive:
                anchors = {name: leaves[getattr(model, name)] for name in PER_ANCHOR}
                found += self._mask_terms(model, level, anchors, schedule.separation(position))
            if not found:
                return Terms(0.0, {}, [])
            loss = torch.stack([weight * value for _, weight, value in found]).sum()
            by_leaf = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
            gradients = [(p, g) for p, g in zip(leaves, by_leaf, strict=True) if g is not None]
            return Terms(float(loss.detach()), {name: float(value.detach()) for name, _, value in found}, gradients)

        return aside(find)

    def _plane_terms(
        self, layer: int, planes: HexPlane, grid: Tensor, step: float, pressure: float
    ) -> Iterator[Weighted]:
        """Yields the regularisers and the rate of a layer's planes."""
        name = {1: "global", 2: "local"}[layer]
        for term, value in planes.regularisers(grid).items():
            yield f"{name}_{term}", getattr(self.config.planes, term), value
        if weight := self.config.plane_rate * pressure:
            yield f"{name}_rate_proxy", weight, planes.rate(grid, step)

    def _mask_terms(
        self, model: Model, level: int, anchors: Mapping[str, Tensor], separation: float
    ) -> Iterator[Weighted]:
        """Yields the anchors' rate and the term that separates masks."""
        config, mask = self.config, level_mask(anchors["mask_logits"], level)
        if config.rate_scale:
            weight = config.lambdas[level] * config.rate_scale
            yield "rate", weight, rate_term(model, anchors, mask, config.rate_share, self.generator)
        if config.binary:
            yield "binary", config.binary * config.binary_growth**separation, binary_term(mask)


def anchor_bits(model: Model, anchors: Mapping[str, Tensor], rows: Tensor, active: Tensor) -> Tensor:
    """Rbar [n]: the mean bits R per scalar of each anchor in `rows` (int64 [n], distinct, all in `active`). The priors
    are moments over the anchors in `active` (int64) of the same step class. anchors: attributes by name, in the model's
    shapes."""
    classes = torch.full((len(model.step_class),), -1, dtype=torch.int8)
    classes[active] = model.step_class.cpu()[active].to(torch.int8)
    parts = [(anchors[name].flatten(1), getattr(model.steps, name)) for name in ATTRIBUTES]
    return row_bits(parts, classes, rows) / model.widths.channels


def rate_term(
    model: Model, anchors: Mapping[str, Tensor], mask: Tensor, share: float, generator: torch.Generator
) -> Tensor:
    """R_l = 1/|V| sum_i m_i Rbar_i over the active anchors i, estimated on a random `share` of them. Gradients reach
    the masks, the attributes and the priors' moments. mask: m^(l) [N]; anchors, Rbar: as in `anchor_bits`."""
    active = (mask.detach() > MASK_THRESHOLD).nonzero()[:, 0]
    if len(active) < 2:
        return mask.sum() * 0.0
    n = max(1, int(len(active) * share))
    rows = active[torch.randperm(len(active), generator=generator)[:n]]
    weighted = mask.index_select(0, rows) * anchor_bits(model, anchors, rows, active)
    return weighted.mean() * (len(active) / len(mask))


def binary_term(mask: Tensor) -> Tensor:
    """L_binary = -1/|V| sum (m log2 m + (1 - m) log2(1 - m)); m clamped to INSIDE in the logarithms."""
    m = mask.clamp(*INSIDE)
    return -torch.lerp((1 - m).log2(), m.log2(), m).mean()
