"""Fits the motion of many Gaussians: bases over time, a coefficient of each Gaussian and basis, and what groups share.

The principal components of what changes, weighted by what pictures depend on, become bases over time. A component stays
while it lowers the error by more than its bits are worth. Groups of Gaussians move alike, as a rigid body does: within
one, coefficients are nearly linear in the position, and what is left costs few bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.draw.simd import kernel
from pd4dgs_codec.format.registry import MAX_CHANNELS
from pd4dgs_codec.interchange.pack import Grid
from pd4dgs_codec.kinds.tracks import Groups, Head, Tracks
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL

BASIS_STEP = 2.0**-10  #: of grids without maps; bases are scaled to it
COARSEST = 0.05  #: the largest step of bases, whose mean square over time is 1
BITS = 6  #: about those of a basis at an instant
BIT = 2 * np.log(2)  #: what a bit is worth, in units of the error that a scalar may add
MOST_BASES = MAX_CHANNELS // 4  #: of a head: its map has four channels for each, as rotations have
STRAIGHT = 0.05  #: the share of the allowed error that left-out instants may add
STATIC = 1e-12  #: the least share of a picture's squared error for which anything changes
#: Groups at first, Gaussians among which they start, rounds of finding them by SAMPLE of the Gaussians, and of finding
#: runs of all of them; by so many coefficients.
GROUPS, STARTS, ROUNDS, SAMPLE, RUNS, LEADING = 64, 4096, 10, 16384, 2, 16
#: Bits of another group than the row before, and of a number of a map. Without groups a row's coefficients are coded as
#: differences from the row before, which leaves them this share of their bits.
SWITCH, MAP_BITS, PREDICTED = 7.0, 12.0, 0.75
FINE = 20.0  #: a map is so many times as precise as coefficients of class 0, since all of its group depend on it


@dataclass(frozen=True, eq=False)
class Change:
    """How a head changes. values: float32 [m, c T], m Gaussians at T instants, c components. rows: int64 [n], those of
    them that are meant. weights: float64 [n], `pack.sensitivity`. vectors: float64 [c T, K], its principal components,
    with mean squares over time of 1. coefficients: float32 [n, K] of these. energies: float64 [K], squared errors of
    pictures without each, falling."""

    values: np.ndarray
    rows: np.ndarray
    weights: np.ndarray
    components: int
    vectors: np.ndarray
    coefficients: np.ndarray
    energies: np.ndarray

    @staticmethod
    def of(values: np.ndarray, weights: np.ndarray) -> Change | None:
        """Analyses values float32 [n, c, T], which are 0 at the key instant; returns None if nothing changes."""
        _, components, instants = values.shape
        values = values.reshape(len(values), -1)
        scaled = values * np.sqrt(weights / instants)[:, None].astype(np.float32)
        energies, vectors = np.linalg.eigh((scaled.T @ scaled).astype(np.float64))
        order = np.argsort(-energies)[:MOST_BASES]
        order = order[energies[order] > max(STATIC, 1e-7 * energies.max())]
        found = vectors[:, order] * np.sqrt(instants)
        if not len(order):
            return None
        coefficients = values @ (found / instants).astype(np.float32)
        return Change(values, np.arange(len(values)), weights, components, found, coefficients, energies[order])

    def taken(self, rows: np.ndarray) -> Change:
        """Returns that of some of the Gaussians, bool [n], by the same components."""
        weights, coefficients = self.weights[rows], self.coefficients[rows]
        energies = weights @ np.square(coefficients, dtype=np.float64)
        kept = self.rows[rows]  # a copy of the values would take longer than all else here
        return replace(self, rows=kept, weights=weights, coefficients=coefficients, energies=energies)

    def gains(self, theta: float) -> np.ndarray:
        """Returns by how much each component lowers the error, less what its bits are worth, float64 [K]."""
        added = self.weights[:, None].astype(np.float32) * np.square(self.coefficients)
        bits = bits_of(added, theta).sum(axis=0, dtype=np.float64) + BITS * len(self.vectors)
        return np.asarray(np.maximum(added - theta, 0).sum(axis=0, dtype=np.float64) - BIT * theta * bits)


def bits_of(added: np.ndarray, theta: float) -> np.ndarray:
    """Returns about the bits of scalars that would add so much to the error if they were 0."""
    return np.asarray(0.5 * np.log2(1 + added / theta))


def knots(paths: np.ndarray, times: np.ndarray, key: int, allowed: float) -> np.ndarray:
    """Returns the instants that are kept, int64: the ends, the key, and those at which straight lines between the
    others are farthest off, until the squares of what is left, summed over paths [any, T], are at most `allowed`."""
    found = sorted({0, key, len(times) - 1})
    while len(found) < len(times):
        off = np.square(between(times[found], paths[:, found], times) - paths).sum(axis=0)
        if off.max() <= allowed:
            break
        spans = np.split(np.arange(len(times)), found[1:-1])
        found = sorted({*found, *(int(span[off[span].argmax()]) for span in spans if off[span].max() > allowed)})
    return np.array(found)


def between(known: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolates values [.., known] linearly at times [T]: [.., T]."""
    j = np.clip(np.searchsorted(known, times, side="right") - 1, 0, len(known) - 2)
    f = (times - known[j]) / (known[j + 1] - known[j])
    return np.asarray(values[..., j] * (1 - f) + values[..., j + 1] * f)


