"""Captures by phones and by rigs of many calibrated cameras.

Phones: the iPhone (DyCheck), Nerfies and HyperNeRF layout has camera/*.json, rgb/{factor}x, splits/, scene.json,
metadata.json and perhaps extra.json, points.npy and covisible/. Unpacked Record3D recordings have `metadata` or
`metadata.json` beside `rgbd/` or `rgb/` with pictures 0.jpg, 1.jpg, ... . Rigs: Neu3D (DyNeRF) has a video per camera,
Panoptic Studio pictures.
"""

import io
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import (
    FREE_BYTES,
    INFLATES,
    LARGEST,
    Color,
    array,
    find_image,
    image_info,
    inside,
    is_there,
    number,
    read_file,
    read_json,
    read_mask,
    read_npy,
    read_only_ply,
    whole_number,
)
from pd4dgs_codec.data.videos import open_video, synchronised_dataset
from pd4dgs_codec.data.view import (
    FPS,
    LARGEST_TIME,
    OPENGL_TO_OPENCV,
    Dataset,
    Lens,
    Origin,
    UnreadView,
    View,
    check_rotation,
    checked_rotation,
    held_out,
    posed_dataset,
    without_first_camera,
    world_to_camera,
)
from pd4dgs_codec.errors import DataError, one_line

# -- iPhone, Nerfies, HyperNeRF ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CameraFiles:
    """The cameras of both splits, centred and scaled, with lenses in pixels of rgb/{factor}x and time ids as times.

    points: float64 [M, 3] of points.npy, centred and scaled, or None. scene, extra: the JSON files.
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
    finite = (np.abs(points) <= LARGEST).all(axis=1)  # False for NaN
    return np.asarray((points[finite].astype(np.float64) - center) * scale)


def read_cameras(folder: Path) -> CameraFiles:
    """Reads every camera of both splits; images need not exist."""
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
    box, depth = _box_and_depth(files, folder)
    where = f"{folder / 'extra.json'}: "
    r, g, b = array(files.extra.get("background", [0.0] * 3), (3,), f"{where}background").tolist()
    fps = FPS if files.extra.get("fps") is None else number(files.extra["fps"], f"{where}fps", positive=True)
    counts = len(files.train) + len(files.test), sum(1 for _ in (folder / "camera").glob("*.json"))
    origin = Origin(
        "warp_id of metadata.json", fps, "points.npy", "{} of {} posed pictures are in the split".format(*counts)
    )
    dataset = posed_dataset(
        folder, files.train, files.test, files.points, downscale, depth, (r, g, b), box, composite=False, origin=origin
    )
    test, covisible = dataset.test, folder / "covisible" / f"{files.factor}x" / "val"
    masked = bool(test) and covisible.is_dir()
    if masked:
        sizes = {frame.name: image_info(frame.image)[:2] for frame in files.test if is_there(frame.image)}
        test = tuple(_covisible(view, sizes[view.name], covisible, downscale) for view in test)
    up = dataset.up
    if files.extra.get("up") is not None:
        x, y, z = array(files.extra["up"], (3,), f"{where}up")
        norm = max(np.linalg.norm((x, y, z)), 1e-12)
        up = (float(x / norm), float(y / norm), float(z / norm))
    return replace(dataset, test=test, masked=masked, up=up)


def _box_and_depth(files: CameraFiles, folder: Path) -> tuple[np.ndarray | None, tuple[float, float] | None]:
    """The scene box of extra.json, and (near, far) of scene.json, scene units; None for either that is missing."""
    box = None
    if files.extra.get("bbox") is not None:
        where = f"{folder / 'extra.json'}: bbox"
        box = array(files.extra["bbox"], (2, 3), where)
        if not (box[0] < box[1]).all():
            raise DataError(f"{where} is {box.tolist()}, expected a lower and an upper corner")
    if files.scene.get("near") is None or files.scene.get("far") is None:
        return box, None
    path = folder / "scene.json"
    near, far = (number(files.scene[key], f"{path}: {key}", positive=True) for key in ("near", "far"))
    if near >= far:
        raise DataError(f"{path}: near {near:g} and far {far:g}, expected near < far")
    return box, (near, far)


def _covisible(view: View, size: tuple[int, int], folder: Path, downscale: int) -> View:
    """The view of a picture of `size` with its covisibility mask."""
    path = inside(folder, f"{view.name}.png")
    if not path.is_file():
        raise DataError(f"{path}: covisibility mask is missing, but its folder has others")
    mask = read_mask(path, size, downscale=downscale)
    return replace(view, mask=mask if view.mask is None else mask & view.mask)


# -- Record3D ----------------------------------------------------------------------------------------------------------

MAX_FRAMES = 1_000_000


def read_record3d(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads an unpacked recording (see `dataset.load`).

    `K` holds nine numbers by columns; `perFrameIntrinsicCoeffs`, if present, fx fy cx cy of each picture. `poses` are
    rows qx qy qz qw x y z, camera to world with ARKit's axes: x right, y up, z backwards. `frameTimestamps` or `fps`
    give the times.
    """
    path = next(folder / name for name in ("metadata", "metadata.json") if (folder / name).exists())
    pictures = next(folder / name for name in ("rgbd", "rgb") if (folder / name).exists())
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
    source = "frameTimestamps" if meta.get("frameTimestamps") is not None else "the frame rate in the metadata"
    return posed_dataset(
        folder, *held_out(frames, holdout), None, downscale, background=background, origin=Origin(source)
    )


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
    cameras = [_neu3d_camera(row, i, open_video(video).size, video) for i, (video, row) in pairs]
    near, far = 0.5 * float(poses[:, 15].min()), float(poses[:, 16].max())
    points = read_only_ply(folder)
    return synchronised_dataset(folder, cameras, points, "the PLY file", downscale, holdout, (near, far))


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


