"""Differentiable rendering: Render_level of a model, and `rasterization` of any Gaussians by one of three backends.

`cpu` is numba (`draw.rasteriser`), `gsplat` is CUDA, `reference` (`reference.py`) is a dense float64 torch oracle.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import rasteriser
from pd4dgs_codec.draw.gaussians import check_time, near_plane
from pd4dgs_codec.draw.projection import ALPHA_MAX, EPS2D, FAR
from pd4dgs_codec.draw.rasteriser import Geometry, Projected
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.model import reference
from pd4dgs_codec.model.model import Gaussians, Model
from pd4dgs_codec.model.networks import EXACT, Rounding
from pd4dgs_codec.scene import Camera, SceneInfo

BACKENDS = ("auto", "cpu", "gsplat", "reference")
#: The clamp on alpha is compiled into gsplat and differs between versions; only a version with ALPHA_MAX is accepted.
ALPHA_MAX_OF_VERSION = {"1.5": 0.999, "1.6": 0.99}

Drawn = tuple[Tensor, Tensor, dict[str, Tensor]]


@dataclass
class Picture:
    """image [H, W, 3], which may exceed 1 by rounding, alpha [H, W], the Gaussians, and meta of `rasterization`."""

    image: Tensor
    alpha: Tensor
    gaussians: Gaussians
    meta: dict[str, Any]


def render(
    model: Model, level: int, t: float, camera: Camera, rounding: Rounding = EXACT, only: Tensor | None = None
) -> Picture:
    """Renders `level` at normalised time t in 0..1, only the anchors `only` (bool [N]) if given. Raises RenderError
    unless t is finite."""
    check_time(t)
    gaussians = model.gaussians(level, t, camera, rounding, only)
    if torch.is_grad_enabled():
        return draw(model.shown(level), gaussians, camera)
    # a colour that overflowed hides its Gaussian; training refuses the step instead
    opacities = torch.where(gaussians.colors.isfinite().all(1), gaussians.opacities, 0.0)
    shown = replace(gaussians, opacities=opacities, colors=gaussians.colors.nan_to_num())
    return replace(draw(model.shown(level), shown, camera), gaussians=gaussians)


def draw(info: SceneInfo, gaussians: Gaussians, camera: Camera) -> Picture:
    """Draws `gaussians` over the scene's background."""
    g = gaussians
    image, alpha, meta = rasterization(
        g.means, g.quats, g.scales, g.opacities, g.colors, camera, info.background, near_plane=near_plane(info)
    )
    return Picture(image, alpha, gaussians, meta)


@torch.no_grad()
def render_image(model: Model, level: int, t: float, camera: Camera, rounding: Rounding = EXACT) -> np.ndarray:
    """Renders `level` at normalised time t in 0..1 as float32 [H, W, 3] in 0..1."""
    image: np.ndarray = render(model, level, t, camera, rounding).image.clamp(0, 1).cpu().numpy()
    return image


# -- rasterising tensors -----------------------------------------------------------------------------------------------


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    near_plane: float = 0.01,
    backend: str = "auto",
) -> Drawn:
    """Draws N Gaussians with a pinhole camera (OpenCV axes, pixel centres at +0.5).

    Arguments as for `rasteriser.draw`, but tensors. A zero quaternion gets no gradient.
    backend: "cpu", "gsplat" (CUDA), "reference" (dense float64, slow) or "auto", by the device of `means`.

    float16 and float64 inputs are drawn in float32; gradients have the input's type. A Gaussian with NaN or infinity in
    its position, rotation, scale or opacity is skipped and gets zero gradients.

    Returns (image [H, W, 3], alpha [H, W], meta), float32 (`reference`: float64). meta, as gsplat has it, is zero where
    a Gaussian is skipped: radii [1, N, 2] int32 pixels; means2d [1, N, 2] pixels, whose `.grad` holds dL/d(pixel
    position) after backward, for densification (except with gsplat it is a leaf: a loss on it does not reach `means`).

    Raises RenderError for wrong shapes, devices and cameras, NotFinite (a RenderError) for colours that are not finite.
    Formulas: Zwicker et al., "EWA splatting"; Kerbl et al., "3D Gaussian Splatting"; conventions of gsplat 1.5.3.
    """
    if backend not in BACKENDS:
        raise RenderError(f"backend is {backend!r}, expected one of {', '.join(BACKENDS)}")
    tensors = means, quats, scales, opacities, colors
    behind = rasteriser.check_input(
        tensors,
        camera,
        background,
        near_plane,
        lambda t: isinstance(t, Tensor) and t.is_floating_point(),
        lambda t: float(torch.as_tensor(t).detach().float().sum()),
    )
    if any(t.device != means.device for t in tensors):
        raise RenderError(f"tensors are on different devices: {sorted({str(t.device) for t in tensors})}")
    if means.device.type not in ("cpu", "cuda"):
        raise RenderError(f"tensors are on {means.device.type}, expected cpu or cuda")
    if backend == "reference":
        return reference.rasterize(tensors, camera, behind, near_plane)
    own = "gsplat" if means.device.type == "cuda" else "cpu"
    if backend not in ("auto", own):
        raise RenderError(f"backend {backend!r} cannot draw tensors on {means.device.type}")
    return (rasterize_gsplat if own == "gsplat" else rasterize_cpu)(tensors, camera, behind, near_plane)


