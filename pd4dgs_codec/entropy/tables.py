"""Integer frequency tables, the only probabilities in the format, and costs of symbols for encoders.

A table is ``cum`` int64 [n + 1], strictly increasing from 0 to 2**24; symbol q owns the interval [cum[q], cum[q + 1]).
Every rule below uses integers below 2**53 only, so Python, C and JavaScript build the same table on every machine.
"""

import math

import numpy as np

TOTAL = 1 << 24
FLOOR = 16  #: least frequency: 16 / 2**24 is the clip of R(a), and keeps outliers from steering a fit
SI_MIN, SI_MAX = -640, 1280  #: sigma = Q * 2 ** (si / 64)

# The two constants of NormTable v1. Computing them in float64 is safe: no entry comes closer than 1e-4 to a rounding
# boundary (a test checks that), while float64 is off by less than 1e-6 whatever the C library.
_T = [round(2**27 * math.erf(i / (32 * math.sqrt(2)))) for i in range(257)]
NORMAL = np.array([*_T, _T[-1]], dtype=np.int64)  #: T[i] = round(2**28 (Phi(i / 32) - 1/2)), T[257] = T[256]
OCTAVE = np.array([round(2.0 ** (31 - j / 64)) for j in range(64)], dtype=np.int64)  #: M[j]


def _mass(t: np.ndarray, si: np.ndarray) -> np.ndarray:
    """Returns a Gaussian's mass up to t / 256 from its mean, in units of 2**-28; si broadcasts against t."""
    e, nb = si >> 6, np.maximum(0, (si >> 6) - 8)
    a = np.minimum(np.abs(t) >> nb, (1 << 21) - 1)
    z = np.minimum((a * OCTAVE[si & 63]) >> (23 + e - nb), 8 << 16)
    i, f = z >> 11, z & 2047
    v = NORMAL[i] + (((NORMAL[i + 1] - NORMAL[i]) * f) >> 11)
    mass: np.ndarray = (1 << 27) + np.where(t < 0, -v, v)
    return mass


def norm_cdf28_of_each(sizes: np.ndarray, mu8: np.ndarray, si: np.ndarray) -> np.ndarray:
    """Returns C(k), the mass up to k + 1/2 in units of 2**-28, for k = -1 .. n - 1 of many Gaussians, concatenated.

    sizes, mu8, si: int64 [m], the n of each Gaussian, 256 * (mean - kmin) in symbols, and 64 * log2(sigma / Q). A table
    uses neither the first nor the last value. Calling numpy for each short table would take longer than decoding it.
    """
    lengths = sizes + 1
    return _mass(_counted(lengths) * 256 - np.repeat(128 + mu8, lengths), np.repeat(si, lengths))


def tables_of_each(cdf: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """NormTable v1: returns the concatenated tables of a result of norm_cdf28_of_each. sizes: int64 [m].

    Each symbol gets FLOOR plus its share of the rest; the first also gets the mass below the window, the last the
    mass above it. The caller has checked the limits of clause 8.2: sizes 1 .. 2**14, si within SI_MIN .. SI_MAX, |mu8|
    < 2**40.
    """
    lengths = sizes + 1
    ends = np.cumsum(lengths)
    cum: np.ndarray = (cdf * np.repeat(TOTAL - sizes * FLOOR, lengths)) >> 28
    cum += FLOOR * _counted(lengths)
    cum[ends - lengths], cum[ends - 1] = 0, TOTAL
    return cum


def _counted(lengths: np.ndarray) -> np.ndarray:
    """Returns 0 .. length - 1 for each of `lengths`, concatenated."""
    counted: np.ndarray = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return counted


# -- costs -----------------------------------------------------------------------------------------------------------

BIT = 1 << 20  #: one bit in integer costs, whose sums do not depend on their order
#: log2(1 + i / 4096) in these units, the last one twice. Linear interpolation is off by less than 2e-8 bits.
LOG2 = np.rint(np.log2(1 + np.minimum(np.arange(4098), 4096) / 4096) * BIT).astype(np.int64)


def frequency_costs(frequencies: np.ndarray) -> np.ndarray:
    """Returns the costs 24 - log2(f), int64 [...] in units of 2^-20 bits, of frequencies f int64 [...], 1 .. 2^24."""
    bits = frequencies.astype(np.float64).view(np.int64)  # exponent and mantissa, IEEE 754
    i, f = (bits >> 40) & 4095, (bits >> 28) & 4095
    log2: np.ndarray = (((bits >> 52) - 1023) * BIT) + LOG2[i] + (((LOG2[i + 1] - LOG2[i]) * f) >> 12)
    return 24 * BIT - log2


def symbol_counts(symbols: np.ndarray, times: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Returns (values int64 [U], ascending, counts int64 [U]) of integer symbols, at least one.
    times: int [N], how often each symbol counts; once if None."""
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
