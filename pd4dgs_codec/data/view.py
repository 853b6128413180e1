"""Posed pictures: the dataset that training and evaluation use, and lenses and poses as files describe them, removal of
lens distortion, and a frame read as a View."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.files import Color, check_downscale, read_image, shrink_image, shrink_mask
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.scene import Camera

#: Names of left-out views that a remark lists.
REMARKED = 4
#: Largest |R Rᵀ - I| of a rotation, and | |q| - 1 | of a quaternion: files round to 3 or more decimals.
ROTATION_TOLERANCE = UNIT_TOLERANCE = 1e-3
#: OpenGL's camera looks along -z with y up; OpenCV's along +z with y down.
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class View:
    """One posed image. The lens is an ideal pinhole: distortion was removed on reading.

    viewmat: float32 [4, 4], world to camera, OpenCV axes (x right, y down, z forward), scene units.
    K: float32 [3, 3], pixels of `image`, pixel centres at +0.5.
    time: 0..1 over the dataset's time range (train and test together).
    image: uint8 [height, width, 3], sRGB as stored.
    mask: bool [height, width], True = valid; None = all valid. Holds the undistortion border and, on test views,
        the covisibility mask.
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    time: float
    image: np.ndarray
    mask: np.ndarray | None
    name: str
    camera_id: int

    @property
    def camera(self) -> Camera:
        """The camera alone."""
        return Camera(self.viewmat, self.K, self.width, self.height)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A scene's images, split into training and test views, with its geometry.

    points: float32 [M, 3], scene units, or None.
    box: float32 [2, 3], lower and upper corner of the content: normalisation box of the HexPlanes and the
        volume of random initial points.
    near, far: scene units along the optical axis. background: 0..1 per channel. time_range: seconds at normalised
        time 0 and 1, (0, 1) if unknown. up: unit vector, world.
    masked: True if the test masks are covisibility masks. left_out: names of views in neither split, as their masks
        hold no valid pixel.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: np.ndarray | None
    box: np.ndarray
    near: float
    far: float
    background: tuple[float, float, float]
    time_range: tuple[float, float]
    up: tuple[float, float, float]
    masked: bool
    left_out: tuple[str, ...] = ()

    @property
    def camera(self) -> Camera:
        """The default camera: that of the first training view."""
        return self.train[0].camera

    def remarks(self) -> list[str]:
        """Limits of this data for training and evaluation, a line each."""
        remarks = []
        if self.left_out:
            names = ", ".join(self.left_out[:REMARKED]) + (", ..." if len(self.left_out) > REMARKED else "")
            count = f"{len(self.left_out)} of {len(self.train) + len(self.test) + len(self.left_out)} views"
            remarks.append(f"{count} left out, no valid pixel in the mask: {names}")
        if len({view.time for view in self.train}) == 1:
            remarks.append("all training views show one instant: levels 1 and 2 cannot learn motion")
        first = self.train[0].viewmat
        if all(np.array_equal(view.viewmat, first) for view in self.train):
            remarks.append("all training views are from one viewpoint: depth is unknown, other viewpoints look wrong")
        return remarks


# -- lenses and poses --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels of the stored image, pixel centres at +0.5.

    radial, tangential: OpenCV's k1 k2 k3 and p1 p2. fisheye: k1 k2 k3 k4 of OpenCV's fisheye model instead.
    """

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
        """float32 [3, 3] of the undistorted, downscaled image."""
        return downscaled_matrix(np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]]), downscale)


def downscaled_matrix(K: np.ndarray, downscale: int) -> np.ndarray:
    """float32 [3, 3]: the intrinsics of an image 1/downscale as wide and high. As pixel centres lie at +0.5, focal
    lengths and principal point all divide."""
    scaled = K.astype(np.float64)
    scaled[:2] /= downscale
    return scaled.astype(np.float32)


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
    """Raises DataError for a matrix [3, 3] that is not a rotation."""
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
    """float64 [3, 3] of a quaternion wxyz [4] from a file. Raises DataError unless its length is about 1."""
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


def distort(x: np.ndarray, y: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Applies OpenCV's models to normalised pinhole coordinates: (xd, yd, bool: the model is one to one there)."""
    r = np.hypot(x, y)
    if lens.fisheye is not None:
        angle = np.arctan(r)
        scale = np.where(r > 0, angle * _growth(angle, lens.fisheye) / np.where(r > 0, r, 1), 1)
        return x * scale, y * scale, angle < _turning_point(lens.fisheye)
    d, (p1, p2) = _growth(r, lens.radial), lens.tangential
    xd = d * x + 2 * p1 * x * y + p2 * (r * r + 2 * x * x)
    yd = d * y + 2 * p2 * x * y + p1 * (r * r + 2 * y * y)
    return xd, yd, r < _turning_point(lens.radial)


