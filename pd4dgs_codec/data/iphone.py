"""Recordings of phones: the iPhone (DyCheck), Nerfies and HyperNeRF layout, and unpacked Record3D recordings.

The first has camera/*.json, rgb/{factor}x, splits/, scene.json, metadata.json and perhaps extra.json, points.npy and
covisible/. Record3D has `metadata` or `metadata.json` beside `rgbd/` or `rgb/` with pictures 0.jpg, 1.jpg, ... .
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.cameras import (
    OPENGL_TO_OPENCV,
    Lens,
    UnreadView,
    check_rotation,
    checked_rotation,
    world_to_camera,
)
from pd4dgs_codec.data.files import (
    LARGEST,
    Color,
    array,
    find_image,
    inside,
    number,
    read_file,
    read_json,
    read_mask,
    read_npy,
    whole_number,
)
from pd4dgs_codec.data.posed import LARGEST_TIME, cameras_box, held_out, points_box, posed_dataset, seconds_range
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError

# -- iPhone, Nerfies, HyperNeRF ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CameraFiles:
    """The cameras of both splits, centred and scaled, with lenses in pixels of rgb/{factor}x and time ids as times.

    points: float32 [M, 3] of points.npy, centred and scaled, or None. scene, extra: the JSON files.
    """

    train: tuple[UnreadView, ...]
    test: tuple[UnreadView, ...]
    factor: int
    scene: dict[str, Any]
    extra: dict[str, Any]
    points: np.ndarray | None


def _camera(path: Path, factor: int) -> tuple[Lens, np.ndarray, np.ndarray]:
    """Lens in pixels of rgb/{factor}x, world-to-camera rotation float64 [3, 3] and camera centre [3], as stored."""
    camera = read_json(path)

    def numbers(key: str, shape: tuple[int, ...], default: Any = None) -> np.ndarray:
        return array(camera.get(key, default), shape, f"{path}: {key}")

    rotation = numbers("orientation", (3, 3))
    check_rotation(rotation, f"{path}: orientation")
    fx = number(camera.get("focal_length"), f"{path}: focal_length", positive=True)
    aspect = number(camera.get("pixel_aspect_ratio", 1.0), f"{path}: pixel_aspect_ratio", positive=True)
    width, height = (int(v) // factor for v in numbers("image_size", (2,)))
    if min(width, height) < 2:
        raise DataError(f"{path}: image_size {camera['image_size']} over factor {factor}, expected at least 2x2")
    cx, cy = numbers("principal_point", (2,)).tolist()
    k1, k2, k3 = numbers("radial_distortion", (3,), [0.0] * 3).tolist()
    p1, p2 = numbers("tangential_distortion", (2,), camera.get("tangential", [0.0, 0.0])).tolist()
    skew = number(camera.get("skew", 0.0), f"{path}: skew") / factor
    focal, middle = (fx / factor, fx * aspect / factor), (cx / factor, cy / factor)
    return Lens(width, height, *focal, *middle, skew, (k1, k2, k3), (p1, p2)), rotation, numbers("position", (3,))


def _strings(value: Any, where: str) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise DataError(f"{where} is not a list of frame names")
    if len(set(value)) < len(value):
        raise DataError(f"{where} names a frame twice")
    return value


def _split_names(folder: Path) -> tuple[list[str], list[str]]:
    """Train and test names: splits/*.json, else dataset.json, else HyperNeRF's rule (i % 4 == 0 and == 2)."""
    if (folder / "splits" / "train.json").is_file():
        paths = [folder / "splits" / f"{s}.json" for s in ("train", "val")]
        train, test = (
            _strings(read_json(p).get("frame_names"), f"{p}: frame_names") if p.is_file() else [] for p in paths
        )
        return train, test
    path = folder / "dataset.json"
    listed = read_json(path)
    ids, train, test = (_strings(listed.get(k, []), f"{path}: {k}") for k in ("ids", "train_ids", "val_ids"))
    return (train, test) if test else (ids[0::4], ids[2::4])


def _extra(folder: Path) -> tuple[dict[str, Any], int]:
    """extra.json and the factor of the dataset's own images. HyperNeRF has no extra.json and is used at 2x."""
    path = folder / "extra.json"
    if not path.is_file():
        return {}, 1 if (folder / "rgb" / "1x").is_dir() and not (folder / "rgb" / "2x").is_dir() else 2
    extra = read_json(path)
    return extra, whole_number(extra.get("factor", 1), f"{path}: factor", low=1)


def _points(folder: Path, center: np.ndarray, scale: float) -> np.ndarray | None:
    path = folder / "points.npy"
    if not path.is_file():
        return None
    points = read_npy(read_file(path), str(path))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        raise DataError(f"{path}: found {points.dtype} {points.shape}, expected floats [M, 3]")
    points = (points[(np.abs(points) <= LARGEST).all(axis=1)].astype(np.float64) - center) * scale  # without NaN, too
    return points.astype(np.float32) if len(points) else None


def read_cameras(folder: str | Path) -> CameraFiles:
    """Reads every camera of both splits; images need not exist."""
    folder = Path(folder)
    scene, (extra, factor) = read_json(folder / "scene.json"), _extra(folder)
    center = array(scene.get("center", [0.0] * 3), (3,), f"{folder / 'scene.json'}: center")
    scale = number(scene.get("scale", 1.0), f"{folder / 'scene.json'}: scale", positive=True)
    path = folder / "metadata.json"
    metadata = read_json(path)

    def frame(name: str) -> UnreadView:
        entry = metadata.get(name)
        if not isinstance(entry, dict):
            raise DataError(f"{path}: no entry for frame {name!r}, which the split lists")
        time = number(entry.get("warp_id", entry.get("time_id")), f"{path}: {name}: warp_id", largest=LARGEST_TIME)
        lens, rotation, position = _camera(inside(folder / "camera", f"{name}.json"), factor)
        viewmat = world_to_camera(rotation, (position - center) * scale)
        camera_id = whole_number(entry.get("camera_id", 0), f"{path}: {name}: camera_id")
        return UnreadView(name, camera_id, time, viewmat, lens, inside(folder / "rgb" / f"{factor}x", f"{name}.png"))

    train, test = (tuple(frame(name) for name in names) for names in _split_names(folder))
    if not train:
        raise DataError(f"{folder}: the split holds 0 training frames, expected at least 1")
    return CameraFiles(train, test, factor, scene, extra, _points(folder, center, scale))


def read_iphone(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads rgb/{factor}x (see `dataset.load`). The dataset's split decides, and `holdout` is ignored."""
    files = read_cameras(folder)
    frames = [*files.train, *files.test]
    box, depth = _box_and_depth(files, frames, folder)
    where, (start, stop) = f"{folder / 'extra.json'}: ", (pick(f.time for f in frames) for pick in (min, max))
    r, g, b = array(files.extra.get("background", [0.0] * 3), (3,), f"{where}background").tolist()
    dataset = posed_dataset(
        folder, files.train, files.test, files.points, downscale, depth, (r, g, b), box, composite=False
    )
    test, covisible = dataset.test, folder / "covisible" / f"{files.factor}x" / "val"
    masked = bool(test) and covisible.is_dir()
    if masked:
        test = tuple(_covisible(v, f, covisible, downscale) for v, f in zip(test, files.test, strict=True))
    time_range, up = (0.0, 1.0), dataset.up
    if files.extra.get("fps") is not None:
        fps = number(files.extra["fps"], f"{where}fps", positive=True)
        if not stop / fps <= LARGEST_TIME:
            found = f"{fps:g}, with which the last frame is at {stop / fps:g} s"
            raise DataError(f"{where}fps is {found}, expected {LARGEST_TIME:.2g} s at most")
        time_range = seconds_range(start / fps, stop / fps)
    if files.extra.get("up") is not None:
        x, y, z = array(files.extra["up"], (3,), f"{where}up")
        norm = max(np.linalg.norm((x, y, z)), 1e-12)
        up = (float(x / norm), float(y / norm), float(z / norm))
    return replace(dataset, test=test, masked=masked, time_range=time_range, up=up)


def _box_and_depth(
    files: CameraFiles, frames: list[UnreadView], folder: Path
) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The scene box, and (near, far) of scene.json, scene units, or None."""
    box = cameras_box(frames) if files.points is None else points_box(files.points)
    if files.extra.get("bbox") is not None:
        where = f"{folder / 'extra.json'}: bbox"
        box = array(files.extra["bbox"], (2, 3), where).astype(np.float32)
        if not (box[0] < box[1]).all():
            raise DataError(f"{where} is {box.tolist()}, expected a lower and an upper corner")
    if files.scene.get("near") is None or files.scene.get("far") is None:
        return box, None
    path = folder / "scene.json"
    near, far = (number(files.scene[key], f"{path}: {key}", positive=True) for key in ("near", "far"))
    if near >= far:
        raise DataError(f"{path}: near {near:g} and far {far:g}, expected near < far")
    return box, (near, far)


def _covisible(view: View, frame: UnreadView, folder: Path, downscale: int) -> View:
    """The view with its covisibility mask."""
    path = inside(folder, f"{frame.name}.png")
    if not path.is_file():
        raise DataError(f"{path}: covisibility mask is missing, but its folder has others")
    mask = read_mask(path, (frame.lens.width, frame.lens.height), downscale=downscale)
    return replace(view, mask=mask if view.mask is None else mask & view.mask)


# -- Record3D ----------------------------------------------------------------------------------------------------------

META, PICTURES = ("metadata", "metadata.json"), ("rgbd", "rgb")
MAX_FRAMES = 1_000_000


def read_record3d(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads an unpacked recording (see `dataset.load`).

    `K` holds nine numbers by columns; `perFrameIntrinsicCoeffs`, if present, fx fy cx cy of each picture. `poses` are
    rows qx qy qz qw x y z, camera to world with ARKit's axes: x right, y up, z backwards. `frameTimestamps` or `fps`
    give the times.
    """
    path = next(folder / name for name in META if (folder / name).exists())
    pictures = next(folder / name for name in PICTURES if (folder / name).exists())
    meta = read_json(path)
    size = tuple(whole_number(meta.get(key), f"{path}: {key}", low=1) for key in ("w", "h"))
    rows = meta.get("poses")
    if not isinstance(rows, list) or not 1 <= len(rows) <= MAX_FRAMES:
        raise DataError(f"{path}: found no poses, expected 1 to {MAX_FRAMES:,} rows of 7")
    poses = array(rows, (len(rows), 7), f"{path}: poses")
    lenses, times = _record3d_lenses(meta, (size[0], size[1]), len(rows), path), _record3d_times(meta, len(rows), path)
    frames = []
    for i, (pose, lens, time) in enumerate(zip(poses, lenses, times, strict=True)):
        rotation = checked_rotation(pose[[3, 0, 1, 2]], f"{path}: pose {i}")
        viewmat = world_to_camera(OPENGL_TO_OPENCV @ rotation.T, pose[4:])
        frames.append(UnreadView(str(i), 0, time, viewmat, lens, find_image(pictures, str(i))))
    return posed_dataset(folder, *held_out(frames, holdout), None, downscale, background=background)


def _record3d_lenses(meta: dict[str, object], size: tuple[int, int], count: int, path: Path) -> list[Lens]:
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


def _record3d_times(meta: dict[str, object], count: int, path: Path) -> list[float]:
    stamps = meta.get("frameTimestamps")
    if stamps is None:
        fps = number(meta.get("fps", 60), f"{path}: fps", positive=True)
        return [i / fps for i in range(count)]
    if not isinstance(stamps, list) or len(stamps) != count:
        raise DataError(f"{path}: frameTimestamps are not {count} numbers, one per pose")
    return [number(stamp, f"{path}: frameTimestamps", largest=LARGEST_TIME) for stamp in stamps]
