"""NormTable v1 and the other integer tables: check vectors, extremes, and closeness to the exact Gaussian."""

import math
import zlib
from dataclasses import replace

import mpmath
import numpy as np
import pytest
import refdec
from hypothesis import given
from hypothesis import strategies as st
from strategies import norm_table

from pd4dgs_codec.entropy.priors import (
    HEIGHT_STEPS,
    Const,
    Gauss,
    Hist,
    Mixture,
    Normal,
    Window,
    _Tabled,
    make_models,
    normal_tables,
    top_limit,
    with_height_symbols,
)
from pd4dgs_codec.entropy.tables import (
    NORMAL,
    OCTAVE,
    SI_MAX,
    SI_MIN,
    TOTAL,
    histogram_table,
    histogram_tables_of_each,
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
    st.sampled_from([1, 16]),
)
def test_equals_the_rule_in_python_integers(n, mu8, si, floor):
    cum = norm_table(n, mu8, si, floor)
    assert cum.tolist() == refdec.table_of(refdec.norm_cdf(n, mu8, si), floor) and is_table(cum, n)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 7.3, 200.0])
def test_loses_almost_nothing_against_the_exact_gaussian(sigma):
    si = round(64 * math.log2(sigma))
    sigma, mean = 2 ** (si / 64), 6 * max(sigma, 1) + 0.25
    n = int(2 * mean) + 1
    cum = norm_table(n, round(256 * mean), si, 1)
    scale = sigma * math.sqrt(2)
    exact = np.array([math.erf((k + 0.5 - mean) / scale) - math.erf((k - 0.5 - mean) / scale) for k in range(n)]) / 2
    seen = exact > 1e-12
    loss = exact[seen] @ np.log2(exact[seen] / (np.diff(cum)[seen] / TOTAL))
    bits = -(exact[seen] @ np.log2(exact[seen]))
    assert 0 <= loss + 1e-9 and loss <= 7e-4 * bits + 1e-5


@given(st.integers(2, 200), st.integers(0, 256), st.integers(SI_MIN, SI_MAX), st.integers(SI_MIN, SI_MAX))
def test_mixture_is_a_table_between_its_parts(n, weight, si1, si2):
    cum = Mixture(Window(0, n), Normal(100, si1), Normal(256 * n, si2), weight, 1).cum
    ends = np.stack([norm_table(n, 100, si1, 1), norm_table(n, 256 * n, si2, 1)])
    assert is_table(cum, n)
    assert np.all(cum >= ends.min(axis=0) - 1) and np.all(cum <= ends.max(axis=0) + 1)


@given(st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=60).filter(any))
def test_histogram_table_follows_the_weights(freqs):
    cum = histogram_table(np.array(freqs))
    assert is_table(cum, len(freqs))
    share = np.array(freqs) / sum(freqs)
    assert np.all(np.abs(np.diff(cum) / TOTAL - share) < (len(freqs) + 3) / TOTAL)


def test_histogram_table_at_its_limits():
    assert histogram_table(np.array([0, 3, 1])).tolist() == [0, 1, 1 + (2**24 - 3) * 3 // 4 + 1, 2**24]
    assert is_table(histogram_table(np.full(1 << 14, 2**31 - 1)), 1 << 14)


def test_tables_are_frozen():
    """A checksum over many tables: a change of any entry is a change of the format."""
    crc = 0
    for si in range(SI_MIN, SI_MAX + 1, 37):
        for mu8 in (-1000, 0, 4321, 10**6):
            crc = zlib.crc32(norm_table(33, mu8, si, 1 if si % 2 else 16).astype("<i8").tobytes(), crc)
    assert crc == 0xC5EA5B43


def test_tables_made_together_are_those_made_alone():
    rng = np.random.default_rng(3)
    priors: list[Gauss | Mixture | Const] = [Const(Window(4, 1))]
    for n in [2, 3, 7, 300, 20_000, 2, 900, *rng.integers(2, 60, 40).tolist()]:
        means, widths = rng.integers(-(2**31), 2**31, 2) >> rng.integers(0, 31, 2), rng.integers(-640, 1281, 2)
        first, second = map(Normal, means.tolist(), widths.tolist())
        window, floor = Window(-3, min(n, 1 << 14)), int(rng.choice([1, 16]))
        priors += [Gauss(window, first, floor), Mixture(window, first, second, int(rng.integers(1, 256)), floor)]
    priors += [
        Hist(Window(0, 9), 8, int(rng.integers(1, 30)), bool(i % 2), int(rng.integers(0, 64)), 40, None)
        for i in range(9)
    ]
    cums, sizes = normal_tables(priors[1:])
    alone = [prior.height_cum if isinstance(prior, Hist) else prior.cum for prior in priors[1:]]
    for found, expected in zip(np.split(cums, np.cumsum(sizes + 1)[:-1]), alone, strict=True):
        np.testing.assert_array_equal(found, expected)
    make_models(priors)
    assert all({"model", "height_model"} & {*prior.__dict__} for prior in priors[1:])


def test_priors_of_another_class_are_not_taken_for_gaussians():
    class Laplace(_Tabled):
        window, normal, floor = Window(0, 9), Normal(0, 0), 1

    with pytest.raises(TypeError, match="^Laplace: "):
        Laplace().cum  # noqa: B018


def test_histograms_completed_together_are_those_made_alone():
    rng = np.random.default_rng(4)
    whole = []
    for n in [2, 3, 1 << 14, *rng.integers(2, 60, 40).tolist()]:
        step = int(rng.choice(HEIGHT_STEPS))
        heights = rng.integers(0, (top := int(rng.integers(1, top_limit(step) + 1))) + 1, n)
        heights[rng.integers(n)] = top
        whole.append(Hist(Window(0, n), step, top, bool(rng.integers(2)), 0, 0, heights))
    found = with_height_symbols(
        [replace(prior, heights=None) for prior in whole], [p.height_symbols.astype(np.int32) for p in whole]
    )
    for prior, expected in zip(found, whole, strict=True):
        np.testing.assert_array_equal(prior.heights, expected.heights)
        assert "model" in prior.__dict__
        assert prior.cum.tolist() == refdec.histogram_table(expected.heights.tolist(), prior.top, prior.step)
    weights = [rng.integers(0, 1 << 31, n) for n in (2, 5, 1 << 14, 33)]
    weights.append(np.array([0, 1, 0]))
    cums = histogram_tables_of_each(np.concatenate(weights), np.array([len(w) for w in weights]))
    for table, w in zip(np.split(cums, np.cumsum([len(w) + 1 for w in weights])[:-1]), weights, strict=True):
        np.testing.assert_array_equal(table, histogram_table(w))
