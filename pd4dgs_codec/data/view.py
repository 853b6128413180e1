"""Posed pictures: the dataset that training and evaluation use; lenses and poses as files describe them, and removal of
lens distortion; for all readers, a dataset of frames: split, times, scene box, depth range and background."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec.data.files import (
    PICTURES,
    WHITE,
    Color,
    check_downscale,
    check_pixels,
    counted,
    files_of,
    image_info,
    is_there,
    last_numbers,
    note,
    read_image,
    read_mask,
    same_shape,
    shrink_image,
    shrink_mask,
)
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.scene import Camera

T = TypeVar("T")

#: Frames per second of pictures that have numbers and no times.
FPS = 30.0
#: Largest |R Rᵀ - I| of a rotation, and | |q| - 1 | of a quaternion: files round to 3 or more decimals.
ROTATION_TOLERANCE = UNIT_TOLERANCE = 1e-3
#: OpenGL's camera looks along -z with y up; OpenCV's along +z with y down.
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
#: Files hold the first and the last time as binary32; their difference may change by SPAN_TOLERANCE.
LARGEST_TIME, SPAN_TOLERANCE = float(np.finfo(np.float32).max), 1e-3
#: Where up follows from the cameras' right vectors, see `up_direction`: the least mean square of these along a second
#: direction (1.8° of turn), the largest share of it along up, and the least cosine of an up vector that tells the sign.
LEVEL_SPREAD, LEVEL_ROLL, UPSIDE = 1e-3, 0.25, 0.1
#: Half the side of D-NeRF's box of initial points (1.3) over the distance of its cameras (4).
BOX_OVER_DISTANCE = 1.3 / 4.0
#: A scene farther from 0 than so many sides of its box is moved: binary32 coordinates would blur it, and the format
#: numbers voxels to 1,024 sides.
FAR_OFF = 100.0
#: Points span a volume if their deviation along every direction is at least this share of the largest.
LEAST_SPREAD = 1e-3
#: A border is one colour if this share of it lies within this many 8-bit levels of its median.
BORDER_SHARE, BORDER_LEVELS = 0.99, 3
#: A lens is scaled to a picture that is larger or smaller by this share; one that is cropped a little is refused.
RESIZED = 0.1
NO_TERM = 1e-30  #: a distortion coefficient up to which it changes no pixel, and by which roots cannot be divided
BAND_PIXELS = 1 << 18  #: resampled at once, some 100 bytes each
USES = 4  #: of a picture at most, such as for training and for testing
#: Views whose pixels count in a fingerprint, evenly spread, and how many such pixels the shorter side has about.
SAMPLED, PER_SIDE = 16, 64
#: Views whose borders decide a background where pixels are read later.
BORDERS = 40
#: Whether readers leave the pixels of views to their accesses, see `pixels_later`.
LATER: ContextVar[bool] = ContextVar("LATER", default=False)


@dataclass(frozen=True, eq=False)
class View:
    """One posed image. The lens is an ideal pinhole: distortion was removed on reading.

    viewmat: float32 [4, 4], world to camera, OpenCV axes (x right, y down, z forward), scene units.
    K: float32 [3, 3], pixels of `image`, pixel centres at +0.5.
    time: 0..1 over the dataset's time range (train and test together).
    image: uint8 [height, width, 3], sRGB as stored.
    mask: bool [height, width], True = valid; None = all valid. Holds the undistortion border, the dataset's own mask
        and, on test views, the covisibility mask.
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

    def project(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Projects points, given by their world coordinates, arrays of one shape. Returns int64 lines and columns of
        the pixels that show them, and bool whether they are before the camera and inside the picture; 0 otherwise."""
        viewmat, K = (np.array(m, np.float32) for m in (self.viewmat, self.K))
        x, y, z = (row[3] + row[0] * x + row[1] * y + row[2] * z for row in viewmat[:3])
        with np.errstate(divide="ignore", invalid="ignore"):
            column, line = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        inside = (z > 0) & (column >= 0) & (column < self.width) & (line >= 0) & (line < self.height)
        line, column = (np.where(inside, part, 0).astype(np.int64) for part in (line, column))
        return line, column, inside


class LaterView(View):
    """A view whose pixels are read at each access to its image, or to its mask if that is not given. read: both."""

    def __init__(self, read: Callable[[], tuple[np.ndarray, np.ndarray | None]] | None = None, **fields: Any) -> None:
        """fields: those of a View; `dataclasses.replace` gives all of them."""
        vars(self).update(fields, read=read)

    def __getattr__(self, name: str) -> Any:
        if name not in ("image", "mask") or self.read is None:
            raise AttributeError(name)
        return self.read()[name == "mask"]


def later_view(read: Callable[[], tuple[np.ndarray, np.ndarray | None]], fields: dict[str, Any]) -> View:
    """The view of these fields, with its pixels within `pixels_later` at each access, else now."""
    if LATER.get():
        return LaterView(read, **fields)
    image, mask = read()
    return View(image=image, mask=mask, **fields)


@contextmanager
def pixels_later() -> Iterator[None]:
    """Within the block, readers check the pictures of long recordings, and leave their pixels to `LaterView`."""
    before = LATER.set(True)
    try:
        yield
    finally:
        LATER.reset(before)


@dataclass(frozen=True)
class Origin:
    """What a dataset was read from, in words for people.

    times: where times come from. fps: frames per second, if times are numbers of frames. points: where the points come
    from. posed: how many pictures of how many have a pose. alpha: whether pictures have alpha. notes: what was assumed
    or left out, a line each.
    """

    times: str = ""
    fps: float | None = None
    points: str = ""
    posed: str = ""
    alpha: bool = False
    notes: tuple[str, ...] = ()


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
    shift: the place in the data's own coordinates that is 0 here. flat_points: the number of points that were read,
        but span no volume, so that `points` is None.
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
    origin: Origin = Origin()
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flat_points: int = 0

    @property
    def camera(self) -> Camera:
        """The default camera: that of the first training view."""
        return self.train[0].camera

    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with the training views: their poses, intrinsics, sizes and times, and a
        sample of their pixels. A name or a folder does not count."""
        digest = hashlib.sha256()
        for view in self.train:
            digest.update(view.viewmat.tobytes() + view.K.tobytes())
            digest.update(repr((view.width, view.height, float(view.time))).encode())
        for view in thinned(self.train, SAMPLED):
            step = max(1, min(view.width, view.height) // PER_SIDE)
            digest.update(view.image[::step, ::step].tobytes())
        return digest.hexdigest()[:16]

    @property
    def place(self) -> str:
        """Where 0 lies in the data's own coordinates, in words; "" if it is their 0."""
        return f"0 is {', '.join(f'{v:.12g}' for v in self.shift)} of the data" if any(self.shift) else ""

    def summary(self) -> list[str]:
        """What was read, a line each: views and pictures, times, colours, start points."""
        views, origin = [*self.train, *self.test], self.origin
        held = [view for view in views if "image" in vars(view)]  # others are read from the cache of video frames
        size = sum(3 * view.width * view.height for view in held) + sum(v.mask.size for v in held if v.mask is not None)
        sizes = sorted({(view.width, view.height) for view in views})
        shown = " to ".join(f"{w}x{h}" for w, h in ([sizes[0], sizes[-1]] if sizes[1:] else sizes))
        where = f"{size / 1e6:.1f} MB in memory" if held else "frames in the cache"
        counts = f"{len(self.train)} to train on, {len(self.test) or 'none'} held out, of {shown}"
        lines = [", ".join(part for part in (f"views: {counts}", origin.posed, where) if part)]
        instants, (start, stop) = len({view.time for view in views}), self.time_range
        rate = f", {origin.fps:g} a second" if origin.fps else ""
        source = f", from {origin.times}" if origin.times else ""
        lines.append(f"times: {instants} instants, {start:.3g} to {stop:.3g} s{rate}{source}")
        masks = [view.mask.mean() for view in self.train if view.mask is not None]
        unseen = f", masks leave out {100 * (len(masks) - sum(masks)) / len(self.train):.0f} % of the pixels"
        color = ",".join(f"{value:.3g}" for value in self.background)
        lines.append(f"colours: {'' if origin.alpha else 'no '}alpha, background {color}{unseen if masks else ''}")
        count = 0 if self.points is None else len(self.points)
        lines.append(f"start points: {count:,}{f' of {origin.points}' if count and origin.points else ''}")
        return lines

    def remarks(self) -> list[str]:
        """Limits of this data for training and evaluation, a line each."""
        remarks = list(self.origin.notes)
        if self.place:
            remarks.append(f"the scene is far from 0 and was moved: {self.place}")
        if self.flat_points:
            remarks.append(f"start points not used: {self.flat_points:,} that span no volume")
        if self.left_out:
            remarks.append(counted("views left out, no valid pixel in the mask", self.left_out))
        if len({view.time for view in self.train}) == 1:
            remarks.append("all training views show one instant: levels 1 and 2 cannot learn motion")
        first = self.train[0].viewmat
        if all(np.array_equal(view.viewmat, first) for view in self.train):
            remarks.append("all training views are from one viewpoint: depth is unknown, other viewpoints look wrong")
        return remarks


def spread(views: Sequence[View], most: int) -> list[View]:
    """Picks at most `most` views, in an order of which every first part is spread over the cameras, time and space:
    next comes, of the cameras that were picked least often, the view farthest from all before it."""
    poses = np.array([view.viewmat for view in views], np.float64).reshape(-1, 4, 4)
    eyes = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    eyes /= max(float(np.ptp(eyes, axis=0).max(initial=0)), 1e-12)
    places = np.column_stack([[view.time for view in views], eyes, poses[:, 2, :3]])
    cameras = np.unique([view.camera_id for view in views], return_inverse=True)[1]
    picked, far, uses = [0], np.full(len(views), np.inf), np.zeros(cameras.max() + 1)
    while len(picked) < min(most, len(views)):
        far = np.minimum(far, np.linalg.norm(places - places[picked[-1]], axis=1))
        far[picked] = -1
        uses[cameras[picked[-1]]] += 1
        allowed = np.where(far >= 0, uses[cameras], np.inf)
        picked.append(int(np.argmax(np.where(allowed == allowed.min(), far, -1))))
    return [views[i] for i in picked]


def thinned(items: Sequence[T], most: int) -> Sequence[T]:
    """Every k-th item from the first on, so that there are at most `most`."""
    return items[:: max(1, -(-len(items) // most))]


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
    """A frame of a dataset before its pixels are read. viewmat: float64 [4, 4] world to camera; time: as stored, None
    if it is not; mask: a picture of the shape of `image` that is black where pixels are not valid."""

    name: str
    camera_id: int
    time: float | None
    viewmat: np.ndarray
    lens: Lens
    image: Path
    mask: Path | None = None


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
    terms = [(2 * i + 1) * c if abs(c) > NO_TERM else 0.0 for i, c in enumerate((1.0, *k))]  # of the derivative, by r^2
    roots = np.roots(terms[::-1])
    real = roots.real[(roots.imag == 0) & (roots.real > 0)]
    return float(np.sqrt(real.min(initial=np.inf)))


@lru_cache(maxsize=1)
def _warp(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """(u, v) float32 [H, W]: the place of each ideal pinhole pixel in the stored image, u -1 where it shows none."""
    places = np.empty((2, lens.height, lens.width), np.float32)
    columns = np.arange(lens.width) + 0.5
    for rows in _bands(lens, 1):
        u, v = np.meshgrid(columns, np.arange(rows.start, rows.stop) + 0.5)
        x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
        with np.errstate(all="ignore"):
            xd, yd, single = distort(x, y, lens)
            u, v = lens.fx * xd + lens.skew * yd + lens.cx, lens.fy * yd + lens.cy
            inside = (u >= 0.5) & (v >= 0.5) & (u <= lens.width - 0.5) & (v <= lens.height - 0.5)
            places[:, rows] = np.where(single & inside, (u, v), -1)
    return places[0], places[1]


def _bands(lens: Lens, k: int) -> Iterator[slice]:
    """Bands of lines of a picture, of whole blocks of k lines, that bound what resampling it takes."""
    step = max(1, BAND_PIXELS // (lens.width * k)) * k
    return (slice(start, min(start + step, lens.height)) for start in range(0, lens.height, step))


def rectify(image: np.ndarray, lens: Lens, k: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(uint8 [H // k, W // k, 3] resampled bilinearly to the ideal pinhole, then the mean of each block of k x k; bool
    [H // k, W // k]: False for blocks with unseen pixels, which are black)."""
    u, v = _warp(lens)
    pictures, masks = [], []
    for rows in _bands(lens, k):
        seen = u[rows] >= 0
        fu, fv = np.where(seen, u[rows] - 0.5, 0), np.where(seen, v[rows] - 0.5, 0)
        u0, v0 = np.minimum(fu.astype(int), lens.width - 2), np.minimum(fv.astype(int), lens.height - 2)
        a, b = (fu - u0)[..., None], (fv - v0)[..., None]
        top = image[v0, u0] * (1 - a) + image[v0, u0 + 1] * a
        bottom = image[v0 + 1, u0] * (1 - a) + image[v0 + 1, u0 + 1] * a
        whole = np.where(seen[..., None], top * (1 - b) + bottom * b + 0.5, 0).astype(np.uint8)
        pictures.append(shrink_image(whole, k))
        masks.append(shrink_mask(seen, k))
    return np.concatenate(pictures), np.concatenate(masks)


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
    lens = frame.lens
    fields = {"viewmat": frame.viewmat.astype(np.float32), "K": lens.matrix(downscale), "time": time}
    fields |= {"width": lens.width // downscale, "height": lens.height // downscale}
    fields |= {"name": frame.name, "camera_id": frame.camera_id}
    return later_view(partial(_pixels, frame, downscale, under), fields)


def _pixels(frame: UnreadView, downscale: int, under: Color | None) -> tuple[np.ndarray, np.ndarray | None]:
    """(image, mask) of a frame, as a View has them."""
    lens, size = frame.lens, (frame.lens.width, frame.lens.height)
    if lens.is_pinhole:
        image = read_image(frame.image, size, downscale=downscale, under=under)
        mask = None if frame.mask is None else read_mask(frame.mask, size, downscale=downscale)
    else:
        check_downscale(size, downscale, str(frame.image))
        image, mask = rectify(read_image(frame.image, size, under=under), lens, downscale)
        if frame.mask is not None:
            valid = np.where(read_mask(frame.mask, size), 255, 0)[..., None].astype(np.uint8)
            whole = rectify(valid, lens)[0][..., 0] == 255  # all pixels between which a place lies
            mask &= shrink_mask(whole, downscale)
    return image, mask


# -- datasets ----------------------------------------------------------------------------------------------------------

Posed = TypeVar("Posed", UnreadView, View)


def held_out(frames: Sequence[T], holdout: int) -> tuple[list[T], list[T]]:
    """(training, test): the i-th frame is a test frame if i % holdout == holdout // 2; none for holdout 0."""
    out = [holdout > 0 and i % holdout == holdout // 2 for i in range(len(frames))]
    return [f for f, o in zip(frames, out, strict=True) if not o], [f for f, o in zip(frames, out, strict=True) if o]


def without_first_camera(folder: Path, frames: Sequence[Posed], holdout: int) -> tuple[list[Posed], list[Posed]]:
    """(training, test): the frames of the first camera are test frames; none for holdout 0."""
    first = min(frame.camera_id for frame in frames) if holdout else None
    train = [frame for frame in frames if frame.camera_id != first]
    if not train:
        raise DataError(f"{folder}: the only camera is held out, expected others to train on or --holdout 0")
    return train, [frame for frame in frames if frame.camera_id == first]


def posed_dataset(
    folder: Path,
    train: Sequence[UnreadView],
    test: Sequence[UnreadView],
    points: np.ndarray | None,
    downscale: int,
    depth: tuple[float, float] | None = None,
    background: Color | None = None,
    box: np.ndarray | None = None,
    *,
    composite: bool = True,
    origin: Origin = Origin(),
) -> Dataset:
    """The dataset of these frames. Those whose picture is missing are left out.

    points: floats [M, 3], or None. depth: near and far, box: floats [2, 3], if known. background: RGB 0..1 of the
    scene, and behind pictures with alpha; None for white if a training picture has alpha, else for the colour of their
    border. composite: False drops alpha (photographs). origin: of the times and points; with fps, the times of the
    frames are numbers of frames. If frames have no times, the last number in the name of their picture is theirs, or
    the place of the name among all names.
    """
    train, test = present(folder, train), present(folder, test, needed=False)
    infos = {frame.image: image_info(frame.image) for frame in (*train, *test)}
    train, test = ([fitted(frame, infos[frame.image][:2]) for frame in split] for split in (train, test))
    frames, under = [*train, *test], (background or WHITE) if composite else None
    files = {frame.image for frame in frames}
    if len(frames) > USES * len(files):
        raise DataError(f"{folder}: {len(frames)} frames of {len(files)} pictures, expected at most {USES} per picture")
    check_pixels(sum(frame.lens.width * frame.lens.height for frame in frames), files, str(folder))
    frames, shape = geometry(frames, points, depth, box)
    alpha = composite and any(infos[frame.image][2] for frame in train)
    if untimed := [frame.name for frame in frames if frame.time is None]:
        if len(untimed) < len(frames):
            origin = replace(origin, notes=(*origin.notes, counted("no time counts, as frames have none", untimed)))
        raw, source = frame_numbers([frame.image for frame in frames])
        origin = replace(origin, times=source, fps=FPS)
    else:
        raw = [float(frame.time or 0.0) for frame in frames]
    times, start, stop = normalised_times([t / (origin.fps or 1.0) for t in raw], str(folder))
    pictures = sum(len(files_of(place, PICTURES)) for place in {frame.image.parent for frame in frames})
    posed = origin.posed or f"{len(files)} of {pictures} pictures have a pose"
    views = [read_view(f, t, downscale, under) for f, t in zip(frames, times, strict=True)]
    bordering = thinned(views[: len(train)], BORDERS if LATER.get() else len(train))
    return Dataset(
        name=folder.resolve().name,
        train=tuple(views[: len(train)]),
        test=tuple(views[len(train) :]),
        background=background or (WHITE if alpha else border_color(bordering)),
        time_range=seconds_range(start, stop),
        origin=replace(origin, posed=posed, alpha=alpha),
        **shape,
    )


def present(folder: Path, frames: Sequence[UnreadView], *, needed: bool = True) -> list[UnreadView]:
    """The frames whose picture is there; the others are noted. Raises DataError if some are `needed` and none is."""
    found = []
    for frame in frames:
        if is_there(frame.image):
            found.append(frame)
        else:
            note("views left out, as their picture is missing", str(frame.image.relative_to(folder)))
    if frames and not found and needed:
        raise DataError(f"{frames[0].image}: image is missing, and so are the others ({len(frames)} in all)")
    return found


def fitted(frame: UnreadView, size: tuple[int, int]) -> UnreadView:
    """The frame with the lens scaled to the size (width, height) of its picture, if the two clearly differ in size and
    not in shape."""
    lens = frame.lens
    x, y = size[0] / lens.width, size[1] / lens.height
    if abs(x - 1) < RESIZED or not same_shape((lens.width, lens.height), size):
        return frame
    found = f"{frame.image.name} of {size[0]}x{size[1]}, not as the camera {lens.width}x{lens.height}"
    note("lens scaled to the size of the picture", found)
    focal, middle = (lens.fx * x, lens.fy * y), (lens.cx * x, lens.cy * y)
    return replace(frame, lens=Lens(*size, *focal, *middle, lens.skew * x, lens.radial, lens.tangential, lens.fisheye))


def frame_numbers(pictures: Sequence[Path]) -> tuple[list[float], str]:
    """The number of each picture's frame, and where it comes from."""
    numbers = last_numbers(pictures)
    if numbers is not None:
        return [float(n) for n in numbers], "the last number of each name"
    rank = {name: float(i) for i, name in enumerate(sorted(set(pictures)))}
    return [rank[name] for name in pictures], "the order of the names"


def geometry(
    frames: Sequence[UnreadView],
    points: np.ndarray | None,
    depth: tuple[float, float] | None,
    box: np.ndarray | None = None,
) -> tuple[list[UnreadView], dict[str, Any]]:
    """(the frames, moved towards 0 if the scene is far from it; the fields of a Dataset that follow from them and the
    points, see `posed_dataset`)."""
    flat = 0 if points is None or spans_volume(points) else len(points)
    if points is not None and (flat or not len(points)):
        points = None
    if box is None:
        box = cameras_box(frames, depth) if points is None else points_box(points)
    side, middle = float((box[1] - box[0]).max()), box.mean(0, np.float64)
    shift = np.zeros(3)
    if np.abs(middle).max() > FAR_OFF * side > 0:  # a round number, so that slightly different data have the same one
        unit = 10.0 ** np.ceil(np.log10(4 * side))
        shift = np.round(middle / unit) * unit
    moved = np.eye(4)
    moved[:3, 3] = shift
    frames = [replace(frame, viewmat=frame.viewmat @ moved) for frame in frames]
    box = (box - shift).astype(np.float32)
    points = None if points is None else (points - shift).astype(np.float32)
    near, far = depth or depth_range([f.viewmat for f in frames], box, points)
    fields = {"points": points, "box": box, "near": near, "far": far, "masked": False, "flat_points": flat}
    up = up_direction([f.viewmat for f in frames])
    return frames, fields | {"up": up, "shift": tuple(shift.tolist())}


def spans_volume(points: np.ndarray) -> bool:
    """Whether points [M, 3] lie neither at one place nor on a line or a plane, so that they say where a scene is."""
    if len(points) < 4:
        return False
    least, _, most = np.linalg.eigvalsh(np.cov(points.T.astype(np.float64)))
    return bool(least > LEAST_SPREAD**2 * most)


def border_pixels(views: Sequence[View]) -> np.ndarray:
    """uint8 [n, 3]: the pixels of the images' borders."""
    images = (view.image for view in views)
    return np.concatenate([e for image in images for e in (image[0], image[-1], image[:, 0], image[:, -1])])


def border_color(views: Sequence[View]) -> tuple[float, float, float]:
    """The background: the colour of the images' borders if they have one colour, else black."""
    edges = border_pixels(views)
    middle = np.median(edges, axis=0)
    same = (np.abs(edges - middle) <= BORDER_LEVELS).all(axis=1).mean() >= BORDER_SHARE
    r, g, b = middle / 255.0 if same else np.zeros(3)
    return float(r), float(g), float(b)


def up_direction(views: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Unit vector, world: up, from world-to-camera matrices [3 or 4, 3 or 4] of level cameras.

    A level camera's right vector r is horizontal, so up is the eigenvector of the least eigenvalue of the mean of
    r rᵀ, with the sign of the cameras' mean up vector; if this one is nearly horizontal, as of cameras that all look
    straight down, the sign that lets them look down. Cameras on a row that face one way have parallel right vectors,
    and cameras that roll have right vectors in all directions. Then, if the second eigenvalue is below LEVEL_SPREAD
    or the least one above LEVEL_ROLL of it, up is the mean of the up vectors.
    """
    right, down, ahead = (np.stack([view[i, :3] for view in views]).astype(np.float64) for i in range(3))
    (least, second, _), axes = np.linalg.eigh(right.T @ right / len(right))
    up, level = -down.mean(axis=0), axes[:, 0]
    if second >= LEVEL_SPREAD and least <= LEVEL_ROLL * second:
        along = up @ level
        up = level * np.sign(along if abs(along) > UPSIDE else -ahead.mean(axis=0) @ level or 1.0)
    norm = np.linalg.norm(up)
    x, y, z = up / norm if norm > 1e-6 else (0.0, 0.0, 1.0)
    return float(x), float(y), float(z)


def normalised_times(raw: Sequence[float], where: str) -> tuple[list[float], float, float]:
    """Times mapped to 0..1 (all 0 if equal), their least and their greatest."""
    low, high = min(raw), max(raw)
    if not max(abs(low), abs(high)) <= LARGEST_TIME:
        raise DataError(f"{where}: times from {low:g} to {high:g}, expected at most {LARGEST_TIME:.2g} in magnitude")
    return [(t - low) / (high - low) if high > low else 0.0 for t in raw], low, high


def seconds_range(start: float, stop: float) -> tuple[float, float]:
    """Seconds at normalised time 0 and 1 of a scene from start to stop; (0, 1) if they are equal.

    Files hold both as binary32. A span that a large start, such as the time of day, would round away begins at 0.
    """
    span = stop - start
    with np.errstate(over="ignore"):
        if not np.float32(span) > 0:
            return 0.0, 1.0
        kept = float(np.float32(stop)) - float(np.float32(start))
    return (start, stop) if abs(kept - span) <= SPAN_TOLERANCE * span else (0.0, span)


def points_box(points: np.ndarray) -> np.ndarray:
    """float64 [2, 3]: the 0.5th to the 99.5th percentile of the points, padded by 10 % of the extent on each side.

    The percentiles keep stray triangulations out; the padding makes room for moving objects, which have no points.
    """
    low, high = np.percentile(points.astype(np.float64), [0.5, 99.5], axis=0)
    pad = np.maximum(0.1 * (high - low), 0.01 * max(float((high - low).max()), 1e-6))
    return np.stack([low - pad, high + pad])


def cameras_box(frames: Sequence[UnreadView], depth: tuple[float, float] | None = None) -> np.ndarray:
    """float64 [2, 3]: a cube around the point nearest to all optical axes, or straight ahead if they are parallel.

    Its half side is 1.3/4 of the median distance, as in D-NeRF, or half of far - near if `depth` is known.
    """
    origins = np.stack([-f.viewmat[:3, :3].T @ f.viewmat[:3, 3] for f in frames])
    axes = np.stack([f.viewmat[2, :3] for f in frames])
    normal = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = normal.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] > 1e-3 * len(frames):
        middle = np.linalg.solve(total, (normal @ origins[:, :, None]).sum(axis=0)[:, 0])
    else:
        apart = float(np.ptp(origins, axis=0).max())
        several = apart > 1e-9 * float(np.abs(origins).max())  # from one viewpoint, any distance is right
        ahead = sum(depth) / 2 if depth else 4.0 * apart if several else 1.0
        middle = origins.mean(axis=0) + ahead * axes.mean(axis=0)
    distance = float(np.median(np.linalg.norm(origins - middle, axis=1)))
    half = (depth[1] - depth[0]) / 2 if depth else BOX_OVER_DISTANCE * distance
    return np.stack([middle - half, middle + half])


def depth_range(views: Sequence[np.ndarray], box: np.ndarray, points: np.ndarray | None) -> tuple[float, float]:
    """(near, far): half the nearest and 1.5 times the farthest depth of the points, else of the box's corners, over
    cameras with the world-to-camera matrices `views` [4, 4]."""
    if points is None:
        points = np.stack(np.meshgrid(*box.T.astype(np.float64)), axis=-1).reshape(-1, 3)
    axes = np.stack([view[2] for view in views])
    depths = points[:: max(1, len(points) // 2000)] @ axes[:, :3].T + axes[:, 3]
    ahead = depths[depths > 0]
    if not len(ahead):
        side = float((box[1] - box[0]).max())
        return 0.01 * side, 100.0 * side
    return depth_bounds(ahead)


def depth_bounds(depths: np.ndarray) -> tuple[float, float]:
    """(near, far): half the nearest and 1.5 times the farthest of some depths, without strays as in `points_box`."""
    near, far = np.percentile(depths, [0.5, 99.5])
    return float(0.5 * near), float(1.5 * far)
