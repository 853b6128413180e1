"""Recordings of Record3D (iPhone): `metadata` or `metadata.json` beside `rgbd/` or `rgb/` with pictures 0.jpg, 1.jpg …

`K` holds nine numbers by columns; `perFrameIntrinsicCoeffs`, where there, fx fy cx cy of each picture. `poses` are rows
qx qy qz qw x y z, camera to world with ARKit's axes: x right, y up, z backwards. `frameTimestamps` or `fps` say when.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pd4dgs_codec.data.cameras import LARGEST_TIME, Lens, UnreadView, checked_rotation, world_to_camera
from pd4dgs_codec.data.files import array, find_image, number, read_json, whole_number
from pd4dgs_codec.data.posed import held_out, posed_dataset
from pd4dgs_codec.data.transforms import OPENGL_TO_OPENCV
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError

META, PICTURES = ("metadata", "metadata.json"), ("rgbd", "rgb")
MAX_FRAMES = 1_000_000


def is_record3d(folder: Path) -> bool:
    """Whether the folder has what a recording of Record3D has."""
    return any((folder / name).is_file() for name in META) and any((folder / name).is_dir() for name in PICTURES)


def read_record3d(folder: Path, downscale: int, holdout: int) -> Dataset:
    """Read an unpacked recording (see `dataset.load`)."""
    path = next(folder / name for name in META if (folder / name).is_file())
    pictures = next(folder / name for name in PICTURES if (folder / name).is_dir())
    meta = read_json(path)
    size = tuple(whole_number(meta.get(key), f"{path}: {key}", low=1) for key in ("w", "h"))
    rows = meta.get("poses")
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_FRAMES:
        raise DataError(f"{path}: found no poses, expected 1 to {MAX_FRAMES:,} rows of 7")
    poses = array(rows, (len(rows), 7), f"{path}: poses")
    lenses, times = _lenses(meta, (size[0], size[1]), len(rows), path), _times(meta, len(rows), path)
    frames = []
    for i, (pose, lens, time) in enumerate(zip(poses, lenses, times, strict=True)):
        rotation = checked_rotation(pose[[3, 0, 1, 2]], f"{path}: pose {i}")
        viewmat = world_to_camera(OPENGL_TO_OPENCV @ rotation.T, pose[4:])
        frames.append(UnreadView(str(i), 0, time, viewmat, lens, find_image(pictures, str(i))))
    return posed_dataset(folder, *held_out(frames, holdout), None, None, downscale)


def _lenses(meta: dict[str, object], size: tuple[int, int], count: int, path: Path) -> list[Lens]:
    if meta.get("perFrameIntrinsicCoeffs") is not None:
        where = f"{path}: perFrameIntrinsicCoeffs"
        table = array(meta["perFrameIntrinsicCoeffs"], (count, 4), where)
    else:
        where = f"{path}: K"
        fx, _, _, _, fy, _, cx, cy, _ = array(meta.get("K"), (9,), where)
        table = np.tile([fx, fy, cx, cy], (count, 1))
    if not (table[:, :2] > 0).all():
        raise DataError(f"{where}: a focal length is not above 0")
    return [Lens(*size, float(fx), float(fy), float(cx), float(cy)) for fx, fy, cx, cy in table]


def _times(meta: dict[str, object], count: int, path: Path) -> list[float]:
    stamps = meta.get("frameTimestamps")
    if stamps is None:
        fps = number(meta.get("fps", 60), f"{path}: fps", positive=True)
        return [i / fps for i in range(count)]
    if not isinstance(stamps, list) or len(stamps) != count:
        raise DataError(f"{path}: frameTimestamps are not {count} numbers, one per pose")
    return [number(stamp, f"{path}: frameTimestamps", largest=LARGEST_TIME) for stamp in stamps]
