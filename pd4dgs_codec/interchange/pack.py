"""Packs explicit Gaussians: the tensors that are coded, their steps, and step classes by what pictures depend on.

A tensor has a step Q, and each Gaussian a step class c that all its tensors share: its values are (m + k 2^c) Q. Steps
and classes come from the derivatives of pictures. With the mean squared error D = sum h q²/12 over all scalars, h the
squared derivative by one and q its step, bits are spent best where every scalar adds the same, theta, to D: the classes
make the Gaussians alike, the steps the tensors.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from pd4dgs_codec.draw.rasteriser import Geometry, backward, composite, project
from pd4dgs_codec.interchange.splats import SH_C0, Splats, picture, quaternions, spread, unit
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import MAX_CLASS, Camera

#: Red, green and blue -> Y, Co, Cg, and back.
YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])
RGB = np.array([[1.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]])
#: Opacities and scales are bounded before their logits and logarithms: a Gaussian thinner than this share of its length
#: looks like a sheet.
LEAST_OPACITY, LEAST_SHARE = 1e-3, np.exp(-6)
FINEST = 0.01  #: the share of Gaussians that would have finer steps than class 0 gives
LONELY = 0.85  #: the share of Gaussians that have a voxel for themselves, at least
DRAWN = 0.3  #: the most by which a symbol is drawn to 0, in steps
CHECKED, ROUNDS, CLOSE = 8, 5, 0.05  #: pictures that measure the error, rounds of matching a PSNR, and how close, dB

T = TypeVar("T")
Tensors = dict[str, np.ndarray]
View = tuple[Camera, Splats]  #: a camera, and Gaussians that it sees
Triple = tuple[float, float, float]


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The products of quaternions [..., 4] wxyz."""
    (w, x, y, z), (i, j, k, l) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [w * i - x * j - y * k - z * l, w * j + x * i + y * l - z * k, w * k - x * l + y * i + z * j,
         w * l + x * k - y * j + z * i], axis=-1,
    )  # fmt: skip


def conjugate(q: np.ndarray) -> np.ndarray:
    """The inverse rotations of unit quaternions [..., 4]."""
    return q * np.array([1, -1, -1, -1], q.dtype)


def _turns() -> tuple[np.ndarray, np.ndarray]:
    """The 24 rotations that carry axes to axes: quaternions [24, 4], and the axis to which each column points."""
    signed = itertools.product(itertools.permutations(np.eye(3)), itertools.product((1.0, -1.0), repeat=3))
    matrices = np.array([np.array(axes).T * signs for axes, signs in signed])
    proper = matrices[np.linalg.det(matrices) > 0]
    return quaternions(proper), np.abs(proper).argmax(axis=1)


TURNS, AXES = _turns()


