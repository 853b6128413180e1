"""The run of a training: steps until its end, its time limit or a signal; log, curve of quality, checkpoints."""

from __future__ import annotations

import json
import time
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import torch

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.threads import one_torch_thread
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.config import DEFAULT_ITERATIONS, TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.log import RecordLog
from pd4dgs_codec.train.schedule import COARSE_SHARE, Schedule
from pd4dgs_codec.train.stop import StopRequest

#: A timed run settles the N of its schedule after so many steps; a slow one once it has spent the share of the limit
#: that is the coarse phase's, but not before the fewer steps, of which the first ones compile.
TIMED_STEPS = 50
FEWEST_TIMED_STEPS = 5
#: Mean cost of a step over a run against that of its first ones, which are all of level 0.
LATER_COST = 1.5
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

    A run with a number of steps goes through its schedule step by step; a time limit besides cuts it. A timed run, with
    a limit alone, goes through it by the clock: each step takes it on by the share of what is left of the schedule that
    the step took of what is left of the time. Its N is what it would take on a machine that stays as it was in the
    first steps; it decides whether the run is long enough to prune and to judge, not when the run ends.

    learner: the model and its steps. seconds: of training, those before a resumption included. curve: quality against
    time, a row for each evaluation. interrupted: a signal ended the last `run`.
    """

    def __init__(self, config: TrainConfig, dataset: Dataset, device: str = "cpu", size: ModelConfig | None = None):
        """size: of the model, if not the preset's."""
        self.timed = config.max_seconds is not None and config.iterations is None
        total = config.iterations or (None if self.timed else DEFAULT_ITERATIONS[config.preset])
        self.config, self.dataset = config, dataset
        self.learner = Learner(config, dataset, Schedule(total), torch.device(device), size)
        self.learner.share = 0.0 if self.timed else None
        self._costs: list[float] = []  #: seconds of the steps from which a timed run settles N
        self._step = self._evaluation = 0.0  #: seconds that the last step and the last evaluation took
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
        """N of the schedule: the steps of the whole run, about those of a timed one; None where it is not settled."""
        return self.learner.schedule.iterations

    @property
    def finished(self) -> bool:
        """Whether the whole schedule is done."""
        return self.total is not None and self.learner.place >= self.total

    def run(
        self, output: Path, *, log: Path | None = None, progress: Progress | None = None, save_every: float = 60.0
    ) -> None:
        """Trains to the end, to the time limit, or to Ctrl-C or SIGTERM, which end it after the step in hand and set
        `interrupted`; `output` holds a whole checkpoint then.

        A second signal raises KeyboardInterrupt at once: `output` stays as last saved. save_every: seconds. Raises
        DataError for a checkpoint that cannot be written, or for such a log, in which case the checkpoint is saved
        first.
        """
        with StopRequest() as stop, one_torch_thread():
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
        saved = told = time.monotonic()
        while not self.finished:
            place = self.learner.place
            record = self.learner.step()
            told, begun = time.monotonic(), told
            late = self._spend(*workers.largest(told - begun))  # one clock for all workers
            if self._curve_due(place):
                record["held_out_psnr"] = workers.alike(self._level_psnr)
                self.curve.append(
                    {"iteration": self.iteration, "seconds": self.seconds, "psnr": record["held_out_psnr"]}
                )
                record["plane_bits"] = self.learner.plane_bits()
                told, begun = time.monotonic(), told
                (self._evaluation,) = workers.largest(told - begun)
                self.seconds += self._evaluation
            logged = records.write(record | {"seconds": round(self.seconds, 3)})
            if progress:
                progress.update(self, record)
            if time.monotonic() - saved > save_every:
                self.save(output)
                saved = time.monotonic()
            if any(workers.largest(stop.requested or late or not logged)):
                break

    def _spend(self, seconds: float) -> bool:
        """Counts the time of a step; a timed run moves on in its schedule. Returns whether the limit is reached."""
        begun, limit = self.seconds, self.config.max_seconds
        self.seconds += seconds
        usual, self._step = min(seconds, self._step), seconds  # a pause is not taken for what the next step will cost
        if not (self.timed and limit):
            return limit is not None and self.seconds >= limit
        if self.total is None:
            self._costs.append(seconds)
            slow = self.iteration >= FEWEST_TIMED_STEPS and self.seconds >= COARSE_SHARE * limit
            if self.iteration >= TIMED_STEPS or slow:
                self.learner.schedule = Schedule(max(1, round(limit / (LATER_COST * median(self._costs)))))
            return self.seconds >= limit
        share, left = self.learner.share or 0.0, limit - self._evaluation - usual - begun
        if seconds < left:
            self.learner.share = share + (1 - share) * seconds / left
            return False
        if self.learner.place >= self.learner.schedule.exact_rounding:  # else the run is cut, and says so
            self.learner.share = 1.0
        return True

    def _curve_due(self, before: int) -> bool:
        """Whether the step that began at place `before` ended at or past a point of the curve."""
        if self.total is None:
            return False
        every = max(1, self.total // CURVE_POINTS)
        return self.finished or self.learner.place // every > before // every

    def _level_psnr(self) -> list[float]:
        """Mean PSNR per level on a few held-out views (training views if none are held out)."""
        views = self.dataset.test or self.dataset.train
        return self.learner.level_psnr(views[:: max(1, len(views) // CURVE_VIEWS)][:CURVE_VIEWS])

    def save(self, path: Path) -> None:
        """Writes the checkpoint with all that resuming needs; of several workers the first one does."""
        if workers.rank():
            return
        training = {
            "config": self.config.to_json(),
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
