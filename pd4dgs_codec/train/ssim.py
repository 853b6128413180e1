"""The picture's loss: L1 and 1 - SSIM of a render against a training image, as two unweighted terms.

SSIM is that of Wang et al. 2004 as 3DGS uses it: 11-tap Gaussian window of sigma 1.5, zero padding, c1 = .01^2,
c2 = .03^2, per channel, mean of the map. With a mask both maps are weighted by it and divided by its sum; a window
still covers the masked pixels next to it. The CPU uses numba kernels, other devices `image_loss_reference`.

In the kernels a row [W, 3] is 3 W floats, so that the horizontal pass is a sum of shifts by 3 and both passes are
contiguous vectors. Images are padded with zeros by 5 pixels on each side and some more on the right, so that no loop
has a border case: [H + 10, stride], pixel (j, i) channel c at [j + 5, 15 + 3 i + c]. Threads split rows and sums are
kept per row: results do not depend on the number of threads. weights: [H, W]. taps: [11].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw.simd import LANES, Tasks, fma, fnma, kernel, load, parallel, splat, store
from pd4dgs_codec.errors import TrainError

C1, C2 = 0.01**2, 0.03**2
TAPS = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
TAPS /= TAPS.sum()
REACH = 5
SIDE = 3 * REACH


class Target:
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
    def forward(ctx: Any, image: Tensor, target: Target) -> tuple[Tensor, Tensor]:
        x, y = pad(image.numpy()), pad(target.image.numpy())
        weights, taps = target.weights.numpy(), TAPS.astype(x.dtype)
        height, width = weights.shape
        mean, variance = (np.empty((height, lanes(width)), y.dtype) for _ in range(2))
        target_moments(mean, variance, y, taps)
        slopes = np.zeros((3, *x.shape), x.dtype)
        sums = np.empty((height, 2))
        loss(slopes, sums, x, y, mean, variance, weights, taps)
        ctx.saved = x, y, weights, slopes
        l1, dissimilarity = sums.sum(0)
        return image.new_tensor(l1), image.new_tensor(dissimilarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_l1: Tensor, g_dissimilarity: Tensor) -> tuple[Tensor, None]:
        x, y, weights, slopes = ctx.saved
        grad = np.empty((*weights.shape, 3), x.dtype)
        factors = np.array([g_l1.item(), g_dissimilarity.item()], x.dtype)
        loss_backward(grad, x, y, weights, slopes, factors, TAPS.astype(x.dtype))
        return torch.from_numpy(grad), None


def image_loss(image: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """(weighted mean of |image - target|, weighted mean of 1 - SSIM), scalars. image: [H, W, 3], linear 0..1."""
    if image.shape != target.image.shape:
        raise TrainError(f"render is {tuple(image.shape)}, its training image {tuple(target.image.shape)}")
    image = image.to(target.image.dtype)
    if image.device.type == "cpu":
        l1, dissimilarity = _ImageLoss.apply(image.contiguous(), target)  # type: ignore[no-untyped-call]
        return l1, dissimilarity
    return image_loss_reference(image, target.image, target.weights)


def image_loss_reference(image: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The plain torch form of `image_loss`; target [H, W, 3], weights [H, W] as in `Target`."""
    taps = torch.from_numpy(TAPS).to(image).view(1, 1, -1, 1)

    def blur(channels: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(channels, taps, padding=(5, 0)), taps.mT, padding=(0, 5))

    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * cov + C2) / (var_x + var_y + C2)
    dissimilarity = (1 - luminance * structure)[:, 0] * weights
    return ((image - target).abs() * weights[..., None]).sum(), dissimilarity.sum()


