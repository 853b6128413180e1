"""Stability of R(a): values and gradients against mpmath over sixteen decades of sigma / Q."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache, partial

import torch
from torch import Tensor

from pd4dgs_codec.bench.stability.rows import Case, mpmath
from pd4dgs_codec.model import rate

GROUP = "rate"
BANDS = ((-8, -6), (-5, -3), (-2, 2), (3, 5), (6, 8))  #: decades of sigma / Q, both ends included
#: |a - mu| / sigma, and |a - mu| / Q: the edge of the interval is where one of the two tails vanishes.
IN_SIGMAS = (0.0, 1e-6, 1.0, *(10 ** (i / 4) for i in range(-8, 25)))
IN_STEPS = (0.49, 0.499999, 0.5, 0.500001, 0.51, 1.0, 40.0)
FARTHEST = 1e6  #: sigmas
PLACES = ((0.0, 0.125), (-1.5, 0.7))  #: (mu, Q)
BOUNDS = {torch.float64: 1e-9, torch.float32: 1e-4}
NAMES = {torch.float64: "float64", torch.float32: "float32"}
SMALLEST = {torch.float64: -math.inf, torch.float32: math.log(1e-30)}  #: ln P from which the value's bound holds
LN_CLIP = math.log(rate.MIN_PROBABILITY)


def cases() -> Iterator[Case]:
    """Values and gradients per band and precision, then the clip, what lies beyond it, and channels without spread."""
    for dtype, bound in BOUNDS.items():
        where = "" if dtype == torch.float64 else " where P >= 1e-30"
        for low, high in BANDS:
            ratios = [10.0**e for e in range(low, high + 1)]
            name = f"sigma/Q 1e{low}..1e{high}, {NAMES[dtype]}"
            fed = f"sigma/Q 1e{low}..1e{high}, |a - mu|/sigma up to 1e6 and around Q/2"
            yield Case(
                GROUP, f"ln P, {name}", fed, f"|d ln P| <= {bound:g} max(1, |ln P|){where}", bound,
                partial(_value, dtype, ratios),
            )  # fmt: skip
            promised = f"slopes times sigma (Q for that in Q) within {bound:g} max(1, |slope|){where}"
            yield Case(GROUP, f"gradients, {name}", fed, promised, bound, partial(_gradients, dtype, ratios))
        everywhere = [10.0**e for e in range(-8, 9)]
        fed = "sigma/Q 1e-8..1e8, |a - mu|/sigma up to 1e6"
        yield Case(
            GROUP, f"finite, {NAMES[dtype]}", fed, "ln P, bits and all gradients finite", 0.0,
            partial(_not_finite, dtype, everywhere),
        )  # fmt: skip
        yield Case(
            GROUP, f"clipped bits, {NAMES[dtype]}", fed,
            f"within {bound:g} max(1, R ln 2) of min(R, 19.93), sigma at least Q/1024", bound,
            partial(_clipped, dtype, everywhere),
        )  # fmt: skip
        yield Case(
            GROUP, f"gradient beyond the clip, {NAMES[dtype]}", fed + ", P < 1e-6",
            f"the slope of the unclipped R, within {bound:g} of itself and towards mu", bound,
            partial(_slope_beyond_the_clip, dtype, everywhere),
        )  # fmt: skip
    yield Case(
        GROUP, "a channel without spread", "1,000 equal values, their own moments, float32",
        "0 bits within 1e-6, finite gradients", 1e-6, _without_spread,
    )  # fmt: skip


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
        return (
            float(mp.log(p)),
            float(mp.sign(a - mu) * (phi_v - phi_u) / p),
            float((u * phi_u - v * phi_v) / p),
            float((phi_u + phi_v) * q / (2 * sigma * p)),
        )


def _relative(found: Tensor, expected: Tensor) -> Tensor:
    return (found.detach().double() - expected).abs() / expected.abs().clamp(min=1.0)


class _Worst:
    """The largest error met, and where; a NaN is larger than all."""

    def __init__(self) -> None:
        self.error, self.where, self.met = 0.0, "nowhere", 0

    def meet(self, errors: Tensor, inputs: list[Tensor], ratio: float) -> None:
        self.met += len(errors)
        if not len(errors):
            return
        index = int(torch.nan_to_num(errors, nan=math.inf).argmax())
        if not float(errors[index]) <= self.error:
            a, mu, sigma, _ = (float(x[index].detach()) for x in inputs)
            self.error = float(errors[index])
            self.where = f"sigma/Q {ratio:.0e}, |a - mu|/sigma {abs(a - mu) / sigma:.3g}"

    def outcome(self) -> tuple[str, float]:
        return f"{self.met} points, worst at {self.where}", self.error if self.met else math.nan


def _value(dtype: torch.dtype, ratios: list[float]) -> tuple[str, float]:
    worst = _Worst()
    for ratio in ratios:
        inputs, expected = _inputs(dtype, ratio), _reference(dtype, ratio, False)[:, 0]
        errors = _relative(rate.log_probability(*inputs), expected)
        held = expected >= SMALLEST[dtype]
        worst.meet(errors[held], [x[held] for x in inputs], ratio)
    return worst.outcome()


def _gradients(dtype: torch.dtype, ratios: list[float]) -> tuple[str, float]:
    worst = _Worst()
    for ratio in ratios:
        inputs, reference = _inputs(dtype, ratio), _reference(dtype, ratio, False)
        a, mu, sigma, q = inputs
        da, dmu, dsigma, dq = (
            g.double() for g in torch.autograd.grad(rate.log_probability(*inputs).sum(), (a, mu, sigma, q))
        )
        units = sigma.detach().double()
        found = torch.stack([da * units, dsigma * units, dq * q.detach().double(), -dmu * units])
        errors = _relative(found, reference[:, [1, 2, 3, 1]].T).nan_to_num(nan=math.inf).amax(0)
        held = reference[:, 0] >= SMALLEST[dtype]
        worst.meet(errors[held], [x[held] for x in inputs], ratio)
    return worst.outcome()


def _not_finite(dtype: torch.dtype, ratios: list[float]) -> tuple[str, float]:
    numbers = 0
    bad = 0
    for ratio in ratios:
        for function in (rate.log_probability, rate.rate_bits):
            inputs = _inputs(dtype, ratio)
            value = function(*inputs)
            for tensor in (value, *torch.autograd.grad(value.sum(), inputs)):
                numbers += tensor.numel()
                bad += int((~torch.isfinite(tensor)).sum())
    return f"{bad} of {numbers} numbers not finite", float(bad)


def _clipped(dtype: torch.dtype, ratios: list[float]) -> tuple[str, float]:
    worst = _Worst()
    for ratio in ratios:
        inputs = _inputs(dtype, ratio)
        expected = _reference(dtype, ratio, True)[:, 0].clamp(min=LN_CLIP)
        worst.meet(_relative(rate.rate_bits(*inputs) * -math.log(2.0), expected), inputs, ratio)
    return worst.outcome()


def _slope_beyond_the_clip(dtype: torch.dtype, ratios: list[float]) -> tuple[str, float]:
    worst = _Worst()
    for ratio in ratios:
        inputs, reference = _inputs(dtype, ratio), _reference(dtype, ratio, True)
        beyond = reference[:, 0] < LN_CLIP
        a, _, sigma, q = inputs
        (slope,) = torch.autograd.grad(rate.rate_bits(*inputs).sum(), a)
        unit = torch.maximum(sigma, q * rate.MIN_SIGMA_RATIO).detach().double()
        expected = -reference[:, 1] / math.log(2.0)  # of bits, per sigma; a wrong sign is an error of 2
        errors = (slope.double() * unit - expected).abs() / expected.abs().clamp(min=1e-300)  # at mu the slope is 0
        worst.meet(errors[beyond], [x[beyond] for x in inputs], ratio)
    return worst.outcome()


def _without_spread() -> tuple[str, float]:
    x = torch.full((1000, 1), 3.7, requires_grad=True)
    bits = rate.rate_bits(x, *rate.channel_moments(x), 0.125).sum()
    bits.backward()
    assert x.grad is not None
    finite = bool(torch.isfinite(x.grad).all())
    return f"{float(bits.detach()):.3g} bits, gradients {'finite' if finite else 'not finite'}", (
        abs(float(bits.detach())) if finite else math.nan
    )
