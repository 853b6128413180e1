"""`pd4dgs-bench latency`: seconds from the request to bytes and to pictures, and what faults on the way do."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING

from pd4dgs_codec.atomic import whole_file
from pd4dgs_codec.bench.latency.published import FIRST_FRAME
from pd4dgs_codec.cli.bench.output import prepare, publish
from pd4dgs_codec.cli.common import (
    FAILED,
    OK,
    SOURCES,
    Console,
    Parser,
    UsageError,
    count,
    positive_int,
    rates,
    use_threads,
)
from pd4dgs_codec.cli.progress import progress_bar

if TYPE_CHECKING:
    from pd4dgs_codec.bench.latency.faults import Cuts, File, Row
    from pd4dgs_codec.bench.latency.table import FileReport

SECTIONS = ("times", "faults")
DETAILS = f"""\
Prints Markdown. The section times: per rate and level the bytes of the prefix S, 8S/B, the median time to their last
byte over the paced link of pd4dgs-serve, and to a picture on the CPU in a warm and in a cold process, with the file's
own camera; beside the published sizes of monolithic models. The section faults, of the first FILE: what the client does
on links and servers that fail, random cuts, and 64 clients at once.

The exit code is 1 if a picture under faults is not the right one; times never fail. They need a quiet machine.
A file takes about (8S/B + 2 s) x 3 x runs at each rate, the faults two to three minutes.

{SOURCES}

