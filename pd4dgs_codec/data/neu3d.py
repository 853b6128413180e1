"""Folders of Neu3D (DyNeRF) and their like: `poses_bounds.npy` of LLFF and a synchronised video per camera, `cam*.mp4`.

Row i of `poses_bounds.npy` is the pose of the i-th video by name: three rows of [R | t | (height, width, focal)], the
columns of R pointing down, right and backwards in the world, and the nearest and farthest depth. The first camera is
held out, as everyone does.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.cameras import (
    Lens,
    UnreadView,
    cameras_box,
    check_rotation,
    mean_up,
    points_box,
    world_to_camera,
)
from pd4dgs_codec.data.files import LARGEST, check_downscale, read_file, shrink_image
from pd4dgs_codec.data.ply import read_ply
from pd4dgs_codec.data.videos import open_video
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError, one_line

POSES = "poses_bounds.npy"
#: Bytes of all pictures, which are held in memory.
MOST_BYTES = 4 << 30
#: By what share width and height of a video may differ from the pose's in their ratio.
ASPECT_TOLERANCE = 0.01
MAX_CAMERAS = 10_000


def read_neu3d(folder: Path, downscale: int, holdout: int) -> Dataset:
    """Read a folder with poses_bounds.npy (see `dataset.load`). holdout 0 holds no camera out."""
    videos = sorted(folder.glob("cam*.mp4"))
    poses = _poses(folder / POSES)
    if len(videos) != len(poses):
        raise DataError(f"{folder}: {len(poses)} poses in {POSES} and {len(videos)} videos cam*.mp4, expected as many")
    cameras, views, fps, count = [], [], 0.0, 0
    for i, (video, row) in enumerate(zip(videos, poses, strict=True)):
        frames, rate, size = _decoded(video, downscale, len(videos))
        camera = _camera(row, i, size, video)
        if i and (len(frames) != count or rate != fps):
            found = f"{len(frames)} frames at {rate:g} per second and {videos[0].name} {count} at {fps:g}"
            raise DataError(f"{video}: has {found}, expected synchronised videos")
        cameras.append(camera)
        fps, count = rate, len(frames)
        viewmat, K = camera.viewmat.astype(np.float32), camera.lens.matrix(downscale)
        for k, image in enumerate(frames):
            height, width = image.shape[:2]
            time = k / (count - 1) if count > 1 else 0.0
            views.append(View(viewmat, K, width, height, time, image, None, f"{video.stem}_{k:04d}", i))
    train = [view for view in views if not holdout or view.camera_id > 0]
    if not train:
        raise DataError(f"{folder}: one camera, which is held out, expected others to train on or --holdout 0")
    near, far = 0.5 * float(poses[:, 15].min()), float(poses[:, 16].max())
    plys = sorted(folder.glob("*.ply"))
    points, colors = read_ply(plys[0]) if len(plys) == 1 else (None, None)
    if points is not None and not len(points):
        points, colors = None, None
    return Dataset(
        name=folder.resolve().name,
        train=tuple(train),
        test=tuple(view for view in views if holdout and view.camera_id == 0),
        points=points,
        point_colors=colors,
        box=cameras_box(cameras, (near, far)) if points is None else points_box(points),
        near=near,
        far=far,
        background=(0.0, 0.0, 0.0),
        time_range=(0.0, (count - 1) / fps if count > 1 else 1.0),
        up=mean_up(cameras),
        unit=0.0,
        masked=False,
    )


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


def _decoded(video: Path, downscale: int, videos: int) -> tuple[list[np.ndarray], float, tuple[int, int]]:
    """(frames uint8 [H, W, 3], downscaled; frames per second; size before that)."""
    source = open_video(video, output=["-fps_mode", "passthrough"])
    width, height = source.size
    check_downscale(source.size, downscale, str(video))
    frames: list[np.ndarray] = []
    for image in source.pictures:
        frames.append(shrink_image(image, downscale))
        if len(frames) * frames[0].nbytes * videos > MOST_BYTES:
            gigabytes = MOST_BYTES / 2**30
            raise DataError(
                f"{video}: {videos} videos of more than {len(frames)} frames of {width // downscale}x"
                f"{height // downscale} take over {gigabytes:g} GiB; expected a larger --downscale"
            )
    if not frames:
        raise DataError(f"{video}: holds no frame, expected one at least")
    return [np.ascontiguousarray(frame) for frame in frames], source.fps, source.size
