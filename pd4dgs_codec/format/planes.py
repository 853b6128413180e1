"""Planes, for `deformation`: prediction, the coded section, and cells that no anchor reads.

A plane is int32 [C, H, W]. A sample at row i, column j of a channel is predicted from its neighbours W = k[i, j-1],
N = k[i-1, j] and NW = k[i-1, j-1], and the residual k - prediction is coded. In row 0 N and NW are taken equal to W, in
column 0 W and NW are taken equal to N, and at (0, 0) all three are 0 (clause 11.3). All arithmetic is on integers.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from pd4dgs_codec.entropy.channels import decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import histogram
from pd4dgs_codec.entropy.tables import BIT, entropy_bits, frequency_costs, symbol_counts
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed, UnsupportedFeature
from pd4dgs_codec.format.quantise import MAX_SYMBOL, magnitude
from pd4dgs_codec.format.stages import (
    Activity,
    Group,
    Places,
    activity_classes,
    cheapest_class_count,
    coded_stages,
    parts_of,
    read_class_count,
    read_stages,
)

PlaneShape = tuple[int, int, int]  #: of a plane: channels, rows, columns
Array = np.ndarray

#: The two forms of the section: all channels as they are, or stages.
PLAIN, STAGED = 0, 1
#: Largest difference in cells between the positions of two renderers, which round coordinates differently.
CELL_SLACK = 0.02


@dataclass(frozen=True)
class Predictor:
    """A predictor. `restore` undoes it by running sums; None for the median, which takes a scan."""

    name: str
    predict: Callable[[Array, Array, Array], Array]  #: (W, N, NW) -> prediction
    restore: Callable[[Array], Array] | None = None  #: int64 residuals [C, H, W] -> samples


def _median(w: Array, n: Array, nw: Array) -> Array:
    """The median of W, N and W + N - NW: the LOCO-I predictor (Weinberger, Seroussi, Sapiro 2000)."""
    low, high = np.minimum(w, n), np.maximum(w, n)
    median: Array = low + high
    median -= nw
    np.minimum(median, high, out=median)
    np.maximum(median, low, out=median)
    return median


def _restore_left(r: Array) -> Array:
    r[:, :, 0] = np.cumsum(r[:, :, 0], axis=1)
    return np.cumsum(r, axis=2)


def _restore_up(r: Array) -> Array:
    r[:, 0, :] = np.cumsum(r[:, 0, :], axis=1)
    return np.cumsum(r, axis=1)


#: Predictors by their id in the bitstream. On time planes "up" is the previous instant.
PREDICTORS: dict[int, Predictor] = {
    0: Predictor("none", lambda w, n, nw: np.zeros_like(w), lambda r: r),
    1: Predictor("left", lambda w, n, nw: w, _restore_left),
    2: Predictor("up", lambda w, n, nw: n, _restore_up),
    3: Predictor("median", _median),
}


def residual(predictor: int, k: Array) -> Array:
    """Returns residuals of samples k, both int32 [C, H, W], under PREDICTORS[predictor]. They may exceed MAX_SYMBOL."""
    w, n, nw = np.zeros_like(k), np.zeros_like(k), np.zeros_like(k)
    w[:, :, 1:], n[:, 1:, :], nw[:, 1:, 1:] = k[:, :, :-1], k[:, :-1, :], k[:, :-1, :-1]
    n[:, 0, :] = nw[:, 0, :] = w[:, 0, :]
    w[:, 1:, 0] = nw[:, 1:, 0] = n[:, 1:, 0]
    r: Array = k - PREDICTORS[predictor].predict(w, n, nw)
    return r


def restore(planes: Sequence[tuple[int, Array]]) -> list[Array]:
    """The inverse of `residual` for many planes at once: [(predictor id, int32 [C, H, W] residuals)] -> int32 samples.

    C is the same throughout. Raises Malformed if a sample's magnitude exceeds MAX_SYMBOL.
    """
    scanned = iter(_scan([r for predictor, r in planes if PREDICTORS[predictor].restore is None]))
    result = list[Array]()
    for predictor, r in planes:
        undo = PREDICTORS[predictor].restore
        result.append(undo(r.astype(np.int64)) if undo else next(scanned))
    for (predictor, _), k in zip(planes, result, strict=True):
        if magnitude(k) > MAX_SYMBOL:
            name = PREDICTORS[predictor].name
            raise Malformed(f"plane sample over {MAX_SYMBOL} in magnitude after predictor {predictor} ({name})")
    return [k.astype(np.int32, copy=False) for k in result]


def _scan(planes: Sequence[Array]) -> list[Array]:
    """Undoes the median on int32 [C, H, W] along anti-diagonals: all cells with equal i + j are independent.

    Planes are scanned in groups in which none has more than twice the diagonals of another. So there are at most
    4 (H + W) steps, with the largest plane's H and W, for any number of planes, and memory is linear in the cells.
    """
    result = list(planes)
    order = sorted(range(len(planes)), key=lambda i: -sum(planes[i].shape[1:]))
    while order:
        longest = sum(planes[order[0]].shape[1:])
        alike = [i for i in order if 2 * sum(planes[i].shape[1:]) >= longest]
        for i, k in zip(alike, _scan_together([planes[i] for i in alike]), strict=True):
            result[i] = k
        order = order[len(alike) :]
    return result


def _scan_together(planes: Sequence[Array]) -> list[Array]:
    """`_scan` of planes in descending order of their number of diagonals.

    A table has a row per diagonal and a column per row of a plane: cell (i, j) is in table row i + j, in the column of
    i. So W is above it, N above and one to the left, and NW one row above N, for all cells of a table row at once.
    Neighbours beyond a border are 0 here, which gives the same median: a column of zeros precedes each plane, and
    entries left of a plane's first column are never written.
    The median stays within its neighbours' range, so a magnitude is at most (h + w) * max|r|. That is below 2^37, and
    nearly always small enough for narrow lanes, which take a half or a quarter of the time. The table has at most 4.5
    lanes per sample: 2.25 if a plane has as many rows as columns (its shorter side gives the rows), and twice as many
    for planes that end early.
    """
    turned = [r if r.shape[1] <= r.shape[2] else r.swapaxes(1, 2) for r in planes]  # the median is symmetric in W and N
    ends = np.cumsum([r.shape[1] + 1 for r in turned])
    zeros = ends - [r.shape[1] + 1 for r in turned]
    diagonals, channels = [sum(r.shape[1:]) - 1 for r in turned], len(turned[0])
    largest = max(magnitude(r) * sum(r.shape[1:]) for r in turned)
    lane = next(t for t in (np.int16, np.int32, np.int64) if 4 * largest <= np.iinfo(t).max)
    table = np.zeros((diagonals[0], int(ends[-1]), channels), lane)
    down, right, deep = table.strides[0] + table.strides[1], table.strides[0], table.strides[2]
    views = [
        np.lib.stride_tricks.as_strided(table[0, zero + 1 :], r.shape, (deep, down, right))
        for zero, r in zip(zeros.tolist(), turned, strict=True)
    ]
    for view, r in zip(views, turned, strict=True):
        view[...] = r.astype(lane)
    rows, count = table.reshape(len(table), -1), len(turned)
    for d in range(1, len(table)):
        while diagonals[count - 1] <= d:
            count -= 1
        end, above = int(ends[count - 1]) * channels, rows[d - 1]
        rows[d, channels:end] += _median(above[channels:end], above[: end - channels], rows[d - 2, : end - channels])
        table[d, zeros] = 0
    upright = (k if k.shape == r.shape else k.swapaxes(1, 2) for k, r in zip(views, planes, strict=True))
    return [np.ascontiguousarray(k).astype(np.int32) for k in upright]


# -- the encoder's choice ----------------------------------------------------------------------------------------------


def choose_predictor(k: Array) -> tuple[int, Array, float]:
    """Returns (id, int32 residuals, estimated bits) of the cheapest predictor with residuals within MAX_SYMBOL."""
    bits, predictor, _, r = min(_candidates((predictor, k) for predictor in PREDICTORS), key=lambda found: found[0])
    return predictor, r, bits


def _candidates(planes: Iterable[tuple[int, Array]]) -> Iterator[tuple[float, int, Array, Array]]:
    """Yields (estimated bits, predictor, samples, residuals) of each (predictor, samples) within MAX_SYMBOL. Predictor
    0 always is, because its residuals are the samples."""
    for predictor, k in planes:
        if magnitude(k) <= MAX_SYMBOL:
            r = residual(predictor, k)
            if magnitude(r) <= MAX_SYMBOL:
                yield _estimated_bits(r), predictor, k, r


def _estimated_bits(residuals: Array) -> float:
    """Estimates the bits of residuals int32 [C, H, W]: per channel, the order-0 entropy and log2(n) / 2 per further
    distinct value for its distribution. Entropies are sums of integers, so every machine makes the same choice."""
    costs, distinct, size = 0, 0, residuals[0].size
    for channel in residuals.reshape(len(residuals), -1):
        _, counts = symbol_counts(channel)
        costs += int(counts @ frequency_costs(counts)) - size * int(frequency_costs(np.array(size)))
        distinct += len(counts) - 1
    return costs / BIT + 0.5 * distinct * float(np.log2(size))


# -- cells that nothing samples ----------------------------------------------------------------------------------------


def cells_read(shape: PlaneShape, u: Array, v: Array | None) -> Array:
    """Marks the cells of a plane that samples may read: bool [H, W]. u, v: float32 [n], 0..1, the samples' places in a
    row and in a column; None if they may read whole columns, as on time planes."""
    _, height, width = shape
    read = np.zeros((height, width), bool)
    for i in _cells(u, width):
        for j in _cells(v, height) if v is not None else [slice(None)]:
            read[j, i] = True
    return read


def _cells(unit: Array, side: int) -> list[Array]:
    """Returns the cells, three int64 [n], that samples at unit float32 [n], 0..1, may read among `side` cells."""
    first = np.floor(unit * (side - 1) - CELL_SLACK)
    last = np.floor(unit * (side - 1) + CELL_SLACK) + 1
    return [np.clip(cell, 0, side - 1).astype(np.int64) for cell in (first, first + 1, last)]


def fill_plane(k: Array, given: Array) -> tuple[Array, float]:
    """Replaces samples of k int32 [C, H, W] outside `given` bool [H, W] by values of little cost: their residuals are 0
    under the predictor that then codes the plane cheapest. Returns (samples, estimated bits saved)."""
    if given.all():
        return k, 0.0
    filled = _candidates((predictor, _filled(k, given, predictor)) for predictor in PREDICTORS)
    bits, _, samples, _ = min(filled, key=lambda found: found[0])
    return samples, choose_predictor(k)[2] - bits


def _filled(k: Array, given: Array, predictor: int) -> Array:
    """Returns `k` with predictions in place of the samples that are not given, by anti-diagonals."""
    channels, height, width = k.shape
    x = k.reshape(channels, -1).T.astype(np.int64)
    i, j = np.nonzero(~given)
    order = np.argsort(i + j, kind="stable")
    i, j = i[order], j[order]
    cell, left, up = i * width + j, i * width + j - 1, (i - 1) * width + j
    west, north = np.where(j > 0, left, up), np.where(i > 0, up, left)
    corner = np.where((i > 0) & (j > 0), up - 1, north)
    ends = np.cumsum(np.bincount(i + j, minlength=1)).tolist()
    for first, end in zip([0, *ends], ends, strict=False):
        if end > first:
            at = slice(first, end)
            x[cell[at]] = PREDICTORS[predictor].predict(x[west[at]], x[north[at]], x[corner[at]]) if cell[first] else 0
    filled: Array = np.clip(x, -1 - MAX_SYMBOL, 1 + MAX_SYMBOL).astype(np.int32)
    return np.ascontiguousarray(filled.T).reshape(k.shape)


# -- the planes section of mode ans (clause 8.6) -----------------------------------------------------------------------


def write_planes(residuals: Sequence[np.ndarray], priors: str, effort: int) -> tuple[bytes, float]:
    """Writes residuals int32 [C, H, W] per plane in the smaller form: (section bytes, sum of R(a) of all channels)."""
    channels = [channel.ravel() for plane in residuals for channel in plane]
    staged = _write_staged(residuals, effort) if priors == "best" and effort > 1 else None
    if staged and 8 * (len(staged) - 1) <= sum(map(entropy_bits, channels)):  # the plain form is not shorter
        return staged, sum(histogram(channel).rate_bits for channel in channels if channel.size)
    plain = encode_channels(channels, priors=priors, effort=effort)
    section = bytes([PLAIN]) + plain.payload
    return staged if staged and len(staged) < len(section) else section, plain.rate_bits


def read_planes(data: bytes, shapes: Sequence[PlaneShape]) -> list[np.ndarray]:
    """Reads residuals int32 [C, H, W] per plane, the inverse of write_planes. shapes: checked against the limits."""
    reader = ByteReader(data)
    form = reader.byte("the form of the planes")
    if form == PLAIN:
        symbols = decode_joined(reader.rest(), [h * w for c, h, w in shapes for _ in range(c)])
        ends = accumulate(c * h * w for c, h, w in shapes)
        return [symbols[end - c * h * w : end].reshape(c, h, w) for (c, h, w), end in zip(shapes, ends, strict=True)]
    if form != STAGED:
        raise UnsupportedFeature(f"form {form} of the planes, expected {PLAIN} or {STAGED}")
    number = _stage_count(shapes)
    counts = [read_class_count(reader, stage) for stage in range(1, number)]
    planes = [np.zeros((c, h * w), np.int32) for c, h, w in shapes]
    read_stages(reader, number, _groups(planes, shapes, counts))
    return [plane.reshape(shape) for plane, shape in zip(planes, shapes, strict=True)]


def _write_staged(residuals: Sequence[np.ndarray], effort: int) -> bytes:
    shapes: list[PlaneShape] = [plane.shape for plane in residuals]
    planes = [plane.reshape(len(plane), -1) for plane in residuals]
    counts, activities = [], [Activity(plane.shape[1]) for plane in planes]
    for stage in range(_stage_count(shapes)):
        first, end = _bounds(stage)
        if stage:
            groups = [
                (plane[first:end], _around(activity.now, shape))
                for plane, activity, shape in zip(planes, activities, shapes, strict=True)
            ]
            counts.append(cheapest_class_count(groups))
        for plane, activity in zip(planes, activities, strict=True):
            activity.add(plane[first:end])
    out = bytearray([STAGED])
    for count in counts:
        put_varint(out, count)
    return coded_stages(out, map(parts_of, _groups(planes, shapes, counts)), effort)


def _stage_count(shapes: Sequence[PlaneShape]) -> int:
    """Returns the number of stages; all planes of a layer have the same number of channels."""
    return max(1, (shapes[0][0] - 1).bit_length())


def _bounds(stage: int) -> tuple[int, int]:
    """Returns the first channels of a stage and of the next stage."""
    return (1 << stage if stage else 0), 2 << stage


def _groups(planes: Sequence[np.ndarray], shapes: Sequence[PlaneShape], counts: Sequence[int]) -> Iterator[list[Group]]:
    """Yields the groups of each stage, one per plane. planes: int32 [C, H * W], read only as far as earlier stages
    reach."""
    activities = [Activity(plane.shape[1]) for plane in planes]
    for stage, count in enumerate((1, *counts)):
        first, end = _bounds(stage)
        groups: list[Group] = []
        for plane, activity, shape in zip(planes, activities, shapes, strict=True):
            places = Places.whole(plane.shape[1])
            if count > 1:
                places = Places.by(activity_classes(_around(activity.now, shape), count), count)
            groups.append((plane[first:end], places))
        yield groups
        if any(later > 1 for later in counts[stage:]):
            for plane, activity in zip(planes, activities, strict=True):
                activity.add(plane[first:end])


def _around(activity: np.ndarray, shape: PlaneShape) -> np.ndarray:
    """Returns activity [H * W] summed over 3 x 3 cells, the border repeated."""
    _, height, width = shape
    cells = activity.reshape(height, width)
    around: np.ndarray = _of_three(_of_three(cells).T).T.ravel()
    return around


def _of_three(cells: np.ndarray) -> np.ndarray:
    """Returns the sum of each cell and its two neighbours in the row, [H, W], the border repeated."""
    sums: np.ndarray = cells.copy(order="K")
    sums[:, 1:] += cells[:, :-1]
    sums[:, :-1] += cells[:, 1:]
    sums[:, 0] += cells[:, 0]
    sums[:, -1] += cells[:, -1]
    return sums
