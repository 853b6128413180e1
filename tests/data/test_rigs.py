"""Folders of rigs, Neu3D and Panoptic Studio: written, read back, damaged."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from folders import CAMERAS, FPS, INSTANTS, NAN, POINTS, assert_same, eye, npy, rig_videos, rig_views, save
from test_colmap import write_synchronised

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset


def write_neu3d(scene: Dataset, folder: Path) -> Path:
    """Nearest depth 1, farthest 9."""
    folder.mkdir()
    rig_videos(scene, folder)
    rows = []
    for camera in range(CAMERAS):
        view = rig_views(scene, camera)[0]
        (right, down, ahead), place = eye(view)
        lens = [view.height, view.width, float(view.K[0, 0])]
        rows.append([*np.stack([down, right, -ahead, place, lens], axis=1).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_panoptic(scene: Dataset, folder: Path) -> Path:
    """The view of camera c at instant t is training view t * CAMERAS + c."""
    instants = [scene.train[t * CAMERAS : (t + 1) * CAMERAS] for t in range(INSTANTS)]
    names = [[f"{camera}/{t:06d}.png" for camera in range(CAMERAS)] for t in range(INSTANTS)]
    for row, views in zip(names, instants, strict=True):
        for name, view in zip(row, views, strict=True):
            save(folder / "ims" / name, view.image)
    meta = {
        "w": scene.train[0].width, "h": scene.train[0].height, "fn": names,
        "k": [[view.K.tolist() for view in views] for views in instants],
        "w2c": [[view.viewmat.tolist() for view in views] for views in instants],
        "cam_id": [list(range(CAMERAS))] * INSTANTS,
    }  # fmt: skip
    save(folder / "train_meta.json", meta)
    rows = np.concatenate([scene.points[:POINTS], np.full((POINTS, 4), 0.5)], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=rows)
    return folder


#: Of the header of a .npy file, up to its shape.
DESCRIBED = "{{'descr': '<f8', 'fortran_order': False, 'shape': {}}}"


def header(text: str) -> bytes:
    """A .npy file of this header and a few bytes."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + bytes(80)


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
LAYOUTS = {"panoptic": write_panoptic, "neu3d": write_neu3d}
FAULTS = {
    "panoptic": [
        ("train_meta.json", lambda m: m | {"k": m["k"][:1]}, "lists of equal length"),
        ("train_meta.json", lambda m: m | {"fn": [row[:1] for row in m["fn"]]}, "instant 0: expected lists"),
        ("train_meta.json", {"fn": [["../x.png"] * CAMERAS] * INSTANTS}, "../x.png' is not the name"),
        ("train_meta.json", {"fn": [["9/a.png"] * CAMERAS] * INSTANTS}, "image is missing"),
        (
            "train_meta.json", {"w2c": [[(2 * np.eye(4)).tolist()] * CAMERAS] * INSTANTS},
            "instant 0: 0/000000.png: w2c is not a rotation",
        ),
        ("train_meta.json", {"k": [[np.zeros((3, 3)).tolist()] * CAMERAS] * INSTANTS}, "with fx, fy > 0"),
        ("train_meta.json", {"w": 7}, "expected 7x"),
        ("train_meta.json", {"h": 0}, "h is 0"),
        ("init_pt_cld.npz", lambda _: bomb(), "data unpacks to more than 1,"),
        ("init_pt_cld.npz", npy(np.array([{}]), archive=True), "data: not a .npy file"),
        ("init_pt_cld.npz", npy(np.zeros((4, 2)), archive=True), "expected numbers [M, 6]"),
        ("init_pt_cld.npz", lambda _: bomb(zipfile.ZIP_BZIP2), "compressed by method 12, expected deflate"),
        ("init_pt_cld.npz", lambda _: bomb(zipfile.ZIP_LZMA), "compressed by method 14, expected deflate"),
        ("init_pt_cld.npz", lambda _: bomb()[:-30], "not an archive of numpy"),
        ("init_pt_cld.npz", b"no archive", "not an archive of numpy"),
    ],
    "neu3d": [
        ("poses_bounds.npy", lambda poses: poses[:2], "3 videos cam*.mp4, expected 2 as in poses"),
        ("poses_bounds.npy", lambda poses: poses[:, :16], "rows of 17"),
        ("poses_bounds.npy", times(COLUMN * NAN), "expected finite numbers"),
        ("poses_bounds.npy", times(np.where(COLUMN < 3, 1.5, 1)), "is not a rotation"),
        ("poses_bounds.npy", times(np.where(COLUMN == 4, 2, 1)), "expected the same shape"),
        ("poses_bounds.npy", times(np.where(COLUMN == 15, 20, 1)), "0 < nearest < farthest"),
        ("poses_bounds.npy", npy(np.array([{}])), "not a .npy file"),
        ("poses_bounds.npy", header("{'descr': '<f8', 'shape': " + "(" * 3000), "not a .npy file of numbers"),
        ("poses_bounds.npy", header("{'descr': '<f8', 'shape': \'\'\'"), "not a .npy file of numbers"),
        *(
            ("poses_bounds.npy", header(DESCRIBED.format(shape)), "not a .npy file of numbers")
            for shape in ("(" + "9" * 40 + ",)", "(-3, 17)", "(1 << 40, 17)", "(1000000000, 17)")
        ),
        ("poses_bounds.npy", header("{'descr': [('a', 'f8')], 'fortran_order': False, 'shape': ()}"), "expected"),
        ("poses_bounds.npy", b"PK\x03\x04", "not a .npy file of numbers"),
        ("cam1.mp4", b"no video", "cam1.mp4: cannot be decoded"),
        ("cam1.mp4", None, "2 videos cam*.mp4, expected 3 as in poses"),
    ],
}  # fmt: skip


