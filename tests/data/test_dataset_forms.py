"""HyperNeRF, Panoptic Studio, Record3D, and videos with one model of COLMAP: synthetic scenes written and read back."""

from __future__ import annotations

import errno
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_dataset_colmap import _quaternion
from videos import write_video

from pd4dgs_codec.data import videos as cached
from pd4dgs_codec.data.cameras import OPENGL_TO_OPENCV
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.synthetic import read_synthetic
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.train.state import TrainingViews

pytest.importorskip("imageio_ffmpeg")
COUNT = 12
CAMERAS, INSTANTS, FPS = 3, 4, 10
SCALE, CENTER = 0.25, np.array([3.0, -1.0, 2.0])


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return read_synthetic("synthetic:local", 4)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv(cached.FOLDER, str(tmp_path / "cache"))
    return tmp_path / "cache"


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def _eye(view) -> tuple[np.ndarray, np.ndarray]:
    """Rotation world to camera, and the camera's place."""
    viewmat = view.viewmat.astype(np.float64)
    return viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]


def assert_same(found, view) -> None:
    np.testing.assert_allclose(found.viewmat, view.viewmat, atol=1e-6)
    np.testing.assert_allclose(found.K, view.K, rtol=1e-6)
    np.testing.assert_array_equal(found.image, view.image)


def refused(folder: Path, text: str, **options) -> None:
    with pytest.raises(DataError) as caught:
        load(folder, **options)
    assert text in str(caught.value) and "\n" not in str(caught.value)


# -- HyperNeRF ---------------------------------------------------------------------------------------------------------


def write_hypernerf(scene: Dataset, folder: Path) -> Path:
    """In units and around a centre of its own; pictures at half the size that the cameras are of."""
    names, metadata = [], {}
    for i, view in enumerate(scene.train[:COUNT]):
        rotation, place = _eye(view)
        K = view.K.astype(np.float64)
        names.append(f"{i:06d}")
        metadata[names[-1]] = {"warp_id": i, "appearance_id": i, "camera_id": 0}
        camera = {
            "orientation": rotation.tolist(), "position": (place / SCALE + CENTER).tolist(),
            "focal_length": 2 * K[0, 0], "pixel_aspect_ratio": K[1, 1] / K[0, 0],
            "principal_point": [2 * K[0, 2], 2 * K[1, 2]], "image_size": [2 * view.width, 2 * view.height],
            "skew": 0.0, "radial_distortion": [0.0] * 3, "tangential": [0.0] * 2,
        }  # fmt: skip
        (folder / "camera").mkdir(parents=True, exist_ok=True)
        (folder / "camera" / f"{names[-1]}.json").write_text(json.dumps(camera))
        _save(folder / "rgb" / "2x" / f"{names[-1]}.png", view.image)
    split = {"ids": names, "train_ids": names[::2], "val_ids": names[1::2], "count": COUNT}
    (folder / "dataset.json").write_text(json.dumps(split))
    (folder / "metadata.json").write_text(json.dumps(metadata))
    (folder / "scene.json").write_text(json.dumps({"scale": SCALE, "center": CENTER.tolist(), "near": 0.1, "far": 9.0}))
    np.save(folder / "points.npy", scene.points[:40] / SCALE + CENTER)
    return folder


