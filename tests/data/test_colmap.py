"""Folders of COLMAP models, with pictures or synchronised videos: written, read back, damaged."""

import struct
from pathlib import Path

import numpy as np
import pytest
from folders import CAMERAS, COUNT, POINTS, assert_same, eye, quaternion, rig_videos, rig_views, save

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError


def colmap_name(i: int) -> str:
    """Of a picture in a model."""
    return f"cam/frame_{2 * i:04d}.png"


def write_colmap(
    scene: Dataset, folder: Path, form: str = "binary", camera: str = "PINHOLE", extra: tuple[float, ...] = ()
) -> Path:
    """A model with camera 7, as pycolmap writes it. form: "binary" or "text". extra: parameters after fx fy cx cy."""
    import pycolmap  # of an extra

    first, K = scene.train[0], scene.train[0].K.astype(float)
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *extra]
    size, model = {"width": first.width, "height": first.height}, pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(model=camera, params=parameters, camera_id=7, **size))
    for i, view in enumerate(scene.train[:COUNT]):
        save(folder / "images" / colmap_name(i), view.image)
        image = pycolmap.Image(name=colmap_name(i), camera_id=7, image_id=i + 1)
        image.points2D = [pycolmap.Point2D(np.array([3.0, 4.0]))] * (i % 2)
        (w, x, y, z), shift = quaternion(eye(view)[0]), view.viewmat[:3, 3].astype(float)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), shift)
        model.add_image_with_trivial_frame(image, pose)
    for point in scene.points[:POINTS].astype(float):
        model.add_point3D(point, pycolmap.Track(), np.array([0, 128, 255], np.uint8))
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    getattr(model, f"write_{form}")(str(place))
    return folder


def write_synchronised(
    scene: Dataset, folder: Path, camera: str = "PINHOLE", extra: str = "", cameras: int = CAMERAS
) -> Path:
    """A model with a video per picture in videos/."""
    save(folder / "sparse" / "0" / "points3D.txt", b"")
    (folder / "videos").mkdir()
    rig_videos(scene, folder / "videos", cameras)
    view, K = scene.train[0], scene.train[0].K.astype(float)
    line = f"1 {camera} {view.width} {view.height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]} {extra}\n"
    save(folder / "sparse" / "0" / "cameras.txt", line.encode())
    lines = []
    for i in range(cameras):
        viewmat = rig_views(scene, i)[0].viewmat.astype(float)
        lines += [" ".join(map(str, [i + 1, *quaternion(viewmat[:3, :3]), *viewmat[:3, 3], 1, f"cam{i}.png"])), ""]
    save(folder / "sparse" / "0" / "images.txt", ("\n".join(lines) + "\n").encode())
    return folder


