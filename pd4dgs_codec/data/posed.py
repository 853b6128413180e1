"""What the readers of posed pictures share: from frames with poses, and perhaps points, to a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec.data.cameras import (
    UnreadView,
    cameras_box,
    depth_range,
    mean_up,
    normalised_times,
    points_box,
    read_view,
    seconds_range,
)
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError

#: A border is one colour if this share of it lies within this many 8-bit levels of its median.
BORDER_SHARE, BORDER_LEVELS = 0.99, 3
T = TypeVar("T")
Posed = TypeVar("Posed", UnreadView, View)


def held_out(frames: Sequence[T], holdout: int) -> tuple[list[T], list[T]]:
    """(those to train on, those held out): the i-th is out if i % holdout == holdout // 2; none for holdout 0."""
    out = [holdout > 0 and i % holdout == holdout // 2 for i in range(len(frames))]
    return [f for f, o in zip(frames, out, strict=True) if not o], [f for f, o in zip(frames, out, strict=True) if o]


def without_first_camera(folder: Path, frames: Sequence[Posed], holdout: int) -> tuple[list[Posed], list[Posed]]:
    """(frames to train on, those of the first camera, which are held out; none for holdout 0)."""
    first = min(frame.camera_id for frame in frames) if holdout else None
    train = [frame for frame in frames if frame.camera_id != first]
    if not train:
        raise DataError(f"{folder}: one camera, which is held out, expected others to train on or --holdout 0")
    return train, [frame for frame in frames if frame.camera_id == first]


def posed_dataset(
    folder: Path,
    train: Sequence[UnreadView],
    test: Sequence[UnreadView],
    points: np.ndarray | None,
    colors: np.ndarray | None,
    downscale: int,
    depth: tuple[float, float] | None = None,
    background: tuple[float, float, float] | None = None,
) -> Dataset:
    """The dataset of these frames. points: float32 [M, 3] and colors uint8 [M, 3], or None; depth: near and far, if the
    folder tells them; background: that of the pictures' border if None."""
    frames = [*train, *test]
    times, start, stop = normalised_times([f.time for f in frames], str(folder))
    views = [read_view(f, t, downscale, composite=True) for f, t in zip(frames, times, strict=True)]
    return Dataset(
        name=folder.resolve().name,
        train=tuple(views[: len(train)]),
        test=tuple(views[len(train) :]),
        background=background or border_color(views[: len(train)]),
        time_range=seconds_range(start, stop),
        **geometry(frames, points, colors, depth),
    )


def geometry(
    frames: Sequence[UnreadView],
    points: np.ndarray | None,
    colors: np.ndarray | None,
    depth: tuple[float, float] | None,
) -> dict[str, Any]:
    """The fields of a Dataset that follow from its frames and points, see `posed_dataset`; its unit and masks are not
    known."""
    if points is not None and not len(points):
        points, colors = None, None
    box = cameras_box(frames, depth) if points is None else points_box(points)
    near, far = depth or depth_range([f.viewmat for f in frames], box, points)
    found = {"points": points, "point_colors": colors, "box": box, "near": near, "far": far, "up": mean_up(frames)}
    return found | {"unit": 0.0, "masked": False}


def border_color(views: Sequence[View]) -> tuple[float, float, float]:
    """The colour behind everything: that of the images' border if it is one colour throughout, else black."""
    edges = np.concatenate([e for v in views for e in (v.image[0], v.image[-1], v.image[:, 0], v.image[:, -1])])
    middle = np.median(edges, axis=0)
    same = (np.abs(edges - middle) <= BORDER_LEVELS).all(axis=1).mean() >= BORDER_SHARE
    r, g, b = middle / 255.0 if same else np.zeros(3)
    return float(r), float(g), float(b)
