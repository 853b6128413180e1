"""`pd4dgs-bench render`: the rasteriser's error against milliseconds."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from pd4dgs_codec.cli.bench.output import add_output, add_views, finish, listed, prepare
from pd4dgs_codec.cli.common import OK, Console, Parser, UsageError, positive_int, use_threads
from pd4dgs_codec.cli.files import named_input
from pd4dgs_codec.cli.progress import progress_bar

DETAILS = """\
The Gaussians of the highest level, as each camera meets them, are drawn in several ways, and each picture is compared
with that of a float64 oracle written from the formulas: the same formulas in float32; the CPU kernels as they are, with
other tiles, with other thresholds; gsplat where there is a CUDA device. Times are of rasterising alone.

Kernels with other constants are compiled first, some 20 s each; --cache keeps them for the next run.

examples:
  pd4dgs-bench render scene.pd4 --plot render.png > render.md
  pd4dgs-bench render model.pt --data synthetic:local --views 1 --only kernels,'T > 1e-2'"""

VIEWS, REPEATS = 2, 15


def parser() -> Parser:
    """The options of the report."""
    summary = "Measure the rasteriser against a float64 oracle: error against milliseconds."
    p = Parser("bench render", "FILE", summary, DETAILS)
    p.add_argument("input", metavar="FILE", help=".pd4 file or .pt checkpoint; - reads a .pd4 from stdin")
    p.add_argument("--only", type=listed(str), metavar="NAME,...", help="these ways to draw alone")
    p.add_argument(
        "--repeats", type=positive_int, default=REPEATS, metavar="N", help=f"drawings per picture (default: {REPEATS})"
    )
    p.add_argument("--cache", metavar="FOLDER", help="where to keep compiled kernels (default: nowhere)")
    add_views(p, str(VIEWS))
    add_output(p)
    return p


def execute(args: argparse.Namespace, console: Console) -> int:
    """Draws every way."""
    prepare(args, console)
    use_threads(args)
    from pd4dgs_codec.bench import render, views
    from pd4dgs_codec.bench.machine import describe, sentence
    from pd4dgs_codec.view.levels import load_levels

    names = args.only or render.NAMES
    if unknown := [name for name in names if name not in render.NAMES]:
        raise UsageError(f"--only: found {unknown[0]!r}, expected some of {', '.join(render.NAMES)}")
    machine = describe(("gsplat",))
    level = load_levels(named_input(args.input))[-1]
    frames = views.frames(level.model.info, args.data, args.views or VIEWS, args.downscale, args.holdout)
    inputs = render.views_of(level, frames)
    with tempfile.TemporaryDirectory() as folder, progress_bar(len(names), "ways to draw", "render") as step:
        cache = Path(args.cache or folder).resolve()
        points = render.sweep(inputs, names, args.repeats, cache, step)
    pictures = [{"width": v["width"], "height": v["height"], "gaussians": len(v["means"])} for v in inputs]
    result: dict[str, Any] = {"input": args.input, "machine": machine, "level": level.level, "pictures": pictures}
    result["points"] = render.as_json(points)
    about = "; ".join(f"{v['width']}x{v['height']}, {v['gaussians']:,} Gaussians" for v in pictures)
    text = "\n\n".join([render.table(points), f"Pictures: {about}.", sentence(machine)])
    finish(args, console, result, text, render.panels(points), "RMSE against the float64 oracle")
    return OK
