"""Facts about a file, from the header alone where possible; digests of its contents; its scene as arrays by name."""

import hashlib
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, MAJOR, MINOR, read_chunk, read_preamble
from pd4dgs_codec.format.decoder import read_layers
from pd4dgs_codec.format.deformation import arrays_of
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.metadata import CHUNK_TYPE, TEXTS, Metadata, read_metadata
from pd4dgs_codec.format.payload import Declared, read_parameters
from pd4dgs_codec.format.quantise import Grid, attribute_rows, classes_of, quantise
from pd4dgs_codec.format.registry import BY_CHUNK_TYPE, LAYER_KINDS, Section
from pd4dgs_codec.scene import MASK_STEP, Scene

FORMAT_VERSION = f"{MAJOR}.{MINOR}"


def info(data: bytes) -> dict[str, Any]:
    """Returns the header and layers of a file, or of a prefix of it that holds at least the preamble and header.

    layers: {layer, offset, bytes, end, slices}; bytes counts whole chunks, and end is the length of the prefix with
    layers 0 .. this one. Layers that `data` holds whole also have anchors, steps, planes ([C, x, y, z, t] per scale),
    networks (output widths), key_instant if any, and sections (bytes by name, without frames and parameters).
    slices: {offset, bytes, end}, and anchors if `data` holds the slice whole.
    metadata: {title, source, licence, command, quality, slices, still_bytes} as far as given, {"fault"} if it cannot be
    read, None if `data` holds no metadata chunk. Raises DecodeError.
    """
    preamble = read_preamble(data)
    header = unpack_header(preamble.header)
    others, offset, declared = [], preamble.size, Declared()
    layers: list[dict[str, Any]] = []
    metadata: dict[str, Any] | None = None
    for index, (chunk_type, length) in enumerate(header.chunks):
        size = CHUNK_OVERHEAD + length
        kind = BY_CHUNK_TYPE.get(chunk_type)
        place: dict[str, Any] = {"offset": offset, "bytes": size, "end": offset + size}
        if kind is None:
            others.append({"type": chunk_type, **place})
            if chunk_type == CHUNK_TYPE and metadata is None and offset + size <= len(data):
                metadata = _about(read_chunk(data, offset, type=chunk_type, length=length, index=index).payload)
        else:
            later = bool(layers) and layers[-1]["layer"] == kind.layer
            if not later:
                layers.append({"layer": kind.layer, **place, "bytes": 0, "slices": []})
            row = layers[-1]
            row["slices"].append(place)
            row |= {"bytes": row["bytes"] + size, "end": place["end"]}
            if offset + size <= len(data):
                payload = read_chunk(data, offset, type=chunk_type, length=length, index=index).payload
                meta, _, declared = read_parameters(payload, kind, header.grid.widths, declared, later)
                place["anchors"] = meta.rows
                row["anchors"] = row.get("anchors", 0) + meta.rows
                if not later:
                    row |= {"steps": meta.steps, **meta.shape.json(), "sections": {}}
                for key, section_bytes in sorted(meta.sections.items()):
                    name = Section(key).name.lower()
                    row["sections"][name] = row["sections"].get(name, 0) + section_bytes
            else:
                for known in ("anchors", "steps", "planes", "networks", "key_instant", "sections"):
                    row.pop(known, None)
        offset += size
    return {
        "format_version": f"{preamble.major}.{preamble.minor}",
        "bytes": offset,
        "available": len(data),
        "header_bytes": preamble.size,
        "mode": header.mode,
        "voxel_size": header.info.voxel_size,
        "feature_width": header.grid.widths.feature,
        "slots": header.grid.widths.slots,
        "view_dependent": list(header.grid.widths.viewing),
        "graded": header.grid.widths.graded,
        "steps": header.grid.steps,
        "error_bounds": header.error_bounds,
        "anchors": declared.rows if all("anchors" in row for row in layers) else None,
        "time_range": list(header.info.time_range),
        "camera": header.info.camera is not None,
        "metadata": metadata,
        "layers": layers,
        "chunks": others,
    }


def metadata_of(data: bytes) -> Metadata | None:
    """Returns the metadata of a complete file, None if it has none. Raises DecodeError if it cannot be read."""
    preamble = read_preamble(data)
    offset = preamble.size
    for chunk_type, length in unpack_header(preamble.header).chunks:
        if chunk_type == CHUNK_TYPE:
            return read_metadata(read_chunk(data, offset, type=chunk_type, length=length).payload)
        offset += CHUNK_OVERHEAD + length
    return None


def _about(payload: bytes) -> dict[str, Any]:
    """Returns metadata as JSON can hold it. A fault leaves the layers valid, so it is reported and not raised."""
    try:
        found = read_metadata(payload)
    except DecodeError as error:
        return {"fault": str(error)}
    texts = {name: text for name in TEXTS if (text := getattr(found, name))}
    quality = {"quality": {str(level): db for level, db in found.quality.items()}} if found.quality else {}
    slices = {"slices": list(found.slices)} if found.slices else {}
    return {**texts, **quality, **slices, **({"still_bytes": len(found.still)} if found.still else {})}


