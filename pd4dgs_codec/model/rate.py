"""The training-time rate R(a) = -log2 P, P = Phi((a + Q/2 - mu)/sigma) - Phi((a - Q/2 - mu)/sigma).

Source: the PD-4DGS rate model. In float32 the plain difference of two Phi is wrong by 7 % above P = 1e-6 and 0 below,
so kernels compute ln P in float64, in one of three forms, chosen per element, with an explicit gradient.
With d = |a - mu|, z = d/sigma, h = Q/(2 sigma), u = (d - Q/2)/sigma, v = (d + Q/2)/sigma:

- narrow, h*max(z, 1) small: P = 2 h phi(z) (1 + h^2 He2(z)/6 + h^4 He4(z)/120 + h^6 He6(z)/5040)
- tail, u >= 0:              P = phi(u) sqrt(pi/2) (erfcx(u/sqrt 2) - exp(-2zh) erfcx(v/sqrt 2))
- centre, u < 0:             P = (erfc(u/sqrt 2) - erfc(v/sqrt 2)) / 2
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw.simd import Array, Tasks, kernel, parallel

#: Probabilities are clipped to this: no scalar costs more than log2(1e6) = 19.93 bits in training.
MIN_PROBABILITY = 1e-6
MAX_BITS = -math.log2(MIN_PROBABILITY)
#: sigma is kept at or above Q * MIN_SIGMA_RATIO.
MIN_SIGMA_RATIO = 2.0**-10
#: h max(z, 1) below which P has the narrow form.
NARROW = {torch.float64: 0.03, torch.float32: 0.2}
#: Added to a channel's variance, so that the gradient of its root is finite if all values are equal.
MIN_VARIANCE = 1e-20

_LN2 = math.log(2.0)
_HALF_LN_2PI = 0.5 * math.log(2.0 * math.pi)
_SQRT_HALF = math.sqrt(0.5)
_SQRT_HALF_PI = math.sqrt(0.5 * math.pi)
_INVERSE_SQRT_PI = 1.0 / math.sqrt(math.pi)
#: From here on erfcx is computed by its asymptotic series, to 4e-12; below by exp(x^2) erfc(x), to 1e-13.
_FAR = 20.0


@kernel(inline=True)
def _erfcx(x: float) -> float:
    """exp(x^2) erfc(x) for x >= 0."""
    if x < _FAR:
        return math.exp(x * x) * math.erfc(x)
    y = 0.5 / (x * x)
    return _INVERSE_SQRT_PI / x * (1.0 - y * (1.0 - 3.0 * y * (1.0 - 5.0 * y * (1.0 - 7.0 * y))))


@kernel(inline=True)
def _probability(z: float, h: float, u: float, v: float, narrow_below: float) -> tuple[float, float]:
    """Returns (ln P, phi(u) / P) by the forms above; narrow_below: h max(z, 1) below which P has the narrow form."""
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


# -- rows of anchors, in numba -----------------------------------------------------------------------------------------

# `classes` int8 [N] is the step class of each anchor, -1 if inactive. Values are [N, c] of one float type, computed in
# float64. Sums are kept per block of rows, so that results do not depend on the number of threads.

_BLOCK = 1024  #: rows


@parallel(lambda parts, *_: len(parts))
def _class_sums(tasks: Tasks, parts: Array, values: Array, classes: Array, centre: Array, power: int) -> None:
    """Adds to parts [blocks, K, c] the sum of each class's values or, with power 2, of their squared distances from
    centre [K, c]."""
    channels = values.shape[1]
    for block in range(tasks[0], tasks[1]):
        for i in range(block * _BLOCK, min(len(values), (block + 1) * _BLOCK)):
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
def scalar_bits(
    tasks: Tasks,
    bits: Array,
    by_value: Array,
    by_sigma: Array,
    values: Array,
    rows: Array,
    classes: Array,
    mu: Array,
    sigma: Array,
    step: float,
    least_sigma: float,
    most_bits: float,
    narrow_below: float,
) -> None:
    """Fills bits float64 [n], the sum of R over each of `rows` int64 [n], each R clipped to most_bits; by_value and
    by_sigma [n, c], the gradients of each scalar's unclipped R. sigma [K, c] is at least least_sigma steps."""
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
def _moments_gradient(
    tasks: Tasks, grad: Array, values: Array, classes: Array, by_mu: Array, mu: Array, by_square: Array
) -> None:
    """Fills grad [N, c] = by_mu + (values - mu) by_square of each row's class, 0 for inactive rows. by_mu, mu,
    by_square: [K, c] of the type of `values`."""
    for i in range(tasks[0], tasks[1]):
        k = classes[i]
        for j in range(values.shape[1]):
            grad[i, j] = by_mu[k, j] + (values[i, j] - mu[k, j]) * by_square[k, j] if k >= 0 else 0.0


