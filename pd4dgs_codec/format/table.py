"""The attributes of anchors <-> symbols, channel-major: one channel per scalar, in the order of `Widths.attributes`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.format.quantise import dequantise, quantise
from pd4dgs_codec.scene import ATTRIBUTES, Scene, Widths

NO_CLASSES = np.zeros(0, np.int32)  #: of anchors that are not graded


#: Some channels of an attribute.
Channels = slice | np.ndarray


@dataclass(frozen=True, eq=False)
class Grid:
    """The values that attributes can have: (m + k 2^c) Q, with a symbol k, the step Q of the attribute, the centre m of
    the channel and the class c of the anchor (clause "dequantisation").

    steps: by name. centre: int32 [channels] in steps, 0 if the anchors are not graded.
    """

    steps: dict[str, float]
    widths: Widths
    centre: np.ndarray

    @staticmethod
    def of(scene: Scene) -> Grid:
        """That of a scene's attributes at its steps. Raises EncodeError for a centre that has no symbol."""
        steps, widths = scene.steps.attributes, scene.widths
        centre = np.zeros(widths.channels, np.int32)
        if scene.grading is not None:
            rows = attribute_rows(scene.grading.centre, widths)
            centre = np.concatenate([quantise(x, steps[name], f"centre of {name}") for name, x in rows])
        return Grid(steps, widths, centre)

    def spacing(self, classes: np.ndarray) -> np.ndarray | int:
        """2^c of anchors int [n], as it broadcasts against [..., n]; 1 if they are not graded."""
        return 1 << classes.astype(np.int64) if self.widths.graded else 1

    def indices(self, symbols: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """int64 [channels, n]: m + k 2^c of symbols [channels, n]."""
        at: np.ndarray = self.centre[:, None] + symbols.astype(np.int64) * self.spacing(classes)
        return at

    def farthest(self, symbols: np.ndarray, classes: np.ndarray) -> dict[str, int]:
        """By name, how many steps from 0 the farthest value of symbols [channels, n] lies; 0 without anchors."""
        most = dict.fromkeys(ATTRIBUTES, 0)
        for rows in row_blocks(symbols.shape[1]) if self.widths.graded else [slice(None)]:
            at = self.indices(symbols[:, rows], classes[rows]) if self.widths.graded else symbols
            for name, own in attribute_rows(at, self.widths):
                most[name] = max(most[name], int(own.max(initial=0)), -int(own.min(initial=0)))
        return most

    def quantise(self, values: dict[str, np.ndarray], classes: np.ndarray) -> np.ndarray:
        """int32 [channels, n] symbols, channel-major, of float32 [n, *shape] per attribute name. classes: int [n], or
        NO_CLASSES."""
        symbols = np.empty((self.widths.channels, len(values[ATTRIBUTES[0]])), np.int32)
        for name, own in attribute_rows(symbols, self.widths):
            self._quantise(name, values[name], classes, own)
        return symbols

    def symbols_of(self, name: str, x: np.ndarray, classes: np.ndarray, which: Channels = slice(None)) -> np.ndarray:
        """int32 [scalars, n] of one attribute float32 [n, *shape], or of some of its channels float32 [n, scalars]."""
        symbols = np.empty((math.prod(x.shape[1:]), len(x)), np.int32)
        self._quantise(name, x, classes, symbols, which)
        return symbols

    def _quantise(
        self, name: str, x: np.ndarray, classes: np.ndarray, symbols: np.ndarray, which: Channels = slice(None)
    ) -> None:
        centre = self._centre(name)[which]
        for rows in row_blocks(len(x)):
            channels, spacing = x[rows].reshape(-1, len(centre)).T, self.spacing(classes[rows])
            symbols[:, rows] = quantise(channels, self.steps[name], name, centre[:, None], spacing)

    def rounded(self, name: str, x: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """The values of one attribute float32 [n, *shape] that come back for those given."""
        values = np.empty_like(x)
        for rows in row_blocks(len(x)):
            own = classes[rows]
            values[rows] = self.values_of(name, self.symbols_of(name, x[rows], own), own)
        return values

    def dequantise(self, symbols: np.ndarray, classes: np.ndarray) -> dict[str, np.ndarray]:
        """The inverse of `quantise`: float32 [n, *shape] per attribute name, C-contiguous."""
        return {name: self.values_of(name, rows, classes) for name, rows in attribute_rows(symbols, self.widths)}

    def values_of(self, name: str, symbols: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """The inverse of `symbols_of`, for all channels of the attribute."""
        centre, values = self._centre(name), np.empty(symbols.shape[::-1], np.float32)
        for rows in row_blocks(symbols.shape[1]):
            spacing = self.spacing(classes[rows])
            values[rows] = dequantise(symbols[:, rows], self.steps[name], centre[:, None], spacing).T
        return values.reshape(-1, *self.widths.attributes[name])

    def value_of(self, name: str, symbol: int, channel: int, step_class: int) -> float:
        """What one symbol of one channel of an attribute stands for at an anchor of that class."""
        centre = int(self._centre(name)[channel])
        return float(dequantise(np.array([symbol]), self.steps[name], centre, 1 << step_class)[0])

    def _centre(self, name: str) -> np.ndarray:
        return dict(attribute_rows(self.centre, self.widths))[name]


#: Anchors that are quantised and dequantised at a time: intermediate values are twice as wide.
BLOCK = 4096


def row_blocks(n: int) -> Iterator[slice]:
    """0 .. n - 1, BLOCK at a time; of nothing one empty block."""
    yield from (slice(first, min(first + BLOCK, n)) for first in range(0, max(n, 1), BLOCK))


def attribute_rows(channels: np.ndarray, widths: Widths) -> Iterator[tuple[str, np.ndarray]]:
    """(name, its rows) of what has a row per channel."""
    first = 0
    for name in ATTRIBUTES:
        last = first + math.prod(widths.attributes[name])
        yield name, channels[first:last]
        first = last


def classes_of(scene: Scene) -> np.ndarray:
    """int32 [N] step classes, or NO_CLASSES."""
    return NO_CLASSES if scene.grading is None else scene.grading.classes.astype(np.int32)
