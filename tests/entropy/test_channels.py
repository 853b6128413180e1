"""Channels <-> payload: round trips, size against the model rate, and bounds of tables."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_symbols

from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.priors import FREE_ENTRIES, K_MAX, MAX_WINDOW, Const, Gauss, Mixture
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


def prior_ids(known):
    return {fitted.prior.id for fitted in known}


@settings(max_examples=25)
@given(st.lists(channel(), max_size=5), st.sampled_from([1, 4, 9]))
def test_round_trip_and_best_is_never_a_word_larger(channels, effort):
    counts, sizes = [len(c) for c in channels], []
    for priors in ("gauss", "best"):
        coded = encode_channels(channels, priors=priors, effort=effort, known=(known := []))
        assert_same_symbols(decode_channels(coded.payload, counts), channels)
        assert coded.payload_bits == 8 * len(coded.payload)
        assert priors == "best" or prior_ids(known) <= {Const.id, Gauss.id}
        sizes.append(len(coded.payload))
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


def test_gaussian_data_costs_its_model_rate():
    channels = gaussian_channels()
    gauss = encode_channels(channels, priors="gauss")
    assert 0.99 < gauss.payload_bits / gauss.rate_bits <= 1.002
    assert_same_symbols(decode_channels(gauss.payload, [len(c) for c in channels]), channels)


def test_mixed_data_costs_less_than_its_model_rate():
    coded = encode_channels(mixed_channels(), known=(known := []))
    assert coded.payload_bits <= 0.96 * coded.rate_bits
    assert Mixture.id in prior_ids(known)


def test_small_similar_channels_share_a_prior():
    rng = np.random.default_rng(2)
    channels = [np.rint(rng.laplace(0, 1.5, 300)).astype(np.int32) for _ in range(40)]
    shared, alone = encode_channels(channels), [encode_channels([c]) for c in channels]
    apart = sum(c.payload_bits for c in alone) - 32 * len(channels)  # each has a stream of its own
    assert shared.payload_bits < 0.98 * apart


def test_outliers_are_listed_rather_than_widening_the_table():
    rng = np.random.default_rng(3)
    plain = np.rint(rng.normal(0, 2, 4000)).astype(np.int32)
    wild = plain.copy()
    wild[[5, 2000, 3999]] = (-9_000_000, 4_000_000, 8_000_000)
    extra = encode_channels([wild]).payload_bits - encode_channels([plain]).payload_bits
    assert 0 < extra <= 8 * 24


@pytest.mark.parametrize(
    "bad", [np.zeros(3), np.zeros((2, 2), np.int32), np.array([K_MAX + 1]), np.array([-K_MAX - 1]), np.array(["a"])]
)
def test_the_encoder_refuses(bad):
    with pytest.raises(EncodeError):
        encode_channels([bad])
    for options in ({"priors": "laplace"}, {"effort": 0}, {"effort": 10}):
        with pytest.raises(EncodeError):
            encode_channels([], **options)


def payload_of(*numbers: int) -> bytes:
    out = bytearray()
    for number in numbers:
        put_varint(out, number)
    return bytes(out)


def test_tables_of_a_section_are_bounded():
    """Eight bytes define a table of 128 KiB; a section of 86 kB once took 1.6 GB."""
    wide = payload_of(2, 0, MAX_WINDOW - 2, 0, 1280)
    most = FREE_ENTRIES // MAX_WINDOW
    assert len(decode_channels(wide * most, [1] * most)) == most
    with pytest.raises(LimitExceeded, match="entries"):
        decode_channels(wide * (most + 1), [1] * (most + 1))
    for count in (-1, (1 << 26) + 1, 10**11):
        with pytest.raises(LimitExceeded):
            decode_channels(b"\0\0", [count])


def test_wide_channels_share_a_table_rather_than_pass_the_limit():
    rng = np.random.default_rng(6)
    centres = rng.integers(-(2**23), 2**23, FREE_ENTRIES // MAX_WINDOW + 20)
    narrow = np.array([0, 1, 1, 2, 5], np.int32)
    channels = [narrow, *((c + rng.integers(-8000, 8000, 40)).astype(np.int32) for c in centres)]
    coded = encode_channels(channels, effort=1)
    assert_same_symbols(decode_channels(coded.payload, [len(c) for c in channels]), channels)
