"""Anchor positions (voxel cells, int32 [N, 3]) <-> payload bytes, lossless, in Morton order.

Payload
    Empty for N = 0. Else the minimum of the cells per axis (3 x int32), the depth of each axis (3 x uint8: bit length
    of the largest cell - minimum, 0..21), then one ANS stream (`ans`) to the end. All little-endian. The decoder
    knows N. Arithmetic is on integers; // and >> round down.

Tree
    Let R be the largest depth. The nodes of the tree are boxes, kept in Morton order; it starts with the one node
    (0, 0, 0). For level = R .. 1 and axis = z, y, x every node is halved along the axis: its coordinate p becomes 2p
    (lower half), 2p + 1 (upper half), or both, in this order. If level > depth of the axis it becomes 2p and nothing is
    coded. Else two sequences are coded: for every node, whether both halves are occupied (left out when there are N
    nodes, as then none is); then, for every node where not, 1 if the occupied half is the expected one. After the last
    level the nodes are the cells - minimum. The stream ends there; there must be N nodes and each minimum must be 0.

Grids
    At the start of a level, its nodes become the cells of a new grid g = level if none exists yet or if the last grid
    is dense: it had fewer than 100 nodes, or on average at least 5 of the 26 cells around a cell were occupied. Only
    the last three grids are used. A node's box in a grid is the 3 x 3 x 3 cells around the cell it lies in. The node
    uses the finest grid whose box holds more than 7 nodes, itself included, or else the coarsest of the three.

Prediction (per node, before a split of axis a; l_i is the number of unknown bits of coordinate i: level or level - 1)
    centre  c_i = (p_i << (l_i + 1)) + (1 << l_i), then u_i = c_i << (8 - g) if g <= 8 else c_i >> (g - 8)
    n = number of other nodes in the box, n' = max(n, 1); sums run over them, with d = their u - the node's u
    m_i = (sum d_i << 4) // n';   s_i = max(9 - g + l_i, 0);   h = max(8 - g + l_a, 0)
    C_ij = ((sum d_i d_j << 8) // n' - m_i m_j) >> 8, and for i = j plus max(2^(2 s_i) >> 3, 1)
    A = row a of the adjugate of C;   D = max(sum_j C_aj A_j, 1);   P = sum_j A_j m_j
    The upper half is expected if P > 0, else the lower.
    pull = number of PULL_STEPS that are <= |P| // max(D >> h, 1) (0 if n = 0)
    sharpness = number of 1, 2, 4 .. 256 that are <= (A_a << (2h + 4)) // D
    density = clip((3 L - 16 (3 g - l_x - l_y - l_z)) // 12 + 30, 0, 39), L = floor(8 log2 min(n, 4096)), 0 for n = 0
    scale = clip(g - l_a, 0, 4)
    This is h . C^-1 m, the log odds of the halves under the Gaussian that fits the neighbours: for points on a surface
    the axis of small variance is the normal, and the pull says on which side of the node the surface passes.

Probabilities
    Flag contexts are (density, sharpness, min(pull // 3, 4)), with the parent (density // 2, sharpness // 2, the same
    last) and the grandparent (sharpness // 2, the same last). Side contexts are (pull, sharpness, scale), with the
    parent (pull, scale) and the grandparent (pull). Each of the six families holds counts (c0, c1), at first 0.
    p = 32768; for the grandparent, parent and context in turn, with w = 1, 16, 16:
        p = (65536 c1 + 256 w p) // (c0 + c1 + 256 w)
    q = max(min(p, 65536 - p), 16);   k = bit length of q - 3;   q = min(((q >> k) << k) + (1 << k >> 1), 32768)
    P(bit = 1) = q / 65536 if p < 32768, else 1 - q / 65536; the table is [0, 2^24 P(0), 2^24].
    A sequence is coded in passes: of 64 elements or more, those with index mod 16 in {0}, {1, 2}, {3 .. 6}, {7 .. 15};
    a shorter one in one pass. Within a pass all tables are those at its start, and the elements are coded by ascending
    P(bit = 1), then by index. After the pass each bit adds 256 to its count in the three families; then counts with
    t = c0 + c1 > 12288 become c = 12288 c // t.

Measured (tools/bench_positions.py): 9.7 bits per point on 26,000 points of five surfaces at 1024^3, where Draco's
kd-tree takes 13.7; 0.79 to 0.94 of Draco on triangulated points of a phone video; 0.8 % over the
entropy on uniform noise.
"""

