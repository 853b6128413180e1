"""Bytes and held-out quality of every level, beside a model of the same scene that is not layered."""

from __future__ import annotations

import lzma
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from common import (
    ONE,
    QUICK,
    SCENES,
    Benchmark,
    Row,
    Run,
    Scene,
    Training,
    command,
    levels,
    number,
    save_jpeg,
    seconds_at,
    table,
)

from pd4dgs_codec.bench.report import drawing

#: A model that is trained as a whole: the highest level in every step, nothing spent on bytes, levels or quantisation.
MONOLITH = ("--rollout", "top", "--prune", "0", "--grading", "0")
MONOLITH += tuple(word for part in ("rate", "binary", "noise", "whitening") for word in ("--without", part))
#: What papers report, see OFFICIAL_TEXT: method, PSNR, SSIM, MB.
PUBLISHED: dict[str, tuple[tuple[str, float, float | None, float | None], ...]] = {
    "mutant": (
        ("P-4DGS", 41.12, 0.993, 0.93),
        ("Deformable-3DGS, black", 42.63, 0.995, 44.44),
        ("4DGaussians, white", 37.71, 0.988, 22.45),
        ("4DGS", 36.62, 0.982, 301.0),
        ("4DGS-1K-PP", 37.02, 0.988, 3.56),
    ),
    "basketball": (("GIFStream, mean with boxes", 29.5, None, None),),
}
OFFICIAL_TEXT = {
    "": "By `pd4dgs-eval --protocol 3dgs`: metrics without masks, means over pictures. Rows with the name of a method "
    "are published figures.",
    "mutant": "mutant is D-NeRF's scene with its official split (20 test views) on white. A number in the name is the "
    "side of our pictures in pixels; published ones have 800. Published rows are from arXiv 2510.10030, supplement, "
    "table 1 (rerun by its authors), 4DGS-1K-PP from arXiv 2503.16422, table 6; their backgrounds differ.",
    "mutant-black": "mutant-black is mutant on black.",
    "basketball": "basketball is from Panoptic Sports, 4 test cameras at 150 instants; GIFStream: arXiv 2505.07539.",
}
#: Bytes of a picture in git.
LARGEST_PICTURE = 300_000


def measure(run: Run, scene: Scene) -> list[Row]:
    """A row per level of each seed's file, and for one scene one of the monolith."""
    rows: list[Row] = []
    for seed in range(run.seeds):
        model, training = run.trained(scene, seed=seed)
        file = run.folder(scene) / ("scene.pd4" if seed == 0 else f"scene-{seed}.pd4")
        told = {"scene": scene.name, "seed": seed, "minutes": training["seconds"] / 60}
        rows += [told | row for row in packed_levels(scene, model, file)]
        if seed == 0:
            rows[0]["curve"] = curve(model)
            if scene.protocol != "3dgs":  # scenes that papers report on name no licence
                draw_levels(scene, file, run.images / f"{scene.name}.jpg")
    return [*rows, monolith(run, scene)] if compared(run, scene) else rows


def trainings(run: Run, scene: Scene) -> list[Training]:
    """One a seed, and the monolith."""
    ours = [Training(scene, seed=seed) for seed in range(run.seeds)]
    return [*ours, Training(scene, MONOLITH)] if compared(run, scene) else ours


def compared(run: Run, scene: Scene) -> bool:
    """Whether it has a monolith beside it."""
    return run.quick or scene.name in ONE


def packed_levels(scene: Scene, model: Path, file: Path) -> list[Row]:
    """Packs a checkpoint into `file`; see `common.levels`."""
    command("encode", model, "-o", file, "-f")
    return levels(scene, file)


def monolith(run: Run, scene: Scene, longer: float = 1.0) -> Row:
    """The monolith after as many steps as our model: every tensor float32, all of it under LZMA, in one piece."""
    model, training = run.trained(scene, *MONOLITH, longer=longer)
    best = levels(scene, model)[-1] | {"bytes": monolithic_bytes(model), "level": "monolith"}
    return {"scene": scene.name, "seed": 0, "minutes": training["seconds"] / 60} | best


def monolithic_bytes(path: Path) -> int:
    """Bytes of a checkpoint's tensors as float32, one after another, under LZMA at its highest preset. Anchors count as
    positions; masks are left out, for every anchor is always there."""
    from pd4dgs_codec.model import checkpoint

    model, _ = checkpoint.load(path)
    tensors: dict[str, Any] = {"anchor": model.anchor}
    tensors |= {name: t for name, t in model.state_dict().items() if name not in ("anchor_q", "mask_logits")}
    return len(lzma.compress(b"".join(t.detach().float().numpy().tobytes() for t in tensors.values()), preset=9))


def curve(model: Path) -> list[Row]:
    """seconds and psnr per level of the evaluations during a training."""
    (found,) = command("bench", "train", model)["runs"]
    return [{"seconds": point["seconds"], "psnr": point["psnr"]} for point in found["curve"]]


def draw_levels(scene: Scene, file: Path, picture: Path) -> None:
    """The first held-out view as every level shows it, and the true image, as JPEG of at most LARGEST_PICTURE."""
    from PIL import Image

    still = file.with_name("levels.png")
    command("render", file, "-o", still, "-f", *scene.data, "--frames", 1, "--side-by-side")
    picture.parent.mkdir(parents=True, exist_ok=True)
    save_jpeg(Image.open(still), picture, LARGEST_PICTURE)


