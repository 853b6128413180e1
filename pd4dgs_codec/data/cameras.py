"""Lenses and poses as files describe them, and the geometry every reader shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.files import check_downscale, read_image, shrink_image, shrink_mask
from pd4dgs_codec.data.view import View
from pd4dgs_codec.errors import DataError

#: Largest |R Rᵀ - I| of a pose that still counts as a rotation (files round to 3 or more decimals).
ROTATION_TOLERANCE = 1e-3
#: Quaternions are unit to this.
UNIT_TOLERANCE = 1e-3
#: Of binary32, in which files hold the first and the last time; and by what share of itself a span may change there.
LARGEST_TIME, SPAN_TOLERANCE = float(np.finfo(np.float32).max), 1e-3
#: Angles at which it is looked where a fisheye's polynomial turns back.
FISHEYE_STEPS = 1000
#: Half side of D-NeRF's box of initial points (1.3) over the distance of its cameras (4).
BOX_OVER_DISTANCE = 1.3 / 4.0


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels of the stored image; pixel centres at +0.5; OpenCV distortion k1 k2 k3 and p1 p2, or, if
    fisheye is given, OpenCV's fisheye with its k1 k2 k3 k4."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: tuple[float, float, float, float] | None = None

    @property
    def is_pinhole(self) -> bool:
        """True if the stored image needs no resampling."""
        return not (self.skew or any(self.radial) or any(self.tangential) or self.fisheye is not None)

    def matrix(self, downscale: int = 1) -> np.ndarray:
        """float32 [3, 3] of the undistorted, downscaled image. With centres at +0.5 all four numbers just divide."""
        k = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, downscale]], np.float64) / downscale
        return k.astype(np.float32)


@dataclass(frozen=True, eq=False)
class UnreadView:
    """A frame of a dataset before its pixels are read. viewmat: float64 [4, 4] world to camera; time: as stored."""

    name: str
    camera_id: int
    time: float
    viewmat: np.ndarray
    lens: Lens
    image: Path


def check_rotation(rotation: np.ndarray, where: str) -> None:
    """Refuse a 3x3 that is not a rotation."""
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    determinant = np.linalg.det(rotation)
    if not error <= ROTATION_TOLERANCE or determinant <= 0:
        raise DataError(
            f"{where} is not a rotation: determinant {determinant:.4g}, |R Rᵀ - I| {error:.3g}; "
            f"expected 1 and at most {ROTATION_TOLERANCE:g}"
        )


def rotation_matrix(wxyz: Sequence[float] | np.ndarray) -> np.ndarray:
    """float64 [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, np.float64), -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*w.shape, 3, 3)


def checked_rotation(wxyz: Sequence[float] | np.ndarray, where: str) -> np.ndarray:
    """float64 [3, 3] of a quaternion [4] as files hold them. Raises DataError unless it is about unit."""
    length = float(np.linalg.norm(wxyz))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise DataError(f"{where}: quaternion of length {length:.4g}, expected 1")
    return rotation_matrix(np.asarray(wxyz) / length)


def world_to_camera(rotation: np.ndarray, center: np.ndarray) -> np.ndarray:
    """float64 [4, 4] from the world-to-camera rotation and the camera centre."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return viewmat


def distort(x: np.ndarray, y: np.ndarray, lens: Lens) -> tuple[np.ndarray, ...]:
    """OpenCV's radial-tangential model on normalised coordinates: (xd, yd) and its symmetric
    Jacobian (xx, xy, yy)."""
    (k1, k2, k3), (p1, p2) = lens.radial, lens.tangential
    r = x * x + y * y
    d = 1 + r * (k1 + r * (k2 + r * k3))
    slope = 2 * (k1 + r * (2 * k2 + 3 * k3 * r))  # d changes by slope * x per unit of x
    xd = d * x + 2 * p1 * x * y + p2 * (r + 2 * x * x)
    yd = d * y + 2 * p2 * x * y + p1 * (r + 2 * y * y)
    xx = d + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = d + slope * y * y + 2 * p2 * x + 6 * p1 * y
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return xd, yd, xx, cross, yy


def distort_fisheye(x: np.ndarray, y: np.ndarray, k: tuple[float, float, float, float]) -> tuple[np.ndarray, ...]:
    """OpenCV's fisheye on normalised pinhole coordinates: (xd, yd), and where no other point is as far out."""
    r = np.hypot(x, y)
    angle = np.arctan(r)

    def bent(a: np.ndarray) -> np.ndarray:
        a2 = a * a
        turned: np.ndarray = a * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
        return turned

    grid = np.linspace(0, np.pi / 2, FISHEYE_STEPS)
    falls = np.flatnonzero(np.diff(bent(grid)) <= 0)
    last = grid[falls[0]] if falls.size else np.pi / 2
    scale = np.where(r > 0, bent(angle) / np.where(r > 0, r, 1), 1)
    return x * scale, y * scale, angle < last


