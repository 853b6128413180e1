"""The pictures to render from a file: a dataset's views, or the file's own camera over time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.data.view import View, downscaled_matrix
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.scene import Camera, SceneInfo

#: The most pixels of a picture by a file's own camera: a .pd4 of a few bytes may declare 65,535 x 65,535.
MAX_PIXELS = 1 << 25


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture to render. time: 0..1. truth: uint8 [H, W, 3], the dataset's image of this view, or None."""

    camera: Camera
    time: float
    truth: np.ndarray | None = None


def dataset_frames(views: Sequence[View]) -> list[Frame]:
    """Returns the cameras, times and images of a dataset's views."""
    return [Frame(view.camera, view.time, view.image) for view in views]


def own_frames(info: SceneInfo, count: int, orbit: float = 0.0, downscale: int = 1) -> list[Frame]:
    """Returns `count` frames over the whole time from the file's camera, which orbits its look-at point by `orbit`
    degrees. Raises RenderError if the file has no camera, or its pictures exceed MAX_PIXELS."""
    if info.camera is None:
        raise RenderError("found no camera in the file, expected one, or --data SOURCE with cameras")
    camera = shrunk(info.camera, downscale)
    if camera.width * camera.height > MAX_PIXELS:
        size = f"{camera.width}x{camera.height}"
        raise RenderError(
            f"pictures of the file's camera are {size}, expected at most {MAX_PIXELS:,} pixels; "
            "use --downscale, or other cameras with --data"
        )
    times = np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(1)
    centre = look_at_point(info)
    # a full sine over the sequence: it starts and ends at the given camera pose, so that a looped video has no jump
    angles = np.radians(orbit / 2) * np.sin(2 * np.pi * times)
    return [
        Frame(turned(camera, centre, info.up, a) if a else camera, float(t)) for a, t in zip(angles, times, strict=True)
    ]


def shrunk(camera: Camera, downscale: int) -> Camera:
    """Returns the camera of an image 1/downscale as wide and high, the remainder cropped; pixel centres at +0.5."""
    if downscale == 1:
        return camera
    width, height = max(1, camera.width // downscale), max(1, camera.height // downscale)
    return replace(camera, K=downscaled_matrix(camera.K, downscale), width=width, height=height)


def look_at_point(info: SceneInfo) -> np.ndarray:
    """Returns the point of the camera's optical axis nearest to the middle of the scene's box, float64 [3], world."""
    assert info.camera is not None
    viewmat = info.camera.viewmat.astype(np.float64)
    eye, axis = -viewmat[:3, :3].T @ viewmat[:3, 3], viewmat[2, :3]
    depth = float(axis @ (info.box.astype(np.float64).mean(axis=0) - eye))
    return np.asarray(eye + max(depth, float(info.near), 1e-6) * axis)


def turned(camera: Camera, centre: np.ndarray, up: Sequence[float], angle: float) -> Camera:
    """Returns the camera rotated by `angle` radians around the axis `up` through `centre`."""
    axis = np.asarray(up, np.float64)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)  # Rodrigues
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation, centre - rotation @ centre
    viewmat = camera.viewmat.astype(np.float64) @ np.linalg.inv(world)
    return replace(camera, viewmat=viewmat.astype(np.float32))
