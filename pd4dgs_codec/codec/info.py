"""What a file says about itself: from the header alone where possible; digests of its contents for conformance."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from pd4dgs_codec.bitstream.container import CHUNK_OVERHEAD, MAJOR, MINOR, PREAMBLE_SIZE, read_chunk, read_preamble
from pd4dgs_codec.codec.bounds import rounding_bounds
from pd4dgs_codec.codec.decoder import read_layers
from pd4dgs_codec.codec.header import unpack_header
from pd4dgs_codec.codec.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.codec.layer_meta import Section
from pd4dgs_codec.codec.payload import read_meta
from pd4dgs_codec.codec.symbols import float_tensors

FORMAT_VERSION = f"{MAJOR}.{MINOR}"


def info(data: bytes) -> dict[str, Any]:
    """Header and layers of a file, or of its first bytes: only the preamble and header must be there.

    layers: {layer, offset, bytes, end} (whole chunks; end = length of the prefix that holds layers 0 .. this one) and,
    for chunks that `data` holds whole, anchors, steps, planes ([C, x, y, z, t] per scale), networks (output widths) and
    sections (bytes by name; what else the chunk holds is its frame and its parameters).
    """
    preamble = read_preamble(data)
    header = unpack_header(preamble.header, offset=PREAMBLE_SIZE)
    layers, others, offset, rows = [], [], preamble.size, 0
    for chunk_type, length in header.chunks:
        size = CHUNK_OVERHEAD + length
        kind = BY_CHUNK_TYPE.get(chunk_type)
        place = {"offset": offset, "bytes": size, "end": offset + size}
        if kind is None:
            others.append({"type": chunk_type, **place})
        else:
            row: dict[str, Any] = {"layer": kind.layer, **place}
            if offset + size <= len(data):
                payload = read_chunk(data, offset, type=chunk_type, length=length).payload
                meta, _ = read_meta(payload, kind, rows, header.raw_deformation)
                rows += meta.rows
                row |= {"anchors": meta.rows, "steps": meta.steps}
                row["planes"] = [[s.channels, *s.sides] for s in meta.scales]
                row["sections"] = {Section(key).name.lower(): length for key, length in sorted(meta.sections.items())}
                row["networks"] = {name: list(widths) for name, widths in meta.networks.items()}
            layers.append(row)
        offset += size
    return {
        "format_version": f"{preamble.major}.{preamble.minor}",
        "bytes": offset,
        "available": len(data),
        "header_bytes": preamble.size,
        "mode": header.mode,
        "deformation": header.deformation,
        "voxel_size": header.info.voxel_size,
        "steps": header.attribute_steps,
        "error_bounds": header.error_bounds,
        "anchors": rows if all("anchors" in row for row in layers) else None,
        "time_range": list(header.info.time_range),
        "camera": header.info.camera is not None,
        "layers": layers,
        "chunks": others,
    }


def nearest_bounds(data: bytes) -> dict[str, float]:
    """By field of Steps the error bounds that a complete file would have if its encoder rounded to the nearest symbol.

    Decodes all of it. They can be held against the declared ones, where the errors themselves take the scene encoded.
    """
    reader, _ = read_layers(data)
    assert reader.header is not None
    return rounding_bounds(reader.scene(), reader.header.raw_deformation)


def hashes(data: bytes, max_layer: int | None = None) -> list[dict[str, Any]]:
    """Per layer {layer, symbols, tensors}: SHA-256 in hex of a complete file's integers and float32 values, or of
    those of its layers <= max_layer alone (bytes after those are not looked at).

    symbols: int32 little-endian, C order, of anchor_q [n, 3], the rise of earlier rows' mask codes, the codes of own
    rows, attributes [68, n], then planes [C, H, W] scale by scale in the order xy xz xt yz yt zt, then weight [out, in]
    and bias [out] per linear layer, networks by ascending id; float32 planes and weights are left out.
    tensors: float32 little-endian of anchor [n, 3], feature [n, 32], scaling_log [n, 6], offset [n, 10, 3] of own rows,
    then planes and networks as above.
    """
    reader, _ = read_layers(data, max_layer=max_layer)
    scene = reader.scene()
    rows = []
    for index, layer in enumerate(reader.layers):
        integers = [a for a in layer.arrays() if a.dtype.kind == "i"]
        symbols, tensors = _digest(integers, "<i4"), _digest(float_tensors(scene, index), "<f4")
        rows.append({"layer": layer.kind.layer, "symbols": symbols, "tensors": tensors})
    return rows


def _digest(arrays: list[np.ndarray], dtype: str) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=dtype).tobytes())
    return digest.hexdigest()
