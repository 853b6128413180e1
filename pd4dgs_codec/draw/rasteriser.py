"""Gaussians to pictures and the gradient back, on the CPU: plain functions over numpy arrays around the numba kernels.

`draw` is for those who only look. Training takes the stages one by one: `project`, `composite`, `backward`; one set of
kernels serves both. Conventions of arrays as in `draw`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pd4dgs_codec import threads
from pd4dgs_codec.draw import binning, kernels, projection
from pd4dgs_codec.draw.checks import check_camera, check_colours, check_limits, check_shape
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.scene import Camera

CHANNELS = 3  #: colour channels drawn per pass
CHUNKS_PER_THREAD = 4  #: of the depth order while binning
MAX_COUNT = 2**31  #: of Gaussians, and of pairs of a Gaussian and a tile


class Geometry(NamedTuple):
    """N Gaussians but for their colours, as `draw` takes them: float32, C-contiguous."""

    means: np.ndarray  #: [N, 3]
    quats: np.ndarray  #: [N, 4]
    scales: np.ndarray  #: [N, 3]
    opacities: np.ndarray  #: [N]


@dataclass(frozen=True)
class Settings:
    """What does not take part in differentiation; see `draw`. depth: append each Gaussian's depth as a last colour."""

    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0
    depth: bool = False


@dataclass(eq=False)
class _View:
    """One camera's Gaussians, projected and binned; the shapes are those of the kernels."""

    camera: np.ndarray
    geom: np.ndarray
    first: np.ndarray
    items: np.ndarray
    slot_of: np.ndarray
    starts: np.ndarray
    colors: np.ndarray = field(init=False)  #: [N, D padded to a multiple of CHANNELS]


@dataclass(eq=False)
class Projected:
    """N Gaussians before C cameras of one size, zeros where a Gaussian is skipped; lengths in pixels."""

    width: int
    height: int
    settings: Settings
    radii: np.ndarray  #: int32 [C, N, 2] half extents
    means2d: np.ndarray  #: float32 [C, N, 2]
    depths: np.ndarray  #: float32 [C, N], scene units
    conics: np.ndarray  #: float32 [C, N, 3], upper triangle of the inverse covariance
    views: list[_View]


@dataclass(eq=False)
class Gradients:
    """Of a loss, float32, each of the shape of what `project` and `composite` took or gave."""

    geometry: Geometry
    colors: np.ndarray
    means2d: np.ndarray


