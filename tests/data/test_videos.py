"""The cache of video frames: decoded once, bounded, and made anew when it is lost."""

import errno
import io
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from folders import CAMERAS, FPS, INSTANTS, rig_views
from PIL import Image
from test_colmap import write_synchronised
from videos import write_video

from pd4dgs_codec.data import videos as cached
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.errors import DamageWarning, DataError
from pd4dgs_codec.train.state import TrainingViews

pytest.importorskip("imageio_ffmpeg")


def png() -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (64, 48)).save(stream, "png")
    return stream.getvalue()


@pytest.fixture(scope="module")
def written(scene, once):
    return once("synchronised", lambda folder: write_synchronised(scene, folder / "set")) / "set"


@pytest.fixture
def folder(written, tmp_path):
    """A copy that a test may damage."""
    return shutil.copytree(written, tmp_path / "set")


@pytest.fixture
def stored(written):
    """Reads every k-th pixel of a camera's video through the cache."""

    def frames(camera=0, k=1):
        video = written / "videos" / f"cam{camera}.mp4"
        return cached.stored_frames(video, str(k), lambda picture: picture[::k, ::k])

    return frames


def test_frames_are_decoded_once(folder, monkeypatch, cache):
    first = load(folder)
    assert sum(file.suffix == ".frames" for file in cache.iterdir()) == CAMERAS
    monkeypatch.setattr(cached, "_store", Mock(side_effect=AssertionError("decoded twice")))
    np.testing.assert_array_equal(first.train[3].image, load(folder).train[3].image)
    with pytest.raises(DataError, match="decoded twice"):
        load(folder, downscale=2)


