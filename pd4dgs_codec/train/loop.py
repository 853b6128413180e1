"""The training loop. One step: draw a view and a level, render, add the level's terms, update; now and then grow.

Everything random comes from one generator whose state is saved, so on the CPU a resumed run repeats the uninterrupted
one bit for bit at a fixed number of iterations and threads; on CUDA sums come in any order.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.dataset import Dataset, View
from pd4dgs_codec.errors import DataError, NotFinite, TrainError
from pd4dgs_codec.jsonable import finite
from pd4dgs_codec.metrics.image import mpsnr
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.picture import Picture, render, render_image
from pd4dgs_codec.model.rounding import EXACT, Noise, Rounding
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import judge, losses, pruning
from pd4dgs_codec.train.config import DEFAULT_ITERATIONS, PRUNING_ROUNDS, PlaneWeights, Schedule, TrainConfig
from pd4dgs_codec.train.densify import Densifier
from pd4dgs_codec.train.initialise import fresh_model
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.rollout import CAPACITY_WEIGHTED, TOP, UNIFORM, rollout_probabilities, sample_level, updated_rho
from pd4dgs_codec.train.ssim import TargetStats, image_loss
from pd4dgs_codec.train.stop import StopRequest

#: Steps timed before a run with a time limit fixes N, and the share of the limit that N is meant to fill.
TIMED_STEPS = 50
TIME_SHARE = 0.95
#: Mean cost of a step over a run against the one measured at its start (more anchors, fewer visible Gaussians). It was
#: 0.35 to 1.4 on the scenes measured: a run that ends early is better than one that is cut.
LATER_COST = 1.4
#: N is at least so much: where a limit is nearly spent the run is cut and says so, instead of squeezing the schedule.
LEAST_TIMED_TOTAL = 10 * TIMED_STEPS
#: Held-out evaluations over a run, for the curve of quality against wall time, and views in each.
CURVE_POINTS = 12
CURVE_VIEWS = 6


class Trainer:
    """A run in progress; `run` carries it to its end. interrupted: a signal ended the last `run`."""

    def __init__(self, config: TrainConfig, dataset: Dataset, device: str = "cpu"):
        preset = PRESETS[config.preset]
        self.config, self.dataset, self.device = config, dataset, torch.device(device)
        if self.device.type == "cuda":  # the variances of SSIM are differences of blurred images: no ten-bit factors
            torch.backends.cudnn.allow_tf32 = False
        self.model = fresh_model(preset, dataset, config.steps or preset.steps, config.seed, config.max_layer)
        self.model.to(self.device)
        self.optimiser = Optimiser(self.model, config.rates, config.cooldown)
        self.densifier = Densifier(self.model, config.grow_threshold, preset.max_anchors)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = Noise(config.seed + 1, self.device)
        self.iteration = 0
        self.total = config.iterations or (0 if config.max_seconds else DEFAULT_ITERATIONS[config.preset])
        self.rho = 0.0
        self.skipped = 0
        self.seconds = 0.0
        self.interrupted = False
        self.curve: list[dict[str, Any]] = []
        self.order: list[int] = []
        self.left_out: list[dict[str, Any]] = []  #: levels judged not to pay, with their gain in dB
        self._targets = [self._target(view) for view in dataset.train]
        self.neighbours: losses.Neighbours | None = None  #: rebuilt when anchors come or go

    # -- the run ---------------------------------------------------------------------------------------------------

    def run(self, output: Path, *, log: Path | None = None, progress: Any = None, save_every: float = 60.0) -> None:
        """Trains to the end, to the time limit, or to Ctrl-C or SIGTERM, which end it after the step in hand and set
        `interrupted`; `output` holds a whole checkpoint then.

        A second signal raises KeyboardInterrupt at once: `output` stays as last saved. progress: an object with
        `.update(trainer, record)` and `.close()`, or None. save_every: seconds. Raises DataError for a checkpoint that
        cannot be written, or for such a log, in which case the checkpoint is saved first.
        """
        with StopRequest() as stop:
            stream = _open_log(log) if log else None
            try:
                failure = self._steps(output, stop, stream, progress, save_every)
            finally:
                if stream:
                    with contextlib.suppress(OSError):  # what a failed write left is lost; it has been told
                        stream.close()
                if progress:
                    progress.close()
            if self.config.noise and self.total and self.iteration >= self.total:
                self.model.round_to_steps()  # what the end of the run rendered, and what the file will hold
            self.save(output)
        self.interrupted = stop.requested
        if failure:
            raise _log_error(log, failure)

    def _steps(
        self, output: Path, stop: StopRequest, stream: TextIO | None, progress: Any, save_every: float
    ) -> OSError | None:
        """Steps until one of the ends of `run`; returns what kept a record from being logged, which is an end too."""
        start = time.monotonic() - self.seconds
        saved = time.monotonic()
        while not self.total or self.iteration < self.total:
            record = self.step()
            self.seconds = time.monotonic() - start
            if not self.total and self.iteration >= TIMED_STEPS:
                self._fix_iterations(start)
                record["total"] = self.total
            if self._curve_due():
                record["held_out_psnr"] = self._evaluate()
                self.seconds = time.monotonic() - start
            if stream and (failure := _append(stream, record | {"seconds": round(self.seconds, 3)})):
                return failure
            if progress:
                progress.update(self, record)
            if time.monotonic() - saved > save_every:
                self.save(output)
                saved = time.monotonic()
            if stop.requested or (self.config.max_seconds and self.seconds >= self.config.max_seconds):
                break
        return None

    def step(self) -> dict[str, Any]:
        """One training step; returns its log record (every term unweighted)."""
        schedule = Schedule(self.total or 10**9)
        judged = self._judge_levels(schedule)
        left = self._prune(schedule)
        levels, probabilities = self._draw_levels(schedule)
        drawn = [(self._next_view(schedule), level) for level in levels]
        rounding = self._rounding(schedule)
        record: dict[str, Any] = {"iteration": self.iteration, "level": levels[-1]}
        if judged:
            record |= {"judged_psnr": judged, "left_out": self.left_out}
        if left:
            record["left_model"], record["left_level_0"] = left
        if not self._learn(drawn, schedule, rounding, record):
            self.skipped += 1
            record["skipped"] = self.skipped
        self.optimiser.zero_grad()
        if self.iteration >= schedule.rho_start and self.iteration % schedule.rho_every == 0:
            with torch.no_grad():
                self.rho = updated_rho(self.rho, self.model.masks(0), self.model.masks(2))
        record |= {"rho": self.rho, "pi": probabilities, "anchors": len(self.model.anchor_q)}
        if self.iteration % schedule.rho_every == 0:
            record["active"] = self.active_anchors()
        self.iteration += 1
        return record

    def active_anchors(self) -> list[int]:
        """Anchors active per level 0, 1, 2."""
        with torch.no_grad():
            return [int((self.model.masks(level) > MASK_THRESHOLD).sum()) for level in range(3)]

    # -- parts of a step -------------------------------------------------------------------------------------------

    def _learn(
        self, drawn: list[tuple[int, int]], schedule: Schedule, rounding: Rounding, record: dict[str, Any]
    ) -> bool:
        """Losses of (view, level) pairs, gradients, update; False, with nothing changed, if any of it is not finite.
        The record is that of the last pair."""
        pictures = []
        for index, level in drawn:
            try:
                picture, terms, loss = self._loss(index, level, schedule, rounding)
            except NotFinite as error:  # a diverged step may be passed over; any other refusal is here to stay
                record["refused"] = str(error)
                return False
            record["loss"] = float(loss.detach())
            record |= {name: float(value.detach()) for name, value in terms.items()}
            loss.backward()
            pictures.append(picture)
            if not math.isfinite(record["loss"]):
                return False
        record["gradient_norm"] = norm = self.optimiser.gradient_norm()
        if not math.isfinite(norm):
            return False
        self._update(norm, schedule, pictures, record)
        return True

    def _loss(self, index: int, level: int, schedule: Schedule, rounding: Rounding) -> tuple[Picture, dict, Tensor]:
        config, view = self.config, self.dataset.train[index]
        picture = render(self.model, level, view.time, view.camera, rounding)
        if picture.meta["means2d"].requires_grad:
            picture.meta["means2d"].retain_grad()
        l1, dissimilarity = image_loss(picture.image, self._targets[index])
        terms = {"l1": l1, "dssim": dissimilarity}
        loss = (1 - config.ssim) * l1 + config.ssim * dissimilarity
        if config.volume and len(picture.gaussians.scales):
            terms["volume"] = picture.gaussians.scales.prod(dim=1).mean()
            loss = loss + config.volume * terms["volume"]
        fields = (
            ("global", self.model.global_deformation, config.global_planes),
            ("local", self.model.local_deformation, config.local_planes),
        )
        for name, field, weights in fields[:level]:
            if field is not None:
                loss = loss + self._plane_terms(name, field, weights, terms)
        if self.iteration >= schedule.progressive:
            loss = loss + self._level_terms(level, terms)
        return picture, terms, loss

    def _plane_terms(self, name: str, field: Any, weights: PlaneWeights, terms: dict[str, Tensor]) -> Tensor:
        total = torch.zeros((), device=self.device)
        for term, value in field.planes.regularisers().items():
            terms[f"{name}_{term}"] = value
            total = total + getattr(weights, term) * value
        return total

    def _level_terms(self, level: int, terms: dict[str, Tensor]) -> Tensor:
        config = self.config
        mask = self.model.masks(level)
        total = torch.zeros((), device=self.device)
        if config.rate_scale:
            terms["rate"] = losses.rate_term(self.model, mask, config.rate_share, self.generator)
            total = total + config.lambdas[level] * config.rate_scale * terms["rate"]
        if config.tmc_binary:
            terms["tmc_binary"] = losses.binary_term(mask)
            weight = config.tmc * config.tmc_binary_growth ** Schedule(self.total).separation(self.iteration)
            total = total + weight * terms["tmc_binary"]
        if config.tmc_smooth:
            if self.neighbours is None:
                self.neighbours = losses.Neighbours(self.model.anchor_q)
            pairs, weights = self.neighbours.draw(config.tmc_tau, self.generator)
            terms["tmc_smooth"] = losses.smooth_term(mask, pairs.to(self.device), weights.to(self.device))
            total = total + config.tmc * terms["tmc_smooth"]
        return total

    def _update(self, norm: float, schedule: Schedule, pictures: list[Picture], record: dict[str, Any]) -> None:
        if norm > self.config.max_gradient_norm:
            for group in self.optimiser.adam.param_groups:
                for p in group["params"]:
                    if p.grad is not None:
                        p.grad.mul_(self.config.max_gradient_norm / norm)
        if self.total and self.iteration <= schedule.grow.stop:
            for picture in pictures:
                self._observe(picture)
        self.optimiser.step(self.iteration / self.total if self.total else 0.0)
        if self.total and self.iteration in schedule.grow:
            room = len(self.model.anchor_q) < self.densifier.max_anchors
            pruned, grown = self.densifier.adjust(
                self.model,
                self.optimiser,
                self.generator,
                grow=room,
                prune=self.iteration >= schedule.coarse_end,  # before, colours are random and opacities fall
            )
            self.neighbours = None
            record |= {"pruned": pruned, "grown": grown}

    def _observe(self, picture: Picture) -> None:
        gradient = picture.meta["means2d"].grad
        if gradient is not None and len(picture.gaussians.slots):
            drawn = (picture.meta["radii"][0] > 0).all(-1)
            height, width = picture.alpha.shape
            self.densifier.observe(picture.gaussians, gradient[0], drawn, width, height)

    def _rounding(self, schedule: Schedule) -> Rounding:
        if not self.config.noise:
            return EXACT
        exact = self.iteration >= schedule.exact_rounding
        noisy = self.iteration >= schedule.coarse_end and not exact
        return Rounding(self.noise if noisy else None, attributes=exact, weights=self.iteration >= schedule.rounding)

    def _draw_levels(self, schedule: Schedule) -> tuple[tuple[int, ...], tuple[float, float, float]]:
        """The levels of this step, ascending, and the probabilities that they were drawn with."""
        if self.iteration < schedule.coarse_end:
            return (0,), (1.0, 0.0, 0.0)
        if self.config.rollout == "all":
            return tuple(range(self.model.level + 1)), (1.0, 1.0, 1.0)
        if self.config.rollout == "top":
            probabilities = TOP
        elif self.config.rollout == "uniform" or self.iteration < schedule.rho_start:
            probabilities = UNIFORM
        elif self.config.rollout == "fixed":
            probabilities = CAPACITY_WEIGHTED
        else:
            probabilities = rollout_probabilities(self.rho)
        return (sample_level(probabilities, self.model.level, self.generator),), probabilities

    def _next_view(self, schedule: Schedule) -> int:
        if not self.order:
            waiting = self._waiting_views() if self.iteration < schedule.rounding else set()
            drawn = torch.randperm(len(self.dataset.train), generator=self.generator).tolist()
            self.order = [index for index in drawn if index not in waiting]
        return self.order.pop()

    def _waiting_views(self) -> set[int]:
        """Training views that wait until the levels are judged; none where N is not known yet, or nothing to judge."""
        judged = self.config.judge and self.config.max_layer > 0 and self.config.rollout != "top"
        return judge.waiting_views(len(self.dataset.train), self.total) if judged else set()

    def _judge_levels(self, schedule: Schedule) -> list[float]:
        """Where the last third begins: leaves out the levels that do not pay. Returns the PSNR per level judged by."""
        waiting = sorted(self._waiting_views()) if self.iteration == schedule.rounding else []
        if not waiting:
            return []
        psnr = self._level_psnr([self.dataset.train[index] for index in waiting])
        found = judge.levels_without_gain(psnr)
        for level, _ in found:
            judge.leave_out(self.model, self.optimiser, level)
        self.left_out = [{"level": level, "gain": gain, "views": len(waiting)} for level, gain in found]
        return psnr

    def _prune(self, schedule: Schedule) -> list[int]:
        """Where growing has ended: takes out what the pictures hardly need, in a few rounds. Returns how many anchors
        left the model and how many left layer 0."""
        due = self.total >= pruning.MIN_ITERATIONS and self.iteration in schedule.prune
        if not (self.config.prune and due):
            return []
        turn = schedule.prune.index(self.iteration)
        waiting, views = self._waiting_views(), self.dataset.train
        indices = [i for i in range(len(views)) if i not in waiting]
        stride = -(-len(indices) // pruning.VIEWS)
        shots = [(views[i], self._targets[i]) for i in indices[turn % stride :: stride]]
        levels = range(self.model.level if self.config.rollout == "top" else 0, self.model.level + 1)
        before, share = len(self.model.anchor_q), self.config.prune / len(schedule.prune)
        rounding = self._rounding(schedule)
        try:
            keep, later = pruning.prune(self.model, self.optimiser, shots, levels, share, turn, rounding)
        except NotFinite:  # as a step that diverged: passed over, with nothing changed
            return []
        self.densifier.keep(keep)
        self.neighbours = None
        return [before - len(keep), later]

    def _target(self, view: View) -> TargetStats:
        image = torch.as_tensor(view.image, device=self.device).float() / 255
        mask = None if view.mask is None else torch.as_tensor(view.mask, device=self.device).float()
        return TargetStats(image, mask)

    # -- time limit, evaluation, checkpoints -----------------------------------------------------------------------

    def _fix_iterations(self, start: float) -> None:
        """Fixes N from the cost of a step at each level, so that the run fills TIME_SHARE of its limit; see
        LEAST_TIMED_TOTAL."""
        assert self.config.max_seconds
        costs = self._level_costs()
        schedule = Schedule(1000)
        coarse = schedule.coarse_end / 1000
        highest = self.model.level
        later = {"all": sum(costs[: highest + 1]), "top": costs[highest]}.get(self.config.rollout, sum(costs) / 3)
        mean = coarse * costs[0] + (1 - coarse) * later
        left = TIME_SHARE * self.config.max_seconds - (time.monotonic() - start)
        left -= CURVE_POINTS * CURVE_VIEWS * sum(costs) / 3
        if self.config.prune:  # to measure a harm takes about a quarter of a step
            left -= PRUNING_ROUNDS * pruning.VIEWS * sum(costs) / 4
        self.total = max(LEAST_TIMED_TOTAL, self.iteration + int(left / (mean * LATER_COST)))
        self.config = replace(self.config, iterations=self.total)

    def _level_costs(self, repeats: int = 9) -> list[float]:
        """Median seconds of a full step at each level, leaving model, optimiser and generators as they are.

        The levels take turns, so that a moment in which something else has the machine falls on all of them.
        """
        states = self.generator.get_state(), self.noise.generator.get_state()
        seconds: list[list[float]] = [[], [], []]
        for i in range(3 * repeats):
            before = time.monotonic()
            _, _, loss = self._loss(i % len(self.dataset.train), i % 3, Schedule(1), Rounding(noise=self.noise))
            loss.backward()
            self.optimiser.gradient_norm()
            self.optimiser.zero_grad()
            seconds[i % 3].append(time.monotonic() - before)
        self.generator.set_state(states[0])
        self.noise.generator.set_state(states[1])
        return [1.1 * sorted(level)[repeats // 2] for level in seconds]  # the update itself is not run here

    def _curve_due(self) -> bool:
        if not self.total:
            return False
        every = max(1, self.total // CURVE_POINTS)
        return self.iteration % every == 0 or self.iteration == self.total

    def _evaluate(self) -> list[float]:
        """Mean PSNR per level on a few held-out views (training views if none are held out)."""
        views = self.dataset.test or self.dataset.train
        psnr = self._level_psnr(views[:: max(1, len(views) // CURVE_VIEWS)][:CURVE_VIEWS])
        self.curve.append({"iteration": self.iteration, "seconds": self.seconds, "psnr": psnr})
        return psnr

    def _level_psnr(self, views: Sequence[View]) -> list[float]:
        """Mean PSNR per level over `views`."""
        psnr = []
        rounding = replace(self._rounding(Schedule(self.total)), noise=None)
        for level in range(self.model.level + 1):
            images = (render_image(self.model, level, v.time, v.camera, rounding) for v in views)
            psnr.append(float(np.mean([mpsnr(i, v.image, v.mask) for i, v in zip(images, views, strict=True)])))
        return psnr

    def save(self, path: Path) -> None:
        """Writes the checkpoint with all that resuming needs."""
        checkpoint.save(
            path,
            self.model,
            {
                "config": json.dumps(_plain(self.config)),
                "source": self.dataset.name,
                "iteration": self.iteration,
                "total": self.total,
                "seconds": self.seconds,
                "rho": self.rho,
                "skipped": self.skipped,
                "order": self.order,
                "curve": json.dumps(self.curve),
                "left_out": json.dumps(self.left_out),
                "optimiser": self.optimiser.state(),
                "densifier": self.densifier.state(),
                "generator": self.generator.get_state(),
                "noise": self.noise.generator.get_state(),
            },
        )

    def resume(self, path: Path) -> None:
        """Goes on from a checkpoint of the same configuration and data.

        TrainError if it holds no training state, DataError if that state is broken or of other data.
        """
        model, training = checkpoint.load(path)
        if "optimiser" not in training:
            raise TrainError(f"{path}: holds no training state (it was decoded or stripped); cannot resume from it")
        self.model = model.to(self.device)
        self.optimiser = Optimiser(self.model, self.config.rates, self.config.cooldown)
        try:
            self._restore(training)
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())  # torch explains itself over several lines
            raise DataError(f"{path}: its training state cannot be read: {reason}") from None
        if not all(0 <= index < len(self.dataset.train) for index in self.order):
            views = f"{len(self.dataset.train)} training views"
            raise DataError(f"{path}: its next views are {self.order[:8]}, found {views}; expected the same data")

    def _restore(self, training: dict[str, Any]) -> None:
        self.optimiser.load_state(training["optimiser"])
        self.densifier.load_state(training["densifier"])
        self.generator.set_state(training["generator"])
        self.noise.generator.set_state(training["noise"])
        self.iteration, self.total, self.skipped = (int(training[k]) for k in ("iteration", "total", "skipped"))
        self.seconds, self.rho = float(training["seconds"]), float(training["rho"])
        self.order = [int(index) for index in training["order"]]
        self.curve = list(json.loads(training["curve"]))
        self.left_out = list(json.loads(training.get("left_out", "[]")))


def _plain(config: TrainConfig) -> dict[str, Any]:
    return json.loads(json.dumps(config, default=lambda value: value.__dict__))


def _open_log(path: Path) -> TextIO:
    try:
        return open(path, "a", encoding="utf-8", buffering=1)  # by lines: a failed write shows at its step
    except OSError as error:
        raise _log_error(path, error) from None


def _append(stream: TextIO, record: dict[str, Any]) -> OSError | None:
    """Writes a record as one line of JSON; returns the error if it could not."""
    try:
        stream.write(json.dumps(finite(record), allow_nan=False) + "\n")
    except OSError as error:
        return error
    return None


def _log_error(path: Path | None, error: OSError) -> DataError:
    return DataError(f"{path}: the log cannot be written: {error.strerror or error}")
