"""Results as Markdown tables and as a plot of quality against training time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from pd4dgs_codec.bench.report import drawing, markdown

#: A coding row's bytes in the modes that the table shows; None where a mode drops the layer.
BYTES = ("ans_bytes", "lzma_bytes")


#: What the page shows of a level and of a coded layer.
LEVEL = ("level", "mpsnr", "mssim", "loss_db", "cumulative_bytes", "first_frame_seconds", "decode_seconds", "render_ms",
         "anchors")  # fmt: skip
LAYER = ("layer", "ans_bytes", "lzma_bytes", "position_bytes", "draco_position_bytes",
         "rate_bits", "payload_over_rate", "train_over_rate", "best_over_gauss", "ans_over_lzma",
         "lzma_symbol_bytes")  # fmt: skip


def figures(result: dict[str, Any]) -> dict[str, Any]:
    """What the tables and the plot show of what `run_job` returns, but for its name."""
    names = ("preset", "iterations", "train_seconds", "skipped_steps", "rho")
    streams = [layer["streams"].get(name, 0.0) for layer in result["coding"][1:] for name in ("planes", "weights")]
    return {
        **{name: result[name] for name in names},
        "deformation_bytes": sum(streams),
        "levels": [{name: level[name] for name in LEVEL} for level in result["evaluation"]["levels"]],
        "coding": [{name: layer[name] for name in LAYER} for layer in result["coding"]],
        "left_out": [{name: row[name] for name in ("what", "why", "bytes")} for row in result["left_out"]],
        "curve": [{name: point[name] for name in ("seconds", "psnr")} for point in result["curve"]],
    }


def point(level: dict[str, Any]) -> dict[str, Any]:
    """What `spread_table` shows of a level of one seed's file."""
    return {"level": level["level"], "bytes": level["cumulative_bytes"], "mpsnr": level["mpsnr"]}


def spread_table(results: Sequence[dict[str, Any]]) -> str:
    """Per scene and level that all its seeds have: bytes and held-out mPSNR over the seeds."""
    rows = []
    for result in results:
        seeds = [{found["level"]: found for found in seed} for seed in result["seeds"]]
        for level in sorted(set.intersection(*map(set, seeds))):
            sizes, quality = ([seed[level][key] for seed in seeds] for key in ("bytes", "mpsnr"))
            spread = f"{median(sizes):,.0f} ({min(sizes):,} to {max(sizes):,})"
            shown = f"{median(quality):.2f} ({min(quality):.2f} to {max(quality):.2f})"
            rows.append((result["name"], str(level), str(len(seeds)), spread, shown))
    return markdown(("scene", "level", "seeds", "bytes so far", "mPSNR dB"), rows)


def quality_table(results: Sequence[dict[str, Any]]) -> str:
    """Per scene and level of `figures`: held-out quality of the `.pd4`, and the bytes, seconds and milliseconds that go
    with it."""
    rows = []
    for result in results:
        for level in result["levels"]:
            rows.append(
                (
                    result["name"],
                    str(level["level"]),
                    f"{level['mpsnr']:.2f}",
                    f"{level['mssim']:.4f}",
                    f"{level['loss_db']:+.3f}",
                    f"{level['cumulative_bytes']:,}",
                    f"{level['first_frame_seconds']:.2f}",
                    f"{level['decode_seconds']:.2f}",
                    f"{level['render_ms']:.0f}",
                    f"{level['anchors']:,}",
                    f"{result['train_seconds'] / 60:.1f}",
                )
            )
    head = (
        "scene",
        "level",
        "mPSNR dB",
        "mSSIM",
        "lost by packing dB",
        "bytes so far",
        "s at 2 Mbps",
        "decode s",
        "render ms",
        "anchors",
        "training min",
    )
    return markdown(head, rows)


def short_table(results: Sequence[dict[str, Any]], shown: dict[str, tuple[int, ...]]) -> str:
    """The levels `shown` of each scene: what has arrived, and how good the picture is then."""
    rows = []
    for result in results:
        layers: list[str] = []
        for level in result["levels"]:
            layers.append(str(level["level"]))
            if level["level"] in shown[result["name"]]:
                size, seconds = f"{level['cumulative_bytes']:,}", f"{level['first_frame_seconds']:.2f}"
                rows.append((result["name"], ", ".join(layers), size, seconds, f"{level['mpsnr']:.2f}"))
    return markdown(("scene", "layers read", "bytes so far", "seconds at 2 Mbps", "mPSNR dB"), rows)


def coding_table(results: Sequence[dict[str, Any]]) -> str:
    """Per scene and layer, and for all layers of a scene together: the modes' bytes, and what the coder spends against
    the rate model and against LZMA."""
    rows = []
    for result in results:
        for row in (*result["coding"], all_layers(result["coding"])):
            draco = row.get("draco_position_bytes")
            rows.append(
                (
                    result["name"],
                    str(row["layer"]),
                    *("-" if row[key] is None else f"{row[key]:,}" for key in BYTES),
                    _ratio(row["payload_over_rate"]),
                    _ratio(row["train_over_rate"]),
                    _ratio(row["best_over_gauss"]),
                    _ratio(row["ans_over_lzma"], 3),
                    f"{row['position_bytes']:,.0f} / {'-' if draco is None else f'{draco:,.0f}'}",
                )
            )
    head = (
        "scene",
        "layer",
        "ans",
        "lzma",
        "lzma, float32 deformation",
        "gauss payload / ΣR",
        "trainer's ΣR / ΣR",
        "best / gauss",
        "ans / lzma, same symbols",
        "positions / Draco",
    )
    return markdown(head, rows)


def all_layers(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One row for the layers of a file together: sums, and ratios of sums; None where a layer has no figure."""
    sums: dict[str, Any] = {"layer": "all"}
    for key in (*BYTES, "position_bytes", "draco_position_bytes"):
        values = [row.get(key) for row in rows]
        sums[key] = None if None in values else sum(value for value in values if value is not None)
    weights = {
        "payload_over_rate": [row.get("rate_bits") for row in rows],
        "train_over_rate": [row.get("rate_bits") for row in rows],
        "best_over_gauss": [_product(row.get("rate_bits"), row.get("payload_over_rate")) for row in rows],
        "ans_over_lzma": [row.get("lzma_symbol_bytes") for row in rows],
    }
    for key, weight in weights.items():
        parts = [_product(row.get(key), w) for row, w in zip(rows, weight, strict=True)]
        sums[key] = None if None in parts or not parts else sum(parts) / sum(weight)  # type: ignore[arg-type]
    return sums


def _product(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a * b


def _ratio(value: float | None, digits: int = 4) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def time_plot(results: Sequence[dict[str, Any]], path: Path) -> None:
    """Held-out PSNR per level against training wall time, one panel per scene, legible in black and white."""
    styles = ((":", "o"), ("--", "s"), ("-", "^"))
    with drawing(path, [result["name"] for result in results], "held-out PSNR, dB", (4.2, 3.4)) as axes:
        for axis, result in zip(axes, results, strict=True):
            for level, (line, mark) in enumerate(styles):
                points = [(p["seconds"], p["psnr"][level]) for p in result["curve"] if len(p["psnr"]) > level]
                if points:
                    look = {"color": "black", "ms": 4, "lw": 1, "label": f"level {level}"}
                    axis.plot(*zip(*points, strict=True), line + mark, **look)
            axis.set_xlabel("training wall time, s")
        axes[0].legend()
