"""NormTable v1 and the other integer tables: check vectors, extremes, and closeness to the exact Gaussian."""

import math
import zlib

import mpmath
import numpy as np
import pytest
import refdec
from hypothesis import given
from hypothesis import strategies as st
from strategies import norm_table

from pd4dgs_codec.entropy.ans import TOTAL
from pd4dgs_codec.entropy.priors import (
    FEW,
    NORMAL,
    OCTAVE,
    SI_MAX,
    SI_MIN,
    Normal,
    Prior,
    Window,
    make_models,
    normal_tables,
)


def is_table(cum: np.ndarray, n: int) -> bool:
    return len(cum) == n + 1 and cum[0] == 0 and cum[-1] == TOTAL and bool(np.all(np.diff(cum) >= 1))


def test_constants_match_high_precision_and_stay_clear_of_rounding_boundaries():
    with mpmath.workdps(40):
        normal = [2**28 * (mpmath.ncdf(mpmath.mpf(i) / 32) - mpmath.mpf(1) / 2) for i in range(257)]
        octave = [mpmath.power(2, 31 - mpmath.mpf(j) / 64) for j in range(64)]
        assert [int(mpmath.nint(x)) for x in normal] == NORMAL[:257].tolist()
        assert [int(mpmath.nint(x)) for x in octave] == OCTAVE.tolist()
        margin = min(abs(x - mpmath.floor(x) - 0.5) for x in normal + octave)
    assert margin > 1e-4 and NORMAL[257] == NORMAL[256] == 2**27
    assert (NORMAL[1], NORMAL[32]) == (3346026, 91629033)
    assert (2**21 - 1) * int(OCTAVE.max()) < 2**53, "the largest product of the rule fits a double"


@given(
    st.integers(2, 300) | st.just(1 << 14),
    st.integers(-(2**31), 2**31),
    st.integers(SI_MIN, SI_MAX) | st.sampled_from([SI_MIN, SI_MAX]),
)
def test_equals_the_rule_in_python_integers(n, mu8, si):
    cum = norm_table(n, mu8, si)
    assert cum.tolist() == refdec.table_of(refdec.norm_cdf(n, mu8, si)) and is_table(cum, n)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 7.3, 200.0])
def test_loses_almost_nothing_against_the_exact_gaussian(sigma):
    si = round(64 * math.log2(sigma))
    sigma, mean = 2 ** (si / 64), 6 * max(sigma, 1) + 0.25
    n = int(2 * mean) + 1
    cum = norm_table(n, round(256 * mean), si)
    scale = sigma * math.sqrt(2)
    exact = np.array([math.erf((k + 0.5 - mean) / scale) - math.erf((k - 0.5 - mean) / scale) for k in range(n)]) / 2
    seen = exact > 1e-12
    loss = exact[seen] @ np.log2(exact[seen] / (np.diff(cum)[seen] / TOTAL))
    bits = -(exact[seen] @ np.log2(exact[seen]))
    assert 0 <= loss + 1e-9 and loss <= 7e-4 * bits + 2e-5  # the least frequency, 16


@given(st.integers(2, 200), st.integers(0, 256), st.integers(SI_MIN, SI_MAX), st.integers(SI_MIN, SI_MAX))
def test_mixture_is_a_table_between_its_parts(n, weight, si1, si2):
    cum = Prior(Window(0, n), (Normal(100, si1), Normal(256 * n, si2)), weight).cum
    ends = np.stack([norm_table(n, 100, si1), norm_table(n, 256 * n, si2)])
    assert is_table(cum, n)
    assert np.all(cum >= ends.min(axis=0) - 1) and np.all(cum <= ends.max(axis=0) + 1)


def test_tables_are_frozen():
    """A checksum over many tables: a change of any entry is a change of the format."""
    crc = 0
    for si in range(SI_MIN, SI_MAX + 1, 37):
        for mu8 in (-1000, 0, 4321, 10**6):
            crc = zlib.crc32(norm_table(33, mu8, si).astype("<i8").tobytes(), crc)
    assert crc == 0x63B148BD


def test_tables_made_together_are_those_made_alone():
    rng = np.random.default_rng(3)
    priors = [Prior(Window(4, 1))]
    for n in [2, 3, 7, 300, 20_000, 2, 900, *rng.integers(2, 60, 40).tolist()]:
        means, widths = rng.integers(-(2**31), 2**31, 2) >> rng.integers(0, 31, 2), rng.integers(-640, 1281, 2)
        first, second = map(Normal, means.tolist(), widths.tolist())
        window = Window(-3, min(n, 1 << 14))
        priors += [Prior(window, (first,)), Prior(window, (first, second), int(rng.integers(1, 256)))]
    cums, sizes = normal_tables(priors)
    for found, prior in zip(np.split(cums, np.cumsum(sizes + 1)[:-1]), priors, strict=True):
        np.testing.assert_array_equal(found, prior.cum)
    make_models(priors)
    assert all("model" in prior.__dict__ for prior in priors)
    few = [Prior(Window(0, FEW + i), (Normal(0, 0),)) for i in range(2)]
    make_models(few)
    assert ["model" in prior.__dict__ for prior in few] == [False, True]
