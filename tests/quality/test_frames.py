"""Camera paths, panels and movies."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageSequence

from pd4dgs_codec.errors import DataError, RenderError
from pd4dgs_codec.quality import frames
from pd4dgs_codec.scene import Camera, SceneInfo


def _info() -> SceneInfo:
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3] = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]  # looks along -x, image y down is world -z
    viewmat[:3, 3] = viewmat[:3, :3] @ np.array([-5, -0.5, -1], np.float32)
    K = np.array([[50, 0, 31], [0, 60, 24], [0, 0, 1]], np.float32)
    box = np.array([[-1, -1, -1], [1, 2, 3]], np.float32)
    return SceneInfo(0.1, box, (0, 1), (0, 0, 0), 0.1, 10.0, (0.0, 0.0, 2.0), 0.0, Camera(viewmat, K, 64, 48))


def _pixel(camera: Camera, point: np.ndarray) -> np.ndarray:
    p = camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3]
    return np.array([*(camera.K @ p)[:2] / p[2], p[2]])


def test_look_at_point_lies_on_the_optical_axis_beside_the_box_centre():
    np.testing.assert_allclose(frames.look_at_point(_info()), [0, 0.5, 1], atol=1e-6)


@pytest.mark.parametrize("angle", [0.3, -2.0, np.pi])
def test_orbit_keeps_the_point_in_place_and_turns_about_up(angle):
    info = _info()
    centre = frames.look_at_point(info)
    moved = frames.turned(info.camera, centre, info.up, angle)
    np.testing.assert_allclose(_pixel(moved, centre), _pixel(info.camera, centre), atol=1e-4)
    rotation = moved.viewmat[:3, :3].astype(np.float64)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    eye = -rotation.T @ moved.viewmat[:3, 3]
    before = -info.camera.viewmat[:3, :3].T @ info.camera.viewmat[:3, 3]
    (x, y, z), c, s = before - centre, np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(eye, centre + [c * x - s * y, s * x + c * y, z], atol=1e-5)


def test_own_frames_span_the_time_and_begin_and_end_at_the_given_camera():
    info = _info()
    path = frames.own_frames(info, 5, orbit=40.0)
    assert [f.time for f in path] == [0.0, 0.25, 0.5, 0.75, 1.0]
    for i in (0, 2, 4):
        np.testing.assert_allclose(path[i].camera.viewmat, info.camera.viewmat, atol=1e-5)
    assert not np.allclose(path[1].camera.viewmat, info.camera.viewmat, atol=1e-2)
    assert [f.time for f in frames.own_frames(info, 1)] == [0.0]


def test_a_camera_of_too_many_pixels_is_refused_unless_shrunk():
    info = _info()
    vast = replace(info, camera=replace(info.camera, width=65_535, height=65_535))
    with pytest.raises(RenderError, match="65535x65535.*--downscale"):
        frames.own_frames(vast, 1)
    assert frames.own_frames(vast, 1, downscale=16)[0].camera.width == 4095


def test_shrunk_camera_sees_the_same_rays():
    camera = _info().camera
    small = frames.shrunk(camera, 3)
    assert (small.width, small.height) == (21, 16)
    point = np.array([-2.0, 0.7, 1.3])
    np.testing.assert_allclose(_pixel(small, point)[:2] * 3, _pixel(camera, point)[:2], rtol=1e-6)


def test_panels_paste_images_unchanged_below_captions():
    a, b = np.full((40, 60, 3), 10, np.uint8), np.full((40, 30, 3), 200, np.uint8)
    captioned = (frames.Panel(a, "level 0, 12 kB"), frames.Panel(b, "a caption far too long for its image"))
    sheet = frames.side_by_side(captioned)
    assert sheet.shape == (40 + 16, 60 + 30 + frames.GAP, 3)
    assert np.array_equal(sheet[-40:, :60], a) and np.array_equal(sheet[-40:, -30:], b)
    band = sheet[:-40]
    assert (band[:, :60] < 128).any() and (band[:, 60 : 60 + frames.GAP] == 255).all()


def test_captions_state_the_size():
    assert frames.level_caption(1, None) == "level 1"
    assert frames.level_caption(0, 425_000) == "level 0, 425 kB"
    assert frames.level_caption(2, 6_880_000) == "level 2, 6.88 MB"


def test_a_film_of_one_pixel_is_refused_in_one_line(tmp_path):
    with pytest.raises(RenderError, match="1x2 pixels, expected at least 2x2 for a video"):
        frames.write_mp4(iter([np.zeros((2, 1, 3), np.uint8)]), tmp_path / "a.mp4", 10.0)


def test_gif_keeps_order_count_and_speed(tmp_path):
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200)]
    images = [np.full((8, 10, 3), c, np.uint8) for c in colours]
    mixed = np.concatenate([*images], axis=1)  # the first frame's palette serves all
    frames.write_gif(iter([mixed] + [np.tile(i, (1, 3, 1)) for i in images]), tmp_path / "a.gif", 10.0)
    gif = Image.open(tmp_path / "a.gif")
    assert gif.n_frames == 4 and gif.info["duration"] == 100
    for i, colour in enumerate(colours, start=1):
        gif.seek(i)
        found = np.asarray(gif.convert("RGB"))[4, 4].astype(int)
        assert np.abs(found - colour).max() <= 8
    frames.write_gif(iter([mixed, *(np.tile(i, (1, 3, 1)) for i in images)]), tmp_path / "b.gif", 30.0)
    shown = ImageSequence.Iterator(Image.open(tmp_path / "b.gif"))
    assert [frame.info["duration"] for frame in shown] == [30, 40, 30, 30]


def test_a_still_gif_too_long_for_its_format_is_refused_in_one_line(tmp_path):
    still = [np.zeros((2, 2, 3), np.uint8)] * 8  # of 100 s each; a picture lasts at most 655.35 s
    with pytest.raises(DataError, match="too long for a .gif at 0.01 frames per second"):
        frames.write_gif(iter(still), tmp_path / "a.gif", 0.01)
