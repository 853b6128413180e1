"""Writes `.pd4` structures from explicit choices, right or wrong.

Nothing here searches, fits or rounds: the caller names every prior, form, predictor and field, or it follows from the
symbols by a rule on integers, so the bytes are the same on every machine. Lengths, scene ids and CRCs are right unless
the caller asks for others.
"""

from __future__ import annotations

import hashlib
import itertools
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.ans import ans_encode
from pd4dgs_codec.entropy.positions import position_channels
from pd4dgs_codec.entropy.priors import FIRST_REUSE, Const, Gauss, Normal, Prior, Window
from pd4dgs_codec.entropy.varint import put_varint, put_zigzag
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.container import MAJOR, SIGNATURE
from pd4dgs_codec.format.planes import residual
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import DEFAULT_WIDTHS, Widths, plane_shapes

from . import lzma2

POSITIONS, MASKS, ATTRIBUTES, PLANE, WEIGHTS, SYMBOLS = range(6)  # sections (clause 6.4)
ANS, LZMA = 0, 1
HEADER: dict[int, Any] = {
    2: ANS,
    4: [0.0625, 0.03125, 0.125],
    5: 2.0**-7,
    6: [-1.0, -2.0, -3.0, 1.0, 2.0, 3.0],
    7: [0.5, 3.25],
    8: [0.0, 0.5, 1.0],
    9: [0.125, 64.0],
    10: [0.0, -1.0, 0.0],
    11: 1.5,
    # of all classes: a file may declare bounds for tensors that it does not have
    13: dict(enumerate([0.03125, 0.015625, 0.0625, 2.0**-8, 0.25, 2.0**-9, 0.5, 2.0**-10])),
    15: [32, 10, 7],
}
CAMERA: dict[int, Any] = {
    1: [1.0, 0.0, 0.0, 0.25, 0.0, 0.0, -1.0, 0.5, 0.0, 1.0, 0.0, 4.0],
    2: [500.0, 501.0, 320.0, 240.0],
    3: 640,
    4: 480,
}
NO_CLASSES = np.zeros(0, np.int32)


# -- primitives --------------------------------------------------------------------------------------------------------


def varint(*values: int) -> bytes:
    """Clause 7.1."""
    out = bytearray()
    for value in values:
        put_varint(out, value)
    return bytes(out)


def zigzag(*values: int) -> bytes:
    """Clause 7.1."""
    out = bytearray()
    for value in values:
        put_zigzag(out, value)
    return bytes(out)


def words(*values: int) -> bytes:
    """u32 words of an ANS stream."""
    return struct.pack(f"<{len(values)}I", *values)


def pattern(*shape: int, low: int = -3, high: int = 3, seed: int = 0) -> np.ndarray:
    """int32 of `shape` in low..high that look irregular: upper bits of a Lehmer generator."""
    state, values = seed * 7919 + 12345, []
    for _ in range(int(np.prod(shape))):
        state = state * 48271 % (2**31 - 1)
        values.append(low + (state >> 8) % (high - low + 1))
    return np.array(values, np.int32).reshape(shape)


# -- coded channels (clause 8) -----------------------------------------------------------------------------------------


@lru_cache
def gauss(low: int, n: int, *, si: int = 64, offset: int = 0) -> Gauss:
    """A Gaussian prior over n entries from `low`. offset: of its mean from the middle of the window, entries / 256."""
    return Gauss(Window(low, n), Normal(offset + 128 * (n - 1), si))


SMALL = gauss(-3, 7)


