"""The planes of grids: prediction, coded channels, and cells that no anchor reads.

A plane is int32 [C, H, W]. A sample at row i, column j of a channel is predicted from its neighbours W = k[i, j-1],
N = k[i-1, j] and NW = k[i-1, j-1], and the residual k - prediction is coded. In row 0 N and NW are taken equal to W, in
column 0 W and NW are taken equal to N, and at (0, 0) all three are 0 (clause 11.3). All arithmetic is on integers.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, Places
from pd4dgs_codec.entropy.fitting import histogram
from pd4dgs_codec.entropy.priors import BIT, frequency_costs
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, magnitude

PlaneShape = tuple[int, int, int]  #: of a plane: channels, rows, columns
Array = np.ndarray

#: Largest difference in cells between the positions of two renderers, which round coordinates differently.
CELL_SLACK = 0.02
CLASSES = 8  #: of a plane's cells by their activity
EXACT = 1 << 53  #: binary64 holds every integer up to here


#: Predictors by their id in the bitstream: N (on time planes, the previous instant), or the median of W, N and
#: W + N - NW, the LOCO-I predictor (Weinberger, Seroussi, Sapiro 2000).
PREDICTORS = {0: "up", 1: "median"}
UP, MEDIAN = PREDICTORS


def _prediction(predictor: int, w: Array, n: Array, nw: Array) -> Array:
    return n if predictor == UP else _median(w, n, nw)


def _median(w: Array, n: Array, nw: Array) -> Array:
    low, high = np.minimum(w, n), np.maximum(w, n)
    median: Array = low + high
    median -= nw
    np.minimum(median, high, out=median)
    np.maximum(median, low, out=median)
    return median


def residual(predictor: int, k: Array) -> Array:
    """Returns residuals of samples k, both int32 [C, H, W], under a predictor: up to 2 MAX_SYMBOL = K_MAX."""
    w, n, nw = np.zeros_like(k), np.zeros_like(k), np.zeros_like(k)
    w[:, :, 1:], n[:, 1:, :], nw[:, 1:, 1:] = k[:, :, :-1], k[:, :-1, :], k[:, :-1, :-1]
    n[:, 0, :] = nw[:, 0, :] = w[:, 0, :]
    w[:, 1:, 0] = nw[:, 1:, 0] = n[:, 1:, 0]
    r: Array = k - _prediction(predictor, w, n, nw)
    return r


def restore(planes: Sequence[tuple[int, Array]]) -> list[Array]:
    """The inverse of `residual` for many planes at once: [(predictor id, int32 [C, H, W] residuals)] -> int32 samples.

    Raises Malformed if a sample's magnitude exceeds MAX_SYMBOL.
    """
    scanned = iter(_scan([r for predictor, r in planes if predictor == MEDIAN]))
    result = [next(scanned) if predictor == MEDIAN else _summed(r.astype(np.int64)) for predictor, r in planes]
    for (predictor, _), k in zip(planes, result, strict=True):
        if magnitude(k) > MAX_SYMBOL:
            raise Malformed(f"plane sample over {MAX_SYMBOL} in magnitude after predictor {PREDICTORS[predictor]}")
    return [k.astype(np.int32, copy=False) for k in result]


def _summed(r: Array) -> Array:
    """Undoes UP by running sums."""
    r[:, 0, :] = np.cumsum(r[:, 0, :], axis=1)
    return np.cumsum(r, axis=1)


def _scan(planes: Sequence[Array]) -> list[Array]:
    """Undoes the median on int32 [C, H, W] along anti-diagonals: all cells with equal i + j are independent.

    Planes are scanned in groups of one number of channels in which none has more than twice the diagonals of another.
    So there are at most 4 (H + W) steps per number of channels, with the largest plane's H and W, for any number of
    planes, and memory is linear in the cells.
    """
    result = list(planes)
    order = sorted(range(len(planes)), key=lambda i: (len(planes[i]), -sum(planes[i].shape[1:])))
    while order:
        channels, longest = len(planes[order[0]]), sum(planes[order[0]].shape[1:])
        alike = [i for i in order if len(planes[i]) == channels and 2 * sum(planes[i].shape[1:]) >= longest]
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
    """Returns (id, int32 residuals, estimated bits) of the cheapest predictor for samples k int32 [C, H, W]."""
    residuals = [residual(predictor, k) for predictor in (UP, MEDIAN)]
    bits = [_estimated_bits(r) for r in residuals]
    best = int(np.argmin(bits))
    return best, residuals[best], bits[best]


def rate_bits(k: Array) -> float:
    """Returns the sum of R(a) of the residuals of samples k int32 [C, H, W] under the cheapest predictor."""
    _, residuals, _ = choose_predictor(k)
    return sum(histogram(channel.ravel()).rate_bits for channel in residuals)


def _estimated_bits(residuals: Array) -> float:
    """Estimates the bits of residuals int32 [C, H, W]: per channel, the order-0 entropy and log2(n) / 2 per further
    distinct value for its distribution. Entropies are sums of integers, so every machine makes the same choice."""
    costs, distinct, size = 0, 0, residuals[0].size
    for channel in residuals.reshape(len(residuals), -1):
        counts = histogram(channel).counts
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
    filled = [_filled(k, given, predictor) for predictor in (UP, MEDIAN)]
    bits = [_estimated_bits(residual(predictor, x)) for predictor, x in enumerate(filled)]
    return filled[int(np.argmin(bits))], choose_predictor(k)[2] - min(bits)


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
            x[cell[at]] = _prediction(predictor, x[west[at]], x[north[at]], x[corner[at]]) if cell[first] else 0
    return np.ascontiguousarray(x.astype(np.int32).T).reshape(k.shape)


# -- coded channels of mode ans (clauses 8.6 and 8.7) ------------------------------------------------------------------

# The residuals of one cell tend to be large together, so the channels of a plane are split by the *activity* of the
# channels before. All arithmetic is on integers.


def write_planes(residuals: Sequence[Array], writer: ChannelWriter) -> float:
    """Codes residuals int32 [C, H, W] per plane, a batch per stage. Returns the sum of R(a) of all channels."""
    planes = [plane.reshape(len(plane), -1) for plane in residuals]
    for stage in _stages(planes, [plane.shape for plane in residuals]):
        writer.write([part for channels, places in stage for part in places.parts(channels)])
    return sum(histogram(c).rate_bits for plane in planes for c in plane)


def read_planes(reader: ChannelReader, shapes: Sequence[PlaneShape]) -> list[Array]:
    """Decodes residuals int32 [C, H, W] per plane, the inverse of write_planes. shapes: checked against the limits."""
    planes = [np.zeros((c, h * w), np.int32) for c, h, w in shapes]
    for groups in _stages(planes, shapes):
        counts = [count for channels, places in groups for count in places.sizes * len(channels)]
        symbols, end = reader.read(counts), 0
        for channels, places in groups:
            first, end = end, end + channels.size
            places.put(symbols[first:end], channels)
    return [plane.reshape(shape) for plane, shape in zip(planes, shapes, strict=True)]


def _stages(planes: Sequence[Array], shapes: Sequence[PlaneShape]) -> Iterator[list[tuple[Array, Places]]]:
    """Yields (channels int32 [m, H * W], order of their places) per plane that has any, for each stage, which is
    decoded before the next. planes: int32 [C, H * W], read only as far as earlier stages reach."""
    activities = [np.zeros(plane.shape[1]) for plane in planes]
    first, end, most = 0, 2, max((len(plane) for plane in planes), default=0)
    while first < most:
        groups: list[tuple[Array, Places]] = []
        for plane, activity, shape in zip(planes, activities, shapes, strict=True):
            if first < len(plane):
                by = Places.by(activity_classes(_around(activity, shape)), CLASSES) if first else None
                groups.append((plane[first:end], by or Places.whole(plane.shape[1])))
        yield groups
        for plane, activity in zip(planes, activities, strict=True):
            if end < len(plane):
                activity += relative_magnitude(plane[first:end])
        first, end = end, 2 * end


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


def relative_magnitude(residuals: np.ndarray) -> np.ndarray:
    """Returns, at each of n places, the sum over channels int [m, n] of the magnitudes relative to their channel's
    mean, in units of 1/256: integers below 2^8 m n in float64 [n]."""
    total, unit = np.zeros(residuals.shape[1]), residuals.shape[1] << 8
    for channel in residuals:
        shares = np.abs(channel.astype(np.float64))
        divisor = shares.sum() + 1  # below 2^53
        if int(shares.max(initial=0)) * unit < EXACT:
            # for integers below 2^53 the rounded quotient has the right floor, and floats divide faster
            shares *= unit
            shares /= divisor
            total += np.floor(shares, out=shares)
        else:
            total += shares.astype(np.int64) * unit // int(divisor)
    return total


def activity_classes(activity: np.ndarray) -> np.ndarray:
    """Returns classes uint8 [n], 0..CLASSES-1, of about equal size of places by their activity [n]."""
    at = np.arange(1, CLASSES) * len(activity) // CLASSES
    classes = np.zeros(len(activity), np.uint8)
    for bound in np.sort(activity)[at]:  # sort takes a tenth of the time of np.partition; a search of 7, several times
        classes += (activity >= bound).view(np.uint8)
    return classes
