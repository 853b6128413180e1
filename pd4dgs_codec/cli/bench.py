"""`pd4dgs-bench`: error against run time of codec, renderer and trainer; latency."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, STDIO, Console, UsageError, is_pd4, progress_bar, read_bytes
from pd4dgs_codec.errors import DataError, DecodeError
from pd4dgs_codec.format.options import MODES

if TYPE_CHECKING:
    from pd4dgs_codec.bench.report import Panel
    from pd4dgs_codec.quality.frames import Frame
    from pd4dgs_codec.scene import SceneInfo


class Outcome(NamedTuple):
    """The results of a report: JSON, Markdown, the plot and the label of its error axis."""

    result: dict[str, Any]
    text: str
    panels: Sequence[Panel] = ()
    error: str = ""


#: Why an option is refused for a file that is not rendered.
CHECKPOINT = "needs a checkpoint, not a .pd4 file"


def _add_views(p: options.Parser, views: int) -> None:
    """Adds the options that choose the images to render. views: their default number."""
    p.add("--data SOURCE", "use the held-out cameras of this dataset (default: the file's own camera over time)")
    options.add_reading(p.add, unset=options.READING)
    p.add("--views N", f"number of images (default: {views})", options.positive_int)


def _complete_views(args: argparse.Namespace, views: int, rendered: bool = True) -> None:
    """Sets the defaults of `_add_views`. Raises UsageError for an option that needs images or a dataset without one."""
    options.conditional(args, rendered, CHECKPOINT, data=None, views=views, downscale=options.READING["downscale"])
    options.conditional(args, args.data, "needs --data SOURCE", holdout=options.READING["holdout"])


def _frames(args: argparse.Namespace, info: SceneInfo) -> list[Frame]:
    """Up to args.views frames: evenly spread held-out (or else training) views of --data, or the file's own camera."""
    from pd4dgs_codec.quality.frames import dataset_frames, own_frames

    if args.data is None:
        return own_frames(info, args.views, downscale=args.downscale)
    dataset = common.read_dataset(args.data, args, info)
    return dataset_frames(dataset.test or dataset.train, args.views)


# -- codec -------------------------------------------------------------------------------------------------------------

CODEC = """\
Encodes a checkpoint with each combination of step scale, mode and effort. The error of a file is the difference between
its renderings and those of the checkpoint. For a .pd4 file, only bytes and times are reported. Times are medians and
quartiles of repetitions in one process; no repetition starts after 5 s.

examples:
  pd4dgs-bench codec model.pt --data recordings/kitchen --downscale 2 --plot codec.png > codec.md
  pd4dgs-bench codec model.pt --quick --views 2
  pd4dgs-bench codec scene.pd4 --json"""

SWEEP: dict[str, Any] = {
    "step_scales": (0.5, 1.0, 2.0, 4.0),
    "modes": ("ans", "lzma"),
    "efforts": (1, 5, 9),
    "repeats": 5,
}
QUICK: dict[str, Any] = {"step_scales": (1.0, 2.0), "efforts": (1,), "repeats": 1}


def _codec_options(p: options.Parser) -> None:
    mode = options.checked(str, MODES.__contains__, f"one of {', '.join(MODES)}")
    effort = options.checked(int, lambda value: 1 <= value <= 9, "an integer from 1 to 9")
    scales, modes, efforts = map(options.listed, (options.positive_float, mode, effort))
    p.add("input FILE", "checkpoint of pd4dgs-train or .pd4 file; - reads stdin")
    p.add("--step-scales X,...", "factors on all quantisation steps (default: 0.5,1,2,4)", scales)
    p.add("--modes M,...", "entropy coders (default: ans,lzma)", modes)
    p.add("--efforts N,...", "compression efforts, 1 to 9 (default: 1,5,9)", efforts)
    p.add("--repeats N", "repetitions of each measurement (default: 5)", options.positive_int)
    p.add("--quick", "only --step-scales 1,2 --efforts 1 --repeats 1")
    _add_views(p, 6)


def _codec(args: argparse.Namespace) -> Outcome:
    data = read_bytes(args.input)
    _complete_views(args, 6, not is_pd4(data))
    options.conditional(args, not is_pd4(data), CHECKPOINT, step_scales=None, modes=None, efforts=None, plot=None)
    from pd4dgs_codec.bench import report, runtime

    machine = report.machine()
    scales, modes, efforts, repeats = (SWEEP | (QUICK if args.quick else {}) | options.given(args, *SWEEP)).values()
    if is_pd4(data):
        points, panels = [runtime.file_point(data, repeats)], []
    else:
        from pd4dgs_codec.model import checkpoint

        model, _ = checkpoint.loads(data, common.shown_name(args.input))
        frames = _frames(args, model.info)
        settings = list(itertools.product(scales, modes, efforts))
        with progress_bar(len(settings), "files", "codec") as step:
            points = runtime.codec_points(model, frames, settings, repeats, step)
        panels = runtime.codec_panels(points)
    text = f"{runtime.codec_table(points)}\n\n{report.machine_line(machine)}"
    return Outcome({"input": args.input, "machine": machine, "points": points}, text, panels, "RMSE of images")


