"""Fits of priors: exact costs, and the same decisions and files with and without numba."""

import importlib.util
import math
import sys

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import coded

from pd4dgs_codec.entropy import channels, fit_kernels, fitting
from pd4dgs_codec.entropy.fitting import fit_best, histogram, pool
from pd4dgs_codec.entropy.priors import BIT


def _channel(seed: int) -> np.ndarray:
    """int64 symbols of many shapes: narrow, wide, skew, with a spike, with outliers."""
    rng = np.random.default_rng(seed)
    count, sigma = rng.integers(2, 3000), rng.choice([0.05, 0.3, 1.0, 4.0, 40.0, 900.0])
    k = rng.normal(rng.uniform(-3, 3), sigma, count)
    if seed % 3 == 0:
        k = np.where(rng.random(count) < 0.2, k + rng.normal(0, 5 * sigma, count), k)
    if seed % 4 == 0:
        k = np.abs(k)
    if seed % 5 == 0:
        k = np.where(rng.random(count) < 0.4, 0, k)
    return np.rint(k).astype(np.int64)


CHANNELS = [_channel(seed) for seed in range(24)]


def _dense(symbols: np.ndarray) -> np.ndarray:
    return np.bincount(symbols - symbols.min(), minlength=2)


@pytest.fixture(scope="module")
def interpreted():
    """The loops as Python runs them where numba is absent."""
    spec = importlib.util.spec_from_file_location("interpreted", fit_kernels.__file__)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "numba", None)
        spec.loader.exec_module(module)
    assert not module.NUMBA
    return module


def test_fits_are_the_same_without_numba(interpreted):
    for symbols in CHANNELS[::2]:
        dense = _dense(symbols)
        np.testing.assert_equal(fit_kernels.gauss(dense), interpreted.gauss(dense))
        np.testing.assert_equal(fit_kernels.mixture(dense, 5), interpreted.mixture(dense, 5))


def test_bytes_are_the_same_without_numba(interpreted, monkeypatch):
    channels = [symbols.astype(np.int32) for symbols in CHANNELS]
    found = coded(channels, effort=3)
    monkeypatch.setattr(fitting, "loops", lambda: interpreted)
    assert coded(channels, effort=3) == found


def test_a_gaussian_is_as_cheap_as_its_neighbours():
    """Within an eighth of a bit, at which the descent ends, in steps of an eighth octave and an eighth deviation."""
    narrow = [dense for dense in map(_dense, CHANNELS) if len(dense) <= 256]  # others are fitted on coarser counts
    assert len(narrow) > 9
    for dense in narrow:
        mu8, si, _, _ = fit_kernels.gauss(dense)

        def cost(mu8, si, dense=dense):
            cdf = np.empty(len(dense) - 1, np.int64)
            fit_kernels._cdf28(mu8, si, cdf)
            return int(fit_kernels._table_cost(cdf, dense))

        move = max(1, round(2 ** (si / 64) * 32))
        least = min(cost(mu8 + a * move, si + 8 * b) for a in (-1, 0, 1) for b in (-1, 0, 1))
        assert cost(mu8, si) <= least + BIT // 8


def test_costs_under_a_prior_are_those_it_was_chosen_by():
    histograms = [histogram(symbols) for symbols in CHANNELS]
    priors = [fit_best(h, 5) for h in histograms]
    matrix = fitting.costs_of(histograms, priors)
    np.testing.assert_array_equal(np.diag(matrix), [p.own for p in priors])


@pytest.mark.parametrize("number", [100, 128, 129])
@pytest.mark.parametrize("value", [-1, -64, -65, 2, 65, 66])
def test_the_cost_of_exceptions_is_that_of_their_bytes(number, value):
    """At the numbers and distances from the window 0..1 at which a varint takes one byte more; the gaps take one."""
    inside = np.arange(2000) % 2
    known, symbols = fit_best(histogram(inside), 5), inside.copy()
    symbols[: 10 * number : 10] = value
    out, (kept, exceptions) = bytearray(), channels._split(symbols, known.prior.window)
    channels._write_channel(out, known, exceptions, [known])
    cost = known.costs[kept].sum() + 8 * BIT * (len(out) - 1)  # without the token of the prior
    assert fitting.costs_of([histogram(symbols)], [known]) == cost


def test_channels_share_a_prior_only_if_that_saves_bits():
    costs = np.array([[10, 12, 90], [11, 10, 90], [80, 80, 10]], np.int64)
    assert fit_kernels.assign(costs, np.array([20, 20, 20])).tolist() == [0, 0, 2]
    assert fit_kernels.assign(costs, np.array([0, 0, 0])).tolist() == [0, 1, 2]


def test_pooled_histograms_count_all_symbols():
    for spread in (1, 1 << 20):
        parts = [symbols * spread for symbols in CHANNELS[:4]]
        pooled = pool([histogram(part) for part in parts])
        values, counts = np.unique(np.concatenate(parts), return_counts=True)
        np.testing.assert_array_equal(pooled.values, values)
        np.testing.assert_array_equal(pooled.counts, counts)


# -- R(a) --------------------------------------------------------------------------------------------------------------


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
@given(st.lists(st.integers(-200, 200) | st.integers(-(2**24), 2**24), min_size=1, max_size=30))
def test_agrees_with_mpmath(symbols):
    rate = histogram(np.array(symbols, dtype=np.int32)).rate_bits
    assert rate == pytest.approx(exact_bits(symbols), rel=1e-8, abs=1e-8)


def test_known_values():
    assert histogram(np.full(100, 7, np.int32)).rate_bits == 0  # sigma is floored, the whole mass is in the interval
    rare = np.zeros(100_000, np.int32)
    rare[0] = 1000
    zero = math.log2(math.erf(0.5 / (math.sqrt(2) * rare.std())))
    assert histogram(rare).rate_bits == pytest.approx(-math.log2(1e-6) - 99_999 * zero, rel=1e-3)