LAYOUTS = {
    "colmap": write_colmap,
    "text": lambda scene, folder: write_colmap(scene, folder, "text"),
    "videos": write_synchronised,
}
MODEL = "sparse/0/"
FAULTS = {
    "colmap": [
        (MODEL + "cameras.bin", lambda data: data[:4], "cameras.bin: ends at byte 4"),
        (MODEL + "images.bin", lambda data: data[:-1], "images.bin: ends at byte"),
        (MODEL + "points3D.bin", lambda data: data[:100], "points3D.bin: ends at byte 100"),
        (MODEL + "images.bin", lambda data: b"\xff" * 8 + data[8:], "images.bin: ends at byte"),
        (
            MODEL + "cameras.bin", lambda data: data.replace(struct.pack("<ii", 7, 1), struct.pack("<ii", 7, 9)),
            "camera model number 9, expected one of",
        ),
        (MODEL + "images.bin", lambda data: data.replace(b"cam/frame_0002", b"../frame_00002"), "is not the n"),
        (MODEL + "images.bin", bytes(8), "no picture is registered"),
        ("times.txt", b"cam/frame_0000.png 1\n", "has no line for cam/frame_0002.png"),
        ("times.txt", b"cam/frame soon\n", "line 1 is 'cam/frame soon', expected NAME SECONDS"),
    ],
    "text": [
        (MODEL + "cameras.txt", b"7 THIN_PRISM 40 30 1 1 1 1", "model THIN_PRISM, expected one of SIMPLE_PINHOLE"),
        (MODEL + "cameras.txt", b"7 PINHOLE 40 30 1 1 1", "PINHOLE with 40x30 pixels and 3 parameters"),
        (MODEL + "cameras.txt", b"7 PINHOLE 40 30 -1 1 1 1", "camera 7: fx"),
        (MODEL + "cameras.txt", b"7 PINHOLE 40", "is not what COLMAP writes"),
        (MODEL + "cameras.txt", b"x PINHOLE 40 30 1 1 1 1", "is not what COLMAP writes"),
        (MODEL + "cameras.txt", b"7 PINHOLE 40 1e9 1 1 1 1", "expected 1..65535 a side"),
        (MODEL + "cameras.txt", b"8 PINHOLE 40 30 30 30 20 15", "camera 7 is not in cameras.txt"),
        (MODEL + "cameras.txt", b"7 PINHOLE 41 30 30 30 20 15", "image is 40x30, expected 41x30"),
        (MODEL + "cameras.txt", b"inf PINHOLE 40 30 30 30 20 15", "line 1 is inf, expected a number"),
        (MODEL + "cameras.txt", b"7 PINHOLE nan 30 30 30 20 15", "line 1 is nan, expected a number"),
        (MODEL + "cameras.txt", b"7 PINHOLE 1e400 30 30 30 20 15", "line 1 is inf, expected a number"),
        (MODEL + "images.txt", b"1 1 0 0 0 0 0 0 nan a.png\n\n", "line 1 is nan, expected a number"),
        (MODEL + "images.txt", b"1 nan 0 0 0 0 0 0 7 a.png\n\n", "pose is nan"),
        (MODEL + "images.txt", b"\n" * 300_000, "no picture is registered"),
        (MODEL + "images.txt", b"1 1 0 0 0 0 0 0 7 " + b"\x1b[2J" * 80 + b"\n\n", "image is missing"),
        (MODEL + "images.txt", b"1 1 0 0 0 0 0 0 7 a\0b\n\n", "is not the name of a file"),
    ],
    "videos": [
        ("videos/cam1.mp4", b"no video", "cam1.mp4: cannot be decoded"),
        ("videos/cam1.mp4", None, "cam1.png: there is no video of this name among 2"),
        (MODEL + "cameras.txt", b"1 PINHOLE 42 30 30 30 20 15", "expected the same size"),
        (MODEL + "images.txt", lambda data: data.replace(b"cam1", b"cam0"), "two pictures are of the video cam0"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap_is_read_back(scene, tmp_path, form):
    data = load(write_colmap(scene, tmp_path / "set", form), holdout=4)
    assert len(data.train) == 9 and [view.name for view in data.test] == ["frame_0004", "frame_0012", "frame_0020"]
    found = sorted((*data.train, *data.test), key=lambda view: view.name)
    for i, (mine, view) in enumerate(zip(found, scene.train[:COUNT], strict=True)):
        assert_same(mine, view)
        assert mine.time == pytest.approx(i / 11) and mine.mask is None
    assert data.time_range == (0.0, pytest.approx(22 / 30))
    order = np.lexsort(data.points.T), np.lexsort(scene.points[:POINTS].T)
    np.testing.assert_allclose(data.points[order[0]], scene.points[:POINTS][order[1]], atol=1e-6)


def test_times_come_from_times_txt(scene, tmp_path):
    folder = write_colmap(scene, tmp_path / "set")
    (folder / "times.txt").write_text("".join(f"{colmap_name(i)} {3 + i * i}\n" for i in range(COUNT)))
    data = load(folder, holdout=0)
    assert [view.time for view in data.train] == pytest.approx([i * i / 121 for i in range(COUNT)])
    assert data.time_range == (3.0, 124.0)


def test_distortion_of_a_colmap_camera_is_removed(scene, tmp_path):
    folder = write_colmap(scene, tmp_path / "set", camera="OPENCV", extra=(0.1, -0.02, 0.003, -0.002))
    view = load(folder).train[0]
    assert view.mask is not None and 0.5 < view.mask.mean() < 1
    assert np.abs(view.image.astype(int) - scene.train[0].image).max() > 20


def test_hidden_files_are_no_videos(scene, tmp_path):
    folder = write_synchronised(scene, tmp_path)
    (folder / "videos" / "cam1.mp4").rename(folder / "videos" / "._cam1.mp4")
    with pytest.raises(DataError, match=f"among {CAMERAS - 1}, expected one per picture"):
        load(folder)


def test_videos_of_a_distorting_lens_are_undistorted(scene, tmp_path):
    folder = write_synchronised(scene, tmp_path / "set", "OPENCV", ".1 0 0 0", cameras=1)
    view = load(folder, downscale=2, holdout=0).train[0]
    assert (view.height, view.width) == view.mask.shape == view.image.shape[:2] and 0.5 < view.mask.mean() < 1
