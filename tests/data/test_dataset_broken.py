"""Every broken input of every reader is one DataError of one line that says what and where."""

from __future__ import annotations

import io
import json
import os
import stat
import struct
import time
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import folders
import numpy as np
import pytest
from folders import CAMERAS, COUNT, INSTANTS, pose, save
from PIL import Image

NAN = float("nan")
FRAMES = [{"file_path": f"r_{i}", "time": i / 10, "transform_matrix": pose(0.2 * i)} for i in range(3)]
SECONDS = 20  #: of processor time, which no case may take: most take a hundredth
UNREAD = ("frames", "rigs")  #: files of COLMAP's that no reader opens
SOCKET = object()  #: a change of a file: it is none, as a pipe would be, for which a reader could wait
XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(form: str, body: bytes = b"", properties: str = XYZ) -> bytes:
    """A PLY file of two vertices."""
    return f"ply\nformat {form} 1.0\nelement vertex 2\n{properties}end_header\n".encode() + body


def write_blender(_: object, folder: Path) -> Path:
    """Three frames, points, depths and a distorting lens."""
    file = {"camera_angle_x": 0.8, "w": 12, "h": 8, "k1": 0.01, "near_far_per_frame": [[1, 9]] * 3, "frames": FRAMES}
    save(folder / "transforms.json", file | {"ply_file_path": "points.ply"})
    save(folder / "points.ply", ply("ascii", b"0 0 0\n1 1 1\n"))
    for i in range(3):
        save(folder / f"r_{i}.png", folders.gradient(12, 8, i))
    save(folder.parent / "outside" / "r_0.png", folders.gradient(12, 8))
    (folder / "out").symlink_to(folder.parent / "outside")
    return folder


def write_iphone(_: object, folder: Path) -> Path:
    """A training and a test frame, points and a covisibility mask."""
    eye = np.eye(3).tolist()
    camera = dict(orientation=eye, position=[0, 0, 0], focal_length=10, principal_point=[6, 4], image_size=[12, 8])
    for i, split in enumerate(("train", "val")):
        save(folder / f"camera/{i}_00000.json", camera)
        save(folder / f"rgb/1x/{i}_00000.png", folders.gradient(12, 8))
        save(folder / f"splits/{split}.json", {"frame_names": [f"{i}_00000"]})
    save(folder / "covisible/1x/val/1_00000.png", np.full((8, 12), 255, np.uint8))
    save(folder / "points.npy", npy(np.arange(12.0).reshape(4, 3)))
    save(folder / "metadata.json", {f"{i}_00000": {"warp_id": i, "camera_id": i} for i in range(2)})
    save(folder / "scene.json", {"center": [0, 0, 0], "scale": 1, "near": 1, "far": 2})
    save(folder / "extra.json", {"factor": 1, "fps": 30, "bbox": [[0, 0, 0], [1, 1, 1]]})
    return folder


LAYOUTS: dict[str, Callable[[Any, Path], Path]] = {
    "blender": write_blender,
    "iphone": write_iphone,
    "record3d": folders.write_record3d,
    "panoptic": folders.write_panoptic,
    "neu3d": folders.write_neu3d,
    "colmap": folders.write_colmap,
    "text": lambda scene, folder: folders.write_colmap(scene, folder, "text"),
    "videos": folders.write_synchronised,
}
VIDEOS = ("neu3d", "videos")  #: layouts with videos


def frame(**keys: Any) -> Callable[[dict], dict]:
    """A change of frame 0 of transforms.json."""
    return lambda value: value | {"frames": [value["frames"][0] | keys, *value["frames"][1:]]}


def entry(i: int, j: int, value: float) -> list:
    """A pose with another number."""
    matrix = np.array(pose())
    matrix[i, j] = value
    return matrix.tolist()


def npy(array: np.ndarray, **archive: bool) -> bytes:
    """A .npy file, or with archive=True a .npz file with `data`."""
    stream = io.BytesIO()
    np.savez(stream, data=array) if archive else np.save(stream, array)
    return stream.getvalue()


#: Of the header of a .npy file, up to its shape.
DESCRIBED = "{{'descr': '<f8', 'fortran_order': False, 'shape': {}}}"


