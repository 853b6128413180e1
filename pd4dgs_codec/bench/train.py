"""The trainer's error against wall time: held-out quality along each run, per preset."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pd4dgs_codec.bench.report import Panel, Points, markdown, pareto_front
from pd4dgs_codec.errors import DataError

#: One training: name; curve: evaluations, each with seconds of wall time so far, psnr in dB per level and rmse 0..1 of
#: the highest level; anchors at its end, None if the log does not say.
Run = dict[str, Any]


def of_curve(name: str, curve: Sequence[dict[str, Any]], anchors: int | None) -> Run:
    """The run of a trainer's or a checkpoint's curve: dicts with seconds and psnr."""
    points = [{"seconds": p["seconds"], "psnr": tuple(p["psnr"]), "rmse": 10 ** (-p["psnr"][-1] / 20)} for p in curve]
    return {"name": name, "curve": points, "anchors": anchors}


def of_file(path: str) -> Run:
    """The run that a checkpoint or a log (pd4dgs-train --log) tells of. Raises DataError if it holds no evaluation."""
    name = Path(path).name if Path(path).parent.name == "" else f"{Path(path).parent.name}/{Path(path).name}"
    if path.endswith(".jsonl"):
        run = _of_log(path, name)
    else:
        from pd4dgs_codec.model import checkpoint

        model, training = checkpoint.load(path)
        preset = json.loads(training.get("config", "{}")).get("preset", "")
        curve = json.loads(training.get("curve", "[]"))
        run = of_curve(f"{name} ({preset})" if preset else name, curve, len(model.anchor_q))
    if not run["curve"]:
        raise DataError(f"{path}: found no held-out quality, expected a run that was evaluated at least once")
    return run


def _of_log(path: str, name: str) -> Run:
    curve, anchors = [], None
    try:
        lines = Path(path).read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from None
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            anchors = record.get("anchors", anchors)
            if "held_out_psnr" in record:
                curve.append({"seconds": float(record["seconds"]), "psnr": [float(p) for p in record["held_out_psnr"]]})
        except (ValueError, KeyError, TypeError, AttributeError):
            raise DataError(f"{path}: line {number} is no record of a training log, expected JSON Lines") from None
    return of_curve(name, curve, anchors)


def _pairs(runs: Sequence[Run]) -> list[tuple[str, Points]]:
    return [(run["name"], [(p["seconds"], p["rmse"]) for p in run["curve"]]) for run in runs]


def table(runs: Sequence[Run]) -> str:
    """A row per evaluation of each run."""
    levels = range(max((len(p["psnr"]) for run in runs for p in run["curve"]), default=0))
    rows = []
    for run in as_json(runs):
        for p in run["curve"]:
            cells = [f"{p['psnr'][i]:.2f}" if i < len(p["psnr"]) else "-" for i in levels]
            rows.append((run["name"], f"{p['seconds']:.1f}", *cells, f"{p['rmse']:.4f}", "yes" if p["front"] else "-"))
    return markdown(("run", "seconds", *(f"level {i} PSNR dB" for i in levels), "RMSE", "on the front"), rows)


def panels(runs: Sequence[Run]) -> list[Panel]:
    """One panel, a series per run."""
    return [Panel("held-out error against training time", "training wall time, s", _pairs(runs))]


def as_json(runs: Sequence[Run]) -> list[Run]:
    """The runs, each evaluation with whether it lies on the Pareto front of (seconds, RMSE) over all of them."""
    best = pareto_front([pair for _, pairs in _pairs(runs) for pair in pairs])
    return [run | {"curve": [p | {"front": (p["seconds"], p["rmse"]) in best} for p in run["curve"]]} for run in runs]
