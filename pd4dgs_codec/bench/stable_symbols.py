"""Stability of numbers and their codes: the rate R(a), priors, quantisers and masks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.bench.stability import Case, Found, largest, mpmath, refusal, small_scene
from pd4dgs_codec.entropy import channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import decoder, encoder
from pd4dgs_codec.format import quantise as q
from pd4dgs_codec.model import networks, rate
from pd4dgs_codec.scene import MASK_THRESHOLD


def cases() -> Iterator[Case]:
    """Groups rate, fitting, quantiser and masks."""
    yield from _rate()
    yield from _fitting()
    yield from _quantiser()
    yield from _masks()


# -- rate: values and gradients against mpmath over sixteen decades of sigma / Q ---------------------------------------

BANDS = ((-8, -6), (-5, -3), (-2, 2), (3, 5), (6, 8))  #: decades of sigma / Q, both ends included
#: |a - mu| / sigma, and |a - mu| / Q around the edge of the interval, where one of the two tails vanishes.
IN_SIGMAS = (0.0, 1e-6, 1.0, *(10 ** (i / 4) for i in range(-8, 25)))
IN_STEPS = (0.49, 0.499999, 0.5, 0.500001, 0.51, 1.0, 40.0)
FARTHEST = 1e6  #: sigmas
PLACES = ((0.0, 0.125), (-1.5, 0.7))  #: (mu, Q)
#: Per type: name, bound, and the ln P from which the bound holds.
TYPES = {
    torch.float64: ("float64", 1e-9, -math.inf),
    torch.float32: ("float32", 1e-4, math.log(1e-30)),
}
LN_CLIP = math.log(rate.MIN_PROBABILITY)
#: (inputs a, mu, sigma, Q, reference) -> (error per point, whether the point counts).
Errors = Callable[[list[Tensor], Tensor], tuple[Tensor, Tensor]]


def _rate() -> Iterator[Case]:
    row, everywhere = partial(Case, "rate"), _decades(-8, 8)
    fed = "sigma/Q 1e-8..1e8, |a - mu|/sigma up to 1e6"
    for dtype, (name, bound, least) in TYPES.items():
        where = " where P >= 1e-30" if least > -math.inf else ""
        for low, high in BANDS:
            band, ratios = f"sigma/Q 1e{low}..1e{high}", _decades(low, high)
            value, slope = f"|d ln P| <= {bound:g} max(1, |ln P|){where}", f"within {bound:g} max(1, |slope|){where}"
            yield row(f"ln P, {band}, {name}", band, value, bound, partial(_worst, _value, dtype, ratios))
            yield row(f"gradients, {band}, {name}", band, slope, bound, partial(_worst, _gradients, dtype, ratios))
        yield row(f"finite, {name}", fed, "value and gradients finite", 0.0, partial(_not_finite, dtype, everywhere))
        clipped = f"within {bound:g} max(1, R ln 2) of min(R, 19.93), sigma at least Q/1024"
        measure = partial(_worst, _clipped, dtype, everywhere, floored=True)
        yield row(f"clipped bits, {name}", fed, clipped, bound, measure)
        beyond = f"the slope of the unclipped R, within {bound:g} of itself and towards mu"
        measure = partial(_worst, _slope_beyond_the_clip, dtype, everywhere, floored=True)
        yield row(f"gradient beyond the clip, {name}", f"{fed}, P < 1e-6", beyond, bound, measure)
    equal, promised = "1,000 equal values, their own moments, float32", "0 bits within 1e-6, finite gradients"
    yield row("a channel without spread", equal, promised, 1e-6, _without_spread)


def _decades(low: int, high: int) -> list[float]:
    return [10.0**e for e in range(low, high + 1)]


def _inputs(dtype: torch.dtype, ratio: float) -> list[Tensor]:
    """(a, mu, sigma, Q), each [n], leaves."""
    rows = []
    for mu, step in PLACES:
        sigma = ratio * step
        distances = [z * sigma for z in IN_SIGMAS] + [d * step for d in IN_STEPS if d <= FARTHEST * ratio]
        rows += [(mu + sign * d, mu, sigma, step) for d in distances for sign in (1, -1)]
    columns = torch.tensor(rows, dtype=torch.float64).T.to(dtype)
    return [column.clone().requires_grad_() for column in columns]


@cache
def _reference(dtype: torch.dtype, ratio: float, floored: bool) -> Tensor:
    """float64 [n, 4] at the inputs exactly as stored: ln P, sigma dlnP/da, sigma dlnP/dsigma, Q dlnP/dQ.

    floored: with the sigma of `rate_bits`, at least Q MIN_SIGMA_RATIO.
    """
    rows = torch.stack([x.detach().double() for x in _inputs(dtype, ratio)], 1).tolist()
    if floored:
        rows = [(a, mu, max(sigma, step * rate.MIN_SIGMA_RATIO), step) for a, mu, sigma, step in rows]
    return torch.tensor([_exact(*row) for row in rows], dtype=torch.float64)


def _exact(*stored: float) -> tuple[float, float, float, float]:
    mp = mpmath()
    with mp.workdps(60):
        a, mu, sigma, step = (mp.mpf(x) for x in stored)
        d = abs(a - mu)
        u, v = (d - step / 2) / sigma, (d + step / 2) / sigma
        p = (mp.erfc(u / mp.sqrt(2)) - mp.erfc(v / mp.sqrt(2))) / 2
        phi_u, phi_v = mp.npdf(u), mp.npdf(v)
        of_a, of_sigma = mp.sign(a - mu) * (phi_v - phi_u) / p, (u * phi_u - v * phi_v) / p
        return float(mp.log(p)), float(of_a), float(of_sigma), float((phi_u + phi_v) * step / (2 * sigma * p))


def _worst(errors: Errors, dtype: torch.dtype, ratios: list[float], floored: bool = False) -> Found:
    """The largest error over the decades and its place; infinite for NaN."""
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
    sigma, step = (x.detach().double() for x in inputs[2:])
    found = torch.stack([da * sigma, dsigma * sigma, dq * step, -dmu * sigma])
    errors = _relative(found, reference[:, [1, 2, 3, 1]].T).nan_to_num(nan=math.inf).amax(0)
    return errors, reference[:, 0] >= TYPES[inputs[0].dtype][2]


def _clipped(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    expected = reference[:, 0].clamp(min=LN_CLIP)
    return _relative(rate.rate_bits(*inputs) * -math.log(2.0), expected), torch.ones_like(expected, dtype=torch.bool)


def _slope_beyond_the_clip(inputs: list[Tensor], reference: Tensor) -> tuple[Tensor, Tensor]:
    a, _, sigma, step = inputs
    (slope,) = torch.autograd.grad(rate.rate_bits(*inputs).sum(), a)
    unit = torch.maximum(sigma, step * rate.MIN_SIGMA_RATIO).detach().double()
    expected = -reference[:, 1] / math.log(2.0)  # of bits, per sigma; a wrong sign is an error of 2
    errors = (slope.double() * unit - expected).abs() / expected.abs().clamp(min=1e-300)  # at mu the slope is 0
    return errors, reference[:, 0] < LN_CLIP


def _not_finite(dtype: torch.dtype, ratios: list[float]) -> Found:
    tensors = []
    for ratio, function in itertools.product(ratios, (rate.log_probability, rate.rate_bits)):
        inputs = _inputs(dtype, ratio)
        value = function(*inputs)
        tensors += [value, *torch.autograd.grad(value.sum(), inputs)]
    numbers = torch.cat(tensors)
    bad = int((~torch.isfinite(numbers)).sum())
    return f"{bad} of {numbers.numel()} numbers not finite", float(bad)


def _without_spread() -> Found:
    x = torch.full((1000, 1), 3.7, requires_grad=True)
    total = rate.rate_bits(x, *rate.channel_moments(x), 0.125).sum()
    (slope,) = torch.autograd.grad(total, x)
    finite = bool(torch.isfinite(slope).all())
    said = f"{float(total.detach()):.3g} bits, gradients {'finite' if finite else 'not finite'}"
    return said, abs(float(total.detach())) if finite else math.nan


# -- fitting: channels that no distribution describes ------------------------------------------------------------------

SETTINGS = (("best", 1), ("best", 5), ("gauss", 5))  #: (priors, effort)
#: The size of a channel may be this multiple of its plain binary form, and OVERHEAD bits more.
SLACK, OVERHEAD = 1.01, 256


def _channels() -> dict[str, tuple[str, np.ndarray]]:
    """Case -> (description, int32 symbols)."""
    rng = np.random.default_rng(0)
    rare = np.zeros(10_000, np.int64)
    rare[4321] = -K_MAX
    tails = np.clip(np.rint(rng.standard_cauchy(20_000) * 3), -K_MAX, K_MAX)
    peaks = np.concatenate([rng.normal(-1e6, 2, 5000), rng.normal(1e6, 2, 5000)])
    data = {
        "constant": ("5,000 times 7", np.full(5000, 7)),
        "constant at the limit": ("5,000 times 2^24 - 1", np.full(5000, K_MAX)),
        "all zero, long": ("2^20 zeros", np.zeros(1 << 20)),
        "two values, far apart": ("5,000 of +-(2^24 - 1)", rng.choice([-K_MAX, K_MAX], 5000)),
        "one rare outlier": ("9,999 zeros and one -(2^24 - 1)", rare),
        "the whole range": ("2,000 uniform in +-(2^24 - 1)", rng.integers(-K_MAX, K_MAX + 1, 2000)),
        "heavy tails": ("20,000 of a Cauchy distribution", tails),
        "two distant peaks": ("10,000 of two Gaussians at +-1e6", np.rint(peaks)),
        "two symbols": ("0 and 2^24 - 1", np.array([0, K_MAX])),
        "empty": ("no symbols", np.zeros(0)),
    }
    return {name: (fed, values.astype(np.int32)) for name, (fed, values) in data.items()}


def _fitting() -> Iterator[Case]:
    row, data = partial(Case, "fitting"), _channels()
    lossless = "every symbol decoded, with any priors and effort"
    small = f"at most {SLACK} of plain binary over its range, and {OVERHEAD} bits"
    for name, (fed, symbols) in data.items():
        yield row(f"lossless: {name}", fed, lossless, 0.0, partial(_lost_symbols, [symbols]))
        yield row(f"size: {name}", fed, small, SLACK, partial(_against_plain_binary, symbols))
    together = partial(_lost_symbols, [symbols for _, symbols in data.values()])
    yield row("lossless: all of these in one payload", "the channels above, side by side", lossless, 0.0, together)
    for value in (2**31 - 1, -(2**31)):
        act = partial(channels.encode_channels, [np.array([0, value], np.int32)])
        fed = "an int32 extreme; the limit is 2^24 - 1"
        yield refusal("fitting", f"beyond the limit: {value}", fed, EncodeError, act)


def _lost_symbols(arrays: list[np.ndarray]) -> Found:
    wrong, sizes = 0, []
    for priors, effort in SETTINGS:
        coded = channels.encode_channels(arrays, priors=priors, effort=effort)
        decoded = channels.decode_channels(coded.payload, [a.size for a in arrays])
        wrong += sum(int((a != b).sum()) for a, b in zip(arrays, decoded, strict=True))
        sizes.append(len(coded.payload))
    return f"{wrong} wrong symbols, {' / '.join(f'{s:,}' for s in sizes)} bytes", float(wrong)


def _against_plain_binary(symbols: np.ndarray) -> Found:
    coded = channels.encode_channels([symbols]).payload_bits
    spread = int(symbols.max()) - int(symbols.min()) if symbols.size else 0
    plain = symbols.size * math.log2(spread + 1)
    return f"{coded:,} bits, plain binary {plain:,.0f}", max(coded - OVERHEAD, 0) / max(plain, 1.0)


# -- quantiser: |x - x_hat| <= Q/2 and one float32 rounding, from the smallest step to the largest ---------------------

TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
SUBNORMAL, NEAR = float(np.float32(1e-45)), float(np.float32(3.3e38))
TOP = round(Fraction(NEAR) / Fraction(2.0**106))
#: (case, values, step, their symbols, promised)
SYMBOLS: tuple[tuple[str, list[float], float, list[int], str], ...] = (
    ("halves", [0.5, 1.5, 2.5, -0.5, -1.5, 8388606.5, 4194303.5], 1.0, [0, 2, 2, 0, -2, 8388606, 4194304],
     "ties go to even"),
    ("negative zero", [-0.0, -1e-30], 0.5, [0, 0], "symbol 0, value +0"),
    ("subnormal values", [1e-45, -1e-39, 1e-38], float(np.float32(1e-12)), [0, 0, 0], "symbol 0"),
    ("subnormal values at the smallest step", [TINY / 2, TINY * 0.75, -TINY, SUBNORMAL], TINY, [0, 1, -1, 0],
     "ties to even, x_hat kept"),
    ("values near the float limit", [NEAR, -NEAR], 2.0**106, [TOP, -TOP], "nearest symbol, x_hat finite"),
)  # fmt: skip
#: (value, step, description)
REFUSED_VALUES = (
    (math.nan, 1.0, "NaN among the values"),
    (math.inf, 1.0, "an infinity among the values"),
    (float(2**23 + 1), 1.0, "a value of 2^23 + 1 steps; the limit is 2^23"),
    (HUGE, 2.0**106, "the largest float32, which would be decoded as an infinity"),
)
#: (factor on all steps of a scene, reason of the refusal)
REFUSED_SCALES = (
    (1e-6, "weights of more than 2^23 steps; the limit is 2^23"),
    (1e-38, "steps below binary32's normal range"),
    (1e40, "steps above binary32's range"),
)


def _quantiser() -> Iterator[Case]:
    row, refuse = partial(Case, "quantiser"), partial(refusal, "quantiser")
    fed = "4,000 values up to 2^23 steps, at halves of a step and around them"
    close = "|x - x_hat| <= Q/2 + half a float32 unit, exactly"
    again = "quantising dequantised symbols returns them"
    for step in (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, TINY, 2.0**104):
        Q = float(np.float32(step))
        yield row(f"step {step:.3g}", fed, close, 1.0, partial(_error_in_bounds, Q))
        yield row(f"again at step {step:.3g}", "symbols 0, +-1 .. +-2^23", again, 0.0, partial(_changed, Q))
    for name, values, step, expected, promised in SYMBOLS:
        fed = f"{', '.join(f'{v:.9g}' for v in values)} at step {step:.3g}"
        yield row(name, fed, promised, 0.0, partial(_wrong_symbols, values, step, expected))
    for step in (0.0, -0.5, math.nan, math.inf, SUBNORMAL, 0.1):
        act = partial(q.quantise, np.zeros(3, np.float32), step, "feature")
        yield refuse(f"step {step:.3g}", "a step that is no positive normal binary32", EncodeError, act)
    for value, step, fed in REFUSED_VALUES:
        act = partial(q.quantise, np.array([0.0, value], np.float32), step, "feature")
        yield refuse(f"value {value:.3g} at step {step:.3g}", fed, EncodeError, act)
    fed, promised = "a scene of 40 anchors, encoded and decoded", "every attribute within Q/2 and half a float32 unit"
    for scale in (1e-3, 1.0, 1e6, 1e30):
        measure = partial(_file_error_in_bounds, scale)
        yield row(f"a whole file at steps times {scale:.0e}", fed, promised, 1.0, measure)
    for scale, fed in REFUSED_SCALES:
        encode = partial(encoder.encode, small_scene(), step_scale=scale)
        yield refuse(f"a whole file at steps times {scale:.0e}", fed, EncodeError, encode)
    for value, name in ((math.nan, "NaN"), (math.inf, "infinity")):
        fed = f"one {name} among the offsets of a scene"
        yield refuse(f"{name} in a scene", fed, EncodeError, partial(_encode_with, value))


def _wrong_symbols(values: list[float], step: float, expected: list[int]) -> Found:
    k = q.quantise(np.array(values, np.float32), step)
    restored = q.dequantise(k, step)
    wrong = int((k != np.array(expected)).sum()) + int((~np.isfinite(restored)).sum())
    wrong += int((np.signbit(restored) & (k >= 0)).sum())
    return f"symbols {k.tolist()}", float(wrong)


def _in_bounds(x: np.ndarray, restored: np.ndarray, step: float) -> float:
    """The largest |x - x_hat| / (Q/2 + half a unit in the last place of x_hat), in rationals."""
    worst = Fraction(0)
    units = np.spacing(np.abs(restored))
    for value, back, unit in zip(x.ravel().tolist(), restored.ravel().tolist(), units.ravel().tolist(), strict=True):
        worst = max(worst, abs(Fraction(value) - Fraction(back)) / ((Fraction(step) + Fraction(unit)) / 2))
    return float(worst)


def _error_in_bounds(step: float) -> Found:
    rng = np.random.default_rng(0)
    k = np.rint(rng.choice([-1, 1], 1000) * 2.0 ** rng.uniform(0, 23, 1000))
    positions = np.concatenate([k, k + 0.5, k + 0.49999997, k + rng.uniform(-0.5, 0.5, 1000)])
    x = (np.clip(positions, -q.MAX_SYMBOL, q.MAX_SYMBOL) * step).astype(np.float32)
    error = _in_bounds(x, q.dequantise(q.quantise(x, step), step), step)
    return f"at most {error:.6f} of the bound", error


def _changed(step: float) -> Found:
    powers = 2 ** np.arange(24)
    k = np.concatenate([[0], powers, -powers, powers - 1, 1 - powers]).astype(np.int32)
    wrong = int((q.quantise(q.dequantise(k, step), step) != k).sum())
    return f"{wrong} of {k.size} symbols changed", float(wrong)


def _file_error_in_bounds(scale: float) -> Found:
    scene = small_scene()
    decoded = decoder.decode(encoder.encode(scene, step_scale=scale, effort=1, omit="nothing"))
    order, back = np.lexsort(scene.anchor_q.T), np.lexsort(decoded.anchor_q.T)
    errors = {
        name: _in_bounds(getattr(scene, name)[order], getattr(decoded, name)[back], getattr(decoded.steps, name))
        for name in ("feature", "scaling_log", "offset")
    }
    return ", ".join(f"{name} {error:.4f}" for name, error in errors.items()) + " of the bound", max(errors.values())


def _encode_with(value: float) -> bytes:
    scene = small_scene()
    offset = scene.offset.copy()
    offset[3, 2, 1] = value
    return encoder.encode(replace(scene, offset=offset))


# -- masks -------------------------------------------------------------------------------------------------------------

LOGITS = (-100.0, -10.0, -4.59512, 0.0, 4.0, 10.0, 100.0)
FAR = (-1e4, *LOGITS, 1e4)  #: float32 sums of these lose up to 5e-4


def _masks() -> Iterator[Case]:
    row = partial(Case, "masks")
    for logits, bound in ((LOGITS, 1e-5), (FAR, 2e-4)):
        name = f"logits {logits[0]:g}..{logits[-1]:g}"
        rising = f"the exact masks within {bound:g}, never falling with the level, finite gradients"
        measure = partial(_level_mask_error, logits)
        yield row(f"masks of {name}", f"{name} at all three levels", rising, bound, measure)
    fed = "0, -0, 0.01, its float32 neighbours, 1, halves of a code"
    promised = "0 up to 0.01, else at least 3, ties to even"
    yield row("codes at 0, 1 and the threshold", fed, promised, 0.0, _code_errors)
    for value in (-0.001, 1.001, math.nan, math.inf):
        act = partial(q.mask_codes, np.array([value]))
        yield refusal("masks", f"mask {value:g}", "a mask outside 0..1", EncodeError, act)


def _level_mask_error(values: Sequence[float]) -> Found:
    mp = mpmath()
    logits = torch.tensor(list(itertools.product(values, repeat=3))).requires_grad_()
    levels = [networks.level_mask(logits, level) for level in range(3)]
    slopes = [torch.autograd.grad(mask.sum(), logits)[0] for mask in levels]
    worst = 0.0
    with mp.workdps(40):
        for i, (a, *rises) in enumerate(logits.tolist()):
            total = mp.mpf(a)
            for level, rise in enumerate((None, *rises)):
                total += 0 if rise is None else max(mp.mpf(rise), 0) + mp.log1p(mp.exp(-abs(mp.mpf(rise))))
                worst = largest([worst, abs(float(levels[level][i].detach()) - float(1 / (1 + mp.exp(-total))))])
    falls = max(float((low - high).max().detach()) for low, high in itertools.pairwise(levels))
    kept = falls <= 0 and all(bool(slope.isfinite().all()) for slope in slopes)
    return f"{len(logits)} triples, largest fall {max(falls, 0.0):g}", worst if kept else math.nan


def _code_errors() -> Found:
    at = np.float32(MASK_THRESHOLD)
    given = [0.0, -0.0, 1e-30, MASK_THRESHOLD, 0.0118, 1.0, float(np.float32(1 - 2**-24))]
    given += [float(x) for x in (np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(1)))]
    given += [float(np.float32((c + 0.5) / 255)) for c in range(3, 254)]
    expected = [0 if m <= MASK_THRESHOLD else max(3, round(Fraction(m) * 255)) for m in given]
    wrong = int((q.mask_codes(np.array(given)) != np.array(expected)).sum())
    return f"{wrong} of {len(given)} codes wrong", float(wrong)