def draw(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    camera: Camera,
    background: Sequence[float] | np.ndarray | None = None,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    radius_clip: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """The picture of N Gaussians, float32 [H, W, D], and its alpha, float32 [H, W] in 0..1.

    means      [N, 3] world, scene units.
    quats      [N, 4] rotations wxyz, not necessarily unit; a zero quaternion is the identity.
    scales     [N, 3] standard deviations, scene units (the sign does not matter).
    opacities  [N] in 0..1; not above 1/255, or not finite: the Gaussian is skipped.
    colors     [N, D], D >= 1. background: D numbers, None for black.
    near_plane, far_plane: Gaussians with camera z outside (near, far] are skipped, scene units.
    eps2d: added to the diagonal of the covariance in the image, square pixels.
    radius_clip: Gaussians whose extent is at most this are skipped, pixels.

    Arrays are of any float type and drawn in float32. A Gaussian with NaN or infinity in its position, rotation or
    scale is skipped. Raises RenderError for wrong shapes, its kind NotFinite for colours.
    """
    _check_floats("means", means, None, 3)
    n = len(means)
    _check_floats("quats", quats, n, 4)
    _check_floats("scales", scales, n, 3)
    _check_floats("opacities", opacities, n)
    _check_floats("colors", colors, n, None)
    channels = colors.shape[1]
    if channels < 1:
        raise RenderError("colors has 0 channels, expected at least 1")
    behind = np.zeros((1, channels), np.float32) if background is None else np.array([background], np.float32)
    check_shape("background", behind.shape[1:], (channels,))
    _check_floats("viewmat", camera.viewmat, 4, 4)
    _check_floats("K", camera.K, 3, 3)
    check_camera(camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height)
    check_limits(near_plane, far_plane, eps2d, radius_clip)
    geometry = Geometry(*(np.ascontiguousarray(a, np.float32) for a in (means, quats, scales, opacities)))
    colors = np.ascontiguousarray(colors, np.float32)
    check_colours("colors", float(colors.sum()))
    check_colours("background", float(behind.sum()))
    projected = project(geometry, [camera], Settings(near_plane, far_plane, eps2d, radius_clip))
    pictures, transmittances = composite(projected, colors, behind)
    return pictures[0], 1.0 - transmittances[0]


def project(geometry: Geometry, cameras: Sequence[Camera], settings: Settings) -> Projected:
    """Where the Gaussians lie in the pictures of `cameras`, at least one and all of one size, and in which tiles."""
    n, count = len(geometry.means), len(cameras)
    if n >= MAX_COUNT:
        raise RenderError(f"{n} Gaussians, expected fewer than 2^31")
    width, height = cameras[0].width, cameras[0].height
    radii, means2d = np.empty((count, n, 2), np.int32), np.empty((count, n, 2), np.float32)
    depths, conics = np.empty((count, n), np.float32), np.empty((count, n, 3), np.float32)
    result = Projected(width, height, settings, radii, means2d, depths, conics, [])
    for c, camera in enumerate(cameras):
        packed, filled = _pack_camera(camera), (radii[c], means2d[c], depths[c], conics[c])
        visible, geom, rects = np.empty(n, np.bool_), np.empty((n, projection.GEOM_COLUMNS)), np.empty((n, 4), np.int32)
        limits = (settings.near, settings.far, settings.eps2d, settings.radius_clip)
        projection.project(*geometry, packed, (width, height), limits, visible, geom, rects, *filled)
        result.views.append(_View(packed, geom, *_bin(visible, depths[c], rects, width, height)))
    return result


def composite(
    projected: Projected, colors: np.ndarray, backgrounds: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(pictures float32 [C, H, W, D], transmittances float32 [C, H, W] = 1 - alpha); D counts the depth, if drawn.

    colors: float32 [N, D] for all cameras or [C, N, D], contiguous; backgrounds: float32 [C, D], depth left out.
    """
    depth, count = projected.settings.depth, len(projected.views)
    channels = colors.shape[-1] + depth
    pictures = np.empty((count, projected.height, projected.width, channels), np.float32)
    transmittances = np.empty((count, projected.height, projected.width), np.float32)
    for c, view in enumerate(projected.views):
        view.colors = _pad_channels(_of_camera(colors, c), projected.depths[c] if depth else None)
        background = np.zeros(view.colors.shape[1], np.float32)
        if backgrounds is not None:
            background[: backgrounds.shape[1]] = backgrounds[c]
        for channel in range(0, channels, CHANNELS):
            kernels.composite(
                view.items, view.starts, view.geom, view.colors, channel, background, pictures[c], transmittances[c]
            )
    return pictures, transmittances


def backward(
    projected: Projected,
    geometry: Geometry,
    colors: np.ndarray,
    pictures: np.ndarray,
    transmittances: np.ndarray,
    g_pictures: np.ndarray,
    g_alphas: np.ndarray,
) -> Gradients:
    """The gradient of a loss from g_pictures [C, H, W, D] and g_alphas [C, H, W], its derivatives by what `composite`
    gave, float32 and contiguous. Everything else as it was there."""
    zeros = Geometry(*(np.zeros_like(a) for a in geometry))
    result = Gradients(zeros, np.zeros_like(colors), np.zeros_like(projected.means2d))
    depth_column = projection.SLOT_GEOMETRY + colors.shape[-1] if projected.settings.depth else -1
    for c, view in enumerate(projected.views):
        slots = np.empty((view.items.size, projection.SLOT_GEOMETRY + view.colors.shape[1]), np.float32)
        for channel in range(0, pictures.shape[-1], CHANNELS):
            kernels.composite_backward(
                view.items, view.slot_of, view.starts, view.geom, view.colors, channel,
                pictures[c], transmittances[c], g_pictures[c], g_alphas[c], slots,
            )  # fmt: skip
        projection.project_backward(
            *geometry, view.camera, view.geom, view.first, slots, depth_column,
            *result.geometry, _of_camera(result.colors, c), result.means2d[c],
        )  # fmt: skip
    return result


def _check_floats(name: str, array: np.ndarray, *shape: int | None) -> None:
    """An array of floats whose shape is `shape`; None in it is any size."""
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise RenderError(f"{name} is {found}, expected an array of floats")
    check_shape(name, array.shape, shape)


def _pack_camera(camera: Camera) -> np.ndarray:
    """float64 [20]: R, t, fx, fy, cx, cy and the range of x/z, y/z inside J (gsplat: 1.3 x the field of view)."""
    viewmat, K = (np.asarray(a, np.float64) for a in (camera.viewmat, camera.K))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    low_x, high_x = -cx / fx - margin_x, (camera.width - cx) / fx + margin_x
    low_y, high_y = -cy / fy - margin_y, (camera.height - cy) / fy + margin_y
    return np.array([*viewmat[:3, :3].ravel(), *viewmat[:3, 3], fx, fy, cx, cy, low_x, high_x, low_y, high_y])


def _bin(
    visible: np.ndarray, depths: np.ndarray, rects: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(first, items, slot_of, starts) of `binning`: the Gaussians of each tile, front to back."""
    order = binning.sort(visible, depths)
    columns, rows = -(-width // projection.TILE_WIDTH), -(-height // projection.TILE_HEIGHT)
    counts = np.empty((CHUNKS_PER_THREAD * threads.kernel_threads(), columns * rows), np.int64)
    starts, first = np.empty(columns * rows + 1, np.int64), np.empty(len(visible) + 1, np.int64)
    binning.count_tiles(order, rects, columns, counts)
    binning.offsets(rects, counts, starts, first)
    if starts[-1] >= MAX_COUNT:
        raise RenderError(f"{starts[-1]} pairs of a Gaussian and a tile, expected fewer than 2^31")
    items, slot_of = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    binning.fill_tiles(order, rects, columns, counts, first, items, slot_of)
    return first, items, slot_of, starts


def _pad_channels(colors: np.ndarray, depths: np.ndarray | None) -> np.ndarray:
    """Colours (and depth) as float32 [N, D'], D' a multiple of CHANNELS; the input itself if nothing is to be added."""
    n, channels = colors.shape
    total = channels + (depths is not None)
    padded = -(-total // CHANNELS) * CHANNELS
    if padded == channels:
        return colors
    result = np.zeros((n, padded), np.float32)
    result[:, :channels] = colors
    if depths is not None:
        result[:, channels] = depths
    return result


def _of_camera(array: np.ndarray, c: int) -> np.ndarray:
    """Camera c's [N, D] of colours that are shared, [N, D], or per camera, [C, N, D]."""
    return array if array.ndim == 2 else array[c]