# -- CPU ---------------------------------------------------------------------------------------------------------------


class _Composite(torch.autograd.Function):
    """(projected, background, means2d, means, ..., colors) -> (image, alpha). Tensors are float32, contiguous and on
    the CPU, so that numpy arrays share their memory."""

    @staticmethod
    def forward(
        ctx: Any, projected: Projected, background: np.ndarray, means2d: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        drawn = rasteriser.composite(projected, tensors[-1].detach().numpy(), background)
        picture, transmittance = map(torch.from_numpy, drawn)
        ctx.projected = projected
        ctx.save_for_backward(*tensors, picture, transmittance)
        return picture, 1.0 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_picture: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        arrays = [t.detach().numpy() for t in (*ctx.saved_tensors, g_picture.contiguous(), g_alpha.contiguous())]
        found = rasteriser.backward(ctx.projected, Geometry(*arrays[:4]), *arrays[4:])
        gradients = (torch.from_numpy(a) for a in (found.means2d[None], *found.geometry, found.colors))
        return None, None, *gradients


def rasterize_cpu(given: Sequence[Tensor], camera: Camera, background: np.ndarray, near_plane: float) -> Drawn:
    """The CPU backend of `rasterization`, which checks the arguments."""
    tensors = [t.to(torch.float32).contiguous() for t in given]
    projected = rasteriser.project(Geometry(*(t.detach().numpy() for t in tensors[:4])), camera, near_plane)
    means2d, radii = torch.from_numpy(projected.means2d)[None], torch.from_numpy(projected.radii)[None]
    means2d.requires_grad_(torch.is_grad_enabled() and any(t.requires_grad for t in tensors))
    image, alpha = _Composite.apply(projected, background, means2d, *tensors)  # type: ignore[no-untyped-call]
    return image, alpha, {"means2d": means2d, "radii": radii}


# -- CUDA through gsplat (an extra, Apache-2.0), held to the contract of `rasterization` -------------------------------


def check_gsplat() -> None:
    """Raises RenderError, of one line, unless gsplat has an accepted version and working CUDA kernels.

    Without a CUDA compiler gsplat can be imported but fails at the first picture. With a compiler this call may build
    the kernels, which takes minutes.
    """
    _gsplat()
    try:
        from gsplat.cuda._backend import _C
    except (ImportError, RuntimeError, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RenderError(f"gsplat's CUDA kernels do not load ({reason}): use the CPU") from error
    if _C is None:
        raise RenderError("gsplat has no CUDA kernels here, nor a compiler (nvcc) to build them: use the CPU")


def _gsplat() -> Any:
    """Imports gsplat. Raises RenderError unless its version clamps alpha as the CPU backend does."""
    try:
        version = importlib.metadata.version("gsplat")
        module = importlib.import_module("gsplat")
    except (ImportError, RuntimeError, OSError) as error:  # the import may load or build its CUDA part
        raise RenderError(f"gsplat cannot be imported ({error}): install pd4dgs-codec[gpu] or use the CPU") from error
    alpha_max = ALPHA_MAX_OF_VERSION.get(".".join(version.split(".")[:2]))
    if alpha_max != ALPHA_MAX:
        found = "an unknown alpha limit" if alpha_max is None else f"alpha limit {alpha_max}"
        raise RenderError(f"gsplat {version} has {found}, expected {ALPHA_MAX} (gsplat 1.5)")
    return module


def _drawable(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> list[Tensor]:
    """Sets Gaussians that are not finite to opacity 0 (skipped, no gradient) and zero quaternions to the identity."""
    finite = torch.isfinite(torch.cat([means, quats, scales, opacities[:, None]], -1)).all(-1)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    rotated = finite & (quats != 0).any(-1)
    return [
        torch.where(finite[:, None], means, 0.0),
        torch.where(rotated[:, None], quats, identity),
        torch.where(finite[:, None], scales, 0.0),
        torch.where(finite, opacities, 0.0),
    ]


def rasterize_gsplat(given: Sequence[Tensor], camera: Camera, background: np.ndarray, near_plane: float) -> Drawn:
    """The gsplat backend of `rasterization`, which checks the arguments. float32, dense layout."""
    *shapes, colors = (t.to(torch.float32) for t in given)
    behind = torch.from_numpy(background).to(colors.device)
    if not len(colors):  # gsplat 1.5.3 ends the process with a division by zero
        alpha = colors.new_zeros(camera.height, camera.width) + sum(t.sum() for t in (*shapes, colors))
        pixels = shapes[0][None, :, :2]
        return behind + alpha[..., None], alpha, {"means2d": pixels, "radii": pixels.to(torch.int32)}
    viewmat, K = (colors.new_tensor(np.array(a))[None] for a in (camera.viewmat, camera.K))
    images, alphas, meta = _gsplat().rasterization(
        *_drawable(*shapes),
        colors,
        viewmat,
        K,
        camera.width,
        camera.height,
        near_plane=near_plane,
        far_plane=FAR,
        eps2d=EPS2D,
        backgrounds=behind[None],
        rasterize_mode="classic",
        packed=False,
    )
    if meta["means2d"].requires_grad:
        meta["means2d"].retain_grad()
    return images[0], alphas[0, ..., 0], {name: meta[name] for name in ("means2d", "radii")}