def test_hypernerf_is_read_back(scene, tmp_path):
    data = load(write_hypernerf(scene, tmp_path / "set"))
    assert len(data.train) == len(data.test) == COUNT // 2 and (data.near, data.far) == (0.1, 9.0)
    for i, view in enumerate(scene.train[:COUNT]):
        found = (data.test if i % 2 else data.train)[i // 2]
        assert_same(found, view)
        assert found.name == f"{i:06d}" and found.time == pytest.approx(i / (COUNT - 1))
    np.testing.assert_allclose(data.points, scene.points[:40], atol=1e-5)


# -- Panoptic Studio ---------------------------------------------------------------------------------------------------


def write_panoptic(scene: Dataset, folder: Path) -> Path:
    """The views of each instant are taken as those of its cameras."""
    meta = {"w": scene.train[0].width, "h": scene.train[0].height, "k": [], "w2c": [], "fn": [], "cam_id": []}
    for t in range(INSTANTS):
        views = scene.train[t * CAMERAS : (t + 1) * CAMERAS]
        names = [f"{camera}/{t:06d}.png" for camera in range(CAMERAS)]
        for name, view in zip(names, views, strict=True):
            _save(folder / "ims" / name, view.image)
        meta["k"].append([view.K.astype(float).tolist() for view in views])
        meta["w2c"].append([view.viewmat.astype(float).tolist() for view in views])
        meta["fn"].append(names)
        meta["cam_id"].append(list(range(CAMERAS)))
    (folder / "train_meta.json").write_text(json.dumps(meta))
    rows = np.concatenate([scene.points[:40], scene.point_colors[:40] / 255, np.ones((40, 1))], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=rows)
    return folder


def test_panoptic_is_read_back(scene, tmp_path):
    data = load(write_panoptic(scene, tmp_path / "set"))
    assert len(data.test) == INSTANTS and len(data.train) == INSTANTS * (CAMERAS - 1)
    assert data.time_range == pytest.approx((0, (INSTANTS - 1) / 30))
    for found in (*data.train, *data.test):
        t = round(found.time * (INSTANTS - 1))
        assert_same(found, scene.train[t * CAMERAS + found.camera_id])
    assert {view.camera_id for view in data.test} == {0}
    np.testing.assert_allclose(data.points, scene.points[:40], atol=1e-6)
    np.testing.assert_array_equal(data.point_colors, scene.point_colors[:40])
    assert not load(tmp_path / "set", holdout=0).test
    (tmp_path / "set" / "test_meta.json").write_text((tmp_path / "set" / "train_meta.json").read_text())
    assert len(load(tmp_path / "set").test) == INSTANTS * CAMERAS


def test_faults_of_panoptic_are_one_line(scene, tmp_path, monkeypatch):
    folder = write_panoptic(scene, tmp_path / "set")
    path = folder / "train_meta.json"
    whole = json.loads(path.read_text())
    stretched = json.loads(json.dumps(whole["w2c"]))
    stretched[1][2][0][0] += 0.5
    for change, text in (
        ({"k": whole["k"][:1]}, "lists of as many instants"),
        ({"fn": [row[:1] for row in whole["fn"]]}, "instant 0: expected k, w2c, fn and cam_id of as many cameras"),
        ({"fn": [["../../secret.png"] * CAMERAS] * INSTANTS}, "is not the name of a picture"),
        ({"fn": [[f"9/{i}.png" for i in range(CAMERAS)]] * INSTANTS}, "image is missing"),
        ({"w2c": stretched}, "instant 1: 2/000001.png: w2c is not a rotation"),
        ({"k": [[np.zeros((3, 3)).tolist()] * CAMERAS] * INSTANTS}, "with fx, fy > 0"),
        ({"w": 7}, "expected 7x"),
        ({"h": 0}, "h is 0"),
    ):
        path.write_text(json.dumps(whole | change))
        refused(folder, text)
    path.write_text(json.dumps(whole))
    with monkeypatch.context() as patch:
        patch.setattr("pd4dgs_codec.data.rigs.MAX_POINTS_BYTES", 1000)
        refused(folder, "unpacks to more than 1,000 bytes")
    with zipfile.ZipFile(folder / "init_pt_cld.npz", "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("data.npy", bytes(50_000_000))  # 50 kB on the disk
    refused(folder, "data: not a .npy file")
    np.savez(folder / "init_pt_cld.npz", data=np.array([{}]))
    refused(folder, "data: not a .npy file")
    np.savez(folder / "init_pt_cld.npz", data=np.zeros((4, 2)))
    refused(folder, "expected numbers [M, 6]")
    (folder / "init_pt_cld.npz").write_bytes(b"no archive")
    refused(folder, "not an archive of numpy")


# -- Record3D ----------------------------------------------------------------------------------------------------------


def write_record3d(scene: Dataset, folder: Path, *, stamps: bool = True) -> Path:
    (folder / "rgbd").mkdir(parents=True)
    poses, coefficients = [], []
    for i, view in enumerate(scene.train[:COUNT]):
        rotation, place = _eye(view)
        w, x, y, z = _quaternion(rotation.T @ OPENGL_TO_OPENCV)
        poses.append([x, y, z, w, *place])
        K = view.K.astype(float)
        coefficients.append([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        _save(folder / "rgbd" / f"{i}.png", view.image)
    K = scene.train[0].K.astype(float)
    meta = {"w": scene.train[0].width, "h": scene.train[0].height, "K": K.T.ravel().tolist(), "fps": 30, "poses": poses}
    if stamps:
        meta |= {"frameTimestamps": [5.0 + i / 20 for i in range(COUNT)], "perFrameIntrinsicCoeffs": coefficients}
    (folder / "metadata").write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize("stamps", [True, False])
def test_record3d_is_read_back(scene, tmp_path, stamps):
    data = load(write_record3d(scene, tmp_path / "set", stamps=stamps), holdout=0)
    assert len(data.train) == COUNT
    first, rate = (5.0, 20) if stamps else (0.0, 30)
    assert data.time_range == pytest.approx((first, first + (COUNT - 1) / rate))
    for found, view in zip(data.train, scene.train, strict=False):
        assert_same(found, view)


def test_faults_of_record3d_are_one_line(scene, tmp_path):
    folder = write_record3d(scene, tmp_path / "set")
    whole = json.loads((folder / "metadata").read_text())
    for change, text in (
        ({"poses": []}, "found no poses"),
        ({"poses": [row[:6] for row in whole["poses"]]}, "expected (12, 7)"),
        ({"poses": [[0, 0, 0, 2, 0, 0, 0]] * COUNT}, "pose 0: quaternion of length 2, expected 1"),
        ({"frameTimestamps": [0.0]}, "frameTimestamps are not 12 numbers"),
        ({"perFrameIntrinsicCoeffs": [[0, 1, 2, 3]] * COUNT}, "a focal length is not above 0"),
        ({"perFrameIntrinsicCoeffs": None, "K": None}, "K"),
        ({"w": 8}, "expected 8x"),
    ):
        (folder / "metadata").write_text(json.dumps(whole | change))
        refused(folder, text)
    (folder / "metadata").write_text(json.dumps(whole))
    (folder / "rgbd" / "3.png").unlink()
    refused(folder, "image is missing")


# -- videos with one model of COLMAP -----------------------------------------------------------------------------------


def write_synchronised(scene: Dataset, folder: Path, camera: str = "") -> Path:
    """The camera stands where its first view is; its video shows the views after that."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "videos").mkdir()
    view = scene.train[0]
    K = view.K.astype(float)
    line = f"{camera or 'PINHOLE'} {view.width} {view.height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
    (model / "cameras.txt").write_text(f"1 {line}{' .1 0 0 0' if camera else ''}\n")
    lines = []
    for i in range(CAMERAS):
        views = scene.train[i * INSTANTS : (i + 1) * INSTANTS]
        write_video(folder / "videos" / f"cam{i}.mp4", [each.image for each in views], FPS)
        viewmat = views[0].viewmat.astype(float)
        numbers = map(repr, map(float, (*_quaternion(viewmat[:3, :3]), *viewmat[:3, 3])))
        lines += [" ".join([str(i + 1), *numbers, "1", f"cam{i}.png"]), ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_videos_with_a_model_are_read_back(scene, tmp_path):
    data = load(write_synchronised(scene, tmp_path / "set"))
    assert len(data.test) == INSTANTS and len(data.train) == INSTANTS * (CAMERAS - 1)
    assert data.time_range == (0.0, pytest.approx((INSTANTS - 1) / FPS))
    for found in (*data.train, *data.test):
        t, first = round(found.time * (INSTANTS - 1)), found.camera_id * INSTANTS
        np.testing.assert_allclose(found.viewmat, scene.train[first].viewmat, atol=1e-6)
        np.testing.assert_allclose(found.K, scene.train[0].K, rtol=1e-6)
        np.testing.assert_array_equal(found.image, scene.train[first + t].image)


def test_videos_of_a_bent_lens_are_straightened(scene, tmp_path):
    view = load(write_synchronised(scene, tmp_path / "set", "OPENCV"), downscale=2).train[0]
    assert (view.height, view.width) == view.mask.shape == view.image.shape[:2] and not view.mask.all()
    assert not view.image[~view.mask].any() or view.mask.mean() > 0.5


def test_faults_of_videos_with_a_model_are_one_line(scene, tmp_path):
    folder = write_synchronised(scene, tmp_path / "set")
    videos = folder / "videos"
    images = [view.image for view in scene.train[:INSTANTS]]
    write_video(videos / "cam1.mp4", images[:2], FPS)
    refused(folder, "has 2 frames at 10 per second and cam0.mp4 4 at 10, expected synchronised videos")
    write_video(videos / "cam1.mp4", [image[:30, :32] for image in images], FPS)
    refused(folder, "cam1.mp4: is 32x30, and its camera in")
    (videos / "cam1.mp4").write_bytes(b"no video")
    refused(folder, "cam1.mp4: cannot be decoded")
    (videos / "cam1.mp4").unlink()
    refused(folder, "cam1.png: there is no video of this name among 2")


# -- the cache ---------------------------------------------------------------------------------------------------------


def test_frames_are_decoded_once(scene, tmp_path, monkeypatch, cache):
    folder = write_synchronised(scene, tmp_path / "set")
    first = load(folder)
    assert sum(file.suffix == ".frames" for file in cache.iterdir()) == CAMERAS

    def never(*_: object) -> None:
        raise AssertionError("decoded twice")

    monkeypatch.setattr(cached, "_store", never)
    again = load(folder)
    np.testing.assert_array_equal(first.train[3].image, again.train[3].image)
    with pytest.raises(AssertionError, match="decoded twice"):
        load(folder, downscale=2)


def test_the_cache_stays_within_its_size(scene, tmp_path, monkeypatch, cache):
    folder = write_synchronised(scene, tmp_path / "set")
    load(folder)
    full = sum(file.stat().st_size for file in cache.glob("*.frames"))
    monkeypatch.setattr(cached, "_IN_USE", set())
    monkeypatch.setenv(cached.SIZE, str(1.01 * full / 2**30))
    load(folder, downscale=2)  # another's frames leave for these
    assert sum(file.stat().st_size for file in cache.glob("*.frames")) <= 1.01 * full
    monkeypatch.setattr(cached, "_IN_USE", set())
    monkeypatch.setenv(cached.SIZE, str(0.4 * full / 2**30))
    refused(folder, "expected a larger PD4DGS_CACHE_GIB or a larger --downscale")
    assert not list(cache.glob(".pd4dgs-*"))
    monkeypatch.setenv(cached.SIZE, "much")
    refused(folder, "PD4DGS_CACHE_GIB is 'much', expected GiB > 0", downscale=3)


def test_a_disk_that_fills_behind_the_frames_keeps_nothing_of_them(scene, tmp_path, monkeypatch, cache):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cached.os, "replace", full)
    refused(write_synchronised(scene, tmp_path / "set"), "the disk is full")
    assert not list(cache.iterdir())


def test_a_cache_that_was_emptied_or_broken_is_one_line_and_made_anew(scene, tmp_path, cache):
    folder = write_synchronised(scene, tmp_path / "set")
    view = load(folder).train[0]
    expected = view.image
    for file in cache.glob("*.frames"):
        file.write_bytes(bytes(file.stat().st_size))
    with pytest.raises(DataError, match="missing or broken"):
        _ = view.image
    for file in cache.glob("*.frames"):
        file.unlink()
    with pytest.raises(DataError, match="missing or broken"):
        _ = view.image
    np.testing.assert_array_equal(load(folder).train[0].image, expected)


def test_shots_are_kept_within_their_bytes(scene, monkeypatch):
    import torch

    views = scene.train[:6]
    whole = TrainingViews(views, torch.device("cpu"))
    size = whole[0].target.image.nbytes + whole[0].target.weights.nbytes
    monkeypatch.setattr("pd4dgs_codec.train.state.KEPT_BYTES", 2 * size)
    few = TrainingViews(views, torch.device("cpu"))
    for index in (0, 1, 0, 5, 0, 2):
        assert torch.equal(few[index].target.image, whole[index].target.image)
    assert set(few._kept) == {0, 2} and few._bytes == 2 * size
    assert few[0] is few[0] and len(few) == 6
