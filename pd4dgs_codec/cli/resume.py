"""What a resumed training run takes from its checkpoint, and what the command line may not contradict."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.files import write_bytes
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.train.config import ABLATIONS, FIXED, at_quality

if TYPE_CHECKING:
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer


def stored_config(args: argparse.Namespace) -> TrainConfig:
    """The configuration in the checkpoint args.resume, with this call's time limit if it names one.

    Raises TrainError where the call asks for something else than was stored.
    """
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.train.config import TrainConfig

    _, training = checkpoint.load(args.resume)
    if "config" not in training:
        what = "no training state (it was decoded from a .pd4, or stripped)"
        raise TrainError(f"{args.resume}: holds {what}; expected a checkpoint of pd4dgs-train")
    config = TrainConfig.from_json(training["config"], args.resume)
    for name in FIXED:
        asked = getattr(args, name)
        if asked is not None:
            _expect_same(args.resume, f"--{name.replace('_', '-')}", getattr(config, name), asked)
    if args.quality is not None:
        for name, value in at_quality(args.quality).items():
            if getattr(args, name, None) is None and name not in ablated(args):
                _expect_same(args.resume, f"{name}, as --quality has it,", getattr(config, name), value)
    for part in args.without:
        if any(getattr(config, name) != value for name, value in ABLATIONS[part].items()):
            raise TrainError(f"{args.resume}: was not trained --without {part}; expected the same to resume")
    if _same_source(args.source) != _same_source(config.source):
        _expect_same(args.resume, "SOURCE", config.source, args.source)
    return replace(config, max_seconds=args.max_seconds or config.max_seconds)


def ablated(args: argparse.Namespace) -> dict[str, Any]:
    """The fields of TrainConfig that --without sets."""
    return {name: value for part in args.without for name, value in ABLATIONS[part].items()}


def _expect_same(path: str, what: str, stored: Any, asked: Any) -> None:
    if stored != asked:
        raise TrainError(f"{path}: was trained with {what} {stored}, found {asked}; expected the same to resume")


def _same_source(source: str) -> str:
    from pd4dgs_codec.data.synthetic import PREFIX

    return source if source.startswith(PREFIX) else str(Path(source).resolve())


def cut_log(path: str, iteration: int) -> None:
    """Takes from a log the records of steps from `iteration` on: those that a killed run had written after its last
    save, which come again, and a line cut in its middle. Lines that are no records stay. Whole or not at all."""
    with open(path, "rb") as stream:
        lines = stream.read().splitlines(keepends=True)
    kept = b"".join(line for line in lines if line.endswith(b"\n") and not _is_step_from(line, iteration))
    if len(kept) < sum(map(len, lines)):
        write_bytes(path, kept, overwrite=True)


def _is_step_from(line: bytes, iteration: int) -> bool:
    try:
        record = json.loads(line)
    except ValueError:
        return False
    return isinstance(record, dict) and isinstance(n := record.get("iteration"), int) and n >= iteration


def check_time_left(trainer: Trainer, path: str) -> None:
    """TrainError if the run has used up its time limit without having finished."""
    limit = trainer.config.max_seconds
    if limit and not trainer.finished and trainer.seconds >= limit:
        used = f"has trained {trainer.seconds:.0f} s of its limit of {limit:g} s"
        raise TrainError(f"{path}: {used}; expected a larger --max-seconds to go on")
