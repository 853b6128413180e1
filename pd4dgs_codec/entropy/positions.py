"""Anchor positions (voxel cells, int32 [N, 3]) <-> codes and channels, lossless, in Morton order: an octree by levels.

Codes before the channels (clause 10; the decoder knows N)
    Three zigzag varints, the minimum of the cells along x, y, z, and u8 R, the bit length of the largest cell -
    minimum. The octree has one node of side 2**R; at level = R .. 1 every node is replaced by its occupied children, in
    Morton order.

Channels
    Per level of fewer than N nodes a channel, the numbers of children less one. From a level of N nodes on, all nodes
    have one child. Then eight channels per level, by number of children: which ones, as the index of the occupancy byte
    among the bytes with as many bits.

Every table is static, so a level is one vectorised step.
"""

import numpy as np

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, Places, split
from pd4dgs_codec.entropy.varint import put_zigzag
from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.morton import AXIS_BITS, MAX_VOXEL, join_bits, morton_codes

_CHILDREN = np.array([value.bit_count() for value in range(256)])  # by occupancy byte
_COUNTS = np.bincount(_CHILDREN)  # bytes with k children
_BYTES = np.argsort(_CHILDREN, kind="stable").astype(np.uint8)  # by number of children, each ascending
_FIRST = np.cumsum(_COUNTS) - _COUNTS  # of the bytes with k children among those
_INDEX = np.argsort(_BYTES) - _FIRST[_CHILDREN]  # of a byte among the bytes with as many children


def encode_positions(cells: np.ndarray, writer: ChannelWriter) -> None:
    """Codes cells int32 [N, 3] (voxels), which must be distinct and in Morton order (`morton_order`), as a batch.
    Raises EncodeError as position_channels does."""
    head, channels = position_channels(cells)
    writer.codes += head
    writer.write(channels, cells.size)


def position_channels(cells: np.ndarray) -> tuple[bytes, list[np.ndarray]]:
    """Returns (codes before the channels, channels), both empty without cells.

    Raises EncodeError unless the cells are distinct, in Morton order and within -2**20 .. 2**20.
    """
    codes = morton_codes(cells)
    steps = np.diff(codes)
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0))
        fault = "the same cell twice" if steps[row] == 0 else "cells out of Morton order"
        raise EncodeError(f"positions: {fault}, rows {row} and {row + 1}")
    if len(cells) == 0:
        return b"", []
    low, high = int(cells.min()), int(cells.max())
    if max(high, -low) > MAX_VOXEL:
        raise EncodeError(f"positions: cells {low}..{high}, limit {MAX_VOXEL} in magnitude")
    out = bytearray()
    for value in cells.min(axis=0).tolist():
        put_zigzag(out, value)
    depth = -(-int(codes[-1]).bit_length() // 3)
    out.append(depth)
    levels = _occupancies(codes, depth)
    channels = [_CHILDREN[level] - 1 for level in levels if len(level) < len(codes)]
    channels += [_INDEX[level[_CHILDREN[level] == k]] for level in levels for k in range(1, 9)]
    return bytes(out), channels


def _occupancies(codes: np.ndarray, depth: int) -> list[np.ndarray]:
    """Returns the occupancy bytes int64 [nodes] of each level, from the root, with nodes in Morton order."""
    levels = []
    for _ in range(depth):
        parents = codes >> 3
        starts = np.flatnonzero(np.diff(parents, prepend=-1))
        levels.append(np.bitwise_or.reduceat(1 << (codes & 7), starts))
        codes = parents[starts]
    return levels[::-1]


def decode_positions(channels: ChannelReader, count: int) -> np.ndarray:
    """Decodes cells int32 [count, 3], in Morton order. Memory is O(count), whatever the bytes say. Raises Malformed,
    LimitExceeded or UnsupportedFeature for codes that encode_positions could not write."""
    if not count:
        return np.zeros((0, 3), dtype=np.int32)
    reader = channels.codes
    low = [reader.zigzag(MAX_VOXEL, "the smallest cell") for _ in range(3)]
    depth = reader.byte("the octree's depth", AXIS_BITS)
    codes = _grow(channels, _read_levels(channels, depth, count), depth, count)
    offsets = np.stack([join_bits(codes >> axis) for axis in range(3)], axis=1)
    if offsets.min(axis=0).any() or int(offsets.max()).bit_length() != depth:
        raise Malformed("positions: the minimum or the depth does not fit the cells")
    cells = offsets + np.array(low, dtype=np.int64)
    if int(cells.max()) > MAX_VOXEL:
        raise Malformed(f"positions: voxel index {int(cells.max())}, limit {MAX_VOXEL}")
    return cells.astype(np.int32)


def _read_levels(channels: ChannelReader, depth: int, count: int) -> list[np.ndarray]:
    """Decodes the numbers of children less one, uint8 [nodes], of each level of fewer than `count` nodes, from the root
    on."""
    levels, nodes = list[np.ndarray](), 1
    while nodes < count and len(levels) < depth:
        further = channels.read([nodes])
        if further.view(np.uint32).max() >= 8:
            raise Malformed(f"positions: {1 + further.min()}..{1 + further.max()} children of a node, expected 1..8")
        levels.append(further.astype(np.uint8))
        if (nodes := nodes + int(further.sum())) > count:
            raise Malformed(f"positions: {nodes} nodes after {len(levels)} levels, expected at most {count}")
    if nodes != count:
        raise Malformed(f"positions: {nodes} nodes after {depth} levels, expected {count}")
    return levels


def _grow(channels: ChannelReader, levels: list[np.ndarray], depth: int, count: int) -> np.ndarray:
    """Expands the octree to the Morton codes int64 [count] of its cells, ascending. levels: of _read_levels."""
    sizes, single = [len(further) for further in levels], depth - len(levels)
    children = np.concatenate([*levels, np.zeros(0, np.uint8)]) + 1
    places = Places.by(np.repeat(np.arange(len(levels), dtype=np.uint8) * 8, sizes) + children - 1, 8 * len(levels))
    several, alone = split(channels.read([*places.sizes, *[count] * single]), [sum(sizes), single * count])
    indices = np.empty((1, len(children)), np.int32)
    places.put(several, indices)
    if np.any(indices.view(np.uint32) >= _COUNTS[children]) or np.any(alone.view(np.uint32) >= 8):
        raise Malformed("positions: a symbol of children that do not exist")
    codes = np.zeros(1, dtype=np.int64)
    for occupancy in split(_BYTES[_FIRST[children] + indices[0]], sizes):
        child = np.flatnonzero(np.unpackbits(occupancy, bitorder="little").view(bool))  # and eight times its parent
        codes = codes[child >> 3] << 3 | child & 7
    for only in alone.reshape(single, count):
        codes = codes << 3 | only
    return codes
