"""Step classes: anchors that the pictures hardly depend on have coarser steps from the last third of a run on.

What a step costs differs a thousandfold from anchor to anchor, and neither place nor size tells how much. So it is
measured, and the classes of least bytes at a given error follow: a class more doubles the steps, which quadruples the
squared error and saves the same bits everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pd4dgs_codec.model.harm import step_harm
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.rounding import Rounding
from pd4dgs_codec.scene import MASK_THRESHOLD, MAX_CLASS
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.pruning import relative_harm
from pd4dgs_codec.train.shot import Shot

#: Training views in which the harm of a step is measured.
VIEWS = 16
#: Halvings of the interval, 80 octaves wide at first, in which the classes' threshold is sought.
HALVINGS = 40


def grade(model: Model, shots: Sequence[Shot], levels: Sequence[int], share: float, rounding: Rounding) -> list[int]:
    """Gives every anchor the class at which quantisation adds `share` at most to the squared error of each of `levels`,
    beside what it adds at class 0, and the attributes their centres. Returns how many anchors each class has."""
    harm = workers.alike(
        lambda: torch.stack([relative_harm(model, level, shots, rounding, step_harm).cpu() for level in levels])
    )
    met = harm.isfinite()
    worst = torch.where(met, harm, 0.0).amax(0)  # a level that is far off anyway must not set the others' budget
    classes = classes_within(torch.where(met.any(0), worst, torch.inf), share)
    model.step_class.copy_(classes)
    model.centre.copy_(centre(model))
    return torch.bincount(classes.long(), minlength=MAX_CLASS + 1).tolist()


def classes_within(harm: Tensor, budget: float) -> Tensor:
    """uint8 [N]: of the classes round(log2(T / harm) / 2), those of the largest T at which the sum of harm (4^c - 1)
    stays within the budget. harm: float64 [N] >= 0, that of class 0; of infinite harm is class 0."""
    finite = harm[harm.isfinite() & (harm > 0)]
    if not len(finite):
        return torch.zeros(len(harm), dtype=torch.uint8)

    def classes(log2_threshold: float) -> Tensor:
        exact = 0.5 * (log2_threshold - harm.clamp(min=1e-300).log2())
        return exact.round().clamp(0, MAX_CLASS)

    low, high = float(finite.log2().min()), float(finite.log2().max()) + 2 * MAX_CLASS + 2
    known = harm.isfinite()
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        added = (harm[known] * (4.0 ** classes(middle)[known] - 1)).sum()
        low, high = (middle, high) if added <= budget else (low, middle)
    return classes(low).to(torch.uint8)


@torch.no_grad()
def centre(model: Model) -> Tensor:
    """[channels]: the means over the active anchors of features and log-scalings, and 0 for offsets, where those of
    Gaussians that were never seen are; multiples of the steps."""
    active = model.masks(2) > MASK_THRESHOLD
    active = active if active.any() else torch.ones_like(active)
    means = [model.feature[active].mean(0), model.scaling_log[active].mean(0)]
    rounded = [
        (mean / step).round() * step
        for mean, step in zip(means, (model.steps.feature, model.steps.scaling_log), strict=True)
    ]
    return torch.cat([*rounded, model.offset.new_zeros(model.offset[0].numel())])
