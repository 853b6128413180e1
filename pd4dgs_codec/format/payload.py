"""A slice's symbols <-> the payload of its chunk (clause 6).

A payload is the u32 length of the parameters, the parameters as canonical msgpack, and the sections in the order of
Section. Mode ans codes each group of channels as a section; mode lzma codes all of them as one LZMA2 stream. A channel
is one scalar of the anchors' attributes, one channel of a plane (its residuals, row by row), or one weight or bias.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from pd4dgs_codec.entropy.channels import Places, decode_channels, decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted, entropy_bits, histogram
from pd4dgs_codec.entropy.lzma_mode import decode_channels_lzma, encode_channels_lzma
from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import LimitExceeded, Malformed
from pd4dgs_codec.format import canonical, deformation
from pd4dgs_codec.format.canonical import Fields
from pd4dgs_codec.format.deformation import Scale, Shape
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.quantise import MAX_SYMBOL, NO_CLASSES, magnitude
from pd4dgs_codec.format.registry import MAX_ANCHORS, MAX_PARAMETERS, MAX_PAYLOAD, LayerKind, Section
from pd4dgs_codec.format.symbols import LayerSymbols
from pd4dgs_codec.scene import MASK_MIN_CODE, MAX_CLASS, Deformation, Widths

# Keys of the layer parameters; `deformation` has the others.
ROWS, SECTIONS = 1, 2

#: A file of S symbols has at least (S - FREE_SYMBOLS) / SYMBOLS_PER_BYTE bytes, so that a few bytes that declare
#: constant channels cannot make a decoder allocate without end. Real scenes spend over 0.1 bit per symbol.
FREE_SYMBOLS = 1 << 22
SYMBOLS_PER_BYTE = 256
#: The same bound for anchors, which may cost almost nothing each; a position takes up to 42 symbols.
FREE_ROWS = 1 << 13
ROWS_PER_BYTE = 2


# -- parameters --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Declared:
    """Sums over the slices of a file so far: rows, symbols and bytes of payloads. scales: of all their planes."""

    rows: int = 0
    symbols: int = 0
    payload_bytes: int = 0
    scales: tuple[Scale, ...] = ()


@dataclass(frozen=True)
class Parameters:
    """The parameters of a slice. rows: its own anchors. rises: earlier anchors whose mask codes it raises. sections:
    length in bytes by Section. steps: by field of Steps."""

    rows: int
    rises: int
    sections: dict[int, int]
    steps: dict[str, float]
    shape: Shape
    widths: Widths

    @property
    def symbols(self) -> int:
        """Number of symbols of the slice, voxel indices and masks included."""
        return self.rises + self.rows * (self.widths.channels + self.widths.graded + 4) + self.shape.symbols


def read_parameters(
    payload: bytes | memoryview, kind: LayerKind, widths: Widths, before: Declared, later: bool = False
) -> tuple[Parameters, int, Declared]:
    """Returns (parameters, offset of the first section, sums with this slice) of a payload. Checks all lengths against
    the payload's size and all counts against their limits.

    widths: of the anchors. before: sums over earlier slices. later: whether it is not the first slice of its layer.
    Raises subclasses of DecodeError.
    """
    where = f"layer {kind.layer}"
    if len(payload) < 4:
        raise Malformed(f"{where}: payload of {len(payload)} bytes, expected at least 4")
    (length,) = struct.unpack_from("<I", payload)
    if length > MAX_PARAMETERS:
        raise LimitExceeded(f"{where}: parameters of {length} bytes, limit {MAX_PARAMETERS}")
    if length > len(payload) - 4:
        raise Malformed(f"{where}: parameters of {length} bytes, expected at most {len(payload) - 4}")
    fields = Fields(canonical.unpack(payload[4 : 4 + length]), where, {ROWS, SECTIONS, *deformation.KEYS})
    known = {int(section) for section in Section}
    sections = Fields(fields.get(SECTIONS), f"{where} sections", known)
    shape, steps = deformation.unpack_parameters(fields, kind, widths, before.scales, later, where)
    parameters = Parameters(
        rows=fields.integer(ROWS, MAX_ANCHORS - before.rows),
        rises=0 if later else before.rows,
        sections={s: sections.integer(s, MAX_PAYLOAD, low=1) for s in known if s in sections},
        steps=steps,
        shape=shape,
        widths=widths,
    )
    start, declared = 4 + length, sum(parameters.sections.values())
    if start + declared != len(payload):
        raise Malformed(f"{where}: sections of {declared} bytes, expected {len(payload) - start}")
    total = Declared(
        before.rows + parameters.rows,
        before.symbols + parameters.symbols,
        before.payload_bytes + len(payload),
        before.scales + shape.scales,
    )
    _check_declared(total, where)
    return parameters, start, total


def _check_declared(total: Declared, where: str) -> None:
    """Raises LimitExceeded if the slices so far are too short for what they declare (clause 6.5)."""
    for what, found, free, per_byte in (
        ("anchors", total.rows, FREE_ROWS, ROWS_PER_BYTE),
        ("symbols", total.symbols, FREE_SYMBOLS, SYMBOLS_PER_BYTE),
    ):
        limit = free + per_byte * total.payload_bytes
        if found > limit:
            size = f"{total.payload_bytes} bytes of payloads up to here"
            raise LimitExceeded(f"{where}: {found} {what} in {size}, limit {limit}")


Known = TypeVar("Known", Prior, Fitted)


@dataclass(eq=False)
class Past(Generic[Known]):
    """Priors of a layer's earlier slices that a later slice may use, by section, in order of definition."""

    positions: list[Known] = field(default_factory=list)
    masks: list[Known] = field(default_factory=list)
    attributes: list[Known] = field(default_factory=list)

    def copy(self) -> "Past[Known]":
        """A copy that grows independently."""
        return Past(list(self.positions), list(self.masks), list(self.attributes))


