"""Uniform scalar quantisation between float32 values and int32 symbols, and the quantisation of rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.scene import MASK_MIN_CODE, MASK_THRESHOLD

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


# -- rows --------------------------------------------------------------------------------------------------------------

#: Anchors that are quantised or dequantised at a time, because intermediate values are twice as wide.
BLOCK = 4096


def row_blocks(n: int) -> Iterator[slice]:
    """Yields slices of 0 .. n - 1 of at most BLOCK rows; one empty slice for n = 0."""
    yield from (slice(first, min(first + BLOCK, n)) for first in range(0, max(n, 1), BLOCK))


@dataclass(frozen=True)
class Rows:
    """A tensor of the form rows: its id, its channels C per anchor, and its step."""

    id: int
    channels: int
    step: float


@dataclass(frozen=True, eq=False)
class RowTable:
    """The tensors of an anchor's row. Their values are (m + k 2^c) Q with a symbol k, the step Q of the tensor, the
    centre m of the channel and the step class c of the anchor (clause 11.5).

    tensors: by ascending id. centre: int32 [W] in steps, None if anchors have no step classes. Symbols are int32 [W,
    n], channel-major; classes are int32 [n], or NO_CLASSES.
    """

    tensors: tuple[Rows, ...]
    centre: np.ndarray | None = None

    @property
    def channels(self) -> int:
        """W, the number of scalars of a row."""
        return sum(tensor.channels for tensor in self.tensors)

    @property
    def graded(self) -> bool:
        """Whether anchors have step classes."""
        return self.centre is not None

    def of_each(self, channels: np.ndarray) -> Iterator[tuple[Rows, np.ndarray]]:
        """Yields (tensor, its rows) of an array [W, ...]."""
        first = 0
        for tensor in self.tensors:
            last = first + tensor.channels
            yield tensor, channels[first:last]
            first = last

    @property
    def centre_values(self) -> np.ndarray:
        """float32 [W]: the value of symbol 0 in each channel."""
        return np.concatenate([dequantise(m, tensor.step) for tensor, m in self.of_each(self._centres)])

    @property
    def _centres(self) -> np.ndarray:
        return np.zeros(self.channels, np.int32) if self.centre is None else self.centre

    def _spacing(self, classes: np.ndarray) -> np.ndarray | int:
        return 1 << classes.astype(np.int64) if self.graded else 1

    def _with_centres(self, symbols: np.ndarray) -> Iterator[tuple[Rows, np.ndarray, np.ndarray]]:
        """Yields (tensor, its rows of symbols [W, n], their centres [rows, 1])."""
        both = self.of_each(symbols), self.of_each(self._centres[:, None])
        yield from ((tensor, own, centre) for (tensor, own), (_, centre) in zip(*both, strict=True))

    def farthest(self, symbols: np.ndarray, classes: np.ndarray) -> list[int]:
        """Returns the largest |m + k 2^c| of each tensor; 0 without anchors."""
        most = [0] * len(self.tensors)
        for rows in row_blocks(symbols.shape[1]) if self.graded else [slice(None)]:
            at = symbols[:, rows]
            if self.graded:
                at = self._centres[:, None] + at.astype(np.int64) * self._spacing(classes[rows])
            most = [max(m, magnitude(own)) for m, (_, own) in zip(most, self.of_each(at), strict=True)]
        return most

    def quantise(self, values: Sequence[np.ndarray], classes: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Returns the symbols of float32 [n, any], one array per tensor. names: for messages. Raises EncodeError for a
        value without a symbol."""
        symbols = np.empty((self.channels, len(values[0])), np.int32)
        for x, name, (tensor, own, centre) in zip(values, names, self._with_centres(symbols), strict=True):
            for rows in row_blocks(symbols.shape[1]):
                channels = x[rows].reshape(-1, tensor.channels).T
                own[:, rows] = quantise(channels, tensor.step, name, centre, self._spacing(classes[rows]))
        return symbols

    def dequantise(self, symbols: np.ndarray, classes: np.ndarray) -> list[np.ndarray]:
        """The inverse of `quantise`: float32 [n, C] of each tensor, C-contiguous."""
        spacing = self._spacing(classes)
        return [
            np.ascontiguousarray(dequantise(own, tensor.step, centre, spacing).T)
            for tensor, own, centre in self._with_centres(symbols)
        ]
