"""The rasteriser on the CPU: draws Gaussians and computes gradients, by functions of numpy arrays around numba kernels.

`draw` draws one picture. Training calls the stages one by one: `project`, `composite`, `backward`. Gaussians are sorted
into tiles here: a radix sort by depth, then a stable counting sort by tile, parallel over equal chunks of the depth
order. The result does not depend on the number of chunks or threads.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pd4dgs_codec import threads
from pd4dgs_codec.draw import compositing, projection
from pd4dgs_codec.draw.simd import Array, Tasks, kernel, parallel
from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.scene import Camera

CHUNKS_PER_THREAD = 4  #: chunks of the depth order while binning
MAX_COUNT = 2**31  #: Gaussians, and pairs of a Gaussian and a tile, must be fewer
MAX_SIDE = 65535  #: pixels
#: Least absolute determinant of a viewmat's 3 x 3 part; a rotation has 1.
LEAST_VOLUME = 1e-9


class Geometry(NamedTuple):
    """N Gaussians without their colours, as `draw` takes them: float32, C-contiguous."""

    means: Array  #: [N, 3]
    quats: Array  #: [N, 4]
    scales: Array  #: [N, 3]
    opacities: Array  #: [N]


@dataclass(eq=False)
class Projected:
    """N projected Gaussians and the tiles that they touch; radii and means2d of skipped Gaussians are 0."""

    width: int
    height: int
    radii: Array  #: int32 [N, 2] half extents, pixels
    means2d: Array  #: float32 [N, 2], pixels
    camera: Array  #: float64 [20], see `_pack_camera`
    geom: Array  #: float64 [N, GEOM_COLUMNS], see `projection`
    first: Array  #: int64 [N + 1], first gradient slot of each Gaussian
    items: Array  #: int32 [pairs], the Gaussians of each tile, front to back
    slot_of: Array  #: int32 [pairs], the gradient slot of each pair
    starts: Array  #: int64 [tiles + 1], first pair of each tile


@dataclass(eq=False)
class Gradients:
    """Gradients of a loss, float32, in the shapes of the arguments of `project` and `composite`."""

    geometry: Geometry
    colors: Array
    means2d: Array


def draw(
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    colors: Array,
    camera: Camera,
    background: Sequence[float] | Array = (0.0, 0.0, 0.0),
    *,
    near_plane: float = 0.01,
) -> tuple[Array, Array]:
    """Draws N Gaussians. Returns the picture, float32 [H, W, 3], and its alpha, float32 [H, W] in 0..1.

    means      [N, 3] world, scene units.
    quats      [N, 4] rotations wxyz, not necessarily unit; a zero quaternion is the identity.
    scales     [N, 3] standard deviations, scene units (the sign does not matter).
    opacities  [N] in 0..1; a Gaussian whose opacity is not above 1/255, or not finite, is skipped.
    colors     [N, 3]. background: 3 numbers.
    near_plane: Gaussians with camera z outside (near_plane, FAR] are skipped, scene units.

    Arrays of any float type are drawn in float32. A Gaussian with NaN or infinity in its position, rotation or scale is
    skipped. Raises RenderError for wrong shapes, NotFinite (a RenderError) for colours that are not finite.
    """
    given = means, quats, scales, opacities, colors
    behind = check_input(given, camera, background, near_plane, _is_floats, lambda a: float(a.astype(np.float32).sum()))
    geometry = Geometry(*(np.ascontiguousarray(a, np.float32) for a in (means, quats, scales, opacities)))
    projected = project(geometry, camera, near_plane)
    picture, transmittance = composite(projected, np.ascontiguousarray(colors, np.float32), behind)
    return picture, 1.0 - transmittance


def project(geometry: Geometry, camera: Camera, near_plane: float) -> Projected:
    """Projects the Gaussians and sorts them into the picture's tiles. Raises RenderError from MAX_COUNT on."""
    n, width, height = len(geometry.means), camera.width, camera.height
    if n >= MAX_COUNT:
        raise RenderError(f"{n} Gaussians, expected fewer than 2^31")
    packed, visible, depths = _pack_camera(camera), np.empty(n, np.bool_), np.empty(n, np.float32)
    radii, means2d = np.empty((n, 2), np.int32), np.empty((n, 2), np.float32)
    geom, rects = np.empty((n, projection.GEOM_COLUMNS)), np.empty((n, 4), np.int32)
    projection.project(*geometry, packed, (width, height), near_plane, visible, geom, rects, radii, means2d, depths)
    return Projected(width, height, radii, means2d, packed, geom, *_bin(visible, depths, rects, width, height))


def composite(projected: Projected, colors: Array, background: Array) -> tuple[Array, Array]:
    """Composites colors float32 [N, 3], contiguous, over background float32 [3]. Returns the picture, float32
    [H, W, 3], and the transmittance 1 - alpha, float32 [H, W]."""
    picture = np.empty((projected.height, projected.width, 3), np.float32)
    transmittance = np.empty(picture.shape[:2], np.float32)
    compositing.composite(projected.items, projected.starts, projected.geom, colors, background, picture, transmittance)
    return picture, transmittance


