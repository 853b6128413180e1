"""A training run: steps until its end, its time limit or a signal; log, curve of quality, checkpoints."""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import torch

from pd4dgs_codec.data.view import Dataset, View, spread
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.io import finite
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.signals import stop_request
from pd4dgs_codec.threads import one_torch_thread
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.doubts import doubts
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.schedule import Schedule

#: A timed run estimates the N of its schedule after so many steps of this process, of which the first compile kernels.
TIMED_STEPS = 10
#: Mean cost of a step over a run, relative to its first steps, which train level 0 only.
LATER_COST = 1.5
#: Held-out evaluations over a run, for the curve of quality against wall time, and views in each.
CURVE_POINTS = 6
CURVE_VIEWS = 4
#: Training cameras and times in a checkpoint, from which packing measures the model.
VIEWPOINTS = 32


class Progress(Protocol):
    """An observer of a run."""

    def update(self, trainer: Trainer, record: dict[str, Any]) -> None:
        """Called after every step with its log record."""

    def on_trial(self, done: int, steps: int) -> None:
        """Called before every trial step with the trial steps done and their total."""

    def close(self) -> None:
        """Called once, when the run ends or raises."""


class Stopped(Exception):
    """A signal or the time limit stopped a trial. The trial is undone; a resumed run repeats it."""


