"""Scene -> bytes of a `.pd4` file, with a report of where the bits went."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import starmap
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.format.bounds import ErrorBound, rounding_bounds, verify_errors
from pd4dgs_codec.format.check import check_scene
from pd4dgs_codec.format.container import (
    CHUNK_OVERHEAD,
    FLAG_ANCILLARY,
    read_preamble,
    slice_flags,
    write_chunk,
    write_preamble,
)
from pd4dgs_codec.format.decoder import decode_layers
from pd4dgs_codec.format.header import Header, pack_header, payload_digest, scene_id_of, unpack_header
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.layer_meta import Declared
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.limits import MAX_CHUNKS
from pd4dgs_codec.format.metadata import CHUNK_TYPE, Metadata, write_metadata
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import StreamReport, read_meta
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.slicing import Slice, whole_layer, write_slices
from pd4dgs_codec.format.symbols import (
    LayerSymbols,
    TakenVoxels,
    assemble,
    attribute_blocks,
    check_last_layer,
    float_tensors,
    layer_symbols,
    outline,
)
from pd4dgs_codec.format.table import Grid
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.threads import one_blas_thread

#: Bytes that preamble, header and chunk list of a sliced file take at most; they count with the first slice.
HEADER = 1000


@dataclass(frozen=True)
class SliceReport:
    """One slice. bytes: its whole chunk."""

    bytes: int
    anchors: int


@dataclass(frozen=True)
class LayerReport:
    """One layer. bytes: its chunks. slices: each of them. payload_bits and rate_bits: sums over attributes, planes and
    weights (in mode lzma one stream codes these and the masks together, and payload_bits is all of it).
    streams: every coded section.
    """

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
    """What encode did. left_out rows hold what, why, lossless and bytes: about what it would have cost. errors: how
    far by the header decoded values may lie from those given and how far they do, empty if not verified.
    metadata_bytes: of the chunk that holds the metadata, 0 without one."""

    mode: str
    bytes: int
    verified: bool
    seconds: float
    layers: list[LayerReport]
    left_out: list[dict[str, Any]]
    errors: list[ErrorBound]
    metadata_bytes: int

    def added_bytes(self) -> dict[int, int]:
        """By layer what it adds to the file, the header counted with layer 0."""
        header = self.bytes - sum(row.bytes for row in self.layers) - self.metadata_bytes
        return {row.layer: row.bytes + (header if row.layer == 0 else 0) for row in self.layers}

    @property
    def first_bytes(self) -> int:
        """What the first picture takes: the header and the first slice."""
        return self.added_bytes()[0] - sum(part.bytes for part in self.layers[0].slices[1:])

    def json(self) -> dict[str, Any]:
        """The report as plain dicts, lists, strings and numbers."""
        return asdict(self)


def encode(scene: Scene, options: EncodeOptions = DEFAULTS, **changes: Any) -> bytes:
    """The bytes of a `.pd4` file; options and changes as in encode_with_report."""
    return encode_with_report(scene, options, **changes)[0]


@one_blas_thread()
def encode_with_report(
    scene: Scene,
    options: EncodeOptions = DEFAULTS,
    *,
    left_out: Sequence[LeftOut] = (),
    metadata: Metadata | None = None,
    utility: Callable[[Scene], np.ndarray] | None = None,
    **changes: Any,
) -> tuple[bytes, Report]:
    """(file, report) of a scene.

    utility: of the scene as it will be decoded, float [N]: what the pictures gain by each anchor, if the layers are
    sliced; by_size if None.
    changes: fields of EncodeOptions by name, in place of those of `options`. left_out: what the caller has taken out of
    the scene, to be reported with the rest. metadata: what the file says about itself. Raises EncodeError.
    """
    started = time.perf_counter()
    scene, options = replace(options, **changes).apply_scale(scene)
    check_scene(scene)
    planned, omitted = plan(scene, options)
    symbols = [layer_symbols(planned, i) for i in range(len(planned.layers))]
    grid = Grid.of(planned)
    meant = outline(planned.info, grid, symbols)
    bounds = rounding_bounds(meant, attribute_blocks(grid, symbols))
    errors = list[ErrorBound]()
    if options.verify:
        errors = verify_errors(planned, meant, attribute_blocks(grid, symbols), bounds)
    del planned  # as large as the scene
    if options.slices:
        values = np.split((utility or by_size)(assemble(meant.info, grid, symbols)), meant.rows[:-1])
        written = [write_slices(layer, options, u, HEADER) for layer, u in zip(symbols, values, strict=True)]
    else:
        written = [[whole_layer(layer, options)] for layer in symbols]
    _check_limits(meant.info.voxel_size, grid, symbols, written)
    about = write_metadata(metadata) if metadata is not None else b""
    data = _container(meant, grid, bounds, options, written, about)
    reports = [_layer_report(layer, slices) for layer, slices in zip(symbols, written, strict=True)]
    if options.verify:
        wanted = [_fingerprint(layer, grid) for layer in symbols]
        del symbols, written  # as large as what is decoded
        _verify(data, meant, wanted, bounds)
    kept = sum(r.anchors for r in reports)
    kept_bits = sum(r.position_bits + s.payload_bits for r in reports for s in r.streams if s.name == "attributes")
    rows = [item.row(scene.steps, options, kept, kept_bits) for item in (*left_out, *omitted)]
    seconds = round(time.perf_counter() - started, 4)
    about_bytes = CHUNK_OVERHEAD + len(about) if about else 0
    return data, Report(options.mode, len(data), options.verify, seconds, reports, rows, errors, about_bytes)


def by_size(scene: Scene) -> np.ndarray:
    """float32 [N]: a guess at what the pictures gain by each anchor where no view is known: its gate in the highest
    layer times the area that its Gaussians cover at most."""
    scales = np.sort(scene.scaling_log[:, 3:], axis=1)[:, 1:].sum(axis=1)
    utility: np.ndarray = scene.mask[-1] * np.exp(scales - scales.max(initial=0))
    return utility


def with_metadata(data: bytes, metadata: Metadata) -> bytes:
    """A complete file with a metadata chunk more at its end; nothing else changes but the chunk list."""
    preamble = read_preamble(data)
    header, about = unpack_header(preamble.header), write_metadata(metadata)
    packed = pack_header(replace(header, chunks=(*header.chunks, (CHUNK_TYPE, len(about)))))
    chunk = write_chunk(CHUNK_TYPE, FLAG_ANCILLARY, scene_id_of(packed), about)
    return write_preamble(packed) + data[preamble.size :] + chunk


def _check_limits(voxel_size: float, grid: Grid, symbols: list[LayerSymbols], written: list[list[Slice]]) -> None:
    """Hold declared sizes and ranges of values against the format's limits as a decoder will, verified or not."""
    declared, taken = Declared(), TakenVoxels()
    chunks = sum(map(len, written))
    if chunks > MAX_CHUNKS:
        raise EncodeError(f"{chunks} slices, expected at most {MAX_CHUNKS}: let slices take more bytes")
    for index, (layer, slices) in enumerate(zip(symbols, written, strict=True)):
        for number, part in enumerate(slices):
            try:
                *_, declared = read_meta(part.payload, layer.kind, layer.widths, declared, number > 0)
                layers = [*symbols[:index], part.symbols]
                check_last_layer(layers, taken, voxel_size, grid)
            except DecodeError as error:
                raise EncodeError(f"the scene is over a limit of the format: {error}") from None


