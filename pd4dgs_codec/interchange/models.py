"""Models that can say their Gaussians at a time, read from the files of others or asked of a function."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.files import LARGEST, read_file, read_vertices
from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.interchange.libraries import SH_SPAN, library, quiet
from pd4dgs_codec.interchange.splats import MAX_DEGREE, SH_C0, Splats, unit
from pd4dgs_codec.interchange.tensors import read_tensors

FRAME_SUFFIXES = (".ply", ".spz")
#: Coefficients of the harmonics but the constant, by degree.
REST = {(degree + 1) ** 2 - 1: degree for degree in range(MAX_DEGREE + 1)}
#: Of an SPZ file: its first bytes, Gaussians at most, and unpacked bytes of each at most: 65 with all harmonics, and
#: extensions.
SPZ_MAGIC, SPZ_MOST, SPZ_BYTES = b"NGSP", 10_000_000, 128
#: What a function answers, with colors in the place of sh if it has no harmonics.
PARTS = ("means", "quats", "scales", "opacities", "sh")


@dataclass(frozen=True)
class Teacher:
    """splats: normalised time -> Gaussians. times: the instants that it knows, or None for any; seconds: from the first
    to the last."""

    splats: Callable[[float], Splats]
    times: tuple[float, ...] | None
    seconds: float

    def nearest(self, t: float) -> float:
        """The instant that it knows next to t."""
        return t if self.times is None else min(self.times, key=lambda known: abs(known - t))


def read_model(place: str, fps: float) -> Teacher:
    """The teacher at a path, or `module:function`. fps: frames per second of a folder. Raises DataError."""
    path = Path(place)
    if path.is_dir():
        return _folder(path, fps)
    if path.is_file():
        name = path.name.lower()
        if name.endswith(".4dgs"):
            return _fourdgs(path)
        read = _gsplat if name.endswith((".pt", ".pth", ".ckpt")) else read_splats
        splats = read(path)
        return Teacher(lambda t: splats, (0.0,), 1.0)
    if match := re.fullmatch(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)", place):
        return Teacher(_function(*match.groups()), None, 1.0)
    raise DataError(f"{place}: found nothing, expected a folder of PLY or SPZ files, a file, or module:function")


def _folder(folder: Path, fps: float) -> Teacher:
    """One file per frame."""
    kinds = {suffix: [p for p in folder.iterdir() if p.suffix.lower() == suffix] for suffix in FRAME_SUFFIXES}
    paths = max(kinds.values(), key=len)
    if not paths:
        raise DataError(f"{folder}: holds no file that ends in {' or '.join(FRAME_SUFFIXES)}, expected one per frame")

    def place(path: Path) -> tuple[int, str]:
        digits = re.findall(r"\d{1,18}", path.stem)
        return int(digits[-1]) if digits else 0, path.name

    paths.sort(key=place)
    times = tuple(i / max(len(paths) - 1, 1) for i in range(len(paths)))

    @lru_cache(maxsize=2)
    def frame(i: int) -> Splats:
        return read_splats(paths[i])

    def splats(t: float) -> Splats:
        return frame(round(t * (len(paths) - 1)))

    return Teacher(splats, times, max(len(paths) - 1, 1) / fps)


def read_splats(path: Path) -> Splats:
    """The Gaussians of a PLY as 3D Gaussian splatting writes it, of a compressed PLY or of an SPZ file."""
    compressed = path.name.lower().endswith(".compressed.ply")
    if path.suffix.lower() == ".spz" or compressed:
        rows = read_vertices(path, _unpacked(path, "compressed.ply" if compressed else "spz"))
    else:
        rows = read_vertices(path)
    names = set(rows.dtype.names or ())

    def stack(*wanted: str) -> np.ndarray:
        missing = [name for name in wanted if name not in names]
        if missing:
            raise DataError(f"{path}: has no property {missing[0]}, expected those of 3D Gaussian splatting")
        return np.stack([rows[name] for name in wanted], axis=1).astype(np.float32)

    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if rest % 3 or rest // 3 not in REST:
        raise DataError(f"{path}: has {rest} properties f_rest_*, expected {', '.join(str(3 * n) for n in REST)}")
    sh = [stack("f_dc_0", "f_dc_1", "f_dc_2")[:, None]]
    if rest:
        columns = stack(*(f"f_rest_{i}" for i in range(rest)))
        sh.append(columns.reshape(len(rows), 3, rest // 3).transpose(0, 2, 1))
    with np.errstate(over="ignore"):
        return checked(
            str(path),
            means=stack("x", "y", "z"),
            quats=stack("rot_0", "rot_1", "rot_2", "rot_3"),
            scales=np.exp(stack("scale_0", "scale_1", "scale_2")),
            opacities=1 / (1 + np.exp(-stack("opacity")[:, 0])),
            sh=np.concatenate(sh, axis=1),
        )


def _unpacked(path: Path, kind: str) -> bytes:
    """The PLY that gaussforge makes of an SPZ file or a compressed PLY."""
    forge = library("gaussforge", "SPZ files and compressed PLYs").GaussForge()
    try:
        data = read_file(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    if kind == "spz":
        _check_spz(path, data)
    with quiet():
        found = forge.convert(data, kind, "ply")
    if "error" in found or not found["data"]:
        why = one_line(str(found.get("error", "no Gaussians were found")), 120)
        raise DataError(f"{path}: gaussforge cannot read it: {why}")
    return bytes(found["data"])


def _check_spz(path: Path, data: bytes) -> None:
    """Refuses what is no SPZ file, and what unpacks to more than its Gaussians take: gaussforge would keep it all."""
    unpacker, zipped = zlib.decompressobj(wbits=31), data[:4] != SPZ_MAGIC  # from version 4 on the header is bare
    try:
        head = unpacker.decompress(data, 20) if zipped else data[:20]
        if head[:4] != SPZ_MAGIC or len(head) < 16:
            raise DataError(f"{path}: is no SPZ file, expected one that begins with {SPZ_MAGIC.decode()}")
        count = int.from_bytes(head[8:12], "little")
        if count > SPZ_MOST:
            raise DataError(f"{path}: says it has {count:,} Gaussians, expected {SPZ_MOST:,} at most")
        size, most = len(head), len(head) + SPZ_BYTES * count
        while zipped and not unpacker.eof and size <= most:
            part = unpacker.decompress(unpacker.unconsumed_tail, 1 << 20)
            if not part:
                break
            size += len(part)
    except zlib.error as error:
        raise DataError(f"{path}: is no SPZ file: {error}") from None
    if not zipped:  # a table of streams: packed and unpacked bytes of each
        table = data[int.from_bytes(head[16:20], "little") :][: 16 * head[15]]
        size = sum(int.from_bytes(table[i + 8 : i + 16], "little") for i in range(0, len(table), 16))
    if size > most:
        raise DataError(f"{path}: unpacks to more than its {count:,} Gaussians take")


def _fourdgs(path: Path) -> Teacher:
    """A .4dgs file over its whole time."""
    fourdgs = library("fourdgs", ".4dgs files")
    try:
        scene = fourdgs.read(read_file(path))
    except (fourdgs.FourdgsError, ValueError, MemoryError, OSError) as error:
        raise DataError(f"{path}: fourdgs cannot read it: {one_line(str(error), 160)}") from None
    g, seconds, cutoff = scene.gaussians, float(scene.header.duration_sec), float(scene.header.cutoff)

    def splats(t: float) -> Splats:
        state = g.state_at(min(t, 1 - 1e-6) * seconds, cutoff)  # the end itself is no longer shown
        rows = state["indices"]
        sh = [(g.colors[rows, None, :3] - 0.5) / SH_C0]
        if g.sh is not None and g.sh_degree:
            flat = g.sh[rows].astype(np.float32) * (2 * SH_SPAN / 255) - SH_SPAN
            sh.append(flat.reshape(len(rows), 3, flat.shape[1] // 3).transpose(0, 2, 1))
        return checked(
            f"{path} at {t:g}",
            means=state["centers"],
            quats=g.rotations[rows][:, [3, 0, 1, 2]],
            scales=g.scales[rows],
            opacities=state["opacity"],
            sh=np.concatenate(sh, axis=1),
        )

    return Teacher(splats, None, seconds)


def _gsplat(path: Path) -> Splats:
    """A checkpoint of gsplat's trainers: {"splats": state dict}."""
    content = read_tensors(path)
    state = content.get("splats") if isinstance(content, dict) else None
    wanted = ("means", "quats", "scales", "opacities", "sh0", "shN")
    missing = [name for name in wanted if not isinstance(state, dict) or not isinstance(state.get(name), np.ndarray)]
    if missing or not isinstance(state, dict):
        raise DataError(f"{path}: has no splats.{missing[0]}; expected a checkpoint of gsplat with spherical harmonics")
    parts = {name: state[name].astype(np.float32) for name in wanted}
    with np.errstate(over="ignore"):
        return checked(
            str(path),
            means=parts["means"],
            quats=parts["quats"],
            scales=np.exp(parts["scales"]),
            opacities=1 / (1 + np.exp(-parts["opacities"])),
            sh=np.concatenate([parts["sh0"], parts["shN"]], axis=1) if parts["sh0"].ndim == 3 else parts["sh0"],
        )


