"""Every broken input is one DataError of one line that says what and where."""

import json

import numpy as np
import pytest
from dataset_pictures import pose
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DataError

NAN = float("nan")


def stretched():
    p = pose()
    p[0][0] *= 1.1
    return p


def mirrored():
    p = pose()
    p[1][1] = -1
    return p


def with_nan():
    p = pose()
    p[0][3] = NAN
    return p


TABLE = {
    "nan focal": (dict(fl_x=NAN), "fl_x is nan"),
    "zero focal": (dict(fl_x=0), "fl_x is 0, expected a number > 0"),
    "huge focal": (dict(fl_x=10**400), "fl_x is 1000"),
    "text focal": (dict(fl_x="wide"), "fl_x is 'wide'"),
    "no focal": (dict(camera_angle_x=None), "no focal length"),
    "angle over pi": (dict(camera_angle_x=3.5), "expected radians below pi"),
    "stretched pose": (dict(frame0={"transform_matrix": stretched()}), "frame 0: transform_matrix is not a rotation"),
    "mirrored pose": (dict(frame0={"transform_matrix": mirrored()}), "determinant -1"),
    "nan pose": (dict(frame0={"transform_matrix": with_nan()}), "frame 0: transform_matrix holds NaN"),
    "short pose": (dict(frame0={"transform_matrix": [[1, 0], [0, 1]]}), "has shape"),
    "no pose": (dict(frame0={"transform_matrix": None}), "transform_matrix"),
    "no file path": (dict(frame0={"file_path": None}), "frame 0 has no file_path"),
    "missing image": (dict(frame0={"file_path": "gone/r_000"}), "gone/r_000: image is missing"),
    "wrong size": (dict(w=16, h=8), "r_000.png: image is 12x8, expected 16x8"),
    "nan time": (dict(frame0={"time": NAN}), "frame 0: time is nan"),
    "no frames": (dict(n=0), "found no frames, expected a list of at least 1"),
    "missing points": (dict(ply_file_path="gone.ply"), "gone.ply: cannot be read"),
    "near over far": (dict(near_far_per_frame=[[3, 1]] * 9), "expected 0 < near < far"),
    "short near far": (dict(near_far_per_frame=[[1, 3]]), "near_far_per_frame has shape (1, 2), expected (9, 2)"),
}


def refused(source, text, **options):
    with pytest.raises(DataError) as caught:
        load(source, **options)
    message = str(caught.value)
    assert text in message and "\n" not in message and len(message) < 500
    return message


@pytest.mark.parametrize("case", TABLE)
def test_broken_blender_folders(blender, case):
    keys, text = TABLE[case]
    folder = blender(**keys)
    assert str(folder) in refused(folder, text)


def test_missing_and_empty_folders(tmp_path):
    refused(tmp_path / "gone", "gone: found nothing, expected a dataset folder")
    refused(tmp_path, "found an empty folder, expected camera/")
    (tmp_path / "readme.txt").write_text("x")
    refused(tmp_path, "found other files")
    refused(tmp_path / "readme.txt", "found a file")


def test_broken_json_names_the_line(blender):
    folder = blender()
    (folder / "transforms.json").write_text('{\n "w": 3,\n "h": ]\n}')
    refused(folder, "transforms.json: line 3, column 7: broken JSON")
    (folder / "transforms.json").write_text("[1]")
    refused(folder, "found a JSON list, expected an object")
    (folder / "transforms.json").write_bytes(b"\xff\xfe\x00")
    refused(folder, "cannot be read as JSON")
    (folder / "transforms.json").write_text('{"fl_x": 1' + "0" * 5000 + "}")
    refused(folder, "transforms.json")


def test_several_files_without_a_rule(blender):
    folder = blender(name="transforms_a.json")
    (folder / "transforms_b.json").write_text("{}")
    refused(folder, "found transforms_a.json, transforms_b.json; expected")


