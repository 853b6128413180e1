"""`pd4dgs-bench train`: held-out quality against wall time, per preset."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.bench.output import add_output, finish, prepare
from pd4dgs_codec.cli.common import (
    OK,
    SOURCES,
    Console,
    Parser,
    UsageError,
    count,
    positive_float,
    positive_int,
    seed,
    use_threads,
)
from pd4dgs_codec.cli.progress import TrainingProgress
from pd4dgs_codec.errors import TrainError

if TYPE_CHECKING:
    from pd4dgs_codec.bench.train import Run

PRESETS = ("tiny", "small", "paper")
DETAILS = f"""\
Each preset is trained for the same time; held-out quality is measured a dozen times on the way, on six views, as
pd4dgs-train does. --from draws runs that exist instead, from their checkpoints or logs.

{SOURCES}

examples:
  pd4dgs-bench train synthetic:local --presets tiny small --seconds 120 --plot train.png > train.md
  pd4dgs-bench train --from out/tiny.pt run.jsonl --plot train.png"""


def parser() -> Parser:
    """The options of the report."""
    p = Parser("bench train", "[SOURCE]", "Measure held-out quality against training wall time.", DETAILS)
    p.add_argument("source", nargs="?", metavar="SOURCE", help="dataset to train on, see below")
    p.add_argument("--presets", nargs="+", choices=PRESETS, metavar="PRESET", help="model sizes (default: tiny small)")
    p.add_argument("--seconds", type=positive_float, metavar="S", help="time limit per preset (default: 120)")
    p.add_argument("--iterations", type=positive_int, metavar="N", help="so many steps instead of a time limit")
    p.add_argument("--downscale", type=positive_int, metavar="K", help="images 1/K as wide and high (default: 1)")
    p.add_argument("--holdout", type=count, metavar="K", help="as in pd4dgs-train (default: 8)")
    p.add_argument("--seed", type=seed, metavar="N", help="seed of each run (default: 0)")
    p.add_argument("--from", dest="runs", nargs="+", metavar="FILE", help="instead of training: checkpoints or logs")
    add_output(p)
    return p


def execute(args: argparse.Namespace, console: Console) -> int:
    """Trains, or reads what was trained."""
    options = ("presets", "seconds", "iterations", "downscale", "holdout", "seed")
    if args.runs and (args.source or any(getattr(args, name) is not None for name in options)):
        raise UsageError("--from takes runs that exist; expected no SOURCE and no option of a training beside it")
    if not args.runs and not args.source:
        raise UsageError("found no SOURCE, expected a dataset to train on or --from FILE")
    if args.seconds and args.iterations:
        raise UsageError("found --seconds and --iterations, expected one of them")
    prepare(args, console)
    use_threads(args)
    from pd4dgs_codec.bench import train
    from pd4dgs_codec.bench.machine import describe, sentence

    machine = None if args.runs else describe()  # where the runs that exist were made is not known
    runs = [train.of_file(path) for path in args.runs] if args.runs else _trained(args, console)
    result: dict[str, Any] = {"source": args.source, "machine": machine, "runs": train.as_json(runs)}
    text = "\n\n".join([train.table(runs), *([sentence(machine)] if machine else [])])
    finish(args, console, result, text, train.panels(runs), "held-out RMSE of the highest level")
    return OK


def _trained(args: argparse.Namespace, console: Console) -> list[Run]:
    from pd4dgs_codec.bench import train
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

    names = ("downscale", "holdout", "seed", "iterations")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    limit = None if args.iterations else args.seconds or 120.0
    runs = []
    for preset in dict.fromkeys(args.presets or ("tiny", "small")):
        config = TrainConfig(preset=preset, source=args.source, max_seconds=limit, **given)
        dataset = load(args.source, downscale=config.downscale, holdout=config.holdout)
        trainer = Trainer(config, dataset)
        console.message(f"training {preset} on {len(dataset.train)} views")
        with tempfile.TemporaryDirectory() as folder:
            trainer.run(Path(folder) / "model.pt", progress=TrainingProgress())
        if trainer.interrupted:
            raise TrainError(f"interrupted while training {preset}; nothing was written")
        if not trainer.curve:
            raise TrainError(f"{preset}: the limit ended the run before its first evaluation; expected a longer one")
        runs.append(train.of_curve(preset, trainer.curve, len(trainer.model.anchor_q)))
    return runs
