"""Choice of frames: sharp, spread over time, without repetitions."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter
from rooms import HEIGHT, WIDTH, walk
from videos import write_video

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.prepare import FEWEST_FRAMES
from pd4dgs_codec.prepare.stages import FrameFolder, Look, choose, look, open_recording, sharpness, write_frames

pytest.importorskip("imageio_ffmpeg")
FPS = 10


def nothing() -> None:
    pass


def blurred(picture: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).filter(ImageFilter.GaussianBlur(4)))


@pytest.fixture(scope="module")
def recording() -> list[np.ndarray]:
    """16 frames, of which the 5th is blurred and the 9th repeats the one before."""
    pictures = walk(16)[0]
    pictures[5], pictures[9] = blurred(pictures[5]), pictures[8]
    return pictures


@pytest.fixture(scope="module")
def film(recording, once) -> Path:
    """The recording as a video."""
    return once("film-of-a-walk", lambda folder: write_video(folder / "film.mp4", recording, FPS)) / "film.mp4"


def write_folder(path, pictures) -> None:
    path.mkdir()
    for i, picture in enumerate(pictures):
        Image.fromarray(picture).save(path / f"shot{i + 1}.png")  # 10 comes after 9
    (path / "._shot1.png").write_bytes(b"of macOS")


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_the_blurred_and_the_repeated_frame_are_left_out(kind, recording, tmp_path, request):
    if kind == "video":
        path = request.getfixturevalue("film")
    else:
        write_folder(path := tmp_path / "film", recording)
    source = open_recording(path, FPS)
    looks = look(source, nothing)
    assert [frame.time for frame in looks] == pytest.approx([i / FPS for i in range(16)])
    choice = choose(looks, 0)
    assert choice.blurred == (5,) and choice.repeated == (9,)
    assert choice.chosen == tuple(i for i in range(16) if i not in (5, 9))
    (tmp_path / "out").mkdir()
    times = write_frames(source, choice.chosen, tmp_path / "out", 2, nothing)
    for (name, seconds), i in zip(times.items(), choice.chosen, strict=True):
        assert seconds == pytest.approx(i / FPS)
        written = np.asarray(Image.open(tmp_path / "out" / name), np.float64)
        blocks = recording[i].reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
        assert np.abs(written - blocks).max() <= 0.5


def remade(path, target, before=(), after=()):
    """A video as ffmpeg makes it of another one."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *before, "-i", path, *after, target]
    subprocess.run(command, check=True)
    return target


def test_a_video_held_upright_is_upright(recording, film, tmp_path, caplog):
    """A phone writes its sensor's rows and a rotation, which is no reason for a warning."""
    path = remade(film, tmp_path / "up.mp4", ["-display_rotation:v:0", "90"], ["-c", "copy"])
    source = open_recording(path, FPS)
    assert source.size == (HEIGHT, WIDTH) and len(look(source, nothing)) == 16
    (found,) = source.pictures([3])
    np.testing.assert_array_equal(found, np.rot90(recording[3]))
    assert not caplog.records


@pytest.mark.parametrize("flag", [3, 6])
def test_pictures_of_a_phone_are_turned_as_they_say(tmp_path, flag):
    """And may be WebP."""
    picture = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    exif = Image.Exif()
    exif[0x0112] = flag
    for i in range(3):
        Image.fromarray(np.ascontiguousarray(np.rot90(picture, flag // 3))).save(
            tmp_path / f"{i}.webp", lossless=True, exif=exif
        )
    folder = FrameFolder(tmp_path, 30.0)
    turned = np.rot90(picture, {3: 3, 6: 1}[flag])
    assert folder.size == turned.shape[1::-1]
    np.testing.assert_array_equal(next(folder.pictures([1])), turned)


def test_frames_of_a_varying_rate_have_their_times(recording, film, tmp_path):
    """A pause of .8 s is in the middle, as when a phone drops frames."""
    true = [i / FPS + 0.8 * (i >= 8) for i in range(16)]
    lossless = "-c:v libx264rgb -preset ultrafast -qp 0".split()
    filters = ["-vf", f"setpts=(N+8*gte(N\\,8))/{FPS}/TB", "-fps_mode", "vfr", *lossless]
    source = open_recording(remade(film, tmp_path / "vary.mp4", after=filters), FPS)
    choice = choose(look(source, nothing), 0)
    assert len(choice.chosen) >= FEWEST_FRAMES
    for index, found in zip(choice.chosen, source.pictures(choice.chosen), strict=True):
        same = [np.array_equal(found, picture) for picture in recording]
        assert any(abs(true[i] - source.time(index)) <= 1 / source.fps for i in np.flatnonzero(same))


def test_frames_are_spread_over_the_time_and_are_the_sharpest_of_their_stretch():
    sharp = [100.0 + 10 * (i % 5 == 3) for i in range(50)]
    choice = choose([Look(i, i / 10, s, 5.0) for i, s in enumerate(sharp)], 10)
    assert choice.chosen == tuple(range(3, 50, 5))


def test_a_still_camera_before_a_still_scene_leaves_one_frame():
    choice = choose([Look(i, i / 10, 100.0, 0.0 if i else float("inf")) for i in range(20)], 10)
    assert choice.chosen == (0,) and len(choice.repeated) == 19


def test_slow_motion_is_no_repetition(tmp_path):
    """Ten pixels in forty frames, over a texture that changes by less than SAME from one frame to the next."""
    x = np.arange(64) - np.arange(40)[:, None] / 4
    rows = np.rint(128 + 8 * np.sin(2 * np.pi * x / 64)).astype(np.uint8)
    write_folder(tmp_path / "slow", np.broadcast_to(rows[:, None, :, None], (40, 48, 64, 3)))
    looks = look(open_recording(tmp_path / "slow", 240), nothing)
    assert len(choose(looks, 0).chosen) >= FEWEST_FRAMES


def test_sharpness_is_the_variance_of_the_laplacian():
    picture = np.random.default_rng(0).random((7, 9), dtype=np.float32)
    expected = [
        picture[y - 1, x] + picture[y + 1, x] + picture[y, x - 1] + picture[y, x + 1] - 4 * picture[y, x]
        for y in range(1, 6)
        for x in range(1, 8)
    ]
    assert sharpness(picture) == pytest.approx(np.var(expected), rel=1e-5)


def test_broken_recordings_are_one_line(recording, tmp_path):
    def line(path) -> str:
        with pytest.raises(DataError) as caught:
            look(open_recording(path, FPS), nothing)
        return str(caught.value)

    assert line(tmp_path / "none.mp4").endswith("found nothing, expected a video or a folder of frames")
    (tmp_path / "text.mp4").write_text("no video")
    assert "text.mp4: cannot be decoded" in line(tmp_path / "text.mp4")
    (tmp_path / "empty").mkdir()
    assert "found no picture" in line(tmp_path / "empty")
    write_folder(tmp_path / "short", recording[:3])
    assert f"3 frames, expected at least {FEWEST_FRAMES}" in line(tmp_path / "short")
    Image.fromarray(recording[3][:100]).save(tmp_path / "short" / "shot4.png")
    assert "is 320x100, expected 320x240" in line(tmp_path / "short")
    Image.fromarray(recording[3]).save(tmp_path / "short" / "other1.png")
    assert "two pictures have the same number" in line(tmp_path / "short")
