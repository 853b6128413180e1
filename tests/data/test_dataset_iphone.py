"""The iPhone layout: writing and reading back, distortion, splits, paper-windmill's cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest
from iphone_export import export_iphone
from PIL import Image

from pd4dgs_codec.data import synthetic
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.iphone import read_cameras
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError


def edit(path, **keys):
    value = json.loads(path.read_text())
    value.update(keys)
    path.write_text(json.dumps(value))


def same_views(a, b):
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        assert (x.name, x.camera_id, x.width, x.height) == (y.name, y.camera_id, y.width, y.height)
        assert x.time == pytest.approx(y.time, abs=1e-6)
        np.testing.assert_allclose(x.viewmat, y.viewmat, atol=2e-6)
        np.testing.assert_allclose(x.K, y.K, rtol=1e-6)
        np.testing.assert_array_equal(x.image, y.image)
        assert (x.mask is None) == (y.mask is None)
        if x.mask is not None:
            np.testing.assert_array_equal(x.mask, y.mask)


def test_full_scene_round_trip(tmp_path):
    a = load("synthetic:local?frames=6")
    export_iphone(a, tmp_path / "out")
    b = load(tmp_path / "out")
    same_views(a.train + a.test, b.train + b.test)
    assert a.masked and b.masked
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_allclose(a.box, b.box)
    assert (a.near, a.far, a.up, a.background) == (b.near, b.far, b.up, b.background)
    assert b.time_range == pytest.approx(a.time_range)
    for v in (synthetic._shrink(v, 2) for v in a.test[:3]):  # the 2x pictures and masks are those of downscale 2
        with Image.open(tmp_path / "out" / "rgb" / "2x" / f"{v.name}.png") as image:
            np.testing.assert_array_equal(np.array(image), v.image)
        with Image.open(tmp_path / "out" / "covisible" / "2x" / "val" / f"{v.name}.png") as image:
            np.testing.assert_array_equal(np.array(image) > 0, v.mask)


def tiny(test_times=(1 / 3,)) -> Dataset:
    """Views 0_00000 to 0_00002 to train on, held-out ones from 1_00001 on."""
    rng = np.random.default_rng(0)
    K = np.array([[20, 0, 7], [0, 22, 6.5], [0, 0, 1]], np.float32)

    def view(i, t, camera):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, 3] = i
        image = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8)
        return View(viewmat, K, 16, 12, t, image, None, f"{camera}_{i:05d}", camera)

    train = tuple(view(i, t, 0) for i, t in enumerate((0.0, 1 / 3, 1.0)))
    test = tuple(view(i, t, 1) for i, t in enumerate(test_times, 1))
    box = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    return Dataset("tiny", train, test, None, None, box, 0.1, 9.0, (0, 0, 0), (0, 1), (0, 1, 0), 0, False)


@pytest.fixture
def exported(tmp_path):
    export_iphone(tiny(), tmp_path / "out")
    return tmp_path / "out"


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


def test_distorted_views_get_a_border_mask(exported):
    edit(exported / "camera" / "1_00001.json", tangential_distortion=[0.02, -0.03], radial_distortion=[0.3, 0.1, 0.0])
    d = load(exported)
    assert d.test[0].mask is not None and 0.3 < d.test[0].mask.mean() < 1 and d.train[0].mask is None


def test_skew_is_straightened(exported):
    edit(exported / "camera" / "0_00000.json", skew=4.0)
    d = load(exported)
    assert d.train[0].K[0, 1] == 0 and d.train[0].mask is not None


def masked_tiny() -> Dataset:
    d, mask = tiny(test_times=(1 / 3, 1.0)), np.ones((12, 16), bool)
    mask[:, 8] = False
    return replace(d, test=tuple(replace(v, mask=mask) for v in d.test), masked=True)


def test_border_and_covisibility_both_count(tmp_path):
    export_iphone(masked_tiny(), tmp_path / "out")
    edit(tmp_path / "out" / "camera" / "1_00001.json", radial_distortion=[0.9, 0.0, 0.0])
    mask = load(tmp_path / "out").test[0].mask
    assert not mask[:, 8].any() and not mask[0, 0] and not mask[-1, -1] and mask[6, 7]


def test_missing_covisible_mask(tmp_path):
    export_iphone(masked_tiny(), tmp_path / "out")
    next((tmp_path / "out" / "covisible" / "1x" / "val").iterdir()).unlink()
    with pytest.raises(DataError, match="covisibility mask is missing"):
        load(tmp_path / "out")


def test_hypernerf_rule(exported):
    names = [f"0_{i:05d}" for i in range(9)]
    camera = (exported / "camera" / "0_00000.json").read_text()
    image = (exported / "rgb" / "1x" / "0_00000.png").read_bytes()
    for name in names:
        (exported / "camera" / f"{name}.json").write_text(camera)
        (exported / "rgb" / "1x" / f"{name}.png").write_bytes(image)
    edit(exported / "metadata.json", **{n: {"time_id": i, "camera_id": 0} for i, n in enumerate(names)})
    edit(exported / "dataset.json", ids=names, train_ids=names, val_ids=[])
    for split in ("train", "val"):
        (exported / "splits" / f"{split}.json").unlink()
    d = load(exported)
    assert [v.name for v in d.train] == [names[0], names[4], names[8]]
    assert [v.name for v in d.test] == [names[2], names[6]] and d.test[0].time == 0.25


def test_paper_windmill_cameras(shared):
    files = read_cameras(shared("paper-windmill"))
    assert (len(files.train), len(files.test)) == (277, 419) and files.factor == 2
    assert {f.camera_id for f in files.train} == {0} and {f.camera_id for f in files.test} == {1, 2}
    lens = files.train[0].lens
    assert (lens.width, lens.height) == (360, 480) and lens.is_pinhole
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx(
        (719.9471435546875 / 2, 358.8895263671875 / 2, 484.92236328125 / 2)
    )
    center = -files.train[0].viewmat[:3, :3].T @ files.train[0].viewmat[:3, 3]
    expected = np.array([0, 4.656612873077393e-10, 0]) - [-0.20061972737312317, 0.1705830693244934, -1.1717479228973389]
    np.testing.assert_allclose(center, expected * 0.2715916376300303, atol=1e-9)
    assert files.train[-1].time == 276


def test_paper_windmill_has_no_images(shared):
    with pytest.raises(DataError, match=r"rgb/2x/0_00000.png: image is missing"):
        load(shared("paper-windmill"))
