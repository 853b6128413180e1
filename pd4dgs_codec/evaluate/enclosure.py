"""Where a deformation's residuals lie over whole stretches of time, by interval arithmetic: bounds, not samples.

Between two instants of its grid a HexPlane's feature at a fixed point is A e(t) f(t) h(t), A the product of its spatial
planes and e, f, h linear in t. Over a stretch of half-width 1 in u, the derivative of that cubic lies within
A (e' f h + e f' h + e f h') +- |A| (2 |e' f' h + e' f h' + e f' h'| + 3 |e' f' h'|), all taken at its middle u = 0.
Such (value, derivative, radius of the derivative) pass through linear layers exactly but for |W| on the radius, and
through a ReLU by whether its input is positive, negative or of either sign on the stretch; the mean value theorem then
encloses each output. Nothing here is normative.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.evaluate.residuals import bilinear
from pd4dgs_codec.scene import LENGTH_HEADS, TRUNK, Deformation, Network, deformation_unit, plane_sides

#: Added to both ends of every range, relative and absolute, for what binary32 sums lose.
SLACK = 1e-4
#: Parts into which the time between two instants is cut: with whole ones the ranges come out some thirty times as wide
#: as what they enclose (trained scenes), with four twice, and each more costs its share of time.
PARTS = 4
#: Points enclosed at once: bounds the memory, about 20 kB a point at 100 instants.
CHUNK = 1024

Ranges = dict[str, tuple[np.ndarray, np.ndarray]]  #: head -> (low, high), float32 [n, width]


@dataclass(frozen=True, eq=False)
class Stretch:
    """A quantity over a stretch of time, u = -1..1: its value at u = 0, the middle of its derivative in u, and how far
    the derivative may lie from that. float32 [n, width]."""

    value: np.ndarray
    slope: np.ndarray
    radius: np.ndarray

    @property
    def reach(self) -> np.ndarray:
        """How far the quantity may move from its middle value."""
        reach: np.ndarray = np.abs(self.slope) + self.radius
        return reach

    def linear(self, weight: np.ndarray, bias: np.ndarray) -> Stretch:
        """After y = weight x + bias."""
        return Stretch(self.value @ weight.T + bias, self.slope @ weight.T, self.radius @ np.abs(weight).T)

    def relu(self) -> Stretch:
        """After max(x, 0)."""
        reach = self.reach
        off, on = self.value + reach <= 0, self.value - reach >= 0
        share = np.where(on, np.float32(1), np.where(off, np.float32(0), np.float32(0.5)))
        either = np.where(on | off, np.float32(0), np.float32(0.5) * np.abs(self.slope))
        return Stretch(np.maximum(self.value, 0), self.slope * share, np.where(off, 0, self.radius) + either)


def time_grid(deformation: Deformation) -> np.ndarray:
    """float64 [k]: 0 .. 1 with the instants of all scales, PARTS stretches from each to the next. A feature is a cubic
    in t on each stretch."""
    instants = [np.linspace(0.0, 1.0, s["zt"].shape[1]) if s["zt"].shape[1] > 1 else [0.0] for s in deformation.planes]
    whole = np.unique(np.concatenate([[0.0, 1.0], *instants]))
    grid: np.ndarray = np.interp(np.arange(PARTS * (len(whole) - 1) + 1) / PARTS, np.arange(len(whole)), whole)
    return grid


def residual_ranges(deformation: Deformation, box: np.ndarray, points: np.ndarray) -> Iterator[list[Ranges]]:
    """Per chunk of CHUNK points [n, 3] (scene units), per stretch of time_grid the Ranges of all heads there.

    Lengths in scene units; an infinite range where the arithmetic overflows.
    """
    unit = deformation_unit(box)
    with np.errstate(all="ignore"):
        for first in range(0, len(points), CHUNK):
            stretches = []
            for features in _features(deformation, box, points[first : first + CHUNK]):
                hidden = _run(deformation.networks[TRUNK], features).relu()
                ranges: Ranges = {}
                for name, network in deformation.networks.items():
                    if name != TRUNK:
                        scale = unit if name in LENGTH_HEADS else np.float32(1)
                        ranges[name] = _ends(_run(network, hidden), scale)
                stretches.append(ranges)
            yield stretches


def _run(network: Network, x: Stretch) -> Stretch:
    for i, (weight, bias) in enumerate(network):
        x = (x.relu() if i else x).linear(weight, bias)
    return x


def _ends(x: Stretch, scale: np.float32) -> tuple[np.ndarray, np.ndarray]:
    reach = x.reach + SLACK * (1 + np.abs(x.value))
    low, high = (x.value - reach) * scale, (x.value + reach) * scale
    return np.nan_to_num(low, nan=-np.inf, neginf=-np.inf), np.nan_to_num(high, nan=np.inf, posinf=np.inf)


def _features(deformation: Deformation, box: np.ndarray, points: np.ndarray) -> Iterator[Stretch]:
    """The features [n, sum of C] of fixed points, per stretch of the time grid."""
    extent = np.maximum(box[1] - box[0], np.finfo(np.float32).tiny)
    place = np.clip((points - box[0]) / extent, 0.0, 1.0).astype(np.float32)
    spatial, temporal = [], []
    for scale in deformation.planes:
        at = place * (np.array(plane_sides(scale)[:3], dtype=np.float32) - 1)
        pairs = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
        spatial.append(np.prod([bilinear(scale[name], at[:, a], at[:, b]) for name, a, b in pairs], axis=0))
        temporal.append([_columns(scale[name], at[:, a]) for a, name in enumerate(("xt", "yt", "zt"))])
    grid = time_grid(deformation)
    for start, end in zip(grid[:-1], grid[1:], strict=True):
        parts = [
            _product(product, [_at_times(rows, start, end) for rows in lines])
            for product, lines in zip(spatial, temporal, strict=True)
        ]
        yield Stretch(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))


def _columns(plane: np.ndarray, u: np.ndarray) -> np.ndarray:
    """float32 [T, n, C]: each instant's row of a time plane [C, T, W] at the columns u [n]."""
    rows = np.ascontiguousarray(plane.transpose(1, 2, 0))
    j = np.minimum(u.astype(np.intp), max(plane.shape[2] - 2, 0))
    f = (u - j)[:, None]
    columns: np.ndarray = rows[:, j] * (1 - f) + rows[:, np.minimum(j + 1, plane.shape[2] - 1)] * f
    return columns


def _at_times(rows: np.ndarray, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(value in the middle of start..end, half of the change over it) of what `rows` [T, n, C] hold, linear there."""
    last = len(rows) - 1
    first = min(int((start + end) / 2 * last), max(last - 1, 0))
    a, change = rows[first], rows[min(first + 1, last)] - rows[first]
    middle, half = (start + end) / 2 * last - first, (end - start) / 2 * last
    return a + change * np.float32(middle), change * np.float32(half)


def _product(a: np.ndarray, lines: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(value, slope, radius) of a times three linear functions, see the head of this file."""
    (e, de), (f, df), (h, dh) = lines
    slope = a * (de * f * h + e * df * h + e * f * dh)
    radius = np.abs(a) * (2 * np.abs(de * df * h + de * f * dh + e * df * dh) + 3 * np.abs(de * df * dh))
    return a * e * f * h, slope, radius
