"""What moves leaves a base: it belongs to the segments that continue the base.

For the first half of the run, pictures of all times train level 0, which learns their mean: what stands still is sharp,
and what moves a blur. Then pixels far from the mean no longer train (trimmed least squares: Rousseeuw, Least median of
squares regression, 1984), and the anchors that mostly show such pixels leave. Segments could neither move nor hide what
the base shows at their key instants.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from pd4dgs_codec.model.picture import render
from pd4dgs_codec.model.sensitivity import omission_error
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.ssim import REACH
from pd4dgs_codec.train.state import TrainingView, TrainState

#: Shares of the run from which pixels of what moves do not train, and after which anchors leave.
STILL_FROM, LEAVE_AT = 1 / 2, 3 / 5
#: A pixel shows what moves if the mean difference of a square of PATCH pixels a side, in which the errors of texture
#: cancel, is at least MOVED and MANY times the median of the picture.
PATCH, MOVED, MANY = 5, 0.08, 4.0
VIEWS = 48  #: that measure what an anchor shows


def at_rest(shown: TrainingView, image: Tensor) -> TrainingView:
    """The view without the pixels that show what moves, and those whose SSIM depends on them. image: its picture."""
    apart = avg_pool2d((image.detach() - shown.image).permute(2, 0, 1), PATCH, 1, PATCH // 2).abs().amax(0)
    limit = (MANY * apart.median()).clamp(min=MOVED)
    apart = max_pool2d(apart[None], 2 * REACH + 1, 1, REACH)[0]
    return replace(shown, weights=shown.weights * (apart < limit))


class LeaveMotion(phases.Phase):
    """Removes the anchors whose absence would change what moves more than what stands still."""

    def due(self, state: TrainState) -> bool:
        """Once, in the training of a base."""
        return state.config.still and state.reached(round(LEAVE_AT * (state.schedule.iterations or 0)))

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Removes them, and logs how many."""
        moving = workers.alike(lambda: _moving(state)).to(state.device)
        if not moving.all():
            state.keep_anchors((~moving).nonzero()[:, 0])
            record["left_base"] = int(moving.sum())


def _moving(state: TrainState) -> Tensor:
    """bool [N], on the CPU: the anchors that mostly show what moves."""
    model, rounding, generator = state.model, state.rounding(noisy=False), torch.Generator().manual_seed(0)
    still = moves = torch.zeros(len(model.anchor_q), dtype=torch.float64, device=state.device)
    for shown in state.views.spread(VIEWS):
        view = shown.view
        with torch.no_grad():
            image = render(model, 0, view.time, view.camera, rounding).image
        rest = at_rest(shown, shown.exposed(image)).weights
        errors = [
            omission_error(model, 0, view.time, view.camera, generator, weights=weights, rounding=rounding)[0]
            for weights in (rest, shown.weights - rest)
        ]
        still, moves = still + errors[0], moves + errors[1]
    return (moves > still).cpu()
