"""The probability model of the position coder: neighbour grids, the covariance predictor, adaptive bits.

Everything here is integer arithmetic on values below 2**63, so every machine derives the same probabilities.
The normative text is the docstring of `positions`.
"""

from __future__ import annotations

import numpy as np

from pd4dgs_codec.morton import spread_bits

MIN_NEIGHBOURS = 7  #: a grid serves a node if its 27 cells hold that many other nodes
DENSE_NEIGHBOURS = 5  #: finer grids are built while a node has that many occupied neighbour cells on average
DENSE_FROM = 100  #: ... or while there are fewer nodes than that
PULL_STEPS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 512])
LOG8 = np.array([0] + [(n**8).bit_length() - 1 for n in range(1, 4097)])  #: floor(8 log2 n), LOG8[0] = 0

_UNIT = 256  # one node counted
_LIMIT = 48 * _UNIT  # counts of a context are scaled down to this sum
_PULLS, _SHARPS, _SCALES, _DENSITIES, _GROUPS = 18, 10, 5, 40, 5


class Grid:
    """The nodes of one level as cells of side 2**level voxels, with the occupied cells among each one's 27.

    prefix: int64 [M, 3] cell indices in Morton order, each 0 .. 2**bits - 1.
    """

    def __init__(self, prefix: np.ndarray, level: int, bits: int):
        self.level = level
        count = len(prefix)
        rows, columns = [np.arange(count)], [np.arange(count)]
        shifted = [[spread_bits(np.maximum(prefix[:, a] + d, 0)) << a for d in (-1, 0, 1)] for a in range(3)]
        keys = shifted[0][1] | shifted[1][1] | shifted[2][1]
        inside = [[prefix[:, a] > 0, np.ones(count, bool), prefix[:, a] + 1 < 1 << bits] for a in range(3)]
        for x, y, z in ((i // 9, i // 3 % 3, i % 3) for i in range(13)):  # the other 13 are these mirrored
            wanted = shifted[0][x] | shifted[1][y] | shifted[2][z]
            at = np.minimum(np.searchsorted(keys, wanted), count - 1)
            hit = np.flatnonzero(inside[0][x] & inside[1][y] & inside[2][z] & (keys[at] == wanted))
            rows += [hit, at[hit]]
            columns += [at[hit], hit]
        row, column = np.concatenate(rows), np.concatenate(columns)
        order = np.argsort(row, kind="stable")
        degree = np.bincount(row)
        rank = np.argsort(-degree, kind="stable")
        begin = (np.cumsum(degree) - degree)[rank]
        # Slot k lists the k-th neighbour of every cell that has one, the cells with the most first: 27 dense sums.
        used = [int(np.count_nonzero(degree > k)) for k in range(int(degree.max()))]
        self._slots = [column[order[begin[:m] + k]] for k, m in enumerate(used)]
        self._rank = np.argsort(rank)
        self.is_dense = len(row) - count >= DENSE_NEIGHBOURS * count or count < DENSE_FROM
        self.cell = np.arange(count)  # of each current node; kept up to date by the walk

    def coordinates(self, centres: np.ndarray) -> np.ndarray:
        """Centres in half voxels -> units of 1/512 of a cell's side."""
        return centres << (8 - self.level) if self.level <= 8 else centres >> (self.level - 8)

    def box_sums(self, units: np.ndarray) -> np.ndarray:
        """Sums int64 [cells, 10] of 1, x, y, z, xx, yy, zz, xy, xz, yz over the nodes in each cell's 27 cells.

        They may wrap around 2**64; the moments relative to a node inside the box do not.
        """
        terms = np.empty((len(units), 10), dtype=np.int64)
        terms[:, 0] = 1
        terms[:, 1:4] = units
        np.multiply(units, units, out=terms[:, 4:7])
        terms[:, 7:9] = units[:, :1] * units[:, 1:]
        terms[:, 9] = units[:, 1] * units[:, 2]
        if len(units) > len(self._rank):
            terms = np.add.reduceat(terms, np.flatnonzero(np.diff(self.cell, prepend=-1)), axis=0)
        sums: np.ndarray = terms.take(self._slots[0], axis=0)
        for slot in self._slots[1:]:
            sums[: len(slot)] += terms.take(slot, axis=0)
        return sums.take(self._rank, axis=0)


def _predict(sums: np.ndarray, units: np.ndarray, axis: int, spans: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pull and sharpness of a split: see "Prediction" in `positions`.

    sums int64 [10, n], units int64 [3, n], spans int [3]: log2 of the node's sides in units, before the split.
    """
    others = np.maximum(sums[0] - 1, 1)
    n = sums[0]
    mean, cov = [], {}
    for i in range(3):
        mean.append(((sums[1 + i] - n * units[i]) << 4) // others)
    for slot, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        moment = sums[4 + slot] - units[i] * sums[1 + j] - units[j] * sums[1 + i] + n * (units[i] * units[j])
        value = ((moment << 8) // others - mean[i] * mean[j]) >> 8
        cov[i, j] = cov[j, i] = value + max((1 << 2 * max(int(spans[i]), 0)) >> 3, 1) if i == j else value
    a, b, c = axis, (axis + 1) % 3, (axis + 2) % 3
    adj_a = cov[b, b] * cov[c, c] - cov[b, c] * cov[b, c]
    adj_b = cov[a, c] * cov[b, c] - cov[a, b] * cov[c, c]
    adj_c = cov[a, b] * cov[b, c] - cov[a, c] * cov[b, b]
    det = np.maximum(cov[a, a] * adj_a + cov[a, b] * adj_b + cov[a, c] * adj_c, 1)
    half = max(int(spans[axis]) - 1, 0)
    pull = adj_a * mean[a] + adj_b * mean[b] + adj_c * mean[c]
    size = np.where(n > 1, np.abs(pull) // np.maximum(det >> half, 1), 0)
    return pull > 0, size, (adj_a << (2 * half + 4)) // det


def contexts(grids: list[Grid], prefix: np.ndarray, left: list[int], axis: int) -> tuple[np.ndarray, ...]:
    """Per node: context of the flag "both halves", context of the side, and whether the upper side is expected.

    grids: the last grids built, finest last. prefix: int64 [M, 3]. left: bits still unknown per axis.
    """
    count = len(prefix)
    flag, side = np.zeros(count, np.int64), np.zeros(count, np.int64)
    upper = np.zeros(count, bool)
    centres = (prefix << (np.array(left) + 1)) + (1 << np.array(left))
    todo = np.arange(count)
    for grid in reversed(grids):
        units = grid.coordinates(centres)
        sums = grid.box_sums(units)
        cells = grid.cell[todo]
        served = sums[cells, 0] > MIN_NEIGHBOURS
        if grid is grids[0]:
            served[:] = True
        here, todo = todo[served], todo[~served]
        if len(here):
            box = np.ascontiguousarray(sums[cells[served]].T)
            spans = 9 - grid.level + np.array(left)
            upper[here], size, sharp = _predict(box, np.ascontiguousarray(units[here].T), axis, spans)
            flag[here], side[here] = _classes(box[0] - 1, size, sharp, 3 * grid.level - sum(left), 9 - int(spans[axis]))
        if not len(todo):
            break
    return flag, side, upper


def _classes(others: np.ndarray, size: np.ndarray, sharp: np.ndarray, deep: int, scale: int) -> tuple[np.ndarray, ...]:
    pull = np.searchsorted(PULL_STEPS, size, side="right")
    sharpness = np.searchsorted(1 << np.arange(_SHARPS - 1), sharp, side="right")
    density = np.clip((3 * LOG8[np.minimum(others, 4096)] - 16 * deep) // 12 + 30, 0, _DENSITIES - 1)
    flag = (density * _SHARPS + sharpness) * _GROUPS + np.minimum(pull // 3, _GROUPS - 1)
    return flag, (pull * _SHARPS + sharpness) * _SCALES + min(max(scale, 0), _SCALES - 1)


class AdaptiveBits:
    """Binary probabilities per context, from decaying counts, backed off to two coarser partitions of the contexts."""

    def __init__(self, parent: np.ndarray, grandparent: np.ndarray):
        self._maps = (np.arange(len(parent)), parent, grandparent)
        self._counts = [np.zeros((int(ids.max()) + 1, 2), dtype=np.int64) for ids in self._maps]
        above = np.zeros(len(self._counts[1]), dtype=np.int64)
        above[parent] = grandparent
        self._above = (parent, above, np.zeros(len(self._counts[2]), dtype=np.int64))  # each family's next coarser

    def probabilities(self) -> np.ndarray:
        """P(bit = 1) of every context in 1/65536, rounded to three significant bits of the smaller side; uint16."""
        p = np.full(1, 1 << 15, dtype=np.int64)
        for c, above, weight in zip(self._counts[::-1], self._above[::-1], (1, 16, 16), strict=True):
            p = ((c[:, 1] << 16) + weight * _UNIT * p[above]) // (c[:, 0] + c[:, 1] + weight * _UNIT)
        small = np.clip(np.minimum(p, 65536 - p), 16, None)
        shift = np.searchsorted(1 << np.arange(17), small, side="right") - 3
        small = np.minimum(((small >> shift) << shift) + (1 << shift >> 1), 1 << 15)
        return np.where(p < 1 << 15, small, 65536 - small).astype(np.uint16)

    def update(self, contexts: np.ndarray, bits: np.ndarray) -> None:
        """Count the coded bits, then scale each context that has seen more than 48 down to 48."""
        for counts, ids in zip(self._counts, self._maps, strict=True):
            new = np.bincount(2 * ids[contexts] + bits, minlength=counts.size).reshape(counts.shape)
            counts += _UNIT * new
            total = counts[:, 0] + counts[:, 1]
            full = np.flatnonzero(total > _LIMIT)
            counts[full] = counts[full] * _LIMIT // total[full, None]


def flag_model() -> AdaptiveBits:
    """Contexts (density, sharpness, pull // 3); parents halve density and sharpness, grandparents drop density."""
    index = np.arange(_DENSITIES * _SHARPS * _GROUPS)
    density, sharp, group = index // (_SHARPS * _GROUPS), index // _GROUPS % _SHARPS // 2, index % _GROUPS
    coarse = sharp * _GROUPS + group
    return AdaptiveBits(density // 2 * (_SHARPS // 2 * _GROUPS) + coarse, coarse)


def side_model() -> AdaptiveBits:
    """Contexts (pull, sharpness, scale); parents drop sharpness, grandparents keep the pull alone."""
    index = np.arange(_PULLS * _SHARPS * _SCALES)
    pull = index // (_SHARPS * _SCALES)
    return AdaptiveBits(pull * _SCALES + index % _SCALES, pull)
