"""The training step: draw a level and a view, render, add the level's terms, update. Phases act between steps."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import NotFinite
from pd4dgs_codec.model.config import ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import Picture, render
from pd4dgs_codec.scene import deformation_unit
from pd4dgs_codec.threads import keep_freed_memory
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.losses import ModelLoss
from pd4dgs_codec.train.phases import Phase
from pd4dgs_codec.train.phases.follow import Follow
from pd4dgs_codec.train.phases.grow import Grow
from pd4dgs_codec.train.phases.levels import SelectLevels
from pd4dgs_codec.train.phases.matching import Match
from pd4dgs_codec.train.phases.opening import OpenTime, few_instants
from pd4dgs_codec.train.phases.prefixes import Prefixes
from pd4dgs_codec.train.phases.prune import Prune
from pd4dgs_codec.train.phases.quantisation import FitQuantisation
from pd4dgs_codec.train.rollout import draw_levels, next_view, updated_rho, without_motion
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS, Schedule
from pd4dgs_codec.train.ssim import image_loss
from pd4dgs_codec.train.state import TrainState


class Learner(TrainState):
    """A model in training, with its steps.

    before_step: the phases that act before a step, in order; `grow` acts after the update. spent: seconds of each, with
    its trials, by the name of its module, since this process began.
    before_practice: called before each trial step with the trial steps done and their total; an exception ends the
    trial.
    """

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        schedule: Schedule,
        device: torch.device,
        size: ModelConfig | None = None,
        start: Model | None = None,
    ):
        """As `TrainState`."""
        keep_freed_memory()
        if device.type == "cuda":  # TF32 is too coarse for SSIM's variances, differences of blurred images
            torch.backends.cudnn.allow_tf32 = False
        super().__init__(config, dataset, schedule, device, size, start)
        self.unit = float(deformation_unit(self.model.info.box))  #: of lengths in the loss, scene units
        self.model_loss = ModelLoss(config, self.generator)
        self.levels, self.prefixes, self.grow = SelectLevels(self.practise), Prefixes(), Grow()
        self.match, self.spent = Match(), defaultdict[str, float](float)
        self.before_practice: Callable[[int, int], None] = lambda done, steps: None
        pruning = (Prune(turn) for turn in range(PRUNING_ROUNDS))
        self.before_step: list[Phase] = [
            Follow(),
            OpenTime(self.practise),
            self.match,
            self.levels,
            FitQuantisation(),
            *pruning,
            self.prefixes,
        ]

    def step(self) -> dict[str, Any]:
        """Performs a training step and returns its log record, with unweighted loss terms."""
        record: dict[str, Any] = {"iteration": self.iteration}
        self._apply(self.before_step, record)
        levels, record["pi"] = draw_levels(self)
        record["level"] = levels[-1]
        if (only := self.prefixes.draw(self, levels[-1])) is not None:
            record["prefix"] = int(only.sum())
        drawn = [(next_view(self, level), level) for level in levels for _ in range(self.config.views_per_step)]
        if not self._learn(drawn, record, only):
            self.skipped += 1
            record["skipped"] = self.skipped
        self.optimiser.zero_grad()
        self._measure(record)
        return record

    def practise(self, level: int, steps: int) -> None:
        """Trains `level` on trial for `steps` steps at the present position of the schedule. Nothing is grown."""
        self.practising = True
        try:
            for done in range(steps):
                self.before_practice(done, steps)
                self._learn([(next_view(self, level), level) for _ in range(self.config.views_per_step)], {}, None)
                self.optimiser.zero_grad()
        finally:
            self.practising = False

    def _apply(self, phases: Sequence[Phase], record: dict[str, Any]) -> None:
        for phase in phases:
            if phase.due(self):
                begun = time.monotonic()
                with suppress(NotFinite):  # skipped like a step that diverged
                    phase.apply(self, record)
                self.spent[type(phase).__module__.rpartition(".")[2]] += time.monotonic() - begun

    # -- loss and update -------------------------------------------------------------------------------------------

    def _learn(self, drawn: list[tuple[int, int]], record: dict[str, Any], only: Tensor | None) -> bool:
        """Computes losses and gradients of (view, level) pairs and updates the model. Returns False, with the model
        unchanged, if a value is not finite. Each worker renders its share of the pairs and records its last one.
        only: bool [N], the anchors to render, if not all."""
        pictures = self._pictures(drawn, record, only)
        if workers.count() > 1:
            pictures = self._shared_gradients(pictures)
        if pictures is None:
            return False
        record["gradient_norm"] = norm = self.optimiser.clip_gradients(self.config.max_gradient_norm)
        if not math.isfinite(norm):
            return False
        if not self.practising:
            self.grow.observe(self, pictures)
        self._update(few_instants(self))
        if not self.practising:
            self._apply([self.grow], record)
        return True

    def _update(self, instants: int | None) -> None:
        """Updates the parameters. With `instants`, the deformations' planes stay linear between so many instants."""
        confined = [] if instants is None else [(f.planes, instants) for f in self.model.deformations.values()]
        for planes, few in confined:
            planes.spread_gradients(few)
        self.optimiser.step(self.schedule.progress(self.position), self.schedule.iterations)
        self.views.centre_exposures()
        for planes, few in confined:
            planes.confine(few)

    def _pictures(
        self, drawn: list[tuple[int, int]], record: dict[str, Any], only: Tensor | None
    ) -> list[Picture] | None:
        """Renders this worker's share of the pairs and sums their gradients. None if a value is not finite."""
        pictures = []
        seeds: list[int | None] = [None] * len(drawn)
        if self.config.views_per_step > 1:
            seeds = torch.randint(1 << 62, (len(drawn),), generator=self.generator).tolist()
        own = list(zip(drawn, seeds, strict=True))[workers.rank() :: workers.count()]
        for (index, level), seed in own:
            earlier, state = self.optimiser.take_gradients(), self.generator.get_state()
            if seed is not None:  # a view's random numbers must not depend on its worker
                self.generator.manual_seed(seed)
                self.noise.generator.manual_seed(seed + 1)
            try:
                pictures.append(self._gather(index, level, only, record))
            except NotFinite as error:  # a diverged step can be skipped; any other error would recur
                record["refused"] = str(error)
                return None
            finally:
                if seed is not None:
                    self.generator.set_state(state)
            self.optimiser.add_gradients(earlier)  # after the view's own sum, as if another worker had rendered it
            if not math.isfinite(record["loss"]):
                return None
        return pictures

    def _gather(self, index: int, level: int, only: Tensor | None, record: dict[str, Any]) -> Picture:
        """Renders training view `index` at `level`, accumulates the gradients of its loss and records its terms.
        Raises NotFinite if the model has diverged."""
        share = 1 / self.config.views_per_step
        finish = self.model_loss.begin(self.model, level, self.schedule, self.position)
        try:
            picture, terms, loss = self.picture_loss(index, level, only)
            torch.autograd.backward(loss * share)
        finally:
            rest = finish()
        for parameter, gradient in rest.gradients:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            parameter.grad.add_(gradient.to(parameter.device), alpha=share)
        fields = self.model.deformations.values()
        if level and self.coarse:
            self.optimiser.keep_gradients(set(self.optimiser.parameters) - {p for f in fields for p in f.parameters()})
        elif level and self.guiding:
            self.optimiser.keep_gradients({p for f in fields for p in f.motion_parameters()})
        record["loss"] = float(loss.detach()) + rest.loss
        record |= {name: float(value.detach()) for name, value in terms.items()} | rest.terms
        return picture

    def _shared_gradients(self, pictures: list[Picture] | None) -> list[Picture] | None:
        """Sums the gradients over all workers. Returns None if a worker's `pictures` are None."""
        parameters = self.optimiser.parameters
        met = torch.tensor([p.grad is not None for p in parameters], dtype=torch.float32, device=self.device)
        failed = torch.full((1,), float(pictures is None), device=self.device)
        for p in parameters:
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        workers.add_up([failed, met, *(p.grad for p in parameters if p.grad is not None)])
        for p, anywhere in zip(parameters, met.tolist(), strict=True):
            p.grad = p.grad if anywhere else None
        return None if failed else pictures

    def picture_loss(
        self, index: int, level: int, only: Tensor | None = None
    ) -> tuple[Picture, dict[str, Tensor], Tensor]:
        """(picture of training view `index` at `level`, unweighted terms by name, their weighted sum).

        only: bool [N], the anchors to render, if not all. Raises NotFinite if the model has diverged.
        """
        config, shown = self.config, self.picture(index)
        picture = render(self.model, level, shown.view.time, shown.view.camera, self.rounding(), only)
        if picture.meta["means2d"].requires_grad:
            picture.meta["means2d"].retain_grad()
        image = shown.exposed(picture.image)
        if level == 0:
            shown = without_motion(self, shown, image)
        part = shown.content(picture.alpha)
        l1, dissimilarity = image_loss(image, shown.pixels[part].float() / 255, shown.weights[part], part)
        terms = {"l1": l1, "dssim": dissimilarity}
        loss = (1 - config.ssim) * l1 + config.ssim * dissimilarity
        if config.volume and len(picture.gaussians.scales):
            x, y, z = (picture.gaussians.scales / self.unit).unbind(1)  # the gradient of prod() is slow
            terms["volume"] = (x * y * z).mean()
            loss = loss + config.volume * terms["volume"]
        if (guide := self.match.term(self, level)) is not None:
            terms["match"] = guide
            loss = loss + self.match.weight(self) * guide
        return picture, terms, loss

    def _measure(self, record: dict[str, Any]) -> None:
        """Updates rho at its intervals, completes the record and counts the step."""
        measured = self.reached(self.position - self.position % self.schedule.rho_every)
        if measured and self.position >= self.schedule.progressive:
            with torch.no_grad():
                self.rho = updated_rho(self.rho, self.model.masks(0), self.model.masks(2))
        record |= {"rho": self.rho, "anchors": len(self.model.anchor_q)}
        if measured:
            record["active"] = self.active_anchors()
        if self.share is not None:
            record["position"] = self.position
        self._before = self.position
        self.iteration += 1

    # -- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """The state that a checkpoint holds besides the model, including that of the phases."""
        stored = super().state()
        for phase in self.before_step:
            stored |= phase.stored()
        return stored

    def restore(self, model: Model, state: dict[str, Any]) -> None:
        """Continues with `model` from a `state`. Raises an exception of any type if the state is broken."""
        super().restore(model, state)
        for phase in self.before_step:
            phase.restore(state)
