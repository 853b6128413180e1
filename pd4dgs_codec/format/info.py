"""Facts about a file, from the header alone where possible; digests of its contents; its scene as arrays by name."""

import hashlib
from typing import Any

import numpy as np

from pd4dgs_codec import kinds
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, MAJOR, MINOR, read_chunk, read_preamble
from pd4dgs_codec.format.header import unpack_header
from pd4dgs_codec.format.metadata import CHUNK_TYPE, TEXTS, Metadata, read_metadata
from pd4dgs_codec.format.parameters import read_parameters
from pd4dgs_codec.format.reader import Base, Source, read_layers
from pd4dgs_codec.format.registry import LAYERS
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.scene import MASK_STEP, Scene
from pd4dgs_codec.tensors.quantise import NO_CLASSES, dequantise, quantise
from pd4dgs_codec.tensors.tables import Tables

FORMAT_VERSION = f"{MAJOR}.{MINOR}"


def info(data: bytes) -> dict[str, Any]:
    """Returns the header and layers of a file, or of a prefix of it that holds at least the preamble and header.

    layers: {layer, offset, bytes, end, slices}; bytes counts whole chunks, and end is the length of the prefix with
    layers 0 .. this one. Layers that `data` holds whole also have anchors, and of a known kind what its `json_of_layer`
    in `kinds` says, else grids, chains, layer rows, their steps and kind, see `Tables.json`. slices: {offset, bytes,
    end}, and anchors and fill if `data` holds the slice whole. kind, rows: of the header; of a known kind also what its
    `json` says.
    base: {scene, digest, rows, bytes} of the base, the first two in hexadecimal, None without one. anchors: its own.
    metadata: {title, source, licence, command, quality, slices, still_bytes} as far as given, {"fault"} if it cannot be
    read, None if `data` holds no metadata chunk. Raises DecodeError.
    """
    preamble = read_preamble(data)
    header = unpack_header(preamble.header)
    others, offset, base, declared = [], preamble.size, header.base, header.declared
    layers, tables = list[dict[str, Any]](), dict[int, Tables]()
    metadata: dict[str, Any] | None = None
    for index, (chunk_type, length) in enumerate(header.chunks):
        size = CHUNK_OVERHEAD + length
        place: dict[str, Any] = {"offset": offset, "bytes": size, "end": offset + size}
        if chunk_type not in LAYERS:
            others.append({"type": chunk_type, **place})
            if chunk_type == CHUNK_TYPE and metadata is None and offset + size <= len(data):
                metadata = _about(read_chunk(data, offset, type=chunk_type, length=length, index=index).payload)
        else:
            later = bool(layers) and layers[-1]["layer"] == chunk_type
            if not later:
                layers.append({"layer": chunk_type, **place, "bytes": 0, "slices": []})
            row = layers[-1]
            row["slices"].append(place)
            row |= {"bytes": row["bytes"] + size, "end": place["end"]}
            if offset + size <= len(data):
                payload = read_chunk(data, offset, type=chunk_type, length=length, index=index).payload
                of = tables[chunk_type] if later else None
                found, _, declared = read_parameters(payload, chunk_type, header.table, declared, of)
                place |= {"anchors": found.rows, "fill": found.fill and list(found.fill)}
                if not later:
                    tables[chunk_type] = found.tables
                    row |= kinds.json_of_layer(header.kind, header.table, tables)
                row["anchors"] = row.get("anchors", 0) + found.rows
            else:
                layers[-1] = {name: row[name] for name in ("layer", "offset", "bytes", "end", "slices")}
        offset += size
    return {
        "format_version": f"{preamble.major}.{preamble.minor}",
        "bytes": offset,
        "available": len(data),
        "header_bytes": preamble.size,
        "mode": header.mode,
        "voxel_size": header.info.voxel_size,
        **kinds.json(header.kind, header.table),
        "graded": header.table.graded,
        "anchors": declared.rows - header.declared.rows if all("anchors" in row for row in layers) else None,
        "base": base
        and {"scene": base.scene_id.hex(), "digest": base.digest.hex(), "rows": base.rows, "bytes": base.bytes},
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


def hashes(data: bytes, max_layer: int | None = None, base: Source | Base | None = None) -> list[dict[str, Any]]:
    """Returns {layer, symbols, tensors} per layer: SHA-256 in hex of the integers and of the float32 values in a
    complete file, or in its layers <= max_layer (later bytes are ignored). Clause 12.4.

    symbols: int32 little-endian, C order, of the own voxels [n, 3], the rises of earlier mask codes, the own codes, the
    step classes if there are any, the rows [W, n] in steps, the layer rows likewise, then the planes [C, H, W] grid by
    grid, then weight and bias per linear layer, chain by chain. tensors: float32 little-endian of the own positions [n,
    3], the rows and layer rows (per tensor [n, C]), then planes, weights and biases as above.
    """
    header, layers = read_layers(data, max_layer=max_layer, base=base)
    found = []
    for part in layers:
        values = [dequantise(part.anchor_q, header.info.voxel_size), *header.table.dequantise(part.rows)]
        values += [*part.layer_table.dequantise(part.layer_rows), *part.tensors.dequantised().arrays]
        found.append({"layer": part.layer, "symbols": _digest(part.arrays(), "<i4"), "tensors": _digest(values, "<f4")})
    return found


def _digest(arrays: list[np.ndarray], dtype: str) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=dtype).tobytes())
    return digest.hexdigest()


