"""Blender-like folders: axes, intrinsics, times, splits, background, points, box."""

import json
import struct

import numpy as np
import pytest
from folders import change_frames, gradient, pose
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import read_vertices


def test_axes_become_opencv(blender):
    d = load(blender(), holdout=0)
    for v in d.train:  # every camera looks at the origin from 4 away: ahead is +z, and world up (y) is image up (-y)
        assert v.viewmat.dtype == np.float32
        np.testing.assert_allclose(v.viewmat @ [0, 0, 0, 1], [0, 0, 4, 1], atol=1e-6)
        np.testing.assert_allclose(v.viewmat @ [0, 1, 0, 1], [0, -1, 4, 1], atol=1e-6)
    np.testing.assert_allclose(d.train[0].viewmat @ [1, 0, 0, 1], [1, 0, 4, 1], atol=1e-6)
    assert d.up == pytest.approx((0, 1, 0))


def test_focal_from_angle_and_centre(blender):
    v = load(blender()).train[0]
    f = 6 / np.tan(0.4)
    np.testing.assert_allclose(v.K, [[f, 0, 6], [0, f, 4], [0, 0, 1]], rtol=1e-6)


def test_frame_keys_go_before_file_keys(blender):
    d = load(blender(fl_x=20, fl_y=30, cx=5, cy=3.5, frame0={"fl_x": 21, "cx": 6.25}))
    np.testing.assert_allclose(d.train[0].K, [[21, 0, 6.25], [0, 30, 3.5], [0, 0, 1]])
    np.testing.assert_allclose(d.train[1].K, [[20, 0, 5], [0, 30, 3.5], [0, 0, 1]])


def test_downscale_is_the_block_mean_and_scales_k(blender):
    folder = blender(size=(13, 8), fl_x=20, fl_y=30, cx=5, cy=3.5)
    v = load(folder, downscale=3).train[0]
    image = gradient(13, 8).astype(float)[:6, :12]
    mean = image.reshape(2, 3, 4, 3, 3).mean(axis=(1, 3))
    assert (v.width, v.height) == (4, 2) == (v.image.shape[1], v.image.shape[0])
    assert np.abs(v.image - mean).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(v.K, np.array([[20, 0, 5], [0, 30, 3.5], [0, 0, 3]]) / 3, rtol=1e-6)


def test_holdout_and_times(blender):
    d = load(blender(n=14), holdout=8)
    assert [v.name for v in d.test] == ["r_004", "r_012"]
    assert [v.name for v in d.train[:5]] == ["r_000", "r_001", "r_002", "r_003", "r_005"]
    assert d.test[0].time == pytest.approx(4 / 13) and d.train[-1].time == 1.0 and d.train[0].time == 0.0
    assert d.time_range == (0.0, 1.3) and not d.masked
    assert len(load(blender(n=14), holdout=0).test) == 0


def test_missing_times_go_by_index(blender):
    folder = blender(n=5)
    change_frames(folder, lambda i: {"time": None})
    assert [v.time for v in load(folder, holdout=0).train] == [0, 0.25, 0.5, 0.75, 1]


def test_split_files_decide(blender):
    folder = blender(n=9, name="transforms_train.json")
    file = json.loads((folder / "transforms_train.json").read_text())
    (folder / "transforms_test.json").write_text(json.dumps({**file, "frames": file["frames"][3:5]}))
    d = load(folder)
    assert len(d.train) == 9 and [v.name for v in d.test] == ["r_003", "r_004"]
    assert d.test[0].time == pytest.approx(3 / 8)


