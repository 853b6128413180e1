"""The rasteriser's error against milliseconds: precision, tile sizes and thresholds, each against the float64 oracle.

All draw the same Gaussians through the same cameras. The error is the RMSE of the picture, 0..1, against the
oracle's, which has the thresholds of the format: alpha below 1/255 is skipped, and a pixel is finished at a
transmittance of 1e-4.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.bench.pictures import View, draw_all, oracle
from pd4dgs_codec.bench.report import Panel, markdown, pareto_front
from pd4dgs_codec.bench.timing import Timing, clock, summary
from pd4dgs_codec.errors import RenderError

#: The float64 oracle, against which all others are held; the same formulas in float32; the kernels as they are.
ORACLE, TEXTBOOK, KERNELS, GSPLAT = "oracle float64", "textbook float32", "kernels", "gsplat"
#: Kernels compiled with other constants. Tiles are 16 rows high by construction and hold at most 64 blocks of
#: 8 pixels; below 1/511 alphas would be clamped.
VARIANTS: dict[str, dict[str, float]] = {
    "tile 16x16": {"tile_width": 16},
    "tile 8x16": {"tile_width": 8},
    "alpha >= 1/500": {"alpha_min": 1 / 500},
    "alpha >= 1/128": {"alpha_min": 1 / 128},
    "alpha >= 1/64": {"alpha_min": 1 / 64},
    "T > 1e-5": {"t_min": 1e-5},
    "T > 1e-3": {"t_min": 1e-3},
    "T > 1e-2": {"t_min": 1e-2},
}
NAMES = (ORACLE, TEXTBOOK, KERNELS, GSPLAT, *VARIANTS)
Drawn = tuple[list[np.ndarray], list[float]]  #: pictures, and the seconds of each drawing


@dataclass(frozen=True)
class RenderPoint:
    """One way to draw. milliseconds per picture, over all pictures and repeats (oracle and textbook draw each once);
    rmse and largest error over all pixels of all pictures. missing: why there are no figures."""

    name: str
    milliseconds: Timing | None = None
    rmse: float | None = None
    largest: float | None = None
    missing: str | None = None


def sweep(
    views: Sequence[View], names: Sequence[str], repeats: int, cache: Path, step: Callable[[], None] = lambda: None
) -> list[RenderPoint]:
    """A point per name of NAMES; the oracle always runs, since the others are measured against it.

    cache: a folder where compiled variants are kept, each for its own; `step` is called after each point.
    """
    exact = _textbook(views, torch.float64)
    points = []
    for name in names:
        if name == GSPLAT and (reason := _without_gsplat()):
            points.append(RenderPoint(name, missing=reason))
        else:
            pictures, seconds = exact if name == ORACLE else _drawn(name, views, repeats, cache)
            errors = [got.astype(np.float64) - want for got, want in zip(pictures, exact[0], strict=True)]
            rmse = math.sqrt(sum(float(np.square(e).mean()) for e in errors) / len(errors))
            largest = max(float(np.abs(e).max()) for e in errors)
            points.append(RenderPoint(name, summary([1e3 * s for s in seconds]), rmse, largest))
        step()
    return points


def _drawn(name: str, views: Sequence[View], repeats: int, cache: Path) -> Drawn:
    if name == TEXTBOOK:
        return _textbook(views, torch.float32)
    if name in VARIANTS:
        return _variant(name, views, repeats, cache)
    return draw_all(views, repeats, "cpu" if name == KERNELS else "gsplat")


def _without_gsplat() -> str | None:
    """Why gsplat cannot draw here, in one line; None if it can."""
    from pd4dgs_codec.model.rasterization import check_gsplat

    if not torch.cuda.is_available():
        return "there is no CUDA device"
    try:
        check_gsplat()
    except RenderError as error:
        return str(error)
    return None


def _textbook(views: Sequence[View], dtype: torch.dtype) -> Drawn:
    drawn = [clock(lambda one=one: oracle(one, dtype), 1) for one in views]  # type: ignore[misc]
    return [image for image, _ in drawn], [seconds for _, own in drawn for seconds in own]


def _variant(name: str, views: Sequence[View], repeats: int, cache: Path) -> Drawn:
    own = cache / "".join(c if c.isalnum() else "-" for c in name)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "views.npz", Path(folder) / "pictures.npz"
        arrays: dict[str, Any] = {f"{i}.{k}": v for i, one in enumerate(views) for k, v in one.items()}
        np.savez(source, count=len(views), **arrays)
        command = [sys.executable, "-m", "pd4dgs_codec.bench.variant", str(source), str(target)]
        command += [json.dumps(VARIANTS[name]), str(repeats)]
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(own)}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise RenderError(f"{name}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
        with np.load(target) as stored:
            return [stored[f"picture{i}"] for i in range(len(views))], stored["seconds"].tolist()


def _series(points: Sequence[RenderPoint]) -> dict[str, list[tuple[float, float]]]:
    return {p.name: [(p.milliseconds.median, p.rmse)] for p in points if p.milliseconds and p.rmse is not None}


def front(points: Sequence[RenderPoint]) -> list[bool]:
    """Per point whether it lies on the Pareto front of error against milliseconds."""
    series = _series(points)
    best = pareto_front([pair for pairs in series.values() for pair in pairs])
    return [p.name in series and series[p.name][0] in best for p in points]


def table(points: Sequence[RenderPoint]) -> str:
    """A row per way to draw; times beside those of the kernels as they are."""
    base = next((p.milliseconds.median for p in points if p.name == KERNELS and p.milliseconds), None)
    head = ("drawn by", "ms per picture", "/ kernels", "RMSE", "PSNR dB", "largest error", "on the front")
    rows: list[tuple[str, ...]] = []
    for p, on in zip(points, front(points), strict=True):
        if p.milliseconds is None or p.rmse is None:
            rows.append((p.name, f"none: {p.missing}", *["-"] * 5))
            continue
        ratio = "-" if base is None else f"{p.milliseconds.median / base:.3g}"
        psnr = "-" if p.rmse == 0 else f"{-20 * math.log10(p.rmse):.1f}"
        error, largest = f"{p.rmse:.2g}", f"{p.largest:.2g}"
        rows.append((p.name, p.milliseconds.text(), ratio, error, psnr, largest, "yes" if on else "-"))
    return markdown(head, rows)


def panels(points: Sequence[RenderPoint]) -> list[Panel]:
    """One panel, a series per way to draw."""
    return [Panel("error against rasterising time", "ms per picture", list(_series(points).items()))]


def as_json(points: Sequence[RenderPoint]) -> list[dict[str, Any]]:
    """The points as plain dicts."""
    return [{**asdict(p), "front": on} for p, on in zip(points, front(points), strict=True)]
