"""Rigs of many calibrated cameras: Neu3D (DyNeRF) with a video per camera, and Panoptic Studio with pictures."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.cameras import Lens, UnreadView, check_rotation, world_to_camera
from pd4dgs_codec.data.files import (
    FREE_BYTES,
    INFLATES,
    LARGEST,
    Color,
    array,
    find_image,
    read_file,
    read_json,
    read_npy,
    read_only_ply,
    whole_number,
)
from pd4dgs_codec.data.posed import posed_dataset, without_first_camera
from pd4dgs_codec.data.videos import synchronised_dataset, video_size
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, one_line

# -- Neu3D -------------------------------------------------------------------------------------------------------------

POSES, MAX_CAMERAS = "poses_bounds.npy", 10_000
#: The ratio of width to height of a video and of its pose may differ by this share.
ASPECT_TOLERANCE = 0.01


def read_neu3d(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads LLFF's poses_bounds.npy with a synchronised video `cam*.mp4` per camera (see `dataset.load`).

    Row i belongs to the i-th video by name: three rows of [R | t | (height, width, focal)], the columns of R pointing
    down, right and backwards in the world; then the nearest and the farthest depth. The first camera is held out
    unless holdout is 0.
    """
    videos, poses = sorted(folder.glob("cam*.mp4")), _poses(folder / POSES)
    if len(videos) != len(poses):
        raise DataError(f"{folder}: {len(videos)} videos cam*.mp4, expected {len(poses)} as in {POSES}")
    pairs = enumerate(zip(videos, poses, strict=True))
    cameras = [_neu3d_camera(row, i, video_size(video), video) for i, (video, row) in pairs]
    near, far = 0.5 * float(poses[:, 15].min()), float(poses[:, 16].max())
    return synchronised_dataset(folder, cameras, read_only_ply(folder), downscale, holdout, (near, far))


def _poses(path: Path) -> np.ndarray:
    """Reads float64 [cameras, 17]. Raises DataError."""
    poses = read_npy(read_file(path), str(path))
    fits = poses.ndim == 2 and poses.shape[1] == 17 and 1 <= len(poses) <= MAX_CAMERAS
    if not fits or not (np.abs(poses) <= LARGEST).all():  # also true of NaN
        raise DataError(f"{path}: expected finite numbers, 1 to {MAX_CAMERAS} rows of 17")
    if not (0 < poses[:, 15].min() and (poses[:, 15] < poses[:, 16]).all()):
        raise DataError(f"{path}: expected depths with 0 < nearest < farthest in the last two columns")
    return np.asarray(poses, np.float64)


def _neu3d_camera(row: np.ndarray, i: int, size: tuple[int, int], video: Path) -> UnreadView:
    """The camera of a row, for pictures of `size` = (width, height)."""
    where = f"{video.parent / POSES}: row {i}"
    down, right, back, position, (height, width, focal) = row[:15].reshape(3, 5).T
    rotation = np.stack([right, down, -back])  # world to camera
    check_rotation(rotation, where)
    if not (min(height, width, focal) > 0 and abs(size[0] * height / (size[1] * width) - 1) <= ASPECT_TOLERANCE):
        shape = f"{width:g}x{height:g}, focal length {focal:g}"
        raise DataError(f"{where} is of {shape}, and {video.name} of {size[0]}x{size[1]}; expected the same shape")
    lens = Lens(*size, focal * size[0] / width, focal * size[1] / height, size[0] / 2, size[1] / 2)
    return UnreadView(video.stem, i, 0.0, world_to_camera(rotation, position), lens, video)


# -- Panoptic Studio ---------------------------------------------------------------------------------------------------

META, TEST_META, PICTURES, POINTS = "train_meta.json", "test_meta.json", "ims", "init_pt_cld.npz"
FPS = 30.0


def read_panoptic(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads Panoptic Studio in the layout of Dynamic 3D Gaussians (see `dataset.load`).

    The meta files hold `w` and `h` and, by instant and camera, `k` (3x3), `w2c` (4x4, OpenCV axes), `fn` (a picture in
    ims/) and `cam_id`; init_pt_cld.npz may hold `data`: rows of x y z r g b and more. Without test_meta.json the first
    camera is held out, unless holdout is 0.
    """
    train = _panoptic_frames(folder, folder / META)
    if (folder / TEST_META).is_file():
        test = _panoptic_frames(folder, folder / TEST_META)
    else:
        train, test = without_first_camera(folder, train, holdout)
    return posed_dataset(folder, train, test, _panoptic_points(folder / POINTS), downscale, background=background)


def _panoptic_frames(folder: Path, path: Path) -> list[UnreadView]:
    meta = read_json(path)
    width, height = (whole_number(meta.get(key), f"{path}: {key}", low=1) for key in ("w", "h"))
    rows = [meta.get(key) for key in ("k", "w2c", "fn", "cam_id")]
    if not all(isinstance(row, list) and row and len(row) == len(rows[0] or []) for row in rows):
        raise DataError(f"{path}: expected lists of equal length k, w2c, fn and cam_id")
    frames = []
    for t, instant in enumerate(zip(*rows, strict=True)):
        if not all(isinstance(row, list) and row and len(row) == len(instant[0]) for row in instant):
            raise DataError(f"{path}: instant {t}: expected lists of equal length k, w2c, fn and cam_id")
        for k, w2c, name, key in zip(*instant, strict=True):
            if not isinstance(name, str):
                raise DataError(f"{path}: instant {t}: fn {one_line(repr(name), 60)} is not the name of a picture")
            where = f"{path}: instant {t}: {name}"
            lens, pose = _panoptic_lens(k, (width, height), where), array(w2c, (4, 4), f"{where}: w2c")
            check_rotation(pose[:3, :3], f"{where}: w2c")
            viewmat = world_to_camera(pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3])
            camera, image = whole_number(key, f"{where}: cam_id"), find_image(folder / PICTURES, name)
            stem = str(Path(name).with_suffix("")).replace("/", "_")
            frames.append(UnreadView(stem, camera, t / FPS, viewmat, lens, image))
    return frames


def _panoptic_lens(k: Any, size: tuple[int, int], where: str) -> Lens:
    K = array(k, (3, 3), f"{where}: k")
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], (0, 0, 1)) and K[1, 0] == 0):
        raise DataError(f"{where}: k is {K.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0")
    return Lens(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1])


def _panoptic_points(path: Path) -> np.ndarray | None:
    """Points float32 [M, 3] of the archive, or None. Large archives are not unpacked whole."""
    if not path.is_file():
        return None
    raw = read_file(path)
    most = FREE_BYTES + INFLATES * len(raw)
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            member = archive.getinfo("data.npy")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DataError(f"{path}: data is compressed by method {member.compress_type}, expected deflate")
            with archive.open(member) as stream:
                held = stream.read(most + 1)
    except DataError:
        raise
    except Exception as error:  # zipfile raises many kinds
        raise DataError(f"{path}: not an archive of numpy with data: {one_line(str(error), 120)}") from None
    if len(held) > most:
        raise DataError(f"{path}: data unpacks to more than {most:,} bytes, expected {INFLATES} times its own at most")
    table = read_npy(held, f"{path}: data")
    if table.ndim != 2 or table.shape[1] < 6:
        raise DataError(f"{path}: data has shape {table.shape}, expected numbers [M, 6] or wider")
    return np.asarray(table[(np.abs(table[:, :6]) <= LARGEST).all(axis=1), :3], np.float32)  # without NaN, too
