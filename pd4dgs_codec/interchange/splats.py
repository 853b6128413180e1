"""Files of explicit Gaussians as in 3D Gaussian splatting, see `kinds.splats`, and pictures of them.

Reads PLY, SPZ, SOG, .splat and gsplat checkpoints, which it tells apart by their content, and writes PLY, glTF, SPZ
and 4dgs. SPZ and compressed PLY need gaussforge, 4dgs needs fourdgs; the extra `interchange` installs both.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import re
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec.archives import read_tensors
from pd4dgs_codec.data.files import FREE_BYTES, INFLATES, LARGEST, MAX_HEADER, read_file, read_vertices
from pd4dgs_codec.data.view import world_to_camera
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.errors import DamageWarning, DataError, one_line, required
from pd4dgs_codec.interchange.sog import META, read_sog
from pd4dgs_codec.kinds.splats import MAX_DEGREE, SH_C0, Splats, unit
from pd4dgs_codec.scene import Camera

T = TypeVar("T")

EXTRA = "interchange"  #: the extra that installs gaussforge and fourdgs
#: Number of coefficients of the harmonics without the constant -> degree.
REST = {(degree + 1) ** 2 - 1: degree for degree in range(MAX_DEGREE + 1)}
#: Bounds of opacities and scales before PLY files take their logits and logarithms.
LEAST_OPACITY, LEAST_SCALE = 1e-6, 1e-12
#: KHR_gaussian_splatting: linear scales and opacities, quaternions xyzw.
#: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS = 5126, 0  #: glTF's numbers of a component type and of a primitive's mode
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
JSON, BINARY = 0x4E4F534A, 0x004E4942  #: types of chunks
#: SPZ stores positions in 24 bits, 12 of them fractional: multiples of SPZ_STEP below SPZ_REACH, scene units.
SPZ_STEP, SPZ_REACH = 1 / 4096, 2048.0
SPZ_SCALE = float(np.exp(255 / 16 - 10))  #: the largest scale of an SPZ file, scene units
#: SPZ's first bytes; most Gaussians, and least and most unpacked bytes of each: 16 in version 1, 65 with all harmonics,
#: the rest for extensions.
SPZ_MAGIC, SPZ_MOST, SPZ_LEAST, SPZ_BYTES = b"NGSP", 10_000_000, 16, 128
GZIP, ZIP, PICKLE = b"\x1f\x8b\x08", b"PK\3\4", b"\x80\x02\x8a"  #: first bytes of SPZ below version 4, of torch's files
PACKED = b"\nproperty uint packed_position"  #: in the header of a compressed PLY
KINDS = "a PLY, SPZ, SOG, .splat, .splatv or .4dgs file or a checkpoint"
#: Files of Gaussians that are not read: the first bytes, bytes that are in them, and what they are. The first of a
#: .ksplat file, which has no signature, are its version.
#: https://github.com/mkkellogg/GaussianSplats3D/blob/main/src/loaders/SplatBuffer.js
NOT_READ = (
    (b"\0\1\0\0", bytes(2048), "a .ksplat file"),
    (b"glTF", b"KHR_gaussian_splatting", "a glTF file"),
)
#: A row of a .splat file: linear scales, and as 0..255 sRGB, opacity and a quaternion wxyz around 128.
#: https://github.com/antimatter15/splat
ROUNDED = 0.05  #: most difference of the length of such a quaternion from 1
ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("a", "u1"), ("quats", "u1", 4)])
#: 4dgs files store harmonics from degree 1 on as bytes, for values from -SH_SPAN to SH_SPAN; no byte stands for 0.
SH_SPAN = 4.0
SH_HALF_STEP = SH_SPAN / 255
#: fourdgs rounds the instant at which a moving Gaussian is at its position to multiples of TICK seconds.
TICK = 0.004
#: What the numbers of our 4dgs files mean, and that no Gaussian fades.
#: https://github.com/avala-ai/4dgs/blob/main/website/docs/spec/registry.md
FOURDGS_METADATA = {"color_space": "srgb-rec709-display", "visibility_profile": "box"}


def picture(splats: Splats, camera: Camera, background: tuple[float, float, float], near: float = 0.01) -> np.ndarray:
    """Draws the Gaussians by our rasteriser, float32 [H, W, 3] in 0..1. near: scene units."""
    shapes, colors = (splats.means, splats.quats, splats.scales, splats.opacities), splats.colors(camera.eye)
    image, _ = draw(*shapes, colors, camera, background, near_plane=near)
    return np.asarray(np.clip(image, 0, 1))


def looking(eye: np.ndarray, ahead: np.ndarray, up: np.ndarray, like: Camera) -> Camera:
    """Moves the camera `like` to `eye` [3], world, and turns it along the unit vector `ahead` [3], with `up` [3] up."""
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:  # straight up or down: any roll will do
        right = np.cross(ahead, np.roll(ahead, 1) + np.array([1e-3, 0, 0]))
    right = unit(right)
    viewmat = world_to_camera(np.stack([right, np.cross(ahead, right), ahead]), eye)
    return replace(like, viewmat=viewmat.astype(np.float32))


def evenly(items: Sequence[T], count: int) -> tuple[T, ...]:
    """Picks `count` items, evenly spaced in their order, or all if there are fewer."""
    rows = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return tuple(items[i] for i in rows)


def sphere(count: int) -> np.ndarray:
    """float64 [count, 3] unit vectors spread evenly, from +z to -z: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Converts rotations [n, 3, 3] to unit quaternions [n, 4] wxyz, dividing by the component of largest magnitude."""
    m = matrices
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    diagonal = np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=1)
    squares = 1 + 2 * diagonal - trace[:, None]  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    squares[:, 0] = 1 + trace
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]  # 4wx, 4wy, 4wz
    d, e, f = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]  # 4xy, 4xz, 4yz
    ww, xx, yy, zz = squares.T
    products = np.array([[ww, a, b, c], [a, xx, d, e], [b, d, yy, f], [c, e, f, zz]])
    return unit(products[squares.argmax(axis=1), :, np.arange(len(m))])


def principal_axes(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (standard deviations [n, 3], rotations [n, 3, 3] with the axes as columns) of covariances [n, 3, 3]. The
    deviations of a covariance that is not finite are NaN."""
    finite = np.isfinite(covariances).all(axis=(1, 2))
    values, axes = np.linalg.eigh(np.where(finite[:, None, None], covariances, np.eye(3)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return np.where(finite[:, None], np.sqrt(np.maximum(values, 0)), np.nan), axes


# -- reading files -----------------------------------------------------------------------------------------------------


def checked(
    where: str, means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
) -> Splats:
    """Returns the arrays as Splats with unit rotations. Drops Gaussians that are huge, invalid or not finite. Raises
    DataError for wrong shapes, or if no Gaussian is left."""
    parts = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    return usable(where, parts)[0]


def usable(where: str, parts: dict[str, np.ndarray], also: np.ndarray | bool = True) -> tuple[Splats, np.ndarray]:
    """Returns (Splats as `checked` does, their rows bool [n]), without Gaussians for which `also` is false. parts: by
    the names of Splats."""
    means, sh = parts["means"], parts["sh"]
    n = len(means) if means.ndim else 0
    harmonics = sh.shape[-2] if sh.ndim == 3 else 1
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, harmonics, 3)}
    for name, array in parts.items():
        if array.shape != shapes[name]:
            raise DataError(f"{where}: {name} has shape {array.shape}, expected {shapes[name]}")
    if sh.shape[1] - 1 not in REST:
        expected = ", ".join(str(k + 1) for k in REST)
        raise DataError(f"{where}: {sh.shape[1]} coefficients per colour, expected {expected}")
    scales, opacities = parts["scales"], parts["opacities"]
    good = np.asarray(finite_rows(parts) & also)
    good &= (np.linalg.norm(parts["quats"], axis=1) > 0) & (scales >= 0).all(axis=1)
    good &= (opacities >= 0) & (opacities <= 1)
    wanted = f"finite and at most {LARGEST:g}, with a quaternion other than 0{'' if also is True else ', and a window'}"
    if not good.any():
        raise DataError(f"{where}: none of {n} Gaussians is {wanted}, expected one")
    if not good.all():
        left = f"{n - np.count_nonzero(good):,} of {n:,} Gaussians are left out, expected all to be {wanted}"
        warnings.warn(DamageWarning(f"{where}: {left}"), stacklevel=2)
    rows = slice(None) if good.all() else good
    kept = {name: np.ascontiguousarray(array[rows], np.float32) for name, array in parts.items()}
    return Splats(**kept | {"quats": unit(kept["quats"])}), good