@pytest.mark.parametrize("color", [None, (0.0, 0.0, 0.0), (0.2, 1.0, 0.6)])
def test_alpha_goes_on_the_background(blender, color):
    folder = blender(n=2)
    rgba = np.zeros((8, 12, 4), np.uint8)
    rgba[:, :6] = 200, 100, 0, 255
    rgba[:, 6:9] = 200, 100, 0, 51
    for i in range(2):
        Image.fromarray(rgba).save(folder / f"r_{i:03d}.png")
    d, behind = load(folder, holdout=0, background=color), color or (1, 1, 1)
    assert d.background == behind
    image = d.train[0].image
    assert image[0, 0].tolist() == [200, 100, 0] and image[0, 11].tolist() == [255 * v for v in behind]
    assert np.abs(image[0, 7] - (0.8 * 255 * np.array(behind) + 0.2 * np.array([200, 100, 0]))).max() <= 1


@pytest.mark.parametrize("color", [(255, 255, 255), (10, 200, 30)])
def test_uniform_border_is_the_background(blender, color):
    folder = blender(n=3)
    for i in range(3):
        image = np.full((8, 12, 3), color, np.uint8)
        image[3:5, 3:9] = 77
        Image.fromarray(image).save(folder / f"r_{i:03d}.png")
    for asked in (None, (0.5, 0.5, 0.5)):  # there is no alpha to see it through
        d = load(folder, background=asked)
        assert d.background == pytest.approx([c / 255 for c in color]) and d.train[0].image[0, 0].tolist() == [*color]


def test_busy_border_means_black(blender):
    assert load(blender()).background == (0, 0, 0)


def test_binary_and_ascii_points_agree(blender):
    folder = blender()
    xyz = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    head = "ply\nformat {} 1.0\ncomment x\nelement vertex 50\n" + "".join(f"property float {c}\n" for c in "xyz")
    head += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    rows = [(*p.tolist(), i, 2 * i, 255 - i) for i, p in enumerate(xyz)]
    body = b"".join(struct.pack("<3f3B", *r) for r in rows)
    (folder / "a.ply").write_bytes(head.format("binary_little_endian").encode() + body)
    binary = load(folder)
    (folder / "a.ply").write_text(head.format("ascii") + "".join(" ".join(map(repr, r)) + "\n" for r in rows))
    text = load(folder)
    for d in (binary, text):
        np.testing.assert_array_equal(d.points, xyz)
    inside = ((xyz >= binary.box[0]) & (xyz <= binary.box[1])).all(axis=1)
    assert inside.mean() >= 0.95


def test_named_points_go_before_the_only_one(blender):
    folder = blender(ply_file_path="b.ply")
    for name, x in (("a", 1.0), ("b", 2.0)):
        head = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {c}\n" for c in "xyz")
        (folder / f"{name}.ply").write_text(head + f"end_header\n{x} 0 0\n")
    d = load(folder)
    assert d.points.tolist() == [[2.0, 0.0, 0.0]]


def test_box_and_depth_without_points(blender):
    d = load(blender())
    np.testing.assert_allclose(d.box, [[-1.3] * 3, [1.3] * 3], atol=1e-5)
    assert d.near < 2.7 and d.far > 5.3


def test_stored_depth(blender):
    d = load(blender(near_far_per_frame=[[2.0, 6.0]] * 9))
    assert (d.near, d.far) == (1.0, 6.0)


def test_parallel_cameras_get_a_box_ahead(blender):
    folder = blender(n=2)
    change_frames(folder, lambda i: {"transform_matrix": [[1, 0, 0, i], *pose()[1:]]})
    d = load(folder, holdout=0)
    assert np.isfinite(d.box).all() and (d.box[1] > d.box[0]).all() and d.box.mean(axis=0)[2] < 4


