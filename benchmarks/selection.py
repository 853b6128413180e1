"""Which levels runs keep, and their quality on held-out views."""

from __future__ import annotations

from collections.abc import Sequence

from common import QUICK, Benchmark, Row, Run, Scene, Training, number, table
from quality import packed_levels

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
    """A row per training: by level, held-out quality."""
    rows: list[Row] = []
    run.train(map(Training, scenes(run).values()))
    for (motion, seed), scene in scenes(run).items():
        model, _training = run.trained(scene)
        found = packed_levels(scene, model, run.folder(scene) / "scene.pd4")
        by_level = {key: [row[key] for row in found if key in row] for key in BY_LEVEL}
        rows.append({"motion": motion, "seed": seed, **by_level})
    return rows


def text(rows: Sequence[Row]) -> str:
    """A row per training."""
    cells = [
        (row["motion"], row["seed"], len(row["bytes"]) - 1)
        + tuple(" / ".join(number(v, digits) for v in row[key]) or "-" for key, digits in BY_LEVEL.items())
        for row in rows
    ]
    head = ("scene", "seed", "top level", "mPSNR dB", "moving dB", "bytes so far")
    return (
        f"`pd4dgs-train 'synthetic:SCENE?seed=SEED' --preset tiny --iterations {STEPS}`: the camera sweeps. The run "
        f"removes levels that a lower one replaces.\n\n{table(head, cells)}"
    )


BENCHMARK = Benchmark("levels", "Which levels stay", (), measure, text)
