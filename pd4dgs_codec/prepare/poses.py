"""Camera poses by COLMAP's incremental mapping (Schönberger and Frahm, CVPR 2016), through pycolmap, and the features
on moving objects, found by epipolar residuals.

Every step resumes from the contents of its database after an interruption. Residuals need no learnt weights, but miss
motion along the epipolar line.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.view import up_direction
from pd4dgs_codec.errors import DataError, required
from pd4dgs_codec.signals import ENDING

#: Called after each item.
Advance = Callable[[], None]

#: Pictures and pairs in a call of pycolmap, between two reports of progress.
BATCH, PAIRS_BATCH = 4, 50
#: Longest side of pictures for feature detection, and the most features. More cost time and hardly change the poses.
MOST_PIXELS, MOST_FEATURES = 1600, 2048
#: Frames are matched at distances 1..NEAR and powers of two, and every EVERY-th frame with all other such frames.
NEAR, EVERY = 4, 10
#: Growth of the model at which all frames are adjusted again, and the most refinements of an adjustment.
GROWTH, ROUNDS = 1.5, 2
#: The camera stands still if no pair's features are farther apart than this, pixels of a picture 1000 wide.
STILL = 5.0
#: CPU seconds per megapixel, per frame and per pair of frames, with MOST_FEATURES; fewer features take less.
MEGAPIXEL_SECONDS, FRAME_SECONDS, PAIR_SECONDS = 2.3, 1.0, 0.11
#: A model must hold this share of the frames.
LEAST_SHARE = 0.5
SEED = 0
#: A match is off if its Sampson distance is above this, pixels of a picture 1000 wide. A wide margin.
OFF = 4.0
#: A feature moves if this share of its matches is off; it needs so many matches.
LEAST_MATCHES, MOVING_SHARE = 3, 0.6
#: Features within this share of the picture's width vote on whether one moves.
REACH = 0.03


def colmap() -> Any:
    """Imports pycolmap, with its log off and a fixed seed. Raises DataError if it is not installed."""
    module = required("pycolmap", "prepare", "camera poses")
    for number in ENDING:  # its C++ would print a stack trace at SIGTERM
        if (handler := signal.getsignal(number)) is not None:
            signal.signal(number, handler)
    module.logging.minloglevel = int(module.logging.Level.FATAL)
    module.set_random_seed(SEED)
    return module


def pairs(count: int) -> list[tuple[int, int]]:
    """The pairs (i, j) of `count` frames to match, i < j, ascending."""
    gaps = {*range(1, NEAR + 1), *(1 << k for k in range(16))}
    near = {(i, i + gap) for gap in gaps for i in range(count - gap)}
    return sorted(near | set(combinations(range(0, count, EVERY), 2)))


def estimate(count: int, size: tuple[int, int], threads: int) -> float:
    """About the longest time, seconds, that the poses of `count` frames of `size` (width, height) take."""
    megapixels = size[0] * size[1] / 1e6 * min(1.0, MOST_PIXELS / max(size)) ** 2
    work = count * (MEGAPIXEL_SECONDS * megapixels + FRAME_SECONDS) + len(pairs(count)) * PAIR_SECONDS
    return work / threads


def extract(database: Path, images: Path, names: Sequence[str], model: str, threads: int, advance: Advance) -> None:
    """Extracts the features of every picture. All pictures share one camera, of COLMAP's camera model `model`."""
    pycolmap = colmap()
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads, options.max_image_size = False, threads, MOST_PIXELS
    options.sift.max_num_features, options.sift.max_num_orientations = MOST_FEATURES, 1
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
            database, images, image_names=batch, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
            extraction_options=options, device=pycolmap.Device.cpu,
        )  # fmt: skip
        for _ in batch:
            advance()


