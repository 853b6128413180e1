"""What makes files small: the quality dial against an earlier commit, and each lever alone. Writes docs/levers.md.

    python tools/levers.py [--before FOLDER] [--dial] [--seeds 1] [--only NAME ...] [--out out] [--docs docs]
                           [--render]

FOLDER is a checkout of another commit of this project whose own trainer left FOLDER/out/NAME/model.pt. Its own
`pd4dgs-encode` packs that as it is, and with --target-size, every layer at the same share of what it takes then;
without FOLDER that part of the page stays. Beside it stand trainings of this commit at some qualities, as long as
tools/results.py has them, packed by default; with --seeds N the medians of N seeds. Of LEVER_STEPS steps there are the
trainer without its levers, with each alone, and with all; --dial leaves them as they are. Trainings that ended in
--out/NAME/quality-Q or --out/NAME/levers are kept. On one processor a scene takes half an hour for a seed of the
qualities, a quarter for the levers, and more than an hour for the commit before. Bjontegaard's difference is the mean
difference of log bytes over the dB that both curves reach, piecewise linear (VCEG-M33 takes cubics).
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from pages.child import command
from pages.page import Page, Row, commit, make, options, paragraph, say
from pages.scenes import SCENES, Scene, present
from pages.trainings import ensure_trained

from pd4dgs_codec.bench.report import drawing, markdown
from pd4dgs_codec.scene import Steps
from pd4dgs_codec.threads import configure
from pd4dgs_codec.train.config import DEFAULT_QUALITY, at_quality

NAMES = ("shelf-hand", "bouncing-balls")
QUALITIES = (20.0, 35.0, DEFAULT_QUALITY, 70.0, 90.0)
#: Of the bytes that a layer of the file before takes as it is packed by default.
SHARES = (1.0, 0.85, 0.7)
LEVER_STEPS = 1_500

#: The trainer without the levers: the steps, pruning and rates of 9275c5f.
WITHOUT: dict[str, Any] = {
    "steps": Steps(),
    "rate_scale": 0.1,
    "plane_rate": 0.0,
    "prune": 0.01,
    "step_scale": 1.0,
    "grading": 0.0,
    "whitening": False,
}

Points = Sequence[tuple[float, float]]  #: (bytes so far, held-out mPSNR in dB)


def levers() -> dict[str, dict[str, Any]]:
    """Changes of a training by the lever that they are, each alone at its default."""
    default = at_quality(DEFAULT_QUALITY)
    return {
        "none": WITHOUT,
        "planes' rate and steps": WITHOUT | {"steps": None, "plane_rate": default["plane_rate"]},
        "anchors' rate": WITHOUT | {"rate_scale": default["rate_scale"]},
        "coarser steps": WITHOUT | {"step_scale": default["step_scale"]},
        "pruning": WITHOUT | {"prune": default["prune"]},
        "step classes": WITHOUT | {"grading": default["grading"]},
        "step classes, mixed features": WITHOUT | {"grading": default["grading"], "whitening": True},
        "all": {},
    }


def bjontegaard(curve: Points, reference: Points) -> float | None:
    """Mean relative difference of bytes at equal dB, -0.5 for half; None where the curves share no dB."""
    ours, theirs = (np.array(sorted((db, np.log(size)) for size, db in points)).T for points in (curve, reference))
    low, high = max(ours[0, 0], theirs[0, 0]), min(ours[0, -1], theirs[0, -1])
    if not low < high:
        return None
    at = np.linspace(low, high, 1001)
    return float(np.exp((np.interp(at, *ours) - np.interp(at, *theirs)).mean()) - 1)


def curve_before(checkout: Path, commit: str, scene: Scene, kept: Path) -> list[Points]:
    """The levels of the checkout's file of a scene at each of SHARES. Each takes minutes and is left in the file
    `kept`, from where the same tool goes on."""
    data = [scene.source, "--downscale", str(scene.downscale)]
    model, whole = checkout / "out" / scene.name / "model.pt", list[int]()
    found: dict[str, Points] = json.loads(kept.read_text()) if kept.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "scene.pd4")
        for share in SHARES:
            name = f"{commit}, {share:.0%}"
            if name not in found:
                targets = ",".join(f"L{layer}={round(share * size)}" for layer, size in enumerate(whole))
                arguments = [str(model), "-o", file, "--overwrite", "--data", *data]
                command(checkout, "encode", *arguments, *(["--target-size", targets] if whole else []))
                levels = command(checkout, "eval", file, *data)["levels"]
                found[name] = [(row["cumulative_bytes"], row["mpsnr"]) for row in levels]
                kept.write_text(json.dumps(found, indent=1))
            ends = [0, *(size for size, _ in found[f"{commit}, {1:.0%}"])]
            whole = [int(end - start) for start, end in zip(ends, ends[1:], strict=False)]
            say(f"  {name}: {found[name]}")
    return [found[f"{commit}, {share:.0%}"] for share in SHARES]


def trained(scene: Scene, path: Path, changes: dict[str, Any]) -> Points:
    """The levels of a training of this commit, packed by default."""
    from pd4dgs_codec.model.convert import to_scene
    from pd4dgs_codec.quality.evaluate import evaluate_file
    from pd4dgs_codec.quality.packing import pack

    dataset = scene.load()
    model, _ = ensure_trained(scene.config(**changes), dataset, path, say=lambda text: say(f"  {text}"))
    rows = evaluate_file(pack(to_scene(model)).data, dataset)["levels"]
    found = [(row["cumulative_bytes"], row["mpsnr"]) for row in rows]
    say(f"  {path.parent.name}: {found}")
    return found


def medians(seeds: Sequence[Points]) -> Points:
    """By level that all seeds have: the median of bytes and that of dB."""
    return [tuple(map(median, zip(*points, strict=True))) for points in zip(*seeds, strict=False)]


def measure_dial(scene: Scene, out: Path, seeds: int) -> Row:
    """This commit's curve: its qualities, and points of each by level, medians of the seeds."""
    folder = out / scene.name
    places = {q: folder / f"quality-{q:g}" if q != DEFAULT_QUALITY else folder for q in QUALITIES}

    def point(quality: float, seed: int) -> Points:
        place = places[quality] / f"seed-{seed}" if seed else places[quality]
        return trained(scene, place / "model.pt", at_quality(quality) | {"seed": seed})

    after = [medians([point(quality, seed) for seed in range(seeds)]) for quality in QUALITIES]
    return {"qualities": QUALITIES, "after": after, "seeds": seeds}


