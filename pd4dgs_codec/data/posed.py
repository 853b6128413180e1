"""Makes a dataset of posed frames, for all readers: split, times, scene box, depth range and background."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec.data.files import WHITE, Color, check_pixels, image_info
from pd4dgs_codec.data.view import Dataset, UnreadView, View, read_view
from pd4dgs_codec.errors import DataError

#: Files hold the first and the last time as binary32; their difference may change by SPAN_TOLERANCE.
LARGEST_TIME, SPAN_TOLERANCE = float(np.finfo(np.float32).max), 1e-3
#: Half the side of D-NeRF's box of initial points (1.3) over the distance of its cameras (4).
BOX_OVER_DISTANCE = 1.3 / 4.0
#: A border is one colour if this share of it lies within this many 8-bit levels of its median.
BORDER_SHARE, BORDER_LEVELS = 0.99, 3
USES = 4  #: of a picture at most, such as for training and for testing
T = TypeVar("T")
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
) -> Dataset:
    """The dataset of these frames.

    points: float32 [M, 3], or None. depth: near and far, box: float32 [2, 3], if known. background: RGB 0..1 behind
    pictures with alpha, None for white; if the first one has no alpha, the colour of the images' border is the scene's
    background. composite: False drops alpha (photographs); `background` is the scene's, None for the border's colour.
    """
    frames, under = [*train, *test], (background or WHITE) if composite else None
    files = {frame.image for frame in frames}
    if len(frames) > USES * len(files):
        raise DataError(f"{folder}: {len(frames)} frames of {len(files)} pictures, expected at most {USES} per picture")
    check_pixels(sum(frame.lens.width * frame.lens.height for frame in frames), files, str(folder))
    behind = background
    if composite:
        behind = under if image_info(train[0].image)[2] else None
    times, start, stop = normalised_times([f.time for f in frames], str(folder))
    views = [read_view(f, t, downscale, under) for f, t in zip(frames, times, strict=True)]
    return Dataset(
        name=folder.resolve().name,
        train=tuple(views[: len(train)]),
        test=tuple(views[len(train) :]),
        background=behind or border_color(views[: len(train)]),
        time_range=seconds_range(start, stop),
        **geometry(frames, points, depth, box),
    )


def geometry(
    frames: Sequence[UnreadView],
    points: np.ndarray | None,
    depth: tuple[float, float] | None,
    box: np.ndarray | None = None,
) -> dict[str, Any]:
    """The fields of a Dataset that follow from its frames and points, see `posed_dataset`."""
    if points is not None and not len(points):
        points = None
    if box is None:
        box = cameras_box(frames, depth) if points is None else points_box(points)
    near, far = depth or depth_range([f.viewmat for f in frames], box, points)
    return {"points": points, "box": box, "near": near, "far": far, "up": mean_up(frames), "masked": False}


def border_color(views: Sequence[View]) -> tuple[float, float, float]:
    """The background: the colour of the images' borders if they have one colour, else black."""
    edges = np.concatenate([e for v in views for e in (v.image[0], v.image[-1], v.image[:, 0], v.image[:, -1])])
    middle = np.median(edges, axis=0)
    same = (np.abs(edges - middle) <= BORDER_LEVELS).all(axis=1).mean() >= BORDER_SHARE
    r, g, b = middle / 255.0 if same else np.zeros(3)
    return float(r), float(g), float(b)


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
    """float32 [2, 3]: the 0.5th to the 99.5th percentile of the points, padded by 10 % of the extent on each side.

    The percentiles keep stray triangulations out; the padding makes room for moving objects, which have no points.
    """
    low, high = np.percentile(points.astype(np.float64), [0.5, 99.5], axis=0)
    pad = np.maximum(0.1 * (high - low), 0.01 * max(float((high - low).max()), 1e-6))
    return np.stack([low - pad, high + pad]).astype(np.float32)


def cameras_box(frames: Sequence[UnreadView], depth: tuple[float, float] | None = None) -> np.ndarray:
    """float32 [2, 3]: a cube around the point nearest to all optical axes, or straight ahead if they are parallel.

    Its half side is 1.3/4 of the median distance, as in D-NeRF, or half of far - near if `depth` is known.
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
    """(near, far): half the nearest and 1.5 times the farthest depth of the points, else of the box's corners, over
    cameras with the world-to-camera matrices `views` [4, 4]."""
    if points is None:
        points = np.stack(np.meshgrid(*box.T.astype(np.float64)), axis=-1).reshape(-1, 3)
    axes = np.stack([view[2] for view in views])
    depths = points[:: max(1, len(points) // 2000)] @ axes[:, :3].T + axes[:, 3]
    ahead = depths[depths > 0]
    if not len(ahead):
        return 0.01, 100.0
    near, far = np.percentile(ahead, [0.5, 99.5])
    return float(0.5 * near), float(1.5 * far)
