"""The one door to rendering with gradients: gsplat's signature, checked, then the backend.

`cpu` is numba (`pd4dgs_codec.draw.rasteriser`), `gsplat` is CUDA, `reference` is a dense float64 torch oracle for
tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.draw.checks import check_camera, check_colours, check_limits, check_shape
from pd4dgs_codec.draw.rasteriser import Settings
from pd4dgs_codec.errors import RenderError

BACKENDS = ("auto", "cpu", "gsplat", "reference")
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def _expect(name: str, tensor: Any, *shapes: tuple[int | None, ...]) -> None:
    """A floating tensor whose shape is one of `shapes`; None in a shape is any size."""
    if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
        found = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
        raise RenderError(f"{name} is {found}, expected a floating-point tensor")
    check_shape(name, tensor.shape, *shapes)


def _choose(backend: str, device: torch.device) -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    """The function (means, ..., width, height, settings) -> (colors, alphas, meta) of a backend for `device`."""
    if backend == "auto":
        backend = "gsplat" if device.type == "cuda" else "cpu"
    if (backend == "gsplat") != (device.type == "cuda") and backend != "reference":
        raise RenderError(f"backend {backend!r} cannot draw tensors on {device.type}")
    if backend == "gsplat":
        from pd4dgs_codec.model.autograd import gsplat_backend

        return gsplat_backend.rasterize
    if device.type not in ("cpu", "cuda"):
        raise RenderError(f"tensors are on {device.type}, expected cpu or cuda")
    if backend == "reference":
        from pd4dgs_codec.model.autograd import reference

        return reference.rasterize
    from pd4dgs_codec.model.autograd import cpu

    return cpu.rasterize


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    radius_clip: float = 0.0,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    covars: Tensor | None = None,
    sh_degree: int | None = None,
    absgrad: bool = False,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw N Gaussians with C pinhole cameras (OpenCV axes, pixel centres at +0.5).

    means      [N, 3] world, scene units.
    quats      [N, 4] rotations wxyz, not necessarily unit; a zero quaternion is the identity and gets no gradient.
    scales     [N, 3] standard deviations, scene units (activated; the sign does not matter).
    opacities  [N] in 0..1 (activated). Not above 1/255, or not finite: the Gaussian is skipped.
    colors     [N, D] or [C, N, D], any D >= 1; D = 3 is drawn in one pass, more channels in passes of 3.
    viewmats   [C, 4, 4] world to camera. Ks [C, 3, 3], pixels, no skew. Neither takes gradients.
    near_plane, far_plane: Gaussians with camera z outside (near, far] are skipped, scene units.
    eps2d: added to the diagonal of the image-space covariance, square pixels.
    radius_clip: Gaussians whose extent is at most this are skipped, pixels.
    backgrounds [C, D] or None for black (depth channels always have background 0).
    render_mode "RGB" colours; "D" accumulated depth; "ED" expected depth (accumulated / alpha); "RGB+D", "RGB+ED" both.
    rasterize_mode "classic", covars None, sh_degree None, absgrad False: other values are refused.
    backend "cpu", "gsplat" (CUDA), "reference" (dense float64, slow), "auto" = by the device of `means`.

    float16 and float64 inputs are drawn in float32 (gradients come back in the input's type). A Gaussian with NaN or
    infinity in its position, rotation, scale or opacity is skipped and gets zero gradients; in its colour, refused.

    Returns (colors [C, H, W, D], alphas [C, H, W, 1], meta), float32 (`reference`: float64). meta, with zeros where a
    Gaussian is skipped: radii [C, N, 2] int32 pixels; means2d [C, N, 2] pixels, whose `.grad` holds dL/d(pixel
    position) after backward (for densification; on the CPU it is a leaf, so a loss on it does not reach `means`);
    depths [C, N]; conics [C, N, 3] upper triangle of the inverse 2D covariance; opacities [C, N]; width; height.

    Raises RenderError for wrong shapes, devices and unsupported options; its kind NotFinite for colours.
    Formulas: Zwicker et al., "EWA splatting"; Kerbl et al., "3D Gaussian Splatting"; conventions of gsplat 1.5.3.
    """
    if covars is not None:
        raise RenderError("covars is not supported: pass quats and scales")
    for name, value, supported in (
        ("rasterize_mode", rasterize_mode, "classic"),
        ("sh_degree", sh_degree, None),
        ("absgrad", absgrad, False),
    ):
        if value != supported:
            raise RenderError(f"{name}={value!r} is not supported, expected {supported!r}")
    for name, choice, known in (("render_mode", render_mode, RENDER_MODES), ("backend", backend, BACKENDS)):
        if choice not in known:
            raise RenderError(f"{name} is {choice!r}, expected one of {', '.join(known)}")
    check_limits(near_plane, far_plane, eps2d, radius_clip)
    _expect("means", means, (None, 3))
    n = means.shape[0]
    _expect("viewmats", viewmats, (None, 4, 4))
    count = viewmats.shape[0]
    if count < 1:
        raise RenderError("viewmats has 0 cameras, expected at least 1")
    _expect("Ks", Ks, (count, 3, 3))
    _expect("quats", quats, (n, 4))
    _expect("scales", scales, (n, 3))
    _expect("opacities", opacities, (n,))
    _expect("colors", colors, (n, None), (count, n, None))
    if colors.shape[-1] < 1:
        raise RenderError("colors has 0 channels, expected at least 1")
    if backgrounds is not None:
        _expect("backgrounds", backgrounds, (count, colors.shape[-1]))
    if viewmats.requires_grad or Ks.requires_grad:
        raise RenderError("gradients to viewmats and Ks are not supported: pass them detached")
    for viewmat, K in zip(viewmats.tolist(), Ks.tolist(), strict=True):
        check_camera(viewmat, K, width, height)
    tensors = [means, quats, scales, opacities, colors, viewmats, Ks] + ([] if backgrounds is None else [backgrounds])
    if any(t.device != means.device for t in tensors):
        raise RenderError(f"tensors are on different devices: {sorted({str(t.device) for t in tensors})}")
    for name, tensor in (("colors", colors), ("backgrounds", backgrounds)):
        if tensor is not None:
            check_colours(name, float(tensor.detach().float().sum()))
    if render_mode in ("D", "ED"):
        colors, backgrounds = colors[..., :0], None

    settings = Settings(float(near_plane), float(far_plane), float(eps2d), float(radius_clip), render_mode != "RGB")
    draw = _choose(backend, means.device)
    out, alphas, meta = draw(
        means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, width, height, settings
    )
    if render_mode.endswith("ED"):
        out = torch.cat([out[..., :-1], out[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    meta["opacities"] = opacities.detach().expand(count, n)
    meta["width"], meta["height"] = width, height
    return out, alphas, meta
