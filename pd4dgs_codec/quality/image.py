"""Masked PSNR and SSIM of the DyCheck protocol, SSIM of 3D Gaussian Splatting, in float64 numpy, and means over views.

Images are rounded to 8 bits first, as in a written picture. Masks are bool [H, W], True for pixels that count.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pd4dgs_codec.errors import DataError

if TYPE_CHECKING:
    from pd4dgs_codec.data.view import View

TAPS, SIGMA = 11, 1.5
GAUSSIAN: np.ndarray = np.exp(-0.5 * ((np.arange(TAPS) - TAPS // 2) / SIGMA) ** 2)
GAUSSIAN /= GAUSSIAN.sum()
C1, C2 = 0.01**2, 0.03**2
LEAST_WEIGHT = 1e-6
#: A pixel moves if its true colour changes by more than this, of 255: above video noise, below changes by motion.
MOVING = 16


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Converts floats in 0..1 (clipped, rounded) to uint8; uint8 passes. Raises DataError for NaN and other dtypes."""
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind != "f":
        raise DataError(f"image has dtype {image.dtype}, expected uint8 or floats in 0..1")
    if np.isnan(image).any():
        raise DataError(f"image holds NaN in {int(np.isnan(image).sum())} values, expected numbers in 0..1")
    return np.rint(np.clip(image.astype(np.float64), 0.0, 1.0) * 255.0).astype(np.uint8)