def test_panoptic_is_read_back(scene, tmp_path):
    data = load(write_panoptic(scene, tmp_path / "set"))
    assert len(data.test) == INSTANTS and len(data.train) == INSTANTS * (CAMERAS - 1)
    assert data.time_range == pytest.approx((0, (INSTANTS - 1) / 30))
    for found in (*data.train, *data.test):
        assert_same(found, scene.train[round(found.time * (INSTANTS - 1)) * CAMERAS + found.camera_id])
    assert {view.camera_id for view in data.test} == {0}
    np.testing.assert_allclose(data.points, scene.points[:POINTS], atol=1e-6)
    assert not load(tmp_path / "set", holdout=0).test
    (tmp_path / "set" / "test_meta.json").write_text((tmp_path / "set" / "train_meta.json").read_text())
    assert len(load(tmp_path / "set").test) == INSTANTS * CAMERAS


@pytest.mark.parametrize("write", [write_neu3d, write_synchronised])
def test_rigs_of_videos_are_read_back(scene, tmp_path, write):
    data = load(write(scene, tmp_path / "set"))
    assert len(data.train) == (CAMERAS - 1) * INSTANTS and len(data.test) == INSTANTS
    assert data.time_range == (0.0, pytest.approx((INSTANTS - 1) / FPS)) and {v.camera_id for v in data.test} == {0}
    for found in (*data.train, *data.test):
        views, t = rig_views(scene, found.camera_id), round(found.time * (INSTANTS - 1))
        np.testing.assert_allclose(found.viewmat, views[0].viewmat, atol=1e-6)
        np.testing.assert_array_equal(found.image, views[t].image)
        assert found.name == f"cam{found.camera_id}_{t:04d}" and found.K[0, 0] == pytest.approx(views[0].K[0, 0])
        centre = views[0].width / 2 if write == write_neu3d else views[0].K[0, 2]
        assert found.K[0, 2] == pytest.approx(centre)
    assert write != write_neu3d or (data.near, data.far) == (0.5, 9)
    assert not load(tmp_path / "set", holdout=0).test


def test_videos_smaller_than_their_poses_scale_the_lens(scene, tmp_path):
    folder = write_neu3d(scene, tmp_path / "set")
    poses = np.load(folder / "poses_bounds.npy")
    poses[:, :15].reshape(-1, 3, 5)[:, :, 4] *= 2  # height, width and focal length of the full pictures
    np.save(folder / "poses_bounds.npy", poses)
    view = load(folder, downscale=2).train[0]
    np.testing.assert_allclose(view.K[0, 0], scene.train[0].K[0, 0] / 2, rtol=1e-6)
    assert (view.width, view.height) == (scene.train[0].width // 2, scene.train[0].height // 2)
