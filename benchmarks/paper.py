"""The tables of the PD-4DGS paper from our own trainings, and the quality dial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from common import ALL_VIEW, TINY, Benchmark, Row, Run, Scene, Training, number, seconds_at, table
from quality import MONOLITH, monolith, packed_levels

from pd4dgs_codec.bench.report import drawing

#: Share of a scene's steps in the trainings of the paper's tables, so that anyone can repeat them.
SHORT = 0.5
#: The paper's method, whose level 0 is the mean over time; all of its networks take the view direction.
PUBLISHED_METHOD = (*ALL_VIEW, "--rollout")
#: What a training leaves out or does instead; "full" is the method as it is.
COMPONENTS = {
    f"without {part}": (*PUBLISHED_METHOD, "adaptive", "--without", part) for part in ("rate", "binary", "whitening")
}
ROLLOUTS = {f"{name} rollout": (*PUBLISHED_METHOD, name) for name in ("uniform", "fixed")}
FULL = "full (adaptive rollout)"
#: Table, model -> (options, share of the steps).
TRAININGS = {
    ("models", "layer 0 alone"): (("--max-layer", "0"), SHORT),
    ("models", "layers 0 and 1 alone"): (("--max-layer", "1"), SHORT),
    ("models", "monolith"): (MONOLITH, SHORT),
    ("models", "ours"): ((), SHORT),
    ("models", "ours, twice the steps"): ((), 2 * SHORT),
    ("models", "ours, every level in every step"): (("--rollout", "all"), SHORT),
    ("parts", FULL): ((*PUBLISHED_METHOD, "adaptive"), SHORT),
    **{("parts", name): (options, SHORT) for name, options in (COMPONENTS | ROLLOUTS).items()},
}
#: mPSNR and MB that the paper publishes for the same changes (averages over the Dycheck iPhone scenes).
PUBLISHED = {
    "without rate": (14.48, 7.49),
    "without binary": (14.48, 6.88),
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


def asked(run: Run) -> dict[tuple[str, str], tuple[tuple[str, ...], float]]:
    """TRAININGS; in a quick run one of each kind of row."""
    return dict(list(TRAININGS.items())[slice(2, 8, 2) if run.quick else slice(None)])


def trainings(run: Run, scene: Scene) -> list[Training]:
    """Of both tables."""
    return [Training(scene, options, longer=longer) for options, longer in asked(run).values()]


def measure(run: Run, scene: Scene) -> list[Row]:
    """A row per level of our models and of those made for one purpose, and one per changed method."""
    rows: list[Row] = []
    for (which, name), (options, longer) in asked(run).items():
        if name == "monolith":
            whole = monolith(run, scene, longer)
            rows.append(whole | {"table": which, "model": name, "level": 2, "layer0": whole["bytes"]})
            continue
        model, training = run.trained(scene, *options, longer=longer)
        told = {"scene": scene.name, "table": which, "model": name, "minutes": training["seconds"] / 60}
        found = packed_levels(scene, model, model.with_suffix(".pd4"))
        shown = found if name in ("ours", "ours, twice the steps") else found[-1:]
        rows += [told | row | {"layer0": found[0]["bytes"]} for row in shown]
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
            psnr, size = PUBLISHED.get(row["model"], (None, None))
            parts.append(
                (row["scene"], row["model"], number(row["mpsnr"]), number(row["bytes"], 0), number(row["layer0"], 0))
                + (number(psnr), number(size))
            )
    heads = ("scene", "method", "mPSNR dB", "bytes", "layer 0 bytes", "published mPSNR", "published MB")
    return (
        f"One training per model on one tiny synthetic scene, with {SHORT:.0%} of its steps unless the row says "
        "otherwise. Rows compare methods with each other; published figures are for the DyCheck iPhone scenes. Our "
        "levels are prefixes of one file; each of the other models is trained for one level.\n\n"
        f"{table(head, models)}\n\n"
        f"The highest level with one part of the method left out or replaced:\n\n{table(heads, parts)}"
    )


def dial_trainings(run: Run, scene: Scene) -> list[Training]:
    """One at each quality."""
    return [Training(scene, dialled(quality)) for quality in (QUALITIES[1::2] if run.quick else QUALITIES)]


def dialled(quality: int) -> tuple[str, ...]:
    """The options of a quality; none for the default, whose training is there."""
    return () if quality == 50 else ("--quality", str(quality))


def measure_dial(run: Run, scene: Scene) -> list[Row]:
    """A row per level of a training at each quality."""
    rows = []
    for quality in QUALITIES[1::2] if run.quick else QUALITIES:
        model, _ = run.trained(scene, *dialled(quality))
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
    return "`pd4dgs-train --quality` on one tiny synthetic scene, for every level in the file.\n\n" + table(
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


PAPER = Benchmark("paper", "The paper's tables", TINY, measure, text, trainings=trainings)
DIAL = Benchmark("dial", "The quality dial", TINY, measure_dial, dial_text, dial_pictures, dial_trainings)
