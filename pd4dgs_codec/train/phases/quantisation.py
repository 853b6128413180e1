"""Fitting of the scene to its quantisation, where planes and weights begin to be rounded: whitening and step classes.

Whitening transforms the features so that a quantisation step costs the same in every channel, see
`sensitivity.whitening_transform`. Its H is the mean Gauss-Newton matrix of the pictures by an anchor's feature.

Step classes give coarser steps to anchors that pictures depend on little. The error of a step differs a thousandfold
between anchors, and neither position nor size predicts it, so it is measured. Each next class doubles the steps, which
quadruples an anchor's squared error and saves the same bits for all anchors, from which the best classes follow.

Both need the derivatives of the same pictures, which are found once: whitening changes those by features linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import Rounding
from pd4dgs_codec.model.sensitivity import attribute_slopes, whitening_transform
from pd4dgs_codec.scene import MASK_THRESHOLD, MAX_CLASS, SCAFFOLD_NETWORKS
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.phases.prune import LEARNT
from pd4dgs_codec.train.state import TrainingView, TrainState

#: Training views in which the error of a step is measured.
VIEWS = 8
#: Halvings of the interval in which the threshold of the classes is searched.
HALVINGS = 40


class FitQuantisation(phases.Phase):
    """Whitens the features and assigns step classes, as far as the options ask for it."""

    def due(self, state: TrainState) -> bool:
        """At `Schedule.rounding`."""
        return state.config.noise and phases.long_enough(state) and state.reached(state.schedule.rounding)

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Whitens and grades, and logs how many anchors each step class has."""
        model, config = state.model, state.config
        # a base has whitened its features, and steps are graded if its are
        whitens, grades = config.whitening and not model.frozen, not model.frozen or bool(model.step_class.any())
        share = config.grading if grades else 0.0
        if not (share or whitens):
            return

        def fit() -> tuple[Tensor | None, Tensor | None]:
            views, rounding = state.views.spread(VIEWS), state.rounding(noisy=False)
            found = [measured(model, level, views, rounding) for level in state.measured_levels()]
            return fitted(model, found, share, whitens)

        classes, transform = workers.alike(fit)
        if transform is not None:
            whiten(model, state.optimiser, transform.to(model.feature.device))
        if classes is not None:
            record["step_classes"] = grade(model, classes)


class Measured(NamedTuple):
    """How the pictures of a level depend on the anchors. feature: float32 [views, N, D], derivatives by features.
    others: float64 [N], the squared error of rounding the other attributes to steps of class 0. met: bool [N], whether
    a view shows the anchor. error: the views' present squared error, of which a view counts at most LEARNT."""

    feature: Tensor
    others: Tensor
    met: Tensor
    error: float


def measured(model: Model, level: int, views: Sequence[TrainingView], rounding: Rounding) -> Measured:
    """Finds the derivatives of a level in some views. The squared error of a step Q is Q^2 / 12 on average."""
    generator, feature, total = torch.Generator().manual_seed(0), [], 0.0
    met, others = torch.zeros_like(model.step_class, dtype=torch.bool), torch.zeros_like(model.step_class).double()
    for view in views:
        viewpoint = (level, view.view.time, view.view.camera)
        slopes, near, image = attribute_slopes(model, *viewpoint, generator, weights=view.weights, rounding=rounding)
        feature.append(slopes.pop("feature"))
        for name, slope in slopes.items():
            others += slope.double().square().flatten(1).sum(1) * (getattr(model.steps, name) ** 2 / 12)
        met |= near
        total += min(view.squared_error(image), LEARNT)
    return Measured(torch.stack(feature), others, met, max(total, 1e-12))


def fitted(model: Model, found: Sequence[Measured], share: float, whitens: bool) -> tuple[Tensor | None, Tensor | None]:
    """(uint8 [N], step classes whose quantisation adds at most `share` to the squared error of the views at any of the
    levels in `found`, beyond that of class 0, if `share` is not 0; float64 [D, D], the features' transform, if it
    `whitens`). Both on the CPU."""
    classes = _classes(model, found, share) if share else None
    if not whitens:
        return classes, None
    transform = _transform(model, found, model.spacing if classes is None else torch.exp2(classes.float()))
    if classes is not None and transform is not None:  # the features' steps change
        classes = _classes(model, found, share, torch.linalg.inv(transform))
    return classes, transform


# -- step classes ------------------------------------------------------------------------------------------------------