def measure_levers(scene: Scene, out: Path) -> Row:
    """Points of short runs, by lever and level."""
    folder, short = out / scene.name / "levers", {"iterations": LEVER_STEPS}
    alone = {
        name: trained(scene, folder / name.replace(" ", "-") / "model.pt", short | changes)
        for name, changes in levers().items()
    }
    return {"levers": alone, "levers_commit": commit()}


def measure_before(scene: Scene, before: Path, out: Path) -> Row:
    """The curve of the commit before."""
    old = commit(before)
    return {"before_commit": old, "before": curve_before(before, old, scene, out / scene.name / "before.json")}


def gains(row: Row) -> list[float | None]:
    """Bjontegaard's difference at levels 0, 1, 2 and of whole files; None where a curve has not two points there, or
    the two share no dB."""
    found: list[float | None] = []
    for level in (0, 1, 2, -1):
        curves = [[points[level] for points in row[side] if level < len(points)] for side in ("after", "before")]
        found.append(bjontegaard(*curves) if min(map(len, curves)) > 1 else None)
    return found


def plot(rows: Sequence[Row], path: Path) -> None:
    """One panel per scene; a line per level, before dashed."""
    with drawing(path, [row["name"] for row in rows], "held-out mPSNR, dB", (5.6, 4.2)) as axes:
        for axis, row in zip(axes, rows, strict=True):
            for side, style, shade in (("before", "--", "0.6"), ("after", "-", "black")):
                for level, mark in enumerate("os^"):
                    points = sorted(found[level] for found in row[side] if level < len(found))
                    if points:
                        sizes, db = zip(*points, strict=True)
                        name = f"level {level}, {row['before_commit'] if side == 'before' else 'now'}"
                        kilo = [size / 1000 for size in sizes]
                        axis.plot(kilo, db, style, color=shade, marker=mark, ms=4, lw=1, label=name)
            axis.set_xlabel("kB up to the level")
            axis.legend(fontsize=8)


