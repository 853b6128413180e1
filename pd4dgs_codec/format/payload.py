"""A slice's symbols <-> its chunk's payload. A layer is one slice or more; the later ones hold anchors alone.

Payload: u32 length of the parameters, the parameters (layer_meta), then the sections in the order of Section.
Mode ans codes each group of channels as one section; mode lzma codes all of them as one LZMA2 stream. A channel is one
attribute scalar over the slice's anchors, one plane channel (its residuals, row by row), or one weight matrix or bias.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits, gaussian_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.lzma_mode import decode_channels_lzma, encode_channels_lzma
from pd4dgs_codec.entropy.positions import decode_positions, encode_positions
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.errors import LimitExceeded, Malformed
from pd4dgs_codec.format import planes as decorrelation
from pd4dgs_codec.format.attribute_section import Past, by_class, check_classes, read_attributes, write_attributes
from pd4dgs_codec.format.kinds import LayerKind
from pd4dgs_codec.format.layer_meta import (
    Declared,
    LayerMeta,
    ScaleMeta,
    Section,
    check_symbol_count,
    pack_meta,
    unpack_meta,
)
from pd4dgs_codec.format.limits import MAX_PARAMETERS
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plane_choice import choose_predictor
from pd4dgs_codec.format.plane_section import read_planes, write_planes
from pd4dgs_codec.format.quantise import MAX_SYMBOL, magnitude
from pd4dgs_codec.format.symbols import LayerSymbols
from pd4dgs_codec.format.table import NO_CLASSES
from pd4dgs_codec.scene import MASK_MIN_CODE, PLANES, Network, Planes, Widths

#: The groups of channels, by section, in coding order; POSITIONS are not channels.
GROUPS = (Section.MASKS, Section.ATTRIBUTES, Section.PLANES, Section.WEIGHTS)


@dataclass(frozen=True)
class StreamReport:
    """One coded section. rate_bits: sum of R(a) of its channels, what the trainer's rate model would charge."""

    name: str
    payload_bits: int
    rate_bits: float
    symbols: int


def write_layer(
    symbols: LayerSymbols,
    options: EncodeOptions,
    past: Past[Fitted] | None = None,
    population: LayerSymbols | None = None,
) -> tuple[bytes, list[StreamReport]]:
    """(payload, what each section took; the first report is the positions'). Inverse: read_layer.

    past: of the layer's slices before this one, which is added. population: the whole layer.
    """
    groups, predictors = channel_groups(symbols)
    past = past or Past()
    positions = encode_positions(symbols.anchor_q, options.effort, past.positions)
    sections = {Section.POSITIONS: positions}
    reports = [StreamReport("positions", 8 * len(positions), 0.0, symbols.anchor_q.size)]
    if options.mode == "lzma":
        groups = {Section.SYMBOLS: [channel for section in GROUPS for channel in groups[section]]}
    for section, channels in groups.items():
        if not any(channel.size for channel in channels):
            continue
        if section == Section.ATTRIBUTES:
            everything = None if population is None else (population.attributes, population.classes)
            data, rate_bits = write_attributes(
                symbols.attributes, symbols.classes, symbols.widths, options.priors, options.effort, past, everything
            )
        elif section == Section.PLANES:
            data, rate_bits = write_planes(_by_plane(channels, symbols), options.priors, options.effort)
        elif options.mode == "lzma":  # one stream for all, but a layer's rate counts no masks
            coded = encode_channels_lzma(channels, effort=options.effort)
            data, rate_bits = coded.payload, _rate_bits(symbols, coded.rate_bits, channels)
        else:
            known = past.masks if section == Section.MASKS else []
            coded = encode_channels(channels, priors=options.priors, effort=options.effort, known=known)
            known += coded.defined
            data, rate_bits = coded.payload, coded.rate_bits
        sections[section] = data
        count = sum(channel.size for channel in channels)
        reports.append(StreamReport(section.name.lower(), 8 * len(data), rate_bits, count))
    meta = pack_meta(_meta(symbols, sections, predictors), symbols.kind)
    return b"".join([struct.pack("<I", len(meta)), meta, *sections.values()]), reports


def _rate_bits(symbols: LayerSymbols, rate_bits: float, channels: list[np.ndarray]) -> float:
    """The rate of all channels of a layer but the masks, with attributes by step class, from that of each as it is."""
    rate_bits -= sum(gaussian_bits(c) for c in channels[:2])
    if symbols.widths.graded:
        graded = channels[2 : 3 + symbols.widths.channels]
        rate_bits += entropy_bits(symbols.classes)
        rate_bits += sum(gaussian_bits(c) for c in by_class(symbols.attributes, symbols.classes) if c.size)
        rate_bits -= sum(gaussian_bits(c) for c in graded if c.size)
    return rate_bits


