"""Encodes a scene into the bytes of a `.pd4` file, with a report of the bits of each part."""

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.errors import DecodeError, EncodeError, LimitExceeded
from pd4dgs_codec.format.check import Errors, check_scene, verify_errors
from pd4dgs_codec.format.container import (
    CHUNK_OVERHEAD,
    FLAG_ANCILLARY,
    PREAMBLE_SIZE,
    read_preamble,
    slice_flags,
    write_chunk,
    write_preamble,
)
from pd4dgs_codec.format.decoder import every_prefix
from pd4dgs_codec.format.header import DIGEST_SIZE, Header, pack_header, payload_digest, scene_id_of, unpack_header
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.metadata import CHUNK_TYPE, Metadata, write_metadata
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.parameters import with_fill
from pd4dgs_codec.format.payload import StreamReport, write_slice
from pd4dgs_codec.format.plan import LeftOut, SceneSymbols, plan
from pd4dgs_codec.format.reader import Base, Source, read_base, read_layers
from pd4dgs_codec.format.registry import MAX_CHUNKS
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.tensors.symbols import LayerSymbols, sliced
from pd4dgs_codec.tensors.tables import Fill
from pd4dgs_codec.threads import one_blas_thread

LATER = 2 / 3  #: size of the slices behind the first one of layer 0, of that one's
TRIES = 4  #: most encodes of one slice to reach its size
SLACK = 0.97  #: share of the size that a slice aims at
FULL = 0.92  #: share of the size that is large enough
LONGEST = (255, 255, 255, 255)  #: a fill that takes the most bytes


@dataclass(frozen=True, eq=False)
class _Slice:
    """A slice as written. anchors: number of its anchors."""

    anchors: int
    payload: bytes
    streams: list[StreamReport]
    fill: Fill | None


@dataclass(frozen=True)
class SliceReport:
    """The report of a slice. bytes: of its whole chunk. fill: RGB 0..255, None for the background."""

    bytes: int
    anchors: int
    fill: Fill | None


@dataclass(frozen=True)
class LayerReport:
    """The report of a layer. bytes: of its chunks. payload_bits, rate_bits: sums over attributes, planes and weights.
    In mode lzma payload_bits counts all channels. streams: every group of channels, summed over the slices."""

    layer: int
    bytes: int
    payload_bits: int
    rate_bits: float
    position_bits: int
    symbols: int
    anchors: int
    slices: list[SliceReport]
    streams: list[StreamReport]


@dataclass(frozen=True)
class Report:
    """The report of an encode. left_out: rows {what, why, lossless, bytes} with the estimated bytes of each part left
    out. errors: by field of Steps, empty if not verified. metadata_bytes: of the metadata chunk, 0 without one."""

    mode: str
    bytes: int
    verified: bool
    seconds: float
    layers: list[LayerReport]
    left_out: list[dict[str, Any]]
    errors: list[Errors]
    metadata_bytes: int

    def added_bytes(self) -> dict[int, int]:
        """Returns the bytes that each layer adds to the file. The header counts with layer 0."""
        header = self.bytes - sum(row.bytes for row in self.layers) - self.metadata_bytes
        return {row.layer: row.bytes + (header if row.layer == 0 else 0) for row in self.layers}

    @property
    def first_bytes(self) -> int:
        """Number of bytes before the first picture: the header and the first slice."""
        return self.added_bytes()[0] - sum(part.bytes for part in self.layers[0].slices[1:])

    def json(self) -> dict[str, Any]:
        """The report as plain dicts, lists, strings and numbers."""
        return asdict(self)


def encode(scene: AnyScene, options: EncodeOptions = DEFAULTS, **changes: Any) -> bytes:
    """Returns the bytes of a `.pd4` file. Options, changes and errors as in encode_with_report."""
    return encode_with_report(scene, options, **changes)[0]


