"""Folders of Neu3D: a synthetic scene written as videos with LLFF poses, and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from videos import write_video

from pd4dgs_codec.data import videos as cached
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.synthetic import read_synthetic
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError

pytest.importorskip("imageio_ffmpeg")
CAMERAS, FRAMES, FPS = 3, 5, 12
BOUNDS = (1.0, 9.0)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(cached.FOLDER, str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return read_synthetic("synthetic:local", 2)


def _views(scene: Dataset, camera: int) -> list:
    """As many views as frames, taken as one camera's; the pose is that of the first."""
    return list(scene.train[camera * FRAMES : (camera + 1) * FRAMES])


def _row(view, width: int, height: int, focal: float) -> np.ndarray:
    viewmat = view.viewmat.astype(np.float64)
    right, down, ahead = viewmat[:3, :3]
    place = -viewmat[:3, :3].T @ viewmat[:3, 3]
    pose = np.stack([down, right, -ahead, place, [height, width, focal]], axis=1)
    return np.concatenate([pose.ravel(), BOUNDS])


def write(scene: Dataset, folder: Path) -> Path:
    folder.mkdir()
    rows = []
    for camera in range(CAMERAS):
        views = _views(scene, camera)
        write_video(folder / f"cam{camera:02d}.mp4", [view.image for view in views], FPS)
        rows.append(_row(views[0], views[0].width, views[0].height, float(views[0].K[0, 0])))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def test_what_was_written_is_read_back(scene, tmp_path):
    data = load(write(scene, tmp_path / "set"))
    assert len(data.train) == (CAMERAS - 1) * FRAMES and len(data.test) == FRAMES
    assert data.time_range == (0.0, pytest.approx((FRAMES - 1) / FPS))
    for camera in range(CAMERAS):
        found = [view for view in (*data.train, *data.test) if view.camera_id == camera]
        for k, (mine, view) in enumerate(zip(found, _views(scene, camera), strict=True)):
            np.testing.assert_allclose(mine.viewmat, _views(scene, camera)[0].viewmat, atol=1e-6)
            assert mine.K[0, 0] == pytest.approx(view.K[0, 0]) and mine.K[0, 2] == view.width / 2
            np.testing.assert_array_equal(mine.image, view.image)
            assert mine.time == pytest.approx(k / (FRAMES - 1)) and mine.name == f"cam{camera:02d}_{k:04d}"
    assert data.near == 0.5 and data.far == 9 and not load(tmp_path / "set", holdout=0).test


def test_videos_smaller_than_their_poses_say_scale_the_lens(scene, tmp_path):
    folder = write(scene, tmp_path / "set")
    poses = np.load(folder / "poses_bounds.npy")
    pose = poses[:, :15].reshape(-1, 3, 5)
    pose[:, :, 4] *= 2  # height, width and focal length of the full pictures
    np.save(folder / "poses_bounds.npy", poses)
    view = load(folder, downscale=2).train[0]
    np.testing.assert_allclose(view.K[0, 0], scene.train[0].K[0, 0] / 2, rtol=1e-6)
    assert (view.width, view.height) == (scene.train[0].width // 2, scene.train[0].height // 2)


def test_faults_are_one_line(scene, tmp_path, monkeypatch):
    folder = write(scene, tmp_path / "set")
    whole = np.load(folder / "poses_bounds.npy")

    def refused(message: str) -> None:
        with pytest.raises(DataError, match=message):
            load(folder)

    for poses, message in (
        (whole[:2], "2 poses in poses_bounds.npy and 3 videos"),
        (whole[:, :16], "rows of 17"),
        (whole * np.nan, "expected finite numbers"),
        (whole * np.where(np.arange(17) < 3, 1.5, 1), "is not a rotation"),
        (whole * np.where(np.arange(17) == 4, 2, 1), "expected the same shape"),
        (whole * np.where(np.arange(17) == 15, 20, 1), "0 < nearest < farthest"),
    ):
        np.save(folder / "poses_bounds.npy", poses)
        refused(message)
    np.save(folder / "poses_bounds.npy", np.array([{}]), allow_pickle=True)
    refused("not a .npy file")
    np.save(folder / "poses_bounds.npy", whole)
    with monkeypatch.context() as patch:
        patch.setenv(cached.SIZE, "1e-6")
        refused("expected a larger PD4DGS_CACHE_GIB or a larger --downscale")
    write_video(folder / "cam01.mp4", [view.image for view in _views(scene, 1)[:3]], FPS)
    refused("cam01.mp4: has 3 frames at 12 per second and cam00.mp4 5")
    (folder / "cam01.mp4").write_bytes(b"no video")
    refused("cam01.mp4: cannot be decoded")
    (folder / "cam01.mp4").unlink()
    refused("3 poses in poses_bounds.npy and 2 videos")
