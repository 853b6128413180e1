"""Numba kernels of the training rate: the bits of some rows under the moments of all, and their gradient.

A row is an anchor; `classes` int8 [N] holds the step class of each, -1 of one that is not active. Values are [N, c] of
one float type, computed in float64 whatever that is. Sums are kept per block of rows: results do not depend on the
number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from pd4dgs_codec.draw.simd import Tasks, kernel, parallel

BLOCK = 1024  #: rows

_SQRT_HALF = math.sqrt(0.5)
_HALF_LN_2PI = 0.5 * math.log(2.0 * math.pi)
_SQRT_HALF_PI = math.sqrt(0.5 * math.pi)
_INVERSE_SQRT_PI = 1.0 / math.sqrt(math.pi)
_LN2 = math.log(2.0)
#: From here on erfcx is its asymptotic series, to 4e-12; below it exp(x^2) erfc(x), to 1e-13.
_FAR = 20.0


@kernel()
def _erfcx(x: float) -> float:
    """exp(x^2) erfc(x) for x >= 0."""
    if x < _FAR:
        return math.exp(x * x) * math.erfc(x)
    y = 0.5 / (x * x)
    return _INVERSE_SQRT_PI / x * (1.0 - y * (1.0 - 3.0 * y * (1.0 - 5.0 * y * (1.0 - 7.0 * y))))


@kernel(inline=True)
def _probability(z: float, h: float, u: float, v: float, narrow_below: float) -> tuple[float, float]:
    """(ln P, phi(u) / P) in the forms of `rate.py`; narrow_below: h max(z, 1) below which P is taken as narrow."""
    if h * max(z, 1.0) < narrow_below:
        z2, h2 = z * z, h * h
        series = (z2 - 1) * h2 / 6 + ((z2 - 6) * z2 + 3) * h2 * h2 / 120
        series += (((z2 - 15) * z2 + 45) * z2 - 15) * h2 * h2 * h2 / 5040
        mass = 2 * h * (1 + series)
        return math.log(mass) - 0.5 * z2 - _HALF_LN_2PI, math.exp(z * h - 0.5 * h2) / mass
    if u < 0:
        p = 0.5 * (math.erfc(u * _SQRT_HALF) - math.erfc(v * _SQRT_HALF))
        return math.log(p), math.exp(-0.5 * u * u - _HALF_LN_2PI) / p
    mass = _SQRT_HALF_PI * (_erfcx(u * _SQRT_HALF) - math.exp(-2 * z * h) * _erfcx(v * _SQRT_HALF))
    return math.log(mass) - 0.5 * u * u - _HALF_LN_2PI, 1.0 / mass


@parallel(lambda parts, *_: len(parts))
def sums(
    tasks: Tasks, parts: np.ndarray, values: np.ndarray, classes: np.ndarray, centre: np.ndarray, power: int
) -> None:
    """parts [blocks, K, c] += of each class the sum of values, or with power 2 that of their squared distances from
    centre [K, c]."""
    channels = values.shape[1]
    for block in range(tasks[0], tasks[1]):
        for i in range(block * BLOCK, min(len(values), (block + 1) * BLOCK)):
            k = classes[i]
            if k < 0:
                continue
            if power == 1:
                for j in range(channels):
                    parts[block, k, j] += values[i, j]
            else:
                for j in range(channels):
                    distance = values[i, j] - centre[k, j]
                    parts[block, k, j] += distance * distance


@parallel(lambda bits, *_: len(bits))
def row_bits(
    tasks: Tasks,
    bits: np.ndarray,
    by_value: np.ndarray,
    by_sigma: np.ndarray,
    values: np.ndarray,
    rows: np.ndarray,
    classes: np.ndarray,
    mu: np.ndarray,
    sigma: np.ndarray,
    step: float,
    least_sigma: float,
    most_bits: float,
    narrow_below: float,
) -> None:
    """bits float64 [n]: the sum of R over each of `rows` int64 [n], a scalar's bits clipped to most_bits; by_value and
    by_sigma [n, c]: the gradients of each scalar's R, not clipped. sigma [K, c] is held above least_sigma steps."""
    for r in range(tasks[0], tasks[1]):
        i = rows[r]
        k = classes[i]
        q, total = step * 2.0**k, 0.0
        for j in range(values.shape[1]):
            s = max(sigma[k, j], q * least_sigma)
            signed = values[i, j] - mu[k, j]
            z, h = abs(signed) / s, 0.5 * q / s
            u, v = (abs(signed) - 0.5 * q) / s, (abs(signed) + 0.5 * q) / s
            log_p, ratio = _probability(z, h, u, v, narrow_below)
            total += min(-log_p / _LN2, most_bits)
            m, slope = math.expm1(-2 * z * h), ratio / (s * _LN2)
            by_value[r, j] = -slope * m if signed > 0 else slope * m if signed < 0 else 0.0
            by_sigma[r, j] = slope * (2 * h + v * m) if s == sigma[k, j] else 0.0
        bits[r] = total


@parallel(lambda grad, *_: len(grad))
def moments_gradient(
    tasks: Tasks,
    grad: np.ndarray,
    values: np.ndarray,
    classes: np.ndarray,
    by_mu: np.ndarray,
    mu: np.ndarray,
    by_square: np.ndarray,
) -> None:
    """grad [N, c] = by_mu + (values - mu) by_square of each row's class, all [K, c] of the type of `values`."""
    for i in range(tasks[0], tasks[1]):
        k = classes[i]
        for j in range(values.shape[1]):
            grad[i, j] = by_mu[k, j] + (values[i, j] - mu[k, j]) * by_square[k, j] if k >= 0 else 0.0
