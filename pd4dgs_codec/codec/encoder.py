"""Scene -> bytes of a `.pd4` file, with a report of where the bits went."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from pd4dgs_codec.attributes.table import ATTRIBUTES
from pd4dgs_codec.bitstream.container import write_chunk, write_preamble
from pd4dgs_codec.codec.bounds import ErrorBound, rounding_bounds, verify_errors
from pd4dgs_codec.codec.check import check_scene
from pd4dgs_codec.codec.decoder import decode_layers
from pd4dgs_codec.codec.header import DEFORMATIONS, MODES, Header, pack_header, scene_id_of
from pd4dgs_codec.codec.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.codec.layers import Coding, StreamReport, read_meta, write_layer
from pd4dgs_codec.codec.omissions import LeftOut
from pd4dgs_codec.codec.plan import OMIT, plan
from pd4dgs_codec.codec.symbols import (
    LayerSymbols,
    assemble,
    check_last_layer,
    float_tensors,
    layer_symbols,
    quantise_deformation,
)
from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.scene import Deformation, Scene, Steps

LAYER_CHOICES = ("auto", 0, 1, 2)


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
    far by the header decoded values may lie from those given and how far they do, empty if not verified."""

    mode: str
    bytes: int
    verified: bool
    seconds: float
    layers: list[LayerReport]
    left_out: list[dict]
    errors: list[ErrorBound]

    def json(self) -> dict:
        """The report as plain dicts, lists, strings and numbers."""
        return asdict(self)


def encode(scene: Scene, **options) -> bytes:
    """The bytes of a `.pd4` file; `options` as in encode_with_report."""
    return encode_with_report(scene, **options)[0]


def encode_with_report(
    scene: Scene,
    *,
    mode: str = "ans",
    deformation: str = "coded",
    priors: str = "best",
    step_scale: float = 1.0,
    layers: str | int = "auto",
    effort: int = 5,
    omit: str = "bounded",
    verify: bool = True,
    left_out: Sequence[LeftOut] = (),
) -> tuple[bytes, Report]:
    """(file, report) of a scene.

    mode: "ans", or "lzma" for the same symbols under LZMA2. deformation: "coded" or "float32". priors: "best" or
    "gauss". step_scale multiplies every quantisation step. layers: "auto" leaves out deformations that do nothing,
    0, 1 or 2 keeps the layers up to that number. effort: 1..9. omit: "bounded", "lossless" or "nothing", see plan.
    verify: decode the result, compare every symbol and every float, and hold every float against the error bound in the
    header. left_out: what the caller has taken out of the scene, to be reported with the rest. Raises EncodeError.
    """
    started = time.perf_counter()
    _check_options(mode, deformation, priors, step_scale, layers, effort, omit)
    scene = replace(scene, steps=scene.steps.scaled(step_scale))
    check_scene(scene)
    coding = Coding(mode, priors, effort)
    planned, omitted = plan(scene, layers, deformation == "float32", omit)
    symbols = [layer_symbols(planned, i, deformation == "float32") for i in range(len(planned.layers))]
    written = [write_layer(layer, coding) for layer in symbols]
    _check_limits(planned, symbols, [payload for payload, _ in written])
    meant = assemble(planned.info, _attribute_steps(planned), symbols)
    data = _container(meant, mode, deformation, [payload for payload, _ in written])
    errors = _verify(data, planned, symbols, meant) if verify else []
    reports = [_layer_report(layer, payload, r) for layer, (payload, r) in zip(symbols, written, strict=True)]
    rows = [_left_out_row(item, scene, coding, deformation, reports) for item in (*left_out, *omitted)]
    seconds = round(time.perf_counter() - started, 4)
    return data, Report(mode, len(data), verify, seconds, reports, rows, errors)


