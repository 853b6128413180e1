"""Folders that trainers of Gaussians leave behind: iterations, options, cameras, and tensors of networks, read as data.

A run holds `point_cloud/iteration_N` with a PLY file and perhaps networks, `cfg_args` with the options as Python wrote
them, and `cameras.json`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.archives import read_tensors
from pd4dgs_codec.data.cameras import ROTATION_TOLERANCE, world_to_camera
from pd4dgs_codec.data.files import LARGEST, WHITE, Color, read_file
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.scene import Camera

PLY = "point_cloud.ply"
#: The most inputs and outputs of a layer: with these, a Gaussian takes a bounded time and memory.
MAX_WIDTH = 1024
Layer = tuple[np.ndarray, np.ndarray]  #: weight float32 [outputs, inputs], bias float32 [outputs]


def iteration(folder: Path, number: int | None = None) -> Path | None:
    """The folder with point_cloud.ply: `folder` itself, or an iteration below it, the last if `number` is None."""
    if (folder / PLY).is_file():
        return folder
    base = folder / "point_cloud" if (folder / "point_cloud").is_dir() else folder
    found = {
        int(match[1]): path
        for path in base.glob("iteration_*")
        if (match := re.fullmatch(r"iteration_(\d{1,9})", path.name)) and (path / PLY).is_file()
    }
    return found.get(max(found, default=0) if number is None else number)


def run_of(place: Path) -> Path:
    """The folder of the run that an iteration belongs to."""
    return place.parent.parent if place.parent.name == "point_cloud" else place


def network_of(place: Path) -> Path | None:
    """The file of the network that moves the Gaussians of an iteration: that of 4DGaussians beside them, or that of
    Deformable-3DGS in a folder of its own. None if they stay; the file need not be there."""
    if any(place.glob("deformation*.pth")):
        return place / "deformation.pth"
    deform = run_of(place) / "deform"
    return deform / place.name / "deform.pth" if deform.is_dir() else None


@dataclass(frozen=True)
class Config:
    """The options of a run: the text `Namespace(name=value, ...)`, never evaluated. Empty if there is no file."""

    path: Path
    text: str

    @classmethod
    def of(cls, run: Path) -> Config:
        """The `cfg_args` of a run."""
        path = run / "cfg_args"
        return cls(path, read_file(path).decode("utf-8", "replace") if path.is_file() else "")

    def get(self, name: str) -> str | None:
        """The text of a number, a truth value or a name; None if there is none."""
        found = re.search(rf"\b{name}=([-+.\w]{{1,40}})\s*[,)]", self.text)
        return found and found[1]

    def flag(self, name: str, usual: str | None) -> bool:
        """A truth value. usual: the text that stands for one that is not there, None to refuse."""
        found = self.get(name) or usual
        if found not in ("True", "False"):
            raise DataError(f"{self.path}: {name} is {found or 'missing'}, expected True or False")
        return found == "True"

    @property
    def background(self) -> Color:
        """White or black."""
        return WHITE if self.get("white_background") == "True" else (0.0, 0.0, 0.0)


def read_torch(path: Path) -> Any:
    """The content of a file of torch."""
    return read_tensors(read_file(path), str(path))


@dataclass(frozen=True)
class State:
    """The tensors of networks by name, checked when they are taken."""

    path: Path
    tensors: Mapping[Any, Any]

    @classmethod
    def read(cls, path: Path) -> State:
        """A state dict."""
        content = read_torch(path)
        if not isinstance(content, dict):
            raise DataError(f"{path}: holds a {type(content).__name__}, expected a dict of tensors")
        return cls(path, content)

    def take(self, name: str, *shape: int | None) -> np.ndarray:
        """A tensor, float32, of this shape, where None stands for any length but 0."""
        found = self.tensors.get(name)
        if not isinstance(found, np.ndarray):
            raise DataError(f"{self.path}: has no tensor {name}")
        if len(found.shape) != len(shape) or any(
            n != (m or max(n, 1)) for n, m in zip(found.shape, shape, strict=True)
        ):
            expected = ", ".join(str(n or "any") for n in shape)
            raise DataError(f"{self.path}: {name} has shape {found.shape}, expected ({expected})")
        if not (np.abs(found) <= LARGEST).all():  # also true of NaN
            raise DataError(f"{self.path}: {name} holds a NaN or a number over {LARGEST:g}")
        return found.astype(np.float32)

    def linear(self, name: str, inputs: int | None = None, outputs: int | None = None) -> Layer:
        """A linear layer."""
        weight = self.take(f"{name}.weight", outputs, inputs)
        if max(weight.shape) > MAX_WIDTH:
            raise DataError(f"{self.path}: {name}.weight has shape {weight.shape}, expected {MAX_WIDTH} at most")
        return weight, self.take(f"{name}.bias", len(weight))

    def chain(self, name: str, places: Iterable[int], inputs: int, outputs: int | None = None) -> list[Layer]:
        """The linear layers `name.place`, each with as many inputs as the one before has outputs."""
        layers: list[Layer] = []
        *_, last = places = list(places)
        for place in places:
            layers.append(self.linear(f"{name}.{place}", inputs, outputs if place == last else None))
            inputs = len(layers[-1][1])
        return layers


def read_cameras(path: Path) -> tuple[list[Camera], tuple[float, float, float]]:
    """(the cameras, their mean direction up) of a cameras.json as 3D Gaussian splatting writes it."""
    try:
        rows = json.loads(read_file(path))
        turns = np.array([row["rotation"] for row in rows], np.float64)
        places = np.array([row["position"] for row in rows], np.float64)
        lenses = np.array([[row[key] for key in ("fx", "fy", "width", "height")] for row in rows], np.float64)
        good = turns.shape == (len(rows), 3, 3) and places.shape == (len(rows), 3) and lenses.shape == (len(rows), 4)
        good = good and bool((np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)) <= ROTATION_TOLERANCE).all())
        good = good and bool((np.abs(places) <= LARGEST).all() and (lenses > 0).all() and (lenses <= LARGEST).all())
        good = good and bool((lenses[:, 2:] == np.round(lenses[:, 2:])).all() and lenses[:, 2:].max() <= 65535)
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError):
        good = False
    if not good:
        raise DataError(f"{path}: expected a list of cameras with position, rotation, fx, fy, width and height")
    cameras = []
    for turn, place, (fx, fy, width, height) in zip(turns, places, lenses, strict=True):
        K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]], np.float32)
        cameras.append(Camera(world_to_camera(turn.T, place).astype(np.float32), K, int(width), int(height)))
    up = -turns[:, :, 1].mean(axis=0)
    x, y, z = (float(np.float32(v)) for v in up / max(float(np.linalg.norm(up)), 1e-12))
    return cameras, (x, y, z)