def finite_rows(parts: dict[str, np.ndarray]) -> np.ndarray:
    """Returns bool [n]: whether a row has only numbers of magnitude up to LARGEST in all arrays [n, ...]."""
    found = np.ones(len(next(iter(parts.values()))), bool)
    for array in parts.values():
        good = np.abs(array) <= LARGEST  # not NaN
        if not good.all():
            found &= good.all(axis=tuple(range(1, array.ndim)))
    return found


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Discards what libraries print, including from C."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(stream) for stream in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        try:
            for stream in (1, 2):
                os.dup2(nowhere.fileno(), stream)
            yield
        finally:
            with contextlib.suppress(TypeError):  # Windows finds no C library by this name
                ctypes.CDLL(None).fflush(None)  # C would write its buffers later, to the restored streams
            for stream, old in zip((1, 2), kept, strict=True):
                os.dup2(old, stream)
                os.close(old)


def read_splats(path: Path, raw: bytes | None = None, content: Any = None) -> Splats:
    """Reads a PLY file of 3D Gaussian splatting, a compressed PLY, an SPZ, SOG or .splat file, or a checkpoint of
    gsplat, whatever its name. raw: its bytes, if known; content: its `torch_content`. Raises DataError."""
    raw = read_file(path) if raw is None else raw
    for first, inside, kind in NOT_READ:
        if raw.startswith(first) and inside in raw:
            raise DataError(f"{path}: is {kind}, expected {KINDS}: convert it to PLY first")
    if raw.startswith(ZIP) and META in raw:
        return checked(str(path), **read_sog(path, raw))
    content = torch_content(path, raw) if content is None else content
    if content is not None:
        return _read_gsplat(path, content)
    return checked(str(path), **activated(read_parameters(path, raw)))