def default_prior(symbols: np.ndarray) -> Prior:
    """The prior of a channel for which the caller names none, by the range of its symbols."""
    low, high = int(symbols.min()), int(symbols.max())
    if low == high:
        return Const(Window(low, 1))
    if -3 <= low and high <= 3:
        return SMALL
    n, most = high - low + 1, (1 << 24) - 1
    if n > 1 << 14:  # around the median; the others are exceptions
        low, n = int(np.sort(symbols)[len(symbols) // 2]) - 7, 15
    return gauss(min(max(low, -most), most - n + 1), n, si=64 * n.bit_length() - 128)


Known = list[bytes]  # definitions of priors
Coder = Callable[[Iterable[np.ndarray]], bytes]  # of the channels of a section


def coded(
    channels: Iterable[Iterable[int]], priors: Mapping[int, Prior] | None = None, known: Known | None = None
) -> bytes:
    """A section of coded channels: its parameter block and its ANS stream.

    Symbols outside the window of a prior become exceptions. A prior that is defined already is referred to. priors: of
    some channels, by their number. known: definitions of the slices before, to which those of this section are added.
    """
    block, defined = b"", [] if known is None else known
    parts, used = list[tuple[np.ndarray, Prior]](), dict[bytes, Prior]()
    for number, channel in enumerate(channels):
        k = np.asarray(channel, np.int64)
        if not k.size:
            continue
        prior = (priors or {}).get(number) or default_prior(k)
        window = prior.window
        inside = (k >= window.kmin) & (k < window.end)
        parameters = bytearray()
        prior.write(parameters)
        key = bytes([prior.id]) + parameters
        if key in defined:
            block += varint(2 * (FIRST_REUSE + defined[::-1].index(key)) + (not inside.all()))
        else:
            block += varint(2 * prior.id + (not inside.all())) + parameters
            defined.append(key)
        if not inside.all():
            block += _exceptions(k, inside, window)
        parts.append((k[inside] - window.kmin, used.setdefault(key, prior)))  # one makes a table for all equal ones
    return block + ans_encode([symbols for symbols, _ in parts], [prior.cum for _, prior in parts])


def _exceptions(k: np.ndarray, inside: np.ndarray, window: Window) -> bytes:
    places = np.flatnonzero(~inside).tolist()
    out = varint(len(places) - 1)
    for last, at in zip([-1, *places], places, strict=False):
        below = 2 * (window.kmin - 1 - int(k[at])) + 1
        out += varint(at - last - 1, below if below > 0 else 2 * (int(k[at]) - window.end))
    return out


def positions(cells: np.ndarray, coder: Coder) -> bytes:
    """Section POSITIONS of int32 [n, 3] in Morton order (clause 10)."""
    head, channels = position_channels(cells)
    return head + coder(channels)


def graded_part(classes: np.ndarray, length: int | None = None, coder: Coder = coded) -> bytes:
    """The step classes of the rows as the attributes section has them. length: stated instead of the true one."""
    if not classes.size:
        return b""
    section = coder([classes])
    return varint(len(section) if length is None else length) + section


def relative_magnitude(e: np.ndarray) -> np.ndarray:
    """int64 [n] of residuals int64 [m, n] (clause 8.7)."""
    parts = (abs(c) * 256 * e.shape[1] // (1 + int(abs(c).sum())) for c in e)
    return sum(parts, np.zeros(e.shape[1], np.int64))


def classes_of_plane(e: np.ndarray) -> np.ndarray:
    """Class 0..7 [H·W] of each cell, by residuals int64 [m, H, W] of the stages before (clause 8.6)."""
    _, height, width = e.shape
    size = relative_magnitude(e.reshape(len(e), -1)).reshape(height, width)
    i, j = np.indices((height, width))
    near = itertools.product((-1, 0, 1), repeat=2)
    parts = (size[np.clip(i + a, 0, height - 1), np.clip(j + b, 0, width - 1)] for a, b in near)
    activity = sum(parts, np.zeros_like(size)).ravel()
    bounds = np.sort(activity)[[i * len(activity) // 8 for i in range(1, 8)]]
    return np.searchsorted(bounds, activity, side="right")


Lengths = Callable[[list[int]], list[int]]
StagePriors = Mapping[int, Mapping[int, Prior]]  # by stage, then by channel of the stage


def coded_planes(
    planes: Sequence[np.ndarray],
    lengths: Lengths = lambda sizes: sizes,
    tail: bytes = b"",
    priors: StagePriors | None = None,
) -> bytes:
    """Section PLANES of residuals int32 [C, H, W] (clause 8.6). lengths: the stated ones of all stages but the last,
    from the true ones."""
    payloads = [coded(stage, (priors or {}).get(number)) for number, stage in enumerate(plane_stages(planes))]
    return varint(*lengths([len(p) for p in payloads[:-1]])) + b"".join(payloads) + tail


def plane_stages(planes: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """The channels of the stages of clause 8.6."""
    stages = []
    for stage in range(max(1, (len(planes[0]) - 1).bit_length())):
        first, end, channels = (1 << stage if stage else 0), 2 << stage, list[np.ndarray]()
        for plane in planes:
            e = plane.astype(np.int64)
            classes = classes_of_plane(e[:first]) if stage else None
            for channel in map(np.ravel, e[first:end]):
                channels += [channel] if classes is None else [channel[classes == q] for q in range(8)]
        stages.append(channels)
    return stages


# -- LZMA sections (clause 9) ------------------------------------------------------------------------------------------


def lzma_symbols(
    channels: Sequence[np.ndarray],
    *,
    base: int | None = 0,
    width: int | None = None,
    planar: bool = False,
    stream: Callable[[bytes], bytes] = lzma2.stored,
) -> bytes:
    """Section SYMBOLS. base: of all channels; None takes the first symbol of each. width: log2 of the bytes of every
    number; None takes the narrowest."""
    out, data = bytes([planar]), b""
    for channel in channels:
        if channel.size:
            own = int(channel[0]) if base is None else base
            v = channel.astype(np.int64) - own
            reach = max(int(v.max()) + 1, -int(v.min()))
            w = (reach > 1 << 7) + (reach > 1 << 15) if width is None else width
            out += varint(4 * (2 * own if own >= 0 else -2 * own - 1) + w)
            numbers = v.astype(("<i1", "<i2", "<i4")[w])
            data += numbers.view(np.uint8).reshape(-1, numbers.itemsize).T.tobytes() if planar else numbers.tobytes()
    return out + stream(data)


# -- layers (clause 6) -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Layer:
    """A slice of a layer: what it means, and its parameters and sections as they are written.

    planes, weights: symbols. residuals: of the planes. meta: the layer parameters without the lengths of the sections.
    """

    number: int
    widths: Widths
    cells: np.ndarray
    rises: np.ndarray
    codes: np.ndarray
    classes: np.ndarray
    attributes: np.ndarray
    planes: list[np.ndarray]
    residuals: list[np.ndarray]
    weights: list[np.ndarray]
    meta: dict[int, Any]
    sections: dict[int, bytes] = field(default_factory=dict)

    def parameters(self) -> dict[int, Any]:
        """The layer parameters."""
        return {**self.meta, 2: {s: len(self.sections[s]) for s in sorted(self.sections)}}

    def payload(self, packed: bytes | None = None) -> bytes:
        """Its bytes. packed: instead of its parameters."""
        packed = canonical.pack(self.parameters()) if packed is None else packed
        return struct.pack("<I", len(packed)) + packed + b"".join(self.sections[s] for s in sorted(self.sections))

    def padded(self, size: int) -> bytes:
        """Its bytes, with parameters of `size` bytes due to an ignored key."""
        bare = len(canonical.pack(self.parameters()))
        form = 2 if size - bare - 3 < 1 << 8 else 3
        return self.payload(canonical.pack({**self.parameters(), 64: bytes(size - bare - 1 - form)}))

    def with_sections(self, sections: Mapping[int, bytes | None]) -> Layer:
        """With other bytes in some sections; None takes one out."""
        both = {**self.sections, **sections}
        return replace(self, sections={s: data for s, data in both.items() if data is not None})

    @property
    def flat(self) -> list[np.ndarray]:
        """The channels of section PLANES."""
        return [channel.ravel() for plane in self.residuals for channel in plane]

    @property
    def channels(self) -> list[np.ndarray]:
        """The channels of section SYMBOLS."""
        grades = [self.classes] if self.widths.graded else []
        return [self.rises, self.codes, *grades, *self.attributes, *self.flat, *(w.ravel() for w in self.weights)]


@dataclass(frozen=True)
class Scale:
    """One scale of a HexPlane. fill: makes the symbols of one plane from its name and shape."""

    channels: int = 2
    sides: tuple[int, ...] = (3, 2, 4, 2)
    predictors: tuple[int, ...] = (0,) * 6
    fill: Callable[[str, tuple[int, ...]], np.ndarray] = lambda name, shape: pattern(*shape, seed=ord(name[0]))

    def planes(self) -> list[np.ndarray]:
        """int32 [C, H, W] each, in the order of the format."""
        return [self.fill(*plane) for plane in plane_shapes(self.channels, self.sides).items()]


def constant(value: int) -> Callable[[str, tuple[int, ...]], np.ndarray]:
    """A `fill` of one symbol."""
    return lambda name, shape: np.full(shape, value, np.int32)


def constant_networks(widths: Mapping[int, Sequence[int]], inputs: Mapping[int, int]) -> dict[int, list[np.ndarray]]:
    """id -> weight, bias, weight, ..; each of one symbol of its own. widths: id -> outputs. inputs: id -> inputs."""
    networks, symbol = {}, 2
    for number, outputs in widths.items():
        wide, layers = inputs[number], list[np.ndarray]()
        for out in outputs:
            layers += [np.full((out, wide), symbol, np.int32), np.full(out, symbol - 5, np.int32)]
            wide, symbol = out, symbol + 1
        networks[number] = layers
    return networks


def line(n: int, z: int = 0) -> list[list[int]]:
    """n cells in a row."""
    return [[i, 0, z] for i in range(n)]


def ordered(cells: Any) -> list[list[int]]:
    """Cells in Morton order."""
    array = np.array(cells, np.int32).reshape(-1, 3)
    return array[morton_order(array)].tolist() if len(array) else []


def make_layer(
    number: int = 0,
    cells: Sequence[Sequence[int]] = ((-1, 0, 2),),
    *,
    before: int = 0,
    below: int = 0,
    rises: Sequence[int] | None = None,
    codes: Sequence[int] | None = None,
    attributes: np.ndarray | None = None,
    scales: Sequence[Scale] = (),
    networks: Mapping[int, Sequence[int]] | dict[int, list[np.ndarray]] | None = None,
    steps: Sequence[float] | None = None,
    mode: int | None = ANS,
    widths: Widths = DEFAULT_WIDTHS,
    classes: Sequence[int] | None = None,
) -> Layer:
    """A layer of `cells` (in Morton order) after `before` earlier rows. below: features of the planes of the layer
    below.

    Defaults: every rise 0, every code 77, attributes all 2; in layer 0 the networks without hidden layers, elsewhere a
    trunk and the head 1 if there are `scales`. networks: outputs by id, or their weights and biases. mode: None leaves
    the sections to the caller.
    """
    n = len(cells)
    if networks is None:
        least = {0: (widths.slots,), 1: (7 * widths.slots,), 2: (3 * widths.slots,)} if number == 0 else {}
        networks = {0: (3,), 1: (3,)} if scales else least
    if not any(isinstance(x, np.ndarray) for own in networks.values() for x in own):
        inputs = dict(enumerate(widths.inputs.values()))
        if number:
            read = below + sum(s.channels for s in scales)
            inputs = {i: networks[0][-1] if i else read for i in networks}  # type: ignore[misc]
        networks = constant_networks(networks, inputs)  # type: ignore[arg-type]
    planes = [plane for scale in scales for plane in scale.planes()]
    predictors = [p for s in scales for p in s.predictors]
    meta: dict[int, Any] = {1: n}
    if networks:
        meta[3] = list(steps or ([2.0**-7] if number == 0 else [2.0**-4, 2.0**-6]))
    if scales:
        meta[4] = [[s.channels, *s.sides, *s.predictors] for s in scales]
    if networks:
        meta[5] = [[i, *(len(bias) for bias in own[1::2])] for i, own in networks.items()]
    layer = Layer(
        number=number,
        widths=replace(widths, graded=classes is not None),
        cells=np.array(cells, np.int32).reshape(-1, 3),
        rises=np.array([0] * before if rises is None else rises, np.int32),
        codes=np.array([77] * n if codes is None else codes, np.int32),
        classes=NO_CLASSES if classes is None else np.array(classes, np.int32),
        attributes=np.full((widths.channels, n), 2, np.int32) if attributes is None else attributes,
        planes=planes,
        residuals=[residual(p, k) if k.size else k for p, k in zip(predictors, planes, strict=True)],
        weights=[w for own in networks.values() for w in own],  # type: ignore[misc]
        meta=meta,
    )
    if mode is None:
        return layer
    if mode == LZMA:
        some = any(c.size for c in layer.channels)
        symbols = lzma_symbols(layer.channels, stream=lzma2.packed) if some else None
        return layer.with_sections({POSITIONS: positions(layer.cells, coded) if n else None, SYMBOLS: symbols})
    planes = coded_planes(layer.residuals) if layer.residuals else None
    weights = coded(w.ravel() for w in layer.weights) if layer.weights else None
    return Slices().add(layer.with_sections({PLANE: planes, WEIGHTS: weights}))


def later(number: int, cells: Sequence[Sequence[int]], **fields: Any) -> Layer:
    """A slice after the first of its layer."""
    return make_layer(number, ordered(cells), networks={}, **fields)


def _coder() -> Coder:
    """Of a section that knows what the slices before defined."""
    return partial(coded, known=[])


@dataclass
class Slices:
    """Writes the slices of a layer in turn, each with what those before defined. grades: codes step classes."""

    positions: Coder = field(default_factory=_coder)
    masks: Coder = field(default_factory=_coder)
    attributes: Coder = field(default_factory=_coder)
    grades: Coder = coded

    def add(self, layer: Layer) -> Layer:
        """The slice as it is written."""
        sections, k, classes = dict[int, bytes | None](), layer.attributes, layer.classes
        if layer.codes.size:
            sections[POSITIONS] = positions(layer.cells, self.positions)
        if layer.rises.size or layer.codes.size:
            sections[MASKS] = self.masks([layer.rises, layer.codes])
        if layer.codes.size:
            channels = [c[classes == q] for c in k for q in range(7)] if classes.size else list(k)
            sections[ATTRIBUTES] = graded_part(classes, coder=self.grades) + self.attributes(channels)
        return layer.with_sections(sections)


# -- files (clause 3) --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
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
    tail: bytes after the last chunk.
    """

    chunks: tuple[Chunk, ...]
    header: dict[int, Any] = field(default_factory=lambda: HEADER)
    packed: bytes | None = None
    signature: bytes = SIGNATURE
    major: int = MAJOR
    minor: int = 0
    declared: int | None = None
    crc: int = 0
    tail: bytes = b""

    def fields(self) -> dict[int, Any]:
        """The header map."""
        chunk_list = [list(c.listed or (c.type, len(c.payload))) for c in self.chunks]
        payloads = b"".join(c.payload for c in self.chunks if not c.flags & 1)
        fields = {1: chunk_list, 14: hashlib.sha256(payloads).digest()[:16], **self.header}
        return {k: fields[k] for k in sorted(fields) if fields[k] is not None}

    def header_bytes(self) -> bytes:
        """The header."""
        return canonical.pack(self.fields()) if self.packed is None else self.packed

    def start(self, index: int) -> int:
        """Offset of a chunk; that of the end of the file for the number of chunks."""
        return 20 + len(self.header_bytes()) + sum(20 + len(c.payload) for c in self.chunks[:index])

    @property
    def scene_id(self) -> bytes:
        """Clause 3.3, of the header as it is written. Where its chunk list is not there, of all its bytes."""
        header, fields = self.header_bytes(), self.fields()
        chunk_list = canonical.pack(1) + canonical.pack(fields[1]) if 1 in fields else header
        described = header[header.find(chunk_list) + len(chunk_list) :] if chunk_list in header else header
        return hashlib.sha256(described).digest()[:8]

    def data(self) -> bytes:
        """Its bytes."""
        header, scene_id = self.header_bytes(), self.scene_id
        declared = len(header) if self.declared is None else self.declared
        front = struct.pack("<8sHHI", self.signature, self.major, self.minor, declared)
        crc = zlib.crc32(header, zlib.crc32(front)) ^ self.crc
        frames = b"".join(c.frame(scene_id) for c in self.chunks)
        return front + struct.pack("<I", crc) + header + frames + self.tail

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
        layer = self.chunks[index].layer
        assert layer is not None
        return layer

    def slices(self, chunks: int | None = None) -> list[int]:
        """The layer of each slice among the first `chunks` chunks."""
        return [c.layer.number for c in self.chunks[:chunks] if c.layer is not None]

    def hashes(self, chunks: int | None = None) -> list[dict[str, Any]]:
        """Clause 12.4 of the layers among the first `chunks` chunks, from what they mean."""
        layers = [c.layer for c in self.chunks[:chunks] if c.layer is not None]
        return [_hashes(list(own), self.header) for _, own in itertools.groupby(layers, key=lambda x: x.number)]


def make_file(*layers: Layer, header: Mapping[int, Any] | None = None) -> File:
    """A file of these layers. Those of one number are the slices of a layer, numbered as they come."""
    chunks = []
    for number, slices in itertools.groupby(layers, key=lambda x: x.number):
        own = list(slices)
        flags = [i << 6 | 2 * (i + 1 < len(own)) for i in range(len(own))]
        chunks += [Chunk(number, x.payload(), f, x) for f, x in zip(flags, own, strict=True)]
    widths = layers[0].widths
    views = sum(1 << i for i, inputs in enumerate(widths.inputs.values()) if inputs > widths.feature)
    centres = {3: [i % 5 - 2 for i in range(widths.channels)]} if widths.graded else {}
    return File(tuple(chunks)).with_header({15: [widths.feature, widths.slots, views], **centres, **(header or {})})


def _hashes(slices: list[Layer], header: Mapping[int, Any]) -> dict[str, Any]:
    first, d, slots = slices[0], slices[0].widths.feature, slices[0].widths.slots
    cells = np.concatenate([x.cells for x in slices])
    order = morton_order(cells) if len(cells) else slice(None)
    codes, classes = (np.concatenate([getattr(x, name) for x in slices]) for name in ("codes", "classes"))
    k = np.concatenate([x.attributes for x in slices], axis=1)[:, order]
    classes = classes[order] if classes.size else classes
    values = k.astype(np.int64) << (classes if classes.size else 0)
    values += np.array(header.get(3, [0] * len(k)), np.int64)[:, None]

    def dequantised(symbols: np.ndarray, step: Any) -> np.ndarray:
        return (symbols.astype(np.float64) * np.asarray(step, np.float64)).astype("<f4")

    x = dequantised(values, np.repeat(header[4], [d, 6, 3 * slots])[:, None])
    tensors = [dequantised(cells[order], header[5]), x[:d].T, x[d : d + 6].T, x[d + 6 :].T]
    tensors += [dequantised(p, first.meta[3][0]) for p in first.planes]
    tensors += [dequantised(w, first.meta[3][-1]) for w in first.weights]
    symbols = [cells[order], first.rises, codes[order], classes, k, *first.planes, *first.weights]
    digests = [hashlib.sha256(b"".join(a.tobytes() for a in own)).hexdigest() for own in (
        [a.astype("<i4") for a in symbols], tensors)]  # fmt: skip
    return {"layer": first.number, "symbols": digests[0], "tensors": digests[1]}


# -- vectors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vector:
    """One file of spec/vectors. layers: the hashes of all layers that decode. error: a name of clause 15, None for a
    valid file. chunk, offset: of the fault, if it lies in a chunk and at a field that the frame fixes. slices: the
    layer of each slice that decodes."""

    name: str
    what: str
    clauses: tuple[str, ...]
    data: bytes
    layers: list[dict[str, Any]]
    slices: list[int]
    error: str | None = None
    chunk: int | None = None
    offset: int | None = None