class _RowBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, classes: Tensor, rows: Tensor, steps: Sequence[float], *parts: Tensor) -> Tensor:
        of, picked, total = classes.numpy(), rows.numpy(), np.zeros(len(rows))
        counts = np.bincount(of[of >= 0], minlength=1)
        each, bits = np.maximum(counts, 1)[:, None], np.empty_like(total)
        ctx.moments = []
        for values, step in zip(parts, steps, strict=True):
            x = values.numpy()
            mu = _sums(x, of, np.zeros((len(counts), x.shape[1])), 1) / each
            sigma = np.sqrt(_sums(x, of, mu, 2) / each + MIN_VARIANCE)
            by_value, by_sigma = (np.empty((len(picked), x.shape[1])) for _ in range(2))
            limits = MIN_SIGMA_RATIO, MAX_BITS, NARROW[values.dtype]
            scalar_bits(bits, by_value, by_sigma, x, picked, of, mu, sigma, step, *limits)
            total += bits
            ctx.moments.append((mu, sigma, by_value, by_sigma))
        ctx.each = each
        ctx.save_for_backward(classes, rows, *parts)
        return torch.from_numpy(total).to(parts[0].dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        classes, rows, *parts = ctx.saved_tensors
        of, picked, weight = classes.numpy(), rows.numpy(), grad.numpy().astype(np.float64)[:, None]
        of_rows = of[picked] == np.arange(len(ctx.each))[:, None]  # [K, n]
        gradients = []
        for values, (mu, sigma, by_value, by_sigma) in zip(parts, ctx.moments, strict=True):
            x = values.detach().numpy()
            slope = weight * by_value
            by_mu = -(of_rows @ slope) / ctx.each
            by_square = of_rows @ (weight * by_sigma) / (ctx.each * sigma)
            found = np.empty_like(x)
            _moments_gradient(found, x, of, *(a.astype(x.dtype) for a in (by_mu, mu, by_square)))
            found[picked] += slope.astype(x.dtype)
            gradients.append(torch.from_numpy(found))
        return None, None, None, *gradients


def _sums(values: Array, classes: Array, centre: Array, power: int) -> Array:
    """Returns the sums of `_class_sums`, float64 [K, c]."""
    parts = np.zeros((-(-len(values) // _BLOCK), *centre.shape))
    _class_sums(parts, values, classes, centre, power)
    total: Array = parts.sum(0)
    return total


def row_bits(parts: Sequence[tuple[Tensor, float]], classes: Tensor, rows: Tensor) -> Tensor:
    """Returns [n], differentiable: R summed over each of `rows` (int64 [n], active, none twice) of all parts.

    All on the CPU. parts: values [N, c] and their step. classes: int8 [N], the step class of each active row, -1 of
    others. A scalar's step is step * 2^class. Its prior has the mean and standard deviation of its column over the
    class's active rows.
    """
    values, steps = zip(*parts, strict=True)
    bits: Tensor = _RowBits.apply(classes, rows, steps, *values)  # type: ignore[no-untyped-call]
    return bits
