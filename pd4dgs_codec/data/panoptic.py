"""Panoptic Studio as Dynamic 3D Gaussians lays it out: `train_meta.json`, `test_meta.json` and `ims/`.

Each file holds `w` and `h`, and, by instant and camera, `k` (3x3), `w2c` (4x4, OpenCV axes), `fn` (a picture in `ims/`)
and `cam_id`. `init_pt_cld.npz` may hold `data`: rows of x y z r g b and more. Without a test file the first camera is
held out.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.cameras import Lens, UnreadView, check_rotation, world_to_camera
from pd4dgs_codec.data.files import LARGEST, array, find_image, read_json, whole_number
from pd4dgs_codec.data.posed import posed_dataset, without_first_camera
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, one_line

META, TEST_META, PICTURES, POINTS = "train_meta.json", "test_meta.json", "ims", "init_pt_cld.npz"
#: The studio's rate, frames per second.
FPS = 30.0
#: Bytes of the points once they are unpacked: ten million rows of seven.
MOST_POINTS_BYTES = 560_000_000


def read_panoptic(folder: Path, downscale: int, holdout: int) -> Dataset:
    """Read a folder with train_meta.json (see `dataset.load`). holdout 0 without a test file holds no camera out."""
    train = _frames(folder, folder / META)
    if (folder / TEST_META).is_file():
        test = _frames(folder, folder / TEST_META)
    else:
        train, test = without_first_camera(folder, train, holdout)
    return posed_dataset(folder, train, test, *_points(folder / POINTS), downscale)


def _frames(folder: Path, path: Path) -> list[UnreadView]:
    meta = read_json(path)
    width, height = (whole_number(meta.get(key), f"{path}: {key}", low=1) for key in ("w", "h"))
    rows = [meta.get(key) for key in ("k", "w2c", "fn", "cam_id")]
    if not all(isinstance(row, list) and row and len(row) == len(rows[0] or []) for row in rows):
        raise DataError(f"{path}: expected k, w2c, fn and cam_id, lists of as many instants")
    frames = []
    for t, instant in enumerate(zip(*rows, strict=True)):
        if not all(isinstance(row, list) and row and len(row) == len(instant[0]) for row in instant):
            raise DataError(f"{path}: instant {t}: expected k, w2c, fn and cam_id of as many cameras")
        for k, w2c, name, key in zip(*instant, strict=True):
            where = f"{path}: instant {t}: {name}"
            if not isinstance(name, str) or ".." in Path(name).parts or Path(name).is_absolute():
                raise DataError(f"{path}: instant {t}: fn {one_line(repr(name), 60)} is not the name of a picture")
            frames.append(_frame(folder, where, (width, height), t, k, w2c, name, key))
    return frames


def _frame(
    folder: Path, where: str, size: tuple[int, int], t: int, k: Any, w2c: Any, name: str, key: Any
) -> UnreadView:
    K, pose = array(k, (3, 3), f"{where}: k"), array(w2c, (4, 4), f"{where}: w2c")
    check_rotation(pose[:3, :3], f"{where}: w2c")
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], (0, 0, 1)) and K[1, 0] == 0):
        raise DataError(f"{where}: k is {K.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0")
    lens = Lens(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1])
    viewmat = world_to_camera(pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3])
    camera = whole_number(key, f"{where}: cam_id")
    stem = str(Path(name).with_suffix("")).replace("/", "_")
    return UnreadView(stem, camera, t / FPS, viewmat, lens, find_image(folder / PICTURES, name))


def _points(path: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Positions float32 [M, 3] and colours uint8 [M, 3] of the archive, or None; it is unpacked up to its bound."""
    if not path.is_file():
        return None, None
    try:
        with zipfile.ZipFile(path) as archive, archive.open("data.npy") as stream:
            held = stream.read(MOST_POINTS_BYTES + 1)
    except (OSError, KeyError, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError) as error:
        raise DataError(f"{path}: not an archive of numpy with data: {one_line(str(error), 120)}") from None
    if len(held) > MOST_POINTS_BYTES:
        raise DataError(f"{path}: data unpacks to more than {MOST_POINTS_BYTES:,} bytes")
    try:
        table = np.load(io.BytesIO(held), allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError, SyntaxError) as error:
        raise DataError(f"{path}: data is not an array: {one_line(str(error), 120)}") from None
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] < 6 or table.dtype.kind not in "fiu":
        raise DataError(f"{path}: data has shape {getattr(table, 'shape', None)}, expected numbers [M, 6] or wider")
    table = table[(np.abs(table[:, :6]) <= LARGEST).all(axis=1)]  # without NaN, too
    colors = np.clip(table[:, 3:6].astype(np.float64) * 255 + 0.5, 0, 255).astype(np.uint8)
    return table[:, :3].astype(np.float32), colors
