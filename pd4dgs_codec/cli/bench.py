"""`pd4dgs-bench`: reports on the codec, the renderer, the trainer and the delivery themselves."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import (
    FAILED,
    OK,
    STDIO,
    Console,
    UsageError,
    check_output,
    is_pd4,
    named_input,
    read_bytes,
    write_bytes,
)
from pd4dgs_codec.cli.progress import TrainingProgress, progress_bar
from pd4dgs_codec.errors import DataError, DecodeError, TrainError
from pd4dgs_codec.io import finite, whole_file

if TYPE_CHECKING:
    from pd4dgs_codec.bench.codec import Deviation, Point, Sweep
    from pd4dgs_codec.bench.train import Run
    from pd4dgs_codec.data.view import Dataset
    from pd4dgs_codec.quality.frames import Frame
    from pd4dgs_codec.scene import SceneInfo

T = TypeVar("T")


class Outcome(NamedTuple):
    """What a report found: JSON, Markdown, what draws its plot to a path, and a line per failure."""

    result: dict[str, Any]
    text: str
    draw: Callable[[Path], None] | None = None
    failures: Sequence[str] = ()


# -- codec -------------------------------------------------------------------------------------------------------------

CODEC = """\
A checkpoint is packed at every combination of step scale, mode and effort. Each file's error is measured on its values,
and on pictures against those of the checkpoint; a file without its checkpoint has bytes and times alone. Times: warm,
the median and quartiles of the repeats in one process (none begun after 5 s); cold, at the step scale nearest to 1,
whole fresh processes, with the largest memory they held.

examples:
  pd4dgs-bench codec model.pt --data recordings/kitchen --downscale 2 --plot codec.png > codec.md
  pd4dgs-bench codec model.pt --quick
  pd4dgs-bench codec scene.pd4 --json"""
#: What --quick runs, where no option says otherwise.
QUICK: dict[str, Any] = {"step_scales": (1.0, 2.0), "modes": ("ans", "lzma"), "efforts": (1,), "repeats": 1, "cold": 0}


def _codec(args: argparse.Namespace, console: Console) -> Outcome:
    data = read_bytes(args.input)
    from pd4dgs_codec.bench import codec, timing

    machine = timing.machine()
    what = codec.Sweep(**(QUICK if args.quick else {}) | _given(args, *QUICK))
    masks = None
    if is_pd4(data):
        if args.plot is not None:
            raise UsageError("--plot: a file without its checkpoint has no error to plot; expected a checkpoint")
        points = [codec.file_point(data, what.repeats, what.cold)]
    else:
        points, masks = _swept(args, what)
    result = {"input": args.input, "machine": machine, "points": codec.as_json(points), "masks": masks and vars(masks)}
    tables = [codec.points_table(points), *([codec.values_table(points, masks)] if masks else [])]
    text = "\n\n".join([*tables, timing.machine_line(machine)])
    return Outcome(result, text, partial(_plot, codec.panels(points), "RMSE of pictures"))


def _swept(args: argparse.Namespace, what: Sweep) -> tuple[list[Point], Deviation]:
    """(points of a checkpoint, what its mask codes lose)."""
    from pd4dgs_codec.bench import codec
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene

    model, _ = checkpoint.load(args.input)
    scene = to_scene(model)
    masks = codec.mask_deviation([model.masks(i).detach().numpy() for i in scene.layers], scene.mask)
    frames = _frames(args, scene.info, 2 if args.quick else 6)
    with progress_bar(len(what), "files", "codec") as step:
        return codec.sweep(args.input, scene, frames, what, step), masks


# -- render ------------------------------------------------------------------------------------------------------------

RENDER = """\
The Gaussians of the highest level, as each camera meets them, are drawn in several ways, and each picture is compared
with that of a float64 oracle written from the formulas: the same formulas in float32; the CPU kernels as they are, with
other tiles, with other thresholds; gsplat where there is a CUDA device. Times are of rasterising alone.

Kernels with other constants are compiled first, some 20 s each; --cache keeps them for the next run.

