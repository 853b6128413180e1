"""Anchor positions (voxel cells, int32 [N, 3]) <-> codes and channels, lossless, in Morton order: an octree by levels.

Codes before the channels (clause 10; the decoder knows N)
    Three zigzag varints, the minimum of the cells along x, y, z, and u8 R, the bit length of the largest cell -
    minimum. The octree has one node of side 2**R; at level = R .. 1 every node is replaced by its occupied children, in
    Morton order. A level of fewer than N nodes states two varints: the number of nodes with one child, and the sum of
    (children - 2) over its other nodes. After the last such level come six varints, the numbers of nodes with 2 .. 7
    children. These give the length of every channel.

Channels
    Per level, three channels: the number of children less one, of the nodes whose parent has one child and of the other
    nodes (both left out once there are N nodes), and the child number of each node with one child. Then, over all
    levels, six channels: for the nodes with 2 .. 7 children, the index of the pattern among patterns of its size.

Every table is static, so a level is one vectorised step.
"""

import numpy as np

from pd4dgs_codec.entropy.ans import MAX_COUNT
from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, split
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.morton import AXIS_BITS, MAX_VOXEL, join_bits, morton_codes

_CHILDREN = np.array([value.bit_count() for value in range(256)])  # by occupancy byte
_PATTERNS = [np.flatnonzero(_CHILDREN == k) for k in range(9)]  #: bytes with k children, ascending
_INDEX = np.zeros(256, dtype=np.int32)  # of a byte among the bytes with as many children
for _patterns in _PATTERNS:
    _INDEX[_patterns] = np.arange(len(_patterns))
_CODED = range(2, 8)  # numbers of children with more than one pattern; nodes with one child have channels of their own


def encode_positions(cells: np.ndarray, writer: ChannelWriter, known: list[Fitted]) -> None:
    """Codes cells int32 [N, 3] (voxels), which must be distinct and in Morton order (`morton_order`), as a batch.
    known: the prior list. Raises EncodeError as position_channels does."""
    head, channels = position_channels(cells)
    writer.codes += head
    writer.write(channels, known, cells.size)


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
    channels: list[np.ndarray] = []
    many: list[np.ndarray] = []
    only_child = np.zeros(1, dtype=bool)
    for occupancy in _occupancies(codes, depth):
        children = _CHILDREN[occupancy]
        if len(occupancy) < len(codes):
            single = int(np.count_nonzero(children == 1))
            put_varint(out, single)
            put_varint(out, int(children.sum()) - 2 * len(children) + single)
            channels += [children[only_child] - 1, children[~only_child] - 1]
            many.append(occupancy[children > 1])
            only_child = np.repeat(children == 1, children)
        channels.append(_INDEX[occupancy[children == 1]])
    if many:
        several = np.concatenate(many)
        for k in _CODED:
            channels.append(_INDEX[several[_CHILDREN[several] == k]])
            put_varint(out, len(channels[-1]))
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


def decode_positions(channels: ChannelReader, count: int, known: list[Prior]) -> np.ndarray:
    """Decodes cells int32 [count, 3], in Morton order. Memory is O(count), whatever the bytes say. known: the prior
    list. Raises Malformed, LimitExceeded or UnsupportedFeature for codes that encode_positions could not write."""
    if not count:
        return np.zeros((0, 3), dtype=np.int32)
    reader = channels.codes
    low = [reader.zigzag(MAX_VOXEL, "the smallest cell") for _ in range(3)]
    depth = reader.byte("the octree's depth", AXIS_BITS)
    nodes, single = _read_counts(reader, depth, count)
    sizes = [reader.varint(MAX_COUNT, f"the number of nodes with {k} children") for k in _CODED] if count > 1 else []
    several = sum(nodes) - sum(single)
    if sum(sizes) > several:
        raise Malformed(f"positions: {sum(sizes)} nodes with 2 to 7 children, expected at most {several}")
    lengths, only = [], 0
    for have, alone in zip(nodes, single, strict=True):
        lengths += [only, have - only, alone] if have < count else [alone]
        only = alone
    found = split(channels.read([*lengths, *sizes], known), [*lengths, *sizes])
    codes = _grow(found, nodes, single, sizes, count)
    offsets = np.stack([join_bits(codes >> axis) for axis in range(3)], axis=1)
    if offsets.min(axis=0).any() or int(offsets.max()).bit_length() != depth:
        raise Malformed("positions: the minimum or the depth does not fit the cells")
    cells = offsets + np.array(low, dtype=np.int64)
    if int(cells.max()) > MAX_VOXEL:
        raise Malformed(f"positions: voxel index {int(cells.max())}, limit {MAX_VOXEL}")
    return cells.astype(np.int32)