from __future__ import annotations

import struct

import numpy as np

from pd4dgs_codec.entropy.ans import AnsDecoder, ans_encode
from pd4dgs_codec.entropy.position_model import AdaptiveBits, Grid, contexts, flag_model, side_model
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed, Truncated
from pd4dgs_codec.morton import AXIS_BITS, morton_codes

_HEADER = struct.Struct("<3i3B")
_TOTAL = 1 << 24
_USED_GRIDS = 3
_INT32 = np.iinfo(np.int32)
_PASS = np.repeat([0, 1, 2, 3], [1, 2, 4, 9])  # of an element, by its index mod 16


class _Coder:
    """Codes sequences of bits: into lists if made without a decoder, else out of the decoder."""

    def __init__(self, decoder: AnsDecoder | None = None):
        self._decoder = decoder
        self.channels: list[np.ndarray] = []
        self.tables: list[np.ndarray] = []

    def code(self, model: AdaptiveBits, contexts: np.ndarray, bits: np.ndarray | None) -> np.ndarray:
        """The bits, bool [n]: those given when encoding, those read (bits is None) when decoding."""
        count = len(contexts)
        out = np.empty(count, dtype=np.int64) if bits is None else bits.astype(np.int64)
        turn = np.resize(_PASS, count) if count >= 64 else np.zeros(count, dtype=np.int64)
        for k in range(4 if count >= 64 else 1):
            mine = np.flatnonzero(turn == k)
            p = model.probabilities()[contexts[mine]]
            order = np.argsort(p, kind="stable")
            self._groups(out, mine[order], p[order])
            model.update(contexts[mine], out[mine])
        return out.astype(bool)

    def _groups(self, out: np.ndarray, order: np.ndarray, p: np.ndarray) -> None:
        first = np.flatnonzero(np.diff(p.astype(np.int64), prepend=-1))
        ends = [*first[1:].tolist(), len(p)]
        for begin, end, one in zip(first.tolist(), ends, p[first].tolist(), strict=False):
            group = order[begin:end]
            cum = np.array([0, _TOTAL - (one << 8), _TOTAL], dtype=np.int64)
            if self._decoder is not None:
                out[group] = self._decoder.take(len(group), cum)
            else:
                self.channels.append(out[group])
                self.tables.append(cum)


class _Occupancy:
    """What the encoder knows: the cells - minimum, int64 [N, 3] in Morton order, and which of them each node holds."""

    def __init__(self, offsets: np.ndarray):
        self._offsets = offsets
        self._starts = np.zeros(1, dtype=np.int64)

    def split(self, axis: int, bit: int) -> tuple[np.ndarray, np.ndarray]:
        """Per node bool [M]: both halves are occupied; the upper half is. The nodes become their halves."""
        ones = self._offsets[:, axis] >> bit & 1
        upper = np.add.reduceat(ones, self._starts)
        sizes = np.diff(self._starts, append=len(ones))
        both = (upper > 0) & (upper < sizes)
        self._starts = np.sort(np.concatenate([self._starts, (self._starts + sizes - upper)[both]]))
        return both, upper > 0


