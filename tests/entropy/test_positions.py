"""Positions: lossless, decodable from the specification, and safe on any bytes."""

import tracemalloc

import numpy as np
import pytest
import refdec
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.errors import DecodeError, EncodeError, LimitExceeded, Malformed
from pd4dgs_codec.morton import MAX_VOXEL, morton_codes, morton_order


def ordered(cells):
    cells = np.unique(np.asarray(cells, dtype=np.int32).reshape(-1, 3), axis=0)
    return cells[morton_order(cells)]


def round_trip(cells):
    payload = encode_positions(cells)
    back = decode_positions(payload, len(cells))
    assert back.dtype == np.int32 and np.array_equal(back, cells)
    return payload


def sphere(count, radius):
    """Cells on a sphere, as dense surfaces have them."""
    points = np.random.default_rng(3).normal(size=(count, 3))
    return np.rint(radius * points / np.linalg.norm(points, axis=1, keepdims=True)).astype(int)


def test_the_order_of_cells_takes_66_bits():
    """Slices may lie at both ends of an axis, 2^21 voxels apart; a code of one slice has 63 bits."""
    ends = (-MAX_VOXEL, -1, 0, MAX_VOXEL)
    cells = np.array([(x, y, z) for x in ends for y in ends for z in ends], np.int32)[::-1]
    codes = [sum((int(v) + MAX_VOXEL >> i & 1) << 3 * i + a for a, v in enumerate(c) for i in range(22)) for c in cells]
    assert max(codes).bit_length() == 66
    assert morton_order(cells).tolist() == sorted(range(64), key=lambda row: codes[row])
    assert morton_order(cells[:0]).tolist() == []


def test_morton_codes_interleave_the_bits():
    cells = np.array([[5, 5, 5], [6, 5, 5], [5, 6, 5], [5, 5, 6], [5 + (1 << 20), 5, 5], [8, 8, 8]])
    assert morton_codes(cells).tolist() == [0, 1, 2, 4, 1 << 60, 0b111111]
    assert morton_order(cells).tolist() == [0, 1, 2, 3, 5, 4]
    assert morton_codes(np.zeros((0, 3), np.int32)).shape == (0,)


@settings(max_examples=30)
@given(
    st.integers(1, 120),
    st.sampled_from([(1, 1, 1), (2, 2, 2), (9, 1, 300), (1 << 21, 5, 5), (1 << 21, 1 << 21, 1 << 21)]),
    st.tuples(*[st.sampled_from([-MAX_VOXEL, -7, 0])] * 3),
    st.integers(0, 2**32 - 1),
)
def test_round_trip_is_lossless_and_canonical(count, spans, low, seed):
    offsets = np.random.default_rng(seed).integers(0, spans, (count, 3))
    cells = ordered(np.minimum(offsets + np.array(low), MAX_VOXEL))
    payload = round_trip(cells)
    assert encode_positions(decode_positions(payload, len(cells))) == payload


def test_smallest_inputs():
    assert encode_positions(np.zeros((0, 3), np.int32)) == b""
    assert decode_positions(b"", 0).shape == (0, 3)
    assert len(round_trip(np.array([[-3, 0, 7]], dtype=np.int32))) == 4
    assert len(round_trip(np.array([[-MAX_VOXEL, 0, MAX_VOXEL]], dtype=np.int32))) == 9


def test_uniform_cells_cost_their_entropy():
    """No structure to find: log2 C(2^30, N) / N bits, and the tables must not cost more than 1 % over it."""
    cells = ordered(np.random.default_rng(1).integers(0, 1024, (10000, 3)))
    n = len(cells)
    ideal = 30 - (np.log2(np.arange(1, n + 1)).sum()) / n
    assert 8 * len(encode_positions(cells)) / n <= 1.01 * ideal


def test_cells_on_a_coarser_lattice_cost_no_more():
    """Levels that always branch alike are free: every third bit of a lattice of step 8 is known."""
    cells = ordered(np.random.default_rng(1).integers(0, 128, (4000, 3)))
    assert len(encode_positions(8 * cells)) <= len(encode_positions(cells)) + 16


@pytest.mark.parametrize("shape", ["surface", "dense", "corner", "sparse", "line"])
def test_the_reference_decoder_agrees(shape):
    rng = np.random.default_rng(2)
    cells = ordered(
        {
            "surface": lambda: sphere(500, 300),
            "dense": lambda: sphere(3000, 12),
            "corner": lambda: np.vstack([rng.integers(0, 30, (1200, 3)), rng.integers(0, 1 << 20, (40, 3))]),
            "sparse": lambda: rng.integers(-(1 << 20), 1 << 20, (200, 3)),
            "line": lambda: np.arange(600)[:, None] * [3, 1, 0] - 900,
        }[shape]()
    )
    payload = encode_positions(cells)
    assert refdec.decode_positions(payload, len(cells)) == [tuple(c) for c in cells.tolist()]


def test_bad_input_is_refused():
    with pytest.raises(EncodeError, match="same cell twice, rows 1 and 2"):
        encode_positions(np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0]], np.int32))
    with pytest.raises(EncodeError, match="out of Morton order"):
        encode_positions(np.array([[1, 0, 0], [0, 0, 0]], np.int32))
    with pytest.raises(EncodeError, match="span 2097153 voxels"):
        encode_positions(np.array([[0, 0, 0], [1 << 21, 0, 0]], np.int32))
    with pytest.raises(EncodeError, match="integer array"):
        encode_positions(np.zeros((2, 3), np.float32))
    with pytest.raises(EncodeError, match="limit 1048576 in magnitude"):
        encode_positions(np.array([[0, MAX_VOXEL + 1, 0]]))


def test_wrong_counts_and_headers_are_refused():
    cells = ordered(np.random.default_rng(0).integers(0, 64, (500, 3)))
    payload = encode_positions(cells)
    for count in (0, 1, len(cells) - 1, len(cells) + 1, 1 << 19, -1):
        with pytest.raises(Malformed):
            decode_positions(payload, count)
    with pytest.raises(Malformed, match="ends before the octree's depth"):
        decode_positions(payload[:3], len(cells))
    with pytest.raises(LimitExceeded, match="depth"):
        decode_positions(payload[:3] + b"\x16" + payload[4:], len(cells))
    with pytest.raises(Malformed):
        decode_positions(payload + bytes(4), len(cells))
    with pytest.raises(Malformed, match="the minimum or the depth does not fit"):
        decode_positions(bytes(3) + b"\1" + b"\0\2", 1)  # one cell in the upper half, so the minimum is another
    with pytest.raises(LimitExceeded, match="smallest cell"):
        decode_positions(b"\x81\x80\x80\x01" + bytes(3), 1)


@pytest.fixture(scope="module")
def small_payload():
    cells = ordered(np.random.default_rng(4).integers(0, 40, (150, 3)))
    return encode_positions(cells), len(cells)


@settings(max_examples=30)
@given(st.data())
def test_changed_bytes_raise_only_our_errors(small_payload, data):
    payload, count = bytearray(small_payload[0]), small_payload[1]
    for _ in range(data.draw(st.integers(1, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for junk in (bytes(payload), bytes(payload[:cut])):
        try:
            decoded = decode_positions(junk, count)
        except DecodeError:
            continue
        assert decoded.shape == (count, 3) and len(np.unique(decoded, axis=0)) == count


def test_memory_follows_the_count_not_the_bytes():
    payload = bytes(3) + bytes([21]) + np.random.default_rng(5).bytes(40000)
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            decode_positions(payload, 1000)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