def channel_groups(symbols: LayerSymbols) -> tuple[dict[Section, list[np.ndarray]], list[int]]:
    """(1-D int32 channels per group, predictor per plane)."""
    groups: dict[Section, list[np.ndarray]] = {section: [] for section in GROUPS}
    groups[Section.MASKS] = [symbols.mask_increase, symbols.mask_own]
    groups[Section.ATTRIBUTES] = [*([symbols.classes] if symbols.widths.graded else []), *symbols.attributes]
    n_planes = len(PLANES) * len(symbols.planes)
    predictors = [0] * n_planes
    for i, tensor in enumerate(symbols.tensors()):
        if i < n_planes:
            predictors[i], residual = choose_predictor(tensor)
            groups[Section.PLANES] += list(residual.reshape(residual.shape[0], -1))
        else:
            groups[Section.WEIGHTS].append(tensor.ravel())
    return groups, predictors


def _by_plane(channels: list[np.ndarray], symbols: LayerSymbols) -> list[np.ndarray]:
    """Residuals [C, H, W] per plane from one array per plane channel."""
    rest = iter(channels)
    shapes = [scale[name].shape for scale in symbols.planes for name, _, _ in PLANES]
    return [np.stack([next(rest) for _ in range(shape[0])]).reshape(shape) for shape in shapes]


def _meta(symbols: LayerSymbols, sections: dict[Section, bytes], predictors: list[int]) -> LayerMeta:
    scales = []
    for i, scale in enumerate(symbols.planes):
        (channels, y, x), (_, t, z) = scale["xy"].shape, scale["zt"].shape
        own = predictors[len(PLANES) * i : len(PLANES) * (i + 1)]
        scales.append(ScaleMeta(channels, (x, y, z, t), tuple(own)))
    return LayerMeta(
        rows=len(symbols.anchor_q),
        sections={int(section): len(data) for section, data in sections.items() if data},
        steps=symbols.steps,
        scales=tuple(scales),
        networks={name: tuple(w.shape[0] for w, _ in network) for name, network in symbols.networks.items()},
        widths=symbols.widths,
    )


def read_meta(
    payload: bytes | memoryview,
    kind: LayerKind,
    widths: Widths,
    before: Declared,
    later: bool = False,
) -> tuple[LayerMeta, int, Declared]:
    """(parameters, offset of the first section, what the file declares with this slice) of a payload, all lengths
    checked against the bytes there are. widths: of the anchors. before: what the slices before it declare. later:
    behind its layer's first."""
    if len(payload) < 4:
        raise Malformed(f"layer {kind.layer}: payload of {len(payload)} bytes, expected at least 4")
    (length,) = struct.unpack_from("<I", payload)
    if length > MAX_PARAMETERS:
        raise LimitExceeded(f"layer {kind.layer}: parameters of {length} bytes, limit {MAX_PARAMETERS}")
    if length > len(payload) - 4:
        raise Malformed(f"layer {kind.layer}: parameters of {length} bytes in a payload of {len(payload)}")
    meta = unpack_meta(bytes(payload[4 : 4 + length]), kind, widths, before.rows, later)
    start, declared = 4 + length, sum(meta.sections.values())
    if start + declared != len(payload):
        raise Malformed(f"layer {kind.layer}: sections of {declared} bytes, expected {len(payload) - start}")
    return meta, start, check_symbol_count(meta, kind, before, len(payload), 0 if later else before.rows)


def read_layer(
    payload: bytes | memoryview,
    kind: LayerKind,
    widths: Widths,
    before: Declared,
    mode: str,
    later: bool = False,
    past: Past[Prior] | None = None,
) -> LayerSymbols:
    """The symbols of a payload (clause "layer payload"). widths: of the anchors. before: what the slices before this
    one declare. later: it stands behind its layer's first. past: of the layer's slices before, to which this one is
    added.

    Raises DecodeError's subclasses; nothing is allocated for a count that the limits or the payload do not cover.
    """
    meta, start, _ = read_meta(payload, kind, widths, before, later)
    parts: dict[int, bytes] = {}
    for section, length in sorted(meta.sections.items()):
        parts[section] = bytes(payload[start : start + length])
        start += length
    channels = _decode_groups(parts, _channel_counts(meta, kind, 0 if later else before.rows), meta, mode, past)
    tensors = _integer_tensors(meta, kind, channels)
    if parts:
        raise Malformed(f"layer {kind.layer}: section {min(parts)} is there, but nothing is left for it to code")
    anchor_q = channels[Section.POSITIONS][0]
    increase, own = channels[Section.MASKS]
    _check_ranges(kind, increase, own)
    planes, networks = _shape_tensors(meta, tensors)
    classes, attributes = channels[Section.ATTRIBUTES]
    check_classes(classes)
    for tensor in (attributes, *tensors):
        if magnitude(tensor) > MAX_SYMBOL:
            raise Malformed(f"layer {kind.layer}: a symbol over {MAX_SYMBOL} in magnitude")
    return LayerSymbols(kind, widths, anchor_q, increase, own, classes, attributes, planes, networks, meta.steps)


