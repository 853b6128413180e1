"""Stability of numbers and their codes: the rate R(a), priors, quantisers and masks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import torch
from mpmath import mp
from promises import Found, Promise, largest, refusal
from tiny import trained_like_scene

from pd4dgs_codec.entropy import channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import decoder, encoder
from pd4dgs_codec.model import networks, rate
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.tensors import quantise as q

# -- rate: values and gradients against mpmath over sixteen decades of sigma / Q ---------------------------------------

#: |a - mu| / sigma, and |a - mu| / Q around the edge of the interval, where one of the two tails vanishes.
IN_SIGMAS = (0.0, 1e-6, *(10 ** (i / 3) for i in range(-6, 19)))
IN_STEPS = (0.49, 0.499999, 0.5, 0.500001, 0.51, 1.0, 40.0)
FARTHEST = 1e6  #: sigmas
PRIORS = ((0.0, 0.125), (-1.5, 0.7))  #: (mu, Q)
LN_2, LN_CLIP = math.log(2.0), math.log(rate.MIN_PROBABILITY)


@cache
def _channels(dtype: type) -> list[tuple[np.ndarray, float, float, float]]:
    """Channels with sigma / Q of 1e-8..1e8: (a [n, 1] of the dtype, mu, sigma, Q)."""
    found = []
    for ratio, (mu, step) in itertools.product((10.0**e for e in range(-8, 9)), PRIORS):
        sigma = ratio * step
        distances = [z * sigma for z in IN_SIGMAS] + [d * step for d in IN_STEPS if d <= FARTHEST * ratio]
        found.append((np.array([[mu + sign * d] for sign in (1, -1) for d in distances], dtype), mu, sigma, step))
    return found


@cache
def _reference(dtype: type, floored: bool) -> np.ndarray:
    """float64 [n, 5] of all channels, exactly as stored: sigma / Q, |a - mu| / sigma, ln P, sigma dlnP/da and
    sigma dlnP/dsigma. floored: with a sigma of at least Q MIN_SIGMA_RATIO."""
    least = rate.MIN_SIGMA_RATIO if floored else 0.0
    rows = ((a, mu, sigma, step) for values, mu, sigma, step in _channels(dtype) for a in values[:, 0].tolist())
    return np.array([(s / q, abs(a - mu) / s, *_exact(a, mu, max(s, q * least), q)) for a, mu, s, q in rows])


def _exact(*stored: float) -> tuple[float, float, float]:
    with mp.workdps(60):
        a, mu, sigma, step = (mp.mpf(x) for x in stored)
        d = abs(a - mu)
        u, v = (d - step / 2) / sigma, (d + step / 2) / sigma
        p = (mp.erfc(u / mp.sqrt(2)) - mp.erfc(v / mp.sqrt(2))) / 2
        phi_u, phi_v = mp.npdf(u), mp.npdf(v)
        return float(mp.log(p)), float(mp.sign(a - mu) * (phi_v - phi_u) / p), float((u * phi_u - v * phi_v) / p)


def _measured(dtype: type, least_sigma: float, most_bits: float) -> np.ndarray:
    """float64 [n, 3] of all channels: R in nats, and its derivatives by a and sigma times the sigma in use."""
    found, narrow = [], rate.NARROW[torch.from_numpy(np.empty(0, dtype)).dtype]
    for values, mu, sigma, step in _channels(dtype):
        bits, slopes, used = np.empty(len(values)), np.empty((2, *values.shape)), max(sigma, step * least_sigma)
        prior, limits = (np.full((1, 1), x) for x in (mu, used)), (least_sigma, most_bits, narrow)
        rows, classes = np.arange(len(values)), np.zeros(len(values), np.int8)
        rate.scalar_bits(bits, *slopes, values, rows, classes, *prior, step, *limits)
        found.append(np.column_stack([bits, *(slope * used for slope in slopes)]) * LN_2)
    return np.concatenate(found)


def _worst(reference: np.ndarray, errors: np.ndarray) -> Found:
    """Returns the position of the largest error, and that error, NaN if there is one."""
    index = int(errors.argmax())
    ratio, distance = reference[index, :2]
    position = f"sigma/Q {ratio:.0e}, |a - mu|/sigma {distance:.3g}"
    return f"{len(errors)} points, worst at {position}", float(errors[index])


def _relative(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.abs(found - expected) / np.maximum(np.abs(expected), 1.0)


def _value_and_gradients(dtype: type) -> Found:
    reference = _reference(dtype, False)
    return _worst(reference, _relative(-_measured(dtype, 0.0, math.inf), reference[:, 2:]).max(axis=1))


def _bits_and_slope(dtype: type) -> Found:
    reference, (nats, slope, _) = _reference(dtype, True), _measured(dtype, rate.MIN_SIGMA_RATIO, rate.MAX_BITS).T
    errors = _relative(-nats, np.maximum(reference[:, 2], LN_CLIP))
    expected = -reference[:, 3]  # per sigma; a wrong sign is an error of 2
    off = np.abs(slope - expected) / np.maximum(np.abs(expected), 1e-300)  # at mu the slope is 0
    return _worst(reference, np.where(reference[:, 2] < LN_CLIP, np.maximum(errors, off), errors))


def _not_finite(dtype: type) -> Found:
    numbers = np.stack([_measured(dtype, 0.0, math.inf), _measured(dtype, rate.MIN_SIGMA_RATIO, rate.MAX_BITS)])
    bad = np.count_nonzero(~np.isfinite(numbers))
    return f"{bad} of {numbers.size} numbers not finite", float(bad)


def _without_spread() -> Found:
    x = torch.full((1000, 1), 3.7, requires_grad=True)
    total = rate.row_bits([(x, 0.125)], torch.zeros(1000, dtype=torch.int8), torch.arange(1000)).sum()
    (slope,) = torch.autograd.grad(total, x)
    finite = bool(torch.isfinite(slope).all())
    said = f"{float(total.detach()):.3g} bits, gradients {'finite' if finite else 'not finite'}"
    return said, abs(float(total.detach())) if finite else math.nan


# -- fitting: channels that no distribution describes ------------------------------------------------------------------

SETTINGS = (("best", 1), ("best", 5), ("gauss", 5))  #: (priors, effort)
#: The size of a channel may be this multiple of its plain binary form, and OVERHEAD bits more.
SLACK, OVERHEAD = 1.01, 256
#: SLACK of channels with most values outside any window of 2^14 entries, since such exceptions take up to 40 bits.
SLACK_OF_EXCEPTIONS, EXCEPTIONS = 1.6, ("the whole range", "two distant peaks")
_RNG = np.random.default_rng(0)
#: (case, description, symbols)
CHANNELS = [
    (name, fed, np.rint(values).astype(np.int32))
    for name, fed, values in (
        ("constant at the limit", "5,000 times 2^24", np.full(5000, K_MAX)),
        ("all zero, long", "2^20 zeros", np.zeros(1 << 20)),
        ("two values, far apart", "5,000 of +-2^24", _RNG.choice([-K_MAX, K_MAX], 5000)),
        ("one rare outlier", "9,999 zeros and one -2^24", -K_MAX * (np.arange(10_000) == 4321)),
        ("the whole range", "2,000 uniform in +-2^24", _RNG.integers(-K_MAX, K_MAX + 1, 2000)),
        ("heavy tails", "20,000 of a Cauchy distribution", np.clip(_RNG.standard_cauchy(20_000) * 3, -K_MAX, K_MAX)),
        ("two distant peaks", "10,000 of two Gaussians at +-1e6", _RNG.choice([-1e6, 1e6], 10_000)
         + _RNG.normal(0, 2, 10_000)),
        ("empty", "no symbols", np.zeros(0)),
    )
]  # fmt: skip


def _coded(*arrays: np.ndarray, priors: str = "best", effort: int = 5) -> tuple[bytes, bytes]:
    writer = channels.ChannelWriter(priors, effort)
    writer.write(arrays)
    return writer.finish()[:2]


def _lost_symbols(*arrays: np.ndarray) -> Found:
    wrong, sizes = 0, []
    for priors, effort in SETTINGS:
        codes, stream = _coded(*arrays, priors=priors, effort=effort)
        reader = channels.ChannelReader(codes, stream, sum(a.size for a in arrays))
        wrong += int((reader.read([a.size for a in arrays]) != np.concatenate(arrays)).sum())
        reader.finish()
        sizes.append(len(codes) + len(stream))
    return f"{wrong} wrong symbols, {' / '.join(f'{s:,}' for s in sizes)} bytes", float(wrong)


def _against_plain_binary(symbols: np.ndarray) -> Found:
    coded = 8 * sum(map(len, _coded(symbols)))
    spread = int(symbols.max()) - int(symbols.min()) if symbols.size else 0
    plain = symbols.size * math.log2(spread + 1)
    return f"{coded:,} bits, plain binary {plain:,.0f}", max(coded - OVERHEAD, 0) / max(plain, 1.0)


# -- quantiser: |x - x_hat| <= Q/2 and one float32 rounding, from the smallest step to the largest ---------------------

TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
SUBNORMAL, NEAR = float(np.float32(1e-45)), float(np.float32(3.3e38))
TOP = round(Fraction(NEAR) / Fraction(2.0**106))


def _wrong_symbols(values: list[float], step: float, expected: list[int]) -> Found:
    k = q.quantise(np.array(values, np.float32), step)
    restored = q.dequantise(k, step)
    wrong = int((k != np.array(expected)).sum()) + int((~np.isfinite(restored)).sum())
    wrong += int((np.signbit(restored) & (k >= 0)).sum())
    return f"symbols {k.tolist()}", float(wrong)


def _in_bounds(x: np.ndarray, restored: np.ndarray, step: float) -> float:
    """Returns the largest |x - x_hat| / (Q/2 + half a unit in the last place of x_hat), exact but for the quotient."""
    unit = np.spacing(np.abs(restored)).astype(np.float64)
    return float((2 * np.abs(x.astype(np.float64) - restored) / (step + unit)).max())


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
    scene = trained_like_scene()
    decoded = decoder.decode(encoder.encode(scene, step_scale=scale, effort=1, omit="nothing"))
    order, back = np.lexsort(scene.anchor_q.T), np.lexsort(decoded.anchor_q.T)
    errors = {
        name: _in_bounds(getattr(scene, name)[order], getattr(decoded, name)[back], getattr(decoded.steps, name))
        for name in ("feature", "scaling_log", "offset")
    }
    return ", ".join(f"{name} {error:.4f}" for name, error in errors.items()) + " of the bound", max(errors.values())


def _encode_with(value: float) -> bytes:
    scene = trained_like_scene()
    offset = scene.offset.copy()
    offset[3, 2, 1] = value
    return encoder.encode(replace(scene, offset=offset))


# -- masks -------------------------------------------------------------------------------------------------------------


def _level_mask_error(values: Sequence[float]) -> Found:
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


# -- the promises ------------------------------------------------------------------------------------------------------

STEPS = {name: float(np.float32(step)) for name, step in (("1e-38", TINY), ("1e-6", 1e-6), ("1", 1), ("2^104", 2**104))}
RATES = "sigma/Q 1e-8..1e8, |a - mu|/sigma up to 1e6"
TYPES = (("float64", np.float64), ("float32", np.float32))  #: of the values; sums are float64
LOSSLESS = "every symbol decoded, with any priors and effort"
NO_STEP, IN_OFFSETS = "a step that is not a positive normal binary32", "among the offsets of a scene"

PROMISES = [
    Promise("rate", "within 1e-9 of mpmath relative to max(1, |x|)", _value_and_gradients,
            [(f"ln P and gradients, {name}", RATES, dtype) for name, dtype in TYPES], 1e-9),
    Promise("rate", "bits min(R, 19.93), gradient of R beyond the clip, within 1e-9", _bits_and_slope,
            [(f"clipped bits, {name}", RATES, dtype) for name, dtype in TYPES], 1e-9),
    Promise("rate", "value and gradients finite", _not_finite,
            [(f"finite, {name}", RATES, dtype) for name, dtype in TYPES]),
    Promise("rate", "0 bits within 1e-6, finite gradients", _without_spread,
            [("a channel without spread", "1,000 equal values, their own moments, float32")], 1e-6),
    Promise("fitting", LOSSLESS, _lost_symbols, [
        *((f"lossless: {name}", fed, symbols) for name, fed, symbols in CHANNELS),
        ("lossless: all of these in one payload", "the channels above, side by side", *(c[2] for c in CHANNELS)),
    ]),
    *(Promise("fitting", f"at most {slack} of plain binary over its range, and {OVERHEAD} bits", _against_plain_binary,
              [(f"size: {name}", fed, given) for name, fed, given in CHANNELS if wide == (name in EXCEPTIONS)], slack)
      for wide, slack in ((False, SLACK), (True, SLACK_OF_EXCEPTIONS))),
    refusal("fitting", EncodeError, lambda value: _coded(np.array([0, value], np.int32)),
            *((f"beyond the limit: {k}", "an int32 extreme; the limit is 2^24", k) for k in (2**31 - 1, -(2**31)))),
    Promise("quantiser", "|x - x_hat| <= Q/2 + half a float32 unit, exactly", _error_in_bounds,
            [(f"step {name}", "4,000 values up to 2^23 steps, at halves of a step and around them", step)
             for name, step in STEPS.items()], 1.0),
    Promise("quantiser", "quantising dequantised symbols returns them", _changed,
            [(f"again at step {name}", "symbols 0, +-1 .. +-2^23", step) for name, step in STEPS.items()]),
    Promise("quantiser", "nearest symbol, ties to even; value finite, no -0", _wrong_symbols, [
        ("halves", "ties at step 1", [0.5, 1.5, 2.5, -0.5, -1.5, 8388606.5, 4194303.5], 1.0,
         [0, 2, 2, 0, -2, 8388606, 4194304]),
        ("negative zero", "-0 and -1e-30 at step 0.5", [-0.0, -1e-30], 0.5, [0, 0]),
        ("subnormal values", "multiples of 0.5, 0.75, -1 and 1e-7 of the smallest step, 2^-126",
         [TINY / 2, TINY * 0.75, -TINY, SUBNORMAL], TINY, [0, 1, -1, 0]),
        ("values near the float limit", "+-3.3e38 at step 2^106", [NEAR, -NEAR], 2.0**106, [TOP, -TOP]),
    ]),
    refusal("quantiser", EncodeError, lambda step: q.quantise(np.zeros(3, np.float32), step, "feature"),
            *((f"step {step:.3g}", NO_STEP, step) for step in (0.0, -0.5, math.nan, math.inf, SUBNORMAL, 0.1))),
    refusal("quantiser", EncodeError, lambda x, step: q.quantise(np.array([0.0, x], np.float32), step, "feature"),
            ("value nan", "NaN among the values", math.nan, 1.0),
            ("value inf", "an infinity among the values", math.inf, 1.0),
            ("value beyond the limit", "2^23 + 1 steps; the limit is 2^23", float(2**23 + 1), 1.0),
            ("value without a float32", "the largest float32, decoded as an infinity at step 2^106", HUGE, 2.0**106)),
    Promise("quantiser", "every attribute within Q/2 and half a float32 unit", _file_error_in_bounds,
            [(f"a whole file at steps times {scale:.0e}", "a scene of 40 anchors, encoded and decoded", scale)
             for scale in (1e-3, 1.0, 1e30)], 1.0),
    refusal("quantiser", EncodeError, lambda scale: encoder.encode(trained_like_scene(), step_scale=scale),
            ("a whole file at steps times 1e-06", "weights of more than 2^23 steps; the limit is 2^23", 1e-6),
            ("a whole file at steps times 1e-38", "steps below binary32's normal range", 1e-38),
            ("a whole file at steps times 1e+40", "steps above binary32's range", 1e40)),
    refusal("quantiser", EncodeError, _encode_with, ("NaN in a scene", f"a NaN {IN_OFFSETS}", math.nan),
            ("infinity in a scene", f"an infinity {IN_OFFSETS}", math.inf)),
    Promise("masks", "the exact masks within 1e-5, never falling with the level, finite gradients", _level_mask_error,
            [(f"masks of logits -{far:g}..{far:g}", "triples of logits at all three levels",
              (-far, -4.59512, 0.0, 4.0, far)) for far in (10.0, 100.0)], 1e-5),
    Promise("masks", "0 up to 0.01, else at least 3, ties to even", _code_errors,
            [("codes at 0, 1 and the threshold", "0, -0, 0.01, its float32 neighbours, 1, halves of a code")]),
    refusal("masks", EncodeError, lambda value: q.mask_codes(np.array([value])),
            *((f"mask {value:g}", "a mask outside 0..1", value) for value in (-0.001, 1.001, math.nan))),
]  # fmt: skip