def backward(
    projected: Projected,
    geometry: Geometry,
    colors: Array,
    picture: Array,
    transmittance: Array,
    g_picture: Array,
    g_alpha: Array,
) -> Gradients:
    """Returns the gradients of a loss from g_picture [H, W, 3] and g_alpha [H, W], its derivatives by picture and
    alpha, float32 and contiguous. The other arguments are arguments and results of `project` and `composite`."""
    result = Gradients(
        Geometry(*(np.zeros_like(a) for a in geometry)), np.zeros_like(colors), np.zeros_like(projected.means2d)
    )
    slots = np.empty((projected.items.size, projection.SLOTS), np.float32)
    compositing.composite_backward(
        projected.items, projected.slot_of, projected.starts, projected.geom, colors,
        picture, transmittance, g_picture, g_alpha, slots,
    )  # fmt: skip
    projection.project_backward(
        *geometry, projected.camera, projected.geom, projected.first, slots,
        *result.geometry, result.colors, result.means2d,
    )  # fmt: skip
    return result


def compile_kernels() -> None:
    """Compiles the kernels of `draw` and of its gradients, or loads them from numba's cache: draws a Gaussian."""
    means, quats, scales, colors = (np.ones((1, k), np.float32) for k in (3, 4, 3, 3))
    viewmat, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    geometry = Geometry(means, quats, scales, np.ones(1, np.float32))
    projected = project(geometry, Camera(viewmat, K, 16, 16), 0.01)
    drawn = composite(projected, colors, np.zeros(3, np.float32))
    backward(projected, geometry, colors, *drawn, *drawn)


def _pack_camera(camera: Camera) -> Array:
    """Packs float64 [20]: R, t, fx, fy, cx, cy and the limits of x/z, y/z in J (gsplat: 1.3 x the field of view)."""
    viewmat, K = (np.asarray(a, np.float64) for a in (camera.viewmat, camera.K))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    low_x, high_x = -cx / fx - margin_x, (camera.width - cx) / fx + margin_x
    low_y, high_y = -cy / fy - margin_y, (camera.height - cy) / fy + margin_y
    return np.array([*viewmat[:3, :3].ravel(), *viewmat[:3, 3], fx, fy, cx, cy, low_x, high_x, low_y, high_y])


# -- tiles -------------------------------------------------------------------------------------------------------------


def _bin(visible: Array, depths: Array, rects: Array, width: int, height: int) -> tuple[Array, Array, Array, Array]:
    """Sorts Gaussians into tiles. Returns (first, items, slot_of, starts), see `Projected`."""
    order = depth_order(visible, depths)
    columns, rows = -(-width // projection.TILE_WIDTH), -(-height // projection.TILE_HEIGHT)
    counts = np.empty((CHUNKS_PER_THREAD * threads.kernel_threads(), columns * rows), np.int64)
    starts, first = np.empty(columns * rows + 1, np.int64), np.empty(len(visible) + 1, np.int64)
    count_tiles(order, rects, columns, counts)
    offsets(rects, counts, starts, first)
    if starts[-1] >= MAX_COUNT:
        raise RenderError(f"{starts[-1]} pairs of a Gaussian and a tile, expected fewer than 2^31")
    items, slot_of = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    fill_tiles(order, rects, columns, counts, first, items, slot_of)
    return first, items, slot_of, starts


@kernel()
def depth_order(visible: Array, depths: Array) -> Array:
    """Returns the indices int64 of the visible Gaussians, front to back; equal float32 depths stay in index order.

    A stable radix sort of the depths' bits minus those of the least depth, 12 bits a pass: two or three passes.
    """
    bits = depths.view(np.int32)
    order, count = np.empty(visible.size, np.int64), 0
    low, high = np.iinfo(np.int32).max, 0
    for i in range(visible.size):
        if visible[i]:
            order[count] = i
            count += 1
            low, high = min(low, bits[i]), max(high, bits[i])
    order, other = order[:count], np.empty(count, np.int64)
    shift = 0
    while count and (high - low) >> shift:
        starts = np.zeros(4097, np.int64)
        for n in range(count):
            starts[(((bits[order[n]] - low) >> shift) & 4095) + 1] += 1
        for digit in range(4096):
            starts[digit + 1] += starts[digit]
        for n in range(count):
            digit = ((bits[order[n]] - low) >> shift) & 4095
            other[starts[digit]] = order[n]
            starts[digit] += 1
        order, other = other, order
        shift += 12
    return order


@parallel(lambda order, rects, columns, counts: len(counts))
def count_tiles(tasks: Tasks, order: Array, rects: Array, columns: int, counts: Array) -> None:
    """Fills counts int64 [chunks, tiles]: how many Gaussians of each equal chunk of `order` touch each tile."""
    chunks = counts.shape[0]
    for chunk in range(tasks[0], tasks[1]):
        counts[chunk, :] = 0
        for n in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            i = order[n]
            for row in range(rects[i, 2], rects[i, 3]):
                for column in range(rects[i, 0], rects[i, 1]):
                    counts[chunk, row * columns + column] += 1


@kernel()
def offsets(rects: Array, counts: Array, starts: Array, first: Array) -> None:
    """Fills the exclusive prefix sums: starts [tiles + 1] into items, first [N + 1] into the slots. counts becomes the
    write positions of fill_tiles."""
    position = 0
    for tile in range(counts.shape[1]):
        starts[tile] = position
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = position
            position += count
    starts[counts.shape[1]] = position
    position = 0
    for i in range(rects.shape[0]):
        first[i] = position
        position += (rects[i, 1] - rects[i, 0]) * (rects[i, 3] - rects[i, 2])
    first[rects.shape[0]] = position


@parallel(lambda order, rects, columns, positions, *_: len(positions))
def fill_tiles(
    tasks: Tasks, order: Array, rects: Array, columns: int, positions: Array, first: Array, items: Array, slot_of: Array
) -> None:
    """Fills items int32 [pairs], the Gaussians of each tile, front to back, and slot_of int32 [pairs], the pair's
    gradient slot. Gaussian i has the slots first[i] .. first[i + 1] - 1, so that summing them reads memory in order."""
    chunks = positions.shape[0]
    for chunk in range(tasks[0], tasks[1]):
        for n in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            i = order[n]
            pair = first[i]
            for row in range(rects[i, 2], rects[i, 3]):
                for column in range(rects[i, 0], rects[i, 1]):
                    tile = row * columns + column
                    position = positions[chunk, tile]
                    positions[chunk, tile] = position + 1
                    items[position] = i
                    slot_of[position] = pair
                    pair += 1


# -- checks ------------------------------------------------------------------------------------------------------------


#: The arguments of `draw` by name, with the shape of one Gaussian's value.
SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "colors": (3,)}