# -- writing -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StreamReport:
    """A coded section. rate_bits: sum of R(a) of its channels, the cost in the trainer's rate model."""

    name: str
    payload_bits: int
    rate_bits: float
    symbols: int


def write_layer(
    symbols: LayerSymbols, options: EncodeOptions, past: Past[Fitted] | None = None
) -> tuple[bytes, list[StreamReport]]:
    """Returns (payload of a slice, a report per section, the positions first). The inverse of read_layer.

    past: priors of the layer's earlier slices, to which those of this one are added.
    """
    past = past or Past()
    coded = deformation.decorrelate(symbols.tensors, symbols.kind)
    sections = {Section.POSITIONS: (encode_positions(symbols.anchor_q, options.effort, past.positions), 0.0)}
    if options.mode == "lzma":
        sections |= _write_lzma(symbols, coded, options)
    else:
        sections |= _write_ans(symbols, coded, options, past)
    counts = _counts(symbols, coded)
    reports = [
        StreamReport(section.name.lower(), 8 * len(data), rate_bits, counts[section])
        for section, (data, rate_bits) in sections.items()
    ]
    parts = {section: data for section, (data, _) in sections.items() if data}
    fields = {ROWS: len(symbols.anchor_q), SECTIONS: {int(section): len(data) for section, data in parts.items()}}
    own = deformation.pack_parameters(symbols.tensors, symbols.kind, symbols.steps, coded.predictors)
    packed = canonical.pack(fields | own)
    return b"".join([struct.pack("<I", len(packed)), packed, *parts.values()]), reports


def _counts(symbols: LayerSymbols, coded: deformation.Decorrelated) -> dict[Section, int]:
    counts = {
        Section.POSITIONS: symbols.anchor_q.size,
        Section.MASKS: symbols.mask_increase.size + symbols.mask_own.size,
        Section.ATTRIBUTES: symbols.classes.size + symbols.attributes.size,
        Section.PLANES: sum(plane.size for plane in coded.planes),
        Section.WEIGHTS: sum(weight.size for weight in coded.weights),
    }
    return counts | {Section.SYMBOLS: sum(counts.values()) - counts[Section.POSITIONS]}


