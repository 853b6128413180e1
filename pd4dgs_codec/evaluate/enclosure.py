"""Where a deformation's residuals lie over whole stretches of time: bounds, not samples.

A quantity over a stretch, u = -1..1, is held as v + s u +- r: a line and how far it may be off (a Taylor model of order
1). Between two instants of its grid a HexPlane's feature at a fixed point is A e(u) f(u) h(u), A the product of its
spatial planes and e, f, h linear in u. Of this cubic c0 + c1 u + c2 u^2 + c3 u^3 the nearest line is
c0 + c2 / 2 + (c1 + 3/4 c3) u, off by |c2| / 2 + |c3| / 4 at most (Chebyshev). Lines pass through linear layers as they
are, and r with |W|. A ReLU whose input keeps its sign passes it or makes it 0; where the input lies in l..h with
l < 0 < h, the output lies in m x .. m (x - l), m = h / (h - l) (Singh et al., "Fast and effective robustness
certification", 2018). Nothing here is normative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import numpy as np

from pd4dgs_codec.evaluate.residuals import bilinear
from pd4dgs_codec.scene import LENGTH_HEADS, TRUNK, Deformation, Network, deformation_unit, plane_sides

#: Added to both ends of every range, relative and absolute, for what binary32 sums lose.
SLACK = 1e-4


class Range(NamedTuple):
    """Where a head's residuals lie over a stretch of time: float32 [n, width]. middle: about in its middle."""

    middle: np.ndarray
    low: np.ndarray
    high: np.ndarray


Ranges = dict[str, Range]  #: by head


@cache
def kernels() -> ModuleType | None:
    """The compiled loops, the same to the bit as those in numpy; None where numba is not installed."""
    try:
        return import_module("pd4dgs_codec.evaluate.reach_kernels")
    except ImportError:
        return None


@dataclass(frozen=True, eq=False)
class Stretch:
    """A quantity over a stretch of time: value + slope u +- radius for u = -1..1, float32 [n, width]."""

    value: np.ndarray
    slope: np.ndarray
    radius: np.ndarray

    @property
    def reach(self) -> np.ndarray:
        """How far the quantity may lie from its value."""
        reach: np.ndarray = np.abs(self.slope) + self.radius
        return reach

    def linear(self, weight: np.ndarray, bias: np.ndarray) -> Stretch:
        """After y = weight x + bias."""
        return Stretch(self.value @ weight.T + bias, self.slope @ weight.T, self.radius @ np.abs(weight).T)

    def relu(self) -> Stretch:
        """After max(x, 0)."""
        if found := kernels():
            return Stretch(*found.relu(self.value, self.slope, self.radius))
        reach = self.reach
        low, high = self.value - reach, self.value + reach
        share = np.where(low >= 0, np.float32(1), np.where(high <= 0, np.float32(0), high / (high - low)))
        shift = np.where((low >= 0) | (high <= 0), np.float32(0), np.float32(-0.5) * share * low)
        return Stretch(share * self.value + shift, share * self.slope, share * self.radius + shift)


def instants(deformation: Deformation) -> np.ndarray:
    """float64 [k]: 0 .. 1 with the instants of all scales. A feature is a cubic in t from each to the next."""
    own = [np.linspace(0.0, 1.0, s["zt"].shape[1]) if s["zt"].shape[1] > 1 else [0.0] for s in deformation.planes]
    return np.unique(np.concatenate([[0.0, 1.0], *own]))


