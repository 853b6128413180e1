"""Folders of every layout but Blender's, written from a synthetic scene and read back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import folders
import numpy as np
import pytest
from folders import CAMERAS, COUNT, FPS, INSTANTS, POINTS, colmap_name, rig_views

from pd4dgs_codec.data.dataset import dataset_folders, load
from pd4dgs_codec.data.iphone import read_cameras
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError


def edit(path: Path, **keys) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | keys))


def assert_same(found: View, view: View) -> None:
    np.testing.assert_allclose(found.viewmat, view.viewmat, atol=2e-6)
    np.testing.assert_allclose(found.K, view.K, rtol=1e-6)
    np.testing.assert_array_equal(found.image, view.image)


def test_folders_of_datasets_are_found_in_a_tree():
    names = ["a/camera/0.json", "b/transforms_train.json", "c/poses_bounds.npy", "d/sparse/0/cameras.bin"]
    names += ["d/sparse/0/images.bin", "e/metadata", "e/rgbd/0.jpg", "f/metadata", "g/x/train_meta.json", "notes.txt"]
    assert dataset_folders([*names, "transforms.json"]) == ["a", "b", "c", "d", "e", "g/x"]


# -- iPhone, Nerfies, HyperNeRF ----------------------------------------------------------------------------------------


def same_views(a: tuple[View, ...], b: tuple[View, ...]) -> None:
    for x, y in zip(a, b, strict=True):
        assert (x.name, x.camera_id, x.width, x.height) == (y.name, y.camera_id, y.width, y.height)
        assert x.time == pytest.approx(y.time, abs=1e-6) and (x.mask is None) == (y.mask is None)
        assert_same(x, y)
        np.testing.assert_array_equal(x.mask, y.mask)


def test_an_iphone_scene_is_read_back(tmp_path):
    a = load("synthetic:local?frames=6")
    b = load(folders.write_iphone(a, tmp_path / "out"))
    same_views(a.train + a.test, b.train + b.test)
    assert a.masked and b.masked
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_allclose(a.box, b.box)
    assert (a.near, a.far, a.up, a.background) == (b.near, b.far, b.up, b.background)
    assert b.time_range == pytest.approx(a.time_range)


def tiny(test_times=(1 / 3,)) -> Dataset:
    """Training views 0_00000 to 0_00002, held-out ones from 1_00001 on."""
    rng = np.random.default_rng(0)
    K = np.array([[20, 0, 7], [0, 22, 6.5], [0, 0, 1]], np.float32)

    def view(i: int, t: float, camera: int) -> View:
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, 3] = i
        image = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8)
        return View(viewmat, K, 16, 12, t, image, None, f"{camera}_{i:05d}", camera)

    train = tuple(view(i, t, 0) for i, t in enumerate((0.0, 1 / 3, 1.0)))
    test = tuple(view(i, t, 1) for i, t in enumerate(test_times, 1))
    box = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    return Dataset("tiny", train, test, None, box, 0.1, 9.0, (0, 0, 0), (0, 1), (0, 1, 0), False)


@pytest.fixture
def exported(tmp_path) -> Path:
    return folders.write_iphone(tiny(), tmp_path / "out")


def test_a_scene_without_masks_and_points(exported):
    d = load(exported)
    assert not d.masked and d.points is None
    same_views(tiny().train + tiny().test, d.train + d.test)


def test_center_and_scale(exported):
    edit(exported / "scene.json", center=[1.0, 2.0, 3.0], scale=0.5)
    np.save(exported / "points.npy", np.array([[3.0, 2.0, 5.0], [np.nan, 0, 0]]))
    d = load(exported)
    before = np.array([-1.0, -1.0, -1.0])  # view 1: t = (1, 1, 1), no rotation
    np.testing.assert_allclose(-d.train[1].viewmat[:3, 3], (before - [1, 2, 3]) * 0.5, atol=1e-6)
    np.testing.assert_allclose(d.points, [[1, 0, 1]])
    assert (d.near, d.far) == (0.1, 9.0)  # already scaled


def test_factor_and_aspect(exported):
    edit(exported / "extra.json", factor=2)
    edit(exported / "camera" / "0_00000.json", focal_length=30.0, pixel_aspect_ratio=1.2, principal_point=[7.5, 5.0])
    d = load(exported)
    assert d.train[0].image.shape == (6, 8, 3)
    np.testing.assert_allclose(d.train[0].K, [[15, 0, 3.75], [0, 18, 2.5], [0, 0, 1]])


def test_distorted_and_skewed_views_get_a_border_mask(exported):
    edit(exported / "camera" / "1_00001.json", tangential_distortion=[0.02, -0.03], radial_distortion=[0.3, 0.1, 0.0])
    edit(exported / "camera" / "0_00000.json", skew=4.0)
    d = load(exported)
    assert d.test[0].mask is not None and 0.3 < d.test[0].mask.mean() < 1
    assert d.train[0].K[0, 1] == 0 and d.train[0].mask is not None and d.train[1].mask is None


def test_border_and_covisibility_both_mask(tmp_path):
    d, mask = tiny(test_times=(1 / 3, 1.0)), np.ones((12, 16), bool)
    mask[:, 8] = False
    d = replace(d, test=tuple(replace(v, mask=mask) for v in d.test), masked=True)
    folder = folders.write_iphone(d, tmp_path / "out")
    edit(folder / "camera" / "1_00001.json", radial_distortion=[0.9, 0.0, 0.0])
    mask = load(folder).test[0].mask
    assert not mask[:, 8].any() and not mask[0, 0] and not mask[-1, -1] and mask[6, 7]
    next((folder / "covisible" / "1x" / "val").iterdir()).unlink()
    with pytest.raises(DataError, match="covisibility mask is missing"):
        load(folder)


def test_hypernerf_is_read_back(scene, tmp_path):
    data = load(folders.write_hypernerf(scene, tmp_path / "set"))
    assert len(data.train) == len(data.test) == COUNT // 2 and (data.near, data.far) == (0.1, 9.0)
    for i, view in enumerate(scene.train[:COUNT]):
        found = (data.test if i % 2 else data.train)[i // 2]
        assert_same(found, view)
        assert found.name == f"{i:06d}" and found.time == pytest.approx(i / (COUNT - 1))
    np.testing.assert_allclose(data.points, scene.points[:POINTS], atol=1e-5)
    edit(tmp_path / "set" / "dataset.json", val_ids=[])  # HyperNeRF's rule then
    data = load(tmp_path / "set")
    assert [v.name for v in data.train] == ["000000", "000004", "000008"]
    assert [v.name for v in data.test] == ["000002", "000006", "000010"]


def test_paper_windmill_cameras(shared):
    files = read_cameras(shared("paper-windmill"))
    assert (len(files.train), len(files.test)) == (277, 419) and files.factor == 2
    assert {f.camera_id for f in files.train} == {0} and {f.camera_id for f in files.test} == {1, 2}
    lens = files.train[0].lens
    assert (lens.width, lens.height) == (360, 480) and lens.is_pinhole
    expected = (719.9471435546875 / 2, 358.8895263671875 / 2, 484.92236328125 / 2)
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx(expected)
    center = -files.train[0].viewmat[:3, :3].T @ files.train[0].viewmat[:3, 3]
    expected = np.array([0, 4.656612873077393e-10, 0]) - [-0.20061972737312317, 0.1705830693244934, -1.1717479228973389]
    np.testing.assert_allclose(center, expected * 0.2715916376300303, atol=1e-9)
    assert files.train[-1].time == 276
    with pytest.raises(DataError, match=r"rgb/2x/0_00000.png: image is missing"):
        load(shared("paper-windmill"))


# -- Record3D ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamps", [True, False])
def test_record3d_is_read_back(scene, tmp_path, stamps):
    data = load(folders.write_record3d(scene, tmp_path / "set", stamps=stamps), holdout=0)
    first, rate = (5.0, 20) if stamps else (0.0, 30)
    assert len(data.train) == COUNT and data.time_range == pytest.approx((first, first + (COUNT - 1) / rate))
    for found, view in zip(data.train, scene.train, strict=False):
        assert_same(found, view)


# -- rigs --------------------------------------------------------------------------------------------------------------


def test_panoptic_is_read_back(scene, tmp_path):
    data = load(folders.write_panoptic(scene, tmp_path / "set"))
    assert len(data.test) == INSTANTS and len(data.train) == INSTANTS * (CAMERAS - 1)
    assert data.time_range == pytest.approx((0, (INSTANTS - 1) / 30))
    for found in (*data.train, *data.test):
        assert_same(found, scene.train[round(found.time * (INSTANTS - 1)) * CAMERAS + found.camera_id])
    assert {view.camera_id for view in data.test} == {0}
    np.testing.assert_allclose(data.points, scene.points[:POINTS], atol=1e-6)
    assert not load(tmp_path / "set", holdout=0).test
    (tmp_path / "set" / "test_meta.json").write_text((tmp_path / "set" / "train_meta.json").read_text())
    assert len(load(tmp_path / "set").test) == INSTANTS * CAMERAS


@pytest.mark.parametrize("layout", ["neu3d", "synchronised"])
def test_rigs_of_videos_are_read_back(scene, tmp_path, layout):
    pytest.importorskip("imageio_ffmpeg")
    data = load(getattr(folders, f"write_{layout}")(scene, tmp_path / "set"))
    assert len(data.train) == (CAMERAS - 1) * INSTANTS and len(data.test) == INSTANTS
    assert data.time_range == (0.0, pytest.approx((INSTANTS - 1) / FPS)) and {v.camera_id for v in data.test} == {0}
    for found in (*data.train, *data.test):
        views, t = rig_views(scene, found.camera_id), round(found.time * (INSTANTS - 1))
        np.testing.assert_allclose(found.viewmat, views[0].viewmat, atol=1e-6)
        np.testing.assert_array_equal(found.image, views[t].image)
        assert found.name == f"cam{found.camera_id}_{t:04d}" and found.K[0, 0] == pytest.approx(views[0].K[0, 0])
        centre = views[0].width / 2 if layout == "neu3d" else views[0].K[0, 2]
        assert found.K[0, 2] == pytest.approx(centre)
    assert layout != "neu3d" or (data.near, data.far) == (0.5, 9)
    assert not load(tmp_path / "set", holdout=0).test


def test_videos_smaller_than_their_poses_scale_the_lens(scene, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    folder = folders.write_neu3d(scene, tmp_path / "set")
    poses = np.load(folder / "poses_bounds.npy")
    poses[:, :15].reshape(-1, 3, 5)[:, :, 4] *= 2  # height, width and focal length of the full pictures
    np.save(folder / "poses_bounds.npy", poses)
    view = load(folder, downscale=2).train[0]
    np.testing.assert_allclose(view.K[0, 0], scene.train[0].K[0, 0] / 2, rtol=1e-6)
    assert (view.width, view.height) == (scene.train[0].width // 2, scene.train[0].height // 2)


def test_videos_of_a_distorting_lens_are_undistorted(scene, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    folder = folders.write_synchronised(scene, tmp_path / "set", "OPENCV", ".1 0 0 0")
    view = load(folder, downscale=2).train[0]
    assert (view.height, view.width) == view.mask.shape == view.image.shape[:2] and 0.5 < view.mask.mean() < 1


# -- COLMAP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap_is_read_back(scene, tmp_path, form):
    data = load(folders.write_colmap(scene, tmp_path / "set", form), holdout=4)
    assert len(data.train) == 9 and [view.name for view in data.test] == ["frame_0004", "frame_0012", "frame_0020"]
    found = sorted((*data.train, *data.test), key=lambda view: view.name)
    for i, (mine, view) in enumerate(zip(found, scene.train[:COUNT], strict=True)):
        assert_same(mine, view)
        assert mine.time == pytest.approx(i / 11) and mine.mask is None
    assert data.time_range == (0.0, 22.0)
    order = np.lexsort(data.points.T), np.lexsort(scene.points[:POINTS].T)
    np.testing.assert_allclose(data.points[order[0]], scene.points[:POINTS][order[1]], atol=1e-6)


def test_times_come_from_times_txt(scene, tmp_path):
    folder = folders.write_colmap(scene, tmp_path / "set")
    (folder / "times.txt").write_text("".join(f"{colmap_name(i)} {3 + i * i}\n" for i in range(COUNT)))
    data = load(folder, holdout=0)
    assert [view.time for view in data.train] == pytest.approx([i * i / 121 for i in range(COUNT)])
    assert data.time_range == (3.0, 124.0)


def test_distortion_of_a_colmap_camera_is_removed(scene, tmp_path):
    folder = folders.write_colmap(scene, tmp_path / "set", camera="OPENCV", extra=(0.1, -0.02, 0.003, -0.002))
    view = load(folder).train[0]
    assert view.mask is not None and 0.5 < view.mask.mean() < 1
    assert np.abs(view.image.astype(int) - scene.train[0].image).max() > 20
