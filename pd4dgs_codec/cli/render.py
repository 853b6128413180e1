"""`pd4dgs-render`: images of a `.pd4` file or a checkpoint."""

from __future__ import annotations

import argparse
import re
import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, STDIO, Console, UsageError, command, progress_bar
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.io import whole_file, whole_files
from pd4dgs_codec.threads import load_numba

if TYPE_CHECKING:
    import numpy as np

    from pd4dgs_codec.quality.frames import Frame
    from pd4dgs_codec.quality.levels import Level

DETAILS = f"""\
Renders the file's own camera over its time range, or with --data the views of a dataset at their times.
The suffix of -o decides the kind: .gif and .mp4 are videos, .png, .jpg, .webp and .bmp images.

{options.SOURCES}

examples:
  pd4dgs-render scene.pd4 -o middle.png --time 0.5
  pd4dgs-render scene.pd4 -o scene.gif --orbit 20
  pd4dgs-render scene.pd4 -o scene.mp4 --duration 4 --fps 30
  pd4dgs-render scene.pd4 -o levels.mp4 --side-by-side --data synthetic:local
  pd4dgs-render scene.pd4 -o out/%04d.png --level 0 --data recordings/kitchen --split test --downscale 2"""

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
VIDEOS = (".gif", ".mp4")
FRAMES, MAX_FRAMES, FPS = 60, 100_000, 20.0
#: Options of which one replaces the other.
EXCLUSIVE = (("data", "orbit"), ("data", "duration"), ("data", "time"), ("time", "orbit"), ("time", "frames"),
             ("duration", "frames"))  # fmt: skip
MAX_GIF_FPS = 50  #: browsers slow down pictures that are shown for a shorter time


def parser() -> options.Parser:
    p = options.Parser("render", "FILE -o OUT", "Render a .pd4 file or a checkpoint to images or a video.", DETAILS)
    p.add("input FILE", ".pd4 file or .pt checkpoint; - reads a .pd4 from stdin")
    p.add("-o, --output OUT", "images such as out/%%04d.png, or a .gif or .mp4 video", required=True)
    options.add_prefix(p.add, "render")
    options.add_background(p.add, "the file's")
    p.add("--data SOURCE", "take cameras, times and ground truth from this dataset")
    p.add("--split", "views of the dataset (default: test)", choices=("test", "train"))
    options.add_reading(p.add, unset=("holdout",))
    p.add("--time T", "render a single image at time T, as 0..1 of the file's time range", options.share)
    what = f"number of evenly spaced frames (default: {FRAMES}, or one image of a static scene); with "
    what += "--data, of evenly spread views (default: all)"
    p.add("--frames N", what, options.positive_int)
    what = "swing the file's camera by DEG degrees about its look-at point (default: 0)"
    p.add("--orbit DEG", what, options.finite_float)
    p.add("--fps F", f"frame rate of a video (default: {FPS:g})", options.fps)
    what = f"length of a video, such as 4s, in place of --frames (default: {FRAMES} frames)"
    p.add("--duration S", what, options.duration)
    what = "show all levels side by side, with --data beside the ground truth; a.png gets a row per frame"
    p.add("--side-by-side", what)
    return p.add_common()


def _render(args: argparse.Namespace, console: Console) -> int:
    kind = _check_usage(args)
    if kind in VIDEOS:
        common.check_output(args.output, args.overwrite)
    load_numba()
    from pd4dgs_codec.quality.levels import load_levels

    if kind == ".mp4":
        from pd4dgs_codec.quality.frames import check_mp4

        check_mp4()
    file, last = common.named_input(args.input), not args.side_by_side
    levels = load_levels(file, args.level, max_bytes=args.max_bytes, last_only=last, background=args.background)
    found = ", ".join(f"{row.level} ({row.anchors} anchors)" for row in levels)
    console.detail(f"{common.shown_name(args.input)}: levels {found}")
    frames = _frames(args, kind, levels[-1])
    if kind in VIDEOS and len({(frame.camera.width, frame.camera.height) for frame in frames}) > 1:
        raise DataError(f"{args.data}: found views of several sizes, expected one size, or -o such as out/%04d.png")
    milliseconds: list[float] = []
    with progress_bar(len(frames), "frames", "rendering") as step:
        outputs = _write(args, kind, _pictures(frames, levels, args.side_by_side, milliseconds, step), len(frames))
    result = {
        "input": args.input,
        "output": args.output,
        "outputs": outputs,
        "frames": len(frames),
        "width": frames[0].camera.width,
        "height": frames[0].camera.height,
        "levels": [level.level for level in levels],
        "render_ms": statistics.median(milliseconds),
    } | ({"seconds": len(frames) / args.fps} if kind in VIDEOS else {})
    console.result(result, _text(result))
    return OK