def undistort(xd: np.ndarray, yd: np.ndarray, lens: Lens, iterations: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of `distort` by Newton's method on all points at once, started at the distorted point."""
    x, y = np.array(xd, np.float64), np.array(yd, np.float64)
    for _ in range(iterations):
        fx, fy, xx, xy, yy = distort(x, y, lens)
        fx, fy, det = fx - xd, fy - yd, xx * yy - xy * xy
        det = np.where(np.abs(det) < 1e-9, np.inf, det)
        x, y = x - (yy * fx - xy * fy) / det, y - (xx * fy - xy * fx) / det
    return x, y


@lru_cache(maxsize=8)
def _warp(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each pixel of the ideal pinhole image lies in the stored one (u, v float64 [H, W]) and if it is there.

    Far off the axis the polynomial folds back and would show the image twice, so a pixel counts as seen only if the
    inverse leads back to it.
    """
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    with np.errstate(all="ignore"):
        if lens.fisheye is not None:
            xd, yd, single = distort_fisheye(x, y, lens.fisheye)
        else:
            xd, yd, xx, xy, yy = distort(x, y, lens)
            xi, yi = undistort(xd, yd, lens)
            single = (np.hypot(xi - x, yi - y) * lens.fx < 0.01) & (xx * yy - xy * xy > 0)
    u, v = lens.fx * xd + lens.skew * yd + lens.cx, lens.fy * yd + lens.cy
    inside = (u >= 0.5) & (v >= 0.5) & (u <= lens.width - 0.5) & (v <= lens.height - 0.5)
    return u, v, single & inside


def rectify(image: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Resample uint8 [H, W, 3] bilinearly to the ideal pinhole; unseen pixels are black and False in the mask."""
    u, v, seen = _warp(lens)
    fu, fv = np.where(seen, u, 0.5) - 0.5, np.where(seen, v, 0.5) - 0.5
    u0, v0 = np.minimum(fu.astype(int), lens.width - 2), np.minimum(fv.astype(int), lens.height - 2)
    a, b = (fu - u0)[..., None], (fv - v0)[..., None]
    top = image[v0, u0] * (1 - a) + image[v0, u0 + 1] * a
    bottom = image[v0 + 1, u0] * (1 - a) + image[v0 + 1, u0 + 1] * a
    return np.where(seen[..., None], top * (1 - b) + bottom * b + 0.5, 0).astype(np.uint8), seen


def read_view(frame: UnreadView, time: float, downscale: int, *, composite: bool) -> View:
    """Read the frame's pixels and make it a View at normalised time `time`."""
    lens, size = frame.lens, (frame.lens.width, frame.lens.height)
    mask = None
    if lens.is_pinhole:
        image = read_image(frame.image, size, downscale=downscale, composite=composite)
    else:
        check_downscale(size, downscale, str(frame.image))
        image, seen = rectify(read_image(frame.image, size, composite=composite), lens)
        image, mask = shrink_image(image, downscale), shrink_mask(seen, downscale)
    height, width = image.shape[:2]
    viewmat = frame.viewmat.astype(np.float32)
    return View(viewmat, lens.matrix(downscale), width, height, time, image, mask, frame.name, frame.camera_id)


def centers(frames: Sequence[UnreadView]) -> np.ndarray:
    """Camera centres float64 [n, 3], world."""
    return np.stack([-f.viewmat[:3, :3].T @ f.viewmat[:3, 3] for f in frames])


def mean_up(frames: Sequence[UnreadView]) -> tuple[float, float, float]:
    """Unit mean of the cameras' up directions (minus OpenCV's y axis)."""
    up = -np.mean([f.viewmat[1, :3] for f in frames], axis=0)
    norm = np.linalg.norm(up)
    x, y, z = up / norm if norm > 1e-6 else (0.0, 0.0, 1.0)
    return float(x), float(y), float(z)


def normalised_times(raw: Sequence[float], where: str) -> tuple[list[float], float, float]:
    """Times mapped to 0..1 by their least and greatest (all 0 if equal), and those two."""
    low, high = min(raw), max(raw)
    if not max(abs(low), abs(high)) <= LARGEST_TIME:
        raise DataError(f"{where}: times from {low:g} to {high:g}, expected at most {LARGEST_TIME:.2g} in magnitude")
    return [(t - low) / (high - low) if high > low else 0.0 for t in raw], low, high


def seconds_range(start: float, stop: float) -> tuple[float, float]:
    """Seconds at normalised time 0 and 1 of a scene that spans start..stop; (0, 1) if it spans none.

    A span that binary32, as files hold it, would lose behind a large start (the time of day, say) begins at 0 instead.
    """
    span = stop - start
    with np.errstate(over="ignore"):
        if not np.float32(span) > 0:
            return 0.0, 1.0
        kept = float(np.float32(stop)) - float(np.float32(start))
    return (start, stop) if abs(kept - span) <= SPAN_TOLERANCE * span else (0.0, span)


def points_box(points: np.ndarray) -> np.ndarray:
    """float32 [2, 3]: the 0.5th to the 99.5th percentile of the points, padded by 10 % of the extent on each side.

    The percentiles keep stray triangulations out; the padding makes room for what moves and was not triangulated.
    """
    low, high = np.percentile(points.astype(np.float64), [0.5, 99.5], axis=0)
    pad = np.maximum(0.1 * (high - low), 0.01 * max(float((high - low).max()), 1e-6))
    return np.stack([low - pad, high + pad]).astype(np.float32)


def cameras_box(frames: Sequence[UnreadView], depth: tuple[float, float] | None = None) -> np.ndarray:
    """float32 [2, 3]: a cube around the point nearest to all optical axes, in the proportion of D-NeRF's.

    Its half side is 1.3/4 of the median distance, or half of far - near if `depth` is known. Nearly parallel axes have
    no such point; then the cube lies straight ahead.
    """
    origins, axes = centers(frames), np.stack([f.viewmat[2, :3] for f in frames])
    normal = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = normal.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] > 1e-3 * len(frames):
        middle = np.linalg.solve(total, (normal @ origins[:, :, None]).sum(axis=0)[:, 0])
    else:
        ahead = sum(depth) / 2 if depth else max(4.0 * float(np.ptp(origins, axis=0).max()), 1.0)
        middle = origins.mean(axis=0) + ahead * axes.mean(axis=0)
    distance = float(np.median(np.linalg.norm(origins - middle, axis=1)))
    half = (depth[1] - depth[0]) / 2 if depth else BOX_OVER_DISTANCE * distance
    return np.stack([middle - half, middle + half]).astype(np.float32)


def depth_range(views: Sequence[np.ndarray], box: np.ndarray, points: np.ndarray | None) -> tuple[float, float]:
    """(near, far) of cameras, world-to-camera matrices [4, 4]: half the nearest and 1.5 times the farthest depth of the
    points, else of the box's corners."""
    if points is None or not len(points):
        points = np.stack(np.meshgrid(*box.T.astype(np.float64)), axis=-1).reshape(-1, 3)
    axes = np.stack([view[2] for view in views])
    depths = points[:: max(1, len(points) // 2000)] @ axes[:, :3].T + axes[:, 3]
    ahead = depths[depths > 0]
    if not len(ahead):
        return 0.01, 100.0
    near, far = np.percentile(ahead, [0.5, 99.5])
    return float(0.5 * near), float(1.5 * far)
