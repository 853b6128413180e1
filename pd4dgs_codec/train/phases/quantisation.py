"""Fitting of the scene to its quantisation, where planes and weights begin to be rounded: whitening and step classes.

Whitening transforms the features so that a quantisation step costs the same in every channel, see
`sensitivity.whitening_transform`. Its H is the mean Gauss-Newton matrix of the pictures by an anchor's feature.

Step classes give coarser steps to anchors that pictures depend on little. The error of a step differs a thousandfold
between anchors, and neither position nor size predicts it, so it is measured. Each next class doubles the steps, which
quadruples an anchor's squared error and saves the same bits for all anchors, from which the best classes follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import Rounding
from pd4dgs_codec.model.sensitivity import attribute_slopes, rounding_error, whitening_transform
from pd4dgs_codec.scene import MASK_THRESHOLD, MAX_CLASS, SCAFFOLD_NETWORKS
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.phases.prune import added_error, relative_error
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
        """Grades and whitens, and logs how many anchors each step class has."""
        model, config, rounding = state.model, state.config, state.rounding(noisy=False)
        levels, views = state.measured_levels(), state.views.spread(VIEWS)
        found: list[int] = []
        if model.frozen:  # the features are those of the base, and steps are graded if its are
            config = replace(config, whitening=False, grading=config.grading * bool(model.step_class.any()))
        if config.grading:
            found = grade(model, levels, views, config.grading, rounding)
        if config.whitening:
            whiten(model, state.optimiser, levels, views, rounding)
            if config.grading:  # the features' steps have changed
                found = grade(model, levels, views, config.grading, rounding)
        if found:
            record["step_classes"] = found


# -- step classes ------------------------------------------------------------------------------------------------------


def grade(
    model: Model, levels: Sequence[int], views: Sequence[TrainingView], share: float, rounding: Rounding
) -> list[int]:
    """Sets the attributes' centres, and step classes whose quantisation adds at most `share` to the squared error of
    the views at any of the levels, beyond that of class 0. Returns how many anchors each class has. Centres and classes
    of frozen anchors stay."""
    errors = added_error(model, levels, views, rounding, rounding_error)[:, model.frozen :]
    met = errors.isfinite()
    worst = torch.where(met, errors, 0.0).amax(0)  # a level of large error must not set the budget of the others
    classes = classes_within(torch.where(met.any(0), worst, torch.inf), share)
    model.step_class[model.frozen :] = classes
    if not model.frozen:
        model.centre.copy_(centre(model))
    return torch.bincount(classes.long(), minlength=MAX_CLASS + 1).tolist()


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


def whiten(
    model: Model, optimiser: Optimiser, levels: Sequence[int], views: Sequence[TrainingView], rounding: Rounding
) -> None:
    """Transforms the features' channels in the anchors and in all layers that read or change them. Pictures stay the
    same up to rounding, and so does the error of a step, summed over the channels."""
    transform = workers.alike(lambda: _measured(model, levels, views, rounding))
    if transform is not None:
        _apply(model, optimiser, transform.to(model.feature.device))


def _measured(model: Model, levels: Sequence[int], views: Sequence[TrainingView], rounding: Rounding) -> Tensor | None:
    """float64 [D, D]: the transform for the model; None if no picture depends on a feature."""
    errors = torch.stack([relative_error(model, level, views, rounding, _feature_error)[0] for level in levels]).sum(0)
    active = model.masks(2).detach() > MASK_THRESHOLD
    if not errors.trace() > 0 or int(active.sum()) < 2:
        return None
    scaled = model.feature.detach()[active].double() / model.spacing[active, None]
    return whitening_transform(errors, torch.cov(scaled.T)).cpu()


def _feature_error(model: Model, *viewpoint: Any, **options: Any) -> tuple[Tensor, Tensor, Tensor]:
    """As `rounding_error`, but float64 [D, D]: the sum of the anchors' Gauss-Newton matrices by the features, in
    units of their steps."""
    slopes, met, image = attribute_slopes(model, *viewpoint, **options)
    slope = (slopes["feature"] * model.spacing[:, None]).double()
    return slope.T @ slope, met, image


@torch.no_grad()
def _apply(model: Model, optimiser: Optimiser, transform: Tensor) -> None:
    """Replaces features f by A f, A = `transform` [D, D], and adapts the layers that read or change them."""
    back, width = torch.linalg.inv(transform), model.widths.feature
    optimiser.transform(model.feature, slice(None), transform.T)
    for name in SCAFFOLD_NETWORKS:
        optimiser.transform(model.network(name).layers[0].weight, slice(width), back)
    for field in model.deformations.values():
        last = field.head_layer("feature")
        if last is not None:
            optimiser.transform(last.weight, slice(None), transform.T, transposed=True)
            optimiser.transform(last.bias, slice(None), transform.T)
