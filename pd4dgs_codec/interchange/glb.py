"""A binary glTF 2.0 file of Gaussians by KHR_gaussian_splatting: linear scales and opacities, quaternions xyzw.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from pd4dgs_codec.interchange.splats import SH_C0, Splats

EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS = 5126, 0  #: glTF's numbers of a component type and of a primitive's mode
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
JSON, BINARY = 0x4E4F534A, 0x004E4942  #: types of chunks


def glb_bytes(splats: Splats) -> bytes:
    """The file. A viewer that does not know the extension shows coloured points. glTF's +y is up: turn them first."""
    colors = np.clip(splats.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1)
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": np.concatenate([_linear(colors), splats.opacities[:, None]], axis=1),
        f"{EXTENSION}:ROTATION": splats.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
    }
    for degree in range(splats.degree + 1):
        for i in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = splats.sh[:, degree * degree + i]
    arrays = [np.ascontiguousarray(values, "<f4") for values in attributes.values()]
    views, at = [], 0
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": at, "byteLength": array.nbytes})
        at += array.nbytes
    accessors: list[dict[str, Any]] = [
        {"bufferView": i, "componentType": FLOAT, "count": len(array), "type": TYPES[array.shape[1]]}
        for i, array in enumerate(arrays)
    ]
    low, high = arrays[0].min(axis=0), arrays[0].max(axis=0)
    accessors[0] |= {"min": [float(v) for v in low], "max": [float(v) for v in high]}
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "pd4dgs-codec"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + at, len(text), JSON)
    return b"".join([head, text, struct.pack("<II", at, BINARY), *(array.tobytes() for array in arrays)])


def _linear(colors: np.ndarray) -> np.ndarray:
    """Light of sRGB values 0..1 (IEC 61966-2-1): COLOR_0 is linear in glTF."""
    light: np.ndarray = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return light