@one_blas_thread()
def encode_with_report(
    scene: AnyScene,
    options: EncodeOptions = DEFAULTS,
    *,
    left_out: Sequence[LeftOut] = (),
    metadata: Metadata | None = None,
    utility: Callable[[AnyScene], np.ndarray] | None = None,
    fill: Callable[[AnyScene], Fill | None] | None = None,
    base: Source | Base | None = None,
    **changes: Any,
) -> tuple[bytes, Report]:
    """Encodes a scene; returns (bytes of the file, report).

    left_out: parts that the caller has removed from the scene, added to the report. metadata: stored in the file.
    utility: function of the decoded scene, float [N], the gain in image quality by each anchor. It orders the anchors
    of sliced layers; `scene.utility` if None. fill: function of the scene that ends with a slice, its fill; called
    for each slice but the last. If None, each slice has the fill of its layer. base: a file, or what `read_base` made
    of it, whose layer 0 the file names and does not hold: the scene's first rows and its networks of layer 0 are those
    of the base, whose mask codes in layer 0 may be 0 instead. changes: fields of EncodeOptions that replace those of
    `options`. Raises EncodeError, and for a base what `read_base` raises.
    """
    started = time.perf_counter()
    scene, options = replace(options, **changes).apply_scale(scene)
    check_scene(scene)
    base = None if base is None else read_base(base)
    planned = plan(scene, options, base)
    symbols, omitted = planned.symbols, planned.left_out
    errors = verify_errors(planned.scene, symbols) if options.verify else []
    del planned  # as large as the scene
    utility = utility or (lambda scene: scene.utility)
    written = _write_layers(symbols, options, utility, None if fill is None else LONGEST)
    if fill is not None:
        written = _filled(symbols, options, written, fill)
    data, about_bytes = _container(symbols, options.mode, written), 0
    if metadata is not None:
        data, about_bytes = with_metadata(data, metadata)
    reports = [_layer_report(layer, slices) for layer, slices in zip(symbols.layers, written, strict=True)]
    pairs = zip(symbols.layers, written, strict=True)
    fingerprints = [_fingerprint(layer, slices[-1].fill) for layer, slices in pairs] if options.verify else []
    del symbols, written, pairs  # as large as what is decoded
    _check_file(data, fingerprints, base)
    kept = sum(r.anchors for r in reports)
    kept_bits = sum(r.position_bits + s.payload_bits for r in reports for s in r.streams if s.name == "attributes")
    rows = [item.row(options, kept, kept_bits) for item in (*left_out, *omitted)]
    seconds = round(time.perf_counter() - started, 4)
    return data, Report(options.mode, len(data), options.verify, seconds, reports, rows, errors, about_bytes)


def with_metadata(data: bytes, metadata: Metadata) -> tuple[bytes, int]:
    """Appends metadata to a complete file that has none: returns (file, bytes of the metadata chunk). The chunk comes
    last, so that no picture waits for it; in the header only the chunk list changes. Raises EncodeError."""
    preamble = read_preamble(data)
    header, about = unpack_header(preamble.header), write_metadata(metadata)
    if len(header.chunks) == MAX_CHUNKS:
        raise EncodeError(f"metadata beside {MAX_CHUNKS} chunks, expected fewer: let slices take more bytes")
    packed = pack_header(replace(header, chunks=(*header.chunks, (CHUNK_TYPE, len(about)))))
    chunk = write_chunk(CHUNK_TYPE, FLAG_ANCILLARY, scene_id_of(packed), about)
    return write_preamble(packed) + data[preamble.size :] + chunk, len(chunk)


def header_size(symbols: SceneSymbols, mode: str, chunks: int, most: int) -> int:
    """Returns the bytes of preamble and header of a file with at most so many chunks of at most `most` bytes."""
    return PREAMBLE_SIZE + len(pack_header(_header(symbols, ((0, most),) * chunks, mode, bytes(DIGEST_SIZE))))


def _header(symbols: SceneSymbols, chunks: tuple[tuple[int, int], ...], mode: str, digest: bytes) -> Header:
    base = symbols.base.reference if symbols.base else None
    return Header(chunks, mode, symbols.kind, symbols.table, symbols.info, digest, base)


