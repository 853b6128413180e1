"""Makes every figure and picture of docs/results.md at the commit that is checked out.

    python benchmarks/run.py                       # everything; benchmarks/README.md has the times
    python benchmarks/run.py --only quality speed  # these sections; the others stay as they are
    python benchmarks/run.py --quick               # a tiny scene, to see that all of it works; docs/ stays as it is
    python benchmarks/run.py --check               # names the sections whose measured code has changed since

Writes docs/results.md, docs/figures/results.json and docs/img/ after each section, the most important first. Trainings
and files stay below -o: the same command with --resume continues an interrupted run. Real scenes are read from the
folder that PD4DGS_SHARED names, by default ../shared/data beside the repository; scenes that are not there are left
out. Stops at the first benchmark that fails.
"""

from __future__ import annotations

import argparse
import ast
import datetime
import json
import os
import sys
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import codec
import delivery
import paper
import quality
import refining_gif
from common import QUICK, ROOT, SCENES, Benchmark, Row, Run, available, commit, git, say
from page import write

from pd4dgs_codec import sample
from pd4dgs_codec.bench.report import machine, machine_line
from pd4dgs_codec.errors import DataError, Pd4Error

ALL = (
    quality.BENCHMARK,
    delivery.SLICES,
    paper.PAPER,
    paper.DIAL,
    codec.CODERS,
    codec.SPEED,
    codec.ERROR,
    delivery.LATENCY,
    delivery.PLAYER,
    codec.BATCH,
    codec.EXPORT,
)
#: What a docstring can begin.
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def section(benchmark: Benchmark, run: Run, names: Sequence[str], made: Row) -> Row:
    """Measures one benchmark: its figures, and what they were made with (`made`: commit and command)."""
    scenes: list[Any] = [None]
    if benchmark.scenes:
        scenes = [QUICK] if run.quick else list(available([n for n in benchmark.scenes if n in names]))
    if not scenes:
        raise DataError(f"{benchmark.name}: found none of the scenes {', '.join(benchmark.scenes)}")
    start, rows = time.monotonic(), []
    run.train(job for scene in scenes if scene for job in benchmark.trainings(run, scene))
    for scene in scenes:
        say(f"{benchmark.name}{f': {scene.name}' if scene else ''}")
        rows += benchmark.measure(run, scene)
    return {
        "name": benchmark.name,
        **made,
        "date": datetime.date.today().isoformat(),
        "machine": machine_line(machine() | {"load_average": None}),
        "minutes": (time.monotonic() - start) / 60,
        "rows": rows,
        "pictures": benchmark.pictures(rows, run.images),
    }


def outdated(sections: Sequence[Row]) -> list[str]:
    """A line for every section whose measured code has changed since it was made."""
    lines, measured = [], {benchmark.name: benchmark.measured for benchmark in ALL}
    for name, made in ((found["name"], found["commit"]) for found in sections):
        if paths := changed(made.partition(",")[0], *measured[name]):
            more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            lines.append(f"{name}: made at {made}; changed since: {paths[0]}{more}")
    return lines


@cache
def changed(commit: str, *folders: str) -> list[str]:
    """The files that do something else than at a commit; all if the commit is not in the history."""
    if not git("cat-file", "-t", commit):
        return git("ls-files", *folders).splitlines()
    paths = git("diff", "--name-only", commit, "HEAD", "--", *folders).splitlines()
    return [path for path in paths if code(commit, path) != code("HEAD", path)]


def code(commit: str, path: str) -> str:
    """The syntax tree of a Python file without its docstrings; the text of another file."""
    text = git("show", f"{commit}:{path}")
    if not path.endswith(".py"):
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node):
            del node.body[0]
    return ast.dump(tree)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    names = [benchmark.name for benchmark in ALL]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"sections: {', '.join(names)}")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, metavar="SCENE", help=f"scenes: {', '.join(SCENES)}")
    parser.add_argument("--seeds", type=int, default=1, help="trainings per scene in the section quality (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="a tiny scene; without the player unless --only names it")
    parser.add_argument("--resume", action="store_true", help="keep the sections that were made at this commit")
    parser.add_argument("--render", action="store_true", help="render the page from its figures without measuring")
    what = "name sections whose measured code has changed (without comments); exit code 1 if any"
    parser.add_argument("--check", action="store_true", help=what)
    out, what = ROOT / "out" / "benchmarks", "folder of checkpoints and files (%(default)s)"
    parser.add_argument("-o", "--out", type=Path, default=out, help=what)
    parser.add_argument("--docs", type=Path, help="folder of the page (docs; with --quick OUT/docs)")
    args = parser.parse_args(argv)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each process that is timed would compile its modules anew
    docs = args.docs or (args.out / "docs" if args.quick else ROOT / "docs")
    run = Run(args.out.resolve(), docs / "img", args.quick, args.seeds)
    asked = args.only or [name for name in names if not (args.quick and name == "player")]
    given = [word for word in (sys.argv[1:] if argv is None else argv) if word != "--resume"]
    made = {"commit": commit(), "command": " ".join(["python benchmarks/run.py", *given])}
    stored = docs / "figures" / "results.json"
    kept = {found["name"]: found for found in json.loads(stored.read_text())["sections"]} if stored.is_file() else {}
    if args.check:
        lines = outdated(list(kept.values()))
        print("\n".join(lines or ["no section's measured code has changed"]))
        return bool(lines)
    run.images.mkdir(parents=True, exist_ok=True)
    scenes = args.scenes or [name for name, scene in SCENES.items() if scene.usual]
    if args.resume:
        asked = [name for name in asked if any(kept.get(name, {}).get(key) != made[key] for key in made)]
    if not (args.only or args.render):  # rows of other commits may lack what a section shows today
        kept = {name: found for name, found in kept.items() if name not in asked}
    try:
        for benchmark in ALL:
            if benchmark.name in asked and not args.render:
                kept[benchmark.name] = section(benchmark, run, scenes, made)
                write(docs, ALL, kept)
                if benchmark is delivery.SLICES:
                    refining_gif.draw(sample().read_bytes(), None, run.images / "refining.gif")
        if args.render:
            write(docs, ALL, kept)
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        say(f"run: error: {str(error) or 'interrupted; --resume continues'}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