def _write_ans(
    symbols: LayerSymbols, coded: deformation.Decorrelated, options: EncodeOptions, past: Past[Fitted]
) -> dict[Section, tuple[bytes, float]]:
    """Returns (bytes, sum of R(a)) by section, only for sections with symbols."""
    sections = {}
    masks = [symbols.mask_increase, symbols.mask_own]
    if any(channel.size for channel in masks):
        found = encode_channels(masks, priors=options.priors, effort=options.effort, known=past.masks)
        sections[Section.MASKS] = found.payload, found.rate_bits
    if symbols.attributes.size:
        sections[Section.ATTRIBUTES] = write_attributes(
            symbols.attributes, symbols.classes, options.priors, options.effort, past.attributes
        )
    return sections | deformation.write_sections(coded, options)


def _write_lzma(
    symbols: LayerSymbols, coded: deformation.Decorrelated, options: EncodeOptions
) -> dict[Section, tuple[bytes, float]]:
    """Returns one section with all channels, none without symbols. Its rate leaves out masks and splits attributes by
    step class."""
    graded = [symbols.classes] if symbols.widths.graded else []
    masks, rest = [symbols.mask_increase, symbols.mask_own], [*coded.plane_channels, *coded.weights]
    channels = [*masks, *graded, *symbols.attributes, *rest]
    if not any(channel.size for channel in channels):
        return {}
    data = encode_channels_lzma(channels, effort=options.effort)
    counted = [*by_class(symbols.attributes, symbols.classes), *rest]
    rate_bits = sum(histogram(channel).rate_bits for channel in counted if channel.size)
    return {Section.SYMBOLS: (data, rate_bits + entropy_bits(symbols.classes))}


# -- reading -----------------------------------------------------------------------------------------------------------


def read_layer(
    payload: bytes | memoryview,
    kind: LayerKind,
    widths: Widths,
    before: Declared,
    mode: str,
    later: bool = False,
    past: Past[Prior] | None = None,
) -> tuple[LayerSymbols, Declared]:
    """Returns (symbols, sums with this slice) of a payload. Arguments as in read_parameters.

    past: priors of the layer's earlier slices, to which those of this one are added. Raises subclasses of DecodeError;
    nothing is allocated for a count beyond the limits or the payload.
    """
    past = past or Past()
    parameters, start, declared = read_parameters(payload, kind, widths, before, later)
    sections = _Sections(payload, start, parameters.sections, kind)
    data = sections.take(Section.POSITIONS, parameters.rows)
    anchor_q = decode_positions(data, parameters.rows, past.positions)
    content = _read_lzma(sections, parameters) if mode == "lzma" else _read_ans(sections, parameters, past)
    increase, own, classes, attributes, tensors = content
    sections.check_empty()
    for name, codes, low in (("rise of a mask code", increase, 0), ("mask code", own, MASK_MIN_CODE)):
        if codes.size and not (low <= codes.min() and codes.max() <= 255):
            found = f"{int(codes.min())}..{int(codes.max())}"
            raise Malformed(f"layer {kind.layer}: {name} in {found}, expected {low}..255")
    if magnitude(attributes) > MAX_SYMBOL:
        raise Malformed(f"layer {kind.layer}: an attribute's symbol over {MAX_SYMBOL} in magnitude")
    return LayerSymbols(kind, widths, anchor_q, increase, own, classes, attributes, tensors, parameters.steps), declared


class _Sections:
    """The sections of a payload, each to be taken once."""

    def __init__(self, payload: bytes | memoryview, start: int, lengths: dict[int, int], kind: LayerKind):
        self._parts: dict[int, bytes] = {}
        self._kind = kind
        for section, length in sorted(lengths.items()):
            self._parts[section] = bytes(payload[start : start + length])
            start += length

    def take(self, section: Section, symbols: int) -> bytes:
        """Returns a section's bytes. Raises Malformed if it is missing with symbols to code, or there without any."""
        if (section in self._parts) != (symbols > 0):
            found = "present" if section in self._parts else "missing"
            raise Malformed(f"section {section.name.lower()} is {found} for {symbols} symbols")
        return self._parts.pop(section, b"")

    def check_empty(self) -> None:
        """Raises Malformed if a section has not been taken."""
        if self._parts:
            where = f"layer {self._kind.layer}: section {min(self._parts)}"
            raise Malformed(f"{where} is present for 0 symbols")


