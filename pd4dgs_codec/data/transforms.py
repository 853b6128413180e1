"""Blender, D-NeRF and nerfstudio folders: transforms*.json with OpenGL camera-to-world matrices."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import (
    Color,
    array,
    find_image,
    image_info,
    inside,
    is_there,
    note,
    number,
    read_json,
    read_only_ply,
    read_ply,
    whole_number,
)
from pd4dgs_codec.data.view import (
    LARGEST_TIME,
    OPENGL_TO_OPENCV,
    ROTATION_TOLERANCE,
    Dataset,
    Lens,
    Origin,
    UnreadView,
    check_rotation,
    held_out,
    posed_dataset,
    present,
    world_to_camera,
)
from pd4dgs_codec.errors import DataError, one_line

PINHOLE_MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
FISHEYE_MODEL = "OPENCV_FISHEYE"


def _choose(folder: Path) -> tuple[Path, list[Path]]:
    """The file with the training frames, and those that may have test frames if the folder is split."""
    train = folder / "transforms_train.json"
    if train.is_file():
        others = (folder / "transforms_test.json", folder / "transforms_val.json")
        return train, [path for path in others if path.is_file()]
    found = {path.name: path for path in sorted(folder.glob("transforms*.json"))}
    if "transforms.json" in found or len(found) == 1:
        return found.get("transforms.json") or next(iter(found.values())), []
    raise DataError(
        f"{folder}: found {', '.join(found)}; expected transforms.json, transforms_train.json or a single file"
    )


def _focal(get: Callable[[str], Any], axis: str, size: int, where: str) -> float | None:
    if get("fl_" + axis) is not None:
        return number(get("fl_" + axis), f"{where}: fl_{axis}", positive=True)
    angle = get("camera_angle_" + axis)
    if angle is None:
        return None
    where = f"{where}: camera_angle_{axis}"
    angle = number(angle, where, positive=True)
    if angle >= np.pi:
        raise DataError(f"{where} is {angle}, expected radians below pi")
    return number(float(0.5 * size / np.tan(0.5 * angle)), f"{where}: focal length", positive=True)


def _lens(file: dict[str, Any], frame: dict[str, Any], size: Callable[[], tuple[int, int]], where: str) -> Lens:
    """Intrinsics of one frame; its own keys override the file's. size: of its image, as (width, height)."""

    def get(key: str) -> Any:
        return frame.get(key, file.get(key))

    def value(key: str, default: float = 0.0) -> float:
        return default if get(key) is None else number(get(key), f"{where}: {key}")

    if get("w") is None or get("h") is None:
        width, height = size()
    else:
        width, height = (whole_number(get(k), f"{where}: {k}", low=1) for k in ("w", "h"))
    model = get("camera_model")
    if model is None and get("is_fisheye"):  # of instant-ngp
        model = FISHEYE_MODEL
    if model is not None and not isinstance(model, str):
        raise DataError(f"{where}: camera_model is {one_line(repr(model), 60)}, expected a name")
    fisheye = model == FISHEYE_MODEL
    if (model is not None and model not in PINHOLE_MODELS and not fisheye) or (value("k4") and not fisheye):
        expected = f"a pinhole or {FISHEYE_MODEL}"
        raise DataError(f"{where}: camera_model {model!r} (k4 {value('k4'):g}) is not supported, expected {expected}")
    focal = [_focal(get, axis, size, where) for axis, size in (("x", width), ("y", height))]
    known = [f for f in focal if f is not None]
    if not known:
        raise DataError(f"{where}: no focal length, expected fl_x or camera_angle_x")
    fx, fy = known[0], known[-1]
    cx, cy = value("cx", width / 2), value("cy", height / 2)
    radial, tangential = (value("k1"), value("k2"), value("k3")), (value("p1"), value("p2"))
    if fisheye:
        return Lens(width, height, fx, fy, cx, cy, fisheye=(*radial, value("k4")))
    return Lens(width, height, fx, fy, cx, cy, 0.0, radial, tangential)


def _viewmat(matrix: Any, where: str) -> np.ndarray:
    """float64 [4, 4] world to camera, OpenCV, from an OpenGL camera-to-world matrix 4x4 or 3x4."""
    rows = 3 if isinstance(matrix, list) and len(matrix) == 3 else 4
    pose = array(matrix, (rows, 4), where)
    if rows == 4 and not np.allclose(pose[3], (0, 0, 0, 1), atol=ROTATION_TOLERANCE):
        raise DataError(f"{where} ends with the row {pose[3].tolist()}, expected 0 0 0 1")
    check_rotation(pose[:3, :3], where)
    return world_to_camera(OPENGL_TO_OPENCV @ pose[:3, :3].T, pose[:3, 3])


