"""Folders with a COLMAP model, binary or text, and pictures or one synchronised video per picture.

Poses are world to camera with OpenCV axes, pixel centres at +0.5. Pictures are in `images/`, else in the folder itself;
videos, named as the pictures of the model (`cam00.png` and `cam00.mp4`), in `videos/`, else in the folder itself.
Times come from `times.txt`, with a line `NAME SECONDS` per picture, else from the names. `masks/` may hold a mask per
picture, black where pixels are not valid: `NAME.png` for the picture NAME, as COLMAP has it, or the same name.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from itertools import dropwhile, islice
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.dataset import COLMAP
from pd4dgs_codec.data.files import (
    LARGEST,
    PICTURES,
    Color,
    files_of,
    find_image,
    inside,
    is_there,
    note,
    number,
    read_file,
    similar,
    whole_number,
)
from pd4dgs_codec.data.videos import open_video, synchronised_dataset
from pd4dgs_codec.data.view import (
    LARGEST_TIME,
    Dataset,
    Lens,
    Origin,
    UnreadView,
    checked_rotation,
    held_out,
    posed_dataset,
    present,
    world_to_camera,
)
from pd4dgs_codec.errors import DataError

#: Camera models in the order of their numbers in binary files, with the names of their parameters.
MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
MAX_SIDE, MAX_NUMBER = 65535, 1 << 32
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")


#: A registered picture: its name, the number of its camera, and quaternion wxyz and translation of world to camera.
Image = tuple[str, int, list[float]]


def read_colmap(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads a folder with a COLMAP model (see `dataset.load`). With videos, the first camera is held out."""
    model, kind = _largest(folder)
    cameras, points = _registered(model, kind)
    source = str((model / f"points3D{kind}").relative_to(folder))
    if videos := _videos(folder):
        return synchronised_dataset(folder, _rig(model, cameras, videos), points, source, downscale, holdout)
    pictures = folder / "images" if (folder / "images").is_dir() else folder
    times = _times(folder, [camera.name for camera in cameras])
    frames = []
    for camera, time in zip(cameras, times, strict=True):
        image = find_image(pictures, camera.name)
        mask = _mask(folder / "masks", camera.name)
        frames.append(replace(camera, name=camera.image.stem, time=time, image=image, mask=mask))
    posed = {frame.image for frame in frames if is_there(frame.image)}
    places = pictures.rglob("*") if pictures != folder else (p for f in {i.parent for i in posed} for p in f.iterdir())
    found = sum(1 for path in places if path.suffix.lower() in PICTURES and not path.name.startswith("."))
    origin = Origin(
        "times.txt", None, source, f"{len(posed)} of {found} pictures have a pose in {model.relative_to(folder)}"
    )
    return posed_dataset(
        folder, *held_out(present(folder, frames), holdout), points, downscale, background=background, origin=origin
    )


def _largest(folder: Path) -> tuple[Path, str]:
    """The model with the most registered pictures, and the suffix of its files. COLMAP numbers models in the order in
    which it made them, and the first may hold three pictures."""
    models = {}
    for pattern in COLMAP:
        for kind in (".txt", ".bin"):  # the binary one if both are there
            for cameras in sorted(folder.glob(f"{pattern}/cameras{kind}")):
                if cameras.with_name(f"images{kind}").exists():
                    models[cameras.parent] = kind
    if len(models) == 1:
        return next(iter(models.items()))
    counts = {place: sum(1 for _ in _reader(kind)(place / f"images{kind}").images()) for place, kind in models.items()}
    model = max(counts, key=lambda place: counts[place])
    others = [f"{place.relative_to(folder)} with {count} pictures" for place, count in counts.items() if place != model]
    note(f"models besides {model.relative_to(folder)}, which has the most pictures", ", ".join(others))
    return model, models[model]


def _mask(folder: Path, name: str) -> Path | None:
    """The mask of a picture: NAME.png as COLMAP has it, else a picture of the same name."""
    if not folder.is_dir():
        return None
    inside(folder, name)
    found = similar(folder, f"{name}.png") or similar(folder, name)
    if found is None:
        note("pictures without a mask in masks/", name)
    return found