def _function(module: str, name: str) -> Callable[[float], Splats]:
    """The caller's own function; its module is looked for in the working folder first."""
    with contextlib.ExitStack() as stack:
        if (here := os.getcwd()) not in sys.path:
            sys.path.insert(0, here)
            stack.callback(sys.path.remove, here)
        try:
            function = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, SyntaxError) as error:
            raise DataError(f"{module}:{name}: cannot be imported: {error}") from None

    def splats(t: float) -> Splats:
        where = f"{module}:{name} at {t:g}"
        try:
            answer = function(t)
        except Exception as error:
            raise DataError(f"{where}: raised {type(error).__name__}: {error}") from error
        found = answer if isinstance(answer, Mapping) else {k: getattr(answer, k, None) for k in (*PARTS, "colors")}

        def part(key: str) -> np.ndarray:
            value = found.get(key)
            if value is not None and hasattr(value, "detach"):
                value = value.detach().cpu().numpy()
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
                raise DataError(f"{where}: {key} is {type(value).__name__}, expected an array of numbers")
            return value.astype(np.float32)

        sh = part("sh") if found.get("sh") is not None else ((part("colors") - 0.5) / SH_C0)[:, None]
        return checked(where, sh=sh, **{key: part(key) for key in PARTS[:4]})

    return splats