def turned(quats: np.ndarray, scales: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns, of the 24 descriptions of each ellipsoid, the one with the rotation nearest to `towards` [n, 4] or [4].

    quats: [n, 4] wxyz, unit. scales: [n, 3] along the own axes. Signs of quaternions are the nearest ones, too.
    """
    near = product(conjugate(quats), np.broadcast_to(towards, quats.shape)) @ TURNS.T
    best = np.abs(near).argmax(axis=1)
    sign = np.where(np.take_along_axis(near, best[:, None], 1) < 0, -1.0, 1.0)
    return product(quats, TURNS[best]) * sign, np.take_along_axis(scales, AXES[best], 1)


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
        "color": (splats.sh @ YCOCG.T).reshape(len(scales), -1),
        "opacity": logits(splats.opacities)[:, None],
        "scale": log_scales(scales),
        "rotation": quats[:, 1:],
    }


def quats_of(xyz: np.ndarray) -> np.ndarray:
    """The quaternions [n, 4] wxyz whose x, y and z are given, with w >= 0."""
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return unit(np.concatenate([w, xyz], axis=1))


def splats_of(tensors: Tensors) -> Splats:
    """The inverse of `tensors_of`, float32."""
    parts = (
        tensors["position"],
        quats_of(tensors["rotation"]),
        np.exp(tensors["scale"]),
        1 / (1 + np.exp(-tensors["opacity"][:, 0])),
        tensors["color"].reshape(len(tensors["color"]), -1, 3) @ RGB.T.astype(tensors["color"].dtype),
    )
    return Splats(*(np.ascontiguousarray(part, np.float32) for part in parts))


# -- what pictures depend on -------------------------------------------------------------------------------------------


def sensitivity(pictures: Pictures) -> Tensors:
    """Returns the squared derivatives of pictures by the values of `tensors_of`, float64 [n] by name.

    They are means over a tensor's channels, and sums over the mean of the views' pixels and colours: a squared error e²
    of one value adds h e² to the mean squared error. Estimated by products with random signs, one a view (see
    `model.sensitivity`); with few views, Gaussians that one or two of them see get too coarse steps. All views show the
    same n Gaussians, at one instant or several.
    """
    rng, total = np.random.default_rng(0), Tensors()
    for camera, splats in pictures.views:
        geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
        projected, colors = project(geometry, camera, pictures.near), splats.colors(camera.eye)
        image, transmittance = composite(projected, colors, np.array(pictures.background, np.float32))
        signs = (2 * rng.integers(0, 2, image.shape) - 1).astype(np.float32)
        g = backward(projected, geometry, colors, image, transmittance, signs, np.zeros_like(transmittance))
        slopes = {
            "position": g.geometry.means,
            # squares of a degree's harmonics have a constant sum; Y, Co and Cg change 8/3 of the colours on average
            "color": g.colors * np.float32(SH_C0 * np.sqrt(8 / 3)),
            "opacity": (g.geometry.opacities * splats.opacities * (1 - splats.opacities))[:, None],
            "scale": g.geometry.scales * splats.scales,
            "rotation": product(conjugate(splats.quats), g.geometry.quats)[:, 1:],
        }
        for name, slope in slopes.items():
            mean = np.square(slope, dtype=np.float64).mean(axis=1) / (image.size * len(pictures.views))
            total[name] = total.get(name, 0) + mean
    return total


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

    def error(self, shown: Callable[[int], Splats]) -> float:
        """Returns the mean squared error of shown(i), which stands for the Gaussians of views[i]."""
        errors = []
        for i, ((camera, _), image) in enumerate(zip(self.views, self.images, strict=True)):
            other = picture(shown(i), camera, self.background, self.near)
            errors.append(np.square(other - image, dtype=np.float64).mean())
        return float(np.mean(errors))

    def some(self) -> Pictures:
        """Returns CHECKED of the views, evenly spread, or all if there are fewer."""
        return Pictures(spread(self.views, CHECKED), self.background, self.near)


def matched(build: Callable[[float], tuple[T, float]], psnr: float, theta: float) -> T:
    """Returns what build(theta) makes at the theta where its error, the second result, is `psnr` dB."""
    for _ in range(ROUNDS):
        made, error = build(theta)
        excess = -10 * np.log10(max(error, 1e-20)) - psnr
        if abs(excess) < CLOSE:
            break
        theta *= 10 ** (excess / 10)
    return made


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
    def of(weights: Tensors, channels: dict[str, int], theta: float) -> Grid:
        """Chooses steps and classes. channels: the number of a Gaussian's scalars by tensor."""
        classes, steps = np.zeros(len(weights["color"])), dict[str, float]()
        for turn in range(6):  # steps follow from classes, and classes from steps
            steps = {name: np.sqrt(12 * theta / np.mean(h * 4.0**classes)) for name, h in weights.items()}
            if turn == 5:
                break
            added = sum(h * (channels[name] * steps[name] ** 2 / 12) for name, h in weights.items())
            own = 0.5 * np.log2(theta * sum(channels.values()) / np.maximum(added, 1e-12 * added.max()))
            classes = np.clip(np.rint(own - np.quantile(own, FINEST)), 0, MAX_CLASS)
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

    @property
    def values(self) -> Tensors:
        """The tensors with position, float64 [n, 3], scene units."""
        return self.tensors | {"position": (self.cells + self.tensors["offset"].astype(np.float64)) * self.voxel_size}

    @property
    def splats(self) -> Splats:
        """The decoded Gaussians."""
        return splats_of(self.values)


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
    def of(splats: Splats, weights: Tensors) -> Ordered:
        """Sorts the Gaussians and leaves out those on which no picture depends."""
        rows = np.flatnonzero(sum(weights.values()) > 0)
        at = splats.means[rows].astype(np.float64)
        voxel_size, cells = voxels(at)
        order = morton_order(cells)
        rows, cells = rows[order], cells[order].astype(np.int32)
        return Ordered(
            tensors_of(splats.taken(rows)), {k: h[rows] for k, h in weights.items()}, voxel_size, cells, rows
        )

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
            centre = np.rint(np.median(x, axis=0) / step).astype(np.int32)
            tensors[coded] = grid.rounded(x, step, grid.weights[name] * unit_**2, centre)
            steps[coded], centres[coded] = step, centre
        return Packed(self.voxel_size, self.cells, tensors, steps, centres, grid.classes, self.rows)


def voxels(at: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns (side, a power of two, of voxels that LONELY of the positions [n, 3] have for themselves; distinct voxels
    int64 [n, 3] near them)."""
    size = 2.0 ** np.ceil(np.log2(max(float(np.ptp(at, axis=0).max(initial=0)), 1e-9)))
    keys = np.array([1, 1 << 21, 1 << 42])
    while np.abs(at).max(initial=0) < 1e5 * size:  # far within the range of voxels
        if len(np.unique(np.rint(at / size).astype(np.int64) @ keys)) >= LONELY * len(at):
            break
        size /= 2
    cells, near = np.rint(at / size).astype(np.int64), 1
    taken, first = np.unique(cells @ keys, return_index=True)
    rows = np.setdiff1d(np.arange(len(at)), first)
    while len(rows):  # move the others to the nearest free voxels
        around = np.stack(np.meshgrid(*[np.arange(-near, near + 1)] * 3), axis=-1).reshape(-1, 3)
        own = np.rint(at[rows] / size).astype(np.int64)
        order = np.argsort(np.square(around - (at[rows] / size - own)[:, None]).sum(axis=2), axis=1)
        for choice in range(1, len(around)):
            wanted = own + around[order[:, choice]]
            key, one = np.unique(wanted @ keys, return_index=True)
            one = one[~np.isin(key, taken)]
            cells[rows[one]], taken = wanted[one], np.append(taken, wanted[one] @ keys)
            left = np.delete(np.arange(len(rows)), one)
            rows, own, order = rows[left], own[left], order[left]
        near *= 2
    return float(size), cells


def pack(splats: Splats, pictures: Pictures, psnr: float) -> Packed:
    """Packs still Gaussians for a PSNR, dB, of pictures of all views, each of which shows `splats`. With 50 views or
    more, evenly around the scene, others are about as good."""
    some, source = pictures.some(), Ordered.of(splats, sensitivity(pictures))
    start = 10 ** (-psnr / 10) / (len(source.rows) * sum(source.channels.values()))

    def build(theta: float) -> tuple[Packed, float]:
        packed = source.packed(Grid.of(source.weights, source.channels, theta))
        shown = packed.splats
        return packed, some.error(lambda _: shown)

    return matched(build, psnr, start)