def check_input(
    given: Sequence[Any],
    camera: Camera,
    background: Sequence[float] | Array,
    near_plane: float,
    is_floats: Callable[[Any], bool],
    total: Callable[[Any], float],
) -> Array:
    """Checks the arguments of `draw`; returns the background, float32 [3].

    given: arrays or tensors, in the order of SHAPES. is_floats: whether one holds floats. total: the float32 sum of
    one. Raises RenderError for wrong types, shapes and cameras, NotFinite for colours that are not finite.
    """
    if not 0 <= near_plane < projection.FAR:
        raise RenderError(f"near_plane is {near_plane}, expected 0 <= near_plane < {projection.FAR:g}")
    check_camera(camera)
    for (name, shape), array in zip(SHAPES.items(), given, strict=True):
        _check_floats(name, array, is_floats, None if name == "means" else len(given[0]), *shape)
    behind = np.array(background, np.float32)
    _check_shape("background", behind.shape, 3)
    for name, value in (("colors", total(given[-1])), ("background", total(behind))):
        if not math.isfinite(value):
            raise NotFinite(f"{name} has a value that is not finite, or its sum overflows")
    return behind


def _is_floats(array: Any) -> bool:
    return isinstance(array, np.ndarray) and array.dtype.kind == "f"


def _check_floats(name: str, array: Any, is_floats: Callable[[Any], bool], *shape: int | None) -> None:
    if not is_floats(array):
        raise RenderError(f"{name} is {getattr(array, 'dtype', type(array).__name__)}, expected an array of floats")
    _check_shape(name, array.shape, *shape)


def _check_shape(name: str, found: Sequence[int], *expected: int | None) -> None:
    """Raises RenderError unless the shape `found` is the expected one; None is any size."""
    if len(found) != len(expected) or any(b is not None and a != b for a, b in zip(found, expected, strict=True)):
        wanted = ", ".join("*" if size is None else str(size) for size in expected)
        raise RenderError(f"{name} has shape {list(found)}, expected [{wanted}]")


def check_camera(camera: Camera) -> None:
    """Raises RenderError unless `camera` is a pinhole without skew and has 1 to MAX_SIDE pixels a side."""
    for name, value in (("width", camera.width), ("height", camera.height)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_SIDE:
            raise RenderError(f"{name} is {value!r}, expected an integer from 1 to {MAX_SIDE}")
    for name, array, side in (("viewmat", camera.viewmat, 4), ("K", camera.K, 3)):
        _check_floats(name, array, _is_floats, side, side)
    viewmat, K = camera.viewmat.tolist(), camera.K.tolist()
    if not all(math.isfinite(v) for row in [*viewmat, *K] for v in row):
        raise RenderError("viewmat or K has a value that is not finite")
    if viewmat[3] != [0.0, 0.0, 0.0, 1.0]:
        raise RenderError(f"the last row of a viewmat is {viewmat[3]}, expected [0, 0, 0, 1]")
    rows = np.array(viewmat)[:3, :3]
    if not abs(np.linalg.det(rows)) >= LEAST_VOLUME:
        raise RenderError(f"the viewmat {rows.tolist()} flattens the scene, expected a rotation")
    if [K[0][1], K[1][0], *K[2]] != [0.0, 0.0, 0.0, 0.0, 1.0]:
        raise RenderError(f"K is {K}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew)")
    if not (K[0][0] > 0 and K[1][1] > 0):
        raise RenderError(f"focal lengths {K[0][0]} and {K[1][1]} in K, expected both positive")
