"""Two trainers of one scene at once, a thread each, so that what else the machine does slows both: dB against time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pages.child import command
from pages.page import Row, say
from pages.scenes import Scene
from pd4dgs_codec.bench.report import drawing, markdown

#: Shares of the time of the trainer before at which both are compared.
MOMENTS = (0.25, 0.5, 1.0)


def race(scene: Scene, checkouts: Mapping[str, Path], folder: Path) -> Row:
    """By the names of the checkouts the curves of their trainers: seconds, and held-out dB by level. Both train anew,
    unless `folder`/NAME.pt is a training of as many steps for each."""
    from pd4dgs_codec.model import checkpoint

    def trained(name: str) -> dict[str, object] | None:
        path = folder / f"{name}.pt"
        training = checkpoint.load(path)[1] if path.is_file() else {}
        return training if training.get("iteration") == scene.iterations else None

    if not all(trained(name) for name in checkouts):
        say(f"{scene.name}: both trainers")
        folder.mkdir(parents=True, exist_ok=True)
        given = [scene.source, "--downscale", str(scene.downscale), "--iterations", str(scene.iterations)]
        given += ["--threads", "1", "--overwrite", "-o"]
        with ThreadPoolExecutor(len(checkouts)) as pool:
            places = [(checkout, str(folder / f"{name}.pt")) for name, checkout in checkouts.items()]
            list(pool.map(lambda place: command(place[0], "train", *given, place[1]), places))
    curves = {name: json.loads(str((trained(name) or {})["curve"])) for name in checkouts}
    return {name: [[p["seconds"], *p["psnr"]] for p in curve] for name, curve in curves.items()}


def race_table(rows: Sequence[Row]) -> list[str]:
    """How far both have come at some moments; rows with a "race" of the checkouts "before" and "after"."""
    table = []
    for row in rows:
        end = row["race"]["before"][-1][0]
        for name, curve in row["race"].items():
            reached = [[point for point in curve if point[0] <= share * end] for share in MOMENTS]
            cells = [" / ".join(f"{db:.2f}" for db in points[-1][1:]) if points else "" for points in reached]
            table.append((row["name"], name, f"{curve[-1][0] / 60:.1f}", *cells))
    moments = (f"at {share:.0%} of that before, dB" for share in MOMENTS)
    return [markdown(("scene", "trainer", "whole run, min", *moments), table)]


def race_plot(rows: Sequence[Row], path: Path) -> None:
    """One panel per scene: a line per level, before dashed."""
    with drawing(path, [row["name"] for row in rows], "held-out PSNR, dB", (5.2, 3.8)) as axes:
        for axis, row in zip(axes, rows, strict=True):
            for name, line in (("before", "--"), ("after", "-")):
                for level, mark in enumerate("os^"):
                    points = [(p[0] / 60, p[1 + level]) for p in row["race"][name] if len(p) > 1 + level]
                    if points:
                        label = f"level {level}, {name}"
                        axis.plot(*zip(*points, strict=True), line + mark, color=f"C{level}", ms=4, lw=1, label=label)
            axis.set_xlabel("training wall time, min")
        axes[0].legend(fontsize="small")