def torch_content(path: Path, raw: bytes) -> Any:
    """Returns what a file of torch holds, None for others. Raises DataError."""
    if not raw.startswith((ZIP, PICKLE)) or raw.startswith(ZIP) and META in raw:
        return None
    return read_tensors(raw, str(path))


def read_parameters(path: Path, raw: bytes | None = None) -> dict[str, np.ndarray]:
    """Reads the numbers that `read_splats` activates, float32, by the names of Splats: logarithms of scales, logits of
    opacities, and quaternions of any length. Raises DataError."""
    raw = read_file(path) if raw is None else raw
    if raw.startswith((SPZ_MAGIC, GZIP)):
        _check_spz(path, raw)
        raw = _unpacked(path, raw, "spz")
    elif PACKED in raw[:MAX_HEADER]:
        raw = _unpacked(path, raw, "compressed.ply")
    elif not raw.startswith(b"ply"):
        return _splat_rows(path, raw)
    rows = read_vertices(path, raw)
    names = set(rows.dtype.names or ())

    def stack(*wanted: str) -> np.ndarray:
        missing = [name for name in wanted if name not in names]
        if missing:
            found = f"has no property {missing[0]}" if "opacity" in names else f"is a point cloud without {missing[0]}"
            raise DataError(f"{path}: {found}, expected the properties of 3D Gaussian splatting")
        return np.stack([rows[name] for name in wanted], axis=1).astype(np.float32)

    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if rest % 3 or rest // 3 not in REST:
        raise DataError(f"{path}: has {rest} properties f_rest_*, expected {', '.join(str(3 * n) for n in REST)}")
    if "f_dc_0" not in names and names >= {"red", "green", "blue"} and rows.dtype["red"] == np.uint8:
        sh = [(stack(name) / 255 - 0.5) / SH_C0 for name in ("red", "green", "blue")]
    else:
        sh = [stack(f"f_dc_{c}", *(f"f_rest_{c * rest // 3 + i}" for i in range(rest // 3))) for c in range(3)]
    return {
        "means": stack("x", "y", "z"),
        "quats": stack("rot_0", "rot_1", "rot_2", "rot_3"),
        "scales": stack("scale_0", "scale_1", "scale_2"),
        "opacities": stack("opacity")[:, 0],
        "sh": np.stack(sh, axis=2),
    }


def _splat_rows(path: Path, raw: bytes) -> dict[str, np.ndarray]:
    """Reads the rows of a .splat file as `read_parameters` does. It has no signature, but its quaternions have length
    1. Raises DataError for other bytes."""
    rows = np.frombuffer(raw, ROW, len(raw) // ROW.itemsize)
    quats = (rows["quats"].astype(np.float32) - 128) / 128
    units = np.count_nonzero(np.abs(np.linalg.norm(quats, axis=1) - 1) < ROUNDED)
    if len(raw) % ROW.itemsize or 2 * units <= len(rows):
        raise DataError(f"{path}: begins with {raw[:8]!r} and is of no known kind, expected {KINDS}")
    with np.errstate(divide="ignore", invalid="ignore"):
        opacities, scales = rows["a"] / np.float32(255), np.log(rows["scales"])
        return {
            "means": rows["means"].astype(np.float32),
            "quats": quats,
            "scales": scales,
            "opacities": np.log(opacities / (1 - opacities)),
            "sh": ((rows["rgb"][:, None] / np.float32(255) - np.float32(0.5)) / np.float32(SH_C0)),
        }


def activated(parameters: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the parameters with scales and opacities instead of their logarithms and logits."""
    with np.errstate(over="ignore"):
        scales, opacities = np.exp(parameters["scales"]), 1 / (1 + np.exp(-parameters["opacities"]))
    return parameters | {"scales": scales, "opacities": opacities}


def _unpacked(path: Path, data: bytes, kind: str) -> bytes:
    """Converts an SPZ file or a compressed PLY to a PLY with gaussforge."""
    forge = required("gaussforge", EXTRA, "SPZ files and compressed PLYs").GaussForge()
    with quiet():
        found = forge.convert(data, kind, "ply")
    if "error" in found or not found["data"]:
        why = one_line(str(found.get("error", "no Gaussians were found")), 120)
        raise DataError(f"{path}: gaussforge cannot read it: {why}")
    return bytes(found["data"])


def _check_spz(path: Path, data: bytes) -> None:
    """Raises DataError unless `data` is an SPZ file that unpacks to as many bytes as its Gaussians need. gaussforge has
    no such limits."""
    unpacker, zipped = zlib.decompressobj(wbits=31), data[:4] != SPZ_MAGIC  # versions from 4 do not compress it
    try:
        head = unpacker.decompress(data, 20) if zipped else data[:20]
        if head[:4] != SPZ_MAGIC or len(head) < 16:
            raise DataError(f"{path}: is not an SPZ file, expected it to begin with {SPZ_MAGIC.decode()}")
        count = int.from_bytes(head[8:12], "little")
        if count > SPZ_MOST:
            raise DataError(f"{path}: declares {count:,} Gaussians, expected {SPZ_MOST:,} at most")
        size, most = len(head), min(len(head) + SPZ_BYTES * count, FREE_BYTES + INFLATES * len(data))
        while zipped and not unpacker.eof and size <= most:
            part = unpacker.decompress(unpacker.unconsumed_tail, 1 << 20)
            if not part:
                break
            size += len(part)
    except zlib.error as error:
        raise DataError(f"{path}: is not an SPZ file: {error}") from None
    if not zipped:  # a table of streams: packed and unpacked bytes of each
        table = data[int.from_bytes(head[16:20], "little") :][: 16 * head[15]]
        size = sum(int.from_bytes(table[i + 8 : i + 16], "little") for i in range(0, len(table), 16))
    if size > most:
        raise DataError(f"{path}: unpacks to more bytes than {count:,} Gaussians need, expected at most {most:,}")
    if size < SPZ_LEAST * count:
        raise DataError(f"{path}: unpacks to {size:,} bytes, too few for the {count:,} Gaussians that it declares")


def _read_gsplat(path: Path, content: Any) -> Splats:
    """Reads a checkpoint of gsplat's trainers, {"splats": state dict}. Raises DataError."""
    state = content.get("splats") if isinstance(content, dict) else None
    wanted = ("means", "quats", "scales", "opacities", "sh0", "shN")
    missing = [name for name in wanted if not isinstance(state, dict) or not isinstance(state.get(name), np.ndarray)]
    if missing or not isinstance(state, dict):
        raise DataError(f"{path}: has no splats.{missing[0]}; expected a checkpoint of gsplat with spherical harmonics")
    *_, base, rest = parts = [state[name].astype(np.float32) for name in wanted]
    if base.ndim != 3 or rest.ndim != 3 or base.shape[::2] != rest.shape[::2]:
        found = f"sh0 and shN have shapes {base.shape} and {rest.shape}"
        raise DataError(f"{path}: {found}, expected (n, 1, 3) and (n, any, 3)")
    sh = np.concatenate([base, rest], axis=1)
    return checked(str(path), sh=sh, **activated(dict(zip(wanted[:4], parts, strict=False))))


# -- writing files -----------------------------------------------------------------------------------------------------


def properties(degree: int) -> list[str]:
    """Names of the vertex properties in order, as 3D Gaussian splatting writes them; all are float."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest)),
        "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
    ]  # fmt: skip


def ply_bytes(splats: Splats) -> bytes:
    """Returns a binary PLY with normals of 0, f_rest channel by channel, logits of opacities, logarithms of scales and
    quaternions wxyz."""
    n = len(splats.means)
    p = np.clip(splats.opacities.astype(np.float64), LEAST_OPACITY, 1 - LEAST_OPACITY)
    columns = (
        splats.means,
        np.zeros((n, 3)),
        splats.sh[:, 0],
        splats.rest,
        np.log(p / (1 - p))[:, None],
        np.log(np.maximum(splats.scales, LEAST_SCALE)),
        splats.quats,
    )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    head += [*(f"property float {name}" for name in properties(splats.degree)), "end_header", ""]
    return "\n".join(head).encode() + np.concatenate(columns, axis=1).astype("<f4").tobytes()


def glb_bytes(splats: Splats) -> bytes:
    """Returns a binary glTF 2.0 file; viewers without the extension show points. Rotate first: +y is up in glTF."""
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": np.concatenate([_linear(splats.base_colors), splats.opacities[:, None]], axis=1),
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
    """Converts sRGB values 0..1 (IEC 61966-2-1) to linear values, as glTF's COLOR_0 requires."""
    light: np.ndarray = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    return light


def spz_bytes(splats: Splats) -> bytes:
    """Returns an SPZ file of version 3. Raises DataError for positions beyond its fixed-point range."""
    reach = float(np.abs(splats.means).max(initial=0))
    if reach >= SPZ_REACH - SPZ_STEP / 2:  # which rounding would wrap
        found = f"a Gaussian lies {reach:.4g} units from 0"
        raise DataError(f"{found}, expected less than {SPZ_REACH:g} in SPZ: use --scale below 1")
    with quiet():
        forge = required("gaussforge", EXTRA, "SPZ files").GaussForge()
        result = forge.convert(ply_bytes(splats), "ply", "spz", spz_version=3)
    if "error" in result:
        raise DataError(f"gaussforge cannot write this SPZ file: {result['error']}")
    return bytes(result["data"])


def fourdgs_bytes(frames: Sequence[tuple[float, Splats, np.ndarray]], seconds: float) -> bytes:
    """Returns a .4dgs file of `seconds`. Each Gaussian is shown in its frame and moves to its slot in the next frame.

    frames: (start in seconds, Gaussians, their slots int64 [N]), ascending from 0. Harmonics of the highest degrees are
    left out if their bytes are farther from them than 0. Raises DataError.
    """
    fourdgs = required("fourdgs", EXTRA, ".4dgs files")
    degree = max(_fourdgs_degree(splats) for _, splats, _ in frames)
    starts = [start for start, _, _ in frames]
    ends = [*starts[1:], seconds]
    parts: dict[str, list[np.ndarray]] = {}
    for i, (start, splats, slots) in enumerate(frames):
        n, middle = len(slots), TICK * round((start + ends[i]) / 2 / TICK)
        speed = np.zeros((n, 3), np.float32)
        if i + 1 < len(frames):
            _, later, later_slots = frames[i + 1]
            _, here, there = np.intersect1d(slots, later_slots, assume_unique=True, return_indices=True)
            speed[here] = (later.means[there] - splats.means[here]) / np.float32(ends[i] - start)
        rest = replace(splats, sh=splats.sh[:, : (degree + 1) ** 2]).rest
        for name, values in {
            "positions": splats.means + speed * np.float32(middle - start),
            "scales": splats.scales,
            "rotations": splats.quats[:, [1, 2, 3, 0]],
            "colors": np.concatenate([splats.base_colors, splats.opacities[:, None]], axis=1),
            "motions": speed,
            "mu_t": np.full(n, middle, np.float32),
            "sigma_t": np.full(n, np.inf, np.float32),
            "win_lo": np.full(n, start),
            "win_hi": np.full(n, ends[i]),
            "sh": np.clip(np.rint((rest + SH_SPAN) * (255 / (2 * SH_SPAN))), 0, 255).astype(np.uint8),
        }.items():
            parts.setdefault(name, []).append(values)
    columns: dict[str, Any] = {name: np.concatenate(values) for name, values in parts.items()}
    if degree == 0:
        columns["sh"] = None
    stream, options = io.BytesIO(), fourdgs.WriteOptions(metadata=FOURDGS_METADATA)
    try:
        fourdgs.write(stream, fourdgs.GaussianSet(**columns, sh_degree=degree), seconds, options=options)
    except (fourdgs.FourdgsError, ValueError) as error:
        wide, scale = (float(x) for x in (np.ptp(columns["positions"], axis=0).max(), np.median(columns["scales"])))
        found = f"Gaussians {wide:.3g} units apart, with a median scale of {scale:.3g}"
        raise DataError(f"fourdgs cannot write {found}: {one_line(str(error), 160)}") from None
    return stream.getvalue()


def _fourdgs_degree(splats: Splats) -> int:
    """Returns the highest degree with a coefficient that a byte stands for better than 0 does."""
    large = (np.abs(splats.sh[:, 1:]) > SH_HALF_STEP).any(axis=(0, 2))
    return int(np.sqrt(large.nonzero()[0].max(initial=-1) + 1))
