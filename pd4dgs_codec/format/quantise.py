"""Uniform scalar quantisation, float32 <-> int32 symbols, and mask codes."""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.scene import MASK_MIN_CODE, MASK_THRESHOLD

#: Symbols k satisfy |k| <= MAX_SYMBOL: binary64(k) * binary64(Q) is exact, and no two symbols of one step share a
#: binary32 value, so that quantising what was dequantised gives the same symbol.
MAX_SYMBOL = 1 << 23

_SMALLEST_STEP = float(np.finfo(np.float32).tiny)
_LARGEST_STEP = float(np.finfo(np.float32).max)
_TO_INFINITY = 2.0**128 - 2.0**103  #: from here on binary64 rounds to an infinite binary32


def is_step(value: float) -> bool:
    """Whether `value` may be a quantisation step or a voxel size: a positive normal binary32."""
    return bool(_SMALLEST_STEP <= value <= _LARGEST_STEP and float(np.float32(value)) == value)


#: Integers that broadcast against the symbols: where a channel's grid lies and how far apart its points are, in steps.
Integers = np.ndarray | int


def magnitude(k: np.ndarray) -> int:
    """The largest |k| of an integer array of any shape, 0 of an empty one."""
    return max(int(k.max()), -int(k.min())) if k.size else 0


def quantise(
    x: np.ndarray, step: float, name: str = "tensor", centre: Integers = 0, spacing: Integers = 1
) -> np.ndarray:
    """k = round-half-to-even((binary64(x) / binary64(step) - centre) / spacing), int32 of x's shape.

    x: float32 array. step: positive normal binary32. spacing: powers of two. quantise(dequantise(k, ...), ...) == k
    while |centre + k spacing| <= 2^23; above that two neighbouring k can share one binary32 value unless step is a
    power of two. Raises EncodeError naming the tensor if a value is not finite, that or |k| would exceed MAX_SYMBOL, or
    x_hat be infinite.
    """
    if not is_step(step):
        raise EncodeError(f"{name}: quantisation step {step!r}, expected a positive normal binary32 value")
    if not np.isfinite(x).all():
        raise EncodeError(f"{name}: {np.size(x) - int(np.isfinite(x).sum())} values are NaN or infinite, expected none")
    k = np.rint((x.astype(np.float64) / np.float64(step) - centre) / spacing)
    at = centre + k * spacing
    largest = float(max(np.abs(k).max(), np.abs(at).max())) if k.size else 0.0
    if largest > MAX_SYMBOL:
        raise EncodeError(f"{name}: symbol of magnitude {largest:.0f} at step {step:g}, expected at most {MAX_SYMBOL}")
    if not all_finite(at, step):
        raise EncodeError(f"{name}: a value that comes back as infinity at step {step:g}, expected a finite one")
    symbols: np.ndarray = k.astype(np.int32)
    return symbols


def all_finite(k: np.ndarray, step: float) -> bool:
    """Whether dequantise(k, step) holds no infinity; |k| <= MAX_SYMBOL."""
    if MAX_SYMBOL * step < _TO_INFINITY:
        return True
    return magnitude(k) * step < _TO_INFINITY


def dequantise(k: np.ndarray, step: float, centre: Integers = 0, spacing: Integers = 1) -> np.ndarray:
    """x_hat = binary32(binary64(centre + k spacing) * binary64(step)), float32 of k's shape: an exact product and one
    rounding.

    So is that product in binary32, because |k|, |centre| and |centre + k spacing| are at most MAX_SYMBOL, spacings are
    powers of two and the step is a binary32: all that is rounded is the last result.
    """
    values: np.ndarray = k.astype(np.float32)
    if np.ndim(spacing) or spacing != 1:
        values *= np.asarray(spacing, np.float32)
    if np.any(centre):
        values += np.asarray(centre, np.float32)
    with np.errstate(over="ignore"):  # an overflow to infinity is the caller's to refuse, see all_finite
        values *= np.float32(step)
    return values


def mask_codes(mask: np.ndarray) -> np.ndarray:
    """uint8 codes of masks m in [0, 1]: 0 where m <= MASK_THRESHOLD, else max(MASK_MIN_CODE, round(255 m)).

    Monotone in m, so codes keep the order of the masks they come from. The inverse is m = code * MASK_STEP.
    """
    m = np.asarray(mask, dtype=np.float64)
    if not ((m >= 0) & (m <= 1)).all():
        raise EncodeError("mask: a value is outside [0, 1] or NaN")
    return np.where(m <= MASK_THRESHOLD, 0, np.maximum(MASK_MIN_CODE, np.rint(m * 255.0))).astype(np.uint8)
