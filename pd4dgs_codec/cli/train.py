"""`pd4dgs-train`: posed images -> a checkpoint with three levels."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, TrainingProgress, UsageError, check_output, command, number, say, table
from pd4dgs_codec.errors import RenderError, TrainError
from pd4dgs_codec.io import remove_leftovers
from pd4dgs_codec.train.config import ABLATIONS, FIXED, OPTIONS, TrainConfig, at_quality

if TYPE_CHECKING:
    from pd4dgs_codec.train.loop import Trainer

DETAILS = f"""\
Training ends after --iterations steps. --max-seconds alone spreads the whole schedule over this time; with --iterations
it stops the run early. Ctrl-C, SIGTERM or a closed terminal stops the run after the current step with a complete
checkpoint, from which --resume continues. A second Ctrl-C stops it at once and loses the steps since the last save (one
a minute).

--quality sets the weights of the bitrate, growing, pruning and quantisation steps together; --rate-scale, --prune and
--grading override single ones.

At two thirds of a run, layers that gain too little on held-back views are dropped; runs of fewer than 500 steps, timed
runs of fewer than 1,000 and --keep-layers keep all.

With --rollout key, level 0 is the scene at --key-instant, layer 1 moves it from there, and most steps train the highest
level. The other values are the paper's, with the mean over time as level 0: adaptive samples higher levels more often
the more the layers differ; uniform samples all levels equally; fixed samples them with probabilities 0.15, 0.30 and
0.55; top trains only the highest level; all trains every level in every step, at about three times the cost. The first
tenth of every run trains level 0.
--without turns off: rate, the bitrate terms; planes, the bitrate term of the planes; binary, the term of the
masks; noise, the simulated quantisation; whitening, the transform of the feature channels.

--segments 10s writes a folder, -o DIR, for a long SOURCE: a base, which holds what all times share, and a file for each
ten seconds that continues it. pd4dgs-info, -render, -eval, -export, -package and -view take the folder as one scene.
First one model of all times, the whole, is trained by --iterations and --max-seconds; its layer 0 is the base. Segments
start from it and train for an eighteenth of its steps each, as many at a time as -j has threads. The same command
resumes after an interruption. --manifest writes the lines by which pd4dgs-batch trains whole and segments, each by
--part; the same command without --manifest then adds the index.

torchrun starts several workers for one scene: they share the V views of a step and average their gradients, and the
first worker writes the files. Their number must divide V and may change when a run is resumed.

{options.SOURCES}

