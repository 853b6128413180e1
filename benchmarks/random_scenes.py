"""Trains `synthetic:random` scenes with any copy of the package and says which moving bodies are kept.

`python benchmarks/random_scenes.py 100-119 -o out/random.jsonl [--tree OTHER_CHECKOUT]` appends a row per seed to the
file and leaves out seeds that it has; `--sheet worst.png` draws the three worst from the files beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from common import ROOT, Row, number, say, table
from moving_bodies import movers
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset, View, thinned
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.quality.evaluate import evaluate
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.quality.levels import Level, load_levels

#: The key instant of every run, by default.
KEY = 0.5
#: A body counts if its radius has so many pixels and it moves by less than so many of its sizes between neighbouring
#: views. It is kept if its region is so many dB above the picture without it.
LEAST_RADIUS, FASTEST, KEPT = 3.0, 1.0, 6.0
#: Of training views as many are measured.
TRAINING_VIEWS = 32
#: A step that takes longer than so many times the median of its neighbours did something else as well.
USUAL, NEIGHBOURS = 3.0, 12
#: A key in at most so many records of a log belongs to a decision. Others are counted or are not decisions.
RARE, KNOWN = 4, {"held_out_psnr", "plane_bits", "active", "pruned", "grown"}


def in_tree(tree: Path, name: str, *arguments: object) -> Row:
    """The JSON that a command of the package in `tree` prints."""
    words = [sys.executable, "-m", "pd4dgs_codec", name, *map(str, arguments), "--json"]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(words, capture_output=True, text=True, cwd=tree, env=environment)
    if done.returncode:
        raise DataError(f"pd4dgs-{name} of {tree}: exit code {done.returncode}: {done.stderr.strip()[-400:]}")
    result: Row = json.loads(done.stdout)
    return result


def split_seconds(records: Sequence[Row]) -> tuple[float, float]:
    """Seconds of steps and of all else (trials, decisions, evaluations) after the first step, which compiles."""
    took = np.diff([record["seconds"] for record in records])
    usual = [median(took[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1]) for i in range(len(took))]
    steps = float(np.minimum(took, USUAL * np.array(usual)).sum())
    return steps, float(took.sum()) - steps


def decisions(records: Sequence[Row]) -> Row:
    """What the log says of decisions, by key; of several records the last one."""
    often = Counter(key for record in records for key in record)
    return {k: v for record in records for k, v in record.items() if often[k] <= RARE and k not in KNOWN}


def gains(source: str, level: Level, views: Sequence[View]) -> list[Row]:
    """Of each moving body: dB of its region above the picture without it, whether it counts, radius and step."""
    pictures = np.stack([np.clip(level.picture(view.camera, view.time), 0, 1) for view in views]) * 255
    truth, rows = np.stack([view.image for view in views]).astype(float), list[Row]()
    for body in movers(source, views):
        ours, without = (np.square(p - truth)[body.shown].sum() for p in (pictures, body.without.astype(float)))
        gain = 10 * float(np.log10(max(without, 1) / max(ours, 1)))
        counts = body.radius >= LEAST_RADIUS and body.step < FASTEST
        rows.append({"gain": gain, "counts": counts, "radius": body.radius, "step": body.step})
    return rows


def measured(source: str, level: Level, dataset: Dataset) -> list[Row]:
    """`gains` in held-out views, with those in training views as "seen": a body whose depth no view tells is seen."""
    seen = gains(source, level, thinned(dataset.train, TRAINING_VIEWS))
    return [row | {"seen": s["gain"]} for row, s in zip(gains(source, level, dataset.test), seen, strict=True)]


def measure(seed: int, source: str, options: Sequence[object], tree: Path, folder: Path) -> Row:
    """Trains and packs a scene; its row."""
    model, log, file = (folder / f"{seed}.{end}" for end in ("pt", "jsonl", "pd4"))
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    log.unlink(missing_ok=True)
    training = in_tree(tree, "train", source, "-o", model, "-f", "--log", log, "-j", 1, *options)
    cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    in_tree(tree, "encode", model, "-o", file, "-f")
    records = [json.loads(line) for line in log.read_text().splitlines()]
    levels, dataset = load_levels(file), load(source)
    rows = evaluate(levels, dataset)["levels"]
    near = min(abs(view.time - KEY) for view in dataset.test)
    still = [view for view in dataset.test if abs(view.time - KEY) <= near + 1e-6]
    steps, others = split_seconds(records)
    return {
        "seed": seed,
        "db": [row["mpsnr"] for row in rows],
        "moving_db": [row.get("moving_mpsnr") for row in rows],
        "key_db": mean(mpsnr(levels[0].picture(v.camera, v.time), v.image, v.mask) for v in still),
        "bodies": measured(source, levels[-1], dataset),
        "bytes": rows[-1]["cumulative_bytes"],
        "step_seconds": steps,
        "other_seconds": others,
        "cpu_seconds": cpu,
        "decided": decisions(records) | {"left_out": training["left_out"], "doubts": training["doubts"]},
    }


def kept(row: Row, views: str = "gain", *, counts: bool = True) -> tuple[int, int]:
    """(bodies that are kept, all) among those that count, or among the others; "seen": in training views."""
    gained = [body[views] for body in row["bodies"] if body["counts"] == counts]
    return sum(gain >= KEPT for gain in gained), len(gained)


def text(rows: Sequence[Row]) -> str:
    """A row per seed, then what all of them say."""

    def levels(values: Sequence[float | None]) -> str:
        return " / ".join("-" if value is None else number(value, 1) for value in values)

    cells: list[Sequence[Any]] = [
        (row["seed"], levels(row["db"]), levels(row["moving_db"]), number(row["key_db"], 1))
        + ("{} of {}".format(*kept(row)), kept(row, "seen")[0], number(row["bytes"], 0))
        + (number(row["step_seconds"], 0), number(row["other_seconds"], 0))
        for row in rows
    ]
    head = (
        "seed",
        "dB",
        "moving dB",
        "level 0 at t*",
        "kept",
        "in training views",
        "bytes",
        "s of steps",
        "s of all else",
    )
    steps, others = (sum(row[f"{what}_seconds"] for row in rows) for what in ("step", "other"))
    lines = [table(head, cells), ""]
    for name, values in (
        ("dB", [row["db"][-1] for row in rows]),
        ("moving dB", [row["moving_db"][-1] for row in rows if row["moving_db"][-1] is not None]),
        ("level 0 at t*", [row["key_db"] for row in rows]),
        ("bytes", [row["bytes"] for row in rows]),
    ):
        worst = max(values) if name == "bytes" else min(values)
        lines.append(f"{name}: mean {number(mean(values), 2)}, worst {number(worst, 2)}")
    what = ("that count", "gain", True), ("that count, in training views", "seen", True)
    for name, views, counts in (*what, ("too small or too fast", "gain", False)):
        had, of = (sum(part) for part in zip(*(kept(row, views, counts=counts) for row in rows), strict=True))
        lines.append(f"bodies {name}: {had} of {of} kept" + (f", {had / of:.0%}" if of else ""))
    lines.append(f"trials, decisions and evaluations: {others / (steps + others):.0%} of the seconds after step 1")
    return "\n".join(lines)


def sheet(rows: Sequence[Row], source: str, folder: Path, path: Path) -> None:
    """Draws the three rows with the least dB of a body that counts (then of what moves): truth and levels."""

    def badness(row: Row) -> float:
        gained: list[float] = [body["gain"] for body in row["bodies"] if body["counts"]]
        return min(gained, default=float(row["db"][-1]))

    strips = []
    for row in sorted(rows, key=badness)[:3]:
        views = load(source.format(row["seed"])).test
        shown = [views[i] for i in np.linspace(0, len(views) - 1, 8).astype(int)]
        levels = load_levels(folder / f"{row['seed']}.pd4")
        drawn = [[np.clip(level.picture(v.camera, v.time), 0, 1) * 255 for v in shown] for level in levels]
        strips += [np.concatenate(strip, axis=1) for strip in ([v.image for v in shown], *drawn)]
        say(f"seed {row['seed']}: {badness(row):.1f} dB, its truth and {len(levels)} levels")
    Image.fromarray(np.concatenate(strips).astype(np.uint8)).save(path)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("seeds", metavar="FIRST-LAST", help="seeds to train")
    add("-o", "--output", type=Path, required=True, help="JSON lines; models and files lie in the folder of its name")
    add("--tree", type=Path, default=ROOT, help="checkout whose package trains and packs (default: this one)")
    add("--frames", type=int, default=40)
    add("--side", type=int, default=112, help="pixels of the pictures' sides (default: 112)")
    add("--iterations", type=int, default=600)
    add("--option", action="append", default=[], metavar="WORD", help="further word for pd4dgs-train (repeatable)")
    add("--sheet", type=Path, help="picture of the three worst seeds to write")
    args = parser.parse_args(words)
    first, last = map(int, args.seeds.split("-"))
    pattern = f"synthetic:random?seed={{}}&frames={args.frames}&size={args.side}x{args.side}"
    folder = args.output.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    found = [json.loads(line) for line in args.output.read_text().splitlines()] if args.output.is_file() else []
    options = ["--preset", "tiny", "--iterations", args.iterations, *args.option]
    for seed in range(first, last + 1):
        if not any(row["seed"] == seed for row in found):
            found.append(measure(seed, pattern.format(seed), options, args.tree, folder))
            with args.output.open("a") as stream:
                stream.write(json.dumps(found[-1]) + "\n")
            say(f"seed {seed}: {found[-1]['db'][-1]:.1f} dB, {'{} of {}'.format(*kept(found[-1]))} kept")
    rows = sorted((row for row in found if first <= row["seed"] <= last), key=lambda row: row["seed"])
    if args.sheet:
        sheet(rows, pattern, folder, args.sheet)
    print(text(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
