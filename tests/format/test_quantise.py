"""Quantiser, masks and the table of rows; refusals and ends of ranges are rows of `tests/stability`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.scene import MAX_CLASS
from pd4dgs_codec.tensors.quantise import (
    MAX_SYMBOL,
    NO_CLASSES,
    WHOLE,
    Rows,
    RowTable,
    dequantise,
    mask_codes,
    quantise,
)

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
    values = rows.dequantise(k)
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
    values = rows.dequantise(rows.values(k, classes))
    np.testing.assert_array_equal(rows.symbols(rows.quantise(values, classes, ["rows"]), classes), k)
    at = centre[0] + k[0].astype(np.int64) * 2 ** classes.astype(np.int64)
    expected = (at * np.float64(step)).astype(np.float32)
    np.testing.assert_array_equal(values[0][:, 0], expected)


def test_a_class_rounds_to_multiples_of_its_step_around_the_centre():
    rows, classes = table(1, centre=[3]), np.array([0, 2, 2], np.int32)
    v = rows.quantise([np.float32([[1.4], [1.4], [3.6]])], classes, ["rows"])
    assert rows.symbols(v, classes)[0].tolist() == [0, 0, 1]
    assert rows.dequantise(v)[0][:, 0].tolist() == [1.5, 1.5, 3.5]


# -- the predictor of rows ---------------------------------------------------------------------------------------------


def predicted(k, classes, m):
    """Clause 11.2, in Python integers."""
    last, v = [m] * 7, []
    for symbol, c in zip(k, classes, strict=True):
        v.append(last[c] + (symbol << c))
        last[c:] = [v[-1]] * (7 - c)
    return v


@given(st.lists(st.tuples(st.integers(-1000, 1000), st.integers(0, MAX_CLASS)), max_size=30), st.integers(-9, 9))
def test_a_row_is_predicted_by_the_last_one_of_its_class_or_a_finer_one(pairs, m):
    k, classes = np.array(pairs, np.int32).reshape(-1, 2).T
    rows = RowTable((Rows(0, 2, 1.0, 1), Rows(1, 1, 1.0)), np.array([m, 0, m], np.int32))
    symbols = np.stack([k, -k, k])
    v = rows.values(symbols, classes)
    assert v[0].tolist() == predicted(k.tolist(), classes.tolist(), m)
    assert v[1].tolist() == predicted((-k).tolist(), classes.tolist(), 0)
    assert v[2].tolist() == [m + (symbol << c) for symbol, c in zip(k.tolist(), classes.tolist(), strict=True)]
    np.testing.assert_array_equal(rows.symbols(v, classes), symbols)


def test_without_classes_rows_are_running_sums():
    rows = RowTable((Rows(0, 1, 1.0, 1),))
    v = rows.values(np.array([[3, -1, 0, 7]], np.int32), NO_CLASSES)
    assert v.tolist() == [[3, 2, 2, 9]] and rows.symbols(v, NO_CLASSES).tolist() == [[3, -1, 0, 7]]
    with pytest.raises(Malformed, match="a value of a row more than 8388608 steps"):
        rows.values(np.array([[MAX_SYMBOL, 1]], np.int32), NO_CLASSES)


def test_values_between_the_steps_of_their_class_have_no_symbols():
    for predictor in (0, 1):
        rows = RowTable((Rows(4, 1, 1.0, predictor),), np.zeros(1, np.int32))
        with pytest.raises(EncodeError, match="rows 4: values between the steps"):
            rows.symbols(np.array([[1, 2]], np.int32), np.array([0, 2], np.int32))


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(0, 6)), max_size=20))
def test_classes_do_not_concern_labels(pairs):
    k, classes = np.array(pairs, np.int32).reshape(-1, 2).T
    table = RowTable((Rows(5, 1, 1.0, WHOLE),), np.zeros(1, np.int32))
    v = table.values(k[None], classes)
    np.testing.assert_array_equal(v[0], np.cumsum(k))
    np.testing.assert_array_equal(table.symbols(v, classes), k[None])