examples:
  pd4dgs-bench latency scene.pd4 > latency.md
  pd4dgs-bench latency scene.pd4 --data recordings/kitchen --downscale 2 --plot latency.png --json latency.json
  pd4dgs-bench latency scene.pd4 --anchors 25000 --size 480x360 --only times --rates 10M"""


def parser() -> Parser:
    """The options of the report."""
    p = Parser("bench latency", "FILE...", "Measure how long the first picture takes, and the next ones.", DETAILS)
    p.add_argument("inputs", nargs="+", metavar="FILE", help=".pd4 files that hold a camera")
    p.add_argument(
        "--rates", type=rates, default="2M,10M,50M", metavar="R", help="rates of the link (default: 2M,10M,50M)"
    )
    p.add_argument(
        "--runs", type=positive_int, default=9, metavar="N", help="runs that medians are taken of (default: 9)"
    )
    p.add_argument("--only", choices=SECTIONS, help="leave out the other section")
    p.add_argument("--size", type=_size, metavar="WxH", help="of the pictures (default: that of the file's camera)")
    p.add_argument(
        "--anchors",
        type=positive_int,
        metavar="N",
        help="measure a scene of N anchors in layer 0: those of FILE, and copies moved by up to 3 voxels",
    )
    p.add_argument(
        "--cuts", type=count, default=1000, metavar="N", help="random cuts to survive, 0: none (default: 1000)"
    )
    p.add_argument(
        "--data", action="append", default=[], metavar="SOURCE", help="dataset to take quality from, one per FILE"
    )
    p.add_argument(
        "--downscale",
        type=positive_int,
        default=1,
        metavar="K",
        help="use its images 1/K as wide and high (default: 1)",
    )
    p.add_argument("--plot", metavar="FILE.png", help="quality over seconds since the request, of the first FILE")
    p.add_common(json_file=True)
    return p


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if match is None or max(int(part) for part in match.groups()) > 65535:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a size in pixels such as 480x360")
    return int(match[1]), int(match[2])


def execute(args: argparse.Namespace, console: Console) -> int:
    """Runs the sections; FAILED if the client showed something wrong under faults."""
    _check_usage(args)
    prepare(args, console)
    use_threads(args)
    from pd4dgs_codec.bench.latency import faults, measure, plot, table
    from pd4dgs_codec.model.warm import warm_up

    contents = [_content(name, args) for name in args.inputs]
    reports: list[FileReport] = []
    rows: list[Row] = []
    cuts = crowd = None
    if args.only != "faults":
        warm_up()
        with progress_bar(3 * args.runs * len(args.rates) * len(contents), "runs", "times") as step:
            for i, (name, data) in enumerate(zip(args.inputs, contents, strict=True)):
                reports.append(_report(name, data, args.data[i] if args.data else None, args, step))
    if args.only != "times":
        file = faults.File(contents[0])
        rows, cuts = _faults(file, args.cuts)
        crowd = measure.crowd(contents[0])
    if args.plot:
        with whole_file(args.plot, args.overwrite) as temporary:
            plot.draw(reports[0], rows, temporary)
    result = {
        "runs": args.runs,
        "rates": args.rates,
        "files": [asdict(r) | {"times": [asdict(t) | {"within": t.within} for t in r.times]} for r in reports],
        "published_megabytes": {row.method: row.megabytes for row in FIRST_FRAME},
        "faults": [asdict(row) for row in rows],
        "random_cuts": cuts and asdict(cuts),
        "crowd": crowd and asdict(crowd),
    }
    publish(args, console, result, table.text(reports, args.runs, rows, cuts, crowd))
    wrong = [row.name for row in rows if not row.kept]
    wrong += ["random cuts"] if cuts and cuts.wrong else []
    wrong += [f"{crowd.clients} clients at once"] if crowd and crowd.errors else []
    for name in wrong:
        console.message(f"fail: {name}")
    return FAILED if wrong else OK


def _check_usage(args: argparse.Namespace) -> None:
    if args.data and len(args.data) != len(args.inputs):
        raise UsageError(f"found {len(args.data)} --data for {len(args.inputs)} files, expected one each or none")
    if args.plot and args.only == "faults":
        raise UsageError("--plot shows the times, which --only faults leaves out; expected one of them")


def _content(name: str, args: argparse.Namespace) -> bytes:
    """The bytes of a valid file with a camera, enlarged if asked for."""
    from pd4dgs_codec.bench.latency.enlarge import with_anchors
    from pd4dgs_codec.cli.files import read_bytes
    from pd4dgs_codec.codec.decoder import decode
    from pd4dgs_codec.errors import DataError, DecodeError

    data = read_bytes(name)
    try:
        scene = decode(data)
        if scene.info.camera is None:
            raise DataError("holds no camera to draw pictures with")
        return data if args.anchors is None else with_anchors(data, args.anchors)
    except (DecodeError, DataError) as error:
        raise DataError(f"{name}: {error}") from None


def _report(
    name: str, data: bytes, source: str | None, args: argparse.Namespace, step: Callable[[], None]
) -> FileReport:
    from pd4dgs_codec.bench.latency import measure
    from pd4dgs_codec.bench.latency.table import FileReport
    from pd4dgs_codec.codec.decoder import decode
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.view.evaluate import evaluate_file

    base = decode(data, max_layer=0)
    assert base.info.camera is not None
    size = args.size or (base.info.camera.width, base.info.camera.height)
    quality = None
    if source is not None:
        levels = evaluate_file(data, load(source, downscale=args.downscale))["levels"]
        quality = [row["mpsnr"] for row in levels]
    return FileReport(
        name=name,
        bytes=len(data),
        anchors=int((base.mask[0] > 0).sum()),
        size=size,
        times=measure.times(data, list(args.rates.values()), args.runs, size, step),
        quality=quality,
        first_start=measure.first_start(data, max(args.rates.values()), size),
    )


def _faults(file: File, cuts: int) -> tuple[list[Row], Cuts | None]:
    from pd4dgs_codec.bench.latency import faults

    chosen = faults.scenarios(file)
    with progress_bar(len(chosen), "faults", "faults") as step:
        rows = faults.run_all(file, chosen, step)
    if not cuts:
        return rows, None
    with progress_bar(None, "transfers", "cuts") as step:
        return rows, faults.random_cuts(file, cuts, step=step)