def _write_layers(
    symbols: SceneSymbols, options: EncodeOptions, utility: Callable[[AnyScene], np.ndarray], fill: Fill | None
) -> list[list[_Slice]]:
    """Writes the slices of each layer. The preamble and the header count with the first slice. fill: of all slices,
    None for that of each layer."""
    layers = [replace(layer, fill=fill or layer.fill) for layer in symbols.layers]
    if not options.slices:
        return [[_Slice(len(layer.anchor_q), *write_slice(layer, options), layer.fill)] for layer in layers]
    ends = np.cumsum([len(layer.anchor_q) for layer in symbols.layers])[:-1]
    values = np.split(utility(symbols.scene())[symbols.base_rows :], ends)
    bits = sum(float(layer.bits_per_row().sum()) for layer in symbols.layers)
    most = len(values) + math.ceil(bits / 8 / (LATER * SLACK * options.slices))  # more than there will be
    header = header_size(symbols, options.mode, most, options.slices)
    sizes = [options.slices - header, *[LATER * options.slices] * (len(values) - 1)]
    written = [_write_slices(layer, options, size, u) for layer, size, u in zip(layers, sizes, values, strict=True)]
    if (slices := sum(map(len, written))) > MAX_CHUNKS:
        raise EncodeError(f"{slices} slices, expected at most {MAX_CHUNKS}: let slices take more bytes")
    return written


def _write_slices(layer: LayerSymbols, options: EncodeOptions, size: float, utility: np.ndarray) -> list[_Slice]:
    """Writes the slices of a layer, in order.

    size: most bytes of the first slice; later ones have LATER * options.slices at most and are equal. utility: float
    [n], of the layer's anchors; the highest come first. If planes and networks alone exceed the size, the first slice
    has no anchors, except in layer 0, where a picture needs some.
    """
    rows = np.argsort(-utility, kind="stable")
    costs = np.cumsum([0.0, *layer.bits_per_row()[rows]]) / 8  # bytes of the first 0, 1, .. rows
    done, found, known = 0, list[_Slice](), list[Fitted]()
    scale = 1.0  # bytes that a slice takes per byte expected
    fixed = len(write_slice(sliced(layer, rows[:0], True), options)[0])  # of planes and networks, in the first slice
    while done < len(rows) or not found:
        room = size - CHUNK_OVERHEAD
        least = 1 if found or layer.layer == 0 else 0
        if found:
            fixed, room = 0, LATER * options.slices - CHUNK_OVERHEAD
            left = (costs[-1] - costs[done]) * scale
            number = math.ceil(left / (room * SLACK))
            room = room if number == 1 else left / number / SLACK
        elif least:
            room = max(room, 2 * fixed)
        tries: list[tuple[bool, int, _Slice, list[Fitted]]] = []  # fits, anchors, slice, priors for the next slice
        for _ in range(TRIES):
            expected = (costs[done + 1 :] - costs[done]) * scale + fixed
            likely = int(np.searchsorted(expected, room * SLACK, side="right"))
            count = min(max(likely, least), len(rows) - done)
            trial = list(known)
            part = sliced(layer, rows[done : done + count], not found)
            payload, streams = write_slice(part, options, bool(found), trial)
            if count:
                scale *= max(len(payload) - fixed, 1) / max(expected[count - 1] - fixed, 1)
            fits = len(payload) <= room or count <= least
            tries.append((fits, count, _Slice(count, payload, streams, layer.fill), trial))
            if fits and (len(payload) >= room * FULL or count in (least, len(rows) - done)):
                break
        _, count, made, known = max(tries, key=lambda tried: (tried[0], tried[1] if tried[0] else -tried[1]))
        found.append(made)
        done += count
    return found


