"""The picture's loss: L1 and 1 - SSIM of a render against a training image, as two unweighted terms.

SSIM is that of Wang et al. 2004 as 3DGS uses it: 11-tap Gaussian window of sigma 1.5, zero padding, c1 = .01^2,
c2 = .03^2, per channel, mean of the map. With a mask both maps are weighted by it and divided by its sum; a window
still sees the masked pixels next to it. On CPU numba kernels do it (`ssim_kernels.py`), else `image_loss_reference`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.train import ssim_kernels as kernels


class TargetStats:
    """A training image and what SSIM needs of it alone.

    image: [H, W, 3] float, 0..1. mask: [H, W] weights >= 0 (bool or float), None for all ones. The image's blurred
    statistics are computed anew for each loss, a fifth of its time: kept, they were 8 bytes per value.
    """

    def __init__(self, image: Tensor, mask: Tensor | None = None):
        if image.dim() != 3 or image.shape[2] != 3 or not image.is_floating_point() or not image.numel():
            raise TrainError(f"training image must be float [H, W, 3], found {image.dtype} {tuple(image.shape)}")
        if mask is not None and mask.shape != image.shape[:2]:
            raise TrainError(f"mask must be {tuple(image.shape[:2])}, found {tuple(mask.shape)}")
        self.image = image.detach().contiguous()
        weights = image.new_ones(image.shape[:2]) if mask is None else mask.detach().to(image)
        total = 3 * weights.sum(dtype=torch.float64)
        #: [H, W], sums to 1 over the pixels and channels; all zero if the mask is.
        self.weights = (weights / total.clamp_min(1e-6)).to(image.dtype).contiguous()


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: TargetStats) -> tuple[Tensor, Tensor]:
        x, y = kernels.pad(image.numpy()), kernels.pad(target.image.numpy())
        weights, taps = target.weights.numpy(), kernels.TAPS.astype(x.dtype)
        height, width = weights.shape
        mean, variance = (np.empty((height, kernels.lanes(width)), y.dtype) for _ in range(2))
        kernels.target_moments(mean, variance, y, taps)
        slopes = np.zeros((3, *x.shape), x.dtype)
        sums = np.empty((height, 2))
        kernels.loss(slopes, sums, x, y, mean, variance, weights, taps)
        ctx.saved = x, y, weights, slopes
        l1, dissimilarity = sums.sum(0)
        return image.new_tensor(l1), image.new_tensor(dissimilarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_l1: Tensor, g_dissimilarity: Tensor) -> tuple[Tensor, None]:
        x, y, weights, slopes = ctx.saved
        grad = np.empty((*weights.shape, 3), x.dtype)
        factors = np.array([g_l1.item(), g_dissimilarity.item()], x.dtype)
        kernels.loss_backward(grad, x, y, weights, slopes, factors, kernels.TAPS.astype(x.dtype))
        return torch.from_numpy(grad), None


def image_loss(image: Tensor, target: TargetStats) -> tuple[Tensor, Tensor]:
    """(weighted mean of |image - target|, weighted mean of 1 - SSIM), scalars. image: [H, W, 3], linear 0..1."""
    if image.shape != target.image.shape:
        raise TrainError(f"render is {tuple(image.shape)}, its training image {tuple(target.image.shape)}")
    image = image.to(target.image.dtype)
    if image.device.type == "cpu":
        l1, dissimilarity = _ImageLoss.apply(image.contiguous(), target)  # type: ignore[no-untyped-call]
        return l1, dissimilarity
    return image_loss_reference(image, target.image, target.weights)


def image_loss_reference(image: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The plain torch form of `image_loss`; target [H, W, 3], weights [H, W] as in `TargetStats`."""
    taps = torch.from_numpy(kernels.TAPS).to(image).view(1, 1, -1, 1)

    def blur(channels: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(channels, taps, padding=(5, 0)), taps.mT, padding=(0, 5))

    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + kernels.C1) / (mean_x**2 + mean_y**2 + kernels.C1)
    structure = (2 * cov + kernels.C2) / (var_x + var_y + kernels.C2)
    dissimilarity = (1 - luminance * structure)[:, 0] * weights
    return ((image - target).abs() * weights[..., None]).sum(), dissimilarity.sum()