# -- render ------------------------------------------------------------------------------------------------------------

RENDER = """\
Renders the Gaussians of the highest level with each rasteriser (the CPU kernels, and gsplat if there is a CUDA device)
and compares the images with those of a float64 reference. Times cover rasterisation only.

examples:
  pd4dgs-bench render scene.pd4 --plot render.png > render.md
  pd4dgs-bench render model.pt --data synthetic:local --views 1 --only kernels"""


def _render_options(p: options.Parser) -> None:
    p.add("input FILE", ".pd4 file or .pt checkpoint; - reads a .pd4 from stdin")
    what = "rasterisers to measure: oracle float64, kernels, gsplat (default: all)"
    p.add("--only NAME,...", what, options.listed(str))
    p.add("--repeats N", "repetitions per image (default: 15)", options.positive_int, default=15)
    _add_views(p, 2)


def _render(args: argparse.Namespace) -> Outcome:
    from pd4dgs_codec.bench import report, runtime
    from pd4dgs_codec.quality.levels import load_levels

    names = args.only or tuple(runtime.BACKENDS)
    if unknown := [name for name in names if name not in runtime.BACKENDS]:
        raise UsageError(f"--only: found {unknown[0]!r}, expected some of {', '.join(runtime.BACKENDS)}")
    _complete_views(args, 2)
    machine = report.machine()
    level = load_levels(common.named_input(args.input), last_only=True)[-1]
    frames = _frames(args, level.model.info)
    views = [runtime.view(level, frame) for frame in frames]
    with progress_bar(len(names), "rasterisers", "render") as step:
        points = runtime.render_points(views, names, args.repeats, step)
    sizes = [
        {"width": f.camera.width, "height": f.camera.height, "gaussians": len(v["means"])}
        for f, v in zip(frames, views, strict=True)
    ]
    shown = "; ".join(f"{v['width']}x{v['height']}, {v['gaussians']:,} Gaussians" for v in sizes)
    text = f"{runtime.render_table(points)}\n\nImages: {shown}.\n\n{report.machine_line(machine)}"
    result = {"input": args.input, "machine": machine, "level": level.level, "pictures": sizes, "points": points}
    return Outcome(result, text, runtime.render_panels(points), "RMSE from the float64 reference")


# -- train -------------------------------------------------------------------------------------------------------------

TRAIN = """\
Reports the held-out quality of finished runs against their training time, which their checkpoints hold.

examples:
  pd4dgs-train synthetic:local -o tiny.pt --preset tiny --max-seconds 120
  pd4dgs-bench train tiny.pt small.pt --plot train.png > train.md"""


def _train_options(p: options.Parser) -> None:
    p.add("inputs FILE", "checkpoints of pd4dgs-train", nargs="+")


def _train(args: argparse.Namespace) -> Outcome:
    from pd4dgs_codec.bench import runtime

    runs = runtime.recorded_runs(args.inputs)
    return Outcome({"runs": runs}, runtime.train_table(runs), runtime.train_panels(runs), "RMSE of the highest level")


# -- player ------------------------------------------------------------------------------------------------------------

PLAYER = """\
Plays a file in Node and reports the CPU time of each step of an image: medians over times of the highest level, while
the camera moves. Steps run in workers, except those of the page. The GPU's work is not measured.

examples:
  pd4dgs-bench player scene.pd4 > player.md
  pd4dgs-bench player scene.pd4 --pictures 60 --json"""


def _player_options(p: options.Parser) -> None:
    p.add("input FILE", ".pd4 file; - reads stdin")
    p.add("--pictures N", "number of images (default: 40)", options.positive_int, default=40)


def _player(args: argparse.Namespace) -> Outcome:
    from pd4dgs_codec.bench import report, runtime

    machine = report.machine()
    found = runtime.player_times(read_bytes(args.input), args.pictures)
    text = f"{runtime.player_table(found)}\n\n{found['gaussians']:,} Gaussians.\n\n{report.machine_line(machine)}"
    return Outcome({"input": args.input, "machine": machine, **found}, text)


# -- latency -----------------------------------------------------------------------------------------------------------

LATENCY = """\
Reports for each rate and level the bytes S of the prefix, the ideal time 8S/rate, the median time to its last byte over
the simulated link of pd4dgs-serve, and the time to the rendered image on the CPU in a warm and in a cold process, with
the file's camera. Each file takes about (8S/rate + 2 s) x 3 x runs per rate. Use an otherwise idle machine.

examples:
  pd4dgs-bench latency scene.pd4 > latency.md
  pd4dgs-bench latency scene.pd4 --rates 500k,10M --json latency.json"""


