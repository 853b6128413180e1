"""The compiled loops of the encoder against their reference in numpy: the same integers, and the same files."""

import numpy as np
import pytest

from pd4dgs_codec.entropy import fit_reference, fitting, sharing
from pd4dgs_codec.entropy.bits import BIT, entropy_bits, frequency_costs, gaussian_bits
from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.entropy.fitting import fit_best, histogram, pool
from pd4dgs_codec.entropy.tables import TOTAL


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


@pytest.fixture
def kernels():
    pytest.importorskip("numba")
    from pd4dgs_codec.entropy import fit_kernels

    return fit_kernels


def _assert_same(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_costs_of_frequencies_are_their_logarithms():
    frequencies = np.unique(np.concatenate([np.arange(1, 5000), np.geomspace(1, TOTAL, 5000).astype(np.int64)]))
    assert np.abs(frequency_costs(frequencies) / BIT - (24 - np.log2(frequencies))).max() < 2e-6
    assert frequency_costs(np.array([1, 1 << 12, TOTAL])).tolist() == [24 * BIT, 12 * BIT, 0]


def test_fits_are_the_same(kernels):
    for symbols in CHANNELS:
        dense = _dense(symbols)
        _assert_same(kernels.gauss(dense), fit_reference.gauss(dense))
        _assert_same(kernels.mixture(dense, 5), fit_reference.mixture(dense, 5))
        found, expected = kernels.classes(dense), fit_reference.classes(dense)
        _assert_same(found[:7], expected[:7])
        if found[0] >= 0:
            _assert_same(found[7:], expected[7:])


def test_plans_are_the_same(kernels):
    histograms = [histogram(symbols) for symbols in CHANNELS]
    ends = np.cumsum([len(h.values) for h in histograms])
    values = np.concatenate([h.values for h in histograms])
    counts = np.concatenate([h.counts for h in histograms])
    priors = [fit_best(h, 5) for h in histograms]
    windows, at = [], 0
    for fitted in priors:
        window = fitted.prior.window
        windows.append((window.kmin, window.n, window.shift, at))
        at += window.n
    arguments = values, counts, ends, np.array(windows), np.concatenate([p.costs for p in priors])
    matrix = fit_reference.cost_matrix(*arguments)
    np.testing.assert_array_equal(kernels.cost_matrix(*arguments), matrix)
    np.testing.assert_array_equal(np.diag(matrix), [p.own for p in priors])
    prices = np.array([p.price for p in priors])
    _assert_same(kernels.assign(matrix, prices), fit_reference.assign(matrix, prices))


def test_costs_of_classes_are_the_same(kernels):
    rng = np.random.default_rng(0)
    for spread, count in ((1, 1), (3, 5), (1 << 20, 3)):
        channels = (rng.integers(-9, 9, (4, 700)) * spread).astype(np.int32)  # as in files: nothing else is compiled
        classes = rng.integers(0, count, 700)
        expected = sum(entropy_bits(channel[classes == k]) for channel in channels for k in range(count))
        cost = fit_reference.split_cost(channels, classes, count)
        assert kernels.split_cost(channels, classes, count) == cost
        assert cost / BIT == pytest.approx(expected, rel=1e-6)


def test_rates_are_the_same(kernels):
    for symbols in CHANNELS:
        h = histogram(symbols)
        assert kernels.gaussian_bits(h.values, h.counts) == pytest.approx(gaussian_bits(symbols), rel=1e-12)


def test_payloads_are_the_same_without_numba(kernels, monkeypatch):
    channels = [symbols.astype(np.int32) for symbols in CHANNELS]
    monkeypatch.setattr(fitting, "loops", lambda: kernels)
    monkeypatch.setattr(sharing, "loops", lambda: kernels)
    payload = encode_channels(channels).payload
    monkeypatch.setattr(fitting, "loops", lambda: fit_reference)
    monkeypatch.setattr(sharing, "loops", lambda: fit_reference)
    assert encode_channels(channels).payload == payload


def test_pooled_histograms_count_all_symbols():
    for spread in (1, 1 << 20):
        parts = [symbols * spread for symbols in CHANNELS[:4]]
        pooled = pool([histogram(part) for part in parts])
        values, counts = np.unique(np.concatenate(parts), return_counts=True)
        np.testing.assert_array_equal(pooled.values, values)
        np.testing.assert_array_equal(pooled.counts, counts)
