"""Loads the levels of a file for rendering, each decoded from the prefix that a receiver has at that level.

`draw.player` renders a decoded level without torch, `Timeline` a level of a folder of segments, and the torch model a
checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from pd4dgs_codec.draw.player import Drawer, drawer
from pd4dgs_codec.errors import DataError, DecodeError
from pd4dgs_codec.format.container import PREAMBLE_SIZE, SIGNATURE
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.reader import read_base
from pd4dgs_codec.format.registry import MAX_HEADER
from pd4dgs_codec.io import read_source
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.scene import MASK_THRESHOLD, Camera, Gaussians
from pd4dgs_codec.segments import File, base_beside, is_folder, read_file, read_index

if TYPE_CHECKING:
    from pd4dgs_codec.model.model import Model


KEPT = 2  #: decoded segments


class Timeline(Drawer):
    """Draws a folder of segments up to a level. A segment is decoded when its time comes, and few are kept. Raises
    DataError that names a file that is missing or damaged, here or later."""

    def __init__(self, path: str | Path, max_layer: int | None = None):
        self.folder, self.index = read_index(path)
        self._base = lru_cache(1)(lambda number: read_base(read_file(self.folder, self.index.bases[number])))
        self._part = lru_cache(KEPT)(self._read_part)
        layers = {layer for file in self.index.segments for layer in self._ends(file)}
        self.level = max((layer for layer in layers if max_layer is None or layer <= max_layer), default=0)
        first = self._part(0)
        self.info = replace(first.info, time_range=self.index.time_range)
        self.active, self.background, self.still = first.active, first.background, False
        self._own = self.background

    def at(self, t: float) -> tuple[Drawer, float]:
        """Returns (what draws the segment that shows time t, the time there), both normalised; of two segments that
        show it, the one of larger weight."""
        seconds = self._seconds(t)
        return self._segment(self.index.at(seconds), seconds)

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        part, own = self.at(t)
        return part.gaussians(camera, own)

    def drawn(self, camera: Camera, t: float) -> tuple[np.ndarray, np.ndarray]:
        seconds = self._seconds(t)
        if len(shown := self.index.shown(seconds)) == 1:
            part, own = self.at(t)
            return part.drawn(camera, own)
        pictures = []
        for number, weight in shown:  # of clipped pictures, as displays show them
            part, own = self._segment(number, seconds)
            image, alpha = part.drawn(camera, own)
            pictures.append((np.float32(weight) * np.clip(image, 0, 1), np.float32(weight) * alpha))
        image, alpha = (sum(parts) for parts in zip(*pictures, strict=True))
        return image, alpha

    def _seconds(self, t: float) -> float:
        low, high = self.index.time_range
        return low + t * (high - low)

    def _segment(self, number: int, seconds: float) -> tuple[Drawer, float]:
        """Returns (what draws a segment, its normalised time at these seconds)."""
        start, end = self.index.segments[number].time_range
        part = self._part(number)
        if self.background != self._own:  # another one was asked for
            part.background = self.background
        return part, min(max((seconds - start) / (end - start), 0.0), 1.0)

    @property
    def bytes(self) -> int:
        """What a receiver of all segments up to this level has."""
        ends = map(self._ends, self.index.segments)
        own = sum(max(end for layer, end in each.items() if layer <= self.level) for each in ends)
        return own + sum(base.bytes for base in self.index.bases)

    def _ends(self, file: File) -> dict[int, int]:
        """The end of each layer, by the header."""
        path = self.folder / file.file
        try:
            with path.open("rb") as stream:
                found = info(stream.read(PREAMBLE_SIZE + MAX_HEADER))
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from None
        except DecodeError as error:
            raise DataError(f"{path}: {error}") from None
        return {row["layer"]: row["end"] for row in found["layers"]}

    def _read_part(self, k: int) -> Drawer:
        file = self.index.segments[k]
        data = read_file(self.folder, file)
        try:
            base = None if file.base is None else self._base(file.base)
            return drawer(decode(data, max_layer=self.level, base=base))
        except DecodeError as error:
            raise DataError(f"{self.folder / file.file}: {error}") from None


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
