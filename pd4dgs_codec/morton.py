"""Morton (Z-order) codes of voxel cells: bit 3i is bit i of x, 3i + 1 of y, 3i + 2 of z, relative to the minimum."""

import numpy as np

from pd4dgs_codec.errors import EncodeError

AXIS_BITS = 21  #: bits per axis; three of them fit in one int64
MAX_VOXEL = 1 << (AXIS_BITS - 1)  #: largest |voxel index| of an anchor along an axis, a limit of the format


def spread_bits(values: np.ndarray) -> np.ndarray:
    """Moves bit i of each value to bit 3i. values: int, 0 <= v < 2**21. Returns int64 of the same shape."""
    v = values.astype(np.int64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        v |= v << shift
        v &= mask
    return v


def join_bits(codes: np.ndarray) -> np.ndarray:
    """Moves bit 3i of each code int64 to bit i and drops the other bits: the inverse of spread_bits, int64."""
    v = codes & 0x1249249249249249
    for shift, mask in (
        (2, 0x10C30C30C30C30C3),
        (4, 0x100F00F00F00F00F),
        (8, 0x1F0000FF0000FF),
        (16, 0x1F00000000FFFF),
        (32, 0x1FFFFF),
    ):
        v = (v | (v >> shift)) & mask
    return v


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """Returns the codes int64 [N] of cells int [N, 3], relative to their minimum.

    Raises EncodeError if the shape is wrong or an axis spans more than 2**21 cells.
    """
    if cells.ndim != 2 or cells.shape[1] != 3 or cells.dtype.kind not in "iu":
        raise EncodeError(f"positions: expected an integer array [N, 3], found {cells.dtype} {list(cells.shape)}")
    if len(cells) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = cells.min(axis=0).tolist(), cells.max(axis=0).tolist()
    span = max(last - first for first, last in zip(low, high, strict=True))
    if span >> AXIS_BITS:
        raise EncodeError(f"positions span {span + 1} voxels on one axis, limit {1 << AXIS_BITS} in a slice")
    codes = np.zeros(len(cells), np.int64)
    for axis, first in enumerate(low):
        offsets = cells[:, axis].astype(np.int64)
        offsets -= first
        codes |= spread_bits(offsets) << axis
    return codes


def morton_order(cells: np.ndarray) -> np.ndarray:
    """Returns the permutation int64 [N] that sorts cells int [N, 3], all within ±MAX_VOXEL, by Morton code; equal cells
    keep their order. An axis that spans the whole range takes one bit more than a code has."""
    offsets = cells.astype(np.int64) - cells.min(axis=0, initial=MAX_VOXEL)
    upper = offsets >> AXIS_BITS
    lower = [spread_bits(offsets[:, axis] & ((1 << AXIS_BITS) - 1)) << axis for axis in range(3)]
    codes = lower[0] | lower[1] | lower[2]
    if not upper.any():
        return np.argsort(codes, kind="stable").astype(np.int64)
    return np.lexsort((codes, upper @ (1, 2, 4))).astype(np.int64)
