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

from pd4dgs_codec.bench.markdown import markdown
from pd4dgs_codec.bench.plot import Panel, Series, pareto_front
from pd4dgs_codec.bench.splats import View, bake, draw_all, view
from pd4dgs_codec.bench.timing import Timing, clock, summary
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.view.frames import Frame
from pd4dgs_codec.view.levels import Level

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


@dataclass(frozen=True)
class RenderPoint:
    """One way to draw. milliseconds per picture, over all pictures and repeats (oracle and textbook draw each once);
    rmse and largest error over all pixels of all pictures. missing: why there are no figures."""

    name: str
    milliseconds: Timing | None = None
    rmse: float | None = None
    largest: float | None = None
    missing: str | None = None


def views_of(level: Level, frames: Sequence[Frame]) -> list[View]:
    """What the frames' cameras meet of the level."""
    return [view(level, bake(level, frame), frame) for frame in frames]


def sweep(
    views: Sequence[View],
    names: Sequence[str],
    repeats: int,
    cache: Path,
    step: Callable[[], None] = lambda: None,
) -> list[RenderPoint]:
    """A point per name of NAMES; the oracle always runs, since the others are measured against it.

    cache: a folder where compiled variants are kept, each for its own; `step` is called after each point.
    """
    want, seconds = _textbook(views, 1, "float64")
    points = []
    for name in names:
        if name == ORACLE:
            points.append(RenderPoint(ORACLE, summary([1e3 * s for s in seconds]), 0.0, 0.0))
        else:
            points.append(_point(name, views, want, repeats, cache))
        step()
    return points


def _point(name: str, views: Sequence[View], want: Sequence[np.ndarray], repeats: int, cache: Path) -> RenderPoint:
    if name == GSPLAT and (reason := _without_gsplat()):
        return RenderPoint(name, missing=reason)
    if name == TEXTBOOK:
        pictures, seconds = _textbook(views, 1, "float32")
    elif name in VARIANTS:
        pictures, seconds = _variant(name, views, repeats, cache)
    else:
        pictures, seconds = draw_all(views, repeats, "cpu" if name == KERNELS else "gsplat")
    errors = [got.astype(np.float64) - w for got, w in zip(pictures, want, strict=True)]
    rmse = math.sqrt(sum(float(np.square(e).mean()) for e in errors) / len(errors))
    return RenderPoint(name, summary([1e3 * s for s in seconds]), rmse, max(float(np.abs(e).max()) for e in errors))


def _without_gsplat() -> str | None:
    """Why gsplat cannot draw here, in one line; None if it can."""
    import torch

    from pd4dgs_codec.render.autograd import gsplat_backend

    if not torch.cuda.is_available():
        return "there is no CUDA device"
    try:
        gsplat_backend.check()
    except RenderError as error:
        return str(error)
    return None


def _textbook(views: Sequence[View], repeats: int, dtype: str) -> tuple[list[np.ndarray], list[float]]:
    import torch

    from pd4dgs_codec.bench.oracle import picture

    pictures, seconds = [], []
    for one in views:
        given: dict[str, Any] = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in one.items()}
        given["dtype"] = getattr(torch, dtype)
        image, own = clock(lambda given=given: picture(**given), repeats)  # type: ignore[misc]
        pictures.append(image.numpy())
        seconds += own
    return pictures, seconds


def _variant(name: str, views: Sequence[View], repeats: int, cache: Path) -> tuple[list[np.ndarray], list[float]]:
    own = cache / "".join(c if c.isalnum() else "-" for c in name)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(own)}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "views.npz", Path(folder) / "pictures.npz"
        arrays: dict[str, Any] = {f"{i}.{k}": v for i, one in enumerate(views) for k, v in one.items()}
        np.savez(source, count=len(views), **arrays)
        command = [sys.executable, "-m", "pd4dgs_codec.bench.raster_variant", str(source), str(target)]
        command += [json.dumps(VARIANTS[name]), str(repeats)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise RenderError(f"{name}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
        with np.load(target) as stored:
            return [stored[f"picture{i}"] for i in range(len(views))], stored["seconds"].tolist()


# -- as tables and plots -----------------------------------------------------------------------------------------------


def front(points: Sequence[RenderPoint]) -> list[bool]:
    """Per point whether it lies on the Pareto front of error against milliseconds."""
    pairs = [(p.milliseconds.median, p.rmse) if p.milliseconds else None for p in points]
    best = pareto_front([(ms, e) for pair in pairs if pair for ms, e in [pair] if e is not None])
    return [pair in best for pair in pairs]


def table(points: Sequence[RenderPoint]) -> str:
    """A row per way to draw; times beside those of the kernels as they are."""
    base = next((p.milliseconds.median for p in points if p.name == KERNELS and p.milliseconds), None)
    head = ("drawn by", "ms per picture", "/ kernels", "RMSE", "PSNR dB", "largest error", "on the front")
    rows = []
    for p, on in zip(points, front(points), strict=True):
        if p.milliseconds is None or p.rmse is None:
            rows.append((p.name, f"none: {p.missing}", *["-"] * 5))
            continue
        ratio = "-" if base is None else f"{p.milliseconds.median / base:.3g}"
        psnr = "-" if p.rmse == 0 else f"{-20 * math.log10(p.rmse):.1f}"
        rows.append(
            (p.name, p.milliseconds.text(), ratio, f"{p.rmse:.2g}", psnr, f"{p.largest:.2g}", "yes" if on else "-")
        )
    return markdown(head, rows)


def panels(points: Sequence[RenderPoint]) -> list[Panel]:
    """One panel, a series per way to draw."""
    series = [
        Series(p.name, ((p.milliseconds.median, p.rmse),)) for p in points if p.milliseconds and p.rmse is not None
    ]
    return [Panel("error against rasterising time", "ms per picture", tuple(series))]


def as_json(points: Sequence[RenderPoint]) -> list[dict[str, Any]]:
    """The points as plain dicts."""
    return [{**asdict(p), "front": on} for p, on in zip(points, front(points), strict=True)]
