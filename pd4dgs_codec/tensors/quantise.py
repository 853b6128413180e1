"""Uniform scalar quantisation between float32 values and int32 symbols, and the quantisation of rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.errors import EncodeError, Malformed
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


def dequantise(k: np.ndarray, step: float) -> np.ndarray:
    """binary32(binary64(k) * binary64(step)), float32 of k's shape: an exact product, rounded once.

    Computed in binary32 with the same result, as |k| <= MAX_SYMBOL and the step is a binary32.
    """
    values: np.ndarray = k.astype(np.float32)
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


#: Predictors of rows by their id in the bitstream.
ROW_PREDICTORS = {0: "none", 1: "previous row", 2: "previous row in whole steps"}
WHOLE = 2  #: for labels: step classes do not concern it


@dataclass(frozen=True)
class Rows:
    """A tensor of the form rows: its id, its channels C per row, its step Q, and the id of its predictor."""

    id: int
    channels: int
    step: float
    predictor: int = 0


@dataclass(frozen=True, eq=False)
class RowTable:
    """The tensors of a row. Their values are v Q with an integer v, int32 [W, n], channel-major (clause 11.2).

    Without a predictor v is m + k 2^c, with a symbol k, the centre m of the channel and the step class c of the row.
    With predictor 1, k 2^c is the difference from the last row before of class c or lower, or from m. With predictor
    WHOLE, k is the difference from the row before, or from m, whatever the classes.

    tensors: by ascending id. centre: int32 [W], None if rows have no step classes. Classes: int32 [n], or NO_CLASSES.
    """

    tensors: tuple[Rows, ...] = ()
    centre: np.ndarray | None = None

    @property
    def channels(self) -> int:
        """W, the number of scalars of a row."""
        return sum(tensor.channels for tensor in self.tensors)

    @property
    def graded(self) -> bool:
        """Whether rows have step classes."""
        return self.centre is not None

    @property
    def centre_values(self) -> np.ndarray:
        """float32 [W]: m Q."""
        return np.concatenate([dequantise(m, tensor.step) for tensor, m in self.of_each(self._centres)])

    @property
    def _centres(self) -> np.ndarray:
        return np.zeros(self.channels, np.int32) if self.centre is None else self.centre

    def of_each(self, channels: np.ndarray) -> Iterator[tuple[Rows, np.ndarray]]:
        """Yields (tensor, its part) of an array [W, ...]."""
        first = 0
        for tensor in self.tensors:
            last = first + tensor.channels
            yield tensor, channels[first:last]
            first = last

    def _mapped(self, a: np.ndarray, b: np.ndarray) -> Iterator[tuple[Rows, np.ndarray, np.ndarray, np.ndarray]]:
        """Yields (tensor, its part of a and of b, both [W, n], its centres [C, 1])."""
        parts = zip(self.of_each(a), self.of_each(b), self.of_each(self._centres[:, None]), strict=True)
        yield from ((tensor, own, other, m) for (tensor, own), (_, other), (_, m) in parts)

    def _used(self, tensor: Rows, classes: np.ndarray) -> np.ndarray:
        """The step classes that concern a tensor, or NO_CLASSES."""
        return classes if self.graded and tensor.predictor != WHOLE else NO_CLASSES

    def quantise(self, given: Sequence[np.ndarray], classes: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Returns v of float32 [n, any], one array per tensor, the nearest that symbols can give. names: for messages.
        Raises EncodeError for a value without a symbol."""
        v = np.empty((self.channels, len(given[0])), np.int32)
        for x, name, (tensor, own, _, m) in zip(given, names, self._mapped(v, v), strict=True):
            used = self._used(tensor, classes)
            if tensor.predictor and used.size:  # v is whole steps from that of the last row of a lower class
                flat = x.reshape(-1, tensor.channels).T
                for c, upto, of_class in _runs(used, v.shape[1]):
                    last, rows = _last_lower(of_class)[of_class], upto[of_class]
                    base = np.concatenate([own[:, upto], m], axis=1)[:, last]
                    own[:, rows] = base + (quantise(flat[:, rows], tensor.step, name, base, 1 << c) << c)
                continue
            spacing = np.int32(1) << used if used.size else np.ones(v.shape[1], np.int32)
            for rows in row_blocks(v.shape[1]):
                channels = x[rows].reshape(-1, tensor.channels).T
                own[:, rows] = quantise(channels, tensor.step, name, m, spacing[rows]) * spacing[rows] + m
        return v

    def dequantise(self, v: np.ndarray) -> list[np.ndarray]:
        """Returns the values float32 [n, C] of each tensor, C-contiguous."""
        return [np.ascontiguousarray(dequantise(own, tensor.step).T) for tensor, own in self.of_each(v)]

    @property
    def _plain(self) -> bool:
        """Whether symbols are values."""
        return not self.graded and not any(tensor.predictor for tensor in self.tensors)

    def values(self, symbols: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """Returns v of symbols k int32 [W, n]. Raises Malformed if a magnitude exceeds MAX_SYMBOL."""
        if magnitude(symbols) > MAX_SYMBOL:
            raise Malformed(f"a symbol of a row over {MAX_SYMBOL} in magnitude")
        if self._plain:
            return symbols
        v = np.empty_like(symbols)
        for tensor, k, out, m in self._mapped(symbols, v):
            used = self._used(tensor, classes)
            found = _accumulated(k, m, used) if tensor.predictor else (k << (used if used.size else 0)) + m
            if magnitude(found) > MAX_SYMBOL:
                raise Malformed(f"a value of a row more than {MAX_SYMBOL} steps from 0")
            out[:] = found
        return v

    def symbols(self, v: np.ndarray, classes: np.ndarray) -> np.ndarray:
        """The inverse of `values`. Raises EncodeError if no symbols give v."""
        if self._plain:
            return v
        symbols = np.empty_like(v)
        for tensor, own, out, m in self._mapped(v, symbols):
            used = self._used(tensor, classes)
            shifts = used if used.size else 0
            steps = _differences(own, m, used) if tensor.predictor else own - m
            out[:] = steps >> shifts
            expect(np.array_equal(out << shifts, steps), f"rows {tensor.id}: values between the steps of their class")
            expect(magnitude(out) <= MAX_SYMBOL, f"rows {tensor.id}: a symbol over {MAX_SYMBOL} in magnitude")
        return symbols


def _runs(classes: np.ndarray, n: int) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yields, for each class c that occurs, ascending: c, the rows int64 of classes <= c, and which of them have it."""
    classes = classes if classes.size else np.zeros(n, np.int32)
    for c in np.unique(classes).tolist():
        rows = np.flatnonzero(classes <= c)
        yield c, rows, classes[rows] == c


def _last_lower(own: np.ndarray) -> np.ndarray:
    """Returns the place of the last row of a lower class before each row, int64 [n], or -1. own: which have the class.
    A row of a lower class is its own."""
    found: np.ndarray = np.maximum.accumulate(np.where(own, -1, np.arange(len(own))))
    return found


def _accumulated(k: np.ndarray, m: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Undoes predictor 1: int64 [C, n] of symbols k [C, n] and centres m [C, 1]."""
    v = np.zeros(k.shape, np.int64)
    for c, rows, own in _runs(classes, k.shape[1]):
        sums = np.cumsum(np.where(own, k[:, rows].astype(np.int64) << c, 0), axis=1)
        last = _last_lower(own)
        base = np.concatenate([v[:, rows] - sums, np.broadcast_to(m, (len(m), 1))], axis=1)
        v[:, rows[own]] = (base[:, last] + sums)[:, own]
    return v


def _differences(v: np.ndarray, m: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Applies predictor 1: int64 [C, n], k 2^c of values v [C, n] and centres m [C, 1]."""
    steps = np.empty(v.shape, np.int64)
    for _, rows, own in _runs(classes, v.shape[1]):
        differences = np.diff(v[:, rows].astype(np.int64), axis=1, prepend=m)
        steps[:, rows[own]] = differences[:, own]
    return steps
