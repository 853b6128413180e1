"""Blender-like folders: axes, intrinsics, times, splits, background, points, box; written and damaged."""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import NAN, change_frames, gradient, pose, save
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import read_vertices

FRAMES = [{"file_path": f"r_{i}", "time": i / 10, "transform_matrix": pose(0.2 * i)} for i in range(3)]
XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(form: str, body: bytes = b"", properties: str = XYZ, vertices: int = 2) -> bytes:
    return f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{properties}end_header\n".encode() + body


def write_blender(_: object, folder: Path) -> Path:
    """Three frames, points, depths and a distorting lens."""
    file = {"camera_angle_x": 0.8, "w": 12, "h": 8, "k1": 0.01, "near_far_per_frame": [[1, 9]] * 3, "frames": FRAMES}
    save(folder / "transforms.json", file | {"ply_file_path": "points.ply"})
    save(folder / "points.ply", ply("ascii", b"0 0 0\n1 1 1\n"))
    for i in range(3):
        save(folder / f"r_{i}.png", gradient(12, 8, i))
    save(folder.parent / "outside" / "r_0.png", gradient(12, 8))
    (folder / "out").symlink_to(folder.parent / "outside")
    return folder


def frame(**keys: Any) -> Callable[[dict], dict]:
    """A change of frame 0 of transforms.json."""
    return lambda value: value | {"frames": [value["frames"][0] | keys, *value["frames"][1:]]}


def gone(name: str) -> dict:
    """A frame whose picture is missing."""
    return FRAMES[0] | {"file_path": name}


def entry(i: int, j: int, value: float) -> list:
    """A pose with another number."""
    matrix = np.array(pose())
    matrix[i, j] = value
    return matrix.tolist()


def blank() -> bytes:
    """A black PNG of 4 kB and 33 megapixels."""
    stream = io.BytesIO()
    Image.new("1", (8192, 4096)).save(stream, "png")
    return stream.getvalue()


def scans() -> bytes:
    """A progressive JPEG whose last pass comes a hundred times more."""
    stream = io.BytesIO()
    Image.new("L", (12, 8), 128).save(stream, "jpeg", progressive=True)
    raw = stream.getvalue()[:-2]
    return raw + 100 * raw[raw.rindex(b"\xff\xda") :] + b"\xff\xd9"