def _part(parts: dict[int, bytes], section: Section, symbols: int) -> bytes:
    """Take a section's bytes; it is there exactly if it has symbols to code."""
    if (section in parts) != (symbols > 0):
        found = "there" if section in parts else "missing"
        raise Malformed(f"section {section.name.lower()} is {found}, with {symbols} symbols to code")
    return parts.pop(section, b"")


def _channel_counts(meta: LayerMeta, kind: LayerKind, rises: int) -> dict[Section, list[int]]:
    return {
        Section.MASKS: [rises, meta.rows],
        Section.ATTRIBUTES: [meta.rows] * (meta.widths.channels + meta.widths.graded),
        Section.PLANES: [h * w for c, h, w in meta.plane_shapes() for _ in range(c)],
        Section.WEIGHTS: [math.prod(shape) for shape in meta.weight_shapes(kind)],
    }


def _decode_groups(
    parts: dict[int, bytes], counts: dict[Section, list[int]], meta: LayerMeta, mode: str, past: Past[Prior] | None
) -> dict[Section, list[np.ndarray]]:
    """By section its channels; of the attributes, what `_attributes` gives."""
    rows = counts[Section.MASKS][1]
    anchor_q = decode_positions(_part(parts, Section.POSITIONS, rows), rows, past.positions if past else None)
    channels: dict[Section, list[np.ndarray]] = {Section.POSITIONS: [anchor_q]}
    if mode == "lzma":
        flat = [count for section in GROUPS for count in counts[section]]
        data = _part(parts, Section.SYMBOLS, sum(flat))
        decoded = decode_channels_lzma(data, flat) if data else _zeros(flat)
        for section in GROUPS:
            channels[section], decoded = decoded[: len(counts[section])], decoded[len(counts[section]) :]
        channels[Section.ATTRIBUTES] = _attributes(channels[Section.ATTRIBUTES], meta.widths)
        return channels
    for section in GROUPS:
        data = _part(parts, section, sum(counts[section]))
        if not data:
            channels[section] = _zeros(counts[section])
            if section == Section.ATTRIBUTES:
                channels[section] = _attributes(channels[section], meta.widths)
        elif section == Section.ATTRIBUTES:
            channels[section] = list(read_attributes(data, meta.widths, rows, past))
        elif section == Section.PLANES:
            channels[section] = [
                channel.ravel() for plane in read_planes(data, meta.plane_shapes()) for channel in plane
            ]
        else:
            known = past.masks if past and section == Section.MASKS else None
            channels[section] = decode_channels(data, counts[section], known)
    return channels


def _attributes(channels: list[np.ndarray], widths: Widths) -> list[np.ndarray]:
    """[step classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]]."""
    return [channels[0] if widths.graded else NO_CLASSES, np.stack(channels[int(widths.graded) :])]


def _zeros(counts: list[int]) -> list[np.ndarray]:
    return [np.zeros(count, np.int32) for count in counts]


def _integer_tensors(meta: LayerMeta, kind: LayerKind, channels: dict[Section, list[np.ndarray]]) -> list[np.ndarray]:
    residuals, first = [], 0
    predictors = [p for scale in meta.scales for p in scale.predictors]
    for predictor, shape in zip(predictors, meta.plane_shapes(), strict=True):
        plane = np.concatenate(channels[Section.PLANES][first : first + shape[0]]).reshape(shape)
        residuals.append((predictor, plane))
        first += shape[0]
    weights = zip(channels[Section.WEIGHTS], meta.weight_shapes(kind), strict=True)
    return decorrelation.restore(residuals) + [channel.reshape(shape) for channel, shape in weights]


def _shape_tensors(meta: LayerMeta, tensors: list[np.ndarray]) -> tuple[Planes, dict[str, Network]]:
    rest = iter(tensors)
    planes = tuple({name: next(rest) for name, _, _ in PLANES} for _ in meta.scales)
    networks = {name: tuple((next(rest), next(rest)) for _ in widths) for name, widths in meta.networks.items()}
    return planes, networks


def _check_ranges(kind: LayerKind, increase: np.ndarray, own: np.ndarray) -> None:
    for name, codes, low in (("rise of a mask code", increase, 0), ("mask code", own, MASK_MIN_CODE)):
        if codes.size and not (low <= codes.min() and codes.max() <= 255):
            found = f"{int(codes.min())}..{int(codes.max())}"
            raise Malformed(f"layer {kind.layer}: {name} in {found}, expected {low}..255")