main = command(parser, _render)


def _check_usage(args: argparse.Namespace) -> str:
    """Returns the lower-case suffix of the output. Raises UsageError for options that do not fit."""
    kind = Path(args.output).suffix.lower()
    if args.output == STDIO or kind not in (*PICTURES, *VIDEOS):
        raise UsageError(f"found -o {args.output}, expected images such as out/%04d.png, or a .gif or .mp4")
    common.check_other_file(args.input, args.output)
    for one, other in EXCLUSIVE:
        if None not in (getattr(args, one), getattr(args, other)):
            raise UsageError(f"found --{one} and --{other}, expected one of them")
    options.conditional(args, args.data, "needs --data SOURCE", split="test", holdout=options.READING["holdout"])
    options.conditional(args, kind in VIDEOS, "needs a .gif or .mp4 as -o", fps=FPS, duration=None)
    options.conditional(args, kind not in VIDEOS, "needs an image such as a.png as -o", time=None)
    if kind == ".gif" and args.fps > MAX_GIF_FPS:
        raise UsageError(f"found --fps {args.fps:g}, expected at most {MAX_GIF_FPS:g} for a .gif")
    if kind not in VIDEOS and "%" in args.output:
        name = Path(args.output).name
        if not re.fullmatch(r"[^%]*%(0?[1-9]\d?)?d[^%]*", name) or "%" in str(Path(args.output).parent):
            raise UsageError(f"found -o {args.output}, expected one frame number such as %04d in the file name")
    return kind


def _frames(args: argparse.Namespace, kind: str, level: Level) -> list[Frame]:
    from pd4dgs_codec.quality.frames import dataset_frames, own_frames

    if args.time is not None:
        return [replace(own_frames(level.model.info, 1, downscale=args.downscale)[0], time=args.time)]
    if args.data is None:
        same = level.still and args.orbit is None and kind not in VIDEOS
        count = 1 if same else FRAMES if args.duration is None else max(1, round(args.duration * args.fps))
        count = args.frames or count
        if count > MAX_FRAMES:
            raise UsageError(f"found {count:,} frames, expected at most {MAX_FRAMES:,}")
        return own_frames(level.model.info, count, args.orbit or 0.0, args.downscale)
    dataset = common.read_dataset(args.data, args, level.model.info)
    views = dataset.test if args.split == "test" else dataset.train
    if not views:
        raise DataError(f"{args.data}: has no held-out views; expected --split train or another --holdout")
    return dataset_frames(views, args.frames)


def _pictures(
    frames: list[Frame], levels: list[Level], beside: bool, milliseconds: list[float], step: Callable[[], None]
) -> Iterator[np.ndarray]:
    """Yields uint8 [H, W, 3] per frame: one level, or all levels beside the ground truth. Appends the time of each
    picture to `milliseconds`."""
    from pd4dgs_codec.quality.frames import Panel, level_panels, side_by_side

    for frame in frames:
        panels = level_panels(levels, frame)
        milliseconds += [panel.milliseconds for panel in panels]
        if frame.truth is not None:
            panels.append(Panel(frame.truth, "ground truth"))
        yield side_by_side(panels) if beside else panels[0].picture
        step()


def _write(args: argparse.Namespace, kind: str, pictures: Iterator[np.ndarray], count: int) -> int:
    """Writes all pictures; returns the number of files."""
    from pd4dgs_codec.quality.frames import stacked, write_gif, write_mp4, write_pictures

    if kind in VIDEOS:
        with whole_file(args.output, args.overwrite) as temporary:
            (write_gif if kind == ".gif" else write_mp4)(pictures, temporary, args.fps)
        return 1
    numbered = "%" in args.output
    if args.side_by_side and not numbered:
        pictures, count = iter([stacked(list(pictures))]), 1
    if count > 1 and not numbered:
        raise UsageError(
            f"found -o {args.output} for {count} images, expected a frame number such as %04d in it, or --time 0.5"
        )
    names = [args.output % i if numbered else args.output for i in range(count)]
    with whole_files(names, args.overwrite, args.output) as temporaries:
        write_pictures(pictures, temporaries)
    return len(names)


def _text(result: dict[str, Any]) -> str:
    levels = ", ".join(map(str, result["levels"]))
    size = f"{result['width']}x{result['height']}"
    speed = f"{result['render_ms']:.1f} ms per frame"
    count = f"{result['frames']} frames" if result["frames"] > 1 else "1 frame"
    lasts = f", {result['seconds']:.3g} s" if "seconds" in result else ""
    return f"{result['output']}: {count} of {size}{lasts}, level {levels}, {speed}"
