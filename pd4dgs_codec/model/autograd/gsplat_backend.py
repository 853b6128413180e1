"""CUDA through gsplat (an extra, Apache-2.0), held to the contract of `rasterization`."""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.draw.projection import ALPHA_MAX
from pd4dgs_codec.draw.rasteriser import Settings
from pd4dgs_codec.errors import RenderError

#: The clamp on alpha is compiled into gsplat and changed between versions; only what equals ours is accepted.
ALPHA_MAX_OF_VERSION = {"1.5": 0.999, "1.6": 0.99}


def _load() -> Any:
    """The gsplat module, if its version draws what the CPU backend draws."""
    try:
        version = importlib.metadata.version("gsplat")
        module = importlib.import_module("gsplat")
    except (ImportError, RuntimeError, OSError) as error:  # it may load or build its CUDA part at once
        raise RenderError(f"gsplat cannot be imported ({error}): install pd4dgs-codec[gpu] or use the CPU") from error
    alpha_max = ALPHA_MAX_OF_VERSION.get(".".join(version.split(".")[:2]))
    if alpha_max != ALPHA_MAX:
        found = "an unknown alpha limit" if alpha_max is None else f"alpha limit {alpha_max}"
        raise RenderError(f"gsplat {version} has {found}, expected {ALPHA_MAX} (gsplat 1.5)")
    return module


def check() -> None:
    """RenderError in one line unless gsplat can draw here: the right version, with its CUDA kernels.

    Without a CUDA compiler gsplat imports all the same and fails at the first picture. Where it has one it may build
    its kernels now, which takes minutes.
    """
    _load()
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, RuntimeError, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RenderError(f"gsplat's CUDA kernels do not load ({reason}): use the CPU") from error
    if _C is None:
        raise RenderError("gsplat has no CUDA kernels here, nor a compiler (nvcc) to build them: use the CPU")


def _drawable(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> list[Tensor]:
    """Gaussians that are not finite become faint (skipped, no gradient); a zero quaternion becomes the identity."""
    finite = torch.isfinite(torch.cat([means, quats, scales, opacities[:, None]], -1)).all(-1)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    rotated = finite & (quats != 0).any(-1)
    return [
        torch.where(finite[:, None], means, 0.0),
        torch.where(rotated[:, None], quats, identity),
        torch.where(finite[:, None], scales, 0.0),
        torch.where(finite, opacities, 0.0),
    ]


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    width: int,
    height: int,
    settings: Settings,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """gsplat behind `rasterization`, which checks the arguments. float32, dense layout."""
    tensors = [t.to(torch.float32) for t in (means, quats, scales, opacities)]
    mode = "RGB" if not settings.depth else "RGB+D" if colors.shape[-1] else "D"
    out, alphas, meta = _load().rasterization(
        *_drawable(*tensors),
        colors.to(torch.float32) if colors.shape[-1] else means.new_zeros((means.shape[0], 1), dtype=torch.float32),
        viewmats.to(torch.float32).contiguous(),
        Ks.to(torch.float32).contiguous(),
        width,
        height,
        near_plane=settings.near,
        far_plane=settings.far,
        eps2d=settings.eps2d,
        radius_clip=settings.radius_clip,
        backgrounds=None if backgrounds is None else backgrounds.to(torch.float32),
        render_mode=mode,
        rasterize_mode="classic",
        packed=False,
    )
    if meta["means2d"].requires_grad:
        meta["means2d"].retain_grad()
    return out, alphas, {name: meta[name] for name in ("means2d", "radii", "depths", "conics")}
