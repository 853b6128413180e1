"""Writes `.pd4` structures from explicit choices, right or wrong.

This is written from the specification. It shares frequency tables and Morton codes with the reference decoder, and with
the package no code but the library that packs msgpack, so that a misreading of either is found. The caller names every
prior, predictor and field, or it follows from the symbols by a rule on integers, so the bytes are the same on every
machine. Lengths, scene ids and CRCs are right unless the caller asks for others.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import msgpack
import numpy as np
from refdec import PATTERNS, less_minimum, morton_code, norm_cdf, row_values, table_of, unpack

from . import lzma2

SIGNATURE, MAJOR = b"\x89PD4\r\n\x1a\n", 5
ANS, LZMA = 0, 1
HEADER: dict[int, Any] = {2: ANS, 6: 2.0**-7, 7: [-1.0, -2.0, -3.0, 1.0, 2.0, 3.0], 8: [0.5, 3.25],
    9: [0.0, 0.5, 1.0], 10: [0.125, 64.0], 11: [0.0, -1.0, 0.0], 12: 1.5}  # fmt: skip
STEPS = (0.0625, 0.03125, 0.125)  # of the tensors of rows, in turn

# -- primitives --------------------------------------------------------------------------------------------------------


def varint(*values: int) -> bytes:
    """Clause 7.1."""
    out = bytearray()
    for value in values:
        while value > 127:
            out.append(value & 127 | 128)
            value >>= 7
        out.append(value)
    return bytes(out)


def zigzag(*values: int) -> bytes:
    """Clause 7.1."""
    return varint(*(2 * v if v >= 0 else -2 * v - 1 for v in values))


def words(*values: int) -> bytes:
    """u32 words of an ANS stream."""
    return struct.pack(f"<{len(values)}I", *values)


def pack(value: Any) -> bytes:
    """Canonical msgpack (clause 4), if the keys of maps ascend. ValueError for a number that has no form."""
    return bytes(msgpack.packb(value, use_single_float=True))


def pattern(*shape: int, low: int = -3, high: int = 3, seed: int = 0) -> np.ndarray:
    """int32 of `shape` in low..high that look irregular: upper bits of a Lehmer generator."""
    state, values = seed * 7919 + 12345, []
    for _ in range(math.prod(shape)):
        state = state * 48271 % (2**31 - 1)
        values.append(low + (state >> 8) % (high - low + 1))
    return np.array(values, np.int32).reshape(shape)


# -- coded channels (clauses 7 and 8) ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prior:
    """The window of n entries from kmin; of more than one entry under a Gaussian with the mean g / 256 from their
    middle and the deviation 2^(si / 64). Const if n is 1. mixed: si, g and weight of a second Gaussian."""

    kmin: int
    n: int = 1
    si: int = 64
    g: int = 0
    mixed: tuple[int, int, int] | None = None

    @property
    def normals(self) -> list[tuple[int, int]]:
        """si and g of each Gaussian; their number is that of the family."""
        return [] if self.n == 1 else [(self.si, self.g), *([self.mixed[:2]] if self.mixed else [])]

    def parameters(self) -> bytes:
        if self.n == 1:
            return zigzag(self.kmin)
        normals = b"".join(zigzag(g) + varint(si + 640) for si, g in self.normals)
        return zigzag(self.kmin) + varint(self.n - 2) + normals + bytes(self.mixed[2:] if self.mixed else ())

    @cached_property
    def cum(self) -> list[int]:
        """Clauses 7.2 to 7.4."""
        cdf, *other = (norm_cdf(self.n, 128 * (self.n - 1) + g, si) for si, g in self.normals)
        w = self.mixed[2] if self.mixed else 0
        return table_of([(256 - w) * a + w * b >> 8 for a, b in zip(cdf, *(other or [cdf]), strict=True)])


SMALL = Prior(-3, 7)
Choice = Callable[[str, int, list[int]], Prior]  #: of a prior, from piece, number of channel, symbols


def default_prior(k: Sequence[int]) -> Prior:
    """The prior of a channel for which the caller names none, by the range of its symbols."""
    low, high = min(k), max(k)
    if low == high:
        return Prior(low)
    if -3 <= low and high <= 3:
        return SMALL
    n, most = high - low + 1, (1 << 24) - 1
    if n > 1 << 14:  # around the median; the others are exceptions
        low, n = sorted(k)[len(k) // 2] - 7, 15
    return Prior(min(max(low, -most), most - n + 1), n, 64 * n.bit_length() - 128)


@dataclass
class Coder:
    """Codes channels, whose symbols go to one stream. known: the prior list, which it extends."""

    known: list[Prior]
    choose: Choice
    parts: list[tuple[list[int], Prior]] = field(default_factory=list)

    def codes(self, piece: str, channels: Iterable[np.ndarray]) -> bytes:
        """Tokens, priors and exceptions of channels. A prior that the list has is referred to, and symbols outside its
        window become exceptions."""
        out, defined = b"", self.known
        for number, channel in enumerate(channels):
            k = channel.ravel().tolist()
            if not k:
                continue
            prior = self.choose(piece, number, k)
            low, end = prior.kmin, prior.kmin + prior.n
            places = [at for at, v in enumerate(k) if not low <= v < end]
            if prior in defined:
                out += varint(2 * (8 + defined[::-1].index(prior)) + bool(places))
            else:
                defined.append(prior)
                out += varint(2 * len(prior.normals) + bool(places)) + prior.parameters()
            out += varint(len(places) - 1) if places else b""
            for last, at in zip([-1, *places], places):  # noqa: B905
                out += varint(at - last - 1, 2 * (k[at] - end) if k[at] >= end else 2 * (low - 1 - k[at]) + 1)
            self.parts.append(([v - low for v in k if low <= v < end], prior))
        return out

    def stream(self) -> bytes:
        """Clause 7.5, run backwards from state 0."""
        x, out = 0, list[int]()
        for entries, prior in reversed(self.parts):
            for s in reversed(entries if prior.n > 1 else []):
                low, high = prior.cum[s : s + 2]
                if x >= high - low << 40:
                    out.append(x & 0xFFFFFFFF)
                    x >>= 32
                x = (x // (high - low) << 24) + x % (high - low) + low
        while x:
            out.append(x & 0xFFFFFFFF)
            x >>= 32
        return words(*reversed(out))


# -- positions (clause 10) ---------------------------------------------------------------------------------------------


def morton_order(cells: np.ndarray) -> list[int]:
    """The rows of int [n, 3] in Morton order (clause 10.1)."""
    codes = [*map(morton_code, less_minimum(cells.tolist()))]
    return sorted(range(len(codes)), key=codes.__getitem__)


def octree(cells: np.ndarray) -> tuple[bytes, list[np.ndarray]]:
    """Head and channels of int32 [n, 3] in Morton order."""
    low = cells.min(axis=0)
    depth = int((cells.astype(np.int64) - low).max()).bit_length()
    codes = [morton_code(cell) for cell in (cells - low).tolist()]
    channels, indices = list[list[int]](), list[list[int]]()
    for level in range(depth - 1, -1, -1):
        children = dict[int, list[int]]()
        for node in sorted({code >> 3 * level for code in codes}):
            children.setdefault(node >> 3, []).append(node & 7)
        if len(children) < len(codes):
            channels.append([len(own) - 1 for own in children.values()])
        for k, alike in enumerate(PATTERNS, 1):
            indices.append([alike.index(sum(1 << c for c in own)) for own in children.values() if len(own) == k])
    head = zigzag(*low.tolist()) + bytes([depth])
    return head, [np.array(channel, np.int64) for channel in channels + indices]


# -- grids (clauses 8.6, 8.7 and 11.3) ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """fill: makes the samples of one plane from its number and shape [C, H, W]."""

    channels: int = 2
    sides: tuple[int, ...] = (3, 2, 4, 2)
    predictors: tuple[int, ...] | None = None  #: all 0 if None
    fill: Callable[[int, tuple[int, ...]], np.ndarray] = lambda number, shape: pattern(*shape, seed=number)
    id: int = 0

    def row(self) -> list[Any]:
        return [self.id, self.channels, list(self.sides), list(self.predictors or [0] * len(self.shapes()))]

    def shapes(self) -> list[tuple[int, int, int]]:
        """[C, H, W] of each plane."""
        pairs = itertools.combinations(self.sides, 2) if len(self.sides) > 1 else [(self.sides[0], 1)]
        return [(self.channels, h, w) for w, h in pairs]

    def planes(self) -> list[np.ndarray]:  # [C, H, W] each
        return [self.fill(number, shape) for number, shape in enumerate(self.shapes())]


def constant(value: int) -> Callable[[int, tuple[int, ...]], np.ndarray]:
    """A `fill` of one symbol."""
    return lambda number, shape: np.full(shape, value, np.int32)


def residual(predictor: int, k: np.ndarray) -> np.ndarray:
    """int64 [C, H, W] of samples (clause 11.3)."""
    k = k.astype(np.int64)
    west, north, corner = k[:, 1:, :-1], k[:, :-1, 1:], k[:, :-1, :-1]
    median = np.clip(west + north - corner, np.minimum(west, north), np.maximum(west, north))
    e = k.copy()
    e[:, 0, 1:] -= k[:, 0, :-1]  # in row 0 and in column 0 both predictors have one neighbour
    e[:, 1:, 0] -= k[:, :-1, 0]
    e[:, 1:, 1:] -= median if predictor else north
    return e


def classes_of_plane(e: np.ndarray) -> np.ndarray:
    """Class 0..7 [H·W] of each cell, by residuals int64 [m, H, W] of the stages before."""
    _, height, width = e.shape
    size = sum((abs(c) * 256 * c.size // (1 + int(abs(c).sum())) for c in e), np.zeros((height, width), np.int64))
    size = np.pad(size, 1, mode="edge")
    near = itertools.product(range(3), repeat=2)
    activity = sum(size[a : a + height, b : b + width] for a, b in near).ravel()  # type: ignore[union-attr]
    bounds = np.sort(activity)[[i * len(activity) // 8 for i in range(1, 8)]]
    return np.searchsorted(bounds, activity, side="right")


def grid_channels(planes: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """The coded channels of residuals int64 [C, H, W], stage by stage."""
    first, end = 0, 2
    while any(first < len(e) for e in planes):
        for e in planes:
            classes = classes_of_plane(e[:first]) if 0 < first < len(e) else None
            for channel in map(np.ravel, e[first:end]):
                yield from [channel] if classes is None else (channel[classes == q] for q in range(8))
        first, end = end, 2 * end


# -- layers (clause 6) -------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Layer:
    """A slice of a layer: what it means, and its parameters, codes and stream as they are written.

    rows, layer_rows: symbols [C, n] and [C, earlier rows + n] of each tensor. earlier: step classes of the earlier rows
    in a first slice. chains: weights and biases. meta: the parameters but that of the codes' length. tree: head and
    channels instead of those of the cells' octree. base: so many earlier rows are a base's. pieces: of the codes, by
    what they code.
    """

    number: int
    cells: np.ndarray
    rises: np.ndarray
    codes: np.ndarray
    classes: np.ndarray | None
    earlier: np.ndarray
    rows: list[np.ndarray]
    layer_rows: list[np.ndarray]
    grids: Sequence[Grid]
    chains: list[np.ndarray]
    meta: dict[int, Any]
    choose: Choice
    tree: tuple[bytes, list[np.ndarray]] | None = None
    base: int = 0
    pieces: dict[str, bytes] = field(default_factory=dict)
    stream: bytes = b""

    @cached_property
    def planes(self) -> list[np.ndarray]:
        """Samples int32 [C, H, W] of all grids."""
        return [plane for grid in self.grids for plane in grid.planes()]

    @cached_property
    def residuals(self) -> list[np.ndarray]:
        return [residual(p, k) for p, k in zip((p for g in self.grids for p in g.row()[3]), self.planes, strict=True)]

    def channels(self) -> dict[str, list[np.ndarray]]:
        """None split, by piece."""
        return {
            "rises": [self.rises],
            "masks": [self.codes],
            "classes": [] if self.classes is None else [self.classes],
            "rows": [channel for tensor in self.rows for channel in tensor],
            "layer_rows": [channel for tensor in self.layer_rows for channel in tensor],
            "grids": [channel for e in self.residuals for channel in e],
            "chains": self.chains,
        }

    def written(self, known: list[Prior] | None = None) -> Layer:
        """With its codes and its stream in mode ans. known: the prior list of the slices before, which it extends."""
        coder = Coder([] if known is None else known, self.choose)
        head, tree = (b"", []) if not len(self.cells) else self.tree or octree(self.cells)
        channels = {"positions": tree, **self.channels(), "grids": [*grid_channels(self.residuals)]}
        if self.classes is not None:
            channels["rows"] = [channel[self.classes == q] for channel in channels["rows"] for q in range(7)]
        if self.layer_rows:
            classes = 0 if self.classes is None else np.append(self.earlier, self.classes)
            of_base = np.arange(self.layer_rows[0].shape[1]) < self.base
            count = 1 if self.classes is None else 7
            parts = [own & (classes == q) for own in (of_base, ~of_base) for q in range(count)]
            channels["layer_rows"] = [channel[part] for channel in channels["layer_rows"] for part in parts]
        pieces = {piece: coder.codes(piece, own) for piece, own in channels.items()}
        pieces["positions"] = head + pieces["positions"]
        return replace(self, pieces=pieces, stream=coder.stream())

    def packed(
        self,
        stream: Callable[[bytes], bytes] = lzma2.packed,
        base: int | None = 0,
        width: int | None = None,
        cells: np.ndarray | None = None,
    ) -> Layer:
        """With its codes and its stream in mode lzma. base: of all channels; None takes the first symbol of each.
        width: log2 of the bytes of every number; None takes the narrowest. cells: others, int64."""
        codes, data = b"", b""
        cells = self.cells.astype(np.int64) if cells is None else cells
        differences = np.diff(cells, axis=0, prepend=0 * self.cells[:1])
        for channel in itertools.chain(differences.T, *self.channels().values()):
            k = channel.ravel().astype(np.int64)
            if k.size:
                own = int(k[0]) if base is None else base
                v = k - own
                reach = max(int(v.max()) + 1, -int(v.min()))
                w = (reach > 1 << 7) + (reach > 1 << 15) if width is None else width
                codes += varint(4 * (2 * own if own >= 0 else -2 * own - 1) + w)
                data += v.astype(("<i1", "<i2", "<i4")[w]).view(np.uint8).reshape(-1, 1 << w).T.tobytes()
        return replace(self, pieces={"lzma": codes}, stream=stream(data) if data else b"")

    def parameters(self) -> dict[int, Any]:
        return dict(sorted({**self.meta, 2: sum(map(len, self.pieces.values()))}.items()))

    def payload(self, packed: bytes | None = None) -> bytes:
        """Its bytes. packed: instead of its parameters."""
        packed = pack(self.parameters()) if packed is None else packed
        return struct.pack("<I", len(packed)) + packed + b"".join(self.pieces.values()) + self.stream

    def padded(self, size: int) -> bytes:
        """Its bytes, with parameters of `size` bytes due to an ignored key."""
        bare = len(pack(self.parameters()))
        form = 2 if size - bare - 3 < 1 << 8 else 3
        return self.payload(pack({**self.parameters(), 64: bytes(size - bare - 1 - form)}))


def constant_chain(widths: Sequence[int], symbol: int) -> list[np.ndarray]:
    """weight, bias, weight, ..; each of one symbol of its own, such that Gaussians can be seen. widths: from the input
    on."""
    shapes = ((shape, i) for i, pair in enumerate(itertools.pairwise(widths)) for shape in (pair[::-1], pair[1:]))
    return [np.full(shape, symbol + i + 38 * (len(shape) == 1), np.int32) for shape, i in shapes]


def line(n: int, z: int = 0) -> list[list[int]]:
    """n cells in a row."""
    return [[i, 0, z] for i in range(n)]


def ordered(cells: Any) -> list[list[int]]:
    """Cells in Morton order."""
    array = np.array(cells, np.int32).reshape(-1, 3)
    return array[morton_order(array)].tolist()


def make_layer(
    number: int = 0, cells: Sequence[Sequence[int]] = ((-1, 0, 2),), *, before: int = 0, below: int = 0,
    rises: Any = None, codes: Any = None, rows: Any = None, widths: Sequence[int] = (2, 6, 3), classes: Any = None,
    earlier: Any = (), layer_rows: Mapping[int, np.ndarray] = {}, labels: Sequence[int] = (),
    grids: Sequence[Grid] = (), chains: Mapping[int, Any] | None = None, kind: Any = None, fill: Any = None,
    steps: tuple[float, float] = (2.0**-4, 2.0**-7), priors: Mapping[str, Mapping[int, Prior]] = {},
    choose: Choice | None = None, tree: Any = None, base: int = 0, known: list[Prior] | None = None, first: bool = True,
) -> Layer:  # noqa: B006  # fmt: skip
    """A slice of `cells` (in Morton order) after `before` earlier rows. below: plane channels of the layers below.

    Defaults: every rise 0, every code 77, rows all 2; in layer 0 the networks of a scaffold without hidden layers,
    elsewhere a trunk and the head 1 if there are `grids`. rows: int32 [sum of widths, n]. layer_rows: int32 [C, earlier
    rows + n] by id. labels: ids of those with step 1 and predictor 2. chains: widths by id, or weight, bias, weight, ..
    steps: of grids and of chains. priors: of some channels, by piece and number; choose: of all.
    """
    n, features = len(cells), below + sum(grid.channels for grid in grids)
    if chains is None:
        chains = {0: (features, 3), 1: (3, 3)} if grids else {}
        if number == 0 and first:
            chains = {i: (widths[0], outputs * max(1, widths[-1] // 3)) for i, outputs in enumerate((1, 7, 3))}
    symbol, made = 2, dict[int, list[np.ndarray]]()
    for i, own in chains.items():
        made[i] = constant_chain(own, symbol) if isinstance(own, tuple) else own
        symbol += len(own) - 1
    tables = [[i, len(k), *((1.0, 2) if i in labels else (2.0**-5, i % 2))] for i, k in layer_rows.items()]
    meta: dict[int, Any] = {
        1: n,
        3: fill,
        4: [steps[0], *(grid.row() for grid in grids)] if grids else None,
        5: [steps[1], *([i, own[0].shape[1], *map(len, own[1::2])] for i, own in made.items())] if made else None,
        6: [0] if number and grids and kind is None else kind,
        7: tables if first and tables else None,
    }
    rows = np.full((sum(widths), n), 2, np.int32) if rows is None else np.asarray(rows)
    return Layer(
        number,
        np.array(cells, np.int32).reshape(-1, 3),
        np.array([0] * before if rises is None else rises, np.int32),
        np.array([77] * n if codes is None else codes, np.int32),
        None if classes is None else np.array(classes, np.int32),
        np.array(earlier, np.int32),
        np.split(rows, np.cumsum(widths)[:-1]),
        list(layer_rows.values()),
        grids,
        [array for own in made.values() for array in own],
        {key: value for key, value in meta.items() if value is not None},
        choose or (lambda piece, number, k: priors.get(piece, {}).get(number) or default_prior(k)),
        tree,
        base,
    ).written(known)


def later(number: int, cells: Sequence[Sequence[int]], **fields: Any) -> Layer:
    """A slice after the first of its layer."""
    return make_layer(number, ordered(cells), first=False, **fields)


# -- files (clause 3) --------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Chunk:
    """A chunk. None: the value that follows from the payload, for the type and length in the header's list, and the
    length and scene id in the frame. crc: xored to the right CRC-32. layer: what the payload means."""

    type: int
    payload: bytes
    flags: int = 0
    layer: Layer | None = None
    listed: tuple[int, int] | None = None
    length: int | None = None
    scene_id: bytes | None = None
    crc: int = 0

    def frame(self, scene_id: bytes) -> bytes:
        """Its bytes in a file with that scene id."""
        length = len(self.payload) if self.length is None else self.length
        head = struct.pack("<HHI8s", self.type, self.flags, length, self.scene_id or scene_id)
        return head + self.payload + struct.pack("<I", zlib.crc32(head + self.payload) ^ self.crc)


def ancillary(type: int, payload: bytes = b"", **fields: Any) -> Chunk:
    """An ancillary chunk."""
    return Chunk(type, payload, **{"flags": 1, **fields})


@dataclass(frozen=True, eq=False)
class File:
    """A file. header: fields; those of value None are left out, chunk list and digest follow from the chunks.

    packed: bytes instead of the header's. declared: the stated length of the header. crc: xored to the right CRC-32.
    tail: bytes after the last chunk. flips: (chunk, offset in it, mask) of bytes that are changed at last. end: (chunk,
    offset in it) where it is cut. The chunk None begins with the file.
    """

    chunks: Sequence[Chunk]
    header: dict[int, Any] = field(default_factory=lambda: HEADER)
    packed: bytes | None = None
    signature: bytes = SIGNATURE
    major: int = MAJOR
    minor: int = 0
    declared: int | None = None
    crc: int = 0
    tail: bytes = b""
    flips: tuple[tuple[int | None, int, int], ...] = ()
    end: tuple[int | None, int] | None = None

    def fields(self) -> dict[int, Any]:
        chunk_list = [list(c.listed or (c.type, len(c.payload))) for c in self.chunks]
        payloads = b"".join(c.payload for c in self.chunks if not c.flags & 1)
        fields = {1: chunk_list, 14: hashlib.sha256(payloads).digest()[:16], **self.header}
        return {k: fields[k] for k in sorted(fields) if fields[k] is not None}

    def header_bytes(self) -> bytes:
        return pack(self.fields()) if self.packed is None else self.packed

    def start(self, index: int | None) -> int:
        """Offset of a chunk; that of the end of the file for the number of chunks, 0 for None."""
        before = self.chunks[:index]
        return 0 if index is None else 20 + len(self.header_bytes()) + sum(20 + len(c.payload) for c in before)

    @property
    def described(self) -> bytes:
        """The header as it is written, behind its chunk list; all of its bytes where that is not there."""
        header, fields = self.header_bytes(), self.fields()
        chunk_list = pack(1) + pack(fields[1]) if 1 in fields else header
        return header[header.find(chunk_list) + len(chunk_list) :] if chunk_list in header else header

    @property
    def scene_id(self) -> bytes:
        """Clause 3.3."""
        return hashlib.sha256(self.described).digest()[:8]

    def reference(self) -> list[Any]:
        """What files say of it whose base it is (clause 5.6)."""
        parts = [self.described, *(c.frame(self.scene_id) for c in self.chunks if c.type == 0)]
        digest = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).digest()
        rows = sum(len(x.cells) for x in self.slices() if x.number == 0)
        return [self.scene_id, digest, rows, sum(map(len, parts))]

    def data(self) -> bytes:
        header, scene_id = self.header_bytes(), self.scene_id
        declared = len(header) if self.declared is None else self.declared
        front = struct.pack("<8sHHI", self.signature, self.major, self.minor, declared)
        crc = zlib.crc32(header, zlib.crc32(front)) ^ self.crc
        chunks = b"".join(c.frame(scene_id) for c in self.chunks)
        data = bytearray(front + struct.pack("<I", crc) + header + chunks + self.tail)
        for chunk, offset, mask in self.flips:
            data[self.start(chunk) + offset] ^= mask
        return bytes(data if self.end is None else data[: self.start(self.end[0]) + self.end[1]])

    def with_header(self, fields: Mapping[int, Any]) -> File:
        """With other fields in the header; the value None takes one out."""
        return replace(self, header={**self.header, **fields})

    def with_chunk(self, index: int, **fields: Any) -> File:
        """With other fields in one chunk."""
        chunks = list(self.chunks)
        chunks[index] = replace(chunks[index], **fields)
        return replace(self, chunks=tuple(chunks))

    def layer(self, index: int) -> Layer:
        """The meaning of a layer's chunk."""
        return self.chunks[index].layer  # type: ignore[return-value]

    def slices(self, chunks: int | None = None) -> list[Layer]:
        """Those among the first `chunks` chunks."""
        return [c.layer for c in self.chunks[:chunks] if c.layer is not None]

    def hashes(self, chunks: int | None = None) -> list[dict[str, Any]]:
        """Clause 12.4 of the layers among the first `chunks` chunks, from what they mean."""
        groups = itertools.groupby(self.slices(chunks), key=lambda x: x.number)
        return [_hashes(list(own), self.fields()) for _, own in groups]


