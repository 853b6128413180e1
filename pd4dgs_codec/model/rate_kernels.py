"""Numba kernels of the training rate: the two element-wise functions of `rate.py`, in one pass each.

Arrays are [n, c] of one float type, computed in float64 whatever that is; broadcast ones may repeat their elements.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from pd4dgs_codec.render.simd import kernel

_SQRT_HALF = math.sqrt(0.5)
_HALF_LN_2PI = 0.5 * math.log(2.0 * math.pi)
_SQRT_HALF_PI = math.sqrt(0.5 * math.pi)
_INVERSE_SQRT_PI = 1.0 / math.sqrt(math.pi)
#: From here on erfcx is its asymptotic series, to 4e-12; below it exp(x^2) erfc(x), to 1e-13.
_FAR = 20.0


@kernel()
def _erfcx(x: float) -> float:
    """exp(x^2) erfc(x) for x >= 0."""
    if x < _FAR:
        return math.exp(x * x) * math.erfc(x)
    y = 0.5 / (x * x)
    return _INVERSE_SQRT_PI / x * (1.0 - y * (1.0 - 3.0 * y * (1.0 - 5.0 * y * (1.0 - 7.0 * y))))


@kernel(parallel=True)
def log_probability(
    out: np.ndarray,
    log_ratio: np.ndarray,
    z: np.ndarray,
    h: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    narrow_below: float,
) -> None:
    """out = ln P and log_ratio = ln(phi(u) / P) in the forms of `rate.py`; narrow_below: h max(z, 1) below which P is
    taken as narrow."""
    for i in nb.prange(z.shape[0]):
        for j in range(z.shape[1]):
            zi, hi, ui, vi = np.float64(z[i, j]), np.float64(h[i, j]), np.float64(u[i, j]), np.float64(v[i, j])
            log_phi = -0.5 * ui * ui - _HALF_LN_2PI
            if ui < 0 and hi * max(zi, 1.0) >= narrow_below:
                out[i, j] = math.log(0.5 * (math.erfc(ui * _SQRT_HALF) - math.erfc(vi * _SQRT_HALF)))
                log_ratio[i, j] = log_phi - out[i, j]
                continue
            if hi * max(zi, 1.0) < narrow_below:
                z2, h2 = zi * zi, hi * hi
                series = (z2 - 1) * h2 / 6 + ((z2 - 6) * z2 + 3) * h2 * h2 / 120
                series += (((z2 - 15) * z2 + 45) * z2 - 15) * h2 * h2 * h2 / 5040
                ratio = zi * hi - 0.5 * h2 - math.log(2 * hi) - math.log1p(series)
            else:
                far = math.exp(-2 * zi * hi) * _erfcx(vi * _SQRT_HALF)
                ratio = -math.log(_SQRT_HALF_PI * (_erfcx(ui * _SQRT_HALF) - far))
            log_ratio[i, j] = ratio
            out[i, j] = log_phi - ratio


@kernel(parallel=True)
def gradients(
    grad_a: np.ndarray,
    grad_sigma: np.ndarray,
    grad: np.ndarray,
    signed: np.ndarray,
    sigma: np.ndarray,
    z: np.ndarray,
    h: np.ndarray,
    v: np.ndarray,
    log_ratio: np.ndarray,
) -> None:
    """The gradients by a and sigma; grad: that of ln P; signed: a - mu; log_ratio: from `log_probability`."""
    for i in nb.prange(z.shape[0]):
        for j in range(z.shape[1]):
            zi, hi, vi = np.float64(z[i, j]), np.float64(h[i, j]), np.float64(v[i, j])
            m = math.expm1(-2 * zi * hi)
            slope = np.float64(grad[i, j]) * math.exp(np.float64(log_ratio[i, j])) / np.float64(sigma[i, j])
            sign = 1.0 if signed[i, j] > 0 else -1.0 if signed[i, j] < 0 else 0.0
            grad_a[i, j] = slope * sign * m
            grad_sigma[i, j] = -slope * (2 * hi + vi * m)