LAYOUTS = {"blender": write_blender}
FAULTS = {
    "blender": [
        ("transforms.json", dict(fl_x=NAN), "fl_x is nan"),
        ("transforms.json", dict(fl_x=0), "fl_x is 0, expected a number > 0"),
        ("transforms.json", dict(fl_x=10**400), "fl_x is 1000"),
        ("transforms.json", dict(fl_x="wide"), "fl_x is 'wide'"),
        ("transforms.json", dict(camera_angle_x=None), "no focal length"),
        ("transforms.json", dict(camera_angle_x=3.5), "expected radians below pi"),
        ("transforms.json", dict(camera_model="THIN_PRISM_FISHEYE"), "THIN_PRISM_FISHEYE"),
        ("transforms.json", frame(transform_matrix=entry(0, 0, 1.1)), "frame 0: transform_matrix is not a rot"),
        ("transforms.json", frame(transform_matrix=entry(1, 1, -1)), "determinant -1"),
        ("transforms.json", frame(transform_matrix=entry(0, 3, NAN)), "frame 0: transform_matrix holds NaN"),
        ("transforms.json", frame(transform_matrix=[[1, 0], [0, 1]]), "has shape"),
        ("transforms.json", frame(transform_matrix=None), "transform_matrix"),
        ("transforms.json", frame(file_path=None), "frame 0 has no file_path"),
        ("transforms.json", {"frames": [gone("gone/r_0")], "near_far_per_frame": None}, "gone/r_0: image is missing"),
        ("transforms.json", dict(w=16, h=8), "r_0.png: image is 12x8, expected 16x8"),
        ("transforms.json", frame(time=NAN), "frame 0: time is nan"),
        ("transforms.json", dict(frames=[]), "found no frames, expected a list of at least 1"),
        ("transforms.json", dict(ply_file_path="gone.ply"), "gone.ply: cannot be read"),
        ("transforms.json", dict(near_far_per_frame=[[3, 1]] * 3), "expected 0 < near < far"),
        ("transforms.json", dict(near_far_per_frame=[[1, 3]]), "has shape (1, 2), expected (3, 2)"),
        ("transforms.json", b'{\n "w": 3,\n "h": ]\n}', "transforms.json: line 3, column 7: broken JSON"),
        ("transforms.json", b'{"a":' + b"[" * 500_000, "cannot be read as JSON"),
        ("transforms.json", b"[1]", "found a JSON list, expected an object"),
        ("transforms.json", b"\xff\xfe\x00", "cannot be read as JSON"),
        ("transforms.json", b'{"fl_x": 1' + b"0" * 5000 + b"}", "transforms.json"),
        ("r_1.png", b"", "r_1.png"),
        ("r_1.png", b"not a png", "r_1.png"),
        ("r_1.png", lambda data: data[: len(data) // 2], "r_1.png"),
        ("points.ply", b"", "points.ply: not a PLY file"),
        ("points.ply", b"ply\nformat ascii 1.0\n", "not a PLY file"),
        ("points.ply", ply("binary_pdp_endian"), "expected ascii, binary_little_endian, binary_big_endian"),
        ("points.ply", ply("binary_little_endian", bytes(23)), "23 bytes of vertices, expected 24"),
        ("points.ply", ply("ascii", b"1 2 3\n"), "1 vertex lines, expected 2"),
        ("points.ply", ply("ascii", b"1 2 3\n1 2\n"), "vertex lines are not 3 numbers"),
        ("points.ply", ply("ascii", b"1\n2\n", "property float x\n"), "expected x, y, z once each"),
        ("points.ply", ply("ascii", b"", "property list uchar int i\n"), "expected a scalar"),
        ("points.ply", ply("ascii").replace(b"2\n", b"99999999999\n", 1), "0 vertex lines"),
        ("transforms.json", {"camera_model": ["PINHOLE"]}, "camera_model is ['PINHOLE'], expected a name"),
        ("transforms.json", {"camera_model": {}}, "camera_model is {}, expected a name"),
        ("transforms.json", frame(mask_path=3), "mask_path is 3, expected the name of a picture"),
        ("transforms.json", frame(mask_path="m/0.png"), "m/0.png: image is missing"),
        ("transforms.json", {"train_filenames": ["r_0"]}, "test_filenames is None, expected a list of frames"),
        ("transforms.json", {"train_filenames": 3}, "train_filenames is 3, expected a list of frames"),
        ("transforms.json", {"train_filenames": ["r_7"]}, "train_filenames is ['r_7'], expected a list of frames"),
        ("transforms.json", {"test_filenames": [["r_0"]]}, "train_filenames is None, expected a list of frames"),
        ("transforms.json", {"ply_file_path": "../points.ply"}, "'../points.ply' is not the name of a file in"),
        ("transforms.json", {"ply_file_path": "/etc/passwd"}, "'/etc/passwd' is not the name of a file in"),
        ("transforms.json", {"ply_file_path": "p\0.ply"}, "is not the name of a file in"),
        *(
            ("transforms.json", frame(file_path=name), "is not the name of a file in")
            for name in ("../r_0", "/r_0", "a/../../r_0", "out/r_0", "r\0", "", ".")
        ),
        *(
            ("transforms.json", {"frames": [gone(name)], "near_far_per_frame": None}, "image is missing")
            for name in ("x" * 300, "\x1b]0;x\x07" * 40)
        ),
        ("transforms.json", {"frames": FRAMES * 5, "near_far_per_frame": None}, "15 frames of 3 pictures"),
        ("r_0.png", lambda _: blank(), "33,554,432 pixels, expected"),
        ("r_0.png", lambda _: scans(), "scans, expected 100 at most in a JPEG"),
        ("r_0.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 8\n", "not an image that can be read"),
    ],
}  # fmt: skip


# -- reading -----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("partly", [False, True])
def test_missing_times_are_the_numbers_of_the_names_in_any_order(blender, partly):
    folder = blender(n=5)
    change_frames(folder, lambda i: {} if partly and i else {"time": None})
    file = json.loads((folder / "transforms.json").read_text())
    save(folder / "transforms.json", file | {"frames": [file["frames"][i] for i in (3, 0, 4, 1, 2)]})
    d = load(folder, holdout=0)
    assert [(v.name, v.time) for v in d.train] == [(f"r_{i:03d}", i / 4) for i in (3, 0, 4, 1, 2)]
    assert d.time_range == (0.0, pytest.approx(4 / 30)) and d.origin.times == "the last number of each name"
    assert [r for r in d.remarks() if "no time counts" in r] == [
        "no time counts, as frames have none (1): r_000"
    ] * partly
    slow = load(folder, holdout=0, fps=2.0)
    assert slow.time_range == (0.0, pytest.approx(2)) and slow.origin.fps == 2


def test_names_without_numbers_go_by_their_order(blender):
    folder = blender(n=3)
    for i, name in enumerate("cab"):
        (folder / f"r_00{i}.png").rename(folder / f"{name}.png")
    change_frames(folder, lambda i: {"time": None, "file_path": "cab"[i]})
    d = load(folder, holdout=0)
    assert [v.time for v in d.train] == [1, 0, 0.5] and d.origin.times == "the order of the names"


def test_a_rate_that_has_no_effect_is_told(blender):
    assert load(blender(), fps=10.0).remarks() == ["--fps 10 has no effect, since times are known otherwise"]


def test_split_files_decide(blender):
    folder = blender(n=9, name="transforms_train.json")
    file = json.loads((folder / "transforms_train.json").read_text())
    save(folder / "transforms_test.json", {**file, "frames": file["frames"][3:5]})
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
        save(folder / f"r_{i:03d}.png", rgba)
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
        save(folder / f"r_{i:03d}.png", image)
    for asked in (None, (0.5, 0.5, 0.5)):  # the pictures stay as they are
        d = load(folder, background=asked)
        assert d.background == (asked or pytest.approx([c / 255 for c in color]))
        assert d.train[0].image[0, 0].tolist() == [*color]
    save(folder / "r_001.png", np.full((8, 12, 4), 9, np.uint8))
    assert load(folder, holdout=0).background == (1, 1, 1)  # one picture has alpha


def test_busy_border_means_black(blender):
    assert load(blender()).background == (0, 0, 0)


def test_a_synthetic_scene_takes_another_background():
    source = "synthetic:static?frames=3&size=16x12"
    assert load(source, downscale=4, background=(1.0, 0.0, 0.0)).background == (1, 0, 0)


def test_binary_and_ascii_points_agree(blender):
    folder = blender()
    xyz = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    properties = f"comment x\n{XYZ}property uchar red\nproperty uchar green\nproperty uchar blue\n"
    rows = [(*p.tolist(), i, 2 * i, 255 - i) for i, p in enumerate(xyz)]
    packed = b"".join(struct.pack("<3f3B", *row) for row in rows)
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    for form, body in (("binary_little_endian", packed), ("ascii", text)):
        save(folder / "a.ply", ply(form, body, properties, len(xyz)))
        d = load(folder)
        np.testing.assert_array_equal(d.points, xyz)
        assert ((xyz >= d.box[0]) & (xyz <= d.box[1])).all(axis=1).mean() >= 0.95


CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def corners(scale: float) -> bytes:
    """A PLY file of four points that span a volume."""
    body = "".join(f"{x * scale} {y * scale} {z * scale}\n" for x, y, z in CORNERS)
    return ply("ascii", body.encode(), vertices=4)


def test_named_points_go_before_the_only_one(blender):
    folder = blender(ply_file_path="b.ply")
    for name, scale in (("a", 1.0), ("b", 2.0)):
        save(folder / f"{name}.ply", corners(scale))
    assert load(folder).points.max() == 2


def test_hidden_files_are_no_points(blender):
    folder = blender(ply_file_path=None)
    save(folder / "a.ply", corners(1.0))
    save(folder / "._a.ply", b"of macOS")
    assert load(folder).points.tolist() == CORNERS


LINE = [[0.01 * i, 0.0, 0.5] for i in range(100)]
FLAT = {
    "none": [],
    "one": [[0.0, 0.0, 0.5]],
    "three": [[0.0, 0.0, 0.5], [0.2, 0.1, 0.6], [-0.8, -0.8, 0.4]],
    "at one place": [[0.2, 0.1, 0.6]] * 500,
    "on a line": LINE,
    "on a far plane": [[100 + x, 3 * x * y, 200 - x] for x, _, _ in LINE for y in (0.0, 0.3)],
}


@pytest.mark.parametrize("kind", FLAT)
def test_points_that_span_no_volume_decide_nothing_and_are_counted(blender, kind):
    without, folder = load(blender()), blender()
    body = "".join(f"{x} {y} {z}\n" for x, y, z in FLAT[kind])
    save(folder / "points.ply", ply("ascii", body.encode(), vertices=len(FLAT[kind])))
    d = load(folder)
    assert d.points is None and (d.near, d.far) == (without.near, without.far)
    np.testing.assert_array_equal(d.box, without.box)
    told = [remark for remark in d.remarks() if "span no volume" in remark]
    assert len(told) == bool(FLAT[kind]) and all(f" {len(FLAT[kind])} " in remark for remark in told)


@pytest.mark.parametrize("unit, offset", [(1e-3, 1e3), (1.0, 5e6), (1e3, 1e5)])
def test_a_scene_far_from_0_is_moved_and_keeps_its_views(blender, unit, offset):
    """The poses are read in binary64; binary32 would round the farthest ones to half a unit."""
    at = offset * np.array([1.0, -1.0, 0.3])

    def at_place(i):
        matrix = np.array(pose(0.2 * i))
        matrix[:3, 3] = matrix[:3, 3] * unit + at
        return {"transform_matrix": matrix.tolist()}

    folder = blender()
    save(folder / "points.ply", corners(1.0))
    near = load(folder)
    change_frames(folder, at_place)
    body = "".join(" ".join(repr(float(v)) for v in np.array(p) * unit + at) + "\n" for p in CORNERS)
    save(folder / "points.ply", ply("ascii", body.encode(), XYZ.replace("float", "double"), vertices=4))
    far = load(folder)
    moved = np.array(far.shift)
    assert (far.place != "") == (offset / unit > 200) and np.abs(far.box).max() < 250 * unit
    assert any(far.place in remark for remark in far.remarks()) or not far.place
    for a, b in zip(near.train, far.train, strict=True):
        centre = -b.viewmat[:3, :3].T @ b.viewmat[:3, 3] + moved
        np.testing.assert_allclose(
            centre, -a.viewmat[:3, :3].T @ a.viewmat[:3, 3] * unit + at, rtol=0, atol=1e-4 * unit
        )
    np.testing.assert_allclose(far.points + moved, near.points * unit + at, rtol=0, atol=1e-4 * unit)
    np.testing.assert_allclose((far.near, far.far), np.array((near.near, near.far)) * unit, rtol=1e-4)


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


@pytest.mark.slow
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
    "fisheye of instant-ngp": {"is_fisheye": True, "k1": 0.05, "k2": -0.01, "k3": 0, "k4": 0},
}


def _levels(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A smooth picture [..., 3] at pixel coordinates."""
    return 128 + 50 * np.stack([np.sin(u / 7), np.cos(v / 6), np.sin((u + v) / 9)], axis=-1)


@pytest.mark.parametrize("name", LENSES)
def test_pictures_are_resampled_by_the_formulas_of_opencv(tmp_path, name):
    lens, (width, height) = LENSES[name], (80, 60)
    fx, fy, cx, cy = 75.0, 74.0, 40.75, 29.4
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    save(tmp_path / "0.png", np.rint(_levels(u, v)).astype(np.uint8))
    content = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height, **lens}
    content["frames"] = [{"file_path": "0.png", "transform_matrix": pose()}]
    save(tmp_path / "transforms.json", content)
    view = load(tmp_path, holdout=0).train[0]
    np.testing.assert_allclose(view.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-6)

    x, y = (u - cx) / fx, (v - cy) / fy
    k, r = [lens.get(f"k{i}", 0.0) for i in range(1, 5)], np.hypot(x, y)
    p1, p2 = (lens.get(f"p{i}", 0.0) for i in (1, 2))
    if "fisheye" in name:
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


@pytest.mark.parametrize("name", LENSES)
def test_masks_of_frames_are_read_and_resampled(tmp_path, name):
    """Black beside a slanted line; the second frame has no mask."""
    u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    levels, black = _levels(u, v).astype(np.uint8), u + v / 2 < 30
    levels[black] = 0  # so that a resampled pixel is as dark as its share of invalid ones
    save(tmp_path / "0.png", levels)
    save(tmp_path / "masks" / "0.png", np.where(black, 0, 255).astype(np.uint8))
    frame = {"file_path": "0.png", "transform_matrix": pose()}
    frames = [frame | {"mask_path": "masks/0.png"}, frame]
    save(tmp_path / "transforms.json", {"fl_x": 75, **LENSES[name], "frames": frames})
    for downscale in (1, 3):
        view, bare = load(tmp_path, holdout=0, downscale=downscale).train
        seen = np.ones(view.image.shape[:2], bool) if bare.mask is None else bare.mask
        dark = view.image.min(axis=2) < 60
        assert 0.1 < dark.mean() < 0.3 and not view.mask[dark].any()
        assert view.mask[seen].mean() > 0.7 and not view.mask[~seen].any()


@pytest.mark.parametrize("held", ["test_filenames", "val_filenames"])
def test_a_listed_split_goes_before_the_holdout(tmp_path, held):
    """nerfstudio's lists, in their order; the fourth frame is in none of them and not read."""
    write_blender(None, tmp_path / "scene")
    path = tmp_path / "scene" / "transforms.json"
    frames = [{k: v for k, v in f.items() if k != "time"} for f in (*FRAMES, FRAMES[0] | {"file_path": "r_2.png"})]
    file = json.loads(path.read_text()) | {"frames": frames, "near_far_per_frame": None}
    save(path, file | {"train_filenames": ["r_2", "r_0", "r_2"], "test_filenames": [], held: ["r_1"]})
    d = load(tmp_path / "scene", holdout=2)
    assert [view.name for view in d.train] == ["r_2", "r_0"] and [view.name for view in d.test] == ["r_1"]
    assert [view.time for view in d.train + d.test] == pytest.approx([1, 0, 1 / 2])


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