def prepare(pred: np.ndarray, target: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns both images rounded to 8 bits, [H, W, 3] in 0..1, and the mask [H, W], float64. Raises DataError."""
    a, b = np.asarray(pred), np.asarray(target)
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise DataError(f"images have shapes {a.shape} and {b.shape}, expected the same [H, W, 3]")
    m = np.ones(a.shape[:2]) if mask is None else np.asarray(mask).astype(np.float64)
    if m.shape != a.shape[:2]:
        raise DataError(f"mask has shape {m.shape}, expected {a.shape[:2]} as the images")
    return to_uint8(a) / 255.0, to_uint8(b) / 255.0, m


def mpsnr(pred: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Returns -10 log10(sum(squared error * m) / max(sum(m), 1e-6)) in dB, m over 3 channels; inf for equal images.

    pred, target: [H, W, 3] uint8 or floats in 0..1. mask: bool [H, W]; None = all.
    """
    a, b, m = prepare(pred, target, mask)
    mse = float((np.square(a - b) * m[..., None]).sum() / max(3.0 * m.sum(), LEAST_WEIGHT))
    return float("inf") if mse == 0 else float(-10.0 * np.log10(mse))


def _slide(z: np.ndarray, weights: np.ndarray, axis: int) -> np.ndarray:
    """Returns the valid correlation of z with `weights` along an axis."""
    n = z.shape[axis] - len(weights) + 1
    part = [slice(None)] * z.ndim
    total = 0.0
    for i, w in enumerate(weights):
        part[axis] = slice(i, i + n)
        total = total + w * z[tuple(part)]
    return np.asarray(total)


def _blur(z: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Blurs z [H, W, C] with mask m [H, W, 1] by a separable Gaussian, along rows first, then along columns.

    Each pass is conv(z m, f) * taps / conv(m, 1), or 0 where no pixel counts; the mask becomes (count != 0).
    """
    for axis in (1, 0):
        count = _slide(m, np.ones(TAPS), axis)
        z = np.where(count != 0, _slide(z * m, GAUSSIAN, axis) * TAPS / np.maximum(count, 1.0), 0.0)
        m = (count != 0).astype(np.float64)
    return z


def mssim(pred: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Masked SSIM: 11-tap Gaussian, sigma 1.5, valid; variances >= 0, |covariance| <= sqrt(s0 s1); mean of the map.

    pred, target: [H, W, 3] uint8 or floats in 0..1, at least 11x11. mask: bool [H, W]; None = all. The mean is not
    weighted by the mask, as in the protocol: windows without a valid pixel count as 1.
    """
    a, b, m = prepare(pred, target, mask)
    if min(a.shape[:2]) < TAPS:
        raise DataError(f"image is {a.shape[1]}x{a.shape[0]}, expected at least {TAPS}x{TAPS} for SSIM")
    blurred = _blur(np.concatenate([a, b, a * a, b * b, a * b], axis=2), m[..., None])
    mu0, mu1, aa, bb, ab = np.split(blurred, 5, axis=2)
    var0, var1 = np.maximum(aa - mu0 * mu0, 0.0), np.maximum(bb - mu1 * mu1, 0.0)
    cov = ab - mu0 * mu1
    cov = np.sign(cov) * np.minimum(np.sqrt(var0 * var1), np.abs(cov))
    return _mean_ssim(mu0, mu1, var0 + var1, cov)


def ssim(pred: np.ndarray, target: np.ndarray) -> float:
    """SSIM as 3D Gaussian Splatting's code computes it: 11x11 Gaussian, sigma 1.5, zeros around the picture, per
    channel; mean of the map. pred, target: [H, W, 3] uint8 or floats in 0..1."""
    a, b, _ = prepare(pred, target, None)
    z = np.pad(np.concatenate([a, b, a * a, b * b, a * b], axis=2), [(TAPS // 2, TAPS // 2)] * 2 + [(0, 0)])
    mu0, mu1, aa, bb, ab = np.split(_slide(_slide(z, GAUSSIAN, 1), GAUSSIAN, 0), 5, axis=2)
    return _mean_ssim(mu0, mu1, aa - mu0 * mu0 + bb - mu1 * mu1, ab - mu0 * mu1)


def _mean_ssim(mu0: np.ndarray, mu1: np.ndarray, variances: np.ndarray, cov: np.ndarray) -> float:
    numerator = (2 * mu0 * mu1 + C1) * (2 * cov + C2)
    return float((numerator / ((mu0 * mu0 + mu1 * mu1 + C1) * (variances + C2))).mean())


def mean_image_baseline(train: Sequence[View], test: Sequence[View]) -> float | None:
    """Returns the mean mPSNR in dB of the mean training image over the test views, which a model should exceed, or None
    if images differ in size. Raises DataError without training or test views."""
    if not train or not test:
        raise DataError(f"found {len(train)} training and {len(test)} test views, expected at least 1 of each")
    if len({view.image.shape for view in (*train, *test)}) > 1:
        return None
    mean = np.asarray(sum(view.image.astype(np.float64) for view in train)) / (255.0 * len(train))
    return float(np.mean([mpsnr(mean, view.image, view.mask) for view in test]))


def moving_regions(views: Sequence[View]) -> dict[View, np.ndarray]:
    """Returns masks bool [H, W] of the valid pixels that change over time, for views of static cameras.

    A camera pose with views at two or more times is static. A pixel changes if a channel of the true image changes by
    more than MOVING between any two times at which it is valid. Views without such a pixel are left out.
    """
    cameras: dict[tuple[object, ...], list[View]] = {}
    for view in views:
        pose = view.viewmat.tobytes(), view.K.tobytes(), view.width, view.height
        cameras.setdefault(pose, []).append(view)
    regions = {}
    for taken in cameras.values():
        if len({view.time for view in taken}) < 2:
            continue
        low, high = np.full_like(taken[0].image, 255), np.zeros_like(taken[0].image)
        for view in taken:
            valid = True if view.mask is None else view.mask[..., None]
            np.minimum(low, view.image, out=low, where=valid)
            np.maximum(high, view.image, out=high, where=valid)
        changes = (high.astype(np.int16) - low > MOVING).any(axis=2)
        for view in taken:
            region = changes if view.mask is None else changes & view.mask
            if region.any():
                regions[view] = region
    return regions


#: (picture, true image, mask) -> score
Metric = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


def mean_scores(
    draw: Callable[[View], np.ndarray],
    views: Sequence[View],
    metrics: Mapping[str, Metric],
    step: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Returns each metric's mean score of draw(view), [H, W, 3] in 0..1, over `views`. step: called after each view."""
    scores: dict[str, list[float]] = {name: [] for name in metrics}
    for view in views:
        picture = draw(view)
        for name, metric in metrics.items():
            scores[name].append(metric(picture, view.image, view.mask))
        step()
    return {name: float(np.mean(values)) for name, values in scores.items()}
