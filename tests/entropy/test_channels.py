"""Channels <-> codes and stream: round trips, size against the model rate, and bounds of tables."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_symbols, coded, decoded

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, split
from pd4dgs_codec.entropy.priors import FREE_ENTRIES, K_MAX, MAX_WINDOW
from pd4dgs_codec.entropy.varint import put_varint
from pd4dgs_codec.errors import EncodeError, LimitExceeded

symbol = st.integers(-3, 3) | st.integers(-100, 100) | st.integers(-K_MAX, K_MAX) | st.sampled_from([-K_MAX, K_MAX])


@st.composite
def channel(draw):
    """Empty, constant, two-valued, anything, or a bell with heavy tails and outliers."""
    kind = draw(st.sampled_from(["list", "const", "two", "tails"]))
    if kind == "list":
        return np.array(draw(st.lists(symbol, max_size=40)), dtype=np.int32)
    size, rng = draw(st.integers(1, 600)), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if kind == "tails":
        scale = 2.0 ** draw(st.integers(-3, 20))
        return np.clip(np.rint(rng.standard_t(1.1, size) * scale), -K_MAX, K_MAX).astype(np.int32)
    values = [draw(symbol)] if kind == "const" else [draw(symbol), draw(symbol)]
    return rng.choice(np.array(values, dtype=np.int32), size, p=[1.0] if kind == "const" else [0.93, 0.07])


def families(known):
    return {fitted.prior.family for fitted in known}


@settings(max_examples=25)
@given(st.lists(channel(), max_size=5), st.sampled_from([1, 4, 9]))
def test_round_trip_and_best_is_never_a_word_larger(channels, effort):
    counts, sizes = [len(c) for c in channels], []
    for priors in ("gauss", "best"):
        codes, stream = coded(channels, known=(known := []), priors=priors, effort=effort)
        assert_same_symbols(decoded(codes, stream, counts), channels)
        assert priors == "best" or families(known) <= {0, 1}
        sizes.append(len(codes) + len(stream))
    assert sizes[1] < sizes[0] + 4  # it costs fewer bits, but the stream has whole words of four bytes


def gaussian_channels(rows=15_000, channels=68):
    rng = np.random.default_rng(0)
    sigmas = 2.0 ** rng.uniform(math.log2(0.3), math.log2(20), channels)
    return [np.rint(rng.normal(rng.uniform(-3, 3), s, rows)).astype(np.int32) for s in sigmas]


def mixed_channels(rows=15_000, channels=24):
    rng, out = np.random.default_rng(1), []
    for index, s in enumerate(2.0 ** rng.uniform(-1, 4, channels)):
        x = [
            rng.normal(0, s, rows),
            rng.laplace(0, s, rows),
            np.where(rng.random(rows) < 0.7, rng.normal(0, 0.3 * s, rows), rng.normal(0, 2 * s, rows)),
            rng.choice([-1, 1], rows) * 2 * s + rng.normal(0, s / 2, rows),
        ][index % 4]
        out.append(np.rint(x).astype(np.int32))
    return out


def bits_of(channels):
    writer = ChannelWriter()
    writer.write(channels)
    return writer.finish()[2][0]


def test_gaussian_data_costs_its_model_rate():
    writer, channels = ChannelWriter("gauss"), gaussian_channels()
    rate_bits = writer.write(channels)
    codes, stream, (bits,) = writer.finish()
    assert 0.99 < bits / rate_bits <= 1.002
    assert 0 <= 8 * (len(codes) + len(stream)) - bits < 32
    assert_same_symbols(decoded(codes, stream, [len(c) for c in channels]), channels)


def test_mixed_data_costs_less_than_its_model_rate():
    writer = ChannelWriter(known=(known := []))
    rate_bits = writer.write(mixed_channels())
    assert writer.finish()[2][0] <= 0.96 * rate_bits
    assert 2 in families(known)


def test_small_similar_channels_share_a_prior():
    rng = np.random.default_rng(2)
    channels = [np.rint(rng.laplace(0, 1.5, 300)).astype(np.int32) for _ in range(40)]
    shared, alone = bits_of(channels), [bits_of([c]) for c in channels]
    assert shared < 0.98 * sum(alone)


def test_outliers_are_listed_rather_than_widening_the_table():
    rng = np.random.default_rng(3)
    plain = np.rint(rng.normal(0, 2, 4000)).astype(np.int32)
    wild = plain.copy()
    wild[[5, 2000, 3999]] = (-9_000_000, 4_000_000, 8_000_000)
    assert 0 < bits_of([wild]) - bits_of([plain]) <= 8 * 24


@pytest.mark.parametrize(
    "bad", [np.zeros(3), np.zeros((2, 2), np.int32), np.array([K_MAX + 1]), np.array([-K_MAX - 1]), np.array(["a"])]
)
def test_the_encoder_refuses(bad):
    with pytest.raises(EncodeError):
        coded([bad])
    for options in ({"priors": "laplace"}, {"effort": 0}, {"effort": 10}):
        with pytest.raises(EncodeError):
            ChannelWriter(**options)


def payload_of(*numbers: int) -> bytes:
    out = bytearray()
    for number in numbers:
        put_varint(out, number)
    return bytes(out)


def test_tables_of_a_layer_are_bounded():
    """Eight bytes define a table of 128 KiB; 86 kB of them once took 1.6 GB."""
    wide = payload_of(2, 0, MAX_WINDOW - 2, 0, 1280)
    most, known = FREE_ENTRIES // MAX_WINDOW, []
    codes = wide * most + payload_of(2, 0, most - 1, 0, 1280)
    assert ChannelReader(codes, b"", most + 1, known).read([1] * (most + 1)).size == most + 1
    with pytest.raises(LimitExceeded, match=f"tables of {FREE_ENTRIES + most + 3} entries in one layer"):
        ChannelReader(payload_of(2, 0, 0, 0, 1280), b"", most + 2, known).read([1])  # in a later slice


def test_wide_channels_share_a_table_rather_than_pass_the_limit():
    rng = np.random.default_rng(6)
    centres = rng.integers(-(2**23), 2**23, FREE_ENTRIES // MAX_WINDOW + 20)
    narrow = np.array([0, 1, 1, 2, 5], np.int32)
    channels = [narrow, *((c + rng.integers(-8000, 8000, 40)).astype(np.int32) for c in centres)]
    codes, stream = coded(channels, effort=1)
    assert_same_symbols(decoded(codes, stream, [len(c) for c in channels]), channels)


def test_all_batches_of_a_layer_keep_within_the_limit():
    """However many entries the batches and slices before have used."""
    rng = np.random.default_rng(7)
    batches = [[(rng.integers(-8000, 8000, 3)).astype(np.int32) for _ in range(30)] for _ in range(8)]
    known, read = [], []
    for later in (False, True):
        writer = ChannelWriter(effort=1, known=known)
        for batch in batches:
            writer.write(batch)
        codes, stream, bits = writer.finish()
        assert len(bits) == 8 and 0 <= 8 * (len(codes) + len(stream)) - sum(bits) < 32
        reader = ChannelReader(codes, stream, 8 * 90 * (1 + later), read)
        for batch in batches:
            assert_same_symbols(split(reader.read([3] * 30), [3] * 30), batch)
        reader.finish()
