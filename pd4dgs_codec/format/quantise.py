"""Uniform scalar quantisation between float32 values and int32 symbols, and the quantisation grid of attributes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.scene import ATTRIBUTES, MASK_MIN_CODE, MASK_THRESHOLD, Scene, Widths

#: Symbols k satisfy |k| <= MAX_SYMBOL: binary64(k) * binary64(Q) is exact, and no two symbols of one step share a
#: binary32 value, so that quantising a dequantised value gives the same symbol.
MAX_SYMBOL = 1 << 23

_SMALLEST_STEP = float(np.finfo(np.float32).tiny)
_LARGEST_STEP = float(np.finfo(np.float32).max)
_TO_INFINITY = 2.0**128 - 2.0**103  #: from here on binary64 rounds to an infinite binary32

NO_CLASSES = np.zeros(0, np.int32)  #: the step classes of anchors that are not graded

#: Integers that broadcast against symbols.
Integers = np.ndarray | int


def expect(ok: bool, message: str) -> None:
    """Raises EncodeError with this message unless `ok`."""
    if not ok:
        raise EncodeError(message)


def expect_array(name: str, a: np.ndarray, dtype: type, shape: tuple[int, ...]) -> None:
    """Raises EncodeError unless an array has this dtype, this shape and finite values."""
    expect(a.dtype == dtype and a.shape == shape, f"{name}: {a.dtype} {a.shape}, expected {np.dtype(dtype)} {shape}")
    if a.dtype.kind == "f":
        expect(bool(np.isfinite(a).all()), f"{name}: a value is NaN or infinite")


def is_step(value: float) -> bool:
    """Whether `value` may be a quantisation step or a voxel size: a positive normal binary32."""
    return bool(_SMALLEST_STEP <= value <= _LARGEST_STEP and float(np.float32(value)) == value)


def magnitude(k: np.ndarray) -> int:
    """Returns the largest |k| of an integer array of any shape, 0 for an empty one."""
    return max(int(k.max()), -int(k.min())) if k.size else 0


def quantise(
    x: np.ndarray, step: float, name: str = "tensor", centre: Integers = 0, spacing: Integers = 1
) -> np.ndarray:
    """k = round-half-to-even((binary64(x) / binary64(step) - centre) / spacing), int32 of x's shape.

    x: float32 array. step: positive normal binary32. spacing: powers of two. quantise(dequantise(k, ...), ...) == k
    while |centre + k spacing| <= 2^23; above that two neighbouring k can share one binary32 value unless step is a
    power of two. Raises EncodeError naming the tensor if a value is not finite, if |k| or |centre + k spacing| would
    exceed MAX_SYMBOL, or if the dequantised value would be infinite.
    """
    if not is_step(step):
        raise EncodeError(f"{name}: quantisation step {step!r}, expected a positive normal binary32 value")
    if not np.isfinite(x).all():
        raise EncodeError(f"{name}: {np.size(x) - int(np.isfinite(x).sum())} values are NaN or infinite, expected none")
    k = np.rint((x.astype(np.float64) / np.float64(step) - centre) / spacing)
    at = centre + k * spacing
    largest = float(max(np.abs(k).max(), np.abs(at).max())) if k.size else 0.0
    if largest > MAX_SYMBOL:
        raise EncodeError(f"{name}: symbol of magnitude {largest:.0f} at step {step:g}, expected at most {MAX_SYMBOL}")
    if not all_finite(at, step):
        raise EncodeError(f"{name}: a value is decoded as infinity at step {step:g}, expected a finite one")
    symbols: np.ndarray = k.astype(np.int32)
    return symbols


def all_finite(k: np.ndarray, step: float) -> bool:
    """Whether dequantise(k, step) holds no infinity; |k| <= MAX_SYMBOL."""
    step = float(step)  # the product with a numpy binary32 would be binary32
    if MAX_SYMBOL * step < _TO_INFINITY:
        return True
    return magnitude(k) * step < _TO_INFINITY


def dequantise(k: np.ndarray, step: float, centre: Integers = 0, spacing: Integers = 1) -> np.ndarray:
    """binary32(binary64(centre + k spacing) * binary64(step)), float32 of k's shape: an exact product, rounded once.

    Computed in binary32 with the same result: |k|, |centre| and |centre + k spacing| are at most MAX_SYMBOL, spacings
    are powers of two and the step is a binary32, so only the last product is rounded.
    """
    values: np.ndarray = k.astype(np.float32)
    if np.ndim(spacing) or spacing != 1:
        values *= np.asarray(spacing, np.float32)
    if np.any(centre):
        values += np.asarray(centre, np.float32)
    with np.errstate(over="ignore"):  # the caller refuses infinities, see all_finite
        values *= np.float32(step)
    return values


def mask_codes(mask: np.ndarray) -> np.ndarray:
    """Returns uint8 codes of masks m in [0, 1]: 0 where m <= MASK_THRESHOLD, else max(MASK_MIN_CODE, round(255 m)).

    Codes keep the order of the masks. The inverse is m = code * MASK_STEP. Raises EncodeError for m outside [0, 1].
    """
    m = np.asarray(mask, dtype=np.float64)
    if not ((m >= 0) & (m <= 1)).all():
        raise EncodeError("mask: a value is outside [0, 1] or NaN")
    return np.where(m <= MASK_THRESHOLD, 0, np.maximum(MASK_MIN_CODE, np.rint(m * 255.0))).astype(np.uint8)


# -- attributes --------------------------------------------------------------------------------------------------------

#: Anchors that are quantised or dequantised at a time, because intermediate values are twice as wide.
BLOCK = 4096


def row_blocks(n: int) -> Iterator[slice]:
    """Yields slices of 0 .. n - 1 of at most BLOCK rows; one empty slice for n = 0."""
    yield from (slice(first, min(first + BLOCK, n)) for first in range(0, max(n, 1), BLOCK))


def attribute_rows(channels: np.ndarray, widths: Widths) -> Iterator[tuple[str, np.ndarray]]:
    """Yields (name of an attribute, its rows) of an array with a row per channel, in coding order."""
    first = 0
    for name in ATTRIBUTES:
        last = first + math.prod(widths.attributes[name])
        yield name, channels[first:last]
        first = last


def classes_of(scene: Scene) -> np.ndarray:
    """Returns the step classes int32 [N] of a scene, or NO_CLASSES."""
    return NO_CLASSES if scene.grading is None else scene.grading.classes.astype(np.int32)


@dataclass(frozen=True, eq=False)
class Grid:
    """The values that attributes can have: (m + k 2^c) Q with a symbol k, the step Q of the attribute, the centre m of
    the channel and the step class c of the anchor (clause 11.5).

    steps: Q by attribute. centre: int32 [channels] in steps, 0 if the anchors are not graded. Symbols are int32
    [channels, n], channel-major; classes are int32 [n], or NO_CLASSES.
    """

    steps: dict[str, float]
    widths: Widths
    centre: np.ndarray

    @staticmethod
    def of(scene: Scene) -> Grid:
        """Returns the grid of a scene's attributes. Raises EncodeError for a centre that has no symbol."""
        steps, widths = scene.steps.attributes, scene.widths
        centre = np.zeros(widths.channels, np.int32)
        if scene.grading is not None:
            rows = attribute_rows(scene.grading.centre, widths)
            centre = np.concatenate([quantise(x, steps[name], f"centre of {name}") for name, x in rows])
        return Grid(steps, widths, centre)

    @property
    def centre_values(self) -> np.ndarray:
        """float32 [channels]: the value of symbol 0 in each channel."""
        rows = attribute_rows(self.centre, self.widths)
        return np.concatenate([dequantise(m, self.steps[name]) for name, m in rows])

    def _spacing(self, classes: np.ndarray) -> np.ndarray | int:
        return 1 << classes.astype(np.int64) if self.widths.graded else 1

    def _with_centres(self, symbols: np.ndarray) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Yields (name of an attribute, its rows of symbols [channels, n], their centres [rows, 1])."""
        both = (attribute_rows(rows, self.widths) for rows in (symbols, self.centre[:, None]))
        yield from ((name, own, centre) for (name, own), (_, centre) in zip(*both, strict=True))

    def farthest(self, symbols: np.ndarray, classes: np.ndarray) -> dict[str, int]:
        """Returns the largest |m + k 2^c| by attribute; 0 without anchors."""
        most = dict.fromkeys(ATTRIBUTES, 0)
        for rows in row_blocks(symbols.shape[1]) if self.widths.graded else [slice(None)]:
            at = symbols[:, rows]
            if self.widths.graded:
                at = self.centre[:, None] + at.astype(np.int64) * self._spacing(classes[rows])
            for name, own in attribute_rows(at, self.widths):
                most[name] = max(most[name], magnitude(own))
        return most

    def quantise(self, values: dict[str, np.ndarray], classes: np.ndarray) -> np.ndarray:
        """Returns the symbols of float32 [n, *shape] by attribute. Raises EncodeError for a value without a symbol."""
        symbols = np.empty((self.widths.channels, len(values[ATTRIBUTES[0]])), np.int32)
        for name, own, centre in self._with_centres(symbols):
            for rows in row_blocks(symbols.shape[1]):
                channels = values[name][rows].reshape(-1, len(centre)).T
                own[:, rows] = quantise(channels, self.steps[name], name, centre, self._spacing(classes[rows]))
        return symbols

    def dequantise(self, symbols: np.ndarray, classes: np.ndarray) -> dict[str, np.ndarray]:
        """The inverse of `quantise`: float32 [n, *shape] by attribute, C-contiguous."""
        values, spacing = {}, self._spacing(classes)
        for name, own, centre in self._with_centres(symbols):
            found = np.ascontiguousarray(dequantise(own, self.steps[name], centre, spacing).T)
            values[name] = found.reshape(-1, *self.widths.attributes[name])
        return values