class Trainer:
    """A training run; `run` executes it.

    A run with a number of steps follows its schedule step by step, and a time limit stops it early. A timed run has a
    time limit only: if a step takes a share of the remaining time, it advances by that share of the remaining schedule.
    Its N, estimated from the pace of its first steps, decides whether the run is long enough to prune and to select
    levels, but not when it ends.

    learner: the model and its steps. seconds: training time, including that before a resumption. curve: quality
    against time, a row for each evaluation. interrupted: whether a signal ended the last `run`.
    """

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        device: str = "cpu",
        size: ModelConfig | None = None,
        start: Model | None = None,
    ):
        """size: the model's size; by default the preset's. start: the model that is trained; by default a fresh one."""
        self.timed = config.total is None
        self.config, self.dataset = config, dataset
        self.fingerprint = dataset.fingerprint()
        self.learner = Learner(config, dataset, Schedule(config.total), torch.device(device), size, start)
        self.learner.share = 0.0 if self.timed else None
        self._costs: list[float] = []  #: seconds of each step from which a timed run estimates N
        self._step = self._evaluation = 0.0  #: seconds of the last step and of the last evaluation
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
        """N of the schedule: the steps of the whole run, estimated in a timed one; None before the estimate."""
        return self.learner.schedule.iterations

    @property
    def finished(self) -> bool:
        """Whether the whole schedule is done."""
        return self.total is not None and self.learner.position >= self.total

    def run(
        self, output: Path, *, log: Path | None = None, progress: Progress | None = None, save_every: float = 60.0
    ) -> None:
        """Trains to the end, the time limit or a signal, then writes a complete checkpoint to `output`.

        Ctrl-C, SIGTERM or SIGHUP ends the run after the current step and sets `interrupted`. A second signal, unless it
        is SIGHUP, raises KeyboardInterrupt at once and leaves `output` as last saved. save_every: seconds between
        checkpoints. Raises DataError if the checkpoint or the log cannot be written; a log's error is raised after
        saving.
        """
        with stop_request() as stop, one_torch_thread():
            records = RecordLog(log)
            try:
                self._steps(output, stop, records, progress, save_every)
            finally:
                records.close()
                if progress:
                    progress.close()
            if self.config.noise and self.finished:
                self.model.round_to_steps()  # to the values that the last steps rendered and the file will hold
            self.save(output)
        self.interrupted = stop.is_set()
        if records.failure:
            raise records.failure

    def _steps(
        self, output: Path, stop: threading.Event, records: RecordLog, progress: Progress | None, save_every: float
    ) -> None:
        """Performs steps until the run ends or a record cannot be logged."""
        saved = now = time.monotonic()
        limit = None if self.timed else self.config.max_seconds  # the schedule of a timed run includes its trials

        def before_practice(done: int, steps: int) -> None:
            late = limit is not None and self.seconds + time.monotonic() - now >= limit
            if any(workers.largest(stop.is_set() or late)):
                raise Stopped
            if progress:
                progress.on_trial(done, steps)

        self.learner.before_practice = before_practice
        while not self.finished:
            position = self.learner.position
            try:
                record = self.learner.step()
            except Stopped:
                self.seconds += max(workers.largest(time.monotonic() - now))
                break
            now, begun = time.monotonic(), now
            late = self._spend(*workers.largest(now - begun))  # one clock for all workers
            if self._curve_due(position):
                self._evaluate(record)
                now, begun = time.monotonic(), now
                (self._evaluation,) = workers.largest(now - begun)
                self.seconds += self._evaluation
                self.learner.spent["curve"] += self._evaluation
            logged = records.write(record | {"seconds": round(self.seconds, 3)})
            if progress:
                progress.update(self, record)
            if time.monotonic() - saved > save_every:
                self.save(output)
                saved = time.monotonic()
            if any(workers.largest(stop.is_set() or late or not logged)):
                break

    def _spend(self, seconds: float) -> bool:
        """Adds the time of a step, and advances a timed run in its schedule. Returns whether the limit is reached."""
        begun, limit = self.seconds, self.config.max_seconds
        self.seconds += seconds
        usual, self._step = min(seconds, self._step), seconds  # a pause does not predict the cost of the next step
        if not (self.timed and limit):
            return limit is not None and self.seconds >= limit
        if self.total is None:
            self._costs.append(seconds)
            if len(self._costs) >= TIMED_STEPS:
                self.learner.schedule = Schedule(max(1, round(limit / (LATER_COST * median(self._costs)))))
            return self.seconds >= limit
        share, left = self.learner.share or 0.0, limit - self._evaluation - usual - begun
        if seconds < left:
            self.learner.share = share + (1 - share) * seconds / left
            return False
        if self.learner.position >= self.learner.schedule.exact_rounding:  # else the run stops early and says so
            self.learner.share = 1.0
        return True

    def _curve_due(self, before: int) -> bool:
        """Whether the step that began at position `before` crossed a point of the curve or finished the run."""
        if self.total is None:
            return False
        every = max(1, self.total // CURVE_POINTS)
        return self.finished or self.learner.position // every > before // every

    def _evaluate(self, record: dict[str, Any]) -> None:
        """Adds a point to the curve: mean mPSNR per level, dB, on a few held-out views, or on training views if none
        are held out."""
        record["held_out_psnr"] = psnr = workers.alike(lambda: self.learner.level_psnr(self._curve_views()))
        self.curve.append({"iteration": self.iteration, "seconds": self.seconds, "psnr": psnr})
        record["plane_bits"] = self.learner.plane_bits()

    def _curve_views(self) -> Sequence[View]:
        views = self.dataset.test or self.dataset.train
        return views[:: max(1, len(views) // CURVE_VIEWS)][:CURVE_VIEWS]

    def doubts(self) -> list[str]:
        """What the pictures of the finished run give cause for, a line each; see `doubts`."""
        return doubts(self.learner, self._curve_views(), self.curve[-1]["psnr"]) if self.finished and self.curve else []

    def save(self, path: Path) -> None:
        """Writes a checkpoint from which a run can resume. Of several workers only the first one writes."""
        if workers.rank():
            return
        training = {
            "config": self.config.to_json(),
            "source": self.dataset.name,
            "place": self.dataset.place,
            "data": self.fingerprint,
            "seconds": self.seconds,
            "curve": json.dumps(self.curve),
            "viewpoints": [(view.camera, float(view.time)) for view in spread(self.dataset.train, VIEWPOINTS)],
        }
        checkpoint.save(path, self.model, training | self.learner.state())

    def resume(self, path: Path) -> None:
        """Continues from a checkpoint of the same configuration and data.

        Raises TrainError if it holds no training state, DataError if the state is broken or belongs to other data: the
        pictures and cameras count, not the place where they lie.
        """
        model, training = checkpoint.load(path)
        if "optimiser" not in training:
            raise TrainError(f"{path}: found no training state, expected a checkpoint that pd4dgs-train saved")
        if training.get("data", self.fingerprint) != self.fingerprint:
            found = f"other pictures or cameras in {self.dataset.name}"
            raise DataError(f"{path}: found {found} than it was trained on, expected the same data")
        try:
            self.learner.restore(model, training)
            self.seconds, self.curve = float(training["seconds"]), read_curve(training["curve"])
            if not 0 <= self.seconds < math.inf:
                raise ValueError(f"seconds is {self.seconds}, expected a finite number >= 0")
        except Exception as error:  # a broken state can raise any exception
            reason = f"{type(error).__name__}: {error}"
            raise DataError(f"{path}: its training state cannot be read: {reason}") from None
        order, count = self.learner.order, len(self.dataset.train)
        if not all(0 <= index < count for index in order):
            raise DataError(
                f"{path}: its next views are {order[:8]}, found {count} training views; expected the same data"
            )


def read_curve(text: str) -> list[dict[str, Any]]:
    """Parses the curve of a checkpoint. Raises ValueError, KeyError or TypeError."""
    rows = list(json.loads(text))
    if not all(math.isfinite(v) for row in rows for v in (row["iteration"], row["seconds"], *row["psnr"])):
        raise ValueError("curve has a value that is not finite")
    return rows


class RecordLog:
    """Appends a line of JSON per record to the file `path`; writes nothing if `path` is None.

    failure: the error if a record could not be written, or None. The run saves its checkpoint before it raises it.
    """

    def __init__(self, path: Path | None):
        """Raises DataError if the file cannot be opened."""
        self.path = path
        self.failure: DataError | None = None
        try:
            # line-buffered, so that a failed write shows at its step
            self._stream = open(path, "a", encoding="utf-8", buffering=1) if path else None
        except OSError as error:
            raise self._error(error) from None

    def write(self, record: dict[str, Any]) -> bool:
        """Writes a record. Returns False if this record or an earlier one could not be written."""
        try:
            if self._stream:
                self._stream.write(json.dumps(finite(record), allow_nan=False) + "\n")
        except OSError as error:
            self.failure = self._error(error)
        return self.failure is None

    def close(self) -> None:
        """Closes the file and ignores errors, since `failure` reports failed writes."""
        if self._stream:
            with contextlib.suppress(OSError):
                self._stream.close()

    def _error(self, error: OSError) -> DataError:
        return DataError(f"{self.path}: the log cannot be written: {error.strerror or error}")
