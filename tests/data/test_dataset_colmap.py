"""Folders with a model of COLMAP: synthetic scenes written in its two forms, by hand and by pycolmap, read back."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.synthetic import read_synthetic
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return read_synthetic("synthetic:local", 4)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation less than half a turn."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    r = rotation
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))])


def _name(i: int) -> str:
    return f"cam/frame_{2 * i:04d}.png"


def _pictures(scene: Dataset, folder: Path) -> Path:
    (folder / "images" / "cam").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    for i, view in enumerate(scene.train[:12]):
        Image.fromarray(view.image).save(folder / "images" / _name(i))
    return folder / "sparse" / "0"


def _entries(scene: Dataset):
    for i, view in enumerate(scene.train[:12]):
        viewmat = view.viewmat.astype(np.float64)
        yield i + 1, _quaternion(viewmat[:3, :3]), viewmat[:3, 3], _name(i)


def write_binary(scene: Dataset, folder: Path, model: int = 1, extra: tuple[float, ...] = ()) -> Path:
    place, view = _pictures(scene, folder), scene.train[0]
    K = view.K.astype(float)
    parameters = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *extra)
    (place / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ", 1, 7, model, view.width, view.height) + struct.pack(f"<{len(parameters)}d", *parameters)
    )
    rows = [
        struct.pack("<i7di", i, *q, *t, 7) + name.encode() + b"\0" + struct.pack("<QddqQ", 1, 3.0, 4.0, -1, 0)[:32]
        for i, q, t, name in _entries(scene)
    ]
    (place / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    points = [
        struct.pack("<Q3d3BdQii", i, *map(float, p), *map(int, c), 0.5, 1, 1, 0)
        for i, (p, c) in enumerate(zip(scene.points[:50], scene.point_colors[:50], strict=True))
    ]
    (place / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(points))
    return folder


def write_text(scene: Dataset, folder: Path, camera: str = "") -> Path:
    place, view = _pictures(scene, folder), scene.train[0]
    K = view.K.astype(float)
    line = camera or f"7 PINHOLE {view.width} {view.height} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
    (place / "cameras.txt").write_text(f"# Camera list\n{line}\n")
    lines = ["# Image list"]
    for i, q, t, name in _entries(scene):
        lines += [" ".join([str(i), *map(repr, map(float, (*q, *t))), "7", name]), "3.0 4.0 -1" if i % 2 else ""]
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    points = [
        " ".join([str(i), *map(repr, map(float, p)), *map(str, c), "0.5", "1", "0"])
        for i, (p, c) in enumerate(zip(scene.points[:50], scene.point_colors[:50], strict=True))
    ]
    (place / "points3D.txt").write_text("\n".join(points) + "\n")
    return folder


def write_pycolmap(scene: Dataset, folder: Path, form: str) -> Path:
    pycolmap = pytest.importorskip("pycolmap")
    place, view = _pictures(scene, folder), scene.train[0]
    K = view.K.astype(float)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=view.width, height=view.height, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera_id=7
    )
    model.add_camera_with_trivial_rig(camera)
    for i, q, t, name in _entries(scene):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(q[[1, 2, 3, 0]]), t)
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=7, image_id=i), pose)
    for p, c in zip(scene.points[:50].astype(float), scene.point_colors[:50], strict=True):
        model.add_point3D(p, pycolmap.Track(), c)
    getattr(model, f"write_{form}")(str(place))
    return folder


@pytest.mark.parametrize("form", ["binary", "text", "pycolmap binary", "pycolmap text"])
def test_what_was_written_is_read_back(scene, tmp_path, form):
    folder = tmp_path / "set"
    if form.startswith("pycolmap"):
        write_pycolmap(scene, folder, form.split()[1])
    else:
        (write_binary if form == "binary" else write_text)(scene, folder)
    data = load(folder, holdout=4)
    assert len(data.train) == 9 and [view.name for view in data.test] == ["frame_0004", "frame_0012", "frame_0020"]
    found = sorted((*data.train, *data.test), key=lambda view: view.name)
    for i, (mine, view) in enumerate(zip(found, scene.train[:12], strict=True)):
        np.testing.assert_allclose(mine.viewmat, view.viewmat, atol=1e-6)
        np.testing.assert_allclose(mine.K, view.K, rtol=1e-6)
        np.testing.assert_array_equal(mine.image, view.image)
        assert mine.time == pytest.approx(i / 11) and mine.mask is None
    assert data.time_range == (0.0, 22.0)
    order = np.lexsort(data.points.T), np.lexsort(scene.points[:50].T)
    np.testing.assert_allclose(data.points[order[0]], scene.points[:50][order[1]], atol=1e-6)
    np.testing.assert_array_equal(data.point_colors[order[0]], scene.point_colors[:50][order[1]])


def test_times_come_from_a_list_if_there_is_one(scene, tmp_path):
    folder = write_binary(scene, tmp_path / "set")
    (folder / "times.txt").write_text("".join(f"{_name(i)} {3 + i * i}\n" for i in range(12)))
    data = load(folder, holdout=0)
    assert [view.time for view in data.train] == pytest.approx([i * i / 121 for i in range(12)])
    assert data.time_range == (3.0, 124.0)
    (folder / "times.txt").write_text(f"{_name(0)} 1\n")
    with pytest.raises(DataError, match="has no line for cam/frame_0002.png"):
        load(folder)
    (folder / "times.txt").write_text("cam/frame soon\n")
    with pytest.raises(DataError, match="line 1 is 'cam/frame soon', expected NAME SECONDS"):
        load(folder)


def test_distortion_is_taken_out(scene, tmp_path):
    folder = write_binary(scene, tmp_path / "set", model=4, extra=(0.1, -0.02, 0.003, -0.002))
    view = load(folder).train[0]
    assert view.mask is not None and 0.5 < view.mask.mean() < 1
    assert np.abs(view.image.astype(int) - scene.train[0].image).max() > 20


@pytest.mark.parametrize(
    "line, message",
    [
        (
            "7 THIN_PRISM_FISHEYE 40 30 1 1 1 1 0 0 0 0",
            "camera model THIN_PRISM_FISHEYE, expected one of SIMPLE_PINHOLE",
        ),
        ("7 PINHOLE 40 30 1 1 1", "PINHOLE with 40x30 pixels and 3 parameters"),
        ("7 PINHOLE 40 30 -1 1 1 1", "camera 7: fx"),
        ("7 PINHOLE 40", "is not what COLMAP writes"),
        ("x PINHOLE 40 30 1 1 1 1", "is not what COLMAP writes"),
        ("7 PINHOLE 40 1e9 1 1 1 1", "expected 1..65535 a side"),
        ("8 PINHOLE 40 30 30 30 20 15", "taken by camera 7, which cameras.txt does not have"),
        ("7 PINHOLE 41 30 30 30 20 15", "40"),
    ],
)
def test_broken_text_models(scene, tmp_path, line, message):
    with pytest.raises(DataError, match=message):
        load(write_text(scene, tmp_path / "set", line))


def test_broken_binary_models(scene, tmp_path):
    folder = write_binary(scene, tmp_path / "set")
    place = folder / "sparse" / "0"
    whole = {name: (place / name).read_bytes() for name in ("cameras.bin", "images.bin", "points3D.bin")}
    for name, data in whole.items():
        for cut in (4, len(data) // 2, len(data) - 1):
            (place / name).write_bytes(data[:cut])
            with pytest.raises(DataError, match=f"{name}: ends at byte {cut}"):
                load(folder)
        (place / name).write_bytes(b"\xff" * 8 + data[8:])  # 2^64 - 1 entries
        with pytest.raises(DataError, match=f"{name}: "):
            load(folder)
        (place / name).write_bytes(data)
    (place / "cameras.bin").write_bytes(
        whole["cameras.bin"].replace(struct.pack("<ii", 7, 1), struct.pack("<ii", 7, 9))
    )
    with pytest.raises(DataError, match="camera model number 9, expected one of"):
        load(folder)
    (place / "cameras.bin").write_bytes(whole["cameras.bin"])
    (place / "images.bin").write_bytes(whole["images.bin"].replace(b"cam/frame_0002", b"../frame_00002"))
    with pytest.raises(DataError, match="there is no such picture in"):
        load(folder)
    (place / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(DataError, match="no picture is registered"):
        load(folder)
