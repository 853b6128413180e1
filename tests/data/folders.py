"""Writers of dataset folders in every layout, from views of a synthetic scene, for the readers' tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from videos import write_video

from pd4dgs_codec.data.cameras import OPENGL_TO_OPENCV
from pd4dgs_codec.data.files import shrink_image, shrink_mask
from pd4dgs_codec.data.view import Dataset, View

COUNT = 12  #: pictures of a moving camera
CAMERAS, INSTANTS, FPS = 3, 4, 10  #: of a rig
POINTS = 50


def pose(angle: float = 0.0, distance: float = 4.0) -> list:
    """OpenGL camera-to-world of a camera that looks at the origin from `distance` away, in the x-z plane."""
    c, s = np.cos(angle), np.sin(angle)
    return [[c, 0, s, distance * s], [0, 1, 0, 0], [-s, 0, c, distance * c], [0, 0, 0, 1]]


def gradient(w: int, h: int, shift: int = 0) -> np.ndarray:
    """A picture in which every pixel differs."""
    y, x = np.mgrid[:h, :w]
    return np.stack([x * 7 + shift, y * 11, x * 3 + y * 5], axis=2).astype(np.uint8)


def save(path: Path, content: Any) -> None:
    """Writes pixels, bytes or JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, np.ndarray):
        Image.fromarray(content).save(path)
    else:
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())


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


# -- phones ------------------------------------------------------------------------------------------------------------


def _camera(view: View, factor: int = 1, scale: float = 1.0, center: float | np.ndarray = 0.0) -> dict[str, Any]:
    rotation, place = eye(view)
    K = view.K.astype(np.float64) * factor
    return {
        "orientation": rotation.tolist(), "position": (place / scale + center).tolist(), "focal_length": K[0, 0],
        "pixel_aspect_ratio": K[1, 1] / K[0, 0], "principal_point": [K[0, 2], K[1, 2]],
        "image_size": [factor * view.width, factor * view.height], "skew": 0.0,
        "radial_distortion": [0.0] * 3, "tangential_distortion": [0.0] * 2,
    }  # fmt: skip


def write_iphone(dataset: Dataset, folder: Path) -> Path:
    """A dataset of 1x and 2x pictures. Masks of training views and colours of points have no place in the layout."""
    views = [*dataset.train, *dataset.test]
    for view in views:
        save(folder / "camera" / f"{view.name}.json", _camera(view))
        for k in (1, 2):
            save(folder / "rgb" / f"{k}x" / f"{view.name}.png", shrink_image(view.image, k))
            if dataset.masked and view in dataset.test:
                mask = shrink_mask(view.mask, k).astype(np.uint8) * 255
                save(folder / "covisible" / f"{k}x" / "val" / f"{view.name}.png", mask)
    for split, part in (("train", dataset.train), ("val", dataset.test)):
        save(folder / "splits" / f"{split}.json", {"frame_names": [view.name for view in part]})
    save(folder / "dataset.json", {"ids": [view.name for view in views]})
    rows = {view.name: {"warp_id": view.time, "camera_id": view.camera_id} for view in views}
    save(folder / "metadata.json", rows)
    save(folder / "scene.json", {"center": [0.0] * 3, "scale": 1.0, "near": dataset.near, "far": dataset.far})
    extra = {"factor": 1, "fps": 1 / (dataset.time_range[1] - dataset.time_range[0]), "bbox": dataset.box.tolist()}
    save(folder / "extra.json", extra | {"up": list(dataset.up), "background": list(dataset.background)})
    if dataset.points is not None:
        np.save(folder / "points.npy", dataset.points)
    return folder


def write_hypernerf(scene: Dataset, folder: Path, scale: float = 0.25, center: float = 3.0) -> Path:
    """In other units and around another centre; pictures of half the size of the cameras."""
    names = [f"{i:06d}" for i in range(COUNT)]
    for name, view in zip(names, scene.train, strict=False):
        save(folder / "camera" / f"{name}.json", _camera(view, 2, scale, center))
        save(folder / "rgb" / "2x" / f"{name}.png", view.image)
    save(folder / "dataset.json", {"ids": names, "train_ids": names[::2], "val_ids": names[1::2], "count": COUNT})
    save(folder / "metadata.json", {name: {"warp_id": i, "camera_id": 0} for i, name in enumerate(names)})
    save(folder / "scene.json", {"scale": scale, "center": [center] * 3, "near": 0.1, "far": 9.0})
    np.save(folder / "points.npy", scene.points[:POINTS] / scale + center)
    return folder


