"""Anchor positions (voxel cells, int32 [N, 3]) <-> codes and channels, lossless, in Morton order: an octree by levels.

Codes before the channels (clause 10; the decoder knows N)
    Three zigzag varints, the minimum of the cells along x, y, z, and u8 R, the bit length of the largest cell -
    minimum. The octree has one node of side 2**R; at level = R .. 1 every node is replaced by its occupied children, in
    Morton order.

Channels
    Per level of fewer than N nodes two channels, the numbers of children less one: of the nodes whose parent has one
    child, then of the others. From a level of N nodes on, all nodes have one child. Then eight channels per level, by
    number of children: which ones, as the index of the occupancy byte among the bytes with as many bits.

Every table is static, so a level is one vectorised step.
"""

import numpy as np

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, split
from pd4dgs_codec.entropy.varint import put_zigzag
from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.morton import AXIS_BITS, MAX_VOXEL, join_bits, morton_codes

_CHILDREN = np.array([value.bit_count() for value in range(256)])  # by occupancy byte
_PATTERNS = [np.flatnonzero(_CHILDREN == k) for k in range(9)]  #: bytes with k children, ascending
_INDEX = np.zeros(256, dtype=np.int32)  # of a byte among the bytes with as many children
for _patterns in _PATTERNS:
    _INDEX[_patterns] = np.arange(len(_patterns))


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
    channels, only_child = list[np.ndarray](), np.zeros(1, dtype=bool)
    levels = _occupancies(codes, depth)
    for occupancy in levels:
        if len(occupancy) < len(codes):
            children = _CHILDREN[occupancy]
            channels += [children[only_child] - 1, children[~only_child] - 1]
            only_child = np.repeat(children == 1, children)
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
    codes = _grow(channels, _read_levels(channels, depth, count))
    offsets = np.stack([join_bits(codes >> axis) for axis in range(3)], axis=1)
    if offsets.min(axis=0).any() or int(offsets.max()).bit_length() != depth:
        raise Malformed("positions: the minimum or the depth does not fit the cells")
    cells = offsets + np.array(low, dtype=np.int64)
    if int(cells.max()) > MAX_VOXEL:
        raise Malformed(f"positions: voxel index {int(cells.max())}, limit {MAX_VOXEL}")
    return cells.astype(np.int32)


def _read_levels(channels: ChannelReader, depth: int, count: int) -> list[np.ndarray]:
    """Decodes the numbers of children uint8 [nodes] of each level, from the root on."""
    levels, only_child = list[np.ndarray](), np.zeros(1, dtype=bool)
    for _ in range(depth):
        nodes = len(only_child)
        if nodes == count:
            levels.append(np.ones(nodes, np.uint8))
            continue
        alone, children = int(np.count_nonzero(only_child)), np.empty(nodes, np.uint8)
        found = _within(channels.read([alone, nodes - alone]), 8) + 1
        children[only_child], children[~only_child] = found[:alone], found[alone:]
        if (after := int(found.sum())) > count:
            raise Malformed(f"positions: {after} nodes after {len(levels) + 1} levels, expected at most {count}")
        levels.append(children)
        only_child = np.repeat(children == 1, children)
    if len(only_child) != count:
        raise Malformed(f"positions: {len(only_child)} nodes after {depth} levels, expected {count}")
    return levels


def _grow(channels: ChannelReader, levels: list[np.ndarray]) -> np.ndarray:
    """Expands the octree to the Morton codes int64 [count] of its cells, ascending. levels: of _read_levels."""
    sizes = [size for children in levels for size in np.bincount(children, minlength=9)[1:].tolist()]
    parts, codes = iter(split(channels.read(sizes), sizes)), np.zeros(1, dtype=np.int64)
    for children in levels:
        occupancy = np.empty(len(children), np.uint8)
        for k in range(1, 9):
            if len(part := next(parts)):
                occupancy[children == k] = _PATTERNS[k][_within(part, len(_PATTERNS[k]))]
        child = np.flatnonzero(np.unpackbits(occupancy, bitorder="little").view(bool))  # and eight times its parent
        codes = codes[child >> 3] << 3 | child & 7
    return codes


def _within(symbols: np.ndarray, size: int) -> np.ndarray:
    """Returns the symbols. Raises Malformed unless all are in 0 .. size - 1."""
    if symbols.size and not (int(symbols.min()) >= 0 and int(symbols.max()) < size):
        found = f"{int(symbols.min())}..{int(symbols.max())}"
        raise Malformed(f"positions: symbols in {found}, expected 0..{size - 1}")
    return symbols
