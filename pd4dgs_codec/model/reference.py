"""Plain torch forms of the kernels, with gradients by autograd: a rasteriser, and the stages of `Model.gaussians`.

The rasteriser is a slow float64 oracle for tests. It is written from the textbook formulas (matrix products, an inverse
by determinant) and shares only thresholds with the kernels, so that a common mistake is unlikely. Only the determinant
differs from the textbook: p r - q^2 loses all digits where a Gaussian is 10^8 times as long as a pixel is wide.

The stages are the oracle of `fused`, and the path on CUDA and for networks that the kernels do not support.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from pd4dgs_codec.draw.projection import ALPHA_MAX, ALPHA_MIN, EPS2D, FAR
from pd4dgs_codec.model.networks import MLP, Quantisation, round_straight_through
from pd4dgs_codec.scene import MIN_OPACITY, SCALING_DIM, Camera

T_MIN = 1e-4
#: Side of a block, pixels.
BLOCK = 16


def _rotations(quats: Tensor) -> Tensor:
    """Returns rotations [N, 3, 3] of quaternions wxyz; a zero quaternion is the identity without gradient."""
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
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns pixel means [N, 2], covariances [N, 2, 2] (EPS2D included), their determinants [N] and depths [N], which
    must be positive."""
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
    blur = math.sqrt(EPS2D) * torch.eye(2, dtype=means.dtype, device=means.device)
    root = torch.cat([half, blur.expand(len(half), 2, 2)], -1)
    products = root[:, 0, :, None] * root[:, 1, None, :]
    det = (products - products.mT).triu().square().sum((1, 2))  # sum of squared minors (Cauchy and Binet)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), root @ root.mT, det, z


def composite(
    means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Blends Gaussians that are sorted front to back. Returns (image [H, W, 3], alpha [H, W, 1])."""
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


def composite_blocks(
    means2d: Tensor, radii: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """`composite` in blocks of pixels, each with only the Gaussians whose radii [N, 2] reach it, to limit memory."""
    image, alpha = colors.new_zeros(height, width, 3), colors.new_zeros(height, width, 1)
    for top in range(0, height, BLOCK):
        for left in range(0, width, BLOCK):
            corner, size = means2d.new_tensor([left, top]), (min(BLOCK, width - left), min(BLOCK, height - top))
            reach = (means2d + radii > corner) & (means2d - radii < corner + BLOCK)
            own = torch.nonzero(reach.all(-1))[:, 0]
            block = slice(top, top + BLOCK), slice(left, left + BLOCK)
            image[block], alpha[block] = composite(
                means2d[own] - corner, conics[own], opacities[own], colors[own], *size
            )
    return image, alpha


def rasterize(
    given: Sequence[Tensor], camera: Camera, background: np.ndarray, near_plane: float
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """The "reference" backend of `rasterization`, which checks the arguments. Results are float64."""
    means, quats, scales, opacities, colors = (t.double() for t in given)
    viewmat, K = (means.new_tensor(np.array(a)).double() for a in (camera.viewmat, camera.K))
    n, width, height = len(means), camera.width, camera.height
    index = _before_the_camera(means, quats, scales, opacities, viewmat, near_plane)
    means, quats, scales, opacities, colors = (a[index] for a in (means, quats, scales, opacities, colors))
    means2d, covariance, det, _ = project(means, quats, scales, viewmat, K, width, height)
    p, q, r = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    extent = torch.sqrt(2 * torch.log(255.0 * opacities.detach()))
    radii = torch.ceil(extent[:, None] * torch.sqrt(torch.stack([p, r], -1).detach()))
    seen = ((means2d + radii > 0) & (means2d - radii < means2d.new_tensor([width, height]))).all(-1)
    seen &= (radii > 0).any(-1) & (det > 0)
    index, conics = index[seen], torch.stack([r, -q, p], -1)[seen] / det[seen, None]
    pixels = means.new_zeros((1, n, 2)).index_copy(1, index, means2d[None, seen].detach())
    pixels.requires_grad_(torch.is_grad_enabled() and means2d.requires_grad)
    moved = means2d[seen] + (pixels - pixels.detach())[0, index]  # adds 0, for the gradient by `pixels`
    image, alpha = composite_blocks(moved, radii[seen], conics, opacities[seen], colors[seen], width, height)
    image = image + (1.0 - alpha) * torch.from_numpy(background).to(means)
    radii = means.new_zeros((1, n, 2)).index_copy(1, index, radii[None, seen]).to(torch.int32)
    return image, alpha[..., 0], {"means2d": pixels, "radii": radii}


def _before_the_camera(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmat: Tensor, near_plane: float
) -> Tensor:
    """Returns int64 [M]: the Gaussians that are finite, visible and between near_plane and FAR, front to back."""
    z = (means @ viewmat[2, :3] + viewmat[2, 3]).detach()
    keep = (z > near_plane) & (z <= FAR) & (opacities > ALPHA_MIN) & torch.isfinite(opacities)
    keep &= torch.isfinite(means).all(-1) & torch.isfinite(quats).all(-1) & torch.isfinite(scales).all(-1)
    index = torch.nonzero(keep)[:, 0]
    return index[torch.sort(z[index].to(torch.float32), stable=True).indices]


# -- the stages of `Model.gaussians`, as `fused` has them --------------------------------------------------------------


def pick(attributes: Sequence[Tensor], position: Tensor, rows: Tensor, quantisation: Quantisation) -> Tensor:
    """See `fused.pick`."""
    steps, centres, spacing, noise, rounding = quantisation
    parts, factor = [position.index_select(0, rows)], spacing.index_select(0, rows)[:, None]
    for i, (values, step, centre) in enumerate(zip(attributes, steps, centres, strict=True)):
        picked, middle = values.flatten(1).index_select(0, rows), centre.flatten()
        if rounding:
            picked = middle + round_straight_through(picked - middle, step * factor)
        elif noise is not None:
            picked = picked + noise[i] * step * factor
        parts.append(picked)
    return torch.cat(parts, dim=1)


def grow(
    anchors: Tensor, mask: Tensor, eye: Tensor, networks: Sequence[MLP], step: float | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `fused.grow`."""
    slots = len(networks[0].layers[-1].bias)
    features = anchors.shape[1] - 3 - SCALING_DIM - 3 * slots
    position, feature, scaling, offset = torch.split(anchors, [3, features, SCALING_DIM, 3 * slots], dim=1)
    inputs = torch.cat([feature, F.normalize(position - eye, dim=1)], dim=1)
    opacity, shape, color = (network(inputs[:, : network.layers[0].in_features], step) for network in networks)
    opacity = torch.tanh(opacity)
    keep = (opacity.detach() * mask.detach()[:, None] >= MIN_OPACITY).flatten().nonzero()[:, 0]
    shape, color = (values.reshape(-1, values.shape[1] // slots).index_select(0, keep) for values in (shape, color))
    owner = torch.div(keep, slots, rounding_mode="floor")
    spread, size = torch.split(scaling.exp().index_select(0, owner), 3, dim=1)
    means = position.index_select(0, owner) + offset.reshape(-1, 3).index_select(0, keep) * spread
    scales, quats = size * torch.sigmoid(shape[:, :3]), F.normalize(shape[:, 3:], dim=1)
    kept = opacity.flatten().index_select(0, keep)[:, None]
    gaussians = torch.cat([means, scales, quats, kept, torch.sigmoid(color)], dim=1)
    return gaussians, mask.index_select(0, owner), opacity.detach(), keep
