"""The step: draw a level and a view, render, add the level's terms, update; now and then judge, prune and grow.

Everything random comes from two generators whose states are saved, so on the CPU a resumed run repeats the
uninterrupted one bit for bit at a fixed number of iterations and threads; on CUDA sums come in any order.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import NotFinite
from pd4dgs_codec.model.config import PRESETS, ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import Picture, render, render_image
from pd4dgs_codec.model.plane_rate import exact_bits
from pd4dgs_codec.model.rounding import EXACT, Noise, Rounding
from pd4dgs_codec.quality.level_psnr import level_psnr
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.threads import keep_freed_memory
from pd4dgs_codec.train import grading, judge, prefixes, pruning, whitening, workers
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.densify import Densifier
from pd4dgs_codec.train.initialise import fresh_model
from pd4dgs_codec.train.losses import ModelLoss
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.rollout import sample_level, updated_rho
from pd4dgs_codec.train.schedule import CAPACITY_WEIGHTED, TOP, UNIFORM, Schedule, rollout_probabilities
from pd4dgs_codec.train.shot import Shots
from pd4dgs_codec.train.ssim import image_loss

Probabilities = tuple[float, float, float]  #: of levels 0, 1, 2


class Learner:
    """A model in training, with all that its steps change.

    schedule: the phases of the run; replaced once where a time limit settles its unit after some steps.
    share: in a run that a time limit ends, how much of the schedule lies behind it, 0..1, which whoever holds the clock
    says; None where the number of steps says it.
    iteration: steps done, those that were skipped included. skipped: those whose loss or gradient was not finite.
    left_out: levels judged not to pay, as the log and the report have them: level, gain in dB, number of views.
    """

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        schedule: Schedule,
        device: torch.device,
        size: ModelConfig | None = None,
    ):
        """A fresh model for `dataset`, of the preset's size if no other is given."""
        keep_freed_memory()
        size = size or PRESETS[config.preset]
        self.config, self.dataset, self.schedule, self.device = config, dataset, schedule, device
        if device.type == "cuda":  # the variances of SSIM are differences of blurred images: no ten-bit factors
            torch.backends.cudnn.allow_tf32 = False
        steps = config.model_steps(size.steps)
        model = fresh_model(size, dataset, config.widths, steps, config.seed, config.max_layer)
        self.model = model.to(device)
        self.optimiser = Optimiser(self.model, config.rates, config.cooldown)
        self.densifier = Densifier(self.model, config.grow_threshold, size.max_anchors)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = Noise(config.seed + 1, device)
        self.model_loss = ModelLoss(config, self.generator)
        self.shots = Shots(dataset.train, device)
        self.iteration = 0
        self.share: float | None = None
        self._passed = -1  #: `place` of the step before, which a share may leave behind by more than one
        self.rho = 0.0
        self.skipped = 0
        self.order: list[int] = []  #: training views drawn and not yet learnt from, the next one last
        self.left_out: list[dict[str, Any]] = []
        self.rank: Tensor | None = None  #: of the anchors in a file, float64 [N], once `prefixes` are trained

    @property
    def place(self) -> int:
        """Where the next step stands in its schedule, 0..N: the steps done, or the share of N."""
        return self.iteration if self.share is None else int(self.share * (self.schedule.iterations or 0))

    def _reached(self, start: float) -> bool:
        """Whether this step is the first at or past place `start`."""
        return (self.place - 1 if self.share is None else self._passed) < start <= self.place

    def _reached_multiple(self, every: float) -> bool:
        """Whether this step is the first at or past some multiple of `every`."""
        return self._reached(self.place - self.place % every)

    def step(self, levels: Sequence[int] | None = None) -> dict[str, Any]:
        """One training step; returns its log record (every term unweighted). levels: those to train, ascending, each on
        views of its own; None draws what the rollout says."""
        judged = self._judge_levels()
        graded = self._grade()
        left = self._prune()
        self._rank()
        only = self._draw_prefix() if levels is None else None
        if only is not None:
            levels = (0,)
        chosen, probabilities = self._draw_levels() if levels is None else _given(levels)
        drawn = [(self._next_view(), level) for level in chosen for _ in range(self.config.views_per_step)]
        record: dict[str, Any] = {"iteration": self.iteration, "level": chosen[-1]}
        if judged:
            record |= {"judged_psnr": judged, "left_out": self.left_out}
        if graded:
            record["step_classes"] = graded
        if left:
            record["left_model"], record["left_level_0"] = left
        if only is not None:
            record["prefix"] = int(only.sum())
        if not self._learn(drawn, record, only):
            self.skipped += 1
            record["skipped"] = self.skipped
        self.optimiser.zero_grad()
        measured = self._reached_multiple(self.schedule.rho_every)
        if measured and self.place >= self.schedule.rho_start:
            with torch.no_grad():
                self.rho = updated_rho(self.rho, self.model.masks(0), self.model.masks(2))
        record |= {"rho": self.rho, "pi": probabilities, "anchors": len(self.model.anchor_q)}
        if measured:
            record["active"] = self.active_anchors()
        if self.share is not None:
            record["place"] = self.place
        self._passed = self.place
        self.iteration += 1
        return record

    def active_anchors(self) -> list[int]:
        """Anchors active per level 0, 1, 2."""
        with torch.no_grad():
            return [int((self.model.masks(level) > MASK_THRESHOLD).sum()) for level in range(3)]

    def plane_bits(self) -> list[float]:
        """The sum of R(a) of the planes of layers 1 and 2 as they would be coded now, in the groups of `--priors
        gauss`; 0 where there are none."""
        steps = self.model.steps.scaled(1.0)
        found = {i: exact_bits(f.planes.plane_arrays(), steps.planes(i)) for i, f in self.model.deformations.items()}
        return [found.get(1, 0.0), found.get(2, 0.0)]

    def level_psnr(self, views: Sequence[View]) -> list[float]:
        """Per level of the model the mean mPSNR over `views`, dB, rounded as the steps round by now, without noise."""
        rounding = replace(self._rounding(), noise=None)

        def draw(level: int, view: View) -> np.ndarray:
            return render_image(self.model, level, view.time, view.camera, rounding)

        return list(level_psnr(draw, range(self.model.level + 1), views).values())

    # -- draws -----------------------------------------------------------------------------------------------------

    def _draw_levels(self) -> tuple[tuple[int, ...], Probabilities]:
        """The levels of this step, ascending, and the probabilities that they were drawn with."""
        if self.place < self.schedule.coarse_end:
            return _given((0,))
        if self.config.rollout == "all":
            return tuple(range(self.model.level + 1)), (1.0, 1.0, 1.0)
        if self.config.rollout == "top":
            probabilities = TOP
        elif self.config.rollout == "uniform" or self.place < self.schedule.rho_start:
            probabilities = UNIFORM
        elif self.config.rollout == "fixed":
            probabilities = CAPACITY_WEIGHTED
        else:
            probabilities = rollout_probabilities(self.rho)
        return (sample_level(probabilities, self.model.level, self.generator),), probabilities

    def _next_view(self) -> int:
        if not self.order:
            waiting = self.waiting_views() if self.place < self.schedule.rounding else set()
            drawn = torch.randperm(len(self.shots), generator=self.generator).tolist()
            self.order = [index for index in drawn if index not in waiting]
        return self.order.pop()

    def _rounding(self) -> Rounding:
        if not self.config.noise:
            return EXACT
        exact = self.place >= self.schedule.exact_rounding
        noisy = self.place >= self.schedule.coarse_end and not exact
        weights = self.place >= self.schedule.rounding
        return Rounding(self.noise if noisy else None, attributes=exact, weights=weights)

    # -- loss and update -------------------------------------------------------------------------------------------

    def _learn(self, drawn: list[tuple[int, int]], record: dict[str, Any], only: Tensor | None) -> bool:
        """Losses of (view, level) pairs, gradients, update; False, with nothing changed, if any of it is not finite.
        The record is that of the last pair of this worker, which takes every Nth where there are N. only: the anchors
        to render, bool [N], if not all."""
        pictures = self._pictures(drawn, record, only)
        if workers.count() > 1:
            pictures = self._shared_gradients(pictures)
        if pictures is None:
            return False
        record["gradient_norm"] = norm = self.optimiser.gradient_norm()
        if not math.isfinite(norm):
            return False
        if norm > self.config.max_gradient_norm:
            self.optimiser.scale_gradients(self.config.max_gradient_norm / norm)
        self._update(pictures, record)
        return True

    def _pictures(
        self, drawn: list[tuple[int, int]], record: dict[str, Any], only: Tensor | None
    ) -> list[Picture] | None:
        """The pictures of this worker's share of the pairs, their gradients gathered; None if one is not finite."""
        pictures = []
        seeds: list[int | None] = [None] * len(drawn)
        if self.config.views_per_step > 1:
            seeds = torch.randint(1 << 62, (len(drawn),), generator=self.generator).tolist()
        own = list(zip(drawn, seeds, strict=True))[workers.rank() :: workers.count()]
        for (index, level), seed in own:
            earlier = self.optimiser.take_gradients()
            try:
                with self._drawing_from(seed):
                    pictures.append(self._gather(index, level, only, record))
                self.optimiser.add_gradients(earlier)  # those of a view are summed first, as a worker's are
            except NotFinite as error:  # a diverged step may be passed over; any other refusal is here to stay
                record["refused"] = str(error)
                return None
            if not math.isfinite(record["loss"]):
                return None
        return pictures

    def _gather(self, index: int, level: int, only: Tensor | None, record: dict[str, Any]) -> Picture:
        """The picture of training view `index` at `level`, the gradients of its loss gathered and the terms in the
        record. Raises NotFinite where the model has diverged."""
        rounding, share = self._rounding(), 1 / self.config.views_per_step
        beside = self.model_loss.begin(self.model, level, self.schedule, self.place)
        try:
            picture, terms, loss = self.picture_loss(index, level, rounding, only)
            torch.autograd.backward(loss * share)
        finally:
            rest = beside()
        for parameter, gradient in rest.gradients:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            parameter.grad.add_(gradient, alpha=share)
        record["loss"] = float(loss.detach()) + rest.loss
        record |= {name: float(value.detach()) for name, value in terms.items()} | rest.terms
        return picture

    @contextmanager
    def _drawing_from(self, seed: int | None) -> Iterator[None]:
        """What is random in the loss of one of several views follows its seed, whichever worker it falls to."""
        if seed is None:
            yield
            return
        state = self.generator.get_state()
        self.generator.manual_seed(seed)
        self.noise.generator.manual_seed(seed + 1)
        try:
            yield
        finally:
            self.generator.set_state(state)

    def _shared_gradients(self, pictures: list[Picture] | None) -> list[Picture] | None:
        """Sums the gradients of all workers; None where any of them has met what is not finite."""
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
        self, index: int, level: int, rounding: Rounding, only: Tensor | None = None
    ) -> tuple[Picture, dict[str, Tensor], Tensor]:
        """(picture of training view `index` at `level`, terms unweighted and by name, their weighted sum).

        only: the anchors to render, bool [N], if not all. Raises NotFinite where the model has diverged.
        """
        config, shot = self.config, self.shots[index]
        view = shot.view
        picture = render(self.model, level, view.time, view.camera, rounding, only)
        if picture.meta["means2d"].requires_grad:
            picture.meta["means2d"].retain_grad()
        l1, dissimilarity = image_loss(picture.image, shot.target)
        terms = {"l1": l1, "dssim": dissimilarity}
        loss = (1 - config.ssim) * l1 + config.ssim * dissimilarity
        if config.volume and len(picture.gaussians.scales):
            x, y, z = picture.gaussians.scales.unbind(1)  # the gradient of prod() looks for zeros
            terms["volume"] = (x * y * z).mean()
            loss = loss + config.volume * terms["volume"]
        return picture, terms, loss

    def _update(self, pictures: list[Picture], record: dict[str, Any]) -> None:
        """Adam; and while anchors grow, what growing goes by and the growing itself."""
        growing, known = self.schedule.grow, self.schedule.iterations is not None
        if known and self.place <= growing.stop:
            before = self.densifier.state()
            if workers.count() > 1:
                self.densifier.load_state({name: torch.zeros_like(value) for name, value in before.items()})
            for picture in pictures:
                self._observe(picture)
            if workers.count() > 1:
                seen = self.densifier.state()
                workers.add_up(list(seen.values()))
                self.densifier.load_state({name: before[name] + value for name, value in seen.items()})
        self.optimiser.step(self.schedule.progress(self.place))
        if any(map(self._reached, growing)):
            pruned, grown = self.densifier.adjust(
                self.model,
                self.optimiser,
                self.generator,
                grow=len(self.model.anchor_q) < self.densifier.max_anchors,
                prune=self.place >= self.schedule.coarse_end,  # before, colours are random and opacities fall
            )
            record |= {"pruned": pruned, "grown": grown}

    def _observe(self, picture: Picture) -> None:
        gradient = picture.meta["means2d"].grad
        if gradient is not None and len(picture.gaussians.slots):
            drawn = (picture.meta["radii"][0] > 0).all(-1)
            height, width = picture.alpha.shape
            pull = gradient[0] * self.config.views_per_step  # as if the loss were of this view alone
            self.densifier.observe(picture.gaussians, pull, drawn, width, height)

    # -- what happens once or a few times in a run -------------------------------------------------------------------

    def waiting_views(self) -> set[int]:
        """Training views that wait until the levels are judged; none where N is not known yet, or nothing to judge."""
        judged = self.config.judge and self.config.max_layer > 0 and self.config.rollout != "top"
        return judge.waiting_views(len(self.shots), self.schedule.iterations or 0) if judged else set()

    def _judge_levels(self) -> list[float]:
        """Where the last third begins: leaves out the levels that do not pay. Returns the PSNR per level judged by."""
        waiting = sorted(self.waiting_views()) if self._reached(self.schedule.rounding) else []
        if not waiting:
            return []
        psnr = workers.alike(lambda: self.level_psnr([self.dataset.train[index] for index in waiting]))
        fields, bits = self.model.deformations, [0.0, *self.plane_bits()]
        sizes = [judge.field_bytes(fields[i], bits[i]) if i in fields else 0.0 for i in range(3)]
        found = judge.levels_without_gain(psnr, sizes)
        for level, _ in found:
            judge.drop_level(self.model, self.optimiser, level)
        self.left_out = [{"level": level, "gain": gain, "views": len(waiting)} for level, gain in found]
        return psnr

    def _prune(self) -> list[int]:
        """Where growing has ended: takes out what the pictures hardly need, in a few rounds. Returns how many anchors
        left the model and how many left layer 0."""
        if not self.config.prune or (self.schedule.iterations or 0) < pruning.MIN_ITERATIONS:
            return []
        rounds = [self._prune_round(turn) for turn, start in enumerate(self.schedule.prune) if self._reached(start)]
        return [sum(column) for column in zip(*filter(None, rounds), strict=True)]

    def _prune_round(self, turn: int) -> tuple[int, ...]:
        waiting = self.waiting_views()
        order = [i for i in range(len(self.shots)) if i not in waiting]
        stride = -(-len(order) // pruning.VIEWS)
        shots = [self.shots[i] for i in order[turn % stride :: stride]]
        before, share = len(self.model.anchor_q), self.config.prune / len(self.schedule.prune)
        try:
            keep, later = pruning.prune(
                self.model, self.optimiser, shots, self._levels(), share, turn, self._rounding()
            )
        except NotFinite:  # as a step that diverged: passed over, with nothing changed
            return ()
        self.densifier.keep(keep)
        return before - len(keep), later

    def _grade(self) -> list[int]:
        """Where planes and weights begin to be rounded: mixes the features' channels and gives anchors their step
        classes. Returns how many each has."""
        enough = (self.schedule.iterations or 0) >= pruning.MIN_ITERATIONS
        if not (self.config.noise and enough and self._reached(self.schedule.rounding)):
            return []
        stride = -(-len(self.shots) // grading.VIEWS)
        levels = self._levels()
        rounding, shots, found = replace(self._rounding(), noise=None), self.shots[::stride], list[int]()
        try:
            if self.config.grading:
                found = grading.grade(self.model, shots, levels, self.config.grading, rounding)
            if self.config.whitening:
                whitening.whiten(self.model, self.optimiser, shots, levels, rounding)
                if self.config.grading:  # a step of the features is another one now
                    found = grading.grade(self.model, shots, levels, self.config.grading, rounding)
        except NotFinite:  # as a step that diverged: passed over
            return []
        return found

    def _levels(self) -> range:
        """Those that the run trains."""
        return range(self.model.level if self.config.rollout == "top" else 0, self.model.level + 1)

    def _rank(self) -> None:
        """Where the last third begins, if prefixes are to be trained: the order of the anchors in a file."""
        if self.config.prefixes and self._reached(self.schedule.rounding):
            try:
                self.rank = workers.alike(lambda: prefixes.rank_anchors(self.model, self.dataset.train))
            except NotFinite:  # as a step that diverged: passed over
                pass

    def _draw_prefix(self) -> Tensor | None:
        """The anchors that this step sees, bool [N]; None if it is all."""
        if self.rank is None or float(torch.rand((), generator=self.generator)) >= self.config.prefixes:
            return None
        return prefixes.draw_prefix(self.rank, self.generator).to(self.device)

    # -- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds besides the model, so that the steps after it are the same."""
        return {
            "iteration": self.iteration,
            "total": self.schedule.iterations or 0,
            "place": self.place,
            "share": self.share or 0.0,
            "passed": self._passed,
            "rho": self.rho,
            "skipped": self.skipped,
            "order": self.order,
            "rank": torch.empty(0) if self.rank is None else self.rank,
            "left_out": json.dumps(self.left_out),
            "optimiser": self.optimiser.state(),
            "densifier": self.densifier.state(),
            "generator": self.generator.get_state(),
            "noise": self.noise.generator.get_state(),
        }

    def restore(self, model: Model, state: dict[str, Any]) -> None:
        """Goes on with `model` from what `state` returned. A broken state raises whatever its first fault does."""
        self.model = model.to(self.device)
        self.optimiser = Optimiser(self.model, self.config.rates, self.config.cooldown)
        self.optimiser.load_state(state["optimiser"])
        self.densifier.load_state(state["densifier"])
        self.generator.set_state(state["generator"])
        self.noise.generator.set_state(state["noise"])
        self.iteration, self.skipped = int(state["iteration"]), int(state["skipped"])
        self.schedule = Schedule(int(state["total"]) or None)
        if self.share is not None:
            self.share, self._passed = float(state.get("share", 0.0)), int(state.get("passed", -1))
        self.rho = float(state["rho"])
        self.order = [int(index) for index in state["order"]]
        self.left_out = list(json.loads(state.get("left_out", "[]")))
        rank = state.get("rank")
        self.rank = rank if rank is not None and len(rank) else None


def _given(levels: Sequence[int]) -> tuple[tuple[int, ...], Probabilities]:
    """Levels that are not left to chance, and the probabilities that say so."""
    first, second, third = (float(level in levels) for level in range(3))
    return tuple(levels), (first, second, third)
