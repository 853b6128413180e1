"""A dense float64 torch oracle: every Gaussian against every pixel, gradients by autograd. Slow, for tests.

Written from the formulas, in their textbook form (matrix products, an inverse by determinant), sharing nothing with the
kernels but the thresholds, so that a common mistake is unlikely. The determinant alone is not that of the textbook:
p r - q^2 has no digit left where a Gaussian is 10^8 times as long as a pixel is wide.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.draw.projection import ALPHA_MAX, ALPHA_MIN
from pd4dgs_codec.draw.rasteriser import Settings

T_MIN = 1e-4


def _rotations(quats: Tensor) -> Tensor:
    """[N, 3, 3] from wxyz; a zero quaternion is the identity without gradient."""
    norm = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    zero = norm == 0
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    w, x, y, z = torch.where(zero, identity, quats / torch.where(zero, 1.0, norm)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, eps2d: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel means [N, 2], covariances [N, 2, 2] (eps2d included), their determinants [N] and depths [N]; the caller
    keeps z > 0."""
    x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = z * torch.clamp(x / z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = z * torch.clamp(y / z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z**2], -1), torch.stack([zero, fy / z, -fy * ty / z**2], -1)], -2
    )
    half = jacobian @ viewmat[:3, :3] @ _rotations(quats) @ torch.diag_embed(scales)
    blur = math.sqrt(eps2d) * torch.eye(2, dtype=means.dtype, device=means.device)
    root = torch.cat([half, blur.expand(len(half), 2, 2)], -1)
    products = root[:, 0, :, None] * root[:, 1, None, :]
    det = (products - products.mT).triu().square().sum((1, 2))  # of all minors of the root (Cauchy and Binet)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), root @ root.mT, det, z


def composite(
    means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians that are already sorted front to back. Returns (colors [H, W, D], alphas [H, W, 1])."""
    ys, xs = (torch.arange(n, dtype=means2d.dtype, device=means2d.device) + 0.5 for n in (height, width))
    ys, xs = torch.meshgrid(ys, xs, indexing="ij")
    dx, dy = xs[..., None] - means2d[:, 0], ys[..., None] - means2d[:, 1]
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = torch.clamp(opacities * torch.exp(-sigma), max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = torch.cumprod(1.0 - alpha, -1)
    # Transmittance only falls, so a pixel that has finished stays finished under this test.
    alpha = torch.where(after > T_MIN, alpha, 0.0)
    before = torch.cat([torch.ones_like(after[..., :1]), torch.cumprod(1.0 - alpha, -1)[..., :-1]], -1)
    weights = alpha * before
    return weights @ colors, weights.sum(-1, keepdim=True)


def _draw_view(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    settings: Settings,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """One camera: (colors [H, W, D], alphas [H, W, 1], meta)."""
    with torch.no_grad():
        z = means @ viewmat[2, :3] + viewmat[2, 3]
        keep = (z > settings.near) & (z <= settings.far) & (opacities > ALPHA_MIN) & torch.isfinite(opacities)
        keep &= torch.isfinite(means).all(-1) & torch.isfinite(quats).all(-1) & torch.isfinite(scales).all(-1)
        index = torch.nonzero(keep)[:, 0]
        index = index[torch.sort(z[index].to(torch.float32), stable=True).indices]
        n = len(means)
    means, quats, scales, opacities, colors = (a[index] for a in (means, quats, scales, opacities, colors))
    means2d, covariance, det, depths = project(means, quats, scales, viewmat, K, width, height, settings.eps2d)
    p, q, r = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    extent = torch.sqrt(2 * torch.log(255.0 * opacities.detach()))
    radii = torch.ceil(extent[:, None] * torch.sqrt(torch.stack([p, r], -1).detach()))
    seen = ((means2d + radii > 0) & (means2d - radii < means2d.new_tensor([width, height]))).all(-1)
    seen &= (radii > settings.radius_clip).any(-1) & (det > 0)
    conics = torch.stack([r, -q, p], -1)[seen] / det[seen, None]
    index, means2d, depths = index[seen], means2d[seen], depths[seen]
    seen_colors = torch.cat([colors[seen], depths[:, None]], -1) if settings.depth else colors[seen]
    if means2d.requires_grad:
        means2d.retain_grad()
    out, alphas = composite(means2d, conics, opacities[seen], seen_colors, width, height)

    def spread(values: Tensor) -> Tensor:
        return values.new_zeros((n, *values.shape[1:])).index_copy(0, index, values)

    meta = {"radii": spread(radii[seen]).to(torch.int32), "depths": spread(depths.detach())}
    return out, alphas, meta | {"conics": spread(conics.detach()), "means2d": means2d, "index": index}


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
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """The oracle behind `rasterization(backend="reference")`. Float64 results.

    meta["means2d"] is a list, one [M, 2] tensor per camera with retained gradient, beside meta["index"], a list of the
    [M] Gaussians it holds, in depth order.
    """
    means, quats, scales, opacities, colors = (t.double() for t in (means, quats, scales, opacities, colors))
    views = []
    for c, (viewmat, K) in enumerate(zip(viewmats.double(), Ks.double(), strict=True)):
        source = colors if colors.dim() == 2 else colors[c]
        views.append(_draw_view(means, quats, scales, opacities, source, viewmat, K, width, height, settings))
    out, alphas = torch.stack([v[0] for v in views]), torch.stack([v[1] for v in views])
    if backgrounds is not None:
        back = backgrounds.double()
        if settings.depth:
            back = torch.cat([back, torch.zeros_like(back[:, :1])], -1)
        out = out + (1.0 - alphas) * back[:, None, None]
    meta: dict[str, Any] = {k: torch.stack([v[2][k] for v in views]) for k in ("radii", "depths", "conics")}
    return out, alphas, meta | {k: [v[2][k] for v in views] for k in ("means2d", "index")}
