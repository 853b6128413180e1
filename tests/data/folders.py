"""What the tests of all readers share: poses and pictures, files written and changed, and how views are compared."""

import io
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from videos import write_video

from pd4dgs_codec.data.view import Dataset, View

COUNT = 12  #: pictures of a moving camera
CAMERAS, INSTANTS, FPS = 3, 4, 10  #: of a rig
POINTS = 50
NAN = float("nan")
SOCKET = object()  #: a change that replaces a file by a socket; like a pipe, it could keep a reader waiting


def pose(angle: float = 0.0, distance: float = 4.0) -> list:
    """OpenGL camera-to-world of a camera that looks at the origin from `distance` away, in the x-z plane."""
    c, s = np.cos(angle), np.sin(angle)
    return [[c, 0, s, distance * s], [0, 1, 0, 0], [-s, 0, c, distance * c], [0, 0, 0, 1]]


def gradient(w: int, h: int, shift: int = 0) -> np.ndarray:
    """A picture of pixels that all differ."""
    y, x = np.mgrid[:h, :w]
    return np.stack([x * 7 + shift, y * 11, x * 3 + y * 5], axis=2).astype(np.uint8)


def save(path: Path, content: Any) -> None:
    """Writes pixels, bytes or JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, np.ndarray):
        Image.fromarray(content).save(path)
    else:
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())


def npy(array: np.ndarray, **archive: bool) -> bytes:
    """A .npy file, or with archive=True a .npz file with `data`."""
    stream = io.BytesIO()
    np.savez(stream, data=array) if archive else np.save(stream, array)
    return stream.getvalue()


def changed(path: Path, change: Any) -> None:
    """Changes a file. change: keys of its JSON, new bytes, a function of its content, SOCKET, or None to remove it."""
    if change is None:
        path.unlink()
    elif change is SOCKET:
        path.unlink()
        os.mknod(path, stat.S_IFSOCK)
    elif isinstance(change, bytes):
        path.write_bytes(change)
    elif path.suffix == ".npy":
        np.save(path, change(np.load(path)))
    elif path.suffix in ("", ".json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps(change(content) if callable(change) else content | change))
    else:
        path.write_bytes(change(path.read_bytes()))


def change_frames(folder: Path, change: Callable[[int], dict[str, Any]]) -> None:
    """Updates every frame i of transforms.json by the keys of change(i)."""
    content = json.loads((folder / "transforms.json").read_text())
    for i, entry in enumerate(content["frames"]):
        entry.update(change(i))
    save(folder / "transforms.json", content)


def eye(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Rotation world to camera, and the camera's centre."""
    viewmat = view.viewmat.astype(np.float64)
    return viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation of less than half a turn."""
    w, r = np.sqrt(1 + np.trace(rotation)) / 2, rotation
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))])


def assert_same(found: View, view: View) -> None:
    np.testing.assert_allclose(found.viewmat, view.viewmat, atol=2e-6)
    np.testing.assert_allclose(found.K, view.K, rtol=1e-6)
    np.testing.assert_array_equal(found.image, view.image)


def rig_views(scene: Dataset, camera: int) -> list[View]:
    """Training views that serve as the frames of a camera; the first one has its pose."""
    return list(scene.train[camera * INSTANTS : (camera + 1) * INSTANTS])


#: The video of each camera, which one test encodes for all: they share one scene.
_ENCODED: dict[int, bytes] = {}


def rig_videos(scene: Dataset, folder: Path, cameras: int) -> None:
    """A video per camera."""
    pytest.importorskip("imageio_ffmpeg")
    for camera in range(cameras):
        path = folder / f"cam{camera}.mp4"
        if camera not in _ENCODED:
            write_video(path, [view.image for view in rig_views(scene, camera)], FPS)
            _ENCODED[camera] = path.read_bytes()
        path.write_bytes(_ENCODED[camera])
