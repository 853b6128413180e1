"""`pd4dgs-train`: posed images -> a checkpoint with three levels."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import values
from pd4dgs_codec.cli.common import (
    OK,
    SOURCES,
    Console,
    Parser,
    UsageError,
    add_reading,
    command,
    number,
    table,
)
from pd4dgs_codec.cli.files import STDIO, check_output
from pd4dgs_codec.cli.progress import TrainingProgress
from pd4dgs_codec.cli.resume import ablated, check_time_left, cut_log, stored_config
from pd4dgs_codec.errors import RenderError, TrainError
from pd4dgs_codec.io import remove_leftovers
from pd4dgs_codec.train.config import ABLATIONS, FIXED, ROLLOUTS

if TYPE_CHECKING:
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

DETAILS = f"""\
Training ends after --iterations; --max-seconds alone goes through the whole schedule by the clock, beside --iterations
it cuts the run. Ctrl-C (or SIGTERM) ends it early, after the step in hand, with a whole checkpoint, which --resume goes
on from. A second Ctrl-C ends it at once, and what was trained since the last save (one a minute) is lost.

--rollout: adaptive draws a level, the higher ones more often the more the layers differ; uniform draws all alike; fixed
draws them with chances of .15, .30, .55; top trains the highest level alone; all trains every level in every step, at
about thrice the cost. Before a tenth of the run it is level 0 in any case.
--without: rate, the bit-rate terms; planes, that of the planes alone; binary and smooth, the two mask terms; tmc, both
of them; noise, the imitation of quantisation; whitening, the mixing of the features' channels; judge, which leaves out
levels that gain too little on training views kept back until then.

Several workers train one scene where torchrun starts them: V views a step are shared out, gradients are averaged, and
the first one writes. N must divide V. A run may be resumed with another N.

{SOURCES}