def header(text: str) -> bytes:
    """A .npy file of this header and a few bytes."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + bytes(80)


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


@cache
def bomb(method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An archive of 50 kB that unpacks to 50 MB. It takes a second: made in the test, not where tests are collected."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("data.npy", bytes(50_000_000))
    return stream.getvalue()


def times(factors: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Columns of poses_bounds.npy times factors."""
    return lambda poses: poses * factors


COLUMN = np.arange(17)
CAMERA, MODEL = "camera/0_00000.json", "sparse/0/"
#: Layout, file, and its change: keys of its JSON, new bytes, a function of its content, or None to remove it.
CASES: list[tuple[str, str, Any, str]] = [
    ("blender", "transforms.json", dict(fl_x=NAN), "fl_x is nan"),
    ("blender", "transforms.json", dict(fl_x=0), "fl_x is 0, expected a number > 0"),
    ("blender", "transforms.json", dict(fl_x=10**400), "fl_x is 1000"),
    ("blender", "transforms.json", dict(fl_x="wide"), "fl_x is 'wide'"),
    ("blender", "transforms.json", dict(camera_angle_x=None), "no focal length"),
    ("blender", "transforms.json", dict(camera_angle_x=3.5), "expected radians below pi"),
    ("blender", "transforms.json", dict(camera_model="THIN_PRISM_FISHEYE"), "THIN_PRISM_FISHEYE"),
    ("blender", "transforms.json", frame(transform_matrix=entry(0, 0, 1.1)), "frame 0: transform_matrix is not a rot"),
    ("blender", "transforms.json", frame(transform_matrix=entry(1, 1, -1)), "determinant -1"),
    ("blender", "transforms.json", frame(transform_matrix=entry(0, 3, NAN)), "frame 0: transform_matrix holds NaN"),
    ("blender", "transforms.json", frame(transform_matrix=[[1, 0], [0, 1]]), "has shape"),
    ("blender", "transforms.json", frame(transform_matrix=None), "transform_matrix"),
    ("blender", "transforms.json", frame(file_path=None), "frame 0 has no file_path"),
    ("blender", "transforms.json", frame(file_path="gone/r_0"), "gone/r_0: image is missing"),
    ("blender", "transforms.json", dict(w=16, h=8), "r_0.png: image is 12x8, expected 16x8"),
    ("blender", "transforms.json", frame(time=NAN), "frame 0: time is nan"),
    ("blender", "transforms.json", dict(frames=[]), "found no frames, expected a list of at least 1"),
    ("blender", "transforms.json", dict(ply_file_path="gone.ply"), "gone.ply: cannot be read"),
    ("blender", "transforms.json", dict(near_far_per_frame=[[3, 1]] * 3), "expected 0 < near < far"),
    ("blender", "transforms.json", dict(near_far_per_frame=[[1, 3]]), "has shape (1, 2), expected (3, 2)"),
    ("blender", "transforms.json", b'{\n "w": 3,\n "h": ]\n}', "transforms.json: line 3, column 7: broken JSON"),
    ("blender", "transforms.json", b'{"a":' + b"[" * 500_000, "cannot be read as JSON"),
    ("blender", "transforms.json", b"[1]", "found a JSON list, expected an object"),
    ("blender", "transforms.json", b"\xff\xfe\x00", "cannot be read as JSON"),
    ("blender", "transforms.json", b'{"fl_x": 1' + b"0" * 5000 + b"}", "transforms.json"),
    ("blender", "r_1.png", b"", "r_1.png"),
    ("blender", "r_1.png", b"not a png", "r_1.png"),
    ("blender", "r_1.png", lambda data: data[: len(data) // 2], "r_1.png"),
    ("blender", "points.ply", b"", "points.ply: not a PLY file"),
    ("blender", "points.ply", b"ply\nformat ascii 1.0\n", "not a PLY file"),
    ("blender", "points.ply", ply("binary_big_endian"), "expected ascii or binary_little_endian"),
    ("blender", "points.ply", ply("binary_little_endian", bytes(23)), "23 bytes of vertices, expected 24"),
    ("blender", "points.ply", ply("ascii", b"1 2 3\n"), "1 vertex lines, expected 2"),
    ("blender", "points.ply", ply("ascii", b"1 2 3\n1 2\n"), "vertex lines are not 3 numbers"),
    ("blender", "points.ply", ply("ascii", b"1\n2\n", "property float x\n"), "expected x, y, z once each"),
    ("blender", "points.ply", ply("ascii", b"", "property list uchar int i\n"), "expected a scalar"),
    ("blender", "points.ply", ply("ascii").replace(b"2\n", b"99999999999\n", 1), "0 vertex lines"),
    ("iphone", CAMERA, {"focal_length": NAN}, "0_00000.json: focal_length is nan"),
    ("iphone", CAMERA, {"focal_length": None}, "0_00000.json: focal_length is None"),
    ("iphone", CAMERA, {"orientation": (2 * np.eye(3)).tolist()}, "orientation is not a rotation: determinant 8"),
    ("iphone", CAMERA, {"position": [0, 0]}, "position has shape (2,), expected (3,)"),
    ("iphone", CAMERA, {"image_size": [1, 1]}, "expected at least 2x2"),
    ("iphone", CAMERA, {"image_size": [14, 8]}, "image is 12x8, expected 14x8"),
    ("iphone", "rgb/1x/0_00000.png", SOCKET, "0_00000.png: is not a regular file"),
    ("iphone", "metadata.json", b"{}", "no entry for frame '0_00000'"),
    ("iphone", "metadata.json", {"0_00000": {}}, "warp_id is None"),
    ("iphone", "splits/train.json", {"frame_names": []}, "0 training frames, expected at least 1"),
    ("iphone", "splits/train.json", {"frame_names": [3]}, "not a list of frame names"),
    ("iphone", "scene.json", {"scale": 0}, "scale is 0"),
    ("iphone", "scene.json", {"near": 5}, "near 5 and far 2"),
    ("iphone", "scene.json", None, "scene.json: cannot be read"),
    ("iphone", "extra.json", {"factor": 1.5}, "factor is 1.5"),
    ("iphone", "extra.json", {"bbox": [[1, 1, 1], [0, 0, 0]]}, "expected a lower and an upper corner"),
    ("iphone", "extra.json", {"fps": 0}, "fps is 0"),
    ("iphone", "points.npy", b"junk", "points.npy: not a .npy file"),
    ("iphone", "points.npy", npy(np.zeros((3, 2))), "found float64 (3, 2), expected floats [M, 3]"),
    ("iphone", "points.npy", npy(np.array([{}], dtype=object)), "points.npy: not a .npy file"),
    ("blender", "transforms.json", {"camera_model": ["PINHOLE"]}, "camera_model is ['PINHOLE'], expected a name"),
    ("blender", "transforms.json", {"camera_model": {}}, "camera_model is {}, expected a name"),
    ("blender", "transforms.json", {"ply_file_path": "../points.ply"}, "'../points.ply' is not the name of a file in"),
    ("blender", "transforms.json", {"ply_file_path": "/etc/passwd"}, "'/etc/passwd' is not the name of a file in"),
    ("blender", "transforms.json", {"ply_file_path": "p\0.ply"}, "is not the name of a file in"),
    *(
        ("blender", "transforms.json", frame(file_path=name), "is not the name of a file in")
        for name in ("../r_0", "/r_0", "a/../../r_0", "out/r_0", "r\0", "", ".")
    ),
    ("blender", "transforms.json", frame(file_path="x" * 300), "image is missing"),
    ("blender", "transforms.json", frame(file_path="\x1b]0;x\x07" * 40), "image is missing"),
    ("blender", "transforms.json", {"frames": FRAMES * 5, "near_far_per_frame": None}, "15 frames of 3 pictures"),
    ("blender", "r_0.png", lambda _: blank(), "33,554,432 pixels, expected"),
    ("blender", "r_0.png", lambda _: scans(), "scans, expected 100 at most in a JPEG"),
    ("blender", "r_0.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 8\n", "not an image that can be read"),
    ("iphone", "splits/train.json", {"frame_names": ["../camera/0_00000"]}, "no entry for frame"),
    ("iphone", "splits/train.json", {"frame_names": ["0_00000"] * 2}, "names a frame twice"),
    ("iphone", "metadata.json", {"0_00000": {"warp_id": [1]}}, "warp_id is [1]"),
    ("record3d", "metadata", SOCKET, "metadata: is not a regular file"),
    ("record3d", "metadata", {"poses": []}, "found no poses"),
    ("record3d", "metadata", lambda m: m | {"poses": [row[:6] for row in m["poses"]]}, "expected (12, 7)"),
    ("record3d", "metadata", {"poses": [[0, 0, 0, 2, 0, 0, 0]] * COUNT}, "pose 0: quaternion of length 2, expected 1"),
    ("record3d", "metadata", {"frameTimestamps": [0.0]}, "frameTimestamps are not 12 numbers"),
    ("record3d", "metadata", {"perFrameIntrinsicCoeffs": [[0, 1, 2, 3]] * COUNT}, "a focal length is not above 0"),
    ("record3d", "metadata", {"perFrameIntrinsicCoeffs": None, "K": None}, "K"),
    ("record3d", "metadata", {"w": 8}, "expected 8x"),
    ("record3d", "rgbd/3.png", None, "image is missing"),
    ("panoptic", "train_meta.json", lambda m: m | {"k": m["k"][:1]}, "lists of equal length"),
    ("panoptic", "train_meta.json", lambda m: m | {"fn": [row[:1] for row in m["fn"]]}, "instant 0: expected lists"),
    ("panoptic", "train_meta.json", {"fn": [["../x.png"] * CAMERAS] * INSTANTS}, "../x.png' is not the name"),
    ("panoptic", "train_meta.json", {"fn": [["9/a.png"] * CAMERAS] * INSTANTS}, "image is missing"),
    (
        "panoptic", "train_meta.json", {"w2c": [[(2 * np.eye(4)).tolist()] * CAMERAS] * INSTANTS},
        "instant 0: 0/000000.png: w2c is not a rotation",
    ),
    ("panoptic", "train_meta.json", {"k": [[np.zeros((3, 3)).tolist()] * CAMERAS] * INSTANTS}, "with fx, fy > 0"),
    ("panoptic", "train_meta.json", {"w": 7}, "expected 7x"),
    ("panoptic", "train_meta.json", {"h": 0}, "h is 0"),
    ("panoptic", "init_pt_cld.npz", lambda _: bomb(), "data unpacks to more than 1,"),
    ("panoptic", "init_pt_cld.npz", npy(np.array([{}]), archive=True), "data: not a .npy file"),
    ("panoptic", "init_pt_cld.npz", npy(np.zeros((4, 2)), archive=True), "expected numbers [M, 6]"),
    ("panoptic", "init_pt_cld.npz", lambda _: bomb(zipfile.ZIP_BZIP2), "compressed by method 12, expected deflate"),
    ("panoptic", "init_pt_cld.npz", lambda _: bomb(zipfile.ZIP_LZMA), "compressed by method 14, expected deflate"),
    ("panoptic", "init_pt_cld.npz", lambda _: bomb()[:-30], "not an archive of numpy"),
    ("panoptic", "init_pt_cld.npz", b"no archive", "not an archive of numpy"),
    ("neu3d", "poses_bounds.npy", lambda poses: poses[:2], "3 videos cam*.mp4, expected 2 as in poses"),
    ("neu3d", "poses_bounds.npy", lambda poses: poses[:, :16], "rows of 17"),
    ("neu3d", "poses_bounds.npy", times(COLUMN * NAN), "expected finite numbers"),
    ("neu3d", "poses_bounds.npy", times(np.where(COLUMN < 3, 1.5, 1)), "is not a rotation"),
    ("neu3d", "poses_bounds.npy", times(np.where(COLUMN == 4, 2, 1)), "expected the same shape"),
    ("neu3d", "poses_bounds.npy", times(np.where(COLUMN == 15, 20, 1)), "0 < nearest < farthest"),
    ("neu3d", "poses_bounds.npy", npy(np.array([{}])), "not a .npy file"),
    ("neu3d", "poses_bounds.npy", header("{'descr': '<f8', 'shape': " + "(" * 3000), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header("{'descr': '<f8', 'shape': \'\'\'"), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header(DESCRIBED.format("(" + "9" * 40 + ",)")), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header(DESCRIBED.format("(-3, 17)")), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header(DESCRIBED.format("(1 << 40, 17)")), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header(DESCRIBED.format("(1000000000, 17)")), "not a .npy file of numbers"),
    ("neu3d", "poses_bounds.npy", header("{'descr': [('a', 'f8')], 'fortran_order': False, 'shape': ()}"), "expected"),
    ("neu3d", "poses_bounds.npy", b"PK\x03\x04", "not a .npy file of numbers"),
    ("neu3d", "cam1.mp4", b"no video", "cam1.mp4: cannot be decoded"),
    ("neu3d", "cam1.mp4", None, "2 videos cam*.mp4, expected 3 as in poses"),
    ("colmap", MODEL + "cameras.bin", lambda data: data[:4], "cameras.bin: ends at byte 4"),
    ("colmap", MODEL + "images.bin", lambda data: data[:-1], "images.bin: ends at byte"),
    ("colmap", MODEL + "points3D.bin", lambda data: data[:100], "points3D.bin: ends at byte 100"),
    ("colmap", MODEL + "images.bin", lambda data: b"\xff" * 8 + data[8:], "images.bin: ends at byte"),
    (
        "colmap", MODEL + "cameras.bin", lambda data: data.replace(struct.pack("<ii", 7, 1), struct.pack("<ii", 7, 9)),
        "camera model number 9, expected one of",
    ),
    ("colmap", MODEL + "images.bin", lambda data: data.replace(b"cam/frame_0002", b"../frame_00002"), "is not the n"),
    ("colmap", MODEL + "images.bin", bytes(8), "no picture is registered"),
    ("colmap", "times.txt", b"cam/frame_0000.png 1\n", "has no line for cam/frame_0002.png"),
    ("colmap", "times.txt", b"cam/frame soon\n", "line 1 is 'cam/frame soon', expected NAME SECONDS"),
    ("text", MODEL + "cameras.txt", b"7 THIN_PRISM 40 30 1 1 1 1", "model THIN_PRISM, expected one of SIMPLE_PINHOLE"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 40 30 1 1 1", "PINHOLE with 40x30 pixels and 3 parameters"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 40 30 -1 1 1 1", "camera 7: fx"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 40", "is not what COLMAP writes"),
    ("text", MODEL + "cameras.txt", b"x PINHOLE 40 30 1 1 1 1", "is not what COLMAP writes"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 40 1e9 1 1 1 1", "expected 1..65535 a side"),
    ("text", MODEL + "cameras.txt", b"8 PINHOLE 40 30 30 30 20 15", "camera 7 is not in cameras.txt"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 41 30 30 30 20 15", "image is 40x30, expected 41x30"),
    ("text", MODEL + "cameras.txt", b"inf PINHOLE 40 30 30 30 20 15", "line 1 is inf, expected a number"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE nan 30 30 30 20 15", "line 1 is nan, expected a number"),
    ("text", MODEL + "cameras.txt", b"7 PINHOLE 1e400 30 30 30 20 15", "line 1 is inf, expected a number"),
    ("text", MODEL + "images.txt", b"1 1 0 0 0 0 0 0 nan a.png\n\n", "line 1 is nan, expected a number"),
    ("text", MODEL + "images.txt", b"1 nan 0 0 0 0 0 0 7 a.png\n\n", "pose is nan"),
    ("text", MODEL + "images.txt", b"\n" * 300_000, "no picture is registered"),
    ("text", MODEL + "images.txt", b"1 1 0 0 0 0 0 0 7 " + b"\x1b[2J" * 80 + b"\n\n", "there is no such picture"),
    ("text", MODEL + "images.txt", b"1 1 0 0 0 0 0 0 7 a\0b\n\n", "is not the name of a file"),
    ("colmap", MODEL + "images.bin", lambda data: data.replace(b"cam/frame_0002", b"\x1b]0;\x9b2J\xff\xfe/x1"), "no"),
    ("videos", "videos/cam1.mp4", b"no video", "cam1.mp4: cannot be decoded"),
    ("videos", "videos/cam1.mp4", None, "cam1.png: there is no video of this name among 2"),
    ("videos", MODEL + "cameras.txt", b"1 PINHOLE 42 30 30 30 20 15", "expected the same size"),
    ("videos", MODEL + "images.txt", lambda data: data.replace(b"cam1", b"cam0"), "two pictures are of the video cam0"),
]  # fmt: skip


def changed(path: Path, change: Any) -> None:
    """Applies a change of CASES."""
    if change is None:
        path.unlink()
    elif change is SOCKET:
        path.unlink()
        os.mknod(path, stat.S_IFSOCK)
    elif isinstance(change, bytes):
        path.write_bytes(change)
    elif path.suffix == ".npy":
        np.save(path, change(np.load(path)))
    elif path.suffix in ("", ".json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps(change(content) if callable(change) else content | change))
    else:
        path.write_bytes(change(path.read_bytes()))


@pytest.fixture(params=LAYOUTS)
def layout(request) -> str:
    if request.param in VIDEOS:
        pytest.importorskip("imageio_ffmpeg")
    return request.param


def test_broken_folders(layout, scene, tmp_path, refused):
    folder = LAYOUTS[layout](scene, tmp_path / "set")
    for name, change, text in [case[1:] for case in CASES if case[0] == layout]:
        path = folder / name
        whole = path.read_bytes() if path.exists() else None
        changed(path, change)
        start = time.process_time()
        refused(folder, text)
        assert time.process_time() - start < SECONDS, name
        path.unlink(missing_ok=True)
        if whole is not None:
            path.write_bytes(whole)


def test_no_file_of_a_folder_is_a_link_out_of_it(layout, scene, tmp_path, refused):
    """Whoever chose its name, the layout or another file: an archive of a stranger may hold links to anything."""
    folder, elsewhere = LAYOUTS[layout](scene, tmp_path / "set"), tmp_path / "elsewhere"
    every = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stem not in UNREAD]
    of_each_kind = {(path.parent, path.suffix in (".png", ".jpg") or path.name): path for path in every}
    for path in of_each_kind.values():
        path.rename(elsewhere)
        path.symlink_to(elsewhere)
        refused(folder, "the name of a file in this folder")
        path.unlink()
        elsewhere.rename(path)


def test_other_faults_of_folders(tmp_path, blender, refused):
    refused(tmp_path / "gone", "gone: found nothing, expected a dataset folder")
    refused(tmp_path, "found an empty folder, expected camera/, rgb/ and splits/ (iPhone")
    (tmp_path / "readme.txt").write_text("x")
    refused(tmp_path, "found other files")
    refused(tmp_path / "readme.txt", "found a file")
    blender(name="transforms_a.json")
    (tmp_path / "transforms_b.json").write_text("{}")
    refused(tmp_path, "found transforms_a.json, transforms_b.json; expected")


def test_a_time_beyond_binary32_is_refused(tmp_path, refused):
    folder = write_iphone(None, tmp_path)
    save(folder / "metadata.json", {"0_00000": {"warp_id": 0}, "1_00000": {"warp_id": 9}})
    save(folder / "extra.json", {"factor": 1, "fps": 1e-300})
    refused(folder, "with which the last frame is at 9e+300 s")


@pytest.mark.parametrize(
    "name, value", [*(("downscale", k) for k in (0, -1, 2.0, True, 9)), ("holdout", 1), ("holdout", -2)]
)
def test_bad_options(blender, refused, name, value):
    refused(blender(), f"{name} {'is ' if name == 'downscale' and value != 9 else ''}{value}", **{name: value})


SYNTHETIC = {
    "": "expected synthetic:static|global|local|fast|flyby|dart|rods|tunnel|bend|blink[?seed=n&size=WxH&frames=N&path=",
    "Static": "expected synthetic:static",
    "nothing?seed=1": "expected synthetic:static",
    **{
        f"static?{query}": f"{query.split('=')[0]} is {query.split('=')[1]!r}; expected for example"
        for query in ("seed=-1", "seed=x", "size=160", "size=9000x90", "frames=", "path=1")
    },
    "static?size=7x160": "size is '7x160'; expected for example size=960x540, each 8 to 8192",
    "static?frames=2": "frames is '2'; expected for example frames=300, 3 to 10000",
    **{
        f"static?{query}": "expected each of seed, size, frames, path once at most, as key=value"
        for query in ("", "a", "seed=1&a", "seed=1&seed=1", "seed=1&")
    },
}


@pytest.mark.parametrize("name", SYNTHETIC)
def test_broken_synthetic_sources(name, refused):
    refused(f"synthetic:{name}", SYNTHETIC[name])


def test_synthetic_downscale_too_large(refused):
    refused("synthetic:static", "downscale 200 leaves nothing of 160x120", downscale=200)