def test_a_relative_cache_is_found_from_another_folder(stored, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PD4DGS_CACHE", "cache")
    frames = stored()
    monkeypatch.chdir("/")
    assert frames.read(0).shape == frames.shape


def test_an_account_without_a_home_is_told_to_name_a_cache(stored, monkeypatch):
    for name in ("PD4DGS_CACHE", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", Mock(side_effect=KeyError))
    with pytest.raises(DataError, match="found no home folder to keep its frames in, expected one in PD4DGS_CACHE"):
        stored()


def test_videos_of_other_lengths_are_refused(scene, folder, refused):
    write_video(folder / "videos" / "cam1.mp4", [view.image for view in rig_views(scene, 1)[:3]], FPS)
    refused(folder, "cam1.mp4: has 3 frames at 10 per second and cam0.mp4 4")


def test_the_cache_stays_within_its_size(stored, monkeypatch, cache):
    def allow(size):
        monkeypatch.setattr(cached, "_IN_USE", set())
        monkeypatch.setenv(cached.SIZE, str(size / 2**30))

    for camera in (0, 1):
        stored(camera)
    full = sum(file.stat().st_size for file in cache.glob("*.frames"))
    allow(1.01 * full)
    stored(0, 2)  # another one leaves for it
    assert sum(file.stat().st_size for file in cache.glob("*.frames")) <= 1.01 * full
    allow(0.7 * full)
    stored(0)
    with pytest.raises(DataError, match="cam1.mp4: .* expected a larger PD4DGS_CACHE_GIB or a larger --downscale"):
        stored(1)
    assert not list(cache.glob(".pd4dgs-*"))
    monkeypatch.setenv(cached.SIZE, "much")
    with pytest.raises(DataError, match="PD4DGS_CACHE_GIB is 'much', expected GiB > 0"):
        stored(0, 3)


WRITER = """
import fcntl, sys, time
stream = open(sys.argv[1], "wb")
fcntl.flock(stream, fcntl.LOCK_EX)
stream.write(bytes(100_000))
stream.flush()
print("written", flush=True)
time.sleep(60)
"""


def test_what_a_killed_process_left_in_the_cache_is_removed(stored, cache, monkeypatch):
    """What another process is writing stays, and counts."""
    folder = cache / ".pd4dgs-other"
    folder.mkdir(parents=True)
    argv = [sys.executable, "-c", WRITER, str(folder / cached.UNFINISHED)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline()
        os.utime(folder / cached.UNFINISHED, (0, 0))
        stored()
        assert (folder / cached.UNFINISHED).stat().st_size == 100_000
        monkeypatch.setenv(cached.SIZE, str(100_000 / 2**30))
        with pytest.raises(DataError, match="expected a larger PD4DGS_CACHE_GIB"):
            stored(1)
        monkeypatch.delenv(cached.SIZE)
        writer.kill()
    stored(2)
    assert not folder.exists()


def test_a_full_disk_keeps_no_part_of_a_video(folder, monkeypatch, cache):
    monkeypatch.setattr(cached.os, "replace", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(DataError, match="cannot keep the frames of cam0.mp4: the disk is full"):
        load(folder)
    assert not list(cache.iterdir())


def test_a_video_that_another_process_has_just_removed_takes_no_room(stored, cache):
    cache.mkdir()
    (cache / "gone.frames").symlink_to("nothing")  # is listed and cannot be measured
    assert len(stored()) == INSTANTS


def test_a_cut_or_foreign_cache_file_and_a_lost_one_are_made_anew(stored, cache):
    frames = stored()
    (file,) = cache.glob("*.frames")
    expected, whole = frames.read(0), file.read_bytes()
    zeros, foreign = bytes(len(whole)), b"[]" + b"\2" + bytes(7)
    for damaged in (zeros, whole[: len(whole) // 2], whole[100:], foreign):
        file.write_bytes(damaged)
        np.testing.assert_array_equal(stored().read(0), expected)
        assert file.read_bytes() == whole
    file.write_bytes(zeros)
    for _ in range(2):  # the first error removes the file
        with pytest.raises(DataError, match="missing or broken"):
            frames.read(0)
    np.testing.assert_array_equal(stored().read(0), expected)


def test_training_views_are_kept_within_a_budget(scene, monkeypatch):
    import torch

    views = scene.train[:6]
    whole = TrainingViews(views, scene.background, torch.device("cpu"))
    size = whole[0].nbytes
    monkeypatch.setattr("pd4dgs_codec.train.state.KEPT_BYTES", 2 * size)
    few = TrainingViews(views, scene.background, torch.device("cpu"))
    for index in (0, 1, 0, 5, 0, 2):
        assert torch.equal(few[index].image, whole[index].image)
    assert set(few._kept) == {(0, 1), (2, 1)} and few._bytes == 2 * size
    assert few[0] is few[0] and len(few) == 6


@pytest.fixture(scope="module")
def recorded(once):
    """A video of 60 frames that begins with its header, so that it plays while it arrives."""
    from pd4dgs_codec.quality.frames import write_mp4

    def make(folder):
        pictures = np.random.default_rng(0).integers(0, 255, (60, 48, 64, 3), np.uint8)
        write_mp4(iter(pictures), folder / "plain.mp4", 30)
        arguments = ["-i", str(folder / "plain.mp4"), "-c", "copy", "-movflags", "+faststart", str(folder / "film.mp4")]
        with cached.ffmpeg(arguments) as run:
            assert run.end() == (0, "")

    return once("film", make) / "film.mp4"


@pytest.fixture
def film(recorded, tmp_path):
    """A copy that a test may damage."""
    return Path(shutil.copy(recorded, tmp_path))


@pytest.mark.parametrize("name", ["walk: day 1.mp4", "pipe:0", "-y é%d.mp4"])
def test_any_name_of_a_video_is_written_and_read(name, tmp_path, monkeypatch):
    from pd4dgs_codec.quality.frames import write_mp4

    monkeypatch.chdir(tmp_path)
    write_mp4(iter(np.zeros((3, 16, 16, 3), np.uint8)), Path(name), 30)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert sum(1 for _ in cached.open_video(Path(name)).pictures) == 3


def test_a_video_that_is_cut_is_refused(film):
    whole = film.read_bytes()
    assert sum(1 for _ in cached.open_video(film).pictures) == 60
    for share in (0.3, 0.6, 0.97):
        film.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DataError, match=r"film.mp4: is damaged: found \d+ of 60 frames"):
            list(cached.open_video(film).pictures)


def test_damage_inside_a_video_is_told(film):
    data = bytearray(film.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4000] = b"\x55" * 4000
    film.write_bytes(data)
    try:
        with pytest.warns(DamageWarning, match="film.mp4: is damaged: found"):
            list(cached.open_video(film).pictures)
    except DataError as error:  # a decoder may give up
        assert "is damaged" in str(error)


@pytest.mark.parametrize(
    "raw",
    [
        b"ffconcat version 1.0\nfile whole.mp4\nfile whole.mp4\n",
        b"#EXTM3U\n#EXT-X-VERSION:3\n#EXTINF:1,\nwhole.mp4\n#EXT-X-ENDLIST\n",
        b'<svg xmlns="http://www.w3.org/2000/svg" width="64" height="48"><rect width="9" height="9"/></svg>',
        png(),
    ],
    ids=["concat", "hls", "svg", "png"],
)
def test_lists_of_other_files_and_pictures_are_no_videos(film, tmp_path, raw):
    shutil.copy(film, tmp_path / "whole.mp4")
    (tmp_path / "list.mp4").write_bytes(raw)
    with pytest.raises(DataError, match="list.mp4: cannot be decoded: .*; expected a whole video in a container among"):
        list(cached.open_video(tmp_path / "list.mp4").pictures)