examples:
  torchrun --nproc-per-node=2 -m -- pd4dgs_codec train synthetic:local -o local.pt --views-per-step 2
  pd4dgs-train synthetic:local -o local.pt --preset tiny --max-seconds 300
  pd4dgs-train recordings/kitchen -o kitchen.pt --downscale 2 --iterations 10000
  pd4dgs-train recordings/kitchen -o kitchen.pt --resume kitchen.pt"""


def parser() -> Parser:
    """The options of `pd4dgs-train`. What a checkpoint fixes has no default here, so that a conflict can be told."""
    p = Parser("train", "SOURCE -o FILE.pt", "Train a layered dynamic Gaussian scene from posed images.", DETAILS)
    p.add_argument("source", metavar="SOURCE", help="dataset to train on, see below")
    p.add_argument("-o", "--output", required=True, metavar="FILE.pt", help="checkpoint to write")
    p.add_argument("--preset", choices=("tiny", "small", "paper"), help="model size (default: small)")
    what = "numbers of an anchor's feature, 1..64 (default: 32)"
    p.add_argument("--feature-width", type=values.positive_int, metavar="N", help=what)
    what = "Gaussians of an anchor, 1..16 (default: 10)"
    p.add_argument("--slots", type=values.positive_int, metavar="N", help=what)
    what = "training steps (default: by preset, unless --max-seconds is given)"
    p.add_argument("--iterations", type=values.positive_int, metavar="N", help=what)
    what = "views that each step learns from (default: 1); several workers share them, see below"
    p.add_argument("--views-per-step", type=values.positive_int, metavar="V", help=what)
    what = "time to train; on --resume earlier time counts too"
    p.add_argument("--max-seconds", type=values.positive_float, metavar="S", help=what)
    add_reading(p, defaults=False)
    p.add_argument("--seed", type=values.seed, metavar="N", help="seed of all that is random in training (default: 0)")
    p.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train (default: auto)")
    p.add_argument("--resume", metavar="FILE.pt", help="go on from this checkpoint, with the settings stored in it")
    p.add_argument("--log", metavar="FILE.jsonl", help="write one JSON object per step")
    what = "0 (small) to 100 (good): weights of the bit rates, pruning and steps at once (default: 50)"
    p.add_argument("--quality", type=values.non_negative_float, metavar="Q", help=what)
    what = "weight of the anchors' bit rate against quality, instead of the quality's (at 50: 0.08; 1: the paper's)"
    p.add_argument("--rate-scale", type=values.non_negative_float, metavar="X", help=what)
    p.add_argument(
        "--prune",
        type=values.non_negative_float,
        metavar="X",
        help="half way, take out anchors whose absence adds at most this share to the squared error, instead of the "
        "quality's (at 50: 0.14; 0: none)",
    )
    what = (
        "coarser steps for anchors that pictures hardly depend on, up to this share of the squared error, instead of "
        "the quality's (at 50: 0.05; 0: none)"
    )
    p.add_argument("--grading", type=values.non_negative_float, metavar="X", help=what)
    what = (
        "share of the steps of the last third that see the most useful anchors of level 0 alone, for pictures from the "
        "first slices of pd4dgs-encode --slices (default: 0; 0.3 is much)"
    )
    p.add_argument("--prefixes", type=values.non_negative_float, metavar="X", help=what)
    p.add_argument("--max-layer", type=int, choices=(0, 1, 2), help="train without the layers above this one")
    what = "show the scene in the browser while it trains, at this port of this machine (default: 8080; needs viser)"
    p.add_argument("--view", type=values.port, nargs="?", const=8080, metavar="PORT", help=what)
    what = "which level each step trains, see below (default: adaptive)"
    p.add_argument("--rollout", choices=ROLLOUTS, help=what)
    p.add_argument(
        "--without",
        action="append",
        choices=tuple(ABLATIONS),
        metavar="PART",
        default=[],
        help=f"leave out a part of the method, to see what it is worth: {', '.join(ABLATIONS)}, see below; may be "
        "given several times",
    )
    p.add_common()
    return p


def _train(args: argparse.Namespace, console: Console) -> int:
    if STDIO in (args.output, args.resume, args.log):
        raise UsageError("training reads and writes named files, not - (stdin, stdout)")
    if args.rate_scale and "rate" in args.without:
        raise UsageError(f"found --rate-scale {args.rate_scale:g} and --without rate, expected one of them")
    if args.log and os.path.realpath(args.log) == os.path.realpath(args.output):
        raise UsageError(f"--log and -o both name {args.output}; expected two files")
    resuming_in_place = args.resume is not None and Path(args.resume).resolve() == Path(args.output).resolve()
    check_output(args.output, args.overwrite or resuming_in_place)
    if args.log:
        check_output(args.log, args.overwrite or args.resume is not None)
    from pd4dgs_codec.interchange.teacher import load_source
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.train import workers
    from pd4dgs_codec.train.loop import Trainer

    checkpoint.target(args.output)  # refuses a device now, not after the first minute
    device = _device(args.device, console)
    config = stored_config(args) if args.resume else _fresh_config(args)
    workers.start(device, config.views_per_step)
    first = workers.rank() == 0
    dataset = load_source(args.source, downscale=config.downscale, holdout=config.holdout)
    trainer = Trainer(config, dataset, device)
    if args.resume:
        trainer.resume(Path(args.resume))
        check_time_left(trainer, args.resume)
    if first and args.log and os.path.isfile(args.log):  # a device or a pipe has nothing to take back
        if args.resume:
            cut_log(args.log, trainer.iteration)
        else:
            open(args.log, "w").close()
    if first:
        remove_leftovers(args.output)
        _announce(args, trainer, console)
    log = Path(args.log) if args.log and first else None
    progress = _progress(args, trainer, console) if first else None
    try:
        trainer.run(Path(args.output), log=log, progress=progress)
    except KeyboardInterrupt:
        raise TrainError("interrupted twice; what was trained since the last save is lost") from None
    workers.stop()
    if trainer.iteration and trainer.learner.skipped == trainer.iteration:
        raise TrainError(
            f"{args.output}: nothing was learnt: in all {trainer.iteration} steps the loss or its gradient was not "
            "finite; expected views and a scene of ordinary size"
        )
    if first:
        result = _summary(args, trainer)
        console.result(result, _text(result), on_stdout=False)
    return OK


main = command(parser, _train)


def _progress(args: argparse.Namespace, trainer: Trainer, console: Console) -> TrainingProgress:
    if args.view is None:
        return TrainingProgress()
    from pd4dgs_codec.cli.watch import WatchedProgress

    progress = WatchedProgress(trainer, args.view)
    console.message(f"the scene is at {progress.url}")
    return progress


def _announce(args: argparse.Namespace, trainer: Trainer, console: Console) -> None:
    """What is about to be trained, on what."""
    from pd4dgs_codec.train import workers

    config, dataset = trainer.config, trainer.dataset
    limit = f", at most {config.max_seconds:g} s" if config.max_seconds else ""
    held_out = f"{len(dataset.test)} held out" if dataset.test else "none held out"
    start = f", from step {trainer.iteration}" if trainer.iteration else ""
    several = f", {workers.count()} workers" if workers.count() > 1 else ""
    console.message(
        f"training {config.preset} on {len(dataset.train)} views ({held_out}), {trainer.learner.device}{several}{limit}"
        f"{start}"
    )
    for remark in dataset.remarks():
        console.message(f"note: {remark}")
    console.detail(f"{config}")


def _fresh_config(args: argparse.Namespace) -> TrainConfig:
    from pd4dgs_codec.train.config import TrainConfig, at_quality

    dial = {} if args.quality is None else at_quality(args.quality)
    named = dial | {name: getattr(args, name) for name in (*FIXED, "max_seconds") if getattr(args, name) is not None}
    return TrainConfig(source=args.source, **named | ablated(args))


def _device(name: str, console: Console) -> str:
    """Where to train. auto is CUDA only where PyTorch finds a GPU and gsplat can draw on it."""
    import torch

    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return "cpu"
    if not torch.cuda.is_available():
        raise TrainError("--device cuda: this PyTorch finds no CUDA device; expected one, or --device cpu")
    from pd4dgs_codec.model.rasterization import check_gsplat

    try:
        check_gsplat()
    except RenderError as error:
        if name == "cuda":
            raise TrainError(f"--device cuda: {error}") from None
        console.message(f"the GPU is not used: {error}")
        return "cpu"
    return "cuda"


def _summary(args: argparse.Namespace, trainer: Trainer) -> dict[str, Any]:
    learner = trainer.learner
    psnr = trainer.curve[-1]["psnr"] if trainer.curve else []
    return {
        "output": args.output,
        "source": trainer.config.source,
        "preset": trainer.config.preset,
        "device": str(learner.device),
        "iterations": trainer.iteration,
        "total": 0 if trainer.timed else trainer.total,  # 0: time ends the run, not a number of steps
        "finished": trainer.finished,
        "interrupted": trainer.interrupted,
        "seconds": round(trainer.seconds, 3),
        "phases_not_reached": learner.schedule.phases_not_reached(learner.place),
        "skipped": learner.skipped,
        "left_out": learner.left_out,
        "anchors": len(trainer.model.anchor_q),
        "active_anchors": learner.active_anchors(),
        "split": "test" if trainer.dataset.test else "train",
        "levels": [{"level": level, "mpsnr": value} for level, value in enumerate(psnr)],
    }


def _text(result: dict[str, Any]) -> str:
    end = "" if result["finished"] or not result["total"] else f" of {result['total']}"
    steps = f"{result['iterations']}{end} steps in {result['seconds']:.0f} s"
    lines = [f"{result['output']}: {steps}, {result['anchors']} anchors"]
    if result["phases_not_reached"]:
        lines.append(f"never reached: {', '.join(result['phases_not_reached'])}")
    if not result["finished"]:
        lines.append(f"not finished: --resume {result['output']} goes on from here")
    if result["skipped"]:
        lines.append(f"{result['skipped']} steps skipped: their gradient was not finite")
    for row in result["left_out"]:
        gain = f"{row['gain']:+.2f} dB over level {row['level'] - 1} on {row['views']} views kept back"
        lines.append(f"level {row['level']} left out: {gain}")
    if result["levels"]:
        split = "held-out" if result["split"] == "test" else "training-view"
        rows = zip(result["levels"], result["active_anchors"], strict=False)
        cells = [(row["level"], number(row["mpsnr"]), number(active, 0)) for row, active in rows]
        lines.append(table(("level", f"{split} PSNR dB", "active anchors"), cells))
    return "\n".join(lines)