def make_file(*layers: Layer, header: Mapping[int, Any] | None = None) -> File:
    """A file of these layers. Those of one number are the slices of a layer, numbered as they come."""
    chunks = []
    for number, slices in itertools.groupby(layers, key=lambda x: x.number):
        own = list(slices)
        flags = [i << 6 | 2 * (i + 1 < len(own)) for i in range(len(own))]
        chunks += [Chunk(number, x.payload(), f, x) for f, x in zip(flags, own, strict=True)]
    widths = [len(tensor) for tensor in layers[0].rows]
    rows = [[i, width, STEPS[i % 3], 0] for i, width in enumerate(widths)]
    centres = {} if layers[0].classes is None else {5: [i % 5 - 2 for i in range(sum(widths))]}
    return File(tuple(chunks)).with_header({3: [0, widths[-1] // 3, 0], 4: rows, **centres, **(header or {})})


def adding(base: File, *layers: Layer, header: Mapping[int, Any] | None = None) -> File:
    """A file of these layers that adds to the layer 0 of another one."""
    shared = {key: base.fields().get(key) for key in (3, 4, 5, 6)}
    return make_file(*layers, header={**shared, 15: base.reference(), **(header or {})})


def read_file(data: bytes) -> File:
    """The parts of a valid file. Its layers have parameters, codes in one piece and a stream, and no meaning."""
    minor, size = struct.unpack_from("<HI", data, 10)
    header, chunks, at = unpack(data[20 : 20 + size]), list[Chunk](), 20 + size
    while at < len(data):
        kind, flags, length = struct.unpack_from("<HHI", data, at)
        chunk = Chunk(kind, data[at + 16 : at + 16 + length], flags)
        if kind < 3:
            codes = 4 + int.from_bytes(chunk.payload[:4], "little")
            meta = unpack(chunk.payload[4:codes])
            end = codes + meta.pop(2)
            pieces, stream = {"codes": chunk.payload[codes:end]}, chunk.payload[end:]
            chunk.layer = replace(make_layer(kind, ()), meta=meta, pieces=pieces, stream=stream)
        chunks.append(chunk)
        at += 20 + length
    del header[1]
    return File(chunks, header, minor=minor)


def _values(k: np.ndarray, classes: np.ndarray | None, centres: Sequence[int], predictor: int) -> np.ndarray:
    """int64 [C, n] of symbols (clause 11.2)."""
    own = [0] * k.shape[1] if classes is None else classes.tolist()
    v = [row_values(channel, own, centre, predictor) for channel, centre in zip(k.tolist(), centres, strict=True)]
    return np.array(v, np.int64).reshape(k.shape)


def _hashes(slices: list[Layer], header: Mapping[int, Any]) -> dict[str, Any]:
    first = slices[0]
    cells, codes = (np.concatenate([getattr(x, name) for x in slices]) for name in ("cells", "codes"))
    order, before = morton_order(cells), len(first.rises)
    arrays = [(cells[order], header[6]), (first.rises, 0), (codes[order], 0)]
    if first.classes is not None:
        arrays.append((np.concatenate([x.classes for x in slices])[order], 0))
    centres = header.get(5, [0] * sum(row[1] for row in header[4]))
    for i, (_, width, step, predictor) in enumerate(header[4]):
        own, centres = centres[:width], centres[width:]
        k = [_values(x.rows[i], x.classes, own, predictor) for x in slices]
        arrays.append((np.concatenate(k, axis=1)[:, order], step))
    for i, (_, width, step, predictor) in enumerate(first.meta.get(7, ())):
        classes = [None if x.classes is None else np.append(x.earlier, x.classes) for x in slices]
        k = [_values(x.layer_rows[i], c, [0] * width, predictor) for x, c in zip(slices, classes, strict=True)]
        k[:1] = np.split(k[0], [before], axis=1)
        arrays.append((np.concatenate([k[0], np.concatenate(k[1:], axis=1)[:, order]], axis=1), step))
    tensors = [a.T if i else a for i, a in enumerate(a.astype(np.float64) * step for a, step in arrays if step)]
    tensors += [a * first.meta[4][0] for a in first.planes] + [a * first.meta[5][0] for a in first.chains]
    symbols = [*(a for a, _ in arrays), *first.planes, *first.chains]
    forms = (("symbols", "<i4", symbols), ("tensors", "<f4", tensors))
    return {"layer": first.number} | {
        name: hashlib.sha256(b"".join(a.astype(form).tobytes() for a in own)).hexdigest() for name, form, own in forms
    }
