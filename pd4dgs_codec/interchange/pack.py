"""Packs explicit Gaussians: the tensors that are coded, their steps, and step classes by what pictures depend on.

A tensor has a step Q, and each Gaussian a step class c that all its tensors share: its values are (m + k 2^c) Q. Steps
and classes come from the derivatives of pictures. With the mean squared error D = sum h q²/12 over all scalars, h the
squared derivative by one and q its step, bits are spent best where every scalar adds the same, theta, to D: the classes
make the Gaussians alike, the steps the tensors.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from pd4dgs_codec.draw.rasteriser import Geometry, backward, composite, project
from pd4dgs_codec.interchange.splats import picture, quaternions
from pd4dgs_codec.kinds.splats import SH_C0, YCOCG, Splats, product
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import MAX_CLASS, Camera

#: Opacities and scales are bounded before their logits and logarithms: a Gaussian thinner than this share of its length
#: looks like a sheet.
LEAST_OPACITY, LEAST_SHARE = 1e-3, np.exp(-6)
FINEST = 0.01  #: the share of Gaussians that would have finer steps than class 0 gives
#: The largest steps: of positions in sizes of the Gaussian, and of other tensors. Steps of class 0 are less than the
#: median by SPREAD.
OWN_SIZE, BOUNDS, SPREAD = 4.0, {"opacity": np.array(3.0), "scale": np.array(1.0), "rotation": np.array(0.5)}, 16
LONELY = 0.85  #: the share of Gaussians that have a voxel for themselves, at least
FARTHEST = 2.0**18  #: most voxels between 0 and a position, far within the range of voxels
KEYS = np.array([1, 1 << 21, 1 << 42])  #: of voxels, which are numbers
DRAWN = 0.3  #: the most by which a symbol is drawn to 0, in steps
PROBES = 4  #: random pictures of signs per view
#: Of matching a PSNR: rounds; how close, dB; the least slope, dB for a factor of 10; the farthest from the first guess.
ROUNDS, CLOSE, SLOPE, DECADES = 7, 0.15, 3.0, 4.0

T = TypeVar("T")
Tensors = dict[str, np.ndarray]
View = tuple[Camera, Splats]  #: a camera, and Gaussians that it sees
Triple = tuple[float, float, float]


def conjugate(q: np.ndarray) -> np.ndarray:
    """The inverse rotations of unit quaternions [..., 4]."""
    return np.asarray(q * np.array([1, -1, -1, -1], q.dtype))


def _turns() -> tuple[np.ndarray, np.ndarray]:
    """The 24 rotations that carry axes to axes: quaternions [24, 4], and the axis to which each column points."""
    signed = itertools.product(itertools.permutations(np.eye(3)), itertools.product((1.0, -1.0), repeat=3))
    matrices = np.array([np.array(axes).T * signs for axes, signs in signed])
    proper = matrices[np.linalg.det(matrices) > 0]
    return quaternions(proper), np.abs(proper).argmax(axis=1)


TURNS, AXES = _turns()
HALFWAY = np.cos(np.pi / 8)  #: w of half of the turn between two of them that are neighbours


def turned(quats: np.ndarray, scales: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns, of the 24 descriptions of each ellipsoid, the one with the rotation nearest to `towards` [n, 4] or [4].

    quats: [n, 4] wxyz, unit. scales: [n, 3] along the own axes. Signs of quaternions are the nearest ones, too.
    """
    quats, scales, towards = quats.copy(), scales.copy(), np.broadcast_to(towards, quats.shape)
    far = np.flatnonzero(np.abs(np.einsum("nd,nd->n", quats, towards)) < HALFWAY)  # to others none is nearer
    best = np.abs(product(conjugate(quats[far]), towards[far]) @ TURNS.T).argmax(axis=1)
    quats[far], scales[far] = product(quats[far], TURNS[best]), np.take_along_axis(scales[far], AXES[best], 1)
    quats[np.einsum("nd,nd->n", quats, towards) < 0] *= -1
    return quats, scales


