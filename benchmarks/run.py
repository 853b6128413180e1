"""Makes every figure and picture of docs/results.md at the commit that is checked out.

    python benchmarks/run.py                       # everything; benchmarks/README.md has the times
    python benchmarks/run.py --only quality speed  # these sections; the others stay as they are
    python benchmarks/run.py --quick               # a tiny scene, to see that all of it works; docs/ stays as it is

Writes docs/results.md, docs/figures/results.json and docs/img/. Trainings and files stay below -o, so that an
interrupted run continues. Real scenes are read from the folder that PD4DGS_SHARED names, by default ../shared/data
beside the repository; scenes that are not there are left out. Stops at the first benchmark that fails.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import codec
import delivery
import paper
import quality
import refining_gif
from common import QUICK, ROOT, SCENES, Benchmark, Row, Run, commit, present, say
from page import write

from pd4dgs_codec.bench.report import machine, machine_line
from pd4dgs_codec.errors import DataError, Pd4Error

ALL = (
    quality.BENCHMARK,
    paper.PAPER,
    paper.DIAL,
    delivery.SLICES,
    delivery.LATENCY,
    delivery.PLAYER,
    codec.SPEED,
    codec.ERROR,
    codec.RIVALS,
    codec.EXPORT,
    codec.STABILITY,
    codec.BATCH,
)
#: The scene of the animation.
ANIMATED = "shelf-hand"


def section(benchmark: Benchmark, run: Run, names: Sequence[str], line: str) -> Row:
    """Measures one benchmark: its figures, and what they were made with."""
    scenes: list[Any] = [None]
    if benchmark.scenes:
        scenes = [QUICK] if run.quick else list(present([n for n in benchmark.scenes if n in names]))
    if not scenes:
        raise DataError(f"{benchmark.name}: none of the scenes {', '.join(benchmark.scenes)} is there")
    start, rows = time.monotonic(), []
    for scene in scenes:
        say(f"{benchmark.name}{f': {scene.name}' if scene else ''}")
        rows += benchmark.measure(run, scene)
    return {
        "name": benchmark.name,
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "command": line,
        "machine": machine_line(machine() | {"load_average": None}),
        "minutes": (time.monotonic() - start) / 60,
        "rows": rows,
        "pictures": benchmark.pictures(rows, run.images),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    names = [benchmark.name for benchmark in ALL]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"some of {', '.join(names)}")
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), metavar="SCENE", help=f"of {', '.join(SCENES)}")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each scene in quality (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="a tiny scene; without the player unless --only names it")
    parser.add_argument("--render", action="store_true", help="make the page from its figures and measure nothing")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "out" / "benchmarks", help="trainings and files")
    parser.add_argument("--docs", type=Path, help="folder of the page (docs; with --quick OUT/docs)")
    args = parser.parse_args(argv)
    docs = args.docs or (args.out / "docs" if args.quick else ROOT / "docs")
    run = Run(args.out.resolve(), docs / "img", args.quick, args.seeds)
    run.images.mkdir(parents=True, exist_ok=True)
    asked = args.only or [name for name in names if not (args.quick and name == "player")]
    line = " ".join(["python benchmarks/run.py", *(sys.argv[1:] if argv is None else argv)])
    stored = docs / "figures" / "results.json"
    kept = {found["name"]: found for found in json.loads(stored.read_text())["sections"]} if stored.is_file() else {}
    try:
        for benchmark in ALL:
            if benchmark.name in asked and not args.render:
                kept[benchmark.name] = section(benchmark, run, args.scenes or list(SCENES), line)
                write(docs, ALL, kept)
        if args.render:
            write(docs, ALL, kept)
        elif "slices" in asked:
            file = run.folder(QUICK if args.quick else SCENES[ANIMATED]) / "slices.pd4"
            if file.is_file():
                refining_gif.draw(file.read_bytes(), run.images / "refining.gif")
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        say(f"run: error: {str(error) or 'interrupted; the same command continues'}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
