"""Canonical msgpack: one value, one byte string, and nothing else is accepted."""

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import memory_below

from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.format.canonical import pack, unpack

leaf = (
    st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(width=32, allow_nan=False, allow_infinity=False)
    | st.text(max_size=40)
    | st.binary(max_size=40)
)


def nested(depth: int) -> st.SearchStrategy:
    if depth == 0:
        return leaf
    inner = nested(depth - 1)
    return leaf | st.lists(inner, max_size=4) | st.dictionaries(st.integers(0, 2**32 - 1), inner, max_size=4)


@settings(max_examples=40)
@given(nested(4))
def test_round_trip(value):
    assert unpack(pack(value)) == value


@given(st.dictionaries(st.integers(0, 300), leaf, min_size=2))
def test_the_order_of_insertion_does_not_matter(value):
    assert pack(value) == pack(dict(reversed(value.items())))


def test_known_bytes():
    assert pack({2: 0.5, 1: [1, 300, -1], 64: b"a"}).hex() == "83019301cd012cff02ca3f00000040c40161"


@pytest.mark.parametrize(
    "value",
    [None, 0.1, float("nan"), float("inf"), 1e39, -1e300, 2**64, -(2**63) - 1, {"a": 1}, {-1: 1}, {True: 1}, {2**32: 1},
     [[[[[]]]]], {1: {1: {1: {1: {1: 1}}}}}, np.float32(1), np.int64(1), object(), "\ud800", msgpack.ExtType(1, b"a")],
)  # fmt: skip
def test_pack_refuses(value):
    with pytest.raises(EncodeError):
        pack(value)


@pytest.mark.parametrize("head", ["dc3fff", "dd0003ffff", "de3fff", "df0003ffff", "c63fffffff", "db3fffffff"])
def test_declared_sizes_take_no_memory(head):
    """Lists of lists that each declare as many entries as there are bytes once took 78 MiB of a header's 16 kB, and
    2 GiB of a metadata chunk of a few bytes."""
    data = bytes.fromhex(head) * 1000 + bytes(1 << 18)
    with memory_below(1 << 20), pytest.raises(Malformed):
        unpack(data)


@settings(max_examples=400)
@given(st.binary(max_size=24))
def test_what_unpacks_packs_to_the_same_bytes(data):
    try:
        value = unpack(data)
    except Malformed:
        return
    assert pack(value) == data
