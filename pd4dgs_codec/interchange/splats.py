"""Explicit Gaussians as in 3D Gaussian splatting: only colour depends on the view direction, by spherical harmonics.

Real harmonics and their signs are those of its reference implementation (Kerbl et al. 2023), as in PLY, SPZ and
KHR_gaussian_splatting. A colour is max(0, 0.5 + sum c_j Y_j(d)), d the unit vector from the eye to the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.scene import Camera

T = TypeVar("T")

MAX_DEGREE = 3
#: Y_0, a constant: the factor between a colour and its first coefficient.
SH_C0 = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians at an instant, float32."""

    means: np.ndarray  #: [N, 3] world, scene units
    quats: np.ndarray  #: [N, 4] wxyz, unit
    scales: np.ndarray  #: [N, 3] standard deviations, scene units
    opacities: np.ndarray  #: [N] 0..1
    sh: np.ndarray  #: [N, (degree + 1)^2, 3] coefficients of red, green and blue

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    def colors(self, eye: np.ndarray) -> np.ndarray:
        """Returns the colours float32 [N, 3] >= 0 seen from `eye` [3], world."""
        basis = harmonics(unit(self.means - eye.astype(np.float32)), self.degree)
        return np.asarray(np.maximum(np.einsum("nj,njc->nc", basis, self.sh) + np.float32(0.5), 0))

    @property
    def base_colors(self) -> np.ndarray:
        """float32 [N, 3] 0..1: the mean colours over all directions."""
        return np.asarray(np.clip(self.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1))

    @property
    def rest(self) -> np.ndarray:
        """float32 [N, 3 ((degree + 1)^2 - 1)]: coefficients from degree 1 on, channel by channel as in files."""
        return np.asarray(self.sh[:, 1:].transpose(0, 2, 1).reshape(len(self.sh), 3 * (self.sh.shape[1] - 1)))

    def taken(self, rows: np.ndarray) -> Splats:
        """Returns the Gaussians `rows`, indices or a mask."""
        return Splats(*(part[rows] for part in vars(self).values()))

    def scaled(self, factor: float) -> Splats:
        """Returns the Gaussians with all lengths multiplied by `factor`."""
        return replace(self, means=self.means * np.float32(factor), scales=self.scales * np.float32(factor))


def picture(splats: Splats, camera: Camera, background: tuple[float, float, float], near: float = 0.01) -> np.ndarray:
    """Draws the Gaussians by our rasteriser, float32 [H, W, 3] in 0..1. near: scene units."""
    colors = splats.colors(camera_eye(camera))
    image, _ = draw(
        splats.means, splats.quats, splats.scales, splats.opacities, colors, camera, background, near_plane=near
    )
    return np.asarray(np.clip(image, 0, 1))


def camera_eye(camera: Camera) -> np.ndarray:
    """Returns the centre of a camera, float64 [3], world."""
    viewmat = camera.viewmat.astype(np.float64)
    return np.asarray(-viewmat[:3, :3].T @ viewmat[:3, 3])


def looking(eye: np.ndarray, ahead: np.ndarray, up: np.ndarray, like: Camera) -> Camera:
    """Moves the camera `like` to `eye` [3], world, and turns it along the unit vector `ahead` [3], with `up` [3] up."""
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:  # straight up or down: any roll will do
        right = np.cross(ahead, np.roll(ahead, 1) + np.array([1e-3, 0, 0]))
    right = unit(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return replace(like, viewmat=viewmat.astype(np.float32))


def spread(items: Sequence[T], count: int) -> tuple[T, ...]:
    """Picks `count` items, evenly spaced in their order, or all if there are fewer."""
    rows = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return tuple(items[i] for i in rows)


def sphere(count: int) -> np.ndarray:
    """float64 [count, 3] unit vectors spread evenly, from +z to -z: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Divides vectors [..., d] by their length; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(vectors.dtype).tiny))


def harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """Evaluates (degree + 1)^2 real harmonics [..., j], degree 0 to 3, at unit vectors [..., 3] in their dtype."""
    x, y, z = np.moveaxis(directions, -1, 0)
    rows = [np.full_like(x, SH_C0)]
    if degree >= 1:
        c = 0.4886025119029199
        rows += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = 1.0925484305920792
        xx, yy, zz = x * x, y * y, z * z
        rows += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -c * x * z, c / 2 * (xx - yy)]
    if degree >= 3:
        rows += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return np.stack(rows, axis=-1).astype(directions.dtype)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Converts rotations [n, 3, 3] to unit quaternions [n, 4] wxyz, dividing by the component of largest magnitude."""
    m = matrices
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    diagonal = np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], axis=1)
    squares = 1 + 2 * diagonal - trace[:, None]  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    squares[:, 0] = 1 + trace
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]  # 4wx, 4wy, 4wz
    d, e, f = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]  # 4xy, 4xz, 4yz
    ww, xx, yy, zz = squares.T
    products = np.array([[ww, a, b, c], [a, xx, d, e], [b, d, yy, f], [c, e, f, zz]])
    return unit(products[squares.argmax(axis=1), :, np.arange(len(m))])


def principal_axes(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (standard deviations [n, 3], rotations [n, 3, 3] with the axes as columns) of covariances [n, 3, 3]. The
    deviations of a covariance that is not finite are NaN."""
    finite = np.isfinite(covariances).all(axis=(1, 2))
    values, axes = np.linalg.eigh(np.where(finite[:, None, None], covariances, np.eye(3)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return np.where(finite[:, None], np.sqrt(np.maximum(values, 0)), np.nan), axes
