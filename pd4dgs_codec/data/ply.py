"""PLY files: their vertex element, and initial points, which are its x, y, z and optional red, green, blue."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pd4dgs_codec.data.files import LARGEST, read_file
from pd4dgs_codec.errors import DataError

SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
END = b"end_header"
DIGITS = 12  #: of a count; Python itself refuses to read thousands


def _header(path: Path, raw: bytes) -> tuple[str, int, list[tuple[str, str]], int]:
    """Format, vertex count, vertex properties as (name, dtype), and where the body starts."""
    stop = raw.find(END)
    if not raw.startswith(b"ply") or stop < 0:
        raise DataError(f"{path}: not a PLY file (expected it to start with 'ply' and hold an end_header line)")
    newline = raw.find(b"\n", stop)
    kind, count, fields, elements = "", -1, [], 0
    for line in raw[:stop].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) >= 2:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            elements += 1
            if elements == 1 and words[1] == "vertex" and words[2].isdigit() and len(words[2]) <= DIGITS:
                count = int(words[2])
        elif words[:1] == ["property"] and elements == 1:
            if len(words) != 3 or words[1] not in SCALARS:
                raise DataError(f"{path}: vertex property {' '.join(words[1:])!r} is not a scalar this reader knows")
            fields.append((words[2], SCALARS[words[1]]))
    if kind not in ("ascii", "binary_little_endian") or count < 0 or newline < 0:
        raise DataError(
            f"{path}: found format {kind!r}, first element with {count} vertices; "
            "expected ascii or binary_little_endian and the element vertex first"
        )
    return kind, count, fields, newline + 1


def _body(path: Path, raw: bytes, kind: str, count: int, dtype: np.dtype) -> np.ndarray:
    """Structured array [count] of the vertices."""
    names = dtype.names or ()
    if kind == "binary_little_endian":
        if len(raw) < count * dtype.itemsize:
            size = count * dtype.itemsize
            raise DataError(f"{path}: {len(raw)} bytes of vertices, expected {size} for {count} of them")
        return np.frombuffer(raw, dtype, count)
    try:
        rows = [tuple(map(float, line.split()[: len(names)])) for line in raw.decode("ascii").splitlines()[:count]]
        if len(rows) == count:
            table = np.asarray(rows, np.float64).reshape(count, len(names))
            vertices = np.empty(count, dtype)
            with np.errstate(over="ignore"):  # what a type cannot hold becomes infinite there
                for i, name in enumerate(names):
                    vertices[name] = table[:, i]
            return vertices
    except ValueError:
        raise DataError(f"{path}: vertex lines are not {len(names)} numbers each") from None
    raise DataError(f"{path}: {len(rows)} vertex lines, expected {count}")


def read_vertices(path: Path, raw: bytes | None = None) -> np.ndarray:
    """Structured array [count] of the vertex element, a field per property. raw: the file's bytes, if they are read
    already. Raises DataError, one line."""
    try:
        raw = read_file(path) if raw is None else raw
    except (OSError, ValueError) as e:  # ValueError: a NUL or half a surrogate in the name
        raise DataError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
    kind, count, fields, start = _header(path, raw)
    names = [name for name, _ in fields]
    if len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        raise DataError(f"{path}: vertex properties are {', '.join(names)}, expected x, y, z once each")
    return _body(path, raw[start:], kind, count, np.dtype(fields))


def read_only_ply(folder: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """As `read_ply`, of the PLY file of a folder that holds one; (None, None) for others."""
    found = list(folder.glob("*.ply"))
    return read_ply(found[0]) if len(found) == 1 else (None, None)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points float32 [M, 3] and colours uint8 [M, 3] (None if absent).

    Points with a coordinate that is not finite or over LARGEST are dropped.
    """
    vertices = read_vertices(path)
    points = np.stack([vertices[c] for c in "xyz"], axis=1)
    keep = (np.abs(points) <= LARGEST).all(axis=1)  # also false of NaN
    names = vertices.dtype.names or ()
    has_color = all(c in names and vertices.dtype[c] == np.uint8 for c in ("red", "green", "blue"))
    colors = np.stack([vertices[c] for c in ("red", "green", "blue")], axis=1)[keep] if has_color else None
    return points[keep].astype(np.float32), colors
