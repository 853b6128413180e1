"""The trainer's error against wall time: held-out quality along each run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pd4dgs_codec.bench.report import Panel, Points, markdown, pareto_front
from pd4dgs_codec.errors import DataError

#: A training run. name; curve: evaluations, each with the seconds of wall time so far, psnr in dB per level and the
#: rmse (0..1) of the highest level; anchors at its end.
Run = dict[str, Any]


def of_curve(name: str, curve: Sequence[dict[str, Any]], anchors: int) -> Run:
    """The run of a trainer's or a checkpoint's curve: dicts with seconds and psnr."""
    points = [{"seconds": p["seconds"], "psnr": p["psnr"], "rmse": 10 ** (-p["psnr"][-1] / 20)} for p in curve]
    return {"name": name, "curve": points, "anchors": anchors}


def of_checkpoint(path: str) -> Run:
    """The run that a checkpoint records. Raises DataError if it was never evaluated."""
    from pd4dgs_codec.model import checkpoint

    model, training = checkpoint.load(path)
    preset = json.loads(training.get("config", "{}")).get("preset", "")
    curve = json.loads(training.get("curve", "[]"))
    if not curve:
        raise DataError(f"{path}: found no held-out quality, expected a run that was evaluated at least once")
    return of_curve(f"{Path(path).name} ({preset})" if preset else Path(path).name, curve, len(model.anchor_q))


def _pairs(run: Run) -> Points:
    return [(p["seconds"], p["rmse"]) for p in run["curve"]]


def table(runs: Sequence[Run]) -> str:
    """A row per evaluation of each run."""
    levels = range(max(len(p["psnr"]) for run in runs for p in run["curve"]))
    rows = []
    for run in as_json(runs):
        for p in run["curve"]:
            cells = [f"{p['psnr'][i]:.2f}" if i < len(p["psnr"]) else "-" for i in levels]
            rows.append((run["name"], f"{p['seconds']:.1f}", *cells, f"{p['rmse']:.4f}", "yes" if p["front"] else "-"))
    return markdown(("run", "seconds", *(f"level {i} PSNR dB" for i in levels), "RMSE", "on the front"), rows)


def panels(runs: Sequence[Run]) -> list[Panel]:
    """One panel, a series per run."""
    series = [(run["name"], _pairs(run)) for run in runs]
    return [Panel("held-out error against training time", "training wall time, s", series)]


def as_json(runs: Sequence[Run]) -> list[Run]:
    """The runs; `front` says whether an evaluation lies on the Pareto front of (seconds, RMSE) of all runs."""
    best = pareto_front([pair for run in runs for pair in _pairs(run)])
    return [run | {"curve": [p | {"front": (p["seconds"], p["rmse"]) in best} for p in run["curve"]]} for run in runs]