def tracks_of(
    changes: Mapping[str, Change],
    chosen: Mapping[str, np.ndarray],
    grid: Grid,
    times: np.ndarray,
    key: int,
    allowed: float,
    grouping: Grouping | None = None,
) -> Tracks:
    """Returns the tracks of components.

    chosen: components by head. times: float64 [T], normalised; key: the key instant. allowed: the squared error that
    leaving out instants may add. grouping: None for tracks without groups.
    """
    paths = [changes[name].vectors[:, own] * np.sqrt(changes[name].energies[own]) for name, own in chosen.items()]
    kept = knots(np.concatenate([path.T.reshape(-1, len(times)) for path in paths]), times, key, allowed)
    largest = {name: changes[name].energies[own].max() for name, own in chosen.items()}
    fine = {name: min(np.sqrt(12 * grid.theta * len(times) / x), COARSEST) for name, x in largest.items()}  # of bases
    step, bases, values = BASIS_STEP, {}, {}
    if grouping:  # centres and maps have no scale of their own
        main = max(largest, key=lambda name: largest[name])
        step = float(np.float32(np.sqrt(fine[main] * grid.steps[main] / FINE)))
    scales = {name: step / x for name, x in fine.items()}
    weights = {name: changes[name].weights * x**2 for name, x in scales.items()}
    for name, own in chosen.items():
        change = changes[name]
        exact = change.vectors[:, own].T.reshape(len(own), change.components, -1)[:, :, kept]
        bases[name] = (np.rint(exact / fine[name]) * step).astype(np.float32)
        whole = between(times[kept], bases[name].astype(np.float64), times).reshape(len(own), -1)
        values[name] = (change.values @ np.linalg.pinv(whole).astype(np.float32))[change.rows].astype(np.float64)
    groups = grouping.fitted(values, weights, grid.theta, step) if grouping else None
    heads = {}
    for name, x in values.items():
        shared = groups.added(name, grouping.places) if grouping and groups and name in groups.maps else np.zeros(1)
        own_step = float(np.float32(grid.steps[name] / scales[name]))
        heads[name] = Head(bases[name], grid.rounded(x - shared, own_step, weights[name]), own_step)
    return Tracks.of(times[kept], step, heads, groups)


# -- groups ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grouping:
    """n Gaussians in Morton order that are in groups. places: float64 [n, 3], see `place`. labels: int64 [n], the
    groups, from 0 without gaps."""

    places: np.ndarray
    labels: np.ndarray

    @staticmethod
    def of(changes: Mapping[str, Change], places: np.ndarray, theta: float) -> Grouping:
        """Groups the Gaussians by the head whose coefficients take most bits at this theta."""
        most, found = 0.0, np.zeros(len(places), np.int64)
        for change in changes.values():
            coefficients = change.coefficients[:, change.gains(theta) > 0]
            bits = bits_of(change.weights[:, None] * np.square(coefficients), theta).sum()
            if bits > most:
                most, found = bits, _labels(coefficients, change.weights, places, theta)
        return Grouping(places, found)

    def taken(self, rows: np.ndarray) -> Grouping:
        """Returns that of some of the Gaussians, bool [n]."""
        return Grouping(self.places[rows], np.unique(self.labels[rows], return_inverse=True)[1])

    def fitted(
        self, values: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray], theta: float, step: float
    ) -> Groups | None:
        """Returns the groups with maps for the heads whose bits they save, multiples of `step`; None if they save none.

        values: coefficients float64 [n, K] by head. weights: float64 [n], what a squared error of one adds to that of
        pictures.
        """
        places, labels = self.places, self.labels
        centres = np.stack([places[labels == m].mean(axis=0) for m in range(labels.max() + 1)])
        span = max(float(np.ptp(centres)), 1e-9)
        order = morton_order(np.rint((centres - centres.min(axis=0)) * (255 / span)).astype(np.int64))
        centres, labels = np.rint(centres[order] / step) * step, np.argsort(order)[labels]
        found = Groups(labels[:, None].astype(np.float32), centres.astype(np.float32), {})
        saved = -SWITCH * np.count_nonzero(np.diff(labels))
        for name, x in values.items():
            maps = np.rint(_maps(x, weights[name], places, labels, centres) / step)
            own = replace(found, maps={name: (maps * step).astype(np.float32)})
            left, cost = (
                bits_of(weights[name][:, None] * np.square(rest), theta).sum()
                for rest in (x - own.added(name, places), x)
            )
            gain = PREDICTED * cost - left - MAP_BITS * maps.size
            if gain > 0 and np.abs(maps).max() <= MAX_SYMBOL:
                found.maps.update(own.maps)
                saved += gain
        return found if saved > 0 and np.abs(centres).max() <= MAX_SYMBOL * step else None