def write_record3d(scene: Dataset, folder: Path, *, stamps: bool = True) -> Path:
    """stamps: a time and intrinsics for each frame."""
    poses, coefficients = [], []
    for i, view in enumerate(scene.train[:COUNT]):
        (w, x, y, z), K = quaternion(eye(view)[0].T @ OPENGL_TO_OPENCV), view.K.astype(float)
        poses.append([x, y, z, w, *eye(view)[1]])
        coefficients.append([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        save(folder / "rgbd" / f"{i}.png", view.image)
    first = scene.train[0]
    meta = {"w": first.width, "h": first.height, "K": first.K.T.ravel().tolist(), "fps": 30, "poses": poses}
    if stamps:
        meta |= {"frameTimestamps": [5.0 + i / 20 for i in range(COUNT)], "perFrameIntrinsicCoeffs": coefficients}
    save(folder / "metadata", meta)
    return folder


# -- rigs --------------------------------------------------------------------------------------------------------------


def rig_views(scene: Dataset, camera: int) -> list[View]:
    """Training views that serve as the frames of a camera; the first one has its pose."""
    return list(scene.train[camera * INSTANTS : (camera + 1) * INSTANTS])


def _rig_videos(scene: Dataset, folder: Path) -> None:
    for camera in range(CAMERAS):
        write_video(folder / f"cam{camera}.mp4", [view.image for view in rig_views(scene, camera)], FPS)


def write_neu3d(scene: Dataset, folder: Path) -> Path:
    """Nearest depth 1, farthest 9."""
    folder.mkdir()
    _rig_videos(scene, folder)
    rows = []
    for camera in range(CAMERAS):
        view = rig_views(scene, camera)[0]
        (right, down, ahead), place = eye(view)
        lens = [view.height, view.width, float(view.K[0, 0])]
        rows.append([*np.stack([down, right, -ahead, place, lens], axis=1).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_panoptic(scene: Dataset, folder: Path) -> Path:
    """The view of camera c at instant t is training view t * CAMERAS + c."""
    instants = [scene.train[t * CAMERAS : (t + 1) * CAMERAS] for t in range(INSTANTS)]
    names = [[f"{camera}/{t:06d}.png" for camera in range(CAMERAS)] for t in range(INSTANTS)]
    for row, views in zip(names, instants, strict=True):
        for name, view in zip(row, views, strict=True):
            save(folder / "ims" / name, view.image)
    meta = {
        "w": scene.train[0].width, "h": scene.train[0].height, "fn": names,
        "k": [[view.K.tolist() for view in views] for views in instants],
        "w2c": [[view.viewmat.tolist() for view in views] for views in instants],
        "cam_id": [list(range(CAMERAS))] * INSTANTS,
    }  # fmt: skip
    save(folder / "train_meta.json", meta)
    rows = np.concatenate([scene.points[:POINTS], np.full((POINTS, 4), 0.5)], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=rows)
    return folder


# -- COLMAP ------------------------------------------------------------------------------------------------------------


def colmap_name(i: int) -> str:
    """Of a picture in a model."""
    return f"cam/frame_{2 * i:04d}.png"


def write_colmap(
    scene: Dataset, folder: Path, form: str = "binary", camera: str = "PINHOLE", extra: tuple[float, ...] = ()
) -> Path:
    """A model with camera 7, as pycolmap writes it. form: "binary" or "text". extra: parameters after fx fy cx cy."""
    import pycolmap  # of an extra

    first, K = scene.train[0], scene.train[0].K.astype(float)
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *extra]
    size, model = {"width": first.width, "height": first.height}, pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(model=camera, params=parameters, camera_id=7, **size))
    for i, view in enumerate(scene.train[:COUNT]):
        save(folder / "images" / colmap_name(i), view.image)
        image = pycolmap.Image(name=colmap_name(i), camera_id=7, image_id=i + 1)
        image.points2D = [pycolmap.Point2D(np.array([3.0, 4.0]))] * (i % 2)
        (w, x, y, z), shift = quaternion(eye(view)[0]), view.viewmat[:3, 3].astype(float)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), shift)
        model.add_image_with_trivial_frame(image, pose)
    for point in scene.points[:POINTS].astype(float):
        model.add_point3D(point, pycolmap.Track(), np.array([0, 128, 255], np.uint8))
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    getattr(model, f"write_{form}")(str(place))
    return folder


def write_synchronised(scene: Dataset, folder: Path, camera: str = "PINHOLE", extra: str = "") -> Path:
    """A model with a video per picture in videos/."""
    save(folder / "sparse" / "0" / "points3D.txt", b"")
    (folder / "videos").mkdir()
    _rig_videos(scene, folder / "videos")
    view, K = scene.train[0], scene.train[0].K.astype(float)
    line = f"1 {camera} {view.width} {view.height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]} {extra}\n"
    save(folder / "sparse" / "0" / "cameras.txt", line.encode())
    lines = []
    for i in range(CAMERAS):
        viewmat = rig_views(scene, i)[0].viewmat.astype(float)
        lines += [" ".join(map(str, [i + 1, *quaternion(viewmat[:3, :3]), *viewmat[:3, 3], 1, f"cam{i}.png"])), ""]
    save(folder / "sparse" / "0" / "images.txt", ("\n".join(lines) + "\n").encode())
    return folder
