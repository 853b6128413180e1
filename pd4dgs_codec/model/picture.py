"""Render_level(t) of a model through a camera: the model's graph, then the rasteriser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.draw.gaussians import check_time, near_plane
from pd4dgs_codec.model.model import Gaussians, Model
from pd4dgs_codec.model.networks import EXACT, Rounding
from pd4dgs_codec.model.rasterization import rasterization
from pd4dgs_codec.scene import Camera, SceneInfo


@dataclass
class Picture:
    """image [H, W, 3] (may exceed 1 slightly where Gaussians overlap numerically), alpha [H, W], the Gaussians, and the
    meta of `rasterization`."""

    image: Tensor
    alpha: Tensor
    gaussians: Gaussians
    meta: dict[str, Any]


def render(
    model: Model, level: int, t: float, camera: Camera, rounding: Rounding = EXACT, only: Tensor | None = None
) -> Picture:
    """Render_level at normalised time t in 0..1, of the anchors `only` (bool [N]) if given."""
    check_time(t)
    gaussians = model.gaussians(level, t, camera, rounding, only)
    if torch.is_grad_enabled():
        return draw(model.info, gaussians, camera)
    # a colour that overflowed hides its Gaussian; training refuses the step instead
    opacities = torch.where(gaussians.colors.isfinite().all(1), gaussians.opacities, 0.0)
    shown = replace(gaussians, opacities=opacities, colors=gaussians.colors.nan_to_num())
    return replace(draw(model.info, shown, camera), gaussians=gaussians)


def draw(info: SceneInfo, gaussians: Gaussians, camera: Camera) -> Picture:
    """The picture of `gaussians` over the scene's background."""
    g = gaussians
    image, alpha, meta = rasterization(
        g.means, g.quats, g.scales, g.opacities, g.colors, camera, info.background, near_plane=near_plane(info)
    )
    return Picture(image, alpha, gaussians, meta)


@torch.no_grad()
def render_image(model: Model, level: int, t: float, camera: Camera, rounding: Rounding = EXACT) -> np.ndarray:
    """Render_level at normalised time t in 0..1 as float32 [H, W, 3] in 0..1."""
    image: np.ndarray = render(model, level, t, camera, rounding).image.clamp(0, 1).cpu().numpy()
    return image