def logits(opacities: np.ndarray) -> np.ndarray:
    """The logits float64 of opacities, which are bounded."""
    p = np.clip(opacities.astype(np.float64), LEAST_OPACITY, 1 - LEAST_OPACITY)
    return np.asarray(np.log(p / (1 - p)))


def log_scales(scales: np.ndarray) -> np.ndarray:
    """The natural logarithms float64 [n, 3] of scales, which are bounded."""
    least = np.maximum(LEAST_SHARE * scales.max(axis=1, keepdims=True), 1e-12)
    return np.asarray(np.log(np.maximum(scales, least).astype(np.float64)))


def tensors_of(splats: Splats) -> Tensors:
    """Returns the values of n Gaussians that are coded, float64: position [n, 3], scene units; color [n, 3 J], Y, Co
    and Cg of each of J harmonics; opacity [n, 1], logits; scale [n, 3], logarithms; rotation [n, 3], x, y and z of the
    quaternion whose w is largest among the 24 that describe the ellipsoid."""
    quats, scales = turned(splats.quats.astype(np.float64), splats.scales, np.array([1.0, 0, 0, 0]))
    return {
        "position": splats.means.astype(np.float64),
        "color": (splats.sh @ YCOCG.T).reshape(len(scales), 3 * splats.sh.shape[1]),
        "opacity": logits(splats.opacities)[:, None],
        "scale": log_scales(scales),
        "rotation": quats[:, 1:],
    }


# -- what pictures depend on -------------------------------------------------------------------------------------------


def sensitivity(pictures: Pictures) -> tuple[Tensors, np.ndarray]:
    """Returns (the squared derivatives of pictures by the values of `tensors_of`, float64 [n] by name; by how much the
    mean squared error grows if one Gaussian alone is missing, float64 [n]).

    Derivatives are means over a tensor's channels, and sums over the mean of the views' pixels and colours: a squared
    error e² of one value adds h e² to the mean squared error. Estimated by products with random signs, one a view (see
    `model.sensitivity`); with few views, Gaussians that one or two of them see get too coarse steps. All views show the
    same n Gaussians, at one instant or several.
    """
    rng, total = np.random.default_rng(0), Tensors()
    for camera, splats in pictures.views:
        geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
        projected, colors = project(geometry, camera, pictures.near), splats.colors(camera.eye)
        image, transmittance = composite(projected, colors, np.array(pictures.background, np.float32))
        for _ in range(PROBES):
            signs = (2 * rng.integers(0, 2, image.shape) - 1).astype(np.float32)
            g = backward(projected, geometry, colors, image, transmittance, signs, np.zeros_like(transmittance))
            slopes = {
                "position": g.geometry.means,
                # squares of a degree's harmonics have a constant sum; Y, Co and Cg change 8/3 of the colours on average
                "color": g.colors * np.float32(SH_C0 * np.sqrt(8 / 3)),
                "opacity": (g.geometry.opacities * splats.opacities * (1 - splats.opacities))[:, None],
                "scale": g.geometry.scales * splats.scales,
                "rotation": g.geometry.quats,  # orthogonal to the quaternion, which leaves three numbers
                "absence": (g.geometry.opacities * splats.opacities)[:, None],
            }
            for name, slope in slopes.items():
                numbers = min(slope.shape[1], 3) * image.size * len(pictures.views) * PROBES
                squares = np.einsum("nc,nc->n", slope, slope, dtype=np.float64)
                total[name] = total.get(name, 0) + squares / numbers
    return total, total.pop("absence")


