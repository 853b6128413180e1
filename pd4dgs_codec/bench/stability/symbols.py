"""Stability of quantisers and of the priors that code their symbols.

Channels that no distribution describes still come back, at a sane size. |x - x_hat| <= Q/2 and one float32 rounding,
from the smallest step to the largest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import partial

import numpy as np

from pd4dgs_codec.bench.stability.cases import Case, Found, mpmath, refusal, small_scene
from pd4dgs_codec.entropy import bits, channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import decoder, encoder
from pd4dgs_codec.format import quantise as q

SETTINGS = (("best", 1), ("best", 5), ("gauss", 5))  #: (priors, effort)
#: A channel may cost this share more than its plain binary form, and OVERHEAD bits.
SLACK, OVERHEAD = 1.01, 256
#: Those whose sum of R is held against mpmath.
SUMMED = ("constant", "two values, far apart", "one rare outlier", "the whole range", "heavy tails")


def cases() -> Iterator[Case]:
    """Groups fitting and quantiser."""
    yield from _fitting()
    yield from _quantiser()


# -- fitting -----------------------------------------------------------------------------------------------------------


def _channels() -> dict[str, tuple[str, np.ndarray]]:
    """Case -> (what it is, int32 symbols)."""
    rng = np.random.default_rng(0)
    rare = np.zeros(10_000, np.int64)
    rare[4321] = -K_MAX
    tails = np.clip(np.rint(rng.standard_cauchy(20_000) * 3), -K_MAX, K_MAX)
    peaks = np.concatenate([rng.normal(-1e6, 2, 5000), rng.normal(1e6, 2, 5000)])
    data = {
        "constant": ("5,000 times 7", np.full(5000, 7)),
        "constant at the limit": ("5,000 times 2^24 - 1", np.full(5000, K_MAX)),
        "all zero, long": ("2^20 zeros", np.zeros(1 << 20)),
        "two neighbours": ("5,000 of 3 or 4", rng.integers(3, 5, 5000)),
        "two values, far apart": ("5,000 of +-(2^24 - 1)", rng.choice([-K_MAX, K_MAX], 5000)),
        "one rare outlier": ("9,999 zeros and one -(2^24 - 1)", rare),
        "the whole range": ("2,000 uniform in +-(2^24 - 1)", rng.integers(-K_MAX, K_MAX + 1, 2000)),
        "heavy tails": ("20,000 of a Cauchy distribution", tails),
        "two distant peaks": ("10,000 of two Gaussians at +-1e6", np.rint(peaks)),
        "one symbol": ("one symbol, 2^24 - 1", np.array([K_MAX])),
        "two symbols": ("0 and 2^24 - 1", np.array([0, K_MAX])),
        "empty": ("no symbols", np.zeros(0)),
    }
    return {name: (fed, values.astype(np.int32)) for name, (fed, values) in data.items()}


def _fitting() -> Iterator[Case]:
    """Per channel: it comes back, it costs no more than plain binary, and the model's rate is right."""
    row, data = partial(Case, "fitting"), _channels()
    lossless = "every symbol comes back, with any priors and effort"
    for name, (fed, symbols) in data.items():
        yield row(f"lossless: {name}", fed, lossless, 0.0, partial(_lost_symbols, [symbols]))
    together = partial(_lost_symbols, [symbols for _, symbols in data.values()])
    yield row("lossless: all of these in one payload", "the channels above, side by side", lossless, 0.0, together)
    small = f"at most {SLACK} of plain binary over its range, and {OVERHEAD} bits"
    for name, (fed, symbols) in data.items():
        yield row(f"size: {name}", fed, small, SLACK, partial(_against_plain_binary, symbols))
    for name in SUMMED:
        fed, symbols = data[name]
        yield row(f"sum of R: {name}", fed, "within 1e-9 of itself", 1e-9, partial(_rate_error, symbols))
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
    bits = channels.encode_channels([symbols]).payload_bits
    spread = int(symbols.max()) - int(symbols.min()) if symbols.size else 0
    plain = symbols.size * math.log2(spread + 1)
    return f"{bits:,} bits, plain binary {plain:,.0f}", max(bits - OVERHEAD, 0) / max(plain, 1.0)


