"""The picture's loss: L1 and 1 - SSIM of a render against a training image, as two unweighted terms.

SSIM is that of Wang et al. 2004 as 3DGS uses it: 11-tap Gaussian window of sigma 1.5, zero padding, c1 = .01^2,
c2 = .03^2, per channel, mean of the map. With a mask both maps are weighted by it and divided by its sum; windows
at its border still read masked pixels. The CPU uses numba kernels, other devices `image_loss_reference`.

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

from pd4dgs_codec.draw.layers import whole
from pd4dgs_codec.draw.simd import LANES, Tasks, fma, fnma, kernel, load, parallel, splat, store
from pd4dgs_codec.quality.image import C1, C2, GAUSSIAN

TAPS = GAUSSIAN.astype(np.float32)
REACH = 5
SIDE = 3 * REACH
Part = tuple[slice, slice]  #: rows and columns
WHOLE = slice(None), slice(None)


def pixel_weights(mask: Tensor) -> Tensor:
    """float32 [H, W]: the mask, scaled so that it sums to 1 over pixels and channels; all zero if the mask is."""
    total = 3 * mask.sum(dtype=torch.float64)
    return (mask / total.clamp_min(1e-6)).float()


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, weights: Tensor, part: Part) -> tuple[Tensor, Tensor]:
        x, y, w = pad(image[part].numpy()), pad(target.numpy()), weights.contiguous().numpy()
        slopes, sums = np.zeros((3, *x.shape), x.dtype), np.empty((len(w), 2))
        loss(slopes, sums, x, y, w, TAPS)
        ctx.saved, ctx.shape, ctx.part = (x, y, w, slopes), image.shape, part
        l1, dissimilarity = sums.sum(0)
        return image.new_tensor(l1), image.new_tensor(dissimilarity)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_l1: Tensor, g_dissimilarity: Tensor) -> tuple[Tensor, None, None, None]:
        x, y, weights, slopes = ctx.saved
        grad = np.empty((*weights.shape, 3), x.dtype)
        factors = np.array([g_l1.item(), g_dissimilarity.item()], x.dtype)
        loss_backward(grad, x, y, weights, slopes, factors, TAPS)
        whole = torch.zeros(ctx.shape)
        whole[ctx.part] = torch.from_numpy(grad)
        return whole, None, None, None


def image_loss(image: Tensor, target: Tensor, weights: Tensor, part: Part = WHOLE) -> tuple[Tensor, Tensor]:
    """(weighted mean of |image - target|, weighted mean of 1 - SSIM), scalars. image, target: float32 [H, W, 3], 0..1.
    weights: [H, W], from `pixel_weights`. part: the rows and columns of the image that `target` and `weights` cover."""
    if image.device.type != "cpu":
        return image_loss_reference(image[part], target, weights)
    l1, dissimilarity = _ImageLoss.apply(image, target, weights, part)  # type: ignore[no-untyped-call]
    return l1, dissimilarity


def image_loss_reference(image: Tensor, target: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The plain torch form of `image_loss`."""
    taps = torch.from_numpy(GAUSSIAN).to(image).view(1, 1, -1, 1)

    def blur(channels: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(channels, taps, padding=(5, 0)), taps.mT, padding=(0, 5))

    x, y = image.permute(2, 0, 1)[:, None], target.permute(2, 0, 1)[:, None]
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * cov + C2) / (var_x + var_y + C2)
    dissimilarity = (1 - luminance * structure)[:, 0] * weights
    return ((image - target).abs() * weights[..., None]).sum(), dissimilarity.sum()


def within_reach(differs: Tensor) -> slice:
    """The rows (or columns) on which `image_loss` of two pictures and its gradient depend; outside, both are zero.
    differs: bool [n], whether the pictures may differ in a row.

    A difference changes the SSIM of windows up to REACH away, whose other pixels lie up to REACH further.
    """
    found = differs.nonzero()[:, 0].tolist() or [0]
    return slice(max(0, found[0] - 2 * REACH), found[-1] + 1 + 2 * REACH)


def pad(image: np.ndarray) -> np.ndarray:
    """[H, W, 3] -> padded image."""
    height, width = image.shape[:2]
    lanes = 3 * (whole(3 * width, LANES) // 3 + 2 * REACH + 1)
    out = np.zeros((height + 2 * REACH, whole(lanes, LANES)), image.dtype)
    out[REACH:-REACH, SIDE : SIDE + 3 * width] = image.reshape(height, -1)
    return out


@kernel(inline=True)
def _across(row: np.ndarray, k: int, taps: np.ndarray) -> Any:
    """The horizontal window at lane k of an image row, from a flat padded row (offset included in k)."""
    value = load(row, k) * splat(taps[0])
    for o in range(1, len(taps)):
        value = fma(load(row, k + 3 * o), splat(taps[o]), value)
    return value


@kernel(inline=True)
def _down(rows: np.ndarray, x: np.ndarray, y: np.ndarray, j: int, taps: np.ndarray) -> None:
    """rows [5, stride] = the vertical window of x, x^2, x y, y and y^2 at image row j."""
    stride = x.shape[1]
    zero = splat(x.dtype.type(0))
    for k in range(0, stride, LANES):
        x1 = x2 = xy = y1 = y2 = zero
        for o in range(len(taps)):
            a, b = load(x, (j + o) * stride + k), load(y, (j + o) * stride + k)
            weighted_a, weighted_b = a * splat(taps[o]), b * splat(taps[o])
            x1, y1 = x1 + weighted_a, y1 + weighted_b
            x2, xy, y2 = fma(weighted_a, a, x2), fma(weighted_a, b, xy), fma(weighted_b, b, y2)
        store(rows, k, x1)
        store(rows, stride + k, x2)
        store(rows, 2 * stride + k, xy)
        store(rows, 3 * stride + k, y1)
        store(rows, 4 * stride + k, y2)


@parallel(lambda slopes, sums, *_: len(sums))
def loss(
    tasks: Tasks,
    slopes: np.ndarray,
    sums: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    taps: np.ndarray,
) -> None:
    """sums [H, 2] = per row the weighted sums of |x - y| and of 1 - SSIM.

    slopes [3, H + 10, stride], given zeroed = the weighted derivatives of SSIM by the windowed x, x^2 and x y, in the
    layout of a padded image.
    """
    height, width = weights.shape
    stride, n = x.shape[1], (3 * width + LANES - 1) // LANES * LANES
    real = x.dtype.type
    one, two, c1, c2 = splat(real(1)), splat(real(2)), splat(real(C1)), splat(real(C2))
    rows, part = np.empty((5, stride), x.dtype), np.empty(n, x.dtype)
    weight = np.zeros(n, x.dtype)  # zero beyond the image, so that slopes stay zero there
    for j in range(tasks[0], tasks[1]):
        for i in range(3 * width):
            weight[i] = weights[j, i // 3]
        _down(rows, x, y, j, taps)
        for k in range(0, n, LANES):
            mx, my, w = _across(rows, k, taps), _across(rows, 3 * stride + k, taps), load(weight, k)
            var_x = fnma(mx, mx, _across(rows, stride + k, taps))
            var_y = fnma(my, my, _across(rows, 4 * stride + k, taps))
            cov = fnma(mx, my, _across(rows, 2 * stride + k, taps))
            a1, a2 = two * mx * my + c1, two * cov + c2
            b1, b2 = mx * mx + my * my + c1, var_x + var_y + c2
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