class Enclosure:
    """The residuals of a deformation at fixed points [n, 3] (scene units), over stretches of time. It takes about 10 kB
    a point at 100 instants."""

    def __init__(self, deformation: Deformation, box: np.ndarray, points: np.ndarray):
        self._networks = deformation.networks
        self._unit = deformation_unit(box)
        extent = np.maximum(box[1] - box[0], np.finfo(np.float32).tiny)
        place = np.clip((points - box[0]) / extent, 0.0, 1.0).astype(np.float32)
        self._spatial: list[np.ndarray] = []  # per scale the product of the spatial planes [n, C]
        self._temporal: list[list[np.ndarray]] = []  # per scale the three time planes' columns [T, n, C]
        for scale in deformation.planes:
            at = place * (np.array(plane_sides(scale)[:3], dtype=np.float32) - 1)
            pairs = (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
            self._spatial.append(np.prod([bilinear(scale[name], at[:, a], at[:, b]) for name, a, b in pairs], axis=0))
            self._temporal.append([_columns(scale[name], at[:, a]) for a, name in enumerate(("xt", "yt", "zt"))])

    def ranges(self, start: float, end: float, heads: Sequence[str], rows: np.ndarray | None = None) -> Ranges:
        """The ranges of `heads`, those that there are, at the points `rows` (all if None) over the times start..end,
        which no instant divides. Lengths in scene units; infinite or NaN where the arithmetic overflows."""
        with np.errstate(all="ignore"):
            hidden = _run(self._networks[TRUNK], self._features(start, end, rows)).relu()
            found: Ranges = {}
            for names, network in _together({n: self._networks[n] for n in heads if n in self._networks}):
                x, first = _run(network, hidden), 0
                for name in names:
                    last = first + len(self._networks[name][-1][1])
                    part = Stretch(x.value[:, first:last], x.slope[:, first:last], x.radius[:, first:last])
                    found[name] = _ends(part, self._unit if name in LENGTH_HEADS else np.float32(1))
                    first = last
        return found

    def _features(self, start: float, end: float, rows: np.ndarray | None) -> Stretch:
        """The features [n, sum of C]."""
        parts = []
        for product, lines in zip(self._spatial, self._temporal, strict=True):
            last = len(lines[0]) - 1
            first = min(int((start + end) / 2 * last), max(last - 1, 0))
            middle, half = np.float32((start + end) / 2 * last - first), np.float32((end - start) / 2 * last)
            pairs = [(columns[first], columns[min(first + 1, last)]) for columns in lines]
            parts.append(_cubic(product, pairs, middle, half, rows))
        return Stretch(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))


def _together(networks: dict[str, Network]) -> Iterator[tuple[list[str], Network]]:
    """Networks of one linear layer as one, and the others each."""
    single = [name for name, network in networks.items() if len(network) == 1]
    if single:
        layers = [networks[name][0] for name in single]
        yield single, ((np.concatenate([w for w, _ in layers]), np.concatenate([b for _, b in layers])),)
    for name, network in networks.items():
        if len(network) > 1:
            yield [name], network


def _run(network: Network, x: Stretch) -> Stretch:
    for i, (weight, bias) in enumerate(network):
        x = (x.relu() if i else x).linear(weight, bias)
    return x


def _ends(x: Stretch, scale: np.float32) -> Range:
    reach = x.reach + SLACK * (1 + np.abs(x.value))
    return Range(x.value * scale, (x.value - reach) * scale, (x.value + reach) * scale)


def _columns(plane: np.ndarray, u: np.ndarray) -> np.ndarray:
    """float32 [T, n, C]: each instant's row of a time plane [C, T, W] at the columns u [n]."""
    rows = np.ascontiguousarray(plane.transpose(1, 2, 0))
    j = np.minimum(u.astype(np.intp), max(plane.shape[2] - 2, 0))
    f = (u - j)[:, None]
    columns: np.ndarray = rows[:, j] * (1 - f) + rows[:, np.minimum(j + 1, plane.shape[2] - 1)] * f
    return columns


def _cubic(
    a: np.ndarray,
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    middle: np.float32,
    half: np.float32,
    rows: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(value, slope, radius) of a times three linear functions, see the head of this file: each goes from the first of
    its pair at 0 to the second at 1, over middle - half .. middle + half. float32 [n, C], of which `rows` are taken."""
    if found := kernels():
        at = np.arange(len(a)) if rows is None else rows
        value, slope, radius = found.cubic(a, *pairs[0], *pairs[1], *pairs[2], middle, half, at)
        return value, slope, radius
    every: np.ndarray | slice = slice(None) if rows is None else rows
    a = a[every]
    lines = [(first[every], second[every] - first[every]) for first, second in pairs]
    (e, de), (f, df), (h, dh) = ((first + change * middle, change * half) for first, change in lines)
    second, third = a * (de * df * h + de * f * dh + e * df * dh), a * de * df * dh
    slope = a * (de * f * h + e * df * h + e * f * dh) + np.float32(0.75) * third
    radius = np.float32(0.5) * np.abs(second) + np.float32(0.25) * np.abs(third)
    return a * e * f * h + np.float32(0.5) * second, slope, radius
