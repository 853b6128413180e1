"""Folders with a model of COLMAP, binary or text: `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself.

Poses are world to camera with OpenCV axes, pixel centres at +0.5, as ours. The pictures are in `images/`, else beside
the model. `times.txt`, a line `NAME SECONDS` per picture, says when each was taken; without it the last number in a
name does, and where none has one, their order.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.cameras import LARGEST_TIME, Lens, UnreadView, checked_rotation, world_to_camera
from pd4dgs_codec.data.files import LARGEST, number, read_file
from pd4dgs_codec.data.posed import held_out, posed_dataset
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
#: Number in binary files -> name, and the names of the parameters.
MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    5: ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
}
PARAMETERS = dict(MODELS.values())
MAX_SIDE = 65535


@dataclass(frozen=True)
class Image:
    """A posed picture: quaternion wxyz and translation of world to camera."""

    name: str
    camera: int
    pose: tuple[float, ...]


def find_model(folder: Path) -> tuple[Path, str] | None:
    """(the model's folder, ".bin" or ".txt") of a folder that has one."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return folder / place, suffix
    return None


def read_colmap(folder: Path, model: Path, suffix: str, downscale: int, holdout: int) -> Dataset:
    """Read a folder with a model of COLMAP, see `find_model` and `dataset.load`."""
    listed, points, colors = registered(model, suffix)
    pictures = folder / "images" if (folder / "images").is_dir() else folder
    times = _times(folder, [image.name for image, _, _ in listed])
    frames = []
    for (image, viewmat, lens), time in zip(listed, times, strict=True):
        path = pictures / image.name
        if pictures.resolve() not in path.resolve().parents or not path.is_file():
            raise DataError(f"{model / f'images{suffix}'}: {image.name}: there is no such picture in {pictures}")
        frames.append(UnreadView(Path(image.name).stem, image.camera, time, viewmat, lens, path))
    return posed_dataset(folder, *held_out(frames, holdout), points, colors, downscale)


def registered(
    model: Path, suffix: str
) -> tuple[list[tuple[Image, np.ndarray, Lens]], np.ndarray | None, np.ndarray | None]:
    """The pictures of a model by name, each with its pose (float64 [4, 4] world to camera) and lens; points float32
    [M, 3] and colours uint8 [M, 3], or None."""
    read = _Binary if suffix == ".bin" else _Text
    lenses = read(model / f"cameras{suffix}").cameras()
    images = sorted(read(model / f"images{suffix}").images(), key=lambda image: image.name)
    if not images:
        raise DataError(f"{model}: no picture is registered, expected one at least")
    listed = []
    for image in images:
        where = f"{model / f'images{suffix}'}: {image.name}"
        if image.camera not in lenses:
            raise DataError(f"{where}: taken by camera {image.camera}, which cameras{suffix} does not have")
        listed.append((image, _viewmat(image, where), lenses[image.camera]))
    if not (model / f"points3D{suffix}").is_file():
        return listed, None, None
    points, colors = read(model / f"points3D{suffix}").points()
    keep = (np.abs(points) <= LARGEST).all(axis=1)  # also false of NaN
    return listed, points[keep].astype(np.float32), colors[keep]


def _viewmat(image: Image, where: str) -> np.ndarray:
    """float64 [4, 4] world to camera."""
    pose = np.array([number(value, f"{where}: pose") for value in image.pose])
    rotation = checked_rotation(pose[:4], where)
    return world_to_camera(rotation, -rotation.T @ pose[4:])


def _times(folder: Path, names: list[str]) -> list[float]:
    """When each picture was taken: by times.txt, by the last number in its name, by its place."""
    path = folder / "times.txt"
    if path.is_file():
        told: dict[str, float] = {}
        for i, line in enumerate(read_file(path).decode("utf-8", "replace").splitlines(), 1):
            if not line.strip():
                continue
            name, _, text = line.strip().rpartition(" ")
            try:
                told[name.strip()] = number(float(text), f"{path}: line {i}", largest=LARGEST_TIME)
            except ValueError:
                raise DataError(f"{path}: line {i} is {line.strip()[:60]!r}, expected NAME SECONDS") from None
        missing = next((name for name in names if name not in told), None)
        if missing is not None:
            raise DataError(f"{path}: has no line for {missing}, expected one for each picture of the model")
        return [told[name] for name in names]
    numbers = [re.findall(r"\d{1,15}", Path(name).stem) for name in names]
    if all(numbers):
        return [float(found[-1]) for found in numbers]
    return [float(i) for i in range(len(names))]


def _lens(model: str, width: int, height: int, values: list[float], where: str) -> Lens:
    if model not in PARAMETERS:
        raise DataError(f"{where}: camera model {model}, expected one of {', '.join(PARAMETERS)}")
    keys = PARAMETERS[model]
    if len(values) != len(keys) or not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        found = f"{width}x{height} pixels and {len(values)} parameters"
        raise DataError(f"{where}: {model} with {found}, expected 1..{MAX_SIDE} a side and {len(keys)} parameters")
    p = {
        key: number(value, f"{where}: {key}", positive=key.startswith("f"))
        for key, value in zip(keys, values, strict=True)
    }
    fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
    if model == "OPENCV_FISHEYE":
        return Lens(width, height, fx, fy, p["cx"], p["cy"], fisheye=(p["k1"], p["k2"], p["k3"], p["k4"]))
    radial, tangential = (p.get("k1", 0.0), p.get("k2", 0.0), 0.0), (p.get("p1", 0.0), p.get("p2", 0.0))
    return Lens(width, height, fx, fy, p["cx"], p["cy"], 0.0, radial, tangential)


class _Binary:
    """One of the binary files."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, read_file(path), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values of a little-endian layout."""
        layout = f"<{layout}"
        try:
            values = struct.unpack_from(layout, self.data, self.at)
        except struct.error:
            raise DataError(f"{self.path}: ends at byte {len(self.data)}, in the middle of an entry") from None
        self.at += struct.calcsize(layout)
        return values

    def skip(self, size: int) -> None:
        """Passes over `size` bytes."""
        if size > len(self.data) - self.at:
            raise DataError(f"{self.path}: ends at byte {len(self.data)}, in the middle of an entry")
        self.at += size

    def cameras(self) -> dict[int, Lens]:
        """Lenses by number."""
        lenses = {}
        for _ in range(self.take("Q")[0]):
            key, model, width, height = self.take("iiQQ")
            where = f"{self.path}: camera {key}"
            if model not in MODELS:
                names = ", ".join(name for name, _ in MODELS.values())
                raise DataError(f"{where}: camera model number {model}, expected one of {names}")
            name, keys = MODELS[model]
            lenses[key] = _lens(name, width, height, list(self.take(f"{len(keys)}d")), where)
        return lenses

    def images(self) -> list[Image]:
        """The registered pictures."""
        images = []
        for _ in range(self.take("Q")[0]):
            _, *pose, camera = self.take("i7di")
            end = self.data.find(b"\0", self.at)
            if end < 0:
                raise DataError(f"{self.path}: ends at byte {len(self.data)}, in the middle of a name")
            name = self.data[self.at : end].decode("utf-8", "replace")
            self.at = end + 1
            self.skip(24 * self.take("Q")[0])
            images.append(Image(name, camera, tuple(pose)))
        return images

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions float64 [M, 3] and colours uint8 [M, 3]."""
        places, colors = [], []
        for _ in range(self.take("Q")[0]):
            _, x, y, z, r, g, b, _, track = self.take("Q3d3BdQ")
            self.skip(8 * track)
            places.append((x, y, z))
            colors.append((r, g, b))
        return np.array(places, np.float64).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3)


class _Text:
    """One of the text files."""

    def __init__(self, path: Path):
        self.path = path
        lines = read_file(path).decode("utf-8", "replace").splitlines()
        self.lines = [(i, line.strip()) for i, line in enumerate(lines, 1) if not line.startswith("#")]

    def _values(self, i: int, words: list[str], count: int) -> list[float]:
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) < count:
            raise DataError(f"{self.path}: line {i} is not what COLMAP writes, expected {count} numbers or more")
        return values

    def cameras(self) -> dict[int, Lens]:
        """Lenses by number."""
        lenses = {}
        for i, line in self.lines:
            if line:
                key, model, *words = [*line.split(), "", ""][: max(2, len(line.split()))]
                width, height, *values = self._values(i, words, 2)
                number_, *_ = self._values(i, [key], 1)
                lenses[int(number_)] = _lens(model, int(width), int(height), values, f"{self.path}: camera {key}")
        return lenses

    def images(self) -> list[Image]:
        """The registered pictures: two lines each, the second of what was matched."""
        images = []
        lines = self.lines
        while lines and not lines[0][1]:
            lines = lines[1:]
        for i, line in lines[::2]:
            words = line.split(maxsplit=9)
            if not words:
                continue
            values = self._values(i, words[:9], 9)
            if len(words) < 10:
                raise DataError(f"{self.path}: line {i} names no picture")
            images.append(Image(words[9], int(values[8]), tuple(values[1:8])))
        return images

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions float64 [M, 3] and colours uint8 [M, 3]."""
        rows = [self._values(i, line.split()[1:7], 6) for i, line in self.lines if line]
        table = np.array(rows, np.float64).reshape(-1, 6)
        return table[:, :3], np.clip(np.nan_to_num(table[:, 3:]), 0, 255).astype(np.uint8)
