"""Loads the levels of a file for rendering, each decoded from the prefix that a receiver has at that level.

`draw.player` renders a decoded level without torch; the torch model renders a checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from pd4dgs_codec.draw.player import Drawer, drawer
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.container import SIGNATURE
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.io import read_source
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.quality.timeline import Timeline
from pd4dgs_codec.scene import MASK_THRESHOLD, Camera
from pd4dgs_codec.segments import base_beside, is_folder

if TYPE_CHECKING:
    from pd4dgs_codec.model.model import Model


@dataclass(frozen=True)
class Level:
    """One level of a file, rendered by `model`. anchors: number of active anchors. cumulative_bytes: its prefix's size,
    decode_seconds: time to decode it, both None for a checkpoint."""

    level: int
    model: Drawer | Model
    anchors: int
    cumulative_bytes: int | None = None
    decode_seconds: float | None = None

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB in 0..1 behind every Gaussian."""
        return self.model.background if isinstance(self.model, Drawer) else self.model.shown(self.level).background

    @property
    def still(self) -> bool:
        """Whether a decoded level looks alike at all times."""
        return isinstance(self.model, Drawer) and self.model.still

    def picture(self, camera: Camera, time: float) -> np.ndarray:
        """Renders float32 [H, W, 3] in 0..1 at normalised time 0..1."""
        if isinstance(self.model, Drawer):
            return self.model.picture(camera, time)
        from pd4dgs_codec.model.picture import render_image

        return render_image(self.model, self.level, time, camera)

    def timed_picture(self, camera: Camera, time: float) -> tuple[np.ndarray, float]:
        """Returns `picture` and its milliseconds, the networks included."""
        start = perf_counter()
        image = self.picture(camera, time)
        return image, 1e3 * (perf_counter() - start)


def level_of(scene: AnyScene) -> Level:
    """Returns the highest level of a decoded scene."""
    return Level(scene.level, drawer(scene), int((scene.mask[-1] > 0).sum()))


def load_levels(
    file: str | Path | bytes,
    max_layer: int | None = None,
    *,
    max_bytes: int | None = None,
    last_only: bool = False,
    background: tuple[float, float, float] | None = None,
) -> list[Level]:
    """Loads the levels of a `.pd4` file (or its bytes), of a folder of segments or of a checkpoint, ascending, up to
    max_layer.

    max_bytes: decode only the slices of a `.pd4` within this many bytes. last_only: only the last of these levels.
    background: RGB in place of the scene's. Each level of a `.pd4` is decoded from its own prefix, so no data of later
    layers can leak into it. Raises DataError for a file that cannot be read, DecodeError for an invalid `.pd4`.
    """
    whole = isinstance(file, bytes) or not is_folder(file)
    data = file if isinstance(file, bytes) else read_source(file) if whole else b""
    if not whole and max_bytes is None:
        levels = _of_segments(str(file), max_layer)[-1 if last_only else 0 :]
    elif isinstance(file, bytes) or data.startswith(SIGNATURE[:4]):
        base = None if isinstance(file, bytes) else base_beside(file)
        levels = _of_bytes(data, max_layer, max_bytes, last_only, base)
    elif max_bytes is None:
        levels = _of_checkpoint(data, str(file), max_layer)[-1 if last_only else 0 :]
    else:
        what = "a checkpoint has no slices" if whole else "segments have slices of their own"
        raise DataError(f"{file}: {what}; expected a .pd4 file")
    if background is not None:
        for level in levels:
            level.model.info = replace(level.model.info, background=background)
            if isinstance(level.model, Drawer):
                level.model.background = background
    return levels


def _of_segments(path: str, max_layer: int | None) -> list[Level]:
    found = [Timeline(path, max_layer)]
    while found[0].level:
        found.insert(0, Timeline(path, found[0].level - 1))
    return [Level(each.level, each, len(each.active), each.bytes) for each in found]


def _of_bytes(
    data: bytes, max_layer: int | None, max_bytes: int | None, last_only: bool, base: bytes | None
) -> list[Level]:
    levels, ends = [], dict[int, int]()
    for row in info(data)["layers"]:
        within = [part["end"] for part in row["slices"] if max_bytes is None or part["end"] <= max_bytes]
        if within and (max_layer is None or row["layer"] <= max_layer):
            ends[row["layer"]] = within[-1]
    if not ends and max_bytes is not None:
        decode(data, max_bytes=max_bytes, base=base)  # raises the reason
    for layer in list(ends)[-1:] if last_only else ends:
        start = perf_counter()
        scene = decode(data[: ends[layer]], max_layer=layer, max_bytes=ends[layer], base=base)
        seconds = perf_counter() - start
        levels.append(replace(level_of(scene), cumulative_bytes=ends[layer], decode_seconds=seconds))
    return levels


def _of_checkpoint(data: bytes, name: str, max_layer: int | None) -> list[Level]:
    import torch

    from pd4dgs_codec.model import checkpoint

    model, _ = checkpoint.loads(data, name)
    with torch.no_grad():
        return [
            Level(level, model, int((model.masks(level) > MASK_THRESHOLD).sum()))
            for level in (0, *model.deformations)
            if max_layer is None or level <= max_layer
        ]