def _walk(coder: _Coder, depths: list[int], count: int, truth: _Occupancy | None) -> np.ndarray:
    """Code the tree from its root to its cells; returns them, int64 [count, 3]. truth is None when decoding."""
    flags, sides = flag_model(), side_model()
    nodes = np.zeros((1, 3), dtype=np.int64)
    grids: list[Grid] = []
    for level in range(max(depths), 0, -1):
        if not grids or grids[-1].is_dense:
            grids = [*grids, Grid(nodes, level, max(depths) - level)][-_USED_GRIDS:]
        for axis in (2, 1, 0):
            nodes[:, axis] *= 2
            if level > depths[axis]:
                continue
            left = [level - 1 if a > axis else level for a in range(3)]
            prefix = nodes >> (np.arange(3) == axis)
            both, one = truth.split(axis, level - 1) if truth else (None, None)
            flag, side, upper = contexts(grids, prefix, left, axis)
            if len(nodes) < count:
                both = coder.code(flags, flag, both)
            else:
                both = np.zeros(count, dtype=bool)
            if len(nodes) + np.count_nonzero(both) > count:
                raise Malformed(f"positions: more than the {count} declared cells")
            single = ~both
            hit = coder.code(sides, side[single], None if one is None else (one == upper)[single])
            nodes[single, axis] += hit == upper[single]
            nodes = _halve(nodes, both, axis, grids)
    if len(nodes) != count:
        raise Malformed(f"positions: {len(nodes)} cells, {count} declared")
    return nodes


def _halve(nodes: np.ndarray, both: np.ndarray, axis: int, grids: list[Grid]) -> np.ndarray:
    parent = np.repeat(np.arange(len(nodes)), 1 + both)
    for grid in grids:
        grid.cell = grid.cell[parent]
    halves = nodes[parent]
    halves[1:, axis] += parent[1:] == parent[:-1]
    return halves


def encode_positions(cells: np.ndarray) -> bytes:
    """The payload of cells int32 [N, 3] (voxels), which must be distinct and in Morton order (`morton_order`).

    Raises EncodeError if they are not, or if an axis spans more than 2**21 voxels.
    """
    steps = np.diff(morton_codes(cells))
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0))
        fault = "the same cell twice" if steps[row] == 0 else "cells out of Morton order"
        raise EncodeError(f"positions: {fault}, rows {row} and {row + 1}")
    if len(cells) == 0:
        return b""
    if int(cells.min()) < _INT32.min or int(cells.max()) > _INT32.max:
        raise EncodeError(f"positions: cells {int(cells.min())}..{int(cells.max())} are outside int32")
    low = cells.min(axis=0).astype(np.int64)
    offsets = cells.astype(np.int64) - low
    depths = [int(v).bit_length() for v in offsets.max(axis=0)]
    coder = _Coder()
    _walk(coder, depths, len(cells), _Occupancy(offsets))
    return _HEADER.pack(*low.tolist(), *depths) + ans_encode(coder.channels, coder.tables)


def decode_positions(payload: bytes | memoryview, count: int) -> np.ndarray:
    """The cells int32 [count, 3] of a payload, in Morton order. Memory is O(count), whatever the bytes say.

    Raises Truncated, Malformed or LimitExceeded if the payload is not one that encode_positions makes for them.
    """
    if count <= 0:
        if count or len(payload):
            raise Malformed(f"positions: {len(payload)} bytes for {count} cells")
        return np.zeros((0, 3), dtype=np.int32)
    if len(payload) < _HEADER.size:
        raise Truncated(f"positions: {len(payload)} bytes, expected at least {_HEADER.size}")
    *low, dx, dy, dz = _HEADER.unpack_from(payload)
    depths = [dx, dy, dz]
    if max(depths) > AXIS_BITS:
        raise LimitExceeded(f"positions: depths {depths}, limit {AXIS_BITS}")
    if sum(depths) < 63 and count > 1 << sum(depths):
        raise Malformed(f"positions: {count} cells in a box of 2**{sum(depths)}")
    decoder = AnsDecoder(payload[_HEADER.size :])
    offsets = _walk(_Coder(decoder), depths, count, None)
    decoder.finish()
    if offsets.min(axis=0).any() or [int(v).bit_length() for v in offsets.max(axis=0)] != depths:
        raise Malformed("positions: the minimum or the depths do not fit the cells")
    cells = offsets + np.array(low, dtype=np.int64)
    if int(cells.max()) > _INT32.max:
        raise Malformed(f"positions: a coordinate of {int(cells.max())} is outside int32")
    return cells.astype(np.int32)
