"""The ANS stream against an independent decoder, and its guards."""

import numpy as np
import pytest
import refdec
from hypothesis import given
from hypothesis import strategies as st
from strategies import norm_table

from pd4dgs_codec.entropy.ans import MAX_COUNT, TOTAL, AnsDecoder, ans_encode, model_of, models_of_each
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed


def even(n: int) -> np.ndarray:
    """The table of n symbols of about equal frequency."""
    return np.arange(n + 1) * TOTAL // n


tables = st.one_of(
    st.builds(norm_table, st.integers(1, 40), st.integers(-9, 9000), st.integers(-640, 640)),
    st.lists(st.integers(1, TOTAL - 1), max_size=30, unique=True).map(lambda ends: np.array([0, *sorted(ends), TOTAL])),
    st.integers(0, 10).map(lambda bits: even(1 << bits)),
)


@st.composite
def coded_channels(draw):
    cums = draw(st.lists(tables, max_size=5))
    channels = [np.array(draw(st.lists(st.integers(0, len(cum) - 2), max_size=40)), dtype=np.int32) for cum in cums]
    return channels, cums


@given(coded_channels())
def test_round_trip_by_both_decoders(case):
    channels, cums = case
    data = ans_encode(channels, cums)
    decoder, reference = AnsDecoder(data), refdec.Ans(data)
    for channel, cum in zip(channels, cums, strict=True):
        taken = decoder.take(len(channel), model_of(cum))
        assert taken.dtype == np.int32 and np.array_equal(taken, channel)
        assert reference.take(len(channel), cum.tolist()) == channel.tolist()
    decoder.finish()
    reference.finish()


def test_first_symbols_at_the_end_take_no_bytes():
    """So no decoder can tell that symbols are missing there (annex C of the format)."""
    cum = norm_table(9, 1000, 64)
    few, more = np.array([3, 8, 1], np.int32), np.array([3, 8, 1, 0, 0, 0], np.int32)
    data = ans_encode([few], [cum])
    assert data == ans_encode([more], [cum])
    decoder = AnsDecoder(data)
    assert decoder.take(6, model_of(cum)).tolist() == more.tolist()
    decoder.finish()
    decoder = AnsDecoder(data)
    decoder.take(2, model_of(cum))
    with pytest.raises(Malformed, match="state 0"):
        decoder.finish()


@pytest.mark.parametrize(
    "symbols, cum",
    [
        ([3], even(2)),
        ([-1], even(2)),
        ([0], np.array([0, 5, 5, 2**24])),
        ([0], np.array([1, 5, 2**24])),
        ([0], np.array([0, 5, 2**24 - 1])),
        ([0.5], even(2)),
        ([[0, 1]], even(2)),
        ([0], np.array([0])),
    ],
)
def test_the_encoder_refuses_what_would_panic(symbols, cum):
    with pytest.raises((EncodeError, Malformed)):
        ans_encode([np.array(symbols)], [cum])


@pytest.mark.parametrize("count", [-1, MAX_COUNT + 1, 10**11])
def test_the_decoder_refuses_counts_that_would_abort(count):
    with pytest.raises(LimitExceeded):
        AnsDecoder(b"\1\0\0\0").take(count, model_of(even(16)))


@pytest.mark.parametrize("table", [[0, 7, 7, 2**24], [1, 7, 2**24], [0, 7, 2**24 - 1], [0, 9, 8, 2**24]])
def test_the_decoder_refuses_a_bad_table(table):
    with pytest.raises(Malformed):
        model_of(np.array(table))
    good = [0, 5, 2**24]
    with pytest.raises(Malformed):  # among others
        models_of_each(np.array([*good, *table, *good]), np.array([2, len(table) - 1, 2]))


@given(st.lists(tables, max_size=6), st.binary(min_size=4, max_size=80).filter(lambda data: any(data[:4])))
def test_models_made_together_decode_as_those_made_alone(cums, data):
    data = data[: len(data) // 4 * 4]
    together = models_of_each(np.concatenate([*cums, np.zeros(0, np.int64)]), np.array([len(c) - 1 for c in cums], int))
    one, other = AnsDecoder(data), AnsDecoder(data)
    for cum, model in zip(cums, together, strict=True):
        np.testing.assert_array_equal(one.take(9, model), other.take(9, model_of(cum)))
