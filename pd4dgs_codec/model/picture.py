"""Render_level(t) of a model through a camera: the model's graph, then the rasteriser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.model.model import EXACT, Gaussians, Model, Rounding
from pd4dgs_codec.render.autograd.rasterization import rasterization
from pd4dgs_codec.scene import SceneInfo


@dataclass
class Picture:
    """image [H, W, 3] (may exceed 1 slightly where Gaussians overlap numerically), alpha [H, W], and what made them."""

    image: Tensor
    alpha: Tensor
    gaussians: Gaussians
    meta: dict[str, Any]


def render(
    model: Model,
    level: int,
    t: float,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    rounding: Rounding = EXACT,
) -> Picture:
    """Render_level at normalised time t in 0..1; viewmat [4, 4] world to camera, K [3, 3] pixels."""
    gaussians = model.gaussians(level, t, viewmat, K, width, height, rounding)
    if torch.is_grad_enabled():
        return draw(model.info, gaussians, viewmat, K, width, height)
    # a colour that overflowed hides its Gaussian; training refuses the step instead
    opacities = torch.where(gaussians.colors.isfinite().all(1), gaussians.opacities, 0.0)
    shown = replace(gaussians, opacities=opacities, colors=gaussians.colors.nan_to_num())
    return replace(draw(model.info, shown, viewmat, K, width, height), gaussians=gaussians)


def draw(info: SceneInfo, gaussians: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int) -> Picture:
    """The picture of `gaussians` over the scene's background; camera as for `render`."""
    background = torch.tensor([info.background], dtype=torch.float32, device=viewmat.device)
    images, alphas, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        viewmat[None],
        K[None],
        width,
        height,
        near_plane=max(float(info.near), 1e-6),
        backgrounds=background,
    )
    return Picture(images[0], alphas[0, ..., 0], gaussians, meta)


@torch.no_grad()
def render_image(
    model: Model,
    level: int,
    t: float,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    rounding: Rounding = EXACT,
) -> np.ndarray:
    """The picture as float32 [H, W, 3] in 0..1."""
    device = model.feature.device
    extrinsics, intrinsics = (torch.as_tensor(np.array(m, np.float32), device=device) for m in (viewmat, K))
    return render(model, level, t, extrinsics, intrinsics, width, height, rounding).image.clamp(0, 1).cpu().numpy()
