"""`pd4dgs-prepare`: a video, or its frames -> a folder that `pd4dgs-train` reads."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pd4dgs_codec.cli import values
from pd4dgs_codec.cli.common import OK, Console, Parser, UsageError, command
from pd4dgs_codec.cli.files import STDIO
from pd4dgs_codec.cli.progress import progress_bar
from pd4dgs_codec.errors import DataError

CAMERAS = ("SIMPLE_RADIAL", "SIMPLE_PINHOLE", "PINHOLE", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
DETAILS = """\
INPUT is a video, or a folder of frames whose names end with their numbers. Frames are spread over its time; those that
are blurred or repeat the one before are left out. pycolmap finds the camera's poses (pip install
'pd4dgs-codec[prepare]'). Things that move are told apart by where their features should be if they stood still, and
the poses are found again without them; nothing is masked for the training.

FOLDER then holds images/, times.txt, sparse/0 (a model of COLMAP), report.json and report.png. Until then the work lies
in FOLDER.partial, and the same command goes on from it after Ctrl-C.

examples:
  pd4dgs-prepare kitchen.mp4 -o kitchen
  pd4dgs-prepare kitchen.mp4 -o kitchen --frames 200 --downscale 2
  pd4dgs-train kitchen -o kitchen.pt"""


def parser() -> Parser:
    """The options of `pd4dgs-prepare`."""
    p = Parser("prepare", "INPUT -o FOLDER", "Find the camera's poses in a recording.", DETAILS)
    p.add_argument("input", metavar="INPUT", help="a video, or a folder of frames")
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="folder to make")
    p.add_argument("--frames", type=values.count, default=120, metavar="N", help="at most (default: 120; 0: all)")
    what = "of a folder of frames: how many were taken per second (default: 30)"
    p.add_argument("--fps", type=values.positive_float, default=30.0, metavar="F", help=what)
    what = "write pictures 1/K as wide and high (default: 1)"
    p.add_argument("--downscale", type=values.positive_int, default=1, metavar="K", help=what)
    what = "how the lens bends: COLMAP's model (default: SIMPLE_RADIAL, of one coefficient)"
    p.add_argument("--camera", choices=CAMERAS, default=CAMERAS[0], help=what)
    p.add_common()
    return p


def _prepare(args: argparse.Namespace, console: Console) -> int:
    if STDIO in (args.input, args.output):
        raise UsageError("found -, expected the names of a recording and of a folder to make")
    from pd4dgs_codec.prepare.stages import Choices, prepare

    choices = Choices(args.frames, args.fps, args.downscale, args.camera, args.threads or -1)
    try:
        report = prepare(Path(args.input), Path(args.output), choices, progress_bar, args.overwrite)
    except KeyboardInterrupt:
        raise DataError(f"interrupted; the same command goes on from {args.output}.partial") from None
    console.result({"output": args.output, **report}, _text(args.output, report), on_stdout=False)
    return OK


main = command(parser, _prepare)


def _text(output: str, report: dict[str, Any]) -> str:
    frames = report["frames"]
    found = f"{frames['registered']} of {frames['chosen']} frames have poses"
    left = f"{frames['blurred']} blurred and {frames['repeated']} repeated of {frames['seen']} left out"
    lines = [
        f"{output}: {found} ({left})",
        f"reprojection error {report['reprojection_error']:.2f} pixels, {report['points']:,} points, "
        f"{100 * report['moving_share']:.0f} % of the features move",
    ]
    lines += [f"record better: {line}" for line in report["advice"]]
    return "\n".join([*lines, f"{output}/report.png shows more"])
