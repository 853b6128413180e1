"""Measures what docs/latency.md shows: its tables, docs/img/latency.png and docs/latency.json.

    python tools/latency.py [--trained out] [--docs docs] [--runs 9]

Reads what tools/results.py trained, and the scene in PD4DGS_SHARED for the quality axis. About 12 minutes on two quiet
cores; on busy ones the times are worthless.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from results import SHARED

#: The tables of docs/latency.md stand below this line.
MARKER = "<!-- latency: written by tools/latency.py -->"
DATA = SHARED / "shelf-hand"
FILES = ("shelf-hand/scene.pd4", "shelf-hand-paper/scene.pd4")
ANCHORS, SIZE, RATE = 25_000, "480x360", "10M"


def bench(folder: Path, *options: object) -> str:
    """What `pd4dgs-bench latency` prints, run in `folder` so that its tables name files from there on."""
    command = [sys.executable, "-m", "pd4dgs_codec", "bench", "latency", *map(str, options)]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(done.returncode)
    return done.stdout


def main() -> None:
    """Writes the page, or nothing if a measurement fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trained", type=Path, default=Path("out"), help="folder of NAME/scene.pd4")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--runs", type=int, default=9)
    args = parser.parse_args()
    page, docs = args.docs / "latency.md", args.docs.absolute()
    for path in (page, *(args.trained / name for name in FILES)):
        if not path.is_file():
            sys.exit(f"latency: error: {path} is not there")
    text = page.read_text().split(MARKER)[0]
    source = ["--data", DATA.absolute()] * len(FILES) + ["--downscale", 2] if DATA.exists() else []
    outputs = ["--plot", docs / "img" / "latency.png", "--json", docs / "latency.json", "--overwrite"]
    tables = bench(args.trained, *FILES, "--runs", args.runs, *source, *outputs)
    larger = ["--anchors", ANCHORS, "--size", SIZE, "--rates", RATE, "--only", "times"]
    more = bench(args.trained, FILES[1], "--runs", args.runs, *larger)
    first = more.split("\n## Beside")[0].rstrip()
    page.write_text(f"{text}{MARKER}\n\n{tables.rstrip()}\n\n{first}\n")


if __name__ == "__main__":
    main()