def test_shelf_hand(shared):
    d = load(shared("shelf-hand"), downscale=2)
    assert (len(d.train), len(d.test)) == (75, 11) and d.train[0].image.shape == (192, 256, 3)
    assert d.points.shape == (12518, 3) and d.background == (0, 0, 0)
    v = d.train[30]
    camera = d.points @ v.viewmat[:3, :3].T + v.viewmat[:3, 3]
    pixel = camera @ v.K.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    inside = (camera[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < [v.width, v.height]).all(axis=1)
    assert inside.mean() > 0.4
    x, y = pixel[inside].astype(int).T
    (ply,) = shared("shelf-hand").glob("*.ply")
    colors = np.stack([read_vertices(ply)[name] for name in ("red", "green", "blue")], axis=1)[inside]
    error = np.abs(v.image[y, x].astype(float) - colors).mean()
    mirrored = np.abs(v.image[y, v.width - 1 - x].astype(float) - colors).mean()
    assert error < 0.6 * mirrored  # the points' colours are found where they project


def test_bouncing_balls(shared):
    d = load(shared("bouncing-balls"), downscale=8)
    assert (len(d.train), len(d.test)) == (140, 20) and d.background == (1, 1, 1)
    np.testing.assert_allclose(d.box, [[-1.3] * 3, [1.3] * 3], atol=1e-4)
    assert d.up == pytest.approx((0, 0, 1), abs=1e-6) and d.points is None
    assert d.train[0].K[0, 0] == pytest.approx(1111.111 / 8, rel=1e-5)


LENSES = {
    "pinhole": {},
    "distorted": {"camera_model": "OPENCV", "k1": 0.12, "k2": -0.03, "p1": 0.004, "p2": -0.003},
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001},
}


def _levels(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth picture [..., 3] at pixel coordinates."""
    return 128 + 50 * np.stack([np.sin(u / 7), np.cos(v / 6), np.sin((u + v) / 9)], axis=-1)


@pytest.mark.parametrize("name", LENSES)
def test_pictures_are_resampled_by_the_formulas_of_opencv(tmp_path, name):
    lens, (width, height) = LENSES[name], (80, 60)
    fx, fy, cx, cy = 75.0, 74.0, 40.75, 29.4
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    Image.fromarray(np.rint(_levels(u, v)).astype(np.uint8)).save(tmp_path / "0.png")
    content = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height, **lens}
    content["frames"] = [{"file_path": "0.png", "transform_matrix": pose()}]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    view = load(tmp_path, holdout=0).train[0]
    np.testing.assert_allclose(view.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6)

    x, y = (u - cx) / fx, (v - cy) / fy
    k, (p1, p2), r = (
        [lens.get(f"k{i}", 0.0) for i in range(1, 5)],
        (lens.get(f"p{i}", 0.0) for i in (1, 2)),
        np.hypot(x, y),
    )
    if name == "fisheye":
        angle = np.arctan(r)
        scale = angle * (1 + sum(k[i] * angle ** (2 * i + 2) for i in range(4))) / r
        xd, yd = scale * x, scale * y
    else:
        scale = 1 + sum(k[i] * r ** (2 * i + 2) for i in range(3))
        xd = scale * x + 2 * p1 * x * y + p2 * (r * r + 2 * x * x)
        yd = scale * y + p1 * (r * r + 2 * y * y) + 2 * p2 * x * y
    seen = np.ones(u.shape, bool) if view.mask is None else view.mask
    assert (view.mask is None) == (name == "pinhole") and seen.mean() > 0.8
    assert np.abs(view.image - _levels(fx * xd + cx, fy * yd + cy))[seen].max() < 2


@pytest.mark.slow
def test_mutant(official):
    """D-NeRF's split: the test file goes before the validation file, and the camera's box is D-NeRF's."""
    d = load(official("mutant"), downscale=8, background=(0.0, 0.0, 0.0))
    assert (len(d.train), len(d.test)) == (150, 20) and d.background == (0, 0, 0) and d.points is None
    assert all((view.image[0] == 0).all() and view.image.max() > 100 for view in d.test)
    np.testing.assert_allclose(d.box, [[-1.3] * 3, [1.3] * 3], atol=0.1)


@pytest.mark.slow
def test_basketball(official):
    d = load(official("basketball"), downscale=8)
    assert (len(d.train), len(d.test)) == (27 * 150, 4 * 150) and len({view.camera_id for view in d.test}) == 4