def lanes(width: int) -> int:
    """3 * width rounded up to whole vectors."""
    return -(-3 * width // LANES) * LANES


def pad(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] -> padded image."""
    height, width = image.shape[:2]
    out = np.zeros((height + 2 * REACH, lanes(lanes(width) // 3 + 2 * REACH + 1)), image.dtype)
    out[REACH:-REACH, SIDE : SIDE + 3 * width] = image.reshape(height, -1)
    return out


@kernel(inline=True)
def _across(row: np.ndarray, k: int, taps: np.ndarray) -> Any:
    """The horizontal window at lane k of an image row, from a flat padded row (offset included in k)."""
    value = load(row, k) * splat(taps[0])
    for o in range(1, len(taps)):
        value = fma(load(row, k + 3 * o), splat(taps[o]), value)
    return value


@parallel(lambda mean, *_: len(mean))
def target_moments(tasks: Tasks, mean: np.ndarray, variance: np.ndarray, image: np.ndarray, taps: np.ndarray) -> None:
    """mean, variance [H, lanes] of a padded image under the window."""
    stride = image.shape[1]
    zero = splat(image.dtype.type(0))
    rows = np.empty((2, stride), image.dtype)
    for j in range(tasks[0], tasks[1]):
        for k in range(0, stride, LANES):
            first = second = zero
            for o in range(len(taps)):
                a = load(image, (j + o) * stride + k)
                weighted = a * splat(taps[o])
                first = first + weighted
                second = fma(weighted, a, second)
            store(rows, k, first)
            store(rows, stride + k, second)
        for k in range(0, mean.shape[1], LANES):
            m = _across(rows, k, taps)
            store(mean, j * mean.shape[1] + k, m)
            store(variance, j * mean.shape[1] + k, fnma(m, m, _across(rows, stride + k, taps)))


@kernel(inline=True)
def _down(rows: np.ndarray, x: np.ndarray, y: np.ndarray, j: int, taps: np.ndarray) -> None:
    """rows [3, stride] = the vertical window of x, x^2 and x y at image row j."""
    stride = x.shape[1]
    zero = splat(x.dtype.type(0))
    for k in range(0, stride, LANES):
        first = second = cross = zero
        for o in range(len(taps)):
            a = load(x, (j + o) * stride + k)
            weighted = a * splat(taps[o])
            first = first + weighted
            second = fma(weighted, a, second)
            cross = fma(weighted, load(y, (j + o) * stride + k), cross)
        store(rows, k, first)
        store(rows, stride + k, second)
        store(rows, 2 * stride + k, cross)


@parallel(lambda slopes, sums, *_: len(sums))
def loss(
    tasks: Tasks,
    slopes: np.ndarray,
    sums: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    mean_y: np.ndarray,
    var_y: np.ndarray,
    weights: np.ndarray,
    taps: np.ndarray,
) -> None:
    """sums [H, 2] = per row the weighted sums of |x - y| and of 1 - SSIM.

    slopes [3, H + 10, stride], given zeroed = the weighted derivatives of SSIM by the windowed x, x^2 and x y, in the
    layout of a padded image.
    """
    height, width = weights.shape
    stride, n = x.shape[1], mean_y.shape[1]
    real = x.dtype.type
    one, two, c1, c2 = splat(real(1)), splat(real(2)), splat(real(C1)), splat(real(C2))
    rows, part = np.empty((3, stride), x.dtype), np.empty(n, x.dtype)
    weight = np.zeros(n, x.dtype)  # zero beyond the image, so that slopes stay zero there
    for j in range(tasks[0], tasks[1]):
        for i in range(3 * width):
            weight[i] = weights[j, i // 3]
        _down(rows, x, y, j, taps)
        for k in range(0, n, LANES):
            mx, my, w = _across(rows, k, taps), load(mean_y, j * n + k), load(weight, k)
            var_x = fnma(mx, mx, _across(rows, stride + k, taps))
            cov = fnma(mx, my, _across(rows, 2 * stride + k, taps))
            a1, a2 = two * mx * my + c1, two * cov + c2
            b1, b2 = mx * mx + my * my + c1, var_x + load(var_y, j * n + k) + c2
            inverse1, inverse2 = one / b1, one / b2
            w_inverse = w * inverse1 * inverse2
            w_ssim = w_inverse * a1 * a2
            store(part, k, w - w_ssim)
            at = (j + REACH) * stride + SIDE + k
            size = (height + 2 * REACH) * stride
            by_mean = two * (my * (a2 - a1) * w_inverse - mx * w_ssim * (inverse1 - inverse2))
            store(slopes, at, by_mean)
            store(slopes, at + size, splat(real(0)) - w_ssim * inverse2)
            store(slopes, at + 2 * size, two * a1 * w_inverse)
        absolute = dissimilarity = 0.0
        for i in range(3 * width):
            absolute += weight[i] * abs(x[j + REACH, SIDE + i] - y[j + REACH, SIDE + i])
            dissimilarity += part[i]
        sums[j, 0], sums[j, 1] = absolute, dissimilarity


@parallel(lambda grad, *_: len(grad))
def loss_backward(
    tasks: Tasks,
    grad: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    slopes: np.ndarray,
    factors: np.ndarray,
    taps: np.ndarray,
) -> None:
    """grad [H, W, 3] = d(factors[0] * L1 + factors[1] * (1 - SSIM)) / dx; the window is its own transpose."""
    height, width = weights.shape
    stride = x.shape[1]
    size = (height + 2 * REACH) * stride
    real = x.dtype.type
    zero, two, factor = splat(real(0)), splat(real(2)), splat(-factors[1])
    rows, result = np.empty((3, stride), x.dtype), np.empty(stride, x.dtype)
    for j in range(tasks[0], tasks[1]):
        for k in range(0, stride, LANES):
            for q in range(3):
                value = zero
                for o in range(len(taps)):
                    value = fma(load(slopes, q * size + (j + o) * stride + k), splat(taps[o]), value)
                store(rows, q * stride + k, value)
        at = (j + REACH) * stride + SIDE
        for k in range(0, 3 * width, LANES):
            by_second, by_cross = _across(rows, stride + k, taps), _across(rows, 2 * stride + k, taps)
            value = _across(rows, k, taps) + two * load(x, at + k) * by_second + load(y, at + k) * by_cross
            store(result, k, factor * value)
        for i in range(width):
            for c in range(3):
                k = 3 * i + c
                sign = np.sign(x[j + REACH, SIDE + k] - y[j + REACH, SIDE + k])
                grad[j, i, c] = result[k] + factors[0] * weights[j, i] * sign