def absence(pictures: Pictures, kept: np.ndarray, seed: int = 0) -> np.ndarray:
    """Returns by how much the mean squared error of pictures that show only the Gaussians `kept`, bool [n], grows if
    one more leaves them: float64 [n], 0 for the others. seed: of random signs.

    Exact up to the random signs of `sensitivity`, since a picture is linear in the opacity of one Gaussian: |c|² -
    2 c r, c what it adds to the pictures, r what those of `kept` have too much. Where its absence would mend an error,
    c r > 0, this part counts as 0: thousands would leave to mend the same error, and make it far larger.
    """
    rng, rows = np.random.default_rng(seed), np.flatnonzero(kept)
    alone, crossed = np.zeros((2, len(kept)))
    for (camera, splats), truth in zip(pictures.views, pictures.images, strict=True):
        own = splats.taken(rows)
        geometry = Geometry(own.means, own.quats, own.scales, own.opacities)
        projected, colors = project(geometry, camera, pictures.near), np.ascontiguousarray(own.colors(camera.eye))
        image, transmittance = composite(projected, colors, np.array(pictures.background, np.float32))
        signs = (2 * rng.integers(0, 2, image.shape) - 1).astype(np.float32)
        own_signs, own_error = (
            backward(projected, geometry, colors, image, transmittance, g, np.zeros_like(transmittance))
            .geometry.opacities.astype(np.float64) * own.opacities
            for g in (signs, image - truth)
        )  # fmt: skip
        alone[rows] += np.square(own_signs) / (image.size * len(pictures.views))
        crossed[rows] += own_error / (image.size * len(pictures.views))
    return np.asarray(alone + 2 * np.maximum(-crossed, 0))


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures by which errors are measured: of each view, and with what is behind. near: scene units."""

    views: Sequence[View]
    background: Triple = (0.0, 0.0, 0.0)
    near: float = 0.01

    @cached_property
    def images(self) -> list[np.ndarray]:
        """float32 [H, W, 3] of each view."""
        return [picture(splats, camera, self.background, self.near) for camera, splats in self.views]


def matched(build: Callable[[float], tuple[T, float]], theta: float) -> T:
    """Returns what build(theta) makes at the theta where its excess, the second result, in dB, is nearest to 0: by
    secants of dB over the logarithm of theta, within the bracket that is known and DECADES of `theta`."""
    tried, place = list[tuple[float, float, T]](), float(np.log10(theta))
    low, high = place - DECADES, place + DECADES
    for _ in range(ROUNDS):
        made, excess = build(10**place)
        tried.append((place, excess, made))
        if abs(excess) < CLOSE:
            break
        low, high = (max(low, place), high) if excess > 0 else (low, min(high, place))
        (p, e, _), (q, f, _) = tried[-2:] if len(tried) > 1 else ((place + 0.1, excess - 1.5, made), tried[-1])
        slope = (f - e) / (q - p)
        place = q - f / slope if slope < -SLOPE else q + f / 15
        if not low < place < high:
            place = (low + high) / 2
    return min(tried, key=lambda row: abs(row[1]))[2]


# -- quantisation ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grid:
    """The values that n Gaussians' tensors can have. theta: what each scalar may add to the mean squared error.
    weights: `sensitivity`, float64 [n] by tensor. steps: by tensor, of positions in scene units. classes: uint8 [n]."""

    theta: float
    weights: Tensors
    steps: dict[str, float]
    classes: np.ndarray

    @staticmethod
    def of(
        weights: Tensors, channels: dict[str, int], bounds: Tensors, theta: float, given: dict[str, float] | None = None
    ) -> Grid:
        """Chooses steps and classes. channels: the number of a Gaussian's scalars by tensor. bounds: the largest step,
        [n] or one for all, by tensor: derivatives tell nothing about larger errors, which uncover what is hidden.
        given: the steps, of which only classes are chosen."""
        classes, steps = np.zeros(len(weights["color"])), dict[str, float]()
        for turn in range(7):  # steps follow from classes, and classes from steps
            steps = {name: np.sqrt(12 * theta / np.mean(h * 4.0**classes)) for name, h in weights.items()}
            steps |= {name: min(steps[name], np.median(most) / SPREAD) for name, most in bounds.items()}
            steps = given or steps
            if turn == 6:
                break
            added = np.sum([h * (channels[name] * steps[name] ** 2 / 12) for name, h in weights.items()], axis=0)
            own = 0.5 * np.log2(theta * sum(channels.values()) / np.maximum(added, 1e-12 * added.max()))
            own = np.rint(own if given else own - np.quantile(own, FINEST))
            for name, most in bounds.items():
                own = np.minimum(own, np.floor(np.log2(np.maximum(most / steps[name], 1))))
            classes = np.clip(own, 0, MAX_CLASS)
        return Grid(theta, weights, {k: float(np.float32(q)) for k, q in steps.items()}, classes.astype(np.uint8))

    def rounded(self, values: np.ndarray, step: float, weight: np.ndarray, centre: np.ndarray | int = 0) -> np.ndarray:
        """Rounds values [n, C] to (centre + k 2^c) step, float32; the classes are c. weight: squared derivatives [n].

        Symbols k are drawn to 0 by what that saves: if they have the density of Laplace, a step towards 0 saves
        1 / (b ln 2) bits, b the mean magnitude, and a bit is worth 2 ln 2 theta.
        """
        spacing = np.ldexp(1.0, self.classes.astype(np.int64))[:, None]
        exact = (values / step - centre) / spacing
        magnitude, usual = np.abs(exact), np.empty_like(exact)
        for c in np.unique(self.classes):
            usual[self.classes == c] = magnitude[self.classes == c].mean(axis=0) + 0.1
        pull = self.theta / np.maximum(usual * weight[:, None] * np.square(step * spacing), 1e-30)
        k = np.copysign(np.ceil(magnitude - 0.5 - np.minimum(pull, DRAWN)), exact)
        return np.asarray((centre + k * spacing) * step, np.float32)


@dataclass(frozen=True, eq=False)
class Packed:
    """n Gaussians to be coded, in Morton order of their voxels.

    cells: int32 [n, 3], distinct voxels of side voxel_size, scene units. By name and in coding order, tensors: float32
    [n, C], values (m + k 2^c) Q; steps: Q, exact binary32; centres: m, int32 [C]. The names are offset, in voxels, and
    those of `tensors_of` but position. classes: uint8 [n], c. rows: int64 [n], numbers in the source; the others are
    left out.
    """

    voxel_size: float
    cells: np.ndarray
    tensors: Tensors
    steps: dict[str, float]
    centres: dict[str, np.ndarray]
    classes: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True, eq=False)
class Ordered:
    """Gaussians of a source that views see, in Morton order. values: by `tensors_of`; cells, voxel_size, rows: of
    Packed; weights: `sensitivity`."""

    values: Tensors
    weights: Tensors
    voxel_size: float
    cells: np.ndarray
    rows: np.ndarray

    @staticmethod
    def of(
        splats: Splats, weights: Tensors, place: Callable[[np.ndarray], tuple[float, np.ndarray]] | None = None
    ) -> Ordered:
        """Sorts the Gaussians and leaves out those on which no picture depends. place: finds voxels as `voxels` does,
        the default."""
        rows = np.flatnonzero(sum(weights.values()) > 0)
        at = splats.means[rows].astype(np.float64)
        voxel_size, cells = (place or voxels)(at)
        order = morton_order(cells)
        rows, cells = rows[order], cells[order].astype(np.int32)
        return Ordered(
            tensors_of(splats.taken(rows)), {k: h[rows] for k, h in weights.items()}, voxel_size, cells, rows
        )

    def taken(self, rows: np.ndarray) -> Ordered:
        """Returns the Gaussians `rows`, a mask."""
        values, weights = ({k: x[rows] for k, x in part.items()} for part in (self.values, self.weights))
        return replace(self, values=values, weights=weights, cells=self.cells[rows], rows=self.rows[rows])

    def grid(self, theta: float, given: dict[str, float] | None = None) -> Grid:
        """Returns the grid for an error by each scalar. given: its steps."""
        bounds = BOUNDS | {"position": OWN_SIZE * np.exp(self.values["scale"].max(axis=1))}
        return Grid.of(self.weights, self.channels, bounds, theta, given)

    @property
    def channels(self) -> dict[str, int]:
        """The number of a Gaussian's scalars by tensor."""
        return {name: self.values[name].shape[1] for name in self.weights}

    def packed(self, grid: Grid) -> Packed:
        """Rounds the tensors."""
        tensors, steps, centres = Tensors(), dict[str, float](), Tensors()
        for name in ("position", "color", "opacity", "scale", "rotation"):
            x, unit_, coded = self.values[name], 1.0, name
            if name == "position":
                coded, unit_ = "offset", self.voxel_size
                x = x / unit_ - self.cells
            step = float(np.float32(grid.steps[name] / unit_))
            centre = self.centre(coded, x, step)
            tensors[coded] = grid.rounded(x, step, grid.weights[name] * unit_**2, centre)
            steps[coded], centres[coded] = step, centre
        return Packed(self.voxel_size, self.cells, tensors, steps, centres, grid.classes, self.rows)

    def centre(self, name: str, values: np.ndarray, step: float) -> np.ndarray:
        """Returns the value of symbol 0 of each channel of a tensor's values [n, C], int32 [C], in steps."""
        return np.asarray(np.rint(np.median(values, axis=0) / step), np.int32)


