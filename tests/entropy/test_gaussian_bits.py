"""The model rate against mpmath."""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.bits import gaussian_bits


def exact_bits(symbols: list[int]) -> float:
    with mpmath.workdps(40):
        n = len(symbols)
        mu = mpmath.fsum(symbols) / n
        sigma = max(mpmath.sqrt(mpmath.fsum((k - mu) ** 2 for k in symbols) / n), mpmath.mpf(2) ** -10)
        bits = mpmath.mpf(0)
        for k in symbols:
            low, high = ((k - 0.5 - mu) / sigma, (k + 0.5 - mu) / sigma)
            p = mpmath.ncdf(-low) - mpmath.ncdf(-high) if low > 0 else mpmath.ncdf(high) - mpmath.ncdf(low)
            bits -= mpmath.log(max(p, mpmath.mpf("1e-6")), 2)
        return float(bits)


@settings(max_examples=40)
@given(st.lists(st.integers(-200, 200) | st.integers(-(2**24) + 1, 2**24 - 1), min_size=1, max_size=30))
def test_agrees_with_mpmath(symbols):
    assert gaussian_bits(np.array(symbols, dtype=np.int32)) == pytest.approx(exact_bits(symbols), rel=1e-8, abs=1e-8)


def test_known_values():
    assert gaussian_bits(np.zeros(0, np.int32)) == 0
    assert gaussian_bits(np.full(100, 7, np.int32)) == 0  # sigma is floored, the whole mass is in the interval
    rare = np.zeros(100_000, np.int32)
    rare[0] = 1000
    zero = math.log2(math.erf(0.5 / (math.sqrt(2) * rare.std())))
    assert gaussian_bits(rare) == pytest.approx(-math.log2(1e-6) - 99_999 * zero, rel=1e-3)
