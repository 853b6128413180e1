"""The CPU backend: a torch autograd function around `rasteriser`. Tensors on the CPU are views of numpy arrays."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import rasteriser
from pd4dgs_codec.draw.rasteriser import Geometry, Projected, Settings
from pd4dgs_codec.scene import Camera


class _Composite(torch.autograd.Function):
    """(..., projected) -> (colors [C, H, W, D], alphas [C, H, W]). All tensors float32 and contiguous."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        backgrounds: Tensor | None,
        means2d: Tensor,
        projected: Projected,
    ) -> tuple[Tensor, Tensor]:
        behind = None if backgrounds is None else backgrounds.detach().numpy()
        drawn = rasteriser.composite(projected, colors.detach().numpy(), behind)
        pictures, transmittances = map(torch.from_numpy, drawn)
        ctx.projected = projected
        ctx.background_channels = 0 if backgrounds is None else backgrounds.shape[1]
        ctx.save_for_backward(means, quats, scales, opacities, colors, pictures, transmittances)
        return pictures, 1.0 - transmittances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_out: Tensor, g_alphas: Tensor) -> tuple[Tensor | None, ...]:
        *geometry, colors, pictures, transmittances = ctx.saved_tensors
        given = (colors, pictures, transmittances, g_out.contiguous(), g_alphas.contiguous())
        arrays = (t.detach().numpy() for t in given)
        found = rasteriser.backward(ctx.projected, Geometry(*(t.detach().numpy() for t in geometry)), *arrays)
        g_backgrounds = None
        if ctx.background_channels and ctx.needs_input_grad[5]:
            g_backgrounds = torch.einsum("chwd,chw->cd", g_out[..., : ctx.background_channels], transmittances)
        gradients = [torch.from_numpy(a) for a in (*found.geometry, found.colors, found.means2d)]
        return (*gradients[:5], g_backgrounds, gradients[5], None)


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
    """The CPU backend of `rasterization`, which checks the arguments."""
    tensors = [t.to(torch.float32).contiguous() for t in (means, quats, scales, opacities, colors)]
    backgrounds = None if backgrounds is None else backgrounds.to(torch.float32)
    cameras = [
        Camera(viewmat, K, width, height)
        for viewmat, K in zip(viewmats.detach().double().numpy(), Ks.detach().double().numpy(), strict=True)
    ]
    projected = rasteriser.project(Geometry(*(t.detach().numpy() for t in tensors[:4])), cameras, settings)
    names = ("means2d", "radii", "depths", "conics")
    meta = {name: torch.from_numpy(getattr(projected, name)) for name in names}
    meta["means2d"].requires_grad_(torch.is_grad_enabled() and any(t.requires_grad for t in tensors))
    out, alphas = _Composite.apply(*tensors, backgrounds, meta["means2d"], projected)  # type: ignore[no-untyped-call]
    return out, alphas[..., None], meta
