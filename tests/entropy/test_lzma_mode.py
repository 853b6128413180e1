"""The LZMA mode: round trips, the choice of settings, bounded decompression."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_symbols

from pd4dgs_codec.entropy import lzma_mode
from pd4dgs_codec.entropy.lzma_mode import decode_channels_lzma, encode_channels_lzma
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed

bounded = st.integers(-100, 100) | st.integers(900, 1100) | st.integers(-K_MAX, K_MAX)


@settings(max_examples=40)
@given(st.lists(st.lists(bounded, max_size=30), max_size=5), st.sampled_from([1, 5, 9]))
def test_symbols_round_trip(lists, effort):
    channels = [np.array(values, dtype=np.int32) for values in lists]
    codes, stream = encode_channels_lzma(channels, effort=effort)
    assert_same_symbols(decode_channels_lzma(codes, stream, [len(c) for c in channels]), channels)
    assert bool(codes) == bool(stream) == any(lists)


def test_more_effort_is_not_larger_here():
    rng = np.random.default_rng(1)
    channels = [np.rint(rng.normal(0, s, 3000)).astype(np.int32) for s in (0.5, 3, 400, 90_000)]
    sizes = [sum(map(len, encode_channels_lzma(channels, effort=e))) for e in (1, 5, 9)]
    assert sizes[2] <= sizes[1] < sizes[0]


def test_never_inflates_beyond_the_declared_counts():
    codes, bomb = encode_channels_lzma([np.zeros(4_000_000, np.int32)], effort=1)
    assert len(bomb) < 2000
    for count in (0, 100, 4_000_001):
        with pytest.raises(Malformed):
            decode_channels_lzma(codes[: bool(count)], bomb, [count])
    wide = encode_channels_lzma([np.array([-K_MAX, K_MAX], np.int32)] * 9, effort=1)
    with pytest.raises(LimitExceeded, match="bytes uncompressed, limit"):
        decode_channels_lzma(*wide, [1 << 26] * 9)


def test_codes_end_with_the_last_channel():
    codes, stream = encode_channels_lzma([np.arange(5, dtype=np.int32)])
    for fault in (codes + b"\0", codes[:-1], b"\x03"):
        with pytest.raises(Malformed):
            decode_channels_lzma(fault, stream, [5])


def test_long_data_is_sampled_to_choose_settings():
    rng = np.random.default_rng(3)
    channel = np.cumsum(rng.integers(-3, 4, 300_000)).astype(np.int32)
    sizes = {}
    for effort in (1, 4):
        codes, stream = encode_channels_lzma([channel], effort=effort)
        np.testing.assert_array_equal(decode_channels_lzma(codes, stream, [channel.size])[0], channel)
        sizes[effort] = len(stream)
    assert sizes[4] < sizes[1]


def test_the_encoder_refuses_what_it_cannot_write(monkeypatch):
    with pytest.raises(EncodeError, match="effort is 10"):
        encode_channels_lzma([np.zeros(1, np.int32)], effort=10)
    monkeypatch.setattr(lzma_mode, "MAX_RAW", 11)
    with pytest.raises(EncodeError, match="12 bytes uncompressed, limit 11"):
        encode_channels_lzma([np.zeros(12, np.int32)])
