"""What each lever on a file's size gains, alone and together, and the curve of the quality dial against that without.

    python tools/levers.py bouncing-balls [--preset tiny] [--iterations 1500] [--quality 20,50,80] [--scales 0.1,1]

Trains every variant with one seed and equal steps, packs it, and prints a Markdown table: cumulative bytes and held-out
dB per level. "before" is the trainer without the levers, at each of --scales as its rate scale. Where both curves have
two points and more, the last lines give Bjontegaard's difference per level: the mean difference of log bytes over the
dB that both reach, piecewise linear (VCEG-M33 takes cubics). Trainings that ended in --out are kept.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pages.scenes import SCENES
from pages.trainings import ensure_trained

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.codec.encoder import encode
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.scene import Steps
from pd4dgs_codec.threads import configure
from pd4dgs_codec.train.config import DEFAULT_QUALITY, TrainConfig, at_quality
from pd4dgs_codec.view.evaluate import evaluate_file

Changes = dict[str, Any]
Points = Sequence[tuple[float, float]]  #: (bytes, dB)

#: The trainer without the levers: steps, pruning and rates of 9275c5f.
BEFORE: Changes = {"steps": Steps(), "rate_scale": 0.1, "plane_rate": 0.0, "prune": 0.01, "step_scale": 1.0}


def levers() -> dict[str, Changes]:
    """Each lever alone, at its default."""
    middle = at_quality(DEFAULT_QUALITY)
    return {
        "planes' rate and steps": BEFORE | {"steps": None, "plane_rate": middle["plane_rate"]},
        "coarser steps": BEFORE | {"step_scale": middle["step_scale"]},
        "pruning": BEFORE | {"prune": middle["prune"]},
    }


def bjontegaard(curve: Points, reference: Points) -> float | None:
    """Mean relative difference of bytes at equal dB, -0.5 for half; None where the curves share no dB."""
    ours, theirs = (np.array(sorted((db, np.log(size)) for size, db in points)).T for points in (curve, reference))
    low, high = max(ours[0, 0], theirs[0, 0]), min(ours[0, -1], theirs[0, -1])
    if not low < high:
        return None
    at = np.linspace(low, high, 1001)
    return float(np.exp((np.interp(at, *ours) - np.interp(at, *theirs)).mean()) - 1)


def measure(name: str, changes: Changes, args: argparse.Namespace) -> list[tuple[float, float]]:
    """(cumulative bytes, held-out dB) per level of the variant's file."""
    scene = SCENES[args.scene]
    config = TrainConfig(
        preset=args.preset,
        source=scene.source,
        downscale=scene.downscale,
        iterations=args.iterations,
        seed=args.seed,
        **changes,
    )
    dataset = scene.load()
    path = args.out / args.scene / f"{name}-{args.preset}-{args.iterations}-{args.seed}" / "model.pt"
    model, _ = ensure_trained(config, dataset, path, say=lambda text: print(f"{name}: {text}", file=sys.stderr))
    data = encode(to_scene(model), effort=args.effort, omit=args.omit)
    return [(row["cumulative_bytes"], row["mpsnr"]) for row in evaluate_file(data, dataset)["levels"]]


def _cells(points: Points) -> tuple[str, str]:
    return " / ".join(f"{db:.2f}" for _, db in points), " / ".join(f"{size / 1e3:.1f}" for size, _ in points)


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",") if part]


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=tuple(SCENES))
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--iterations", type=int, default=1_500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quality", type=_numbers, default=[20.0, 50.0, 80.0])
    parser.add_argument("--scales", type=_numbers, default=[0.1])
    parser.add_argument("--effort", type=int, default=2)
    parser.add_argument("--omit", default="nothing", help="as pd4dgs-encode has it; proving takes minutes")
    parser.add_argument("--out", type=Path, default=Path("out/levers"))
    args = parser.parse_args(argv)
    configure()
    variants = {f"before, rate scale {x:g}": BEFORE | {"rate_scale": x} for x in args.scales} | levers()
    variants |= {f"quality {q:g}": at_quality(q) for q in args.quality}
    found = {name: measure(name, changes, args) for name, changes in variants.items()}
    print(markdown(("variant", "dB at levels", "kB so far"), [(name, *_cells(rows)) for name, rows in found.items()]))
    for level in range(3):
        curves = [
            [rows[level] for name, rows in found.items() if name.startswith(start) and level < len(rows)]
            for start in ("quality", "before")
        ]
        if min(map(len, curves)) > 1:
            gain = bjontegaard(*curves)
            print(f"level {level}: " + ("no dB in common" if gain is None else f"{100 * gain:+.1f} % bytes"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