def _latency_options(p: options.Parser) -> None:
    p.add("inputs FILE", ".pd4 files with a camera", nargs="+")
    p.add("--rates R", "link rates in bits per second (default: 2M,10M,50M)", options.rates, default="2M,10M,50M")
    p.add("--runs N", "runs per median (default: 9)", options.positive_int, default=9)


def _latency(args: argparse.Namespace) -> Outcome:
    contents = [_with_camera(name) for name in args.inputs]
    from pd4dgs_codec.bench import latency, report

    machine, speeds, files, parts = report.machine(), args.rates.values(), [], []
    with progress_bar(3 * args.runs * len(speeds) * len(contents), "runs", "latency") as step:
        for name, data in zip(args.inputs, contents, strict=True):
            rows = [row for rate in speeds for row in latency.times(data, rate, args.runs, step)]
            start = latency.first_start(data, max(speeds))
            files.append({"name": name, "bytes": len(data), "times": rows, "first_start": start})
            cold = f"With empty kernel caches the first image takes {start:.1f} s."
            parts += [f"## {name}", latency.table(rows), cold]
    parts.append(f"Seconds since the request (cold: since the start of the process), medians of {args.runs}.")
    result = {"runs": args.runs, "rates": args.rates, "machine": machine, "files": files}
    return Outcome(result, "\n\n".join([*parts, report.machine_line(machine)]))


def _with_camera(name: str) -> bytes:
    """Reads the bytes of a file. Raises DataError unless it is valid and holds a camera."""
    from pd4dgs_codec.format.decoder import decode

    data = read_bytes(name)
    try:
        if decode(data).info.camera is None:
            raise DataError("has no camera, expected one to render with")
    except (DecodeError, DataError) as error:
        raise DataError(f"{name}: {error}") from None
    return data


# -- the command -------------------------------------------------------------------------------------------------------


class Report(NamedTuple):
    """A report: its arguments in the usage line, summary, details, options and function; whether it has a plot."""

    usage: str
    summary: str
    details: str
    add_options: Callable[[options.Parser], None]
    execute: Callable[[argparse.Namespace], Outcome]
    plot: bool = True


REPORTS = {
    "codec": Report("FILE", "Measure the codec's error against bytes and time.", CODEC, _codec_options, _codec),
    "render": Report("FILE", "Measure the rasterisers' error against time.", RENDER, _render_options, _render),
    "train": Report("FILE...", "Measure held-out error against training time.", TRAIN, _train_options, _train),
    "player": Report("FILE", "Measure the CPU time of the player in Node.", PLAYER, _player_options, _player, False),
    "latency": Report(
        "FILE...", "Measure the time to the image of each level.", LATENCY, _latency_options, _latency, False
    ),
}


def parser(name: str | None = None) -> options.Parser:
    """Returns the options of a report, or of `pd4dgs-bench` if `name` is None."""
    if name is not None:
        report = REPORTS[name]
        p = options.Parser(f"bench {name}", report.usage, report.summary, report.details)
        report.add_options(p)
        if report.plot:
            what = "plot error against cost on log axes, with the Pareto front"
            p.add("-o, --plot FILE.png", what, options.ending(".png"))
        return p.add_common(json_file=True)
    lines = [f"  {name:<11} {report.summary}" for name, report in REPORTS.items()]
    examples = [f"  pd4dgs-bench {name} --help" for name in REPORTS]
    details = "\n".join(["REPORT is one of", *lines, "", "examples:", *examples])
    summary = "Measure error against run time, and latency."
    p = options.Parser("bench", "REPORT", summary, details)
    p.add("report REPORT", "report to make, see below", choices=tuple(REPORTS))
    return p.add_common()


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] not in REPORTS:
        return common.run(parser(), _misplaced, arguments)
    return common.run(parser(arguments[0]), partial(_report, REPORTS[arguments[0]].execute), arguments[1:])


def _misplaced(args: argparse.Namespace, console: Console) -> int:
    raise UsageError(f"found options before {args.report!r}, expected the report first")


def _report(execute: Callable[[argparse.Namespace], Outcome], args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.io import finite, whole_file

    console.json = args.json == STDIO
    plot = getattr(args, "plot", None)
    for path in (plot, args.json):
        if path is not None:
            common.check_output(path, args.overwrite)
    found = execute(args)
    if plot is not None:
        from pd4dgs_codec.bench.report import draw

        with whole_file(plot, args.overwrite) as temporary:
            draw(found.panels, found.error, temporary)
    if args.json not in (None, STDIO):
        text = json.dumps(finite(found.result), indent=1) + "\n"
        common.write_bytes(args.json, text.encode(), args.overwrite)
    console.result(found.result, found.text, on_stdout=True)
    return OK