def match(database: Path, names: Sequence[str], listed: Sequence[tuple[int, int]], threads: int, adv: Advance) -> None:
    """Matches these pairs of pictures and verifies them by robust estimation of their epipolar geometry."""
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
    """The largest model of incremental mapping, a pycolmap.Reconstruction, or None."""
    pycolmap = colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    options.min_model_size = 3
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWTH
    options.ba_global_max_refinements = options.ba_local_max_refinements = ROUNDS
    folder.mkdir(parents=True, exist_ok=True)
    models = pycolmap.incremental_mapping(database, images, folder, options, next_image_callback=advance)
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def write(model: Any, folder: Path) -> None:
    """Writes a model into a folder. Raises DataError unless it can be read again, since COLMAP does not report a full
    disk."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    try:
        found = colmap().Reconstruction(folder).num_points3D()
    except Exception:  # pycolmap raises its own types
        found = -1
    if found != model.num_points3D():
        raise DataError(f"{folder}: COLMAP wrote an incomplete model; is the disk full?")


def upright(model: Any) -> None:
    """Rotates the up direction of the model to -y and moves its median point to 0: boxes and planes along the axes
    fit better, and numbers stay small."""
    pycolmap = colmap()
    views = [image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose]
    down, ahead = -np.array(up_direction(views)), np.mean([view[2] for view in views], axis=0)
    ahead -= down * (down @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # the views face all around: any direction will do
        ahead = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([np.cross(down, ahead), down, ahead])
    points = np.array([point.xyz for point in model.points3D.values()]) @ rotation.T
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), -np.median(points, axis=0)))


def moving_features(database: Path, model: Any) -> dict[str, Features]:
    """By name of each picture with a pose, the match counts of its features."""
    pycolmap = colmap()
    features, normalised, poses = {}, {}, {}
    camera = next(iter(model.cameras.values()))
    with pycolmap.Database.open(database) as stored:
        names = {image.image_id: image.name for image in stored.read_all_images()}
        for key in model.reg_image_ids():
            keypoints = stored.read_keypoints(key)[:, :2].astype(np.float64)
            features[key], normalised[key] = Features(keypoints), camera.cam_from_img(keypoints)
            poses[key] = model.image(key).cam_from_world().matrix()
        numbers, matches = stored.read_all_matches()
        listed = [(*pycolmap.pair_id_to_image_pair(n), index) for n, index in zip(numbers, matches, strict=True)]
    count_off(features, normalised, poses, camera.mean_focal_length(), camera.width, listed)
    return {names[key]: own for key, own in features.items()}


def leave_out(model: Any, moving: Mapping[str, np.ndarray]) -> None:
    """Removes the features `moving`, bool [n] by picture name, from the model, and adjusts the rest."""
    pycolmap = colmap()
    for image in list(model.images.values()):
        for index in np.flatnonzero(moving.get(image.name, ())):
            if image.points2D[index].has_point3D():  # until its point has lost the others
                model.delete_observation(image.image_id, index)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.use_gpu, options.print_summary = False, False
    config = pycolmap.BundleAdjustmentConfig()  # pycolmap.bundle_adjustment() would print a heading
    for key in model.reg_image_ids():
        config.add_image(key)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def travel(database: Path) -> float:
    """The median distance between the positions of matched features in two pictures, pixels, of the pair where it is
    largest; -1 without pairs."""
    pycolmap, largest = colmap(), -1.0
    with pycolmap.Database.open(database) as stored:
        keypoints = {image.image_id: stored.read_keypoints(image.image_id)[:, :2] for image in stored.read_all_images()}
        for number, geometry in zip(*stored.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(number)
            index = geometry.inlier_matches
            if len(index):
                gaps = keypoints[first][index[:, 0]] - keypoints[second][index[:, 1]]
                largest = max(largest, float(np.median(np.hypot(*gaps.T))))
    return largest


# -- moving features ---------------------------------------------------------------------------------------------------


@dataclass
class Features:
    """A picture's features. keypoints: float64 [n, 2], pixels. matched, off: int64 [n], all matches and matches off."""

    keypoints: np.ndarray
    matched: np.ndarray = field(init=False)
    off: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.matched = np.zeros(len(self.keypoints), np.int64)
        self.off = np.zeros(len(self.keypoints), np.int64)

    @property
    def known(self) -> np.ndarray:
        """bool [n]: the feature has enough matches."""
        return np.asarray(self.matched >= LEAST_MATCHES)

    def moving(self, width: int) -> np.ndarray:
        """bool [n]: most of the known features within REACH move. width: of the picture, pixels."""
        known = self.known
        votes, voters = np.where(self.off >= MOVING_SHARE * self.matched, 1, -1)[known], self.keypoints[known]
        result = np.zeros(len(self.keypoints), bool)
        for start in range(0, len(self.keypoints), 512):
            part = slice(start, start + 512)
            gaps = ((self.keypoints[part, None] - voters) ** 2).sum(axis=2)
            result[part] = ((gaps <= (REACH * width) ** 2) @ votes) > 0
        return result


def sampson(a: np.ndarray, b: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Sampson distance float64 [n] of matches a, b [n, 2] in normalised coordinates (Hartley and Zisserman, 11.4.3).

    relative: float64 [3, 4], from the first camera to the second. The unit is that of the coordinates.
    """
    essential = np.cross(relative[:, 3], relative[:, :3], axisb=0, axisc=0)  # the shift times each column
    ha, hb = (np.column_stack([p, np.ones(len(p))]) for p in (a, b))
    line_b, line_a = ha @ essential.T, hb @ essential
    error = np.abs((hb * line_b).sum(axis=1))
    slope = np.sqrt((line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.where(slope > 1e-12, error / np.where(slope > 1e-12, slope, 1), 0.0))


def count_off(
    features: dict[int, Features],
    normalised: dict[int, np.ndarray],
    poses: dict[int, np.ndarray],
    focal: float,
    width: int,
    matches: Iterable[tuple[int, int, np.ndarray]],
) -> None:
    """Counts the matches of each feature, and its matches that are off.

    normalised: float64 [n, 2] per picture, undistorted; poses: float64 [3, 4] per picture, world to camera; focal and
    width: pixels; matches: (picture, picture, int [m, 2] indices of features).
    """
    for first, second, index in matches:
        if first not in poses or second not in poses or not len(index):
            continue
        rotation = poses[second][:, :3] @ poses[first][:, :3].T
        shift = poses[second][:, 3] - rotation @ poses[first][:, 3]
        a, b = normalised[first][index[:, 0]], normalised[second][index[:, 1]]
        off = sampson(a, b, np.column_stack([rotation, shift])) * focal > OFF * width / 1000
        for picture, column in ((first, 0), (second, 1)):
            np.add.at(features[picture].matched, index[:, column], 1)
            np.add.at(features[picture].off, index[:, column], off)
