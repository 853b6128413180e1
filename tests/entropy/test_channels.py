"""Channels <-> payload: round trips, size against the model rate, and damaged payloads."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import norm_table

from pd4dgs_codec.entropy import channels as coding
from pd4dgs_codec.entropy import priors as registry
from pd4dgs_codec.entropy.ans import ans_encode, model_of
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.priors import (
    CONST,
    FREE_ENTRIES,
    GAUSS,
    GMM2,
    HIST,
    K_MAX,
    MAX_WINDOW,
    Gauss,
    Normal,
    Window,
)
from pd4dgs_codec.entropy.tables import uniform_table
from pd4dgs_codec.entropy.varint import put_varint
from pd4dgs_codec.errors import DecodeError, EncodeError, LimitExceeded, Malformed, UnsupportedFeature

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


def assert_same(decoded, channels):
    assert len(decoded) == len(channels)
    for a, b in zip(decoded, channels, strict=True):
        assert a.dtype == np.int32 and np.array_equal(a, b)


def prior_ids(coded):
    return {fitted.prior.id for fitted in coded.defined}


@settings(max_examples=25)
@given(st.lists(channel(), max_size=5), st.sampled_from([1, 4, 9]))
def test_round_trip_and_best_is_never_larger(channels, effort):
    counts, sizes = [len(c) for c in channels], []
    for priors in ("gauss", "best"):
        coded = encode_channels(channels, priors=priors, effort=effort)
        assert_same(decode_channels(coded.payload, counts), channels)
        assert coded.payload_bits == 8 * len(coded.payload)
        assert priors == "best" or prior_ids(coded) <= {CONST, GAUSS}
        sizes.append(len(coded.payload))
    assert sizes[1] <= sizes[0]


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
    assert_same(decode_channels(gauss.payload, [len(c) for c in channels]), channels)


def test_mixed_data_costs_less_than_its_model_rate():
    coded = encode_channels(mixed_channels())
    assert coded.payload_bits <= 0.96 * coded.rate_bits
    assert {GMM2, HIST} <= prior_ids(coded)


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


def small_case():
    """A payload with every prior, a shared one, a scaled one and exceptions."""
    rng = np.random.default_rng(4)
    spiky = np.array([0, 3, 4, 9, 20], np.int32)[rng.integers(0, 5, 900)]
    tails = np.where(rng.random(1500) < 0.8, rng.normal(0, 0.6, 1500), rng.normal(0, 30, 1500))
    wide = np.rint(rng.normal(0, 40_000, 200)).astype(np.int32)
    listed = np.rint(rng.normal(0, 1, 500)).astype(np.int32)
    listed[[3, 77]] = (5_000_000, -123_456)
    bell = np.rint(rng.normal(2, 1, 200)).astype(np.int32)
    const = np.full(10, -4, np.int32)
    return [spiky, np.rint(tails).astype(np.int32), wide, listed, bell, bell[::-1].copy(), const, const[:0]]


def test_every_cut_and_every_flip_gives_our_errors_only():
    channels = small_case()
    coded = encode_channels(channels)
    assert prior_ids(coded) == {CONST, GAUSS, GMM2, HIST}
    counts, payload, survived = [len(c) for c in channels], coded.payload, 0
    for size in range(len(payload)):
        try:
            decoded = decode_channels(payload[:size], counts)
        except (Malformed, LimitExceeded):
            continue
        survived += 1
        assert not all(np.array_equal(a, b) for a, b in zip(decoded, channels, strict=True))
    # State 0 decodes first symbols for ever, so a cut can end in it by chance. A chunk's length and CRC-32 tell.
    assert survived <= len(payload) // 400
    with pytest.raises(Malformed):
        decode_channels(payload + b"\1\0\0\0", counts)
    rng = np.random.default_rng(5)
    head, unchanged = range(8 * 120), 0
    for bit in [*head, *rng.integers(8 * 120, 8 * len(payload), 200).tolist()]:
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << (bit % 8)
        try:
            decoded = decode_channels(bytes(damaged), counts)
        except DecodeError:
            continue
        assert [len(d) for d in decoded] == counts and all(np.abs(d).max(initial=0) <= K_MAX for d in decoded)
        unchanged += all(np.array_equal(a, b) for a, b in zip(decoded, channels, strict=True))
    assert unchanged <= 4  # such as the class step of a histogram whose classes are all 0 or 1


@settings(max_examples=300)
@given(st.binary(max_size=60), st.lists(st.integers(0, 50), max_size=4))
def test_junk_gives_our_errors_only(payload, counts):
    try:
        decoded = decode_channels(payload, counts)
    except DecodeError:
        return
    assert [len(d) for d in decoded] == counts


def payload_of(*numbers: int) -> bytes:
    out = bytearray()
    for number in numbers:
        put_varint(out, number)
    return bytes(out)


@pytest.mark.parametrize(
    "payload, error",
    [
        (payload_of(2 * 7, 0), UnsupportedFeature),  # a prior id outside the registry
        (payload_of(2 * 8), Malformed),  # reuse before the first prior
        (payload_of(2 * 4, 0, 1), Malformed),  # scaled by nothing
        (payload_of(2 * 4, 1, 0), Malformed),  # a scaled constant
        (payload_of(2 * 4, 13, 1), LimitExceeded),  # too large a shift
        (payload_of(2, 2 * K_MAX, 0, 0, 0), Malformed),  # a window past the last symbol
        (payload_of(2, 0, (1 << 14) - 1, 0, 0), LimitExceeded),  # a window too wide
        (payload_of(2, 0, 0, 0, 3842), LimitExceeded),  # sigma out of range
        (payload_of(2 * 2, 0, 0, 0, 0, 0, 0, 0), Malformed),  # a mixture without its second part
        (payload_of(2 * 3, 0, 0, 0, 0), Malformed),  # a histogram without classes
        (payload_of(1, 0, 9, 0, 0), Malformed),  # more exceptions than symbols
        (payload_of(1, 0, 0, 7, 0), Malformed),  # an exception after the last symbol
        (payload_of(1, 0, 0, 0, 2 * K_MAX), Malformed),  # an exception past the last symbol value
        (b"\x80\x00\x00", Malformed),  # a varint that is not in its shortest form
        (b"\x80\x80\x80\x80\x80\x00", Malformed),  # and one without an end
    ],
)
def test_bad_parameters_are_named(payload, error):
    with pytest.raises(error):
        decode_channels(payload, [5])


def test_tables_of_a_section_are_bounded():
    """Eight bytes define a table of 128 KiB: 86 kB of them took 1.6 GB."""
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
    assert_same(decode_channels(coded.payload, [len(c) for c in channels]), channels)


def test_low_bits_past_the_last_symbol_are_malformed():
    """A window may end above the largest symbol; what is coded there may not."""
    top = K_MAX - 1
    head = payload_of(2 * 4) + bytes((2, 1)) + payload_of(2 * (top - 4), 0, 0, 1280)
    symbols = [np.array([1]), np.array([3])]
    words = ans_encode(symbols, [norm_table(2, 128, 0, 1), uniform_table(2)])
    with pytest.raises(Malformed, match=f"symbol {K_MAX + 2}, limit {K_MAX}"):
        decode_channels(head + words, [1])
    words = ans_encode([symbols[0], np.array([1])], [norm_table(2, 128, 0, 1), uniform_table(2)])
    assert decode_channels(head + words, [1])[0].tolist() == [K_MAX]


@dataclass(frozen=True, eq=False)
class Flat:
    """A family of a later version: a window and nothing else."""

    id: ClassVar[int] = 7
    window: Window

    @property
    def cum(self):
        return uniform_table((self.window.n - 1).bit_length())

    @property
    def model(self):
        return model_of(self.cum)

    def write(self, out):
        self.window.write(out)

    @classmethod
    def read(cls, reader, shift):
        return cls(Window.read(reader, shift))


def test_a_further_family_is_one_class_in_the_registry(monkeypatch):
    """Between Gaussians, whose tables are made together."""
    rng = np.random.default_rng(0)
    channels = [rng.integers(-8, 8, 50).astype(np.int32) for _ in range(3)]
    gauss = Gauss(Window(-8, 16), Normal(2048, 100), 1)
    plan = [Fitted(prior, np.zeros(16, np.int64), 0, 0) for prior in (gauss, Flat(Window(-8, 16)), replace(gauss))]
    monkeypatch.setattr(coding, "plan_priors", lambda *_: plan)
    payload = encode_channels(channels, priors="gauss").payload
    with pytest.raises(UnsupportedFeature, match="prior 7"):
        decode_channels(payload, [50] * 3)
    monkeypatch.setitem(registry._FAMILIES, Flat.id, Flat)
    assert_same(decode_channels(payload, [50] * 3), channels)