def _frames(folder: Path, path: Path) -> tuple[list[UnreadView], dict[str, Any]]:
    """The frames of one file in its order, and the whole file."""
    file = read_json(path)
    listed = file.get("frames")
    if not isinstance(listed, list) or not listed:
        raise DataError(f"{path}: found no frames, expected a list of at least 1")
    frames = []
    size = cache(lambda image: image_info(image)[:2] if is_there(image) else (1, 1))  # a missing one is left out later
    for i, frame in enumerate(listed):
        where = f"{path}: frame {i}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise DataError(f"{where} has no file_path, expected an object with file_path and transform_matrix")
        viewmat = _viewmat(frame.get("transform_matrix"), f"{where}: transform_matrix")
        image = find_image(folder, frame["file_path"])
        time = frame.get("time")
        if time is not None:
            time = number(time, f"{where}: time", largest=LARGEST_TIME)
        lens = _lens(file, frame, partial(size, image), where)
        frames.append(UnreadView(image.stem, 0, time, viewmat, lens, image, _mask(folder, frame, where)))
    return frames, file


def _mask(folder: Path, frame: dict[str, Any], where: str) -> Path | None:
    """The file of nerfstudio's mask of a frame, black where pixels are not valid, or None."""
    named = frame.get("mask_path")
    if named is None:
        return None
    if not isinstance(named, str):
        raise DataError(f"{where}: mask_path is {one_line(repr(named), 60)}, expected the name of a picture")
    return find_image(folder, named)


def _stored_depth(folder: Path, file: dict[str, Any]) -> tuple[float, float] | None:
    """(near, far) from near_far_per_frame. Half the 5th percentile of near: single frames go down to almost 0."""
    if file.get("near_far_per_frame") is None:
        return None
    where = f"{folder}: near_far_per_frame"
    rows = array(file["near_far_per_frame"], (len(file["frames"]), 2), where)
    near, far = 0.5 * float(np.percentile(rows[:, 0], 5)), float(rows[:, 1].max())
    if not 0 < near < far:
        raise DataError(f"{where} spans {near:g} to {far:g}, expected 0 < near < far")
    return near, far


def _listed_split(
    path: Path, file: dict[str, Any], frames: list[UnreadView]
) -> tuple[list[UnreadView], list[UnreadView]] | None:
    """(training, test) frames by nerfstudio's train_filenames and test_filenames or val_filenames; None without them.
    A frame in none of the lists is not read."""
    held = "test_filenames" if file.get("test_filenames") or not file.get("val_filenames") else "val_filenames"
    keys = ("train_filenames", held)
    if not any(file.get(key) for key in keys):
        return None
    named = {listed["file_path"]: frame for listed, frame in zip(file["frames"], frames, strict=True)}
    for key in keys:
        names = file.get(key)
        if not isinstance(names, list) or not names or not all(isinstance(n, str) and n in named for n in names):
            raise DataError(f"{path}: {key} is {one_line(repr(names), 60)}, expected a list of frames' file_path")
    train, test = ([named[name] for name in dict.fromkeys(file[key])] for key in keys)
    return train, test


def read_transforms(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads a folder with transforms*.json (see `dataset.load`); a split by files or lists overrides `holdout`."""
    train_file, test_files = _choose(folder)
    frames, file = _frames(folder, train_file)
    train, test = frames, list[UnreadView]()
    for path in test_files:
        test = _frames(folder, path)[0] if read_json(path).get("frames") != [] else []
        if any(is_there(frame.image) for frame in test):
            break
        note("no picture of these test frames is there, so that they count as none", f"{len(test)} of {path.name}")
        test = []
    if not test:
        train, test = _listed_split(train_file, file, frames) or held_out(present(folder, frames), holdout)
    named = file.get("ply_file_path")
    points = read_ply(inside(folder, named)) if isinstance(named, str) else read_only_ply(folder)
    origin = Origin("`time` of each frame", points=named if isinstance(named, str) else "the PLY file")
    return posed_dataset(folder, train, test, points, downscale, _stored_depth(folder, file), background, origin=origin)
