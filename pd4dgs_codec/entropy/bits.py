"""Costs of symbols: of integer frequencies, and of a channel under its own frequencies (order-0 entropy)."""

from __future__ import annotations

import numpy as np

BIT = 1 << 20  #: one bit, where costs are integers, whose sums do not depend on their order
#: log2(1 + i / 4096) in these units, the last one twice. Linear interpolation is off by less than 2e-8 bits.
LOG2 = np.rint(np.log2(1 + np.minimum(np.arange(4098), 4096) / 4096) * BIT).astype(np.int64)


def frequency_costs(frequencies: np.ndarray) -> np.ndarray:
    """24 - log2 of frequencies int64 [...] from 1 to 2^24, of 2^24 in all: int64 [...] in units of 2^-20 bits."""
    bits = frequencies.astype(np.float64).view(np.int64)  # exponent and mantissa, IEEE 754
    i, f = (bits >> 40) & 4095, (bits >> 28) & 4095
    log2: np.ndarray = (((bits >> 52) - 1023) * BIT) + LOG2[i] + (((LOG2[i + 1] - LOG2[i]) * f) >> 12)
    return 24 * BIT - log2


def symbol_counts(symbols: np.ndarray, times: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(values int64 [U], ascending, counts int64 [U]) of integer symbols, at least one. times: int [N], how often each
    counts, if not once."""
    low, high = int(symbols.min()), int(symbols.max())
    if high - low > 4 * symbols.size + 1024:  # too wide for an array of counts, which is faster than sorting
        values, index = np.unique(symbols, return_inverse=True)
        return values.astype(np.int64), np.bincount(index, weights=times).astype(np.int64)
    counts = np.bincount(symbols.astype(np.int64) - low, weights=times).astype(np.int64)
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