def _cells(points: Points) -> tuple[str, str]:
    return " / ".join(f"{size / 1e3:.1f}" for size, _ in points), " / ".join(f"{db:.2f}" for _, db in points)


def render(rows: Sequence[Row]) -> str:
    """The page."""
    differences, each, alone = [], [], []
    for row in rows:
        differences.append((row["name"], *("" if gain is None else f"{gain:+.0%}" for gain in gains(row))))
        for share, points in zip(SHARES, row["before"], strict=True):
            each.append((row["name"], row["before_commit"], f"{share:.0%} of each layer", *_cells(points)))
        for quality, points in zip(row["qualities"], row["after"], strict=True):
            each.append((row["name"], "now", f"--quality {quality:g}", *_cells(points)))
        alone += [(row["name"], name, *_cells(points)) for name, points in row["levers"].items()]
    seeds = "one seed" if (of := min(row["seeds"] for row in rows)) == 1 else f"medians of {of} seeds"
    commits, short_of = (", ".join(sorted({row[key] for row in rows})) for key in ("before_commit", "levers_commit"))
    lines = [
        *paragraph(
            "dB are held-out mPSNR of the packed file, bytes those of the file up to the level. Of one seed bytes "
            "spread by a tenth, dB by some tenths ([results](results.md))."
        ),
        "",
        "## The dial",
        "",
        *paragraph(
            f"Trainings by `--quality` ({seeds}) against one training of {commits}, packed by its own encoder with "
            "`--target-size`, all layers at the same share of their bytes: the one dial that it had after training. "
            "Bytes at equal dB, by Bjøntegaard's difference; nothing stands where trainings leave the level out, or "
            "where ours are better at every point than all of the other:"
        ),
        "",
        markdown(("scene", "level 0", "level 1", "level 2", "whole file"), differences),
        "",
        "![dB against bytes](img/levers.png)",
        "",
        markdown(("scene", "commit", "dial", "kB up to each level", "dB"), each),
        "",
        "## Each lever alone",
        "",
        *paragraph(
            f"{LEVER_STEPS:,} steps of one trainer and encoder ({short_of}), without the levers, with one of them as "
            "its default quality sets it, and with all; one seed. A short run tells them apart and no more: its dB are "
            "far from those of a whole one."
        ),
        "",
        markdown(("scene", "levers", "kB up to each level", "dB"), alone),
    ]
    return "\n".join(lines)


PAGE = Page("levers", "levers.py", render, "What makes files small")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, NAMES)
    parser.add_argument("--dial", action="store_true", help="leave the levers as the page has them")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train with seeds 0 to N - 1 (1)")
    parser.add_argument("--before", type=Path, metavar="FOLDER", help="a checkout of the commit to compare with")
    args = parser.parse_args(argv)
    kept = {row["name"]: row for row in PAGE.read(args.docs)}
    todo = [scene.name for scene in present(args, NAMES)]
    if args.before is None and (new := [name for name in todo if name not in kept]):
        parser.error(f"the page has no commit before for {', '.join(new)}, expected --before FOLDER")
    configure()
    images = args.docs / "img"
    images.mkdir(parents=True, exist_ok=True)

    def measured(name: str) -> Row:
        say(f"{name}:")
        given = SCENES[name], args.out.resolve()
        row = kept.get(name, {}) | {"commit": commit()} | measure_dial(*given, args.seeds)
        row |= {} if args.dial else measure_levers(*given)
        return row | (measure_before(given[0], args.before.resolve(), given[1]) if args.before else {})

    return make(PAGE, NAMES, todo, args, measured, lambda rows: plot(rows, images / "levers.png"))


if __name__ == "__main__":
    sys.exit(main())