# -- arrays for readers without this package ---------------------------------------------------------------------------

#: Part of the names of each layer's networks and planes in a scaffold.
OWNERS = {0: "", 1: "global", 2: "local"}


def to_npz_dict(scene: AnyScene, symbols: bool = False) -> dict[str, np.ndarray]:
    """Returns a scene as arrays by key, for numpy.savez: anchor (float32 positions at rest), the attributes (float32,
    one row per anchor); mask_L per layer L present (float32 masks of the first rows); meta_* for the rest.

    A scaffold has mlp.NAME.weight.i and .bias.i with NAME opacity, covariance, color, {global,local}.trunk and
    {global,local}.HEAD, and planes.{global,local}.SCALE.PLANE. Splats have tracks.L.instants, tracks.L.bases.HEAD
    [K c, 1, T] and tracks.L.coefficients.HEAD [n, K], and with groups tracks.L.group [n, 1], tracks.L.centres [3, 1, M]
    and tracks.L.maps.HEAD [4 K, 1, M].

    Step classes add step_class (uint8), and NAME_centre (float32) per attribute, whose values are the centre plus
    multiples of 2^step_class steps.

    symbols: adds NAME_q (int32) and NAME_step (float32) for every quantised array; anchor_step is the voxel size.
    Coefficients are NAME_q steps, whatever their class.
    """
    arrays, steps = {"anchor": scene.anchor, **scene.attributes}, dict[str, float]()
    table = kinds.row_table(scene)
    if scene.grading is not None:
        arrays["step_class"] = scene.grading.classes
        for (name, values), (_, centre) in zip(
            scene.attributes.items(), table.of_each(scene.grading.centre), strict=True
        ):
            arrays[f"{name}_centre"] = centre.reshape(values.shape[1:])
    for layer in LAYERS:
        tensors = kinds.tensors_of(scene, layer)
        found = dict(zip(kinds.array_names(scene, layer, tensors.tables), tensors.arrays, strict=True))
        all_steps = [*tensors.tables.steps, *(tensor.step for tensor in tensors.tables.rows)]
        if tensors.tables.rows:
            found |= kinds.rows_of(scene, layer, scene.rows[scene.layers.index(layer)])
        for step, (name, array) in zip(all_steps, found.items(), strict=True):
            family, rest = name.split(".", 1)
            name = ".".join(filter(None, (family, OWNERS[layer] if isinstance(scene, Scene) else str(layer), rest)))
            arrays[name], steps[name] = array, step
    if symbols:
        quantised = {name: quantise(arrays[name], step, name) for name, step in steps.items()}
        classes = NO_CLASSES if scene.grading is None else scene.grading.classes.astype(np.int32)
        v = table.quantise(list(scene.attributes.values()), classes, list(scene.attributes))
        channels = table.symbols(v, classes)
        for name, (_, rows) in zip(scene.attributes, table.of_each(channels), strict=True):
            quantised[name] = rows.T.reshape(arrays[name].shape)
        steps |= scene.row_steps
        arrays |= {f"{name}_q": k for name, k in quantised.items()}
        arrays |= {f"{name}_step": np.float32(step) for name, step in steps.items()}
        arrays |= {"anchor_q": scene.anchor_q, "anchor_step": np.float32(scene.info.voxel_size)}
    for layer, codes in zip(scene.layers, scene.mask, strict=True):
        arrays[f"mask_{layer}"] = codes.astype(np.float32) * MASK_STEP
        if symbols:
            arrays |= {f"mask_{layer}_q": codes.astype(np.int32), f"mask_{layer}_step": MASK_STEP}
    return {name: np.asarray(a) for name, a in (arrays | _meta(scene)).items()}


def _meta(scene: AnyScene) -> dict[str, np.ndarray]:
    info = scene.info
    meta = {
        "layers": np.array(scene.layers, np.int32),
        "rows": np.array(scene.rows, np.int32),
        "voxel_size": np.float32(info.voxel_size),
        "box": info.box,
        "time_range": np.array(info.time_range, np.float32),
        "background": np.array(scene.background(), np.float32),
        "near_far": np.array([info.near, info.far], np.float32),
        "up": np.array(info.up, np.float32),
        "unit": np.float32(info.unit),
    }
    if info.camera is not None:
        meta |= {"camera_viewmat": info.camera.viewmat, "camera_K": info.camera.K}
        meta["camera_size"] = np.array([info.camera.width, info.camera.height], np.int32)
    return {f"meta_{name}": np.asarray(value) for name, value in meta.items()}
