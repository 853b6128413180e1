"""The attributes section: both forms give back the symbols; prediction pays where channels depend on each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.attributes.table import N_CHANNELS
from pd4dgs_codec.codec.attribute_section import read_attributes, write_attributes
from pd4dgs_codec.codec.stages import PLAIN, STAGED
from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.errors import DecodeError


def correlated(rows: int, seed: int = 0) -> np.ndarray:
    """Features mixed from a few sources, and offsets that are all zero for half of the Gaussians."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(38, 6)) @ rng.normal(size=(6, rows)) * 6 + rng.normal(size=(38, rows))
    alive = rng.random((10, 1, rows)) < 0.5
    offsets = (alive * rng.normal(size=(10, 3, rows)) * 8).reshape(30, rows)
    return np.rint(np.concatenate([mixed, offsets])).astype(np.int32)


def test_dependent_channels_are_predicted_and_come_back():
    attributes = correlated(1500)
    data, rate = write_attributes(attributes, "best", 5)
    assert data[0] == STAGED
    plain = encode_channels(list(attributes))
    assert len(data) < 0.75 * len(plain.payload)
    assert rate == plain.rate_bits
    np.testing.assert_array_equal(read_attributes(data, 1500), attributes)


def test_the_rate_model_forbids_prediction():
    data, _ = write_attributes(correlated(800), "gauss", 5)
    assert data[0] == PLAIN


def test_independent_channels_stay_plain():
    attributes = np.random.default_rng(1).integers(-9, 10, (N_CHANNELS, 300)).astype(np.int32)
    data, _ = write_attributes(attributes, "best", 5)
    assert data[0] == PLAIN
    np.testing.assert_array_equal(read_attributes(data, 300), attributes)


@settings(max_examples=15)
@given(st.integers(1, 60), st.integers(0, 1000), st.sampled_from((1, 50, 1 << 23)))
def test_any_symbols_come_back(rows, seed, scale):
    rng = np.random.default_rng(seed)
    attributes = np.clip(np.rint(rng.standard_t(2, (N_CHANNELS, rows)) * scale), -(1 << 23), 1 << 23).astype(np.int32)
    attributes[rng.random(N_CHANNELS) < 0.3] = int(rng.integers(-5, 5))
    data, _ = write_attributes(attributes, "best", 2)
    np.testing.assert_array_equal(read_attributes(data, rows), attributes)


def test_damage_raises_only_decode_errors():
    rows = 400
    data, _ = write_attributes(correlated(rows), "best", 2)
    assert data[0] == STAGED
    rng = np.random.default_rng(2)
    for cut in rng.integers(0, len(data), 60):
        with pytest.raises(DecodeError):
            read_attributes(data[:cut], rows)
    for _ in range(300):
        broken = bytearray(data)
        broken[rng.integers(0, min(len(data), 900))] ^= 1 << rng.integers(0, 8)
        try:
            assert read_attributes(bytes(broken), rows).shape == (N_CHANNELS, rows)
        except DecodeError:
            pass


def test_an_unknown_form_is_refused():
    with pytest.raises(DecodeError, match="form 2"):
        read_attributes(b"\x02", 3)
