"""Selection of levels: a level of little use is removed for the rest of the run.

A level is compared with the level below on views held back from training, because every level gains on training views.
Before, the level below, which has had few steps of its own, is trained alone: on a static scene, level 1 is then no
better. Only pixels that the level changes are compared, so that small objects count as much as large ones.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import render
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.initialise import TIED
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.state import TrainingView, TrainState

#: One in EVERY training views is held back until levels are selected, if these are at least MIN_VIEWS.
EVERY = 16
MIN_VIEWS = 4
#: Levels that move stay if their gains sum to MIN_GAIN_1 dB. Shorter runs, which learn fast motion incompletely, need
#: less in proportion, from 0 at the first of LEARNING steps to all of it at the second. Level 2 must also gain
#: MIN_GAIN_2 dB and SHARE_2 of its gain over level 0.
MIN_GAIN_1, LEARNING, SHARE_2, MIN_GAIN_2 = 1.5, (300, 1160), 0.15, 0.5
#: A gain counts the pixels in which the level changes a colour by MIN_CONTRAST; if there are fewer than this, it is 0.
MIN_CONTRAST, MIN_PIXELS = 0.02, 32
#: Steps for which the level below is trained before: a share of the run, and the fewest for levels 0 and 1. In short
#: runs level 0 needs more, or level 1 gains on static scenes too.
PRACTICE, MIN_PRACTICE = 1 / 10, (150, 75)

#: A timed run of fewer steps keeps its levels: fast motion is not learnt by then, and nobody asked for so few.
MIN_TIMED = 1000


class SelectLevels(phases.Phase):
    """Removes the levels of little use, where planes and weights begin to be rounded.

    practise: trains a level on trial for a number of steps. left_out: for each removed level, the level, its gain in
    dB in the pixels that it changes, and the number of views.
    """

    def __init__(self, practise: Callable[[int, int], None]) -> None:
        self._practise = practise
        self.left_out: list[dict[str, Any]] = []

    def due(self, state: TrainState) -> bool:
        """At `Schedule.rounding`, if views are held back for it and a timed run has not become too slow."""
        selects = state.reached(state.schedule.rounding) and bool(held_back_views(state))
        return selects and (state.share is None or state.steps_in(1.0) >= MIN_TIMED)

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Removes levels from the highest down, until one stays."""
        gains: list[float] = []
        record["level_gains"] = gains
        while state.model.level:
            level, views = state.model.level, [state.views[index] for index in sorted(held_back_views(state))]
            above = max([0.0, *(row["gain"] for row in self.left_out)])  # also before the run was resumed
            gain, needed = self._gain(state, level, views, above)
            tested, stays = {level: gain}, gain >= needed
            if stays and level == 2 and gain < motion_gain(state.steps_in(1.0)):  # level 1 has to show the rest
                tested[1], needed = self._gain(state, 1, views, gain)
                stays = tested[1] >= needed
            gains += tested.values()
            if stays:
                break
            for level, gain in tested.items():
                drop_level(state.model, state.optimiser, level)
                self.left_out.append({"level": level, "gain": gain, "views": len(views)})
        record["left_out"] = self.left_out

    def _gain(self, state: TrainState, level: int, views: list[TrainingView], above: float) -> tuple[float, float]:
        """(the gain of `level` over the level below after a trial, dB in the pixels that it changes; the gain that it
        needs to stay). The state is restored if the level stays. above: the gain of the level above."""
        below = max(layer for layer in (0, *state.model.deformations) if layer < level)
        pictures = [images(state, view, (below, level)) for view in views]
        acts, with_it = [changes(*pair) for pair in pictures], [shown for _, shown in pictures]

        def gain_over(other: int) -> float:
            return gain_in(views, acts, [images(state, view, (other,))[0] for view in views], with_it)

        needed = motion_gain(state.steps_in(1.0)) - above
        if level == 2:
            needed = max(MIN_GAIN_2, SHARE_2 * workers.alike(lambda: gain_over(0)))
        if workers.alike(lambda: sum(int(mask.sum()) for mask in acts)) < MIN_PIXELS:
            return 0.0, needed

        before, logits = state.snapshot(), state.model.mask_logits
        with torch.no_grad():
            logits[:, below] += softplus(logits[:, level])  # the anchors of the level, without its motion
        gain = math.inf
        try:
            self._practise(below, max(MIN_PRACTICE[below], state.steps_in(PRACTICE)))
            gain = workers.alike(lambda: gain_over(below))
        finally:  # a picture that is not finite ends the phase, and the level stays
            if gain >= needed:
                state.return_to(before)
        return gain, needed

    def stored(self) -> dict[str, Any]:
        """left_out, as JSON."""
        return {"left_out": json.dumps(self.left_out)}

    def restore(self, stored: Mapping[str, Any]) -> None:
        self.left_out = list(json.loads(stored["left_out"]))


def motion_gain(steps: int) -> float:
    """The gain in dB that the levels that move need together in a run of so many steps."""
    first, last = LEARNING
    return MIN_GAIN_1 * min(max((steps - first) / (last - first), 0.0), 1.0)


@torch.no_grad()
def images(state: TrainState, view: TrainingView, levels: Sequence[int]) -> list[Tensor]:
    """The pictures [H, W, 3] of a view at these levels, rounded as at this position, without noise."""
    rounding = state.rounding(noisy=False)
    return [render(state.model, level, view.view.time, view.view.camera, rounding).image for level in levels]


def changes(without: Tensor, with_it: Tensor) -> Tensor:
    """bool [H, W]: the pixels in which a colour differs by MIN_CONTRAST or more between two pictures."""
    return (without - with_it).abs().amax(-1) >= MIN_CONTRAST


def gain_in(
    views: Sequence[TrainingView], where: Sequence[Tensor | None], without: Sequence[Tensor], with_it: Sequence[Tensor]
) -> float:
    """The gain in dB, in squared error, of the pictures `with_it` over the pictures `without`, one of each per view, in
    the pixels `where`, bool [H, W]; None: in all."""
    first, second = (
        sum(view.squared_error(image.clamp(0, 1), mask) for view, mask, image in zip(views, where, drawn, strict=True))
        for drawn in (without, with_it)
    )
    return 10 * math.log10(max(first, 1e-9) / max(second, 1e-9))


def held_back_views(state: TrainState) -> set[int]:
    """Indices of the training views that select levels and are unseen until then; none if no level is selected or the
    length of the run is not known yet."""
    config = state.config
    selects = not config.keep_layers and config.max_layer > 0 and config.rollout != "top" and phases.long_enough(state)
    views = set(range(EVERY // 2, len(state.views), EVERY)) if selects else set()
    return views if len(views) >= MIN_VIEWS else set()


def other_views(state: TrainState) -> list[int]:
    """Indices of the training views that are not held back, ascending."""
    held_back = held_back_views(state)
    return [index for index in range(len(state.views)) if index not in held_back]


def drop_level(model: Model, optimiser: Optimiser, level: int) -> None:
    """Removes the deformation of `level` from the model and its optimiser, and ties its masks to the level below."""
    name = {1: "global_deformation", 2: "local_deformation"}[level]
    field = getattr(model, name)
    if field is not None:
        optimiser.forget(field)
        setattr(model, name, None)
    with torch.no_grad():
        model.mask_logits[:, level] = TIED