def hashes(data: bytes, max_layer: int | None = None) -> list[dict[str, Any]]:
    """Returns {layer, symbols, tensors} per layer: SHA-256 in hex of the integers and of the float32 values in a
    complete file, or in its layers <= max_layer (later bytes are ignored). Clause 12.4.

    symbols: int32 little-endian, C order, of anchor_q [n, 3], the rise of earlier rows' mask codes, the codes of own
    rows, their step classes if there are any, attributes [channels, n], then planes [C, H, W] scale by scale in the
    order xy xz xt yz yt zt, then weight [out, in] and bias [out] per linear layer, networks by ascending id.
    tensors: float32 little-endian of anchor [n, 3], feature [n, D], scaling_log [n, 6], offset [n, G, 3] of own rows,
    then planes and networks as above.
    """
    _, symbols = read_layers(data, max_layer=max_layer)
    scene, found, first = symbols.scene(), [], 0
    for layer, last in zip(symbols.layers, scene.rows, strict=True):
        own, first = slice(first, last), last
        tensors = [scene.anchor_at(own), *(values[own] for values in scene.attributes.values())]
        tensors += [x for *_, x in arrays_of(scene.tensors(layer.kind.layer), layer.kind)]
        digests = {"symbols": _digest(layer.arrays(), "<i4"), "tensors": _digest(tensors, "<f4")}
        found.append({"layer": layer.kind.layer, **digests})
    return found


def _digest(arrays: list[np.ndarray], dtype: str) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=dtype).tobytes())
    return digest.hexdigest()


# -- arrays for readers without this package ---------------------------------------------------------------------------

#: Part of the names of each layer's networks and planes.
OWNERS = {0: "", 1: "global", 2: "local"}


def to_npz_dict(scene: Scene, symbols: bool = False) -> dict[str, np.ndarray]:
    """Returns a scene as arrays by key, for numpy.savez: anchor, feature, scaling_log, offset (float32, one row per
    anchor); mask_L per layer L present (float32 masks of the first rows); mlp.NAME.weight.i and .bias.i with NAME
    opacity, covariance, color, {global,local}.trunk and {global,local}.HEAD; planes.{global,local}.SCALE.PLANE; meta_*
    for the rest.

    Step classes add step_class (uint8), and NAME_centre (float32) per attribute, whose values are the centre plus
    multiples of 2^step_class steps.

    symbols: adds NAME_q (int32) and NAME_step (float32) for every quantised array; anchor_step is the voxel size.
    """
    arrays, steps = {"anchor": scene.anchor, **scene.attributes}, dict[str, float]()
    if scene.grading is not None:
        arrays["step_class"] = scene.grading.classes
        for name, centre in attribute_rows(scene.grading.centre, scene.widths):
            arrays[f"{name}_centre"] = centre.reshape(scene.widths.attributes[name])
    for kind in LAYER_KINDS:
        for step, name, array in arrays_of(scene.tensors(kind.layer), kind):
            family, rest = name.split(".", 1)
            name = ".".join(filter(None, (family, OWNERS[kind.layer], rest)))
            arrays[name], steps[name] = array, vars(scene.steps)[step]
    if symbols:
        quantised = {name: quantise(arrays[name], step, name) for name, step in steps.items()}
        channels = Grid.of(scene).quantise(scene.attributes, classes_of(scene))
        for name, rows in attribute_rows(channels, scene.widths):
            quantised[name] = rows.T.reshape(arrays[name].shape)
        steps |= scene.steps.attributes
        arrays |= {f"{name}_q": k for name, k in quantised.items()}
        arrays |= {f"{name}_step": np.float32(step) for name, step in steps.items()}
        arrays |= {"anchor_q": scene.anchor_q, "anchor_step": np.float32(scene.info.voxel_size)}
    for layer, codes in zip(scene.layers, scene.mask, strict=True):
        arrays[f"mask_{layer}"] = codes.astype(np.float32) * MASK_STEP
        if symbols:
            arrays |= {f"mask_{layer}_q": codes.astype(np.int32), f"mask_{layer}_step": MASK_STEP}
    return {name: np.asarray(a) for name, a in (arrays | _meta(scene)).items()}


def _meta(scene: Scene) -> dict[str, np.ndarray]:
    info = scene.info
    meta = {
        "layers": np.array(scene.layers, np.int32),
        "rows": np.array(scene.rows, np.int32),
        "voxel_size": np.float32(info.voxel_size),
        "box": info.box,
        "time_range": np.array(info.time_range, np.float32),
        "background": np.array(info.background, np.float32),
        "near_far": np.array([info.near, info.far], np.float32),
        "up": np.array(info.up, np.float32),
        "unit": np.float32(info.unit),
    }
    if info.camera is not None:
        meta |= {"camera_viewmat": info.camera.viewmat, "camera_K": info.camera.K}
        meta["camera_size"] = np.array([info.camera.width, info.camera.height], np.int32)
    return {f"meta_{name}": np.asarray(value) for name, value in meta.items()}