examples:
  pd4dgs-train synthetic:local -o local.pt --preset tiny --max-seconds 300
  pd4dgs-train recordings/kitchen -o kitchen.pt --downscale 2 --iterations 10000
  pd4dgs-train recordings/kitchen -o kitchen.pt --resume kitchen.pt
  pd4dgs-train recordings/lesson -o lesson --segments 10s --iterations 3000
  torchrun --nproc-per-node=2 -m -- pd4dgs_codec train synthetic:local -o local.pt --views-per-step 2"""


def parser() -> options.Parser:
    """Returns the parser. Options that are stored in a checkpoint default to None, so that conflicts are noticed."""
    p = options.Parser("train", "SOURCE -o FILE.pt", "Train a layered dynamic Gaussian scene from images.", DETAILS)
    p.add("source SOURCE", "dataset to train on, see below")
    p.add("-o, --output FILE.pt", "checkpoint to write", options.named, required=True)
    options.add_reading(p.add, unset=options.READING)
    options.add_background(p.add, "the dataset's; white for images with alpha")
    what = "0 (small files) to 100 (high quality), see below (default: 50)"
    p.add("--quality Q", what, options.checked(float, lambda q: 0 <= q <= 100, "0 to 100"))
    _add_fields(p)
    p.add("--device", "device to train on (default: auto)", choices=("auto", "cpu", "cuda"), default="auto")
    p.add("--resume FILE.pt", "continue from this checkpoint with its stored settings", options.named)
    p.add("--log FILE.jsonl", "log to write, one JSON object per step", options.named)
    what = f"turn off a part of the method, see below (repeatable): {', '.join(ABLATIONS)}"
    p.add("--without PART", what, action="append", choices=tuple(ABLATIONS), default=[])
    parts = p.group("segments", "a long capture as a folder of files, see below")
    parts("--segments T", "write segments of about this length, such as 10s", options.duration)
    parts("--overlap T", "seconds that neighbouring segments share (default: 0s)", options.duration)
    what = "train only the model of all times (whole) or segment N, from 0 on, into -o FILE.pd4"
    parts("--part N", what, options.checked(_part, lambda _: True, "whole or a number"))
    parts("--whole FILE.pd4", "with --part N, the trained model of all times", options.named)
    what = "write a manifest of whole and segments for pd4dgs-batch, and train nothing"
    parts("--manifest FILE.jsonl", what, options.named)
    return p.add_common()


def _part(text: str) -> int | str:
    return text if text == "whole" else options.count(text)


def _add_fields(p: options.Parser) -> None:
    """Adds an option for each field of TrainConfig whose declaration has a help text."""
    for field in fields(TrainConfig):
        about = OPTIONS.get(field.name)
        if about is None or not about.help:
            continue
        name = f"--{field.name.replace('_', '-')}"
        if field.type == "bool":
            p.add(name, about.help, action="store_const", const=True)
            continue
        kind = {"int": int, "float": float}.get(str(field.type).split(" ")[0], str)
        at = " at quality 50" if about.dial else ""
        what = about.help if field.default is None else f"{about.help} (default: {field.default}{at})"
        if about.choices:
            p.add(name, what, kind, choices=about.choices)
        else:
            p.add(f"{name} {about.metavar}", what, options.checked(kind, about.contains, about.range))


def _train(args: argparse.Namespace, console: Console) -> int:
    check_usage(args)
    if args.segments is not None:
        return _train_segments(args, console)
    in_place = args.resume is not None and common.same_file(args.resume, args.output)
    check_output(args.output, args.overwrite or in_place)
    if args.log:
        check_output(args.log, args.overwrite or args.resume is not None)
    from pd4dgs_codec.interchange.teacher import load_source
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.train import workers
    from pd4dgs_codec.train.kernels import compiling
    from pd4dgs_codec.train.loop import Trainer

    checkpoint.target(args.output)  # refuses a device now, not after the first minute
    device = _device(args.device)
    config = _stored_config(args) if args.resume else _fresh_config(args)
    workers.start(device, config.views_per_step)
    first = workers.rank() == 0
    reading = {name: getattr(config, name) for name in ("downscale", "holdout", "background", "fps")}
    with compiling(config, device):
        dataset = load_source(args.source, **reading)
        start = checkpoint.load(args.resume)[0] if args.resume else None  # spares the search for start points
        trainer = Trainer(config, dataset, device, start=start)
    if args.resume:
        trainer.resume(Path(args.resume))
    progress, log = None, None
    if first:
        _announce(trainer, console)
        progress = TrainingProgress()
        log = _prepare_log(args, trainer.iteration)
        remove_leftovers(args.output)
    try:
        trainer.run(Path(args.output), log=log, progress=progress)
    except KeyboardInterrupt:
        raise TrainError("interrupted twice; all steps since the last save are lost") from None
    workers.stop()
    if trainer.iteration and trainer.learner.skipped == trainer.iteration:
        raise TrainError(
            f"{args.output}: training failed: the loss or its gradient was not finite in all {trainer.iteration} "
            "steps; expected images and a scene of ordinary size"
        )
    if first:
        result = _summary(args, trainer)
        console.result(result, _text(result))
        for doubt in result["doubts"]:
            say(f"warning: {doubt}")
    return OK


def _train_segments(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.cli import train_segments as segmented

    config = _fresh_config(args)
    reading = {name: getattr(config, name) for name in ("downscale", "holdout", "background", "fps")}
    capture = segmented.Capture(config, reading, args.segments, args.overlap, _device(args.device), args.threads)
    if args.manifest:
        check_output(args.manifest, args.overwrite)
        common.write_bytes(args.manifest, data := segmented.manifest(capture), args.overwrite)
        lines = data.count(b"\n")
        console.result({"manifest": args.manifest, "lines": lines}, f"{args.manifest}: {lines} lines")
        return OK
    if args.part is None:
        result = segmented.train_folder(capture, args.output, args.overwrite)
        console.result(result, _segments_text(result))
        return OK
    check_output(args.output, args.overwrite)
    k, whole = (None, None) if args.part == "whole" else (args.part, Path(args.whole))
    result = segmented.train_one(capture, k, Path(args.output), whole)
    console.result({"output": args.output, **result}, f"{args.output}: {'' if result['finished'] else 'not '}finished")
    return OK


def _segments_text(result: dict[str, Any]) -> str:
    sizes = f"{result['base_bytes']:,} bytes of the base, {result['bytes'] - result['base_bytes']:,} of segments"
    text = f"{result['output']}: {result['segments']} segments, {result['kept']} of them kept; {sizes}"
    return text if result["finished"] else f"{text}\nnot finished; to continue: the same command"


main = command(parser, _train)


def check_usage(args: argparse.Namespace) -> None:
    """Raises UsageError for options that do not fit together."""
    options.conditional(args, args.rollout in (None, "key"), "needs --rollout key", key_instant=None)
    segments = args.segments is not None
    options.conditional(args, segments, "needs --segments", overlap=0.0, part=None, whole=None, manifest=None)
    if segments:
        options.conditional(args, False, "has no effect with --segments", log=None)
        if (args.whole is None) == isinstance(args.part, int):
            raise UsageError("expected --part N and --whole FILE.pd4 together, or neither")
        if args.resume and not common.same_file(args.resume, args.output):
            raise UsageError(f"found --resume {args.resume}, expected the folder of -o {args.output}")
    if args.rate_scale and "rate" in args.without:
        raise UsageError(f"found --rate-scale {args.rate_scale:g} and --without rate, expected one of them")
    for option, name in (("-o", args.output), ("--resume", args.resume)):
        if args.log and name and common.same_file(args.log, name):
            raise UsageError(f"--log and {option} both name {name}; expected two files")


# -- configuration -----------------------------------------------------------------------------------------------------


def _ablated(args: argparse.Namespace) -> dict[str, Any]:
    """Returns the fields of TrainConfig that --without sets."""
    return {name: value for part in args.without for name, value in ABLATIONS[part].items()}


def _fresh_config(args: argparse.Namespace) -> TrainConfig:
    dial = {} if args.quality is None else at_quality(args.quality)
    named = dial | options.given(args, *FIXED, "max_seconds") | _ablated(args)
    return TrainConfig(source=args.source, **named)


def _stored_config(args: argparse.Namespace) -> TrainConfig:
    """Reads the configuration of the checkpoint args.resume, with the time limit of this call if it has one.

    Raises TrainError for options that differ from the stored ones.
    """
    from pd4dgs_codec.model import checkpoint

    data = common.read_bytes(args.resume)
    found = "a .pd4 file, which holds no training state" if common.is_pd4(data) else None
    training = {} if found else checkpoint.loads(data, args.resume)[1]
    if "config" not in training:
        found = found or "no training state (decoded from a .pd4, or stripped)"
        raise TrainError(f"{args.resume}: found {found}, expected a checkpoint of pd4dgs-train")
    config = TrainConfig.from_json(training["config"], args.resume)
    for name in FIXED:
        asked = getattr(args, name)
        if asked is not None:
            _expect_same(args.resume, f"--{name.replace('_', '-')}", getattr(config, name), asked)
    if args.quality is not None:
        for name, value in at_quality(args.quality).items():
            if getattr(args, name, None) is None and name not in _ablated(args):
                _expect_same(args.resume, f"--quality with {name}", getattr(config, name), value)
    for part in args.without:
        if any(getattr(config, name) != value for name, value in ABLATIONS[part].items()):
            raise TrainError(f"{args.resume}: found --without {part}, expected the settings of the checkpoint")
    # the number of steps stays, since a time limit that comes later does not make a timed run
    config = replace(
        config, source=args.source, iterations=config.total, max_seconds=args.max_seconds or config.max_seconds
    )
    _check_unfinished(config, training, args.resume)
    return config


def _expect_same(path: str, what: str, stored: Any, asked: Any) -> None:
    if stored != asked:
        raise TrainError(f"{path}: found {what} {asked}, expected {stored} as in the checkpoint")


def _check_unfinished(config: TrainConfig, training: dict[str, Any], path: str) -> None:
    """Says if the run is complete. Raises TrainError if it has used up its time limit before its end."""
    total, used = config.total, training.get("seconds")
    done, end = (training.get("share"), 1) if total is None else (training.get("iteration"), total)
    if not isinstance(done, int | float) or not isinstance(used, int | float):
        return  # the trainer refuses the state
    if done >= end:
        say(f"{path}: the run is complete; a longer one starts anew, with more --iterations or --max-seconds")
    elif config.max_seconds and used >= config.max_seconds:
        spent = f"has used {used:.0f} s of its limit of {config.max_seconds:g} s"
        raise TrainError(f"{path}: {spent}, expected a higher --max-seconds")


# -- log and messages --------------------------------------------------------------------------------------------------


def _prepare_log(args: argparse.Namespace, iteration: int) -> Path | None:
    """Returns the log to append to: empty for a fresh run, cut to the first `iteration` steps for a resumed one."""
    if args.log and os.path.isfile(args.log):  # devices and pipes cannot be cut
        if args.resume:
            _cut_log(args.log, iteration)
        else:
            open(args.log, "w").close()
    return Path(args.log) if args.log else None


def _cut_log(path: str, iteration: int) -> None:
    """Removes an incomplete last line and the records of steps from `iteration` on, which a killed run wrote after its
    last save and which are repeated now. The file is replaced whole or not at all."""
    with open(path, "rb") as stream:
        lines = stream.read().splitlines(keepends=True)
    kept = b"".join(line for line in lines if line.endswith(b"\n") and not _is_step_from(line, iteration))
    if len(kept) < sum(map(len, lines)):
        common.write_bytes(path, kept, overwrite=True)


def _is_step_from(line: bytes, iteration: int) -> bool:
    try:
        record = json.loads(line)
    except ValueError:
        return False
    return isinstance(record, dict) and isinstance(n := record.get("iteration"), int) and n >= iteration


def _announce(trainer: Trainer, console: Console) -> None:
    from pd4dgs_codec.train import workers

    config, dataset = trainer.config, trainer.dataset
    limit = f", at most {config.max_seconds:g} s" if config.max_seconds else ""
    start = f", from step {trainer.iteration}" if trainer.iteration else ""
    several = f", {workers.count()} workers" if workers.count() > 1 else ""
    device = trainer.learner.device
    say(f"training {config.preset} on {device}{several}{limit}{start}")
    for line in (*dataset.summary(), *(f"note: {remark}" for remark in dataset.remarks())):
        say(line)
    console.detail(f"{config}")


def _device(name: str) -> str:
    """Returns the device. auto is CUDA if PyTorch finds a GPU and gsplat can render on it, else the CPU."""
    import torch

    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return "cpu"
    if not torch.cuda.is_available():
        raise TrainError("--device cuda: PyTorch found no CUDA device, expected one or --device cpu")
    from pd4dgs_codec.model.picture import check_gsplat

    try:
        check_gsplat()
    except RenderError as error:
        if name == "cuda":
            raise TrainError(f"--device cuda: {error}") from None
        say(f"training on the CPU: {error}")
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
        "total": 0 if trainer.timed else trainer.total,  # 0: the run ends by time
        "finished": trainer.finished,
        "resume": None if trainer.finished else _resuming(args, trainer),
        "interrupted": trainer.interrupted,
        "seconds": round(trainer.seconds, 3),
        "spent": {name: round(seconds, 3) for name, seconds in learner.spent.items()},
        "phases_not_reached": learner.schedule.phases_not_reached(learner.position),
        "skipped": learner.skipped,
        "doubts": trainer.doubts(),
        "left_out": learner.levels.left_out,
        "anchors": len(trainer.model.anchor_q),
        "active_anchors": learner.active_anchors(),
        "split": "test" if trainer.dataset.test else "train",
        "levels": [{"level": level, "mpsnr": value} for level, value in enumerate(psnr)],
    }


def _resuming(args: argparse.Namespace, trainer: Trainer) -> str:
    """The command that resumes the run."""
    words = ["pd4dgs-train", args.source, "-o", args.output, "--resume", args.output]
    limit = trainer.config.max_seconds
    if limit and trainer.seconds >= limit:
        words += ["--max-seconds", f"{2 * limit:g}"]
    if args.device != "auto":
        words += ["--device", args.device]
    if args.log:
        words += ["--log", args.log]
    return shlex.join(words)


def _text(result: dict[str, Any]) -> str:
    end = "" if result["finished"] or not result["total"] else f" of {result['total']}"
    steps = f"{result['iterations']}{end} steps in {result['seconds']:.0f} s"
    lines = [f"{result['output']}: {steps}, {result['anchors']} anchors"]
    if result["spent"]:
        parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in result["spent"].items())
        lines.append(f"seconds outside training steps: {sum(result['spent'].values()):.0f}, of {parts}")
    if result["phases_not_reached"]:
        lines.append(f"phases not reached: {', '.join(result['phases_not_reached'])}")
    if result["resume"]:
        lines.append(f"not finished; to continue: {result['resume']}")
    if result["skipped"]:
        lines.append(f"{result['skipped']} steps skipped for non-finite gradients")
    for row in result["left_out"]:
        dB = [-10 * math.log10(max(row[name], 1e-9)) for name in ("error", "instead")]
        lines.append(
            f"left out above level {row['kept']}: {dB[0]:.2f} dB on {row['views']} held-back views, "
            f"{dB[1]:.2f} once level {row['kept']} had trained in its place"
        )
    if result["levels"]:
        split = "held-out" if result["split"] == "test" else "training-view"
        rows = zip(result["levels"], result["active_anchors"], strict=False)
        cells = [(row["level"], number(row["mpsnr"]), number(active, 0)) for row, active in rows]
        lines.append(table(("level", f"{split} PSNR dB", "active anchors"), cells))
    return "\n".join(lines)
