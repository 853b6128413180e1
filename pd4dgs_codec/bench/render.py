"""The rasterisers' error against time: RMSE of an image (0..1) from that of the float64 reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.bench.report import Panel, markdown, pareto_front
from pd4dgs_codec.bench.timing import Timing, clock, summary
from pd4dgs_codec.draw.gaussians import near_plane
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.model.picture import rasterization
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.levels import Level

ORACLE, KERNELS, GSPLAT = "oracle float64", "kernels", "gsplat"
#: Name -> backend of `rasterization`.
BACKENDS = {ORACLE: "reference", KERNELS: "cpu", GSPLAT: "gsplat"}
SPLATS = ("means", "quats", "scales", "opacities", "colors")
#: Arguments of `rasterization` for one view.
View = dict[str, Any]


@dataclass(frozen=True)
class RenderPoint:
    """One rasteriser. milliseconds per image over all images and repeats (the reference renders each once); rmse and
    largest error over all pixels of all images. missing: the reason if there are no figures."""

    name: str
    milliseconds: Timing | None = None
    rmse: float | None = None
    largest: float | None = None
    missing: str | None = None


def view(level: Level, frame: Frame) -> View:
    """The Gaussians that the camera of `frame` meets at its time, with their colours in this view."""
    model, camera = level.model, frame.camera
    if isinstance(model, Player):
        gaussians: Any = model.gaussians(camera, frame.time)
        splats = {name: torch.from_numpy(np.ascontiguousarray(getattr(gaussians, name))) for name in SPLATS}
    else:
        with torch.no_grad():
            gaussians = model.gaussians(level.level, frame.time, camera)
        splats = {name: getattr(gaussians, name) for name in SPLATS}
    return {**splats, "camera": camera, "background": model.info.background, "near_plane": near_plane(model.info)}


def sweep(
    views: Sequence[View], names: Sequence[str], repeats: int, step: Callable[[], None] = lambda: None
) -> list[RenderPoint]:
    """A point per name of BACKENDS, each compared with the reference. `step` is called after each point."""
    exact = _rendered(views, ORACLE, 1)
    points = []
    for name in names:
        if name == GSPLAT and (reason := _without_gsplat()):
            points.append(RenderPoint(name, missing=reason))
        else:
            images, seconds = exact if name == ORACLE else _rendered(views, name, repeats)
            errors = [got.astype(np.float64) - want for got, want in zip(images, exact[0], strict=True)]
            rmse = math.sqrt(sum(float(np.square(e).mean()) for e in errors) / len(errors))
            largest = max(float(np.abs(e).max()) for e in errors)
            points.append(RenderPoint(name, summary([1e3 * s for s in seconds]), rmse, largest))
        step()
    return points


def _rendered(views: Sequence[View], name: str, repeats: int) -> tuple[list[np.ndarray], list[float]]:
    """(image of each view [H, W, 3], seconds of each repetition); a first rendering for warming up is not timed."""
    images, seconds = [], []
    for given in views:
        device = "cuda" if name == GSPLAT else "cpu"
        inputs = {key: v.to(device) if isinstance(v, torch.Tensor) else v for key, v in given.items()}

        def render(inputs: View = inputs) -> torch.Tensor:
            with torch.no_grad():
                image = rasterization(**inputs, backend=BACKENDS[name])[0]
            if image.device.type == "cuda":
                torch.cuda.synchronize()
            return image

        if name != ORACLE:
            render()
        image, own = clock(render, repeats)
        images.append(image.cpu().numpy())
        seconds += own
    return images, seconds


def _without_gsplat() -> str | None:
    """Why gsplat cannot render here, in one line; None if it can."""
    from pd4dgs_codec.model.picture import check_gsplat

    if not torch.cuda.is_available():
        return "there is no CUDA device"
    try:
        check_gsplat()
    except RenderError as error:
        return str(error)
    return None


def _front(points: Sequence[RenderPoint]) -> list[bool]:
    """Per point whether it lies on the Pareto front of error against milliseconds."""
    best = pareto_front([(p.milliseconds.median, p.rmse) for p in points if p.milliseconds and p.rmse is not None])
    return [p.milliseconds is not None and (p.milliseconds.median, p.rmse) in best for p in points]


def table(points: Sequence[RenderPoint]) -> str:
    """A row per rasteriser; the third column is the time over that of the CPU kernels."""
    base = next((p.milliseconds.median for p in points if p.name == KERNELS and p.milliseconds), None)
    head = ("drawn by", "ms per picture", "/ kernels", "RMSE", "PSNR dB", "largest error", "on the front")
    rows: list[tuple[str, ...]] = []
    for p, on in zip(points, _front(points), strict=True):
        if p.milliseconds is None or p.rmse is None:
            rows.append((p.name, f"none: {p.missing}", *["-"] * 5))
            continue
        ratio = "-" if base is None else f"{p.milliseconds.median / base:.3g}"
        psnr = "-" if p.rmse == 0 else f"{-20 * math.log10(p.rmse):.1f}"
        errors = (f"{p.rmse:.2g}", psnr, f"{p.largest:.2g}")
        rows.append((p.name, p.milliseconds.text(), ratio, *errors, "yes" if on else "-"))
    return markdown(head, rows)


def panels(points: Sequence[RenderPoint]) -> list[Panel]:
    """One panel, a series per rasteriser."""
    series = [(p.name, [(p.milliseconds.median, p.rmse or 0.0)]) for p in points if p.milliseconds]
    return [Panel("error against rasterising time", "ms per picture", series)]


def as_json(points: Sequence[RenderPoint]) -> list[dict[str, Any]]:
    """The points as plain dicts; `front` says whether a point lies on the Pareto front."""
    return [{**asdict(p), "front": on} for p, on in zip(points, _front(points), strict=True)]
