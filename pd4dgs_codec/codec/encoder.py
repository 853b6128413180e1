"""Scene -> bytes of a `.pd4` file, with a report of where the bits went."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.attributes.table import Grid
from pd4dgs_codec.bitstream.container import CHUNK_OVERHEAD, FLAG_ANCILLARY, write_chunk, write_preamble
from pd4dgs_codec.codec.bounds import ErrorBound, rounding_bounds, verify_errors
from pd4dgs_codec.codec.check import check_scene
from pd4dgs_codec.codec.decoder import decode_layers
from pd4dgs_codec.codec.header import Header, pack_header, payload_digest, scene_id_of
from pd4dgs_codec.codec.kinds import LAYER_KINDS
from pd4dgs_codec.codec.layer_meta import Declared
from pd4dgs_codec.codec.left_out import LeftOut
from pd4dgs_codec.codec.metadata import CHUNK_TYPE, Metadata, write_metadata
from pd4dgs_codec.codec.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.codec.payload import StreamReport, read_meta, write_layer
from pd4dgs_codec.codec.plan import plan
from pd4dgs_codec.codec.symbols import LayerSymbols, assemble, check_last_layer, float_tensors, layer_symbols
from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.threads import one_blas_thread


@dataclass(frozen=True)
class LayerReport:
    """One layer. bytes: its whole chunk. payload_bits and rate_bits: sums over attributes, planes and weights (in mode
    lzma one stream codes these and the masks together, and payload_bits is all of it). streams: every coded section.
    """

    layer: int
    bytes: int
    payload_bits: int
    rate_bits: float
    position_bits: int
    symbols: int
    anchors: int
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
    **changes: Any,
) -> tuple[bytes, Report]:
    """(file, report) of a scene.

    changes: fields of EncodeOptions by name, in place of those of `options`. left_out: what the caller has taken out of
    the scene, to be reported with the rest. metadata: what the file says about itself. Raises EncodeError.
    """
    started = time.perf_counter()
    scene, options = replace(options, **changes).apply_scale(scene)
    check_scene(scene)
    planned, omitted = plan(scene, options)
    symbols = [layer_symbols(planned, i, options.raw_deformation) for i in range(len(planned.layers))]
    written = [write_layer(layer, options) for layer in symbols]
    _check_limits(planned, symbols, [payload for payload, _ in written])
    meant = assemble(planned.info, Grid.of(planned), symbols)
    about = write_metadata(metadata) if metadata is not None else b""
    data = _container(meant, options, [payload for payload, _ in written], about)
    errors = _verify(data, planned, symbols, meant) if options.verify else []
    reports = [_layer_report(layer, payload, r) for layer, (payload, r) in zip(symbols, written, strict=True)]
    kept = sum(r.anchors for r in reports)
    kept_bits = sum(r.position_bits + s.payload_bits for r in reports for s in r.streams if s.name == "attributes")
    rows = [item.row(scene.steps, options, kept, kept_bits) for item in (*left_out, *omitted)]
    seconds = round(time.perf_counter() - started, 4)
    about_bytes = CHUNK_OVERHEAD + len(about) if about else 0
    return data, Report(options.mode, len(data), options.verify, seconds, reports, rows, errors, about_bytes)


def _check_limits(scene: Scene, symbols: list[LayerSymbols], payloads: list[bytes]) -> None:
    """Hold declared sizes and ranges of values against the format's limits as a decoder will, verified or not."""
    declared = Declared()
    for index, (layer, payload) in enumerate(zip(symbols, payloads, strict=True)):
        try:
            *_, declared = read_meta(payload, layer.kind, layer.widths, declared, layer.raw_deformation)
            check_last_layer(symbols[: index + 1], scene.info.voxel_size, Grid.of(scene))
        except DecodeError as error:
            raise EncodeError(f"the scene is over a limit of the format: {error}") from None


def _container(meant: Scene, options: EncodeOptions, payloads: list[bytes], metadata: bytes) -> bytes:
    """The file of a scene as it will be decoded, from the payloads of its layers and of its metadata, if there is any.
    The latter comes last: a picture does not wait for it."""
    parts = [(LAYER_KINDS[layer].chunk_type, 0, payload) for layer, payload in zip(meant.layers, payloads, strict=True)]
    if metadata:
        parts.append((CHUNK_TYPE, FLAG_ANCILLARY, metadata))
    header = Header(
        chunks=tuple((kind, len(payload)) for kind, _, payload in parts),
        mode=options.mode,
        deformation=options.deformation,
        attribute_steps=meant.steps.attributes,
        widths=meant.widths,
        centre=Grid.of(meant).centre if meant.widths.graded else None,
        info=meant.info,
        error_bounds=rounding_bounds(meant, options.raw_deformation),
        digest=payload_digest(payloads),
    )
    packed = pack_header(header)
    scene_id = scene_id_of(packed)
    chunks = [write_chunk(kind, flags, scene_id, payload) for kind, flags, payload in parts]
    return b"".join([write_preamble(packed), *chunks])


def _verify(data: bytes, planned: Scene, symbols: list[LayerSymbols], meant: Scene) -> list[ErrorBound]:
    """Decode `data`, compare all integers with `symbols`, all floats with those `meant`, which the integers stand for,
    and these with the ones given, those of `planned`."""
    try:
        header, decoded, _ = decode_layers(data)
        scene = assemble(header.info, header.grid, decoded)
    except DecodeError as error:
        raise EncodeError(f"verification: the file does not decode: {error}") from error
    if scene.layers != planned.layers or scene.rows != planned.rows:
        meant_rows = f"{planned.layers}, {planned.rows}"
        raise EncodeError(f"verification: layers and rows {scene.layers}, {scene.rows}; meant {meant_rows}")
    for index, (got, want) in enumerate(zip(decoded, symbols, strict=True)):
        if got.steps != want.steps or not _same(got.arrays(), want.arrays()):
            raise EncodeError(f"verification: layer {want.kind.layer} decodes to other symbols")
        if not _same(float_tensors(scene, index), float_tensors(meant, index)):
            raise EncodeError(f"verification: layer {want.kind.layer} decodes to other values")
    return verify_errors(planned, scene, header.error_bounds, header.raw_deformation)


def _same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all(x.shape == y.shape and np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _layer_report(layer: LayerSymbols, payload: bytes, reports: list[StreamReport]) -> LayerReport:
    positions, *streams = reports
    counted = [s for s in streams if s.name not in ("masks", "floats")]
    return LayerReport(
        layer=layer.kind.layer,
        bytes=len(write_chunk(layer.kind.chunk_type, 0, bytes(8), payload)),
        payload_bits=sum(s.payload_bits for s in counted),
        rate_bits=sum(s.rate_bits for s in counted),
        position_bits=positions.payload_bits,
        symbols=sum(s.symbols for s in counted),
        anchors=len(layer.anchor_q),
        streams=streams,
    )