def _filled(
    symbols: SceneSymbols, options: EncodeOptions, written: list[list[_Slice]], fill: Callable[[AnyScene], Fill | None]
) -> list[list[_Slice]]:
    """Gives the last slice of the file the fill of its layer, every other one that of the prefix that ends with it."""
    data, last = _container(symbols, options.mode, written), written[-1][-1]
    _check_file(data, [], symbols.base)  # limits of the format
    prefixes = every_prefix(data, symbols.base)

    def filled(part: _Slice) -> _Slice:
        own = symbols.layers[-1].fill if part is last else fill(next(prefixes))
        return replace(part, payload=with_fill(part.payload, own), fill=own)

    return [[filled(part) for part in slices] for slices in written]


def _container(symbols: SceneSymbols, mode: str, written: list[list[_Slice]]) -> bytes:
    parts = [
        (layer.layer, slice_flags(number, len(slices)), part.payload)
        for layer, slices in zip(symbols.layers, written, strict=True)
        for number, part in enumerate(slices)
    ]
    digest = payload_digest(payload for *_, payload in parts)
    chunks = tuple((kind, len(payload)) for kind, _, payload in parts)
    packed = pack_header(_header(symbols, chunks, mode, digest))
    scene_id = scene_id_of(packed)
    return b"".join([write_preamble(packed), *(write_chunk(kind, flags, scene_id, p) for kind, flags, p in parts)])


def _check_file(data: bytes, fingerprints: list[bytes], base: Base | None) -> None:
    """Decodes `data`, checks its header and compares its layers with the fingerprints. Without fingerprints, reads only
    the header and the parameters of all slices, to check the format's limits. Raises EncodeError."""
    try:
        if not fingerprints:
            info(data)
            return
        header, found = read_layers(data, base=base)
    except LimitExceeded as error:
        raise EncodeError(f"the scene is over a limit of the format: {error}") from None
    except DecodeError as error:
        raise EncodeError(f"verification: the file does not decode: {error}") from error
    if pack_header(header) != read_preamble(data).header:
        raise EncodeError("verification: the header decodes to other values")
    if len(found) != len(fingerprints):
        raise EncodeError(f"verification: the file decodes to {len(found)} layers, expected {len(fingerprints)}")
    for layer, meant in zip(found, fingerprints, strict=True):
        if _fingerprint(layer, layer.fill) != meant:
            raise EncodeError(f"verification: layer {layer.layer} decodes to other symbols")


def _fingerprint(layer: LayerSymbols, fill: Fill | None) -> bytes:
    """Returns the SHA-256 of a layer's steps and symbols, with their shapes, and of its fill."""
    digest = hashlib.sha256(repr((layer.tensors.tables.steps, layer.tensors.tables.kind, fill)).encode())
    for array in layer.arrays():
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()


def _layer_report(layer: LayerSymbols, slices: list[_Slice]) -> LayerReport:
    streams = _added(slices)
    rows = [SliceReport(CHUNK_OVERHEAD + len(part.payload), part.anchors, part.fill) for part in slices]
    counted = [s for s in streams if s.name not in ("positions", "masks")]
    return LayerReport(
        layer=layer.layer,
        bytes=sum(row.bytes for row in rows),
        payload_bits=sum(s.payload_bits for s in counted),
        rate_bits=sum(s.rate_bits for s in counted),
        position_bits=sum(s.payload_bits for s in streams if s.name == "positions"),
        symbols=sum(s.symbols for s in counted),
        anchors=len(layer.anchor_q),
        slices=rows,
        streams=streams,
    )


def _added(slices: list[_Slice]) -> list[StreamReport]:
    """Sums the reports of the slices by group."""
    found: dict[str, StreamReport] = {}
    for row in (row for part in slices for row in part.streams):
        other = found.get(row.name, StreamReport(row.name, 0, 0.0, 0))
        bits, rate = other.payload_bits + row.payload_bits, other.rate_bits + row.rate_bits
        found[row.name] = StreamReport(row.name, bits, rate, other.symbols + row.symbols)
    return list(found.values())