def _check_options(
    mode: str, deformation: str, priors: str, scale: float, layers: str | int, effort: int, omit: str
) -> None:
    choices = (
        ("mode", mode, tuple(MODES)),
        ("deformation", deformation, tuple(DEFORMATIONS)),
        ("priors", priors, ("best", "gauss")),
        ("layers", layers, LAYER_CHOICES),
        ("effort", effort, tuple(range(1, 10))),
        ("omit", omit, OMIT),
    )
    for name, value, allowed in choices:
        if value not in allowed:
            raise EncodeError(f"{name} {value!r}, expected one of {list(allowed)}")
    if not (np.isfinite(scale) and scale > 0):
        raise EncodeError(f"step_scale {scale!r}, expected a positive number")


def _check_limits(scene: Scene, symbols: list[LayerSymbols], payloads: list[bytes]) -> None:
    """Hold declared sizes and ranges of values against the format's limits as a decoder will, verified or not."""
    rows = 0
    for index, (layer, payload) in enumerate(zip(symbols, payloads, strict=True)):
        try:
            read_meta(payload, layer.kind, rows, layer.raw)
            check_last_layer(symbols[: index + 1], scene.info.voxel_size, _attribute_steps(scene))
        except DecodeError as error:
            raise EncodeError(f"the scene is over a limit of the format: {error}") from None
        rows += len(layer.anchor_q)


def _attribute_steps(scene: Scene) -> dict[str, float]:
    return {a.name: getattr(scene.steps, a.name) for a in ATTRIBUTES}


def _container(meant: Scene, mode: str, deformation: str, payloads: list[bytes]) -> bytes:
    """The file of a scene as it will be decoded, from the payloads of its layers."""
    types = [LAYER_KINDS[layer].chunk_type for layer in meant.layers]
    header = Header(
        chunks=tuple(zip(types, map(len, payloads), strict=True)),
        mode=mode,
        deformation=deformation,
        attribute_steps=_attribute_steps(meant),
        info=meant.info,
        error_bounds=rounding_bounds(meant, deformation == "float32"),
    )
    packed = pack_header(header)
    scene_id = scene_id_of(packed, payloads[0])
    chunks = [write_chunk(t, 0, scene_id, payload) for t, payload in zip(types, payloads, strict=True)]
    return b"".join([write_preamble(packed), *chunks])


def _verify(data: bytes, planned: Scene, symbols: list[LayerSymbols], meant: Scene) -> list[ErrorBound]:
    """Decode `data`, compare all integers with `symbols`, all floats with those `meant`, which the integers stand for,
    and these with the ones given, those of `planned`."""
    try:
        header, decoded, _ = decode_layers(data)
        scene = assemble(header.info, header.attribute_steps, decoded)
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


def _left_out_row(item: LeftOut, scene: Scene, coding: Coding, deformation: str, reports: list[LayerReport]) -> dict:
    """{what, why, lossless, bytes}: see LeftOut; anchors cost what the kept ones do on average."""
    row = {"what": item.what, "why": item.why, "lossless": item.lossless}
    if item.anchors:
        kept = sum(r.anchors for r in reports)
        spent = sum(r.position_bits + s.payload_bits for r in reports for s in r.streams if s.name == "attributes")
        return row | {"bytes": round(item.anchors * spent / 8 / kept) if kept else 0}
    if item.tensors is None or item.kind is None:
        return row | {"bytes": round(item.bits / 8)}
    return row | {"bytes": deformation_bytes(item.tensors, item.kind, scene.steps, coding, deformation == "float32")}


def deformation_bytes(deformation: Deformation, kind: LayerKind, steps: Steps, coding: Coding, raw: bool) -> int:
    """What planes and networks alone would take as the layer of `kind`."""
    tensors = deformation if raw else quantise_deformation(deformation, kind, steps)
    empty = np.zeros(0, np.int32)
    alone = LayerSymbols(
        kind=kind,
        anchor_q=np.zeros((0, 3), np.int32),
        mask_increase=empty,
        mask_own=empty,
        attributes=np.zeros((0, 0), np.int32),
        planes=tensors.planes,
        networks=tensors.networks,
        steps={name: getattr(steps, name) for name in (kind.planes_step, kind.weights_step) if name},
        raw=raw,
    )
    return len(write_layer(alone, coding)[0])
