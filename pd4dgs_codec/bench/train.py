"""The trainer's error against wall time: held-out quality along each run, per preset."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pd4dgs_codec.bench.markdown import markdown
from pd4dgs_codec.bench.plot import Panel, Series, pareto_front
from pd4dgs_codec.errors import DataError


@dataclass(frozen=True)
class CurvePoint:
    """Held-out quality at one moment. seconds: wall time of the run so far; psnr: dB per level."""

    seconds: float
    psnr: tuple[float, ...]

    @property
    def rmse(self) -> float:
        """Of the highest level: 10^(-PSNR / 20), 0..1."""
        return 10 ** (-self.psnr[-1] / 20)


@dataclass(frozen=True)
class Run:
    """One training. anchors: at its end, None if the log does not say."""

    name: str
    curve: tuple[CurvePoint, ...]
    anchors: int | None


def of_curve(name: str, curve: Sequence[dict[str, Any]], anchors: int | None) -> Run:
    """The run of a trainer's or a checkpoint's curve: dicts with seconds and psnr."""
    return Run(name, tuple(CurvePoint(p["seconds"], tuple(p["psnr"])) for p in curve), anchors)


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
    if not run.curve:
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


def front(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """The Pareto front of (seconds, RMSE) over all runs."""
    return pareto_front([(p.seconds, p.rmse) for run in runs for p in run.curve])


def table(runs: Sequence[Run]) -> str:
    """A row per evaluation of each run."""
    best = front(runs)
    levels = max((len(p.psnr) for run in runs for p in run.curve), default=0)
    head = ("run", "seconds", *(f"level {i} PSNR dB" for i in range(levels)), "RMSE", "on the front")
    rows = []
    for run in runs:
        for p in run.curve:
            cells = [f"{p.psnr[i]:.2f}" if i < len(p.psnr) else "-" for i in range(levels)]
            on = "yes" if (p.seconds, p.rmse) in best else "-"
            rows.append((run.name, f"{p.seconds:.1f}", *cells, f"{p.rmse:.4f}", on))
    return markdown(head, rows)


def panels(runs: Sequence[Run]) -> list[Panel]:
    """One panel, a series per run."""
    series = [Series(run.name, tuple((p.seconds, p.rmse) for p in run.curve)) for run in runs]
    return [Panel("held-out error against training time", "training wall time, s", tuple(series))]


def as_json(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The runs as plain dicts, each evaluation with its RMSE and whether it lies on the front."""
    best = front(runs)
    return [
        {
            **asdict(run),
            "curve": [{**asdict(p), "rmse": p.rmse, "front": (p.seconds, p.rmse) in best} for p in run.curve],
        }
        for run in runs
    ]