def _videos(folder: Path) -> dict[str, Path]:
    """Videos by name without suffix, in videos/ or in the folder itself; none if it has images/ instead."""
    place = folder / "videos"
    if not place.is_dir():
        if (folder / "images").is_dir():
            return {}
        place = folder
    return {file.stem: file for file in files_of(place, VIDEOS)}


def _rig(model: Path, cameras: list[UnreadView], videos: dict[str, Path]) -> list[UnreadView]:
    """The cameras with their videos instead of pictures. Raises DataError unless each has its own, of its size."""
    rig: dict[Path, UnreadView] = {}
    for camera in cameras:
        video = videos.get(camera.image.stem) or videos.get(camera.image.parts[0])
        if video is None:
            where = f"{model}: {camera.name}"
            raise DataError(f"{where}: there is no video of this name among {len(videos)}, expected one per picture")
        if video in rig:
            raise DataError(f"{model}: two pictures are of the video {video.stem}, expected one per camera")
        size, lens = open_video(video).size, camera.lens
        if size != (lens.width, lens.height):
            found = f"is {size[0]}x{size[1]}, and its camera in {model} {lens.width}x{lens.height}"
            raise DataError(f"{video}: {found}, expected the same size")
        rig[video] = replace(camera, name=video.stem, camera_id=len(rig), image=video)
    return list(rig.values())


def _registered(model: Path, kind: str) -> tuple[list[UnreadView], np.ndarray | None]:
    """(the pictures of a model, sorted by name, with that name as `image` and time 0; points float64 [M, 3], or
    None)."""
    read = _reader(kind)
    lenses = dict(read(model / f"cameras{kind}").cameras())
    images = sorted(read(model / f"images{kind}").images())
    if not images:
        raise DataError(f"{model}: no picture is registered, expected one at least")
    frames = []
    for name, camera, values in images:
        where = f"{model / f'images{kind}'}: {name}"
        if camera not in lenses:
            raise DataError(f"{where}: camera {camera} is not in cameras{kind}")
        pose = np.array([number(value, f"{where}: pose") for value in values])
        rotation = checked_rotation(pose[:4], where)
        viewmat = world_to_camera(rotation, -rotation.T @ pose[4:])
        frames.append(UnreadView(name, camera, 0.0, viewmat, lenses[camera], Path(name)))
    if not (model / f"points3D{kind}").is_file():
        return frames, None
    points = np.array(list(read(model / f"points3D{kind}").points()), np.float64).reshape(-1, 3)
    return frames, points[(np.abs(points) <= LARGEST).all(axis=1)]  # also false of NaN


def _reader(kind: str) -> type[_Binary] | type[_Text]:
    return _Binary if kind == ".bin" else _Text


def _times(folder: Path, names: list[str]) -> list[float] | list[None]:
    """The time of each picture from times.txt; None without this file."""
    path = folder / "times.txt"
    if not path.is_file():
        return [None] * len(names)
    known: dict[str, float] = {}
    for i, line in enumerate(map(str.strip, os.fsdecode(read_file(path)).splitlines()), 1):
        name, _, text = line.rpartition(" ")
        try:
            if line:
                known[name.strip()] = number(float(text), f"{path}: line {i}", largest=LARGEST_TIME)
        except ValueError:
            raise DataError(f"{path}: line {i} is {line[:60]!r}, expected NAME SECONDS") from None
    if missing := [name for name in names if name not in known]:
        raise DataError(f"{path}: has no line for {missing[0]}, expected one for each picture of the model")
    return [known[name] for name in names]


