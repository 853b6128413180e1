"""Draws a folder of segments as one scene over all of its time, blended where two segments overlap."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from pd4dgs_codec.draw.player import Drawer, drawer
from pd4dgs_codec.errors import DataError, DecodeError
from pd4dgs_codec.format.container import PREAMBLE_SIZE
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.reader import Base, read_base
from pd4dgs_codec.format.registry import MAX_HEADER
from pd4dgs_codec.scene import Camera, Gaussians
from pd4dgs_codec.segments import File, read_file, read_index

KEPT = 2  #: decoded segments


class Timeline(Drawer):
    """Draws a folder of segments up to a level. A segment is decoded when its time comes, and few are kept. Raises
    DataError that names a file that is missing or damaged, here or later."""

    def __init__(self, path: str | Path, max_layer: int | None = None):
        self.folder, self.index = read_index(path)
        self._base, self._part = lru_cache(1)(self._read_base), lru_cache(KEPT)(self._read_part)
        layers = {layer for layer in self._layers() if max_layer is None or layer <= max_layer}
        self.level = max(layers, default=0)
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
        ends = [
            max(end for layer, end in self._ends(file).items() if layer <= self.level) for file in self.index.segments
        ]
        return sum(base.bytes for base in self.index.bases) + sum(ends)

    def _layers(self) -> set[int]:
        return {layer for file in self.index.segments for layer in self._ends(file)}

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

    def _read_base(self, number: int) -> Base:
        return read_base(read_file(self.folder, self.index.bases[number]))

    def _read_part(self, k: int) -> Drawer:
        file = self.index.segments[k]
        data = read_file(self.folder, file)
        try:
            base = None if file.base is None else self._base(file.base)
            return drawer(decode(data, max_layer=self.level, base=base))
        except DecodeError as error:
            raise DataError(f"{self.folder / file.file}: {error}") from None