examples:
  pd4dgs-bench render scene.pd4 --plot render.png > render.md
  pd4dgs-bench render model.pt --data synthetic:local --views 1 --only kernels,'T > 1e-2'"""


def _render(args: argparse.Namespace, console: Console) -> Outcome:
    from pd4dgs_codec.bench import pictures, render, timing
    from pd4dgs_codec.quality.levels import load_levels

    names = args.only or render.NAMES
    if unknown := [name for name in names if name not in render.NAMES]:
        raise UsageError(f"--only: found {unknown[0]!r}, expected some of {', '.join(render.NAMES)}")
    machine = timing.machine("gsplat")
    level = load_levels(named_input(args.input))[-1]
    views = [pictures.view(level, frame) for frame in _frames(args, level.model.info, 2)]
    with tempfile.TemporaryDirectory() as folder, progress_bar(len(names), "ways to draw", "render") as step:
        points = render.sweep(views, names, args.repeats, Path(args.cache or folder).resolve(), step)
    sizes = [{"width": v["width"], "height": v["height"], "gaussians": len(v["means"])} for v in views]
    result = {"input": args.input, "machine": machine, "level": level.level, "pictures": sizes}
    drawn = "; ".join(f"{v['width']}x{v['height']}, {v['gaussians']:,} Gaussians" for v in sizes)
    text = "\n\n".join([render.table(points), f"Pictures: {drawn}.", timing.machine_line(machine)])
    plot = partial(_plot, render.panels(points), "RMSE against the float64 oracle")
    return Outcome(result | {"points": render.as_json(points)}, text, plot)


# -- train -------------------------------------------------------------------------------------------------------------

TRAIN = f"""\
Each preset is trained for the same time; held-out quality is measured a dozen times on the way, on six views, as
pd4dgs-train does. --from draws runs that exist instead, from their checkpoints or logs.

{options.SOURCES}

examples:
  pd4dgs-bench train synthetic:local --presets tiny small --seconds 120 --plot train.png > train.md
  pd4dgs-bench train --from out/tiny.pt run.jsonl --plot train.png"""
#: Options that are fields of TrainConfig.
TRAIN_FIELDS = ("downscale", "holdout", "seed", "iterations")


def _train(args: argparse.Namespace, console: Console) -> Outcome:
    if args.runs and (args.source or _given(args, "presets", "seconds", *TRAIN_FIELDS)):
        raise UsageError("--from takes runs that exist; expected no SOURCE and no option of a training beside it")
    if not args.runs and not args.source:
        raise UsageError("found no SOURCE, expected a dataset to train on or --from FILE")
    if args.seconds and args.iterations:
        raise UsageError("found --seconds and --iterations, expected one of them")
    from pd4dgs_codec.bench import timing, train

    machine = None if args.runs else timing.machine()  # where the runs that exist were made is not known
    runs = [train.of_file(path) for path in args.runs] if args.runs else _trained(args, console)
    text = "\n\n".join([train.table(runs), *([timing.machine_line(machine)] if machine else [])])
    plot = partial(_plot, train.panels(runs), "held-out RMSE of the highest level")
    return Outcome({"source": args.source, "machine": machine, "runs": train.as_json(runs)}, text, plot)


def _trained(args: argparse.Namespace, console: Console) -> list[Run]:
    from pd4dgs_codec.bench import train
    from pd4dgs_codec.interchange.teacher import load_source
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

    limit = None if args.iterations else args.seconds or 120.0
    runs = []
    for preset in dict.fromkeys(args.presets or ("tiny", "small")):
        config = TrainConfig(preset=preset, source=args.source, max_seconds=limit, **_given(args, *TRAIN_FIELDS))
        dataset = load_source(args.source, downscale=config.downscale, holdout=config.holdout)
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


# -- latency -----------------------------------------------------------------------------------------------------------

LATENCY = f"""\
Prints Markdown: per rate and level the bytes of the prefix S, 8S/B, the median time to their last byte over the paced
link of pd4dgs-serve, and to a picture on the CPU in a warm and in a cold process, with the file's own camera; beside
the published sizes of monolithic models.

A file takes about (8S/B + 2 s) x 3 x runs at each rate. Times need a quiet machine.

{options.SOURCES}

examples:
  pd4dgs-bench latency scene.pd4 > latency.md
  pd4dgs-bench latency scene.pd4 --data recordings/kitchen --downscale 2 --plot latency.png --json latency.json
  pd4dgs-bench latency scene.pd4 --anchors 25000 --size 480x360 --rates 10M"""


def _latency(args: argparse.Namespace, console: Console) -> Outcome:
    if args.data and len(args.data) != len(args.inputs):
        raise UsageError(f"found {len(args.data)} --data for {len(args.inputs)} files, expected one each or none")
    from pd4dgs_codec.bench import latency
    from pd4dgs_codec.draw.warm import warm_up
    from pd4dgs_codec.interchange.teacher import load_source

    contents = [_with_camera(name, args.anchors) for name in args.inputs]
    sets: list[Dataset | None] = [load_source(source, downscale=args.downscale) for source in args.data]
    sets = sets or [None] * len(contents)
    speeds, files = list(args.rates.values()), []
    warm_up()
    with progress_bar(3 * args.runs * len(speeds) * len(contents), "runs", "times") as step:
        for name, data, dataset in zip(args.inputs, contents, sets, strict=True):
            files.append(latency.report(name, data, speeds, args.runs, None, dataset, step))
    result = {
        "runs": args.runs,
        "rates": args.rates,
        "files": [asdict(f) | {"times": [asdict(t) | {"within": t.within} for t in f.times]} for f in files],
        "published_megabytes": latency.PUBLISHED_MEGABYTES,
    }
    return Outcome(result, latency.text(files, args.runs), partial(latency.draw, files[0]))


def _with_camera(name: str, anchors: int | None) -> bytes:
    """The bytes of a valid file with a camera, enlarged if asked for."""
    from pd4dgs_codec.bench.latency import with_anchors
    from pd4dgs_codec.format.decoder import decode

    data = read_bytes(name)
    try:
        if decode(data).info.camera is None:
            raise DataError("holds no camera to draw pictures with")
        return data if anchors is None else with_anchors(data, anchors)
    except (DecodeError, DataError) as error:
        raise DataError(f"{name}: {error}") from None


# -- stability ---------------------------------------------------------------------------------------------------------

STABILITY = """\
A row passes if its error is within its bound, or if input that has no answer was refused in one line. References are
computed by mpmath or in float64. The exit code is 1 if any row fails.