#: Rises, own codes, step classes, attributes, planes and networks of a slice, as in LayerSymbols.
Content = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Deformation]


def _read_ans(sections: _Sections, parameters: Parameters, past: Past[Prior]) -> Content:
    rows, widths = parameters.rows, parameters.widths
    sizes = [parameters.rises, rows]
    masks = sections.take(Section.MASKS, sum(sizes))
    increase, own = decode_channels(masks, sizes, past.masks)
    data = sections.take(Section.ATTRIBUTES, rows)
    classes, attributes = NO_CLASSES, np.zeros((widths.channels, 0), np.int32)
    if data:
        classes, attributes = read_attributes(data, widths, rows, past.attributes)
    return increase, own, classes, attributes, deformation.read_sections(sections.take, parameters.shape)


def _read_lzma(sections: _Sections, parameters: Parameters) -> Content:
    widths, (planes, weights) = parameters.widths, deformation.channel_sizes(parameters.shape)
    first = 2 + widths.graded
    last = first + widths.channels
    sizes = [parameters.rises, *[parameters.rows] * (last - 1), *planes, *weights]
    data = sections.take(Section.SYMBOLS, sum(sizes))
    channels = decode_channels_lzma(data, sizes) if data else [np.zeros(0, np.int32) for _ in sizes]
    classes, attributes = channels[2] if widths.graded else NO_CLASSES, np.stack(channels[first:last])
    check_classes(classes)
    end = last + len(planes)
    tensors = deformation.from_channels(channels[last:end], channels[end:], parameters.shape)
    return channels[0], channels[1], classes, attributes, tensors


# -- the attributes section of mode ans (clause 8.5): features, log-scalings and offsets by step class -----------------


def write_attributes(
    attributes: np.ndarray, classes: np.ndarray, priors: str, effort: int, known: list[Fitted]
) -> tuple[bytes, float]:
    """Returns (section bytes, bits of R(a) of all channels by step class and of the step classes).

    attributes: int32 [channels, n]. classes: int32 [n], or NO_CLASSES. known: priors of the layer's earlier slices, to
    which those of this one are added.
    """
    coded = encode_channels(list(by_class(attributes, classes)), priors=priors, effort=effort, known=known)
    if not classes.size:
        return coded.payload, coded.rate_bits
    out, graded = bytearray(), encode_channels([classes], effort=effort).payload
    put_varint(out, len(graded))
    return bytes(out + graded + coded.payload), coded.rate_bits + entropy_bits(classes)


def by_class(attributes: np.ndarray, classes: np.ndarray) -> Iterator[np.ndarray]:
    """Yields the coded channels, int [n]: each channel's rows of class 0 .. MAX_CLASS, or all without classes."""
    yield from Places.by(classes, MAX_CLASS + 1).parts(attributes) if classes.size else attributes


def read_attributes(
    data: bytes, widths: Widths, rows: int, known: list[Prior] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]); the inverse of write_attributes.
    rows: already checked against the limits. known: priors of the layer's earlier slices, to which those of this one
    are added."""
    if not widths.graded:
        return NO_CLASSES, decode_joined(data, [rows] * widths.channels, known).reshape(widths.channels, rows)
    reader = ByteReader(data)
    length = reader.varint(reader.remaining, "the length of the step classes")
    (classes,) = decode_channels(reader.take(length), [rows])
    check_classes(classes)
    places, attributes = Places.by(classes, MAX_CLASS + 1), np.empty((widths.channels, rows), np.int32)
    places.put(decode_joined(reader.rest(), places.sizes * widths.channels, known), attributes)
    return classes, attributes


def check_classes(classes: np.ndarray) -> None:
    """Raises Malformed unless classes int32 [n] are in 0..MAX_CLASS."""
    if classes.size and not (0 <= classes.min() and classes.max() <= MAX_CLASS):
        raise Malformed(f"step classes in {int(classes.min())}..{int(classes.max())}, expected 0..{MAX_CLASS}")
