"""The main job on one scene: train, pack in every mode, decode each prefix, render, measure; one dict holds it all."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pages.draco import draco_encode
from pages.pictures import draw_levels
from pages.trainings import ensure_trained
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.format.encoder import LayerReport, Report, encode, encode_with_report
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.io import finite, whole_file, whole_files, write_bytes
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.quality.evaluate import evaluate_file
from pd4dgs_codec.quality.measure import train_rate_bits
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.schedule import Schedule

#: Encodings whose sizes stand side by side; "ans" is the file that is evaluated and kept.
VARIANTS: dict[str, dict[str, str]] = {
    "ans": {},
    "gauss": {"priors": "gauss"},
    "lzma": {"mode": "lzma"},
}
#: Pictures of the levels: stills and an animation.
PICTURES = ("levels.png", "levels.gif")
#: The rate of a first frame's figure, bits per second.
LINK = 2e6


@dataclass(frozen=True)
class Job:
    """One scene and how to train it. name: the folder and the row label."""

    name: str
    config: TrainConfig


def run_job(job: Job, folder: Path, *, say: Callable[[str], None], progress: Any = None) -> dict[str, Any]:
    """Runs `job` in folder/name and returns what it writes to results.json there.

    A checkpoint of the same configuration is kept if its training ended, by itself or at the time limit, and trained to
    that end if it was interrupted. say: receives one line per stage. progress: as Trainer.run takes it. TrainError
    if a signal interrupts the training.
    """
    folder = folder / job.name
    folder.mkdir(parents=True, exist_ok=True)
    config = job.config
    say(f"{job.name}: reading {config.source}")
    path = folder / "model.pt"
    dataset, model, training = _trained(config, path, job.name, say, progress)
    say(f"{job.name}: packing {len(model.anchor_q)} anchors in {len(VARIANTS)} ways")
    planned, left_out = plan(to_scene(model))
    files = {
        name: encode_with_report(planned, omit="nothing", left_out=left_out, **options)  # type: ignore[arg-type]
        for name, options in VARIANTS.items()
    }
    data, report = files["ans"]
    write_bytes(folder / "scene.pd4", data, overwrite=True)
    say(f"{job.name}: {len(data)} bytes; rendering the held-out views at each level")
    packed = evaluate_file(data, dataset)
    unpacked = {row["level"]: row for row in evaluate_file(path, dataset)["levels"]}
    for row in packed["levels"]:
        row["loss_db"] = unpacked[row["level"]]["mpsnr"] - row["mpsnr"]
        row["first_frame_seconds"] = 8 * row["cumulative_bytes"] / LINK
    place = training.get("place", training["iteration"])
    result = {
        "name": job.name,
        "source": config.source,
        "preset": config.preset,
        "downscale": config.downscale,
        "seed": config.seed,
        "iterations": training["iteration"],
        "total": training["total"],
        "phases_not_reached": Schedule(training["total"] or None).phases_not_reached(place),
        "train_seconds": training["seconds"],
        "skipped_steps": training["skipped"],
        "rho": training["rho"],
        "curve": json.loads(training["curve"]),
        "evaluation": packed,
        "coding": coding_rows({name: rep for name, (_, rep) in files.items()}, planned),
        "left_out": report.left_out,
    }
    say(f"{job.name}: drawing")
    pictures = [str(folder / name) for name in PICTURES]
    with whole_files(pictures[0], pictures, overwrite=True) as temporaries:
        draw_levels(data, dataset, *temporaries)
    result["pictures"] = list(PICTURES)
    with whole_file(folder / "results.json", overwrite=True) as temporary:
        temporary.write_text(json.dumps(finite(result), indent=1, allow_nan=False))
    return result


def pack_seed(job: Job, folder: Path, *, say: Callable[[str], None], progress: Any = None) -> list[dict[str, Any]]:
    """Levels of the file of another seed, trained in folder/name/seed-N, as `run_job` measures them of seed 0."""
    path, label = folder / job.name / f"seed-{job.config.seed}" / "model.pt", f"{job.name}, seed {job.config.seed}"
    dataset, model, _ = _trained(job.config, path, label, say, progress)
    say(f"{label}: packing")
    levels: list[dict[str, Any]] = evaluate_file(encode(to_scene(model)), dataset)["levels"]
    return levels


def _trained(
    config: TrainConfig, path: Path, label: str, say: Callable[[str], None], progress: Any
) -> tuple[Dataset, Model, dict[str, Any]]:
    """The data, and the model in `path` with its training state."""
    dataset = load(config.source, downscale=config.downscale, holdout=config.holdout)
    return dataset, *ensure_trained(config, dataset, path, say=lambda text: say(f"{label}: {text}"), progress=progress)


def coding_rows(reports: dict[str, Report], planned: Scene) -> list[dict[str, Any]]:
    """One row per layer of `planned` (see `plan`): its bytes under every variant, payload against rate, positions
    against Draco's.

    payload_over_rate: `--priors gauss` payload bits over the sum of R(a) on the layer's own symbols.
    train_over_rate: the trainer's sum of R(a) on the float checkpoint over the same. ans_over_lzma: all coded symbols
    (masks included, positions aside) in mode ans over the same symbols in mode lzma. None where there is nothing to
    compare, as where an encoding drops the layer.
    """
    rates = train_rate_bits(planned, EncodeOptions(omit="nothing"))
    trained = {int(row["layer"]): sum(row.values()) - row["layer"] for row in rates}
    cells = planned.anchor_q
    variants = {name: {layer.layer: layer for layer in report.layers} for name, report in reports.items()}
    rows, start = [], 0
    for best in reports["ans"].layers:
        layers = {name: by_number.get(best.layer) for name, by_number in variants.items()}
        draco = draco_position_bits(cells[start : start + best.anchors])
        start += best.anchors
        own_rate, rate = trained.get(best.layer), _value(layers["gauss"], "rate_bits")
        payload = _value(layers["gauss"], "payload_bits")
        coded = {name: _symbol_bits(layers[name]) for name in ("ans", "lzma")}
        rows.append(
            {
                "layer": best.layer,
                "anchors": best.anchors,
                **{f"{name}_bytes": _value(layer, "bytes") for name, layer in layers.items()},
                "streams": {s.name: s.payload_bits / 8 for s in best.streams},
                "position_bytes": best.position_bits / 8,
                "draco_position_bytes": None if draco is None else draco / 8,
                "rate_bits": rate,
                "train_rate_bits": own_rate,
                "payload_over_rate": _over(payload, rate),
                "best_over_gauss": _over(best.payload_bits, payload),
                "train_over_rate": _over(own_rate, rate),
                "ans_over_lzma": _over(coded["ans"], coded["lzma"]),
                "lzma_symbol_bytes": _over(coded["lzma"], 8),
            }
        )
    return rows


def _value(layer: LayerReport | None, name: str) -> Any:
    return None if layer is None else getattr(layer, name)


def _symbol_bits(layer: LayerReport | None) -> float | None:
    return None if layer is None else sum(s.payload_bits for s in layer.streams)


def _over(a: float | None, b: float | None) -> float | None:
    return None if a is None or not b else a / b


def draco_position_bits(cells: np.ndarray) -> int | None:
    """Bits that Draco's kd-tree coder takes for int32 cells [N, 3], lossless, best effort; None without DracoPy."""
    if len(cells) == 0:
        return 0
    try:
        data = draco_encode(cells)
    except ImportError:
        return None
    return 8 * len(data)