@pytest.mark.parametrize("content", [b"", b"not a png", None], ids=["empty", "text", "cut"])
def test_broken_image(blender, content):
    folder = blender()
    whole = (folder / "r_002.png").read_bytes()
    (folder / "r_002.png").write_bytes(whole[: len(whole) // 2] if content is None else content)
    refused(folder, "r_002.png")


@pytest.mark.parametrize("k", [0, -1, 2.0, True, 9])
def test_downscale(blender, k):
    refused(blender(), f"downscale {k}" if k == 9 else f"downscale is {k}", downscale=k)


@pytest.mark.parametrize("k", [1, -2])
def test_holdout_that_leaves_nothing(blender, k):
    refused(blender(), f"holdout {k} leaves no training frame", holdout=k)


@pytest.mark.parametrize("name", ["", "nothing", "Static", "nothing?seed=1"])
def test_unknown_synthetic(name):
    refused(f"synthetic:{name}", "expected synthetic:static|global|local|fast[?seed=n&size=WxH&frames=N]")


@pytest.mark.parametrize(
    "query", ["seed=-1", "seed=x", "size=160", "size=7x160", "size=9000x9000", "frames=2", "frames="]
)
def test_synthetic_option_of_another_value(query):
    refused(f"synthetic:static?{query}", f"{query.split('=')[0]} is {query.split('=')[1]!r}; expected for example")


@pytest.mark.parametrize("query", ["", "a", "seed=1&a", "seed=1&seed=1", "seed=1&"])
def test_unknown_option_of_a_synthetic_scene(query):
    refused(f"synthetic:static?{query}", "expected each of seed, size, frames once at most, as key=value")


def test_synthetic_downscale_too_large():
    refused("synthetic:static", "downscale 200 leaves nothing of 160x120", downscale=200)


HEAD = "ply\nformat {} 1.0\nelement vertex 2\n{}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "not a PLY file"),
        (HEAD.format("binary_big_endian", XYZ).encode(), "expected ascii or binary_little_endian"),
        (HEAD.format("binary_little_endian", XYZ).encode() + b"\0" * 23, "23 bytes of vertices, expected 24"),
        (HEAD.format("ascii", XYZ).encode() + b"1 2 3\n", "1 vertex lines, expected 2"),
        (HEAD.format("ascii", XYZ).encode() + b"1 2 3\n1 2\n", "vertex lines are not 3 numbers"),
        (HEAD.format("ascii", "property float x\n").encode() + b"1\n2\n", "expected x, y, z once each"),
        (HEAD.format("ascii", "property list uchar int i\n").encode(), "not a scalar"),
        (HEAD.format("ascii", XYZ).replace("2\n", "99999999999\n", 1).encode(), "0 vertex lines"),
    ],
)
def test_broken_points(blender, content, text):
    folder = blender()
    (folder / "p.ply").write_bytes(content)
    assert "p.ply" in refused(folder, text)


def camera_folder(tmp_path, camera=None, metadata=None, scene=None, extra=None, names=("0_00000",)):
    eye = np.eye(3).tolist()
    base = dict(orientation=eye, position=[0, 0, 0], focal_length=10, principal_point=[6, 4], image_size=[12, 8])
    files = {
        "camera/0_00000.json": {**base, **(camera or {})},
        "metadata.json": {"0_00000": {"warp_id": 0, "camera_id": 0}} if metadata is None else metadata,
        "scene.json": {"center": [0, 0, 0], "scale": 1, "near": 1, "far": 2, **(scene or {})},
        "extra.json": {"factor": 1, "fps": 30, "bbox": [[0, 0, 0], [1, 1, 1]], **(extra or {})},
        "splits/train.json": {"frame_names": list(names)},
    }
    for name, value in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(json.dumps(value))
    (tmp_path / "rgb" / "1x").mkdir(parents=True)
    Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(tmp_path / "rgb" / "1x" / "0_00000.png")
    return tmp_path


def test_the_unbroken_camera_folder_loads(tmp_path):
    d = load(camera_folder(tmp_path))
    assert len(d.train) == 1 and d.test == () and d.time_range == (0, 1)


@pytest.mark.parametrize(
    ("broken", "text"),
    [
        (dict(camera={"focal_length": NAN}), "0_00000.json: focal_length is nan"),
        (dict(camera={"focal_length": None}), "0_00000.json: no focal_length"),
        (dict(camera={"orientation": (2 * np.eye(3)).tolist()}), "orientation is not a rotation: determinant 8"),
        (dict(camera={"position": [0, 0]}), "position has shape (2,), expected (3,)"),
        (dict(camera={"image_size": [1, 1]}), "expected at least 2x2"),
        (dict(camera={"image_size": [14, 8]}), "image is 12x8, expected 14x8"),
        (dict(metadata={}), "no entry for frame '0_00000'"),
        (dict(metadata={"0_00000": {}}), "warp_id is None"),
        (dict(names=()), "0 training frames, expected at least 1"),
        (dict(names=(3,)), "not a list of frame names"),
        (dict(scene={"scale": 0}), "scale is 0"),
        (dict(scene={"near": 5}), "near 5 and far 2"),
        (dict(extra={"factor": 1.5}), "factor is 1.5"),
        (dict(extra={"bbox": [[1, 1, 1], [0, 0, 0]]}), "expected a lower and an upper corner"),
        (dict(extra={"fps": 0}), "fps is 0"),
        (dict(extra={"fps": 1e-300}, metadata={"0_00000": {"warp_id": 9}}), "with which the last frame is at 9e+300 s"),
    ],
)
def test_broken_camera_folders(tmp_path, broken, text):
    refused(camera_folder(tmp_path, **broken), text)


def test_points_that_are_not_numbers(tmp_path):
    folder = camera_folder(tmp_path)
    (folder / "points.npy").write_bytes(b"junk")
    refused(folder, "points.npy: not a .npy file")
    np.save(folder / "points.npy", np.zeros((3, 2)))
    refused(folder, "found float64 (3, 2), expected floats [M, 3]")
    np.save(folder / "points.npy", np.array([{}], dtype=object), allow_pickle=True)
    refused(folder, "points.npy")
