"""Camera poses of frames by COLMAP's incremental mapping (Schönberger and Frahm, CVPR 2016), through pycolmap.

Every step goes on from what its database holds, so that a run that was cut does not begin anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.prepare.moving import Verdicts, count_off
from pd4dgs_codec.prepare.progress import Advance

#: Camera models that COLMAP fits and our reader takes. Phones need one coefficient.
CAMERA_MODELS = ("SIMPLE_RADIAL", "SIMPLE_PINHOLE", "PINHOLE", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
#: Pictures and pairs that are handed over at once, between two signs of progress.
BATCH, PAIRS_BATCH = 4, 50
#: Longest side that features are looked for at, and the most of them.
MOST_PIXELS, MOST_FEATURES = 1600, 4096
#: Each frame is matched with the next ones, with those at powers of two, and some with each other over the whole time.
NEAR, EVERY = 10, 5
#: A model must hold this share of the frames.
LEAST_SHARE = 0.5
SEED = 0


def colmap() -> Any:
    """pycolmap, which tells nothing but through its results; DataError if it is not there."""
    try:
        module = import_module("pycolmap")
    except ImportError:
        raise DataError(
            "camera poses need the package pycolmap, which is not installed: pip install 'pd4dgs-codec[prepare]'"
        ) from None
    module.logging.minloglevel = int(module.logging.Level.FATAL)
    module.set_random_seed(SEED)
    return module


def pairs(count: int) -> list[tuple[int, int]]:
    """Which of `count` frames are matched, i < j, ascending."""
    gaps = {*range(1, NEAR + 1), *(1 << k for k in range(4, 16))}
    near = {(i, i + gap) for gap in gaps for i in range(count - gap)}
    return sorted(near | set(combinations(range(0, count, EVERY), 2)))


def extract(database: Path, images: Path, names: Sequence[str], model: str, threads: int, advance: Advance) -> None:
    """Features of every picture; all are of one camera, of this model."""
    pycolmap = colmap()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads, options.max_image_size = False, threads, MOST_PIXELS
    options.sift.max_num_features = MOST_FEATURES
    for start in range(0, len(names), BATCH):
        batch = list(names[start : start + BATCH])
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = model
        if database.is_file():
            with pycolmap.Database.open(database) as stored:
                cameras = stored.read_all_cameras()
            if cameras:
                reader.existing_camera_id = cameras[0].camera_id
        pycolmap.extract_features(
            database,
            images,
            image_names=batch,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        for _ in batch:
            advance()


def match(database: Path, names: Sequence[str], listed: Sequence[tuple[int, int]], threads: int, adv: Advance) -> None:
    """Matches of these pairs of pictures, verified by robust estimation of their epipolar geometry."""
    pycolmap = colmap()
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    path = database.with_name("pairs.txt")
    pairing.match_list_path = path
    for start in range(0, len(listed), PAIRS_BATCH):
        batch = listed[start : start + PAIRS_BATCH]
        path.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in batch))
        pycolmap.match_image_pairs(
            database, options, pairing, verification_options=verification, device=pycolmap.Device.cpu
        )
        for _ in batch:
            adv()
    path.unlink(missing_ok=True)


def reconstruct(database: Path, images: Path, folder: Path, threads: int, advance: Advance) -> Any | None:
    """The largest model that incremental mapping finds, a pycolmap.Reconstruction; None if it finds none."""
    pycolmap = colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    options.min_model_size = 3
    folder.mkdir(parents=True, exist_ok=True)
    try:
        models = pycolmap.incremental_mapping(database, images, folder, options, next_image_callback=advance)
    except (RuntimeError, ValueError) as error:
        raise DataError(f"{images}: COLMAP gives up: {one_line(str(error), 160)}") from None
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def upright(model: Any) -> None:
    """Turns the model so that the pictures' mean up direction is -y, as in each picture, and moves it so that the
    median point lies at 0. Boxes and planes along the axes fit better, and numbers stay small."""
    pycolmap = colmap()
    views = [image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose]
    down = np.mean([view[1] for view in views], axis=0)
    ahead = np.mean([view[2] for view in views], axis=0)
    if np.linalg.norm(down) < 1e-6:
        return
    down /= np.linalg.norm(down)
    ahead -= down * (down @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # all around: any direction will do
        ahead = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([np.cross(down, ahead), down, ahead])
    points = np.array([point.xyz for point in model.points3D.values()]) @ rotation.T
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), -np.median(points, axis=0)))


def moving_features(database: Path, model: Any) -> dict[str, Verdicts]:
    """By picture, what the poses of the model say of its features; see `moving`. Pictures without a pose are absent."""
    pycolmap = colmap()
    verdicts, normalised, poses = {}, {}, {}
    camera = next(iter(model.cameras.values()))
    with pycolmap.Database.open(database) as stored:
        names = {image.image_id: image.name for image in stored.read_all_images()}
        for key in model.reg_image_ids():
            places = stored.read_keypoints(key)[:, :2].astype(np.float64)
            verdicts[key], normalised[key] = Verdicts(places), camera.cam_from_img(places)
            poses[key] = model.image(key).cam_from_world().matrix()
        numbers, matches = stored.read_all_matches()
        listed = [(*pycolmap.pair_id_to_image_pair(n), index) for n, index in zip(numbers, matches, strict=True)]
    count_off(verdicts, normalised, poses, camera.mean_focal_length(), camera.width, listed)
    return {names[key]: verdict for key, verdict in verdicts.items()}


def leave_out(database: Path, moving: Mapping[str, np.ndarray]) -> None:
    """Takes the verified matches of these features, bool [n] by picture, out of the database."""
    pycolmap = colmap()
    with pycolmap.Database.open(database) as stored:
        keys = {image.image_id: moving.get(image.name) for image in stored.read_all_images()}
        numbers, geometries = stored.read_two_view_geometries()
        for number, geometry in zip(numbers, geometries, strict=True):
            first, second = pycolmap.pair_id_to_image_pair(number)
            index = geometry.inlier_matches
            keep = np.ones(len(index), bool)
            for key, column in ((first, 0), (second, 1)):
                if (out := keys[key]) is not None:
                    keep &= ~out[index[:, column]]
            if not keep.all():
                geometry.inlier_matches = index[keep]
                stored.update_two_view_geometry(first, second, geometry)
