"""Quantiser, masks and the attribute table; refusals and ends of ranges are rows of `tests/stability`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.format.quantise import MAX_SYMBOL, NO_CLASSES, Grid, dequantise, mask_codes, quantise
from pd4dgs_codec.scene import ATTRIBUTES, MAX_CLASS, Widths

steps = st.floats(2.0**-100, 2.0**90, width=32)


@given(st.lists(st.integers(-MAX_SYMBOL, MAX_SYMBOL), min_size=1, max_size=50), steps)
def test_symbols_survive_their_float32_values(ks, step):
    k = np.array(ks, np.int32)
    np.testing.assert_array_equal(quantise(dequantise(k, step), step), k)


@given(st.integers(-1000, 1000), steps)
def test_dequantise_is_one_rounding_of_the_exact_product(k, step):
    from fractions import Fraction

    exact = Fraction(k) * Fraction(step)
    got = dequantise(np.array([k], np.int32), step)[0]
    neighbours = [np.nextafter(got, np.float32(s)) for s in (-np.inf, np.inf)]
    assert all(abs(Fraction(float(got)) - exact) <= abs(Fraction(float(n)) - exact) for n in neighbours)


@given(st.lists(st.floats(0, 1, width=32), min_size=2))
def test_mask_codes_keep_order(values):
    codes = mask_codes(np.sort(np.array(values, np.float32)))
    assert (np.diff(codes.astype(int)) >= 0).all() and not ((codes > 0) & (codes < 3)).any()


@pytest.mark.parametrize("widths", [Widths(), Widths(1, 2), Widths(64, 16)])
def test_the_table_is_a_bijection_on_channels(widths):
    k = np.arange(widths.channels * 7, dtype=np.int32).reshape(widths.channels, 7)
    q = {"feature": 0.5, "scaling_log": 0.25, "offset": 2.0}
    grid = Grid(q, widths, np.zeros(widths.channels, np.int32))
    values = grid.dequantise(k, NO_CLASSES)
    shapes = {name: array.shape for name, array in values.items()}
    assert shapes == {"feature": (7, widths.feature), "scaling_log": (7, 6), "offset": (7, widths.slots, 3)}
    assert values["offset"][3, 1, 2] == 2.0 * k[widths.feature + 6 + 3 * 1 + 2, 3]
    np.testing.assert_array_equal(grid.quantise(values, NO_CLASSES), k)


@given(st.lists(st.integers(-MAX_SYMBOL, MAX_SYMBOL), min_size=1, max_size=20), steps, st.integers(0, 2**32 - 1))
def test_symbols_of_any_class_survive_their_float32_values(indices, step, seed):
    """k of m + k 2^c, with m and c such that it stays within the limit."""
    rng, widths = np.random.default_rng(seed), Widths(1, 1, graded=True)
    centre = rng.integers(-MAX_SYMBOL, MAX_SYMBOL + 1, widths.channels).astype(np.int32)
    classes = rng.integers(0, MAX_CLASS + 1, len(indices)).astype(np.int32)
    k = (np.array(indices)[None] - centre[:, None]) // (1 << classes.astype(np.int64))
    at = centre[:, None] + k * (1 << classes.astype(np.int64))
    k = np.where((np.abs(at) <= MAX_SYMBOL) & (np.abs(k) <= MAX_SYMBOL), k, 0).astype(np.int32)
    grid = Grid(dict.fromkeys(ATTRIBUTES, step), widths, centre)
    values = grid.dequantise(k, classes)
    np.testing.assert_array_equal(grid.quantise(values, classes), k)
    at = centre[0] + k[0].astype(np.int64) * 2 ** classes.astype(np.int64)
    expected = (at * np.float64(step)).astype(np.float32)
    np.testing.assert_array_equal(values["feature"][:, 0], expected)


def test_a_class_rounds_to_multiples_of_its_step_around_the_centre():
    grid = Grid(dict.fromkeys(ATTRIBUTES, 0.5), Widths(1, 1, graded=True), np.array([3, *[0] * 9], np.int32))
    values = {"feature": np.float32([[1.4], [1.4], [3.6]]), "scaling_log": np.zeros((3, 6), np.float32)}
    values["offset"] = np.zeros((3, 1, 3), np.float32)
    classes = np.array([0, 2, 2], np.int32)
    k = grid.quantise(values, classes)
    assert k[0].tolist() == [0, 0, 1]
    assert grid.dequantise(k, classes)["feature"][:, 0].tolist() == [1.5, 1.5, 3.5]
