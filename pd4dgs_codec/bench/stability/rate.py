"""Stability of R(a): values and gradients against mpmath over sixteen decades of sigma / Q."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache, partial

import torch
from torch import Tensor

from pd4dgs_codec.bench.stability.cases import Case, Found, mpmath
from pd4dgs_codec.model import rate

BANDS = ((-8, -6), (-5, -3), (-2, 2), (3, 5), (6, 8))  #: decades of sigma / Q, both ends included
#: |a - mu| / sigma, and |a - mu| / Q: the edge of the interval is where one of the two tails vanishes.
IN_SIGMAS = (0.0, 1e-6, 1.0, *(10 ** (i / 4) for i in range(-8, 25)))
IN_STEPS = (0.49, 0.499999, 0.5, 0.500001, 0.51, 1.0, 40.0)
FARTHEST = 1e6  #: sigmas
PLACES = ((0.0, 0.125), (-1.5, 0.7))  #: (mu, Q)
#: Per type: name, bound, ln P from which the bound holds, and that in words.
TYPES = {
    torch.float64: ("float64", 1e-9, -math.inf, ""),
    torch.float32: ("float32", 1e-4, math.log(1e-30), " where P >= 1e-30"),
}
LN_CLIP = math.log(rate.MIN_PROBABILITY)
#: (inputs a, mu, sigma, Q, reference) -> (error per point, whether the point counts).
Errors = Callable[[list[Tensor], Tensor], tuple[Tensor, Tensor]]


def cases() -> Iterator[Case]:
    """Values and gradients per band and precision, then the clip, what lies beyond it, and channels without spread."""
    row = partial(Case, "rate")
    everywhere, fed = _decades(-8, 8), "sigma/Q 1e-8..1e8, |a - mu|/sigma up to 1e6"
    for dtype, (name, bound, _, where) in TYPES.items():
        value, slope = f"|d ln P| <= {bound:g} max(1, |ln P|){where}", f"{bound:g} max(1, |slope|){where}"
        for low, high in BANDS:
            band, ratios = f"sigma/Q 1e{low}..1e{high}", _decades(low, high)
            here = f"{band}, |a - mu|/sigma up to 1e6 and around Q/2"
            yield row(f"ln P, {band}, {name}", here, value, bound, partial(_worst, _value, dtype, ratios))
            promised = f"slopes times sigma (Q for that in Q) within {slope}"
            measure = partial(_worst, _gradients, dtype, ratios)
            yield row(f"gradients, {band}, {name}", here, promised, bound, measure)
        finite = "ln P, bits and all gradients finite"
        yield row(f"finite, {name}", fed, finite, 0.0, partial(_not_finite, dtype, everywhere))
        clipped = f"within {bound:g} max(1, R ln 2) of min(R, 19.93), sigma at least Q/1024"
        measure = partial(_worst, _clipped, dtype, everywhere, floored=True)
        yield row(f"clipped bits, {name}", fed, clipped, bound, measure)
        beyond = f"the slope of the unclipped R, within {bound:g} of itself and towards mu"
        measure = partial(_worst, _slope_beyond_the_clip, dtype, everywhere, floored=True)
        yield row(f"gradient beyond the clip, {name}", fed + ", P < 1e-6", beyond, bound, measure)
    equal, promised = "1,000 equal values, their own moments, float32", "0 bits within 1e-6, finite gradients"
    yield row("a channel without spread", equal, promised, 1e-6, _without_spread)


def _decades(low: int, high: int) -> list[float]:
    return [10.0**e for e in range(low, high + 1)]


def _inputs(dtype: torch.dtype, ratio: float) -> list[Tensor]:
    """(a, mu, sigma, Q), each [n], leaves."""
    rows = []
    for mu, q in PLACES:
        sigma = ratio * q
        distances = [z * sigma for z in IN_SIGMAS] + [d * q for d in IN_STEPS if d <= FARTHEST * ratio]
        rows += [(mu + sign * d, mu, sigma, q) for d in distances for sign in (1, -1)]
    columns = torch.tensor(rows, dtype=torch.float64).T.to(dtype)
    return [column.clone().requires_grad_() for column in columns]


@cache
def _reference(dtype: torch.dtype, ratio: float, floored: bool) -> Tensor:
    """float64 [n, 4] at the inputs exactly as stored: ln P, sigma dlnP/da, sigma dlnP/dsigma, Q dlnP/dQ.

    floored: with sigma as `rate_bits` keeps it, at least Q MIN_SIGMA_RATIO.
    """
    rows = torch.stack([x.detach().double() for x in _inputs(dtype, ratio)], 1).tolist()
    if floored:
        rows = [(a, mu, max(sigma, q * rate.MIN_SIGMA_RATIO), q) for a, mu, sigma, q in rows]
    return torch.tensor([_exact(*row) for row in rows], dtype=torch.float64)


def _exact(*stored: float) -> tuple[float, float, float, float]:
    mp = mpmath()
    with mp.workdps(60):
        a, mu, sigma, q = (mp.mpf(x) for x in stored)
        d = abs(a - mu)
        u, v = (d - q / 2) / sigma, (d + q / 2) / sigma
        p = (mp.erfc(u / mp.sqrt(2)) - mp.erfc(v / mp.sqrt(2))) / 2
        phi_u, phi_v = mp.npdf(u), mp.npdf(v)
        of_a, of_sigma = mp.sign(a - mu) * (phi_v - phi_u) / p, (u * phi_u - v * phi_v) / p
        return float(mp.log(p)), float(of_a), float(of_sigma), float((phi_u + phi_v) * q / (2 * sigma * p))


def _worst(errors: Errors, dtype: torch.dtype, ratios: list[float], floored: bool = False) -> Found:
    """The largest error over the decades, infinite for NaN, and where it is."""
    worst, place, met = 0.0, "nowhere", 0
    for ratio in ratios:
        inputs = _inputs(dtype, ratio)
        found, held = errors(inputs, _reference(dtype, ratio, floored))
        found = torch.where(held, found.nan_to_num(nan=math.inf), -1.0)
        index, met = int(found.argmax()), met + int(held.sum())
        if float(found[index]) > worst:
            a, mu, sigma, _ = (float(x[index].detach()) for x in inputs)
            worst = float(found[index])
            place = f"sigma/Q {ratio:.0e}, |a - mu|/sigma {abs(a - mu) / sigma:.3g}"
    return f"{met} points, worst at {place}", worst if met else math.nan


def _relative(found: Tensor, expected: Tensor) -> Tensor:
    return (found.detach().double() - expected).abs() / expected.abs().clamp(min=1.0)


def _value(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    expected = reference[:, 0]
    return _relative(rate.log_probability(*inputs), expected), expected >= TYPES[inputs[0].dtype][2]


def _gradients(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    slopes = torch.autograd.grad(rate.log_probability(*inputs).sum(), inputs)
    da, dmu, dsigma, dq = (slope.double() for slope in slopes)
    sigma, q = (x.detach().double() for x in inputs[2:])
    found = torch.stack([da * sigma, dsigma * sigma, dq * q, -dmu * sigma])
    errors = _relative(found, reference[:, [1, 2, 3, 1]].T).nan_to_num(nan=math.inf).amax(0)
    return errors, reference[:, 0] >= TYPES[inputs[0].dtype][2]


def _clipped(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    expected = reference[:, 0].clamp(min=LN_CLIP)
    return _relative(rate.rate_bits(*inputs) * -math.log(2.0), expected), torch.ones_like(expected, dtype=torch.bool)


def _slope_beyond_the_clip(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    a, _, sigma, q = inputs
    (slope,) = torch.autograd.grad(rate.rate_bits(*inputs).sum(), a)
    unit = torch.maximum(sigma, q * rate.MIN_SIGMA_RATIO).detach().double()
    expected = -reference[:, 1] / math.log(2.0)  # of bits, per sigma; a wrong sign is an error of 2
    errors = (slope.double() * unit - expected).abs() / expected.abs().clamp(min=1e-300)  # at mu the slope is 0
    return errors, reference[:, 0] < LN_CLIP


def _not_finite(dtype: torch.dtype, ratios: list[float]) -> Found:
    numbers = bad = 0
    for ratio in ratios:
        for function in (rate.log_probability, rate.rate_bits):
            inputs = _inputs(dtype, ratio)
            value = function(*inputs)
            for tensor in (value, *torch.autograd.grad(value.sum(), inputs)):
                numbers += tensor.numel()
                bad += int((~torch.isfinite(tensor)).sum())
    return f"{bad} of {numbers} numbers not finite", float(bad)


def _without_spread() -> Found:
    x = torch.full((1000, 1), 3.7, requires_grad=True)
    bits = rate.rate_bits(x, *rate.channel_moments(x), 0.125).sum()
    (slope,) = torch.autograd.grad(bits, x)
    finite = bool(torch.isfinite(slope).all())
    said = f"{float(bits.detach()):.3g} bits, gradients {'finite' if finite else 'not finite'}"
    return said, abs(float(bits.detach())) if finite else math.nan
