"""The main job on one scene: train, pack in every mode, decode each prefix, render, measure; one dict holds it all."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.codec.encoder import Report, encode_with_report
from pd4dgs_codec.codec.plan import plan
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.entropy.morton import morton_order
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.report.evaluate import evaluate_file
from pd4dgs_codec.report.pictures import draw_levels
from pd4dgs_codec.report.rate import train_rate_bits
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer

#: Encodings whose sizes stand side by side; "ans" is the file that is evaluated and kept.
VARIANTS: dict[str, dict[str, str]] = {
    "ans": {},
    "gauss": {"priors": "gauss"},
    "lzma": {"mode": "lzma"},
    "lzma_float32": {"mode": "lzma", "deformation": "float32"},
}
#: The rate of a first frame's figure, bits per second.
LINK = 2e6


@dataclass(frozen=True)
class Job:
    """One scene and how to train it. name: the folder and the row label."""

    name: str
    config: TrainConfig


def run_job(job: Job, folder: Path, *, say: Callable[[str], None], progress: Any = None) -> dict[str, Any]:
    """Runs `job` in folder/name, keeping a finished checkpoint of the same configuration; returns and writes
    results.json there. say: receives one line per stage. progress: as Trainer.run takes it."""
    folder = folder / job.name
    folder.mkdir(parents=True, exist_ok=True)
    config = job.config
    say(f"{job.name}: reading {config.source}")
    dataset = load(config.source, downscale=config.downscale, holdout=config.holdout)
    path = folder / "model.pt"
    training = _finished_training(path, config)
    if training is None:
        say(f"{job.name}: training, preset {config.preset}, {len(dataset.train)} views")
        log = folder / "train.jsonl"
        log.unlink(missing_ok=True)
        Trainer(config, dataset).run(path, log=log, progress=progress)
    model, training = checkpoint.load(path)
    scene = to_scene(model)
    say(f"{job.name}: packing {len(scene.anchor_q)} anchors in {len(VARIANTS)} ways")
    files = {name: encode_with_report(scene, **options) for name, options in VARIANTS.items()}  # type: ignore[arg-type]
    data, report = files["ans"]
    (folder / "scene.pd4").write_bytes(data)
    say(f"{job.name}: {len(data)} bytes; rendering the held-out views at each level")
    packed = evaluate_file(data, dataset)
    unpacked = {row["level"]: row for row in evaluate_file(path, dataset)["levels"]}
    for row in packed["levels"]:
        row["loss_db"] = unpacked[row["level"]]["mpsnr"] - row["mpsnr"]
        row["first_frame_seconds"] = 8 * row["cumulative_bytes"] / LINK
    result = {
        "name": job.name,
        "source": config.source,
        "preset": config.preset,
        "downscale": config.downscale,
        "seed": config.seed,
        "iterations": training["total"],
        "train_seconds": training["seconds"],
        "skipped_steps": training["skipped"],
        "rho": training["rho"],
        "curve": json.loads(training["curve"]),
        "evaluation": packed,
        "coding": coding_rows({name: rep for name, (_, rep) in files.items()}, scene),
        "left_out": report.left_out,
    }
    say(f"{job.name}: drawing")
    result["pictures"] = [path.name for path in draw_levels(data, dataset, folder)]
    (folder / "results.json").write_text(json.dumps(result, indent=1))
    return result


def coding_rows(reports: dict[str, Report], scene: Scene) -> list[dict[str, Any]]:
    """One row per layer: its bytes under every variant, payload against rate, positions against Draco's.

    payload_over_rate: `--priors gauss` payload bits over the sum of R(a) on the layer's own symbols.
    train_over_rate: the trainer's sum of R(a) on the float checkpoint over the same. ans_over_lzma: all coded symbols
    (masks included, positions aside) in mode ans over the same symbols in mode lzma.
    """
    trained = train_rate_bits(scene)
    cells = plan(scene)[0].anchor_q
    rows = []
    for i, best in enumerate(reports["ans"].layers):
        layers = {name: report.layers[i] for name, report in reports.items()}
        gauss, lzma = layers["gauss"], layers["lzma"]
        own_rate = sum(value for name, value in trained[i].items() if name != "layer")
        start = sum(layer.anchors for layer in reports["ans"].layers[:i])
        draco = draco_position_bits(cells[start : start + best.anchors])
        coded = {name: sum(s.payload_bits for s in layers[name].streams) for name in ("ans", "lzma")}
        rows.append(
            {
                "layer": best.layer,
                "anchors": best.anchors,
                **{f"{name}_bytes": layer.bytes for name, layer in layers.items()},
                "streams": {s.name: s.payload_bits / 8 for s in best.streams},
                "position_bytes": best.position_bits / 8,
                "draco_position_bytes": None if draco is None else draco / 8,
                "rate_bits": gauss.rate_bits,
                "train_rate_bits": own_rate,
                "payload_over_rate": gauss.payload_bits / gauss.rate_bits if gauss.rate_bits else None,
                "best_over_gauss": best.payload_bits / gauss.payload_bits if gauss.payload_bits else None,
                "train_over_rate": own_rate / gauss.rate_bits if gauss.rate_bits else None,
                "ans_over_lzma": coded["ans"] / coded["lzma"] if coded["lzma"] else None,
                "lzma_symbol_bytes": sum(s.payload_bits for s in lzma.streams) / 8,
            }
        )
    return rows


def draco_position_bits(cells: np.ndarray) -> int | None:
    """Bits that Draco's kd-tree coder takes for int32 cells [N, 3], lossless, best effort; None without DracoPy."""
    if len(cells) == 0:
        return 0
    try:
        import DracoPy
    except ImportError:
        return None
    cells = cells[morton_order(cells)] - cells.min(0)
    bits = max(1, int(cells.max()).bit_length())
    data = DracoPy.encode(
        cells.astype(np.float32),
        quantization_bits=bits,
        compression_level=10,
        quantization_range=float((1 << bits) - 1),
        quantization_origin=[0.0, 0.0, 0.0],
    )
    return 8 * len(data)


def _finished_training(path: Path, config: TrainConfig) -> dict[str, Any] | None:
    """The training state of a finished run of this very configuration, else None."""
    if not path.exists():
        return None
    _, training = checkpoint.load(path)
    stored = json.loads(training.get("config", "{}"))
    wanted = json.loads(json.dumps(config, default=lambda value: value.__dict__))
    if wanted["iterations"] is None:
        stored["iterations"] = None
    return training if stored == wanted and training["iteration"] >= training["total"] else None