def _growth(r: np.ndarray, k: Sequence[float]) -> np.ndarray:
    """1 + k1 r^2 + k2 r^4 + ..."""
    return np.asarray(np.polyval([*k[::-1], 1.0], r * r))


def _turning_point(k: Sequence[float]) -> float:
    """The least r > 0 at which r times `_growth` stops growing; beyond it, the lens would show points twice."""
    roots = np.roots([(2 * i + 1) * c for i, c in enumerate((1.0, *k))][::-1])  # of the derivative, by r^2
    real = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(np.sqrt(real.min(initial=np.inf)))


@lru_cache(maxsize=8)
def _warp(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v float64 [H, W], the place of each ideal pinhole pixel in the stored image; bool [H, W]: it is valid)."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    with np.errstate(all="ignore"):
        xd, yd, single = distort(x, y, lens)
    u, v = lens.fx * xd + lens.skew * yd + lens.cx, lens.fy * yd + lens.cy
    inside = (u >= 0.5) & (v >= 0.5) & (u <= lens.width - 0.5) & (v <= lens.height - 0.5)
    return u, v, single & inside


def rectify(image: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """(uint8 [H, W, 3] resampled bilinearly to the ideal pinhole; bool [H, W]: False for unseen pixels, black)."""
    u, v, seen = _warp(lens)
    fu, fv = np.where(seen, u, 0.5) - 0.5, np.where(seen, v, 0.5) - 0.5
    u0, v0 = np.minimum(fu.astype(int), lens.width - 2), np.minimum(fv.astype(int), lens.height - 2)
    a, b = (fu - u0)[..., None], (fv - v0)[..., None]
    top = image[v0, u0] * (1 - a) + image[v0, u0 + 1] * a
    bottom = image[v0 + 1, u0] * (1 - a) + image[v0 + 1, u0 + 1] * a
    return np.where(seen[..., None], top * (1 - b) + bottom * b + 0.5, 0).astype(np.uint8), seen


def shrunk_view(view: View, k: int) -> View:
    """The view at 1/k of its size: the mean of each block of k x k pixels, valid where the whole block is; the
    remainder is cropped."""
    if k == 1:
        return view
    image, mask = shrink_image(view.image, k), None if view.mask is None else shrink_mask(view.mask, k)
    size = image.shape[1], image.shape[0]
    return View(view.viewmat, downscaled_matrix(view.K, k), *size, view.time, image, mask, view.name, view.camera_id)


def read_view(frame: UnreadView, time: float, downscale: int, under: Color | None) -> View:
    """The frame with its pixels, undistorted and downscaled. time: normalised. under: as in `read_image`."""
    lens, size = frame.lens, (frame.lens.width, frame.lens.height)
    mask = None
    if lens.is_pinhole:
        image = read_image(frame.image, size, downscale=downscale, under=under)
    else:
        check_downscale(size, downscale, str(frame.image))
        image, seen = rectify(read_image(frame.image, size, under=under), lens)
        image, mask = shrink_image(image, downscale), shrink_mask(seen, downscale)
    height, width = image.shape[:2]
    viewmat = frame.viewmat.astype(np.float32)
    return View(viewmat, lens.matrix(downscale), width, height, time, image, mask, frame.name, frame.camera_id)