def _read_counts(reader: ByteReader, depth: int, count: int) -> tuple[list[int], list[int]]:
    """Reads, per level from the root, the number of nodes and the number of nodes with one child."""
    nodes, single, have = list[int](), list[int](), 1
    for _ in range(depth):
        nodes.append(have)
        if have == count:
            single.append(have)
            continue
        at = reader.offset
        alone = reader.varint(MAX_COUNT, "the number of nodes with one child")
        more = reader.varint(MAX_COUNT, "the number of further children")
        if alone > have or more > 6 * (have - alone) or 2 * have - alone + more > count:
            raise Malformed(f"positions: {alone} of {have} nodes with one child, {more} further children", offset=at)
        single.append(alone)
        have += have - alone + more
    if have != count:
        raise Malformed(f"positions: {have} nodes after {depth} levels, expected {count}", offset=reader.offset)
    return nodes, single


def _grow(channels: list[np.ndarray], nodes: list[int], single: list[int], sizes: list[int], count: int) -> np.ndarray:
    """Expands the octree to the Morton codes int64 [count] of its cells, ascending."""
    first = len(channels) - len(sizes)
    levels = iter(channels[:first])
    patterns = {k: _within(c, len(_PATTERNS[k])) for k, c in zip(_CODED, channels[first:], strict=False)}
    codes, only_child = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
    for level, (have, alone) in enumerate(zip(nodes, single, strict=True)):
        if have == count:
            codes = codes << 3 | _within(next(levels), 8)
            continue
        children = np.empty(have, np.uint8)
        children[only_child] = _within(next(levels), 8)
        children[~only_child] = _within(next(levels), 8)
        children += 1
        after = nodes[level + 1] if level + 1 < len(nodes) else count
        one = children == 1
        if np.count_nonzero(one) != alone or int(children.sum()) != after:
            raise Malformed("positions: the numbers of children differ from their stated sums")
        occupancy = np.full(have, 255, np.uint8)  # eight children have one pattern
        occupancy[one] = 1 << _within(next(levels), 8)
        for k in _CODED:
            here = np.flatnonzero(children == k)
            if len(here) > len(patterns[k]):
                raise Malformed(f"positions: more nodes with {k} children than stated")
            occupancy[here] = _PATTERNS[k][patterns[k][: len(here)]]
            patterns[k] = patterns[k][len(here) :]
        child = np.flatnonzero(np.unpackbits(occupancy, bitorder="little").view(bool))  # and eight times its parent
        parent = child >> 3
        codes = codes[parent] << 3 | child & 7
        only_child = one[parent]
    for k, unused in patterns.items():
        if len(unused):
            raise Malformed(f"positions: {len(unused)} nodes with {k} children fewer than stated")
    return codes


def _within(symbols: np.ndarray, size: int) -> np.ndarray:
    """Returns the symbols. Raises Malformed unless all are in 0 .. size - 1."""
    if symbols.size and not (int(symbols.min()) >= 0 and int(symbols.max()) < size):
        found = f"{int(symbols.min())}..{int(symbols.max())}"
        raise Malformed(f"positions: symbols in {found}, expected 0..{size - 1}")
    return symbols