def _maps(
    x: np.ndarray, weights: np.ndarray, places: np.ndarray, labels: np.ndarray, centres: np.ndarray
) -> np.ndarray:
    """Fits coefficients [n, K] linearly to positions [n, 3] within each of M groups: float64 [M, 4, K]."""
    maps = np.zeros((len(centres), 4, x.shape[1]))
    for m, centre in enumerate(centres):
        rows = np.flatnonzero(labels == m)
        if len(rows):
            near = np.concatenate([places[rows] - centre, np.ones((len(rows), 1))], axis=1)
            weighed = near.T * (weights[rows] + 1e-6 * weights[rows].mean() + 1e-30)
            normal = weighed @ near
            normal[range(3), range(3)] += 1e-3 * normal.trace() / 4  # what hardly any Gaussian shows has no slope
            maps[m] = np.linalg.solve(normal + 1e-12 * normal.trace() * np.eye(4), weighed @ x[rows])
    return maps


def _labels(x: np.ndarray, weights: np.ndarray, places: np.ndarray, theta: float) -> np.ndarray:
    """Finds groups within which coefficients [n, K] are nearly linear in the position, in long runs of rows: int64 [n],
    from 0 without gaps."""
    x = x[:, :LEADING].astype(np.float32)
    motion = x / max(float(np.sqrt(np.average(np.square(x).sum(axis=1), weights=weights))), 1e-30)
    near = np.concatenate([places / max(float(places.std()), 1e-30), motion], axis=1).astype(np.float32)
    rows = np.random.default_rng(0).permutation(len(x))[:SAMPLE]
    some, starts, far = near[rows[:STARTS]], [near[rows[0]]], np.full(min(STARTS, len(rows)), np.inf)
    for _ in range(min(GROUPS, len(some)) - 1):
        far = np.minimum(far, np.square(some - starts[-1]).sum(axis=1))
        starts.append(some[far.argmax()])
    labels = np.argmin([np.square(near[rows] - start).sum(axis=1) for start in starts], axis=0)
    for turn in range(ROUNDS + RUNS):
        _, labels = np.unique(labels, return_inverse=True)
        centres = np.stack([places[rows[labels == m]].mean(axis=0) for m in range(labels.max() + 1)])
        maps = _maps(x[rows], weights[rows], places[rows], labels, centres).astype(np.float32)
        if turn == ROUNDS:
            rows = np.arange(len(x))
        own, at, costs = x[rows], places[rows], np.empty((len(rows), len(centres)), np.float32)
        for m, centre in enumerate(centres):
            left = np.square(own - (at - centre).astype(np.float32) @ maps[m, :3] - maps[m, 3])
            if turn >= ROUNDS:
                left = bits_of(left * (weights[rows, None] / theta).astype(np.float32), 1.0)
            costs[:, m] = left.sum(axis=1)
        labels = costs.argmin(axis=1) if turn < ROUNDS else _runs(costs, np.float32(SWITCH))
    return np.unique(labels, return_inverse=True)[1]


@kernel()
def _runs(costs: np.ndarray, switch: np.float32) -> np.ndarray:
    """Returns the labels int64 [n] of least total cost, costs [n, M] plus `switch` wherever a label differs from the
    one before: by dynamic programming."""
    n, groups = costs.shape
    total, came, best = costs[0].copy(), np.zeros((n, groups), np.bool_), np.zeros(n, np.int64)
    for i in range(1, n):
        best[i] = total.argmin()
        least = total[best[i]]
        for m in range(groups):
            came[i, m] = total[m] - least > switch
            total[m] = min(total[m] - least, switch) + costs[i, m]
    labels = np.empty(n, np.int64)
    labels[n - 1] = total.argmin()
    for i in range(n - 1, 0, -1):
        labels[i - 1] = best[i] if came[i, labels[i]] else labels[i]
    return labels
