"""Which levels runs keep: the measured gain of each level, and its quality on held-out views."""

from __future__ import annotations

import json
from collections.abc import Sequence

from common import QUICK, Benchmark, Row, Run, Scene, Training, number, table
from quality import packed_levels

from pd4dgs_codec.train.phases.levels import MIN_GAIN_2, SHARE_2, motion_gain

MOTIONS, SEEDS = ("static", "global", "local", "fast"), range(5)
#: Half of what other tiny scenes get: twenty trainings have to end.
STEPS = 750
#: The columns with a value for each level, and their decimals.
BY_LEVEL = {"mpsnr": 2, "moving_mpsnr": 2, "bytes": 0}


def scenes(run: Run) -> dict[tuple[str, int], Scene]:
    """By motion and seed."""
    if run.quick:
        return {("quick", 0): QUICK}
    names = [(motion, seed) for motion in MOTIONS for seed in SEEDS]
    return {(m, s): Scene(f"{m}-{s}", f"synthetic:{m}?seed={s}", "", iterations=STEPS) for m, s in names}


def measure(run: Run, _: None) -> list[Row]:
    """A row per training. gains: of the levels that were tested, the highest first; by level, held-out quality."""
    rows = []
    run.train(map(Training, scenes(run).values()))
    for (motion, seed), scene in scenes(run).items():
        model, _training = run.trained(scene)
        log = map(json.loads, model.with_suffix(".jsonl").read_text().splitlines())
        found = packed_levels(scene, model, run.folder(scene) / "scene.pd4")
        told: Row = {"motion": motion, "seed": seed, "gains": [g for r in log for g in r.get("level_gains", [])]}
        rows.append(told | {key: [row[key] for row in found if key in row] for key in BY_LEVEL})
    return rows


def text(rows: Sequence[Row]) -> str:
    """A row per training."""
    cells = [
        (row["motion"], row["seed"], len(row["bytes"]) - 1, gain(row, 1), gain(row, 2))
        + tuple(" / ".join(number(v, digits) for v in row[key]) or "-" for key, digits in BY_LEVEL.items())
        for row in rows
    ]
    head = ("scene", "seed", "top level", "gain of 1", "gain of 2", "mPSNR dB", "moving dB", "bytes so far")
    return (
        f"`pd4dgs-train 'synthetic:SCENE?seed=SEED' --preset tiny --iterations {STEPS}`: the camera sweeps. "
        "*gain*: dB over the level below, once that has trained alone, in the pixels that the level changes in views "
        f"held back from training. Level 2 needs {SHARE_2:.0%} of its gain over level 0 and {MIN_GAIN_2:g} dB. The "
        f"gains of both must sum to {motion_gain(STEPS):.2g} dB; if level 2 alone gains so much, level 1 is not "
        f"tested (-).\n\n{table(head, cells)}"
    )


def gain(row: Row, level: int) -> str:
    """The measured gain of `level`; a dash if it was not tested."""
    return number(dict(zip((2, 1), row["gains"], strict=False)).get(level), 1)


BENCHMARK = Benchmark("levels", "Which levels stay", (), measure, text)
