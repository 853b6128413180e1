"""The dense oracle on scenes too large for it: the same formulas, a block of pixels at a time.

A Gaussian contributes nothing where its alpha is below 1/255, so that each block needs only those whose box meets it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pd4dgs_codec.render.autograd.reference import composite, project
from pd4dgs_codec.render.projection import ALPHA_MIN

#: Pixels of a block's side: small blocks meet few Gaussians, large ones cost fewer calls.
BLOCK = 16


@torch.no_grad()
def picture(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near: float,
    background: Tensor,
    eps2d: float = 0.3,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """[H, W, 3] in `dtype`: what `rasterization(backend="reference")` draws of the same input, N as large as wanted.

    Shapes as there, for one camera: viewmat [4, 4], K [3, 3], background [3]; colors [N, 3].
    """
    tensors = [a.to(dtype) for a in (means, quats, scales, opacities, colors, viewmat, K, background)]
    means, quats, scales, opacities, colors, viewmat, K, background = tensors
    z = means @ viewmat[2, :3] + viewmat[2, 3]
    index = torch.nonzero((z > near) & (opacities > ALPHA_MIN))[:, 0]
    index = index[torch.sort(z[index].to(torch.float32), stable=True).indices]
    means, quats, scales, opacities, colors = (a[index] for a in tensors[:5])
    means2d, covariance, _ = project(means, quats, scales, viewmat, K, width, height, eps2d)
    p, q, r = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    det = p * r - q * q
    conics = torch.stack([r, -q, p], -1) / det[:, None]
    extent = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN))
    half = torch.ceil(extent[:, None] * torch.sqrt(torch.stack([p, r], -1)))
    drawn = det > 0
    image = background.expand(height, width, 3).clone()
    for top in range(0, height, BLOCK):
        rows = drawn & (means2d[:, 1] + half[:, 1] > top) & (means2d[:, 1] - half[:, 1] < top + BLOCK)
        row = torch.nonzero(rows)[:, 0]
        for left in range(0, width, BLOCK):
            hit = (means2d[row, 0] + half[row, 0] > left) & (means2d[row, 0] - half[row, 0] < left + BLOCK)
            own = row[hit]
            if len(own) == 0:
                continue
            size = min(BLOCK, width - left), min(BLOCK, height - top)
            shifted = means2d[own] - means2d.new_tensor([left, top])
            block, alpha = composite(shifted, conics[own], opacities[own], colors[own], *size)
            image[top : top + size[1], left : left + size[0]] = block + (1 - alpha) * background
    return image
