"""`pd4dgs-prepare`: a video, or its frames -> a folder that `pd4dgs-train` reads."""

import argparse
from pathlib import Path
from typing import Any

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, Console, command, progress_bar, say
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.prepare import FEWEST_FRAMES

CAMERAS = ("SIMPLE_RADIAL", "SIMPLE_PINHOLE", "PINHOLE", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
FRAMES = options.checked(int, lambda n: n == 0 or n >= FEWEST_FRAMES, f"0 or an integer >= {FEWEST_FRAMES}")
DETAILS = """\
INPUT is a video, or a folder of frames whose names end with their numbers.
Frames are chosen evenly over time, without blurred and repeated ones. pycolmap estimates the camera poses (pip install
'pd4dgs-codec[prepare]'). Features off their predicted positions in a static scene count as moving, and the
poses are refined without them. Training images are not masked.

FOLDER then holds images/, times.txt, sparse/0 (a COLMAP model), report.json and report.png. FOLDER.partial holds
intermediate results; after Ctrl-C, the same command resumes from them.

examples:
  pd4dgs-prepare kitchen.mp4 -o kitchen
  pd4dgs-prepare kitchen.mp4 -o kitchen --frames 200 --downscale 2
  pd4dgs-train kitchen -o kitchen.pt"""


def parser() -> options.Parser:
    p = options.Parser("prepare", "INPUT -o FOLDER", "Estimate the camera poses of a video.", DETAILS)
    p.add("input INPUT", "video or folder of frames", options.named)
    p.add("-o, --output FOLDER", "output folder", options.named, required=True)
    p.add("--frames N", "use at most N frames (default: 120; 0: all)", FRAMES, default=120)
    p.add("--fps F", "frame rate of a folder of frames (default: 30)", options.fps)
    p.add("--downscale K", "downscale images by K (default: 1)", options.positive_int, default=1)
    p.add("--camera", f"COLMAP camera model (default: {CAMERAS[0]})", choices=CAMERAS, default=CAMERAS[0])
    return p.add_common()


def check_usage(args: argparse.Namespace) -> None:
    """Sets conditional defaults. Raises UsageError for options that do not fit together."""
    from pd4dgs_codec.data.colmap import VIDEOS

    path = Path(args.input)
    video = path.suffix.lower() in VIDEOS and not path.is_dir()  # a URI has no more than a name
    options.conditional(args, not (video or path.is_file()), "needs a folder of frames", fps=30.0)


def _prepare(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.prepare.stages import Options, prepare

    check_usage(args)
    chosen = Options(args.frames, args.fps, args.downscale, args.camera, args.threads or -1)
    try:
        report = prepare(Path(args.input), Path(args.output), chosen, progress_bar, args.overwrite, say)
    except KeyboardInterrupt:
        raise DataError(f"interrupted; the same command resumes from {args.output}.partial") from None
    console.result({"output": args.output, **report}, _text(args.output, report))
    return OK


main = command(parser, _prepare)


def _text(output: str, report: dict[str, Any]) -> str:
    frames = report["frames"]
    found = f"{frames['registered']} of {frames['chosen']} frames have poses"
    left = f"of {frames['seen']}, {frames['blurred']} blurred and {frames['repeated']} repeated left out"
    lines = [
        f"{output}: {found} ({left})",
        f"reprojection error {report['reprojection_error']:.2f} pixels, {report['points']:,} points, "
        f"{100 * report['moving_share']:.0f} % of the features move",
    ]
    lines += [f"advice: {line}" for line in report["advice"]]
    return "\n".join([*lines, f"see {output}/report.png"])
