"""Folders of Neu3D (DyNeRF) and their like: `poses_bounds.npy` of LLFF and a synchronised video per camera, `cam*.mp4`.

Row i of `poses_bounds.npy` is the pose of the i-th video by name: three rows of [R | t | (height, width, focal)], the
columns of R pointing down, right and backwards in the world, and the nearest and farthest depth. The first camera is
held out, as everyone does.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.cameras import Lens, UnreadView, check_rotation, world_to_camera
from pd4dgs_codec.data.files import LARGEST, read_file
from pd4dgs_codec.data.ply import read_only_ply
from pd4dgs_codec.data.synchronised import synchronised_dataset
from pd4dgs_codec.data.videos import video_size
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, one_line

POSES = "poses_bounds.npy"
#: By what share width and height of a video may differ from the pose's in their ratio.
ASPECT_TOLERANCE = 0.01
MAX_CAMERAS = 10_000


def read_neu3d(folder: Path, downscale: int, holdout: int) -> Dataset:
    """Read a folder with poses_bounds.npy (see `dataset.load`). holdout 0 holds no camera out."""
    videos = sorted(folder.glob("cam*.mp4"))
    poses = _poses(folder / POSES)
    if len(videos) != len(poses):
        raise DataError(f"{folder}: {len(poses)} poses in {POSES} and {len(videos)} videos cam*.mp4, expected as many")
    cameras = [
        _camera(row, i, video_size(video), video) for i, (video, row) in enumerate(zip(videos, poses, strict=True))
    ]
    near, far = 0.5 * float(poses[:, 15].min()), float(poses[:, 16].max())
    return synchronised_dataset(folder, cameras, *read_only_ply(folder), downscale, holdout, (near, far))


def _poses(path: Path) -> np.ndarray:
    """float64 [cameras, 17]."""
    try:
        poses = np.load(io.BytesIO(read_file(path)), allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise DataError(f"{path}: not a file of numpy: {one_line(str(error), 120)}") from None
    fits = isinstance(poses, np.ndarray) and poses.dtype.kind == "f" and poses.ndim == 2 and poses.shape[1:] == (17,)
    if not fits or not 1 <= len(poses) <= MAX_CAMERAS or not (np.abs(poses) <= LARGEST).all():  # also true of NaN
        raise DataError(f"{path}: expected finite numbers, 1 to {MAX_CAMERAS} rows of 17")
    if not (0 < poses[:, 15].min() and (poses[:, 15] < poses[:, 16]).all()):
        raise DataError(f"{path}: expected depths with 0 < nearest < farthest in the last two columns")
    return np.asarray(poses, np.float64)


def _camera(row: np.ndarray, i: int, size: tuple[int, int], video: Path) -> UnreadView:
    """The pose and lens of a row, for pictures of `size` = (width, height)."""
    where = f"{video.parent / POSES}: row {i}"
    pose = row[:15].reshape(3, 5)
    down, right, back = pose[:, 0], pose[:, 1], pose[:, 2]
    rotation = np.stack([right, down, -back])  # world to camera
    check_rotation(rotation, where)
    height, width, focal = pose[:, 4]
    if not (min(height, width, focal) > 0 and abs(size[0] * height / (size[1] * width) - 1) <= ASPECT_TOLERANCE):
        shape = f"{width:g}x{height:g}, focal length {focal:g}"
        raise DataError(f"{where} is of {shape}, and {video.name} of {size[0]}x{size[1]}; expected the same shape")
    fx, fy = focal * size[0] / width, focal * size[1] / height
    lens = Lens(*size, fx, fy, size[0] / 2, size[1] / 2)
    return UnreadView(video.stem, i, 0.0, world_to_camera(rotation, pose[:, 3]), lens, video)