groups: rate, fitting, quantiser, hexplane, deformation, masks, rasteriser, training
The row that compares one thread with two is there only where the process may use two CPUs.

examples:
  pd4dgs-bench stability > table.md
  pd4dgs-bench stability --only rasteriser
  pd4dgs-bench stability --only needle --json
  pd4dgs-bench stability --json rows.json > table.md"""


def _stability(args: argparse.Namespace, console: Console) -> Outcome:
    from pd4dgs_codec.bench.stability import cases as table

    table.mpmath()
    cases = table.chosen(args.only)
    if not cases:
        raise UsageError(f"--only: found {args.only!r}, expected a group or a part of a case's name")
    rows = []
    with progress_bar(len(cases), "cases", "stability") as step:
        for case in cases:
            rows.append(table.judge(case))
            step()
    failed = [row for row in rows if row.status == table.FAIL]
    failures = [f"fail: {row.group}: {row.case}: {row.got}, error {row.error}, bound {row.bound}" for row in failed]
    result = {"rows": [asdict(row) for row in rows], "counts": table.counts(rows)}
    return Outcome(result, table.text(rows), failures=failures)


# -- options -----------------------------------------------------------------------------------------------------------


def _options(report: str, p: options.Parser) -> None:
    """What a report has beside the options that every command has."""
    add = p.add_argument
    if report == "codec":
        kinds = (
            options.positive_float,
            options.one_of(*QUICK["modes"]),
            options.checked(int, lambda n: 1 <= n <= 9, "from 1 to 9"),
        )
        scales, modes, efforts = map(options.listed, kinds)
        add("input", metavar="FILE", help="checkpoint of pd4dgs-train, or a .pd4 file (- for stdin)")
        add("--step-scales", type=scales, metavar="X,...", help="factors on all steps (default: 0.5,1,2,4)")
        add("--modes", type=modes, metavar="M,...", help="entropy coders (default: ans,lzma)")
        add("--efforts", type=efforts, metavar="N,...", help="1 fast to 9 small (default: 1,5,9)")
        add("--repeats", type=options.positive_int, metavar="N", help="runs per warm time (default: 5)")
        add("--cold", type=options.count, metavar="N", help="fresh processes per cold time; 0: none (default: 1)")
        add("--quick", action="store_true", help="few points, one run each, no fresh processes")
        _add_views(p, "6; with --quick 2")
    elif report == "render":
        add("input", metavar="FILE", help=".pd4 file or .pt checkpoint; - reads a .pd4 from stdin")
        add("--only", type=options.listed(str), metavar="NAME,...", help="these ways to draw alone")
        add("--repeats", type=options.positive_int, default=15, metavar="N", help="drawings per picture (default: 15)")
        add("--cache", metavar="FOLDER", help="where to keep compiled kernels (default: nowhere)")
        _add_views(p, "2")
    elif report == "train":
        presets = ("tiny", "small", "paper")
        add("source", nargs="?", metavar="SOURCE", help="dataset to train on, see below")
        add("--presets", nargs="+", choices=presets, metavar="PRESET", help="model sizes (default: tiny small)")
        add("--seconds", type=options.positive_float, metavar="S", help="time limit per preset (default: 120)")
        add("--iterations", type=options.positive_int, metavar="N", help="so many steps instead of a time limit")
        options.add_reading(p, defaults=False)
        add("--seed", type=options.seed, metavar="N", help="seed of each run (default: 0)")
        add("--from", dest="runs", nargs="+", metavar="FILE", help="instead of training: checkpoints or logs")
    elif report == "latency":
        larger = "measure a scene of N anchors in layer 0: those of FILE, and copies moved by up to 3 voxels"
        add("inputs", nargs="+", metavar="FILE", help=".pd4 files that hold a camera")
        add("--rates", type=options.rates, default="2M,10M,50M", metavar="R", help="of the link (default: 2M,10M,50M)")
        add("--runs", type=options.positive_int, default=9, metavar="N", help="runs per median (default: 9)")
        add("--anchors", type=options.positive_int, metavar="N", help=larger)
        add("--data", action="append", default=[], metavar="SOURCE", help="dataset for quality, one per FILE")
        add("--downscale", type=options.positive_int, default=1, metavar="K", help="images 1/K as large (default: 1)")
    else:
        add("--only", metavar="NAME", help="the group NAME, or the cases with NAME in their name")
    if report in PLOTS:
        add("--plot", metavar="FILE.png", help=f"write a plot: {PLOTS[report]}")
    p.add_common(json_file=True)


def _add_views(p: options.Parser, views: str) -> None:
    """The options that say which pictures to take; views: how many are taken without --views, in words."""
    group = p.add_argument_group("pictures")
    what = "dataset whose held-out views give the cameras (default: the file's own camera over time)"
    group.add_argument("--data", metavar="SOURCE", help=what)
    options.add_reading(group, defaults=False)
    group.add_argument("--views", type=options.positive_int, metavar="N", help=f"how many pictures (default: {views})")


def _frames(args: argparse.Namespace, info: SceneInfo, views: int) -> list[Frame]:
    from pd4dgs_codec.bench.pictures import frames

    return frames(info, args.data, args.views or views, **_given(args, "downscale", "holdout"))


def _given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """The options among `names` that were given a value."""
    return {name: getattr(args, name) for name in names if getattr(args, name) is not None}


def _plot(panels: Sequence[Any], ylabel: str, path: Path) -> None:
    from pd4dgs_codec.bench.report import draw

    draw(panels, ylabel, path)


#: Report: its arguments, what it is, its details, what makes it.
REPORTS: dict[str, tuple[str, str, str, Callable[[argparse.Namespace, Console], Outcome]]] = {
    "codec": ("FILE", "Measure what the codec's error costs in bytes and seconds.", CODEC, _codec),
    "render": ("FILE", "Measure the rasteriser against a float64 oracle: error against milliseconds.", RENDER, _render),
    "train": ("[SOURCE]", "Measure held-out quality against training wall time.", TRAIN, _train),
    "latency": ("FILE...", "Measure how long the first picture takes, and the next ones.", LATENCY, _latency),
    "stability": ("", "Feed stiff and extreme cases, and print a table of what became of each.", STABILITY, _stability),
}
_FRONT = "error against cost, log-log, Pareto front marked"
PLOTS = dict.fromkeys(("codec", "render", "train"), _FRONT) | {"latency": "quality over seconds since the request"}


def parser(report: str | None = None) -> options.Parser:
    """The options of a report, or of `pd4dgs-bench` without one."""
    if report is not None:
        synopsis, summary, details, _ = REPORTS[report]
        p = options.Parser(f"bench {report}", synopsis, summary, details)
        _options(report, p)
        return p
    lines = [f"  {name:<11} {summary}" for name, (_, summary, _, _) in REPORTS.items()]
    examples = [f"  pd4dgs-bench {name} --help" for name in REPORTS]
    details = "\n".join(["REPORT is one of", *lines, "", "examples:", *examples])
    p = options.Parser("bench", "REPORT", "Measure what the codec, the renderer and the trainer promise.", details)
    p.add_argument("report", metavar="REPORT", choices=tuple(REPORTS), help="what to measure, see below")
    p.add_common()
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] not in REPORTS:
        return common.run(parser(), _misplaced, arguments)
    return common.run(parser(arguments[0]), partial(_report, REPORTS[arguments[0]][3]), arguments[1:])


def _misplaced(args: argparse.Namespace, console: Console) -> int:
    raise UsageError(f"found options before {args.report!r}, expected the report first")


def _report(execute: Callable[..., Outcome], args: argparse.Namespace, console: Console) -> int:
    """Refuses outputs that cannot be written before any work, and writes them after it; FAILED if the report did."""
    console.json = args.json == STDIO
    plot = getattr(args, "plot", None)
    if plot is not None and Path(plot).suffix.lower() != ".png":
        raise UsageError(f"found --plot {plot}, expected a name that ends in .png")
    for path in (plot, None if args.json == STDIO else args.json):
        if path is not None:
            check_output(path, args.overwrite)
    found = execute(args, console)
    if plot is not None and found.draw is not None:
        with whole_file(plot, args.overwrite) as temporary:
            found.draw(temporary)
    if args.json not in (None, STDIO):
        write_bytes(args.json, (json.dumps(finite(found.result), indent=1) + "\n").encode(), args.overwrite)
    for line in found.failures:
        console.message(line)
    console.result(found.result, found.text, on_stdout=True)
    return FAILED if found.failures else OK