def text(rows: Sequence[Row]) -> str:
    """A row per scene and level: medians over the seeds and, of several, the least and the most. Scenes that papers
    report on have a table of their own, with what they report."""
    ours, official = ([row for row in rows if ("psnr" in row) == by] for by in (False, True))
    shown = [described(scene) for scene in (*SCENES.values(), QUICK) if any(row["scene"] == scene.name for row in rows)]
    seeds = 1 + max(row["seed"] for row in rows)
    told = f" Medians of {seeds} seeds, with the least and the most." if seeds > 1 else ""
    parts = [
        "Quality is measured on held-out views, from the prefix of the file whose size is in the same row. *monolith*: "
        "the same scene trained for the highest level alone, without a rate term, stored as float32 under LZMA. "
        "*moving*: mPSNR of the pixels whose true colour changes over time, for fixed test cameras. Each training has "
        f"one thread and runs beside another one.{told}"
    ]
    if shown:
        parts.append(table(("scene", "shows", "`pd4dgs-train`"), shown))
    if ours:
        parts.append(levels_table(ours, "m"))
    if official:
        names = [row["scene"] for row in official]
        about = [text for start, text in OFFICIAL_TEXT.items() if any(name.startswith(start) for name in names)]
        parts += [" ".join(about), levels_table(official, "")]
    return "\n\n".join(parts)


def described(scene: Scene) -> tuple[str, str, str]:
    """What a scene shows and how it is trained."""
    source = scene.source if scene.source.startswith("synthetic:") else Path(scene.source).name
    reading = f"--downscale {scene.downscale} " if scene.downscale > 1 else ""
    options = f"{reading}--preset {scene.preset} --iterations {scene.iterations} {' '.join(scene.training)}"
    return scene.name, scene.what, f"`{source} {options.strip()}`"


def levels_table(rows: Sequence[Row], m: str) -> str:
    """The rows as a table, of mpsnr and mssim (m is "m") or of psnr and ssim, and published ones below their scene."""
    groups: dict[tuple[str, Any], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["level"]), []).append(row)
    cells, moves = [], any("moving_mpsnr" in row for row in rows)
    for (scene, level), found in groups.items():
        sizes = [row["bytes"] for row in found]
        moving = [row["moving_mpsnr"] for row in found if "moving_mpsnr" in row]
        training = [number(found[0][key], digits) for key, digits in (("anchors", 0), ("minutes", 1))]
        cells.append(
            (scene, level, spread(sizes, 0), seconds_at(median(sizes)), spread([row[f"{m}psnr"] for row in found], 2))
            + ((spread(moving, 2),) if moves else ())
            + (number(median(row[f"{m}ssim"] for row in found), 4), *training)
        )
    scenes = list(dict.fromkeys(scene for scene, _ in groups))
    for name, published in PUBLISHED.items():
        family = [scene for scene in scenes if scene.split("-")[0] == name]
        for method, psnr, ssim, size in published if family else ():
            told = ("-", "-") if size is None else (number(1e6 * size, 0), seconds_at(1e6 * size))
            cells.append((family[-1], method, *told, number(psnr), *["-"] * moves, number(ssim, 3), "-", "-"))
    cells.sort(key=lambda row: scenes.index(row[0]))
    head = ["scene", "level", "bytes so far", "s at 2 Mbps", f"{m}PSNR dB", f"{m}SSIM", "anchors"]
    if moves:
        head.insert(5, "moving dB")
    return table([*head, "training min"], cells)


def spread(values: Sequence[float], digits: int) -> str:
    """The median and, of several values, the least and the most; a dash without values."""
    if not values:
        return "-"
    middle = number(median(values), digits)
    return f"{middle} ({number(min(values), digits)} to {number(max(values), digits)})" if len(values) > 1 else middle


def pictures(rows: Sequence[Row], folder: Path) -> list[str]:
    """The levels of each scene, and quality over training time, one panel a scene, legible in black and white."""
    shown = [row for row in rows if "curve" in row]
    time_plot([(row["scene"], row["curve"]) for row in shown], folder / "quality-over-time.png")
    drawn = {row["scene"] for row in rows if "psnr" not in row}
    return [f"{row['scene']}.jpg" for row in shown if row["scene"] in drawn] + ["quality-over-time.png"]


def time_plot(curves: Sequence[tuple[str, list[Row]]], path: Path) -> None:
    """Held-out PSNR of each level over training wall time."""
    styles = ((":", "o"), ("--", "s"), ("-", "^"))
    with drawing(path, [name for name, _ in curves], "held-out PSNR, dB", (3.7, 3.0), across=3) as axes:
        for axis, (_, points) in zip(axes, curves, strict=True):
            for level, (line, mark) in enumerate(styles):
                reached = [(p["seconds"], p["psnr"][level]) for p in points if len(p["psnr"]) > level]
                if reached:
                    look = {"color": "black", "ms": 4, "lw": 1, "label": f"level {level}"}
                    axis.plot(*zip(*reached, strict=True), line + mark, **look)
            axis.set_xlabel("training wall time, s")
        axes[0].legend()


BENCHMARK = Benchmark("quality", "Quality and bytes", tuple(SCENES), measure, text, pictures, trainings)