def _lens(model: str, width: int, height: int, values: list[float], where: str) -> Lens:
    keys = MODELS[model]
    if len(values) != len(keys) or not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        found = f"{width}x{height} pixels and {len(values)} parameters"
        raise DataError(f"{where}: {model} with {found}, expected 1..{MAX_SIDE} a side and {len(keys)} parameters")
    pairs = zip(keys, values, strict=True)
    p = {key: number(value, f"{where}: {key}", positive=key.startswith("f")) for key, value in pairs}
    fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
    if model == "OPENCV_FISHEYE":
        return Lens(width, height, fx, fy, p["cx"], p["cy"], fisheye=(p["k1"], p["k2"], p["k3"], p["k4"]))
    radial, tangential = (p.get("k1", 0.0), p.get("k2", 0.0), 0.0), (p.get("p1", 0.0), p.get("p2", 0.0))
    return Lens(width, height, fx, fy, p["cx"], p["cy"], 0.0, radial, tangential)


class _Binary:
    """A binary file of a model."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, read_file(path), 0

    def cameras(self) -> Iterator[tuple[int, Lens]]:
        for _ in range(self._take("Q")[0]):
            key, model, width, height = self._take("iiQQ")
            where = f"{self.path}: camera {key}"
            if not 0 <= model < len(MODELS):
                raise DataError(f"{where}: camera model number {model}, expected one of {', '.join(MODELS)}")
            name, keys = list(MODELS.items())[model]
            yield key, _lens(name, width, height, list(self._take(f"{len(keys)}d")), where)

    def images(self) -> Iterator[Image]:
        for _ in range(self._take("Q")[0]):
            _, *pose, camera = self._take("i7di")
            end = self.data.find(b"\0", self.at)
            if end < 0:
                raise DataError(f"{self.path}: ends at byte {len(self.data)}, in the middle of a name")
            name = os.fsdecode(self.data[self.at : end])  # as the file system has it
            self.at = end + 1
            self._skip(24 * self._take("Q")[0])
            yield name, camera, pose

    def points(self) -> Iterator[tuple[float, ...]]:
        for _ in range(self._take("Q")[0]):
            _, x, y, z, *_, track = self._take("Q3d3BdQ")
            self._skip(8 * track)
            yield x, y, z

    def _take(self, layout: str) -> tuple[Any, ...]:
        """Reads the next values of a little-endian `struct` layout."""
        start = self.at
        self._skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self.data, start)

    def _skip(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise DataError(f"{self.path}: ends at byte {len(self.data)}, in the middle of an entry")
        self.at += size


class _Text:
    """A text file of a model."""

    def __init__(self, path: Path):
        self.path = path
        self.raw = os.fsdecode(read_file(path)).splitlines()

    @property
    def lines(self) -> Iterator[tuple[int, str]]:
        """(number, text) of each line, without comments."""
        return ((i, line.strip()) for i, line in enumerate(self.raw, 1) if not line.startswith("#"))

    def cameras(self) -> Iterator[tuple[int, Lens]]:
        for i, line in self.lines:
            if line:
                key, model, *words = [*line.split(), "", ""][: max(2, len(line.split()))]
                where = f"{self.path}: camera {key}"
                if model not in MODELS:
                    raise DataError(f"{where}: camera model {model}, expected one of {', '.join(MODELS)}")
                width, height, *values = self._values(i, words, 2)
                number, width, height = (self._whole(i, v) for v in (*self._values(i, [key], 1), width, height))
                yield number, _lens(model, width, height, values, where)

    def images(self) -> Iterator[Image]:
        """Yields the registered pictures, which have two lines each, the second with the features."""
        for i, line in islice(dropwhile(lambda line: not line[1], self.lines), 0, None, 2):
            words = line.split(maxsplit=9)
            if not words:
                continue
            values = self._values(i, words[:9], 9)
            if len(words) < 10:
                raise DataError(f"{self.path}: line {i} names no picture")
            yield words[9], self._whole(i, values[8]), values[1:8]

    def points(self) -> Iterator[tuple[float, ...]]:
        return (tuple(self._values(i, line.split()[1:7], 6)[:3]) for i, line in self.lines if line)

    def _whole(self, i: int, value: float) -> int:
        return whole_number(value, f"{self.path}: line {i}", low=-MAX_NUMBER, largest=MAX_NUMBER)

    def _values(self, i: int, words: list[str], count: int) -> list[float]:
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) < count:
            raise DataError(f"{self.path}: line {i} is not what COLMAP writes, expected {count} numbers or more")
        return values
