"""The run of a training: steps until its end, its time limit or a signal; log, curve of quality, checkpoints."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train import pruning
from pd4dgs_codec.train.config import COARSE_SHARE, DEFAULT_ITERATIONS, PRUNING_ROUNDS, Schedule, TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.log import RecordLog
from pd4dgs_codec.train.stop import StopRequest

#: Steps timed before a run with a time limit fixes N, and the share of the limit that N is meant to fill.
TIMED_STEPS = 50
TIME_SHARE = 0.95
#: Mean cost of a step over a run against the one measured at its start (more anchors, fewer visible Gaussians). It was
#: 0.35 to 1.4 on the scenes measured: a run that ends early is better than one that is cut.
LATER_COST = 1.4
#: N is at least so much: where a limit is nearly spent the run is cut and says so, instead of squeezing the schedule.
LEAST_TIMED_TOTAL = 10 * TIMED_STEPS
#: Rehearsals of a step per level from which its cost is taken, and what an update, which is not in them, adds to it.
REHEARSALS = 9
UPDATE_COST = 1.1
#: Held-out evaluations over a run, for the curve of quality against wall time, and views in each.
CURVE_POINTS = 12
CURVE_VIEWS = 6


class Progress(Protocol):
    """What a run tells of its steps to whoever watches."""

    def update(self, trainer: Trainer, record: dict[str, Any]) -> None:
        """Called after every step with its log record."""

    def close(self) -> None:
        """Called once, after the last step or what ended the run."""


class Trainer:
    """A run in progress; `run` carries it to its end.

    learner: the model and its steps. seconds: of training, those before a resumption included. curve: quality against
    time, a row for each evaluation. interrupted: a signal ended the last `run`.
    """

    def __init__(self, config: TrainConfig, dataset: Dataset, device: str = "cpu", size: ModelConfig | None = None):
        """size: of the model, if not the preset's."""
        total = config.iterations or (None if config.max_seconds else DEFAULT_ITERATIONS[config.preset])
        self.config, self.dataset = config, dataset
        self.learner = Learner(config, dataset, Schedule(total), torch.device(device), size)
        self.seconds = 0.0
        self.interrupted = False
        self.curve: list[dict[str, Any]] = []

    @property
    def model(self) -> Model:
        """The model as trained so far."""
        return self.learner.model

    @property
    def iteration(self) -> int:
        """Steps done."""
        return self.learner.iteration

    @property
    def total(self) -> int | None:
        """Steps of the whole run; None where a time limit has not fixed them yet."""
        return self.learner.schedule.iterations

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.total is not None and self.iteration >= self.total

    def run(
        self, output: Path, *, log: Path | None = None, progress: Progress | None = None, save_every: float = 60.0
    ) -> None:
        """Trains to the end, to the time limit, or to Ctrl-C or SIGTERM, which end it after the step in hand and set
        `interrupted`; `output` holds a whole checkpoint then.

        A second signal raises KeyboardInterrupt at once: `output` stays as last saved. save_every: seconds. Raises
        DataError for a checkpoint that cannot be written, or for such a log, in which case the checkpoint is saved
        first.
        """
        with StopRequest() as stop:
            records = RecordLog(log)
            try:
                self._steps(output, stop, records, progress, save_every)
            finally:
                records.close()
                if progress:
                    progress.close()
            if self.config.noise and self.finished:
                self.model.round_to_steps()  # what the end of the run rendered, and what the file will hold
            self.save(output)
        self.interrupted = stop.requested
        if records.failure:
            raise records.failure

    def _steps(
        self, output: Path, stop: StopRequest, records: RecordLog, progress: Progress | None, save_every: float
    ) -> None:
        """Steps until one of the ends of `run`; a record that cannot be logged is one too."""
        start = time.monotonic() - self.seconds
        saved = time.monotonic()
        while not self.finished:
            record = self.learner.step()
            self.seconds = time.monotonic() - start
            if self.total is None and self.iteration >= TIMED_STEPS:
                record["total"] = self._fix_iterations(start)
            if self._curve_due():
                record["held_out_psnr"] = self._evaluate()
                record["plane_bits"] = self.learner.plane_bits()
                self.seconds = time.monotonic() - start
            if not records.write(record | {"seconds": round(self.seconds, 3)}):
                break
            if progress:
                progress.update(self, record)
            if time.monotonic() - saved > save_every:
                self.save(output)
                saved = time.monotonic()
            if stop.requested or (self.config.max_seconds and self.seconds >= self.config.max_seconds):
                break

    def _fix_iterations(self, start: float) -> int:
        """Fixes N from the cost of a step at each level, so that the run, which began at `start`, fills TIME_SHARE of
        its limit; see LEAST_TIMED_TOTAL. Returns N."""
        assert self.config.max_seconds
        costs = self._level_costs()
        highest = self.model.level
        later = {"all": sum(costs[: highest + 1]), "top": costs[highest]}.get(self.config.rollout, sum(costs) / 3)
        mean = COARSE_SHARE * costs[0] + (1 - COARSE_SHARE) * later
        left = TIME_SHARE * self.config.max_seconds - (time.monotonic() - start)
        left -= CURVE_POINTS * CURVE_VIEWS * sum(costs) / 3
        if self.config.prune:  # to measure a harm takes about a quarter of a step
            left -= PRUNING_ROUNDS * pruning.VIEWS * sum(costs) / 4
        total = max(LEAST_TIMED_TOTAL, self.iteration + int(left / (mean * LATER_COST)))
        self.learner.schedule = Schedule(total)
        self.config = replace(self.config, iterations=total)
        return total

    def _level_costs(self) -> list[float]:
        """Median seconds of a full step at each level, leaving the learner as it is.

        The levels take turns, so that a moment in which something else has the machine falls on all of them.
        """
        seconds: list[list[float]] = [[], [], []]
        for i in range(3 * REHEARSALS):
            before = time.monotonic()
            self.learner.rehearse(i % len(self.dataset.train), i % 3)
            seconds[i % 3].append(time.monotonic() - before)
        return [UPDATE_COST * sorted(level)[REHEARSALS // 2] for level in seconds]

    def _curve_due(self) -> bool:
        return self.total is not None and (self.iteration % max(1, self.total // CURVE_POINTS) == 0 or self.finished)

    def _evaluate(self) -> list[float]:
        """Mean PSNR per level on a few held-out views (training views if none are held out)."""
        views = self.dataset.test or self.dataset.train
        psnr = self.learner.level_psnr(views[:: max(1, len(views) // CURVE_VIEWS)][:CURVE_VIEWS])
        self.curve.append({"iteration": self.iteration, "seconds": self.seconds, "psnr": psnr})
        return psnr

    def save(self, path: Path) -> None:
        """Writes the checkpoint with all that resuming needs."""
        training = {
            "config": json.dumps(self.config, default=vars),
            "source": self.dataset.name,
            "seconds": self.seconds,
            "curve": json.dumps(self.curve),
        }
        checkpoint.save(path, self.model, training | self.learner.state())

    def resume(self, path: Path) -> None:
        """Goes on from a checkpoint of the same configuration and data.

        TrainError if it holds no training state, DataError if that state is broken or of other data.
        """
        model, training = checkpoint.load(path)
        if "optimiser" not in training:
            raise TrainError(f"{path}: holds no training state (it was decoded or stripped); cannot resume from it")
        try:
            self.learner.restore(model, training)
            self.seconds, self.curve = float(training["seconds"]), list(json.loads(training["curve"]))
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())  # torch explains itself over several lines
            raise DataError(f"{path}: its training state cannot be read: {reason}") from None
        order, count = self.learner.order, len(self.dataset.train)
        if not all(0 <= index < count for index in order):
            raise DataError(
                f"{path}: its next views are {order[:8]}, found {count} training views; expected the same data"
            )
