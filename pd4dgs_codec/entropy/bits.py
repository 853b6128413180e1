"""The bits of a channel of symbols under two simple models: its own frequencies (order-0 entropy), and R(a)."""

from __future__ import annotations

import math

import numpy as np

P_MIN = 1e-6  #: the clip of R(a)
SIGMA_MIN = 2.0**-10  #: in units of Q

BIT = 1 << 20  #: one bit, where costs are integers, whose sums do not depend on their order
#: log2(1 + i / 4096) in these units, the last one twice. Linear interpolation is off by less than 2e-8 bits.
LOG2 = np.rint(np.log2(1 + np.minimum(np.arange(4098), 4096) / 4096) * BIT).astype(np.int64)


def frequency_costs(frequencies: np.ndarray) -> np.ndarray:
    """24 - log2 of frequencies int64 [...] from 1 to 2^24, of 2^24 in all: int64 [...] in units of 2^-20 bits."""
    bits = frequencies.astype(np.float64).view(np.int64)  # exponent and mantissa, IEEE 754
    i, f = (bits >> 40) & 4095, (bits >> 28) & 4095
    log2: np.ndarray = (((bits >> 52) - 1023) * BIT) + LOG2[i] + (((LOG2[i + 1] - LOG2[i]) * f) >> 12)
    return 24 * BIT - log2


def symbol_counts(symbols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values int64 [U], ascending, counts int64 [U]) of integer symbols, at least one."""
    low, high = int(symbols.min()), int(symbols.max())
    if high - low > 4 * symbols.size + 1024:
        values, counts = np.unique(symbols, return_counts=True)
        return values.astype(np.int64), counts.astype(np.int64)
    counts = np.bincount(symbols.astype(np.int64) - low)  # faster than sorting, unless the range is wide
    present = np.flatnonzero(counts)
    return present + low, counts[present]


def order0_bits(counts: np.ndarray) -> float:
    """Order-0 entropy of symbols that occur counts [U] times, all positive, in bits for all symbols together."""
    each = counts.astype(np.float64)
    total = each.sum()
    return float(total * np.log2(total) - (each * np.log2(each)).sum())


def entropy_bits(symbols: np.ndarray) -> float:
    """Order-0 entropy of integer symbols, in bits for all symbols together."""
    return order0_bits(symbol_counts(symbols)[1]) if symbols.size else 0.0


def gaussian_bits(symbols: np.ndarray) -> float:
    """Sum of R(a) over integer symbols, in bits; see `gaussian_bits_of`."""
    symbols = np.asarray(symbols)
    return gaussian_bits_of(*symbol_counts(symbols)) if symbols.size else 0.0


def gaussian_bits_of(values: np.ndarray, counts: np.ndarray) -> float:
    """Sum of R(a) = -log2(Phi((k + 1/2 - mu) / sigma) - Phi((k - 1/2 - mu) / sigma)) over values k int64 [U] that occur
    counts [U] times, in bits.

    mu and sigma are the symbols' mean and standard deviation (units of Q, sigma >= 2**-10), each probability is
    clipped at 1e-6. Written with the upper tail of |k - mu|, so nothing above the clip loses more than 1e-9 of itself.
    """
    weights = counts / counts.sum()
    mu = float(values @ weights)
    sigma = max(math.sqrt(float((values - mu) ** 2 @ weights)), SIGMA_MIN)
    scale = 1.0 / (sigma * math.sqrt(2.0))
    bits = 0.0
    for distance, count in zip(np.abs(values - mu).tolist(), counts.tolist(), strict=True):
        p = 0.5 * (math.erfc((distance - 0.5) * scale) - math.erfc((distance + 0.5) * scale))
        bits -= count * math.log2(max(p, P_MIN))
    return bits
