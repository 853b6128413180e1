"""Positions: lossless, of known cost, and bounded in memory on any bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import memory_below

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter
from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.morton import MAX_VOXEL, morton_codes, morton_order


def ordered(cells):
    cells = np.unique(np.asarray(cells, dtype=np.int32).reshape(-1, 3), axis=0)
    return cells[morton_order(cells)]


def coded(cells):
    writer = ChannelWriter()
    encode_positions(cells, writer)
    return writer.finish()[:2]


def size_of(cells):
    return sum(map(len, coded(cells)))


def decoded(codes, stream, count):
    reader = ChannelReader(codes, stream, 3 * count)
    cells = decode_positions(reader, count)
    reader.finish()
    return cells


def round_trip(cells):
    codes, stream = coded(cells)
    back = decoded(codes, stream, len(cells))
    assert back.dtype == np.int32 and np.array_equal(back, cells)
    return len(codes) + len(stream)


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
    found = coded(cells)
    assert coded(decoded(*found, len(cells))) == found


def test_smallest_inputs():
    assert round_trip(np.zeros((0, 3), np.int32)) == 0
    assert round_trip(np.array([[-3, 0, 7]], dtype=np.int32)) == 4
    assert round_trip(np.array([[-MAX_VOXEL, 0, MAX_VOXEL]], dtype=np.int32)) == 9


def test_uniform_cells_cost_their_entropy():
    """No structure to find: log2 C(2^30, N) / N bits, and the tables must not cost more than 1 % over it."""
    cells = ordered(np.random.default_rng(1).integers(0, 1024, (10000, 3)))
    n = len(cells)
    ideal = 30 - (np.log2(np.arange(1, n + 1)).sum()) / n
    assert 8 * size_of(cells) / n <= 1.01 * ideal


def test_cells_on_a_coarser_lattice_cost_no_more():
    """Levels that always branch alike are free: every third bit of a lattice of step 8 is known."""
    cells = ordered(np.random.default_rng(1).integers(0, 128, (4000, 3)))
    assert size_of(8 * cells) <= size_of(cells) + 16


@pytest.mark.parametrize(
    "cells, says",
    [
        ([[0, 0, 0], [1, 0, 0], [1, 0, 0]], "same cell twice, rows 1 and 2"),
        ([[1, 0, 0], [0, 0, 0]], "out of Morton order"),
        ([[0, 0, 0], [1 << 21, 0, 0]], "span 2097153 voxels on one axis, limit 2097152 in a slice"),
        ([[0.0, 0.0, 0.0]], "integer array"),
        ([[0, MAX_VOXEL + 1, 0]], "limit 1048576 in magnitude"),
    ],
)
def test_bad_input_is_refused(cells, says):
    with pytest.raises(EncodeError, match=says):
        coded(np.array(cells))


def test_memory_follows_the_count_not_the_bytes():
    payload = bytes(3) + bytes([21]) + np.random.default_rng(5).bytes(40000)
    with memory_below(8 << 20), pytest.raises(DecodeError):
        decoded(payload, b"", 1000)