def checked(
    where: str, means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
) -> Splats:
    """Splats of these arrays: shapes checked, rotations made unit, and what is not finite or huge left out."""
    n = len(means) if means.ndim else 0
    shapes = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "sh": (n, sh.shape[-2] if sh.ndim == 3 else 1, 3),
    }
    parts = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    for name, array in parts.items():
        if array.shape != shapes[name]:
            raise DataError(f"{where}: {name} has shape {array.shape}, expected {shapes[name]}")
    if sh.shape[1] - 1 not in REST:
        raise DataError(
            f"{where}: {sh.shape[1]} coefficients per colour, expected {', '.join(str(k + 1) for k in REST)}"
        )
    good = np.ones(n, bool)
    for array in parts.values():
        good &= (np.abs(array) <= LARGEST).all(axis=tuple(range(1, array.ndim)))  # also false of NaN
    good &= (np.linalg.norm(quats, axis=1) > 0) & (scales >= 0).all(axis=1) & (opacities >= 0) & (opacities <= 1)
    if not good.any():
        raise DataError(f"{where}: none of {n} Gaussians is finite with a rotation, expected one at least")
    kept = {name: np.ascontiguousarray(array[good], np.float32) for name, array in parts.items()}
    return Splats(**kept | {"quats": unit(kept["quats"])})