def voxels(at: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns (side, a power of two, of voxels that LONELY of the positions [n, 3] have for themselves; distinct voxels
    int64 [n, 3] near them)."""
    far = float(np.abs(at).max(initial=0))
    size = 2.0 ** np.ceil(np.log2(max(float(np.ptp(at, axis=0).max(initial=0)), far / FARTHEST, 1e-9)))
    while far < FARTHEST / 2 * size:
        if len(np.unique(np.rint(at / size).astype(np.int64) @ KEYS)) >= LONELY * len(at):
            break
        size /= 2
    return float(size), cells_of(at, size, np.zeros((0, 3), np.int64))


def cells_of(at: np.ndarray, size: float, others: np.ndarray) -> np.ndarray:
    """Returns distinct voxels of this side near the positions [n, 3], none of them one of `others` [m, 3], int64."""
    own = np.rint(at / size).astype(np.int64)
    cells = own.copy()
    lonely, taken = _first_come(own, others.astype(np.int64) @ KEYS)
    rows = np.flatnonzero(~lonely)
    around = _offsets(1)
    order = np.argsort(np.square(around - (at[rows] / size - own[rows])[:, None]).sum(axis=2), axis=1)
    for choice in range(len(around)):  # the nearest free voxels
        won, taken = _first_come(own[rows] + around[order[:, choice]], taken)
        cells[rows[won]] += around[order[won, choice]]
        rows, order = rows[~won], order[~won]
    _, group, count = np.unique(own[rows] @ KEYS, return_inverse=True, return_counts=True)
    order, stride = np.argsort(group, kind="stable"), count[group]
    tries = np.empty(len(rows), np.int64)
    tries[order] = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    reach = 2
    while len(rows):  # many at one place: each begins with another voxel
        around = _offsets(reach)
        near = np.flatnonzero(tries < len(around))
        if not len(near):
            reach *= 2
            continue
        moved = around[tries[near]]
        won, taken = _first_come(own[rows[near]] + moved, taken)
        cells[rows[near[won]]] += moved[won]
        tries[near] += stride[near]
        left = np.ones(len(rows), bool)
        left[near[won]] = False
        rows, tries, stride = rows[left], tries[left], stride[left]
    return np.asarray(cells)


def _offsets(reach: int) -> np.ndarray:
    """Returns int64 [(2 reach + 1)^3, 3]: voxels around 0, shell by shell, in each the nearest first."""
    grid = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3), axis=-1).reshape(-1, 3)
    return grid[np.lexsort((np.square(grid).sum(axis=1), np.abs(grid).max(axis=1)))]


def _first_come(wanted: np.ndarray, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (bool [m]: whether a row gets the voxel [m, 3] that it wants, the keys that are taken then)."""
    keys, one = np.unique(wanted @ KEYS, return_index=True)
    free = ~np.isin(keys, taken)
    won = np.zeros(len(wanted), bool)
    won[one[free]] = True
    return won, np.append(taken, keys[free])
