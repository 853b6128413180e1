"""A file's levels as models ready to render: each one from the bytes that a receiver would hold at that level."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from pd4dgs_codec.bitstream.container import SIGNATURE
from pd4dgs_codec.codec.decoder import decode
from pd4dgs_codec.codec.info import info
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.scene import MASK_THRESHOLD, Camera, Scene


@dataclass(frozen=True)
class Level:
    """One level of a file, drawn by `model`. anchors: active at it. cumulative_bytes: of its prefix, and decode_seconds
    of decoding that; both None for a checkpoint."""

    level: int
    model: Model
    anchors: int
    cumulative_bytes: int | None = None
    decode_seconds: float | None = None

    def picture(self, camera: Camera, time: float) -> np.ndarray:
        """float32 [H, W, 3] in 0..1 at normalised time 0..1."""
        return render_image(self.model, self.level, time, camera)

    def timed_picture(self, camera: Camera, time: float) -> tuple[np.ndarray, float]:
        """`picture`, and the milliseconds that it took, the networks included."""
        start = perf_counter()
        image = self.picture(camera, time)
        return image, 1e3 * (perf_counter() - start)


def level_of(scene: Scene, device: str = "cpu") -> Level:
    """The highest level of a decoded scene."""
    return Level(scene.level, from_scene(scene).to(device), int((scene.mask[-1] > 0).sum()))


def load_levels(file: str | Path | bytes, max_layer: int | None = None, device: str = "cpu") -> list[Level]:
    """The levels of a `.pd4` file (or its bytes) or of a checkpoint, ascending, up to max_layer.

    Each level of a `.pd4` is decoded from its own prefix, so nothing of a later layer can leak into it.
    """
    if isinstance(file, bytes):
        return _of_bytes(file, max_layer, device)
    try:
        data = Path(file).read_bytes()
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from None
    return (
        _of_bytes(data, max_layer, device)
        if data.startswith(SIGNATURE[:4])
        else _of_checkpoint(file, max_layer, device)
    )


def _of_bytes(data: bytes, max_layer: int | None, device: str) -> list[Level]:
    levels = []
    for row in info(data)["layers"]:
        if max_layer is not None and row["layer"] > max_layer:
            continue
        start = perf_counter()
        scene = decode(data[: row["end"]], max_layer=row["layer"])
        seconds = perf_counter() - start
        levels.append(replace(level_of(scene, device), cumulative_bytes=row["end"], decode_seconds=seconds))
    return levels


def _of_checkpoint(path: str | Path, max_layer: int | None, device: str) -> list[Level]:
    model, _ = checkpoint.load(path)
    present = [0]
    present += [1] if model.global_deformation is not None else []
    present += [2] if model.local_deformation is not None else []
    model = model.to(device)
    with torch.no_grad():
        return [
            Level(level, model, int((model.masks(level) > MASK_THRESHOLD).sum()))
            for level in present
            if max_layer is None or level <= max_layer
        ]
