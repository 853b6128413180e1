"""Quantiser, masks and the table of rows; refusals and ends of ranges are rows of `pd4dgs-bench stability`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.format.quantise import MAX_SYMBOL, NO_CLASSES, Rows, RowTable, dequantise, mask_codes, quantise
from pd4dgs_codec.scene import MAX_CLASS

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


def table(*channels, step=0.5, centre=None):
    """Tensors of these channels with steps that double from one to the next."""
    rows = tuple(Rows(3 * i, c, step * 2**i) for i, c in enumerate(channels))
    return RowTable(rows, None if centre is None else np.array(centre, np.int32))


@pytest.mark.parametrize("channels", [(32, 6, 30), (1,), (1, 256, 2)])
def test_the_table_is_a_bijection_on_channels(channels):
    rows = table(*channels)
    k = np.arange(rows.channels * 7, dtype=np.int32).reshape(rows.channels, 7)
    values = rows.dequantise(k, NO_CLASSES)
    assert [x.shape for x in values] == [(7, c) for c in channels]
    assert values[-1][3, -1] == 0.5 * 2 ** (len(channels) - 1) * k[-1, 3]
    np.testing.assert_array_equal(rows.quantise(values, NO_CLASSES, channels), k)


@given(st.lists(st.integers(-MAX_SYMBOL, MAX_SYMBOL), min_size=1, max_size=20), steps, st.integers(0, 2**32 - 1))
def test_symbols_of_any_class_survive_their_float32_values(indices, step, seed):
    """k of m + k 2^c, with m and c such that it stays within the limit."""
    rng = np.random.default_rng(seed)
    centre = rng.integers(-MAX_SYMBOL, MAX_SYMBOL + 1, 10).astype(np.int32)
    classes = rng.integers(0, MAX_CLASS + 1, len(indices)).astype(np.int32)
    k = (np.array(indices)[None] - centre[:, None]) // (1 << classes.astype(np.int64))
    at = centre[:, None] + k * (1 << classes.astype(np.int64))
    k = np.where((np.abs(at) <= MAX_SYMBOL) & (np.abs(k) <= MAX_SYMBOL), k, 0).astype(np.int32)
    rows = table(10, step=step, centre=centre)
    values = rows.dequantise(k, classes)
    np.testing.assert_array_equal(rows.quantise(values, classes, ["rows"]), k)
    at = centre[0] + k[0].astype(np.int64) * 2 ** classes.astype(np.int64)
    expected = (at * np.float64(step)).astype(np.float32)
    np.testing.assert_array_equal(values[0][:, 0], expected)


def test_a_class_rounds_to_multiples_of_its_step_around_the_centre():
    rows, classes = table(1, centre=[3]), np.array([0, 2, 2], np.int32)
    k = rows.quantise([np.float32([[1.4], [1.4], [3.6]])], classes, ["rows"])
    assert k[0].tolist() == [0, 0, 1]
    assert rows.dequantise(k, classes)[0][:, 0].tolist() == [1.5, 1.5, 3.5]
