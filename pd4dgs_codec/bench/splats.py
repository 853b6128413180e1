"""Gaussians as a camera meets them at one instant, and pictures of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.bench.timing import clock
from pd4dgs_codec.render.autograd.rasterization import rasterization
from pd4dgs_codec.view.frames import Frame
from pd4dgs_codec.view.levels import Level

#: What is drawn and from where: the keyword arguments of oracle.picture, as numpy arrays and numbers.
View = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians as static formats know them, float32: means [N, 3], scales [N, 3] (standard deviations), quats [N, 4]
    wxyz, opacities [N] and colors [N, 3] in 0..1."""

    means: np.ndarray
    scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


def bake(level: Level, frame: Frame) -> Splats:
    """The Gaussians that the frame's camera meets at its time, with the colours that it sees."""
    with torch.no_grad():
        g = level.model.gaussians(level.level, frame.time, frame.camera)
    return Splats(*(a.numpy() for a in (g.means, g.scales, g.quats, g.opacities, g.colors)))


def view(level: Level, splats: Splats, frame: Frame) -> View:
    """The splats before the scene's background, through the frame's camera."""
    info, camera = level.model.info, frame.camera
    return {
        **vars(splats),
        "viewmat": np.array(camera.viewmat, np.float32),
        "K": np.array(camera.K, np.float32),
        "width": camera.width,
        "height": camera.height,
        "near": max(float(info.near), 1e-6),
        "background": np.array(info.background, np.float32),
    }


def draw(view: View, backend: str = "cpu") -> Tensor:
    """[H, W, 3] float32, as `rasterization` draws it, on the CPU."""
    return _draw(_inputs(view, backend), backend).cpu()


def draw_all(views: Sequence[View], repeats: int, backend: str = "cpu") -> tuple[list[np.ndarray], list[float]]:
    """(picture of each view, seconds of each of `repeats` drawings of each); a first drawing is not timed."""
    pictures, seconds = [], []
    for view in views:
        inputs = _inputs(view, backend)
        _draw(inputs, backend)
        image, own = clock(lambda inputs=inputs: _draw(inputs, backend), repeats)  # type: ignore[misc]
        pictures.append(image.cpu().numpy())
        seconds += own
    return pictures, seconds


def _inputs(view: View, backend: str) -> dict[str, Any]:
    device = "cuda" if backend == "gsplat" else "cpu"
    names = ("means", "quats", "scales", "opacities", "colors")
    tensors = {name: torch.from_numpy(np.ascontiguousarray(view[name], np.float32)).to(device) for name in names}
    for name, own in (("viewmats", "viewmat"), ("Ks", "K"), ("backgrounds", "background")):
        tensors[name] = torch.from_numpy(view[own])[None].to(device)
    sizes = {name: int(view[name]) for name in ("width", "height")}
    return {**tensors, **sizes, "near_plane": float(view["near"])}


def _draw(inputs: dict[str, Any], backend: str) -> Tensor:
    with torch.no_grad():
        image = rasterization(**inputs, backend=backend)[0][0]
    if image.device.type == "cuda":
        torch.cuda.synchronize()
    return image