def rounding_errors(model: Model, level: Measured, back: Tensor | None = None) -> Tensor:
    """float64 [N]: the squared error of rounding each anchor to steps of class 0. back: [D, D], the inverse of a
    transform of the features."""
    feature = level.feature if back is None else level.feature @ back.to(level.feature)
    return level.others + feature.double().square().sum((0, 2)) * (model.steps.feature**2 / 12)


def _classes(model: Model, found: Sequence[Measured], share: float, back: Tensor | None = None) -> Tensor:
    """uint8 [N]; frozen anchors keep theirs. A level of large error must not set the budget of the others."""
    met = torch.stack([level.met for level in found]).any(0)
    worst = torch.stack([rounding_errors(model, level, back) / level.error for level in found]).amax(0)
    own = torch.where(met, worst, torch.inf)[model.frozen :].cpu()
    return torch.cat([model.step_class[: model.frozen].cpu(), classes_within(own, share)])


def grade(model: Model, classes: Tensor) -> list[int]:
    """Sets the step classes and the attributes' centres. Returns how many of the anchors each class has. The centres of
    frozen anchors stay."""
    model.step_class.copy_(classes)
    if not model.frozen:
        model.centre.copy_(centre(model))
    return torch.bincount(classes[model.frozen :].long(), minlength=MAX_CLASS + 1).tolist()


def classes_within(errors: Tensor, budget: float) -> Tensor:
    """uint8 [N]: the classes c = round(log2(T / error) / 2) for the largest T at which the sum of error (4^c - 1) stays
    within the budget. errors: float64 [N] >= 0, at class 0; an infinite error keeps class 0."""
    finite = errors[errors.isfinite() & (errors > 0)]
    if not len(finite):
        return torch.zeros(len(errors), dtype=torch.uint8)

    def classes(log2_threshold: float) -> Tensor:
        exact = 0.5 * (log2_threshold - errors.clamp(min=1e-300).log2())
        return exact.round().clamp(0, MAX_CLASS)

    low, high = float(finite.log2().min()), float(finite.log2().max()) + 2 * MAX_CLASS + 2
    known = errors.isfinite()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        added = (errors[known] * (4.0 ** classes(middle)[known] - 1)).sum()
        low, high = (middle, high) if added <= budget else (low, middle)
    return classes(low).to(torch.uint8)


@torch.no_grad()
def centre(model: Model) -> Tensor:
    """[channels]: the means of features and log-scalings over the active anchors, rounded to steps, and 0 for offsets,
    which is their value in Gaussians that were never seen."""
    active = model.masks(2) > MASK_THRESHOLD
    active = active if active.any() else torch.ones_like(active)
    means = [model.feature[active].mean(0), model.scaling_log[active].mean(0)]
    steps = (model.steps.feature, model.steps.scaling_log)
    rounded = [(mean / step).round() * step for mean, step in zip(means, steps, strict=True)]
    return torch.cat([*rounded, model.offset.new_zeros(model.offset[0].numel())])


# -- whitening ---------------------------------------------------------------------------------------------------------


def _transform(model: Model, found: Sequence[Measured], spacing: Tensor) -> Tensor | None:
    """float64 [D, D]: the transform for the model, with anchors whose steps are `spacing` [N] times those of class 0;
    None if no picture depends on a feature."""
    spacing = spacing.to(model.feature)
    slopes = [(level.feature * spacing[:, None]).double().flatten(0, 1) / level.error**0.5 for level in found]
    errors = torch.stack([slope.T @ slope for slope in slopes]).sum(0)
    active = model.masks(2).detach() > MASK_THRESHOLD
    if not errors.trace() > 0 or int(active.sum()) < 2:
        return None
    scaled = model.feature.detach()[active].double() / spacing[active, None]
    return whitening_transform(errors, torch.cov(scaled.T)).cpu()


@torch.no_grad()
def whiten(model: Model, optimiser: Optimiser, transform: Tensor) -> None:
    """Replaces features f by A f, A = `transform` float64 [D, D], and adapts the layers that read or change them, so
    that pictures stay the same up to rounding."""
    back, width = torch.linalg.inv(transform), model.widths.feature
    optimiser.transform(model.feature, slice(None), transform.T)
    for name in SCAFFOLD_NETWORKS:
        optimiser.transform(model.network(name).layers[0].weight, slice(width), back)
    for field in model.deformations.values():
        last = field.head_layer("feature")
        if last is not None:
            optimiser.transform(last.weight, slice(None), transform.T, transposed=True)
            optimiser.transform(last.bias, slice(None), transform.T)