def read_panoptic(folder: Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    """Reads Panoptic Studio in the layout of Dynamic 3D Gaussians (see `dataset.load`).

    The meta files hold `w` and `h` and, by instant and camera, `k` (3x3), `w2c` (4x4, OpenCV axes), `fn` (a picture in
    ims/) and `cam_id`; init_pt_cld.npz may hold `data`: rows of x y z r g b and more. Without test_meta.json the first
    camera is held out, unless holdout is 0.
    """
    train, test_file = _panoptic_frames(folder / "train_meta.json"), folder / "test_meta.json"
    if test_file.is_file():
        test = _panoptic_frames(test_file)
    else:
        train, test = without_first_camera(folder, train, holdout)
    points = _panoptic_points(folder / "init_pt_cld.npz")
    origin = Origin("the instants of the meta files", FPS, "init_pt_cld.npz")
    return posed_dataset(folder, train, test, points, downscale, background=background, origin=origin)


def _panoptic_frames(path: Path) -> list[UnreadView]:
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
            camera, image = whole_number(key, f"{where}: cam_id"), find_image(path.parent / "ims", name)
            stem = str(Path(name).with_suffix("")).replace("/", "_")
            frames.append(UnreadView(stem, camera, float(t), viewmat, lens, image))
    return frames


def _panoptic_lens(k: Any, size: tuple[int, int], where: str) -> Lens:
    K = array(k, (3, 3), f"{where}: k")
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], (0, 0, 1)) and K[1, 0] == 0):
        raise DataError(f"{where}: k is {K.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 with fx, fy > 0")
    return Lens(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1])


def _panoptic_points(path: Path) -> np.ndarray | None:
    """Points, floats [M, 3], of the archive, or None. Large archives are not unpacked whole."""
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
    return np.asarray(table[(np.abs(table[:, :6]) <= LARGEST).all(axis=1), :3])  # without NaN, too
