"""The tables of the PD-4DGS paper from our own trainings, and the quality dial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common import ONE, REAL, Benchmark, Row, Run, Scene, number, seconds_at, table
from quality import monolith, packed_levels

from pd4dgs_codec.bench.report import drawing

#: Share of a scene's steps in these trainings, so that anyone can repeat them.
SHORT = 0.3
#: The paper's method, whose level 0 is the mean over time; all of its networks take the view direction.
PUBLISHED_METHOD = ("--view-dependent", "opacity+covariance+color", "--rollout")
#: What a training leaves out or does instead; "full" is the method as it is.
COMPONENTS = {
    f"without {part}": (*PUBLISHED_METHOD, "adaptive", "--without", part)
    for part in ("rate", "binary", "smooth", "tmc", "whitening")
}
ROLLOUTS = {f"{name} rollout": (*PUBLISHED_METHOD, name) for name in ("uniform", "fixed")}
FULL = "full (adaptive rollout)"
#: mPSNR and MB that the paper publishes for the same changes (averages over the Dycheck iPhone scenes).
PUBLISHED = {
    "without rate": (14.48, 7.49),
    "without binary": (14.48, 6.88),
    "without smooth": (14.58, 6.89),
    "without tmc": (14.52, 6.81),
    "uniform rollout": (15.01, 7.03),
    "fixed rollout": (14.94, 7.18),
    FULL: (14.54, 6.90),
}
#: What the paper publishes for whole models: method, mPSNR, mSSIM, MB.
METHODS = (
    ("SC-GS", 13.90, 0.464, 232.4),
    ("Deformable 3DGS", 13.72, 0.461, 109.4),
    ("4DGS", 13.72, 0.460, 78.54),
    ("MoDec-GS", 14.60, 0.480, 18.37),
    ("PD-4DGS", 14.54, 0.480, 6.88),
    ("PD-4DGS, layer 0", 14.12, 0.354, 0.436),
)
QUALITIES = (0, 25, 50, 75, 100)


def measure(run: Run, scene: Scene) -> list[Row]:
    """A row per level of our models and of those made for one purpose, and one per changed method."""
    rows: list[Row] = []

    def train(table: str, name: str, *options: str, longer: float = SHORT, top: bool = True) -> None:
        model, training = run.trained(scene, *options, longer=longer)
        told = {"scene": scene.name, "table": table, "model": name, "minutes": training["seconds"] / 60}
        found = packed_levels(scene, model, model.with_suffix(".pd4"))
        rows.extend(told | row | {"layer0": found[0]["bytes"]} for row in (found[-1:] if top else found))

    train("models", "layer 0 alone", "--max-layer", "0")
    train("models", "layers 0 and 1 alone", "--max-layer", "1")
    whole = monolith(run, scene, SHORT)
    rows.append(whole | {"table": "models", "model": "monolith", "level": 2, "layer0": whole["bytes"]})
    train("models", "ours", top=False)
    train("models", "ours, 3 x the steps", longer=3 * SHORT, top=False)
    train("models", "ours, every level in every step", "--rollout", "all")
    parts = {FULL: (*PUBLISHED_METHOD, "adaptive"), **COMPONENTS, **ROLLOUTS}
    for name in list(parts)[: 2 if run.quick else None]:
        train("parts", name, *parts[name])
    return rows


def text(rows: Sequence[Row]) -> str:
    """Both tables."""
    models = [
        (r["scene"], r["model"], r["level"], number(r["mpsnr"]), number(r["mssim"], 4), number(r["bytes"], 0))
        + (seconds_at(r["bytes"]), number(r["minutes"], 1))
        for r in rows
        if r["table"] == "models"
    ]
    models += [
        ("other scenes", f"{name}, published", "-", number(psnr), number(ssim, 3), number(1e6 * size, 0))
        + (seconds_at(1e6 * size), "-")
        for name, psnr, ssim, size in METHODS
    ]
    head = ("scene", "model", "level", "mPSNR dB", "mSSIM", "bytes", "s at 2 Mbps", "training min")
    parts = []
    for row in rows:
        if row["table"] == "parts":
            psnr, size = PUBLISHED.get(row["model"], (None, None)) if row["scene"] in ONE else (None, None)
            parts.append(
                (row["scene"], row["model"], number(row["mpsnr"]), number(row["bytes"], 0), number(row["layer0"], 0))
                + (number(psnr), number(size))
            )
    heads = ("scene", "method", "mPSNR dB", "bytes", "layer 0 bytes", "published mPSNR", "published MB")
    return (
        f"One training each, {SHORT:.0%} of the steps above unless the row says otherwise; published figures are of "
        "the Dycheck iPhone scenes. Our levels are prefixes of one file, the models beside them are trained for one "
        "level. A step of ours trains one level, so that each has a third of the steps of a model made for it.\n\n"
        f"{table(head, models)}\n\n"
        f"The highest level with one part of the method left out or replaced:\n\n{table(heads, parts)}"
    )


def measure_dial(run: Run, scene: Scene) -> list[Row]:
    """A row per level of a training at each quality."""
    rows = []
    for quality in QUALITIES[1::2] if run.quick else QUALITIES:
        model, _ = run.trained(scene, "--quality", str(quality), longer=SHORT)
        found = packed_levels(scene, model, model.with_suffix(".pd4"))
        rows += [{"scene": scene.name, "quality": quality} | row for row in found]
    return rows


def dial_text(rows: Sequence[Row]) -> str:
    """A row per scene and quality."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["quality"]), []).append(row)
    cells = [
        (
            scene,
            quality,
            " / ".join(number(r["bytes"], 0) for r in found),
            " / ".join(number(r["mpsnr"]) for r in found),
        )
        for (scene, quality), found in groups.items()
    ]
    return f"`pd4dgs-train --quality`, {SHORT:.0%} of the steps above; every level that the file holds.\n\n" + table(
        ("scene", "quality", "bytes so far", "mPSNR dB"), cells
    )


def dial_pictures(rows: Sequence[Row], folder: Path) -> list[str]:
    """Held-out quality over bytes, one line per level."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    with drawing(folder / "dial.png", scenes, "held-out mPSNR, dB", (4.6, 3.4)) as axes:
        for axis, scene in zip(axes, scenes, strict=True):
            for level, style in enumerate((":o", "--s", "-^")):
                shown = [r for r in rows if (r["scene"], r["level"]) == (scene, level)]
                points = [(r["bytes"] / 1e3, r["mpsnr"]) for r in shown]
                if points:
                    axis.plot(*zip(*points, strict=True), style, color="black", mfc="white", label=f"level {level}")
            axis.set_xlabel("kB")
        axes[0].legend()
    return ["dial.png"]


PAPER = Benchmark("paper", "The paper's tables", REAL, measure, text)
DIAL = Benchmark("dial", "The quality dial", REAL, measure_dial, dial_text, dial_pictures)
