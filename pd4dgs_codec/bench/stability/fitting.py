"""Stability of prior fitting: channels that no distribution describes still come back, at a sane size."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from pd4dgs_codec.bench.stability.rows import Case, mpmath, refusal
from pd4dgs_codec.entropy import channels
from pd4dgs_codec.entropy.bits import P_MIN, SIGMA_MIN, gaussian_bits
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError

GROUP = "fitting"
SETTINGS = (("best", 1), ("best", 5), ("gauss", 5))  #: (priors, effort)
#: A channel may cost this share more than its plain binary form, and OVERHEAD bits.
SLACK, OVERHEAD = 1.01, 256


def _data() -> dict[str, tuple[str, np.ndarray]]:
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


def cases() -> Iterator[Case]:
    """Per channel: it comes back, it costs no more than plain binary, and the model's rate is right."""
    data = _data()
    for name, (fed, symbols) in data.items():
        yield Case(
            GROUP, f"lossless: {name}", fed, "every symbol comes back, with any priors and effort", 0.0,
            partial(_wrong_symbols, [symbols]),
        )  # fmt: skip
    everything = [symbols for _, symbols in data.values()]
    yield Case(
        GROUP, "lossless: all of these in one payload", "the channels above, side by side",
        "every symbol comes back, with any priors and effort", 0.0, partial(_wrong_symbols, everything),
    )  # fmt: skip
    for name, (fed, symbols) in data.items():
        yield Case(
            GROUP, f"size: {name}", fed, f"at most {SLACK} of plain binary over its range, and {OVERHEAD} bits", SLACK,
            partial(_against_plain_binary, symbols),
        )  # fmt: skip
    for name in ("constant", "two values, far apart", "one rare outlier", "the whole range", "heavy tails"):
        fed, symbols = data[name]
        yield Case(
            GROUP, f"sum of R: {name}", fed, "within 1e-9 of itself", 1e-9, partial(_rate_error, symbols)
        )  # fmt: skip
    for value in (2**31 - 1, -(2**31)):
        over = np.array([0, value], np.int32)
        yield refusal(
            GROUP, f"beyond the limit: {value}", "an int32 extreme; the limit is 2^24 - 1", EncodeError,
            partial(channels.encode_channels, [over]),
        )  # fmt: skip


def _wrong_symbols(arrays: list[np.ndarray]) -> tuple[str, float]:
    wrong, sizes = 0, []
    for priors, effort in SETTINGS:
        coded = channels.encode_channels(arrays, priors=priors, effort=effort)
        decoded = channels.decode_channels(coded.payload, [a.size for a in arrays])
        wrong += sum(int((a != b).sum()) for a, b in zip(arrays, decoded, strict=True))
        sizes.append(len(coded.payload))
    return f"{wrong} wrong symbols, {' / '.join(f'{s:,}' for s in sizes)} bytes", float(wrong)


def _against_plain_binary(symbols: np.ndarray) -> tuple[str, float]:
    bits = channels.encode_channels([symbols]).payload_bits
    spread = int(symbols.max()) - int(symbols.min()) if symbols.size else 0
    plain = symbols.size * math.log2(spread + 1)
    return f"{bits:,} bits, plain binary {plain:,.0f}", max(bits - OVERHEAD, 0) / max(plain, 1.0)


def _rate_error(symbols: np.ndarray) -> tuple[str, float]:
    mp = mpmath()
    with mp.workdps(50):
        values, counts = np.unique(symbols, return_counts=True)
        pairs = [(mp.mpf(v), mp.mpf(c)) for v, c in zip(values.tolist(), counts.tolist(), strict=True)]
        n = mp.mpf(symbols.size)
        mu = sum(v * c for v, c in pairs) / n
        sigma = max(mp.sqrt(sum((v - mu) ** 2 * c for v, c in pairs) / n), mp.mpf(SIGMA_MIN))
        scale = 1 / (sigma * mp.sqrt(2))
        expected = mp.mpf(0)
        for v, c in pairs:
            d = abs(v - mu)
            p = (mp.erfc((d - 0.5) * scale) - mp.erfc((d + 0.5) * scale)) / 2
            expected -= c * mp.log(max(p, mp.mpf(P_MIN)), 2)
        found = gaussian_bits(symbols)
        error = float(abs(mp.mpf(found) - expected) / max(expected, mp.mpf(1)))
    return f"{found:,.3f} bits", error
