"""Trainings that a report needs: kept if they ended, gone on with if they were stopped, begun if they are not there."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.train.config import BEFORE, TrainConfig
from pd4dgs_codec.train.loop import Trainer


def ensure_trained(
    config: TrainConfig, dataset: Dataset, path: Path, *, say: Callable[[str], None], progress: Any = None
) -> tuple[Model, dict[str, Any]]:
    """The model and training state in `path` once a run of `config` on `dataset` has ended there, by itself or at its
    time limit; the log lies beside it as train.jsonl.

    say: receives one line on what is done. progress: as Trainer.run takes it. TrainError if a signal interrupts the
    training.
    """
    stored = _stored(path, config)
    if stored is not None and _ended(stored, config):
        say(f"{path} is kept: {stored['iteration']} steps, the same settings")
        return checkpoint.load(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    say(f"training, preset {config.preset}, {len(dataset.train)} views")
    log = path.with_name("train.jsonl")
    trainer = Trainer(config, dataset)
    if stored is None:
        log.unlink(missing_ok=True)
    else:
        trainer.resume(path)
        say(f"going on from step {trainer.iteration}")
    trainer.run(path, log=log, progress=progress)
    if trainer.interrupted:
        raise TrainError(f"{path}: training was interrupted at step {trainer.iteration}; the same command goes on")
    return checkpoint.load(path)


def _stored(path: Path, config: TrainConfig) -> dict[str, Any] | None:
    """The training state of a run of this very configuration, finished or not, else None."""
    if not path.exists():
        return None
    _, training = checkpoint.load(path)
    # fields that are newer than the checkpoint had the values that are their defaults now, but for BEFORE
    stored = json.loads(json.dumps(TrainConfig().__dict__, default=lambda value: value.__dict__))
    stored |= BEFORE | json.loads(training.get("config", "{}"))
    wanted = json.loads(json.dumps(config, default=lambda value: value.__dict__))
    return training if stored == wanted else None


def _ended(training: dict[str, Any], config: TrainConfig) -> bool:
    """Whether a run came to its end, or to that of its time."""
    finished = 0 < training["total"] <= training.get("place", training["iteration"])
    return finished or bool(config.max_seconds and training["seconds"] >= config.max_seconds)