def _container(
    meant: Scene,
    grid: Grid,
    bounds: dict[str, float],
    options: EncodeOptions,
    written: list[list[Slice]],
    metadata: bytes,
) -> bytes:
    """The file of a scene as it will be decoded, from the slices of its layers and its metadata, if there is any.
    The latter comes last: a picture does not wait for it."""
    parts = [
        (LAYER_KINDS[layer].chunk_type, slice_flags(number, len(slices)), part.payload)
        for layer, slices in zip(meant.layers, written, strict=True)
        for number, part in enumerate(slices)
    ]
    payloads = [payload for *_, payload in parts]
    if metadata:
        parts.append((CHUNK_TYPE, FLAG_ANCILLARY, metadata))
    header = Header(
        chunks=tuple((kind, len(payload)) for kind, _, payload in parts),
        mode=options.mode,
        attribute_steps=meant.steps.attributes,
        widths=grid.widths,
        centre=grid.centre if grid.widths.graded else None,
        info=meant.info,
        error_bounds=bounds,
        digest=payload_digest(payloads),
    )
    packed = pack_header(header)
    scene_id = scene_id_of(packed)
    chunks = [write_chunk(kind, flags, scene_id, payload) for kind, flags, payload in parts]
    return b"".join([write_preamble(packed), *chunks])