def _rate_error(symbols: np.ndarray) -> Found:
    mp = mpmath()
    with mp.workdps(50):
        values, counts = np.unique(symbols, return_counts=True)
        pairs = [(mp.mpf(v), mp.mpf(c)) for v, c in zip(values.tolist(), counts.tolist(), strict=True)]
        n = mp.mpf(symbols.size)
        mu = sum(v * c for v, c in pairs) / n
        sigma = max(mp.sqrt(sum((v - mu) ** 2 * c for v, c in pairs) / n), mp.mpf(bits.SIGMA_MIN))
        scale, expected = 1 / (sigma * mp.sqrt(2)), mp.mpf(0)
        for v, c in pairs:
            d = abs(v - mu)
            p = (mp.erfc((d - 0.5) * scale) - mp.erfc((d + 0.5) * scale)) / 2
            expected -= c * mp.log(max(p, mp.mpf(bits.P_MIN)), 2)
        found = bits.gaussian_bits(symbols)
        return f"{found:,.3f} bits", float(abs(mp.mpf(found) - expected) / max(expected, mp.mpf(1)))


# -- quantiser ---------------------------------------------------------------------------------------------------------

TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
_SUBNORMAL, _NEAR = float(np.float32(1e-45)), float(np.float32(3.3e38))
_TOP = round(Fraction(_NEAR) / Fraction(2.0**106))
#: (case, values, step, their symbols, promised)
SYMBOLS: tuple[tuple[str, list[float], float, list[int], str], ...] = (
    ("halves", [0.5, 1.5, 2.5, -0.5, -1.5, 8388606.5, 4194303.5], 1.0, [0, 2, 2, 0, -2, 8388606, 4194304],
     "ties go to even"),
    ("negative zero", [-0.0, -1e-30], 0.5, [0, 0], "symbol 0, value +0"),
    ("subnormal values", [1e-45, -1e-39, 1e-38], float(np.float32(1e-12)), [0, 0, 0], "symbol 0"),
    ("subnormal values at the smallest step", [TINY / 2, TINY * 0.75, -TINY, _SUBNORMAL], TINY, [0, 1, -1, 0],
     "ties to even, x_hat kept"),
    ("values near the float limit", [_NEAR, -_NEAR], 2.0**106, [_TOP, -_TOP], "nearest symbol, x_hat finite"),
)  # fmt: skip
#: (value, step, what it is)
REFUSED = (
    (math.nan, 1.0, "NaN among the values"),
    (math.inf, 1.0, "an infinity among the values"),
    (float(2**23 + 1), 1.0, "a value of 2^23 + 1 steps; the limit is 2^23"),
    (HUGE, 2.0**106, "the largest float32, which would come back as an infinity"),
)
#: (factor on all steps of a scene, why it is refused)
REFUSED_SCALES = (
    (1e-6, "weights of more than 2^23 steps; the limit is 2^23"),
    (1e-38, "steps below binary32's normal range"),
    (1e40, "steps above binary32's range"),
)


def _quantiser() -> Iterator[Case]:
    """Steps from 1e-12 to 1e6 and at binary32's ends; halves, zeros, subnormals and float limits; refusals."""
    row, refuse = partial(Case, "quantiser"), partial(refusal, "quantiser")
    fed, close = "4,000 values up to 2^23 steps, at halves of a step and around them", "Q/2 + half a float32 unit"
    again = "quantising what was dequantised gives the same symbols"
    for step in (1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e6, TINY, 2.0**104):
        Q = float(np.float32(step))
        yield row(f"step {step:.3g}", fed, f"|x - x_hat| <= {close}, exactly", 1.0, partial(_error_in_bounds, Q))
        yield row(f"again at step {step:.3g}", "symbols 0, +-1 .. +-2^23", again, 0.0, partial(_changed, Q))
    for name, values, step, expected, promised in SYMBOLS:
        fed = f"{', '.join(f'{v:.9g}' for v in values)} at step {step:.3g}"
        yield row(name, fed, promised, 0.0, partial(_wrong_symbols, values, step, expected))
    for step in (0.0, -0.5, math.nan, math.inf, _SUBNORMAL, 0.1):
        act = partial(q.quantise, np.zeros(3, np.float32), step, "feature")
        yield refuse(f"step {step:.3g}", "a step that is no positive normal binary32", EncodeError, act)
    for value, step, fed in REFUSED:
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