def _verify(data: bytes, meant: Scene, wanted: list[tuple[bytes, bytes]], bounds: dict[str, float]) -> None:
    """Decode `data`, compare by layer all integers, and all floats that they stand for, with the `wanted` fingerprints,
    and the bounds, within which these floats lie of those given."""
    try:
        header, decoded, _ = decode_layers(data)
        scene = outline(header.info, header.grid, decoded)
    except DecodeError as error:
        raise EncodeError(f"verification: the file does not decode: {error}") from error
    if header.error_bounds != bounds:
        raise EncodeError(f"verification: bounds {header.error_bounds}, meant {bounds}")
    if scene.layers != meant.layers or scene.rows != meant.rows:
        meant_rows = f"{meant.layers}, {meant.rows}"
        raise EncodeError(f"verification: layers and rows {scene.layers}, {scene.rows}; meant {meant_rows}")
    for index, (layer, (symbols, values)) in enumerate(zip(decoded, wanted, strict=True)):
        found = _fingerprint(layer, header.grid)
        if found[0] != symbols:
            raise EncodeError(f"verification: layer {layer.kind.layer} decodes to other symbols")
        tensors = zip(float_tensors(scene, index), float_tensors(meant, index), strict=True)
        if found[1] != values or not all(starmap(np.array_equal, tensors)):
            raise EncodeError(f"verification: layer {layer.kind.layer} decodes to other values")


def _fingerprint(layer: LayerSymbols, grid: Grid) -> tuple[bytes, bytes]:
    """SHA-256 of a layer's steps and integers, with their shapes, and of the attributes that these stand for."""
    symbols, values = hashlib.sha256(repr(layer.steps).encode()), hashlib.sha256()
    for array in layer.arrays():
        symbols.update(f"{array.dtype} {array.shape}".encode())
        symbols.update(np.ascontiguousarray(array).data)
    for _, block in attribute_blocks(grid, [layer]):
        for value in block.values():
            values.update(value.data)
    return symbols.digest(), values.digest()


def _layer_report(layer: LayerSymbols, slices: list[Slice]) -> LayerReport:
    positions, *streams = _added(slices)
    rows = [SliceReport(CHUNK_OVERHEAD + len(part.payload), len(part.symbols.anchor_q)) for part in slices]
    counted = [s for s in streams if s.name != "masks"]
    return LayerReport(
        layer=layer.kind.layer,
        bytes=sum(row.bytes for row in rows),
        payload_bits=sum(s.payload_bits for s in counted),
        rate_bits=sum(s.rate_bits for s in counted),
        position_bits=positions.payload_bits,
        symbols=sum(s.symbols for s in counted),
        anchors=len(layer.anchor_q),
        slices=rows,
        streams=streams,
    )


def _added(slices: list[Slice]) -> list[StreamReport]:
    """By section, what all slices took; the positions come first."""
    found: dict[str, StreamReport] = {}
    for row in (row for part in slices for row in part.streams):
        so_far = found.get(row.name, StreamReport(row.name, 0, 0.0, 0))
        found[row.name] = StreamReport(
            row.name,
            so_far.payload_bits + row.payload_bits,
            so_far.rate_bits + row.rate_bits,
            so_far.symbols + row.symbols,
        )
    return list(found.values())
