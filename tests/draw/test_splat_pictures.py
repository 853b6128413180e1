"""Pictures of splats: every prefix of any file renders, and the player draws what the scene says."""

from dataclasses import fields, replace

import numpy as np
import pytest
from explicit import splat_scenes, visible_splats
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import camera_ahead, camera_around

from pd4dgs_codec import decode, encode, render
from pd4dgs_codec.draw.player import drawer
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.errors import DataError, RenderError
from pd4dgs_codec.format.decoder import every_prefix
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.quality.levels import load_levels

SIZE = {"width": 24, "height": 16}


@given(splat_scenes(), st.integers(0, 2**32 - 1), st.floats(-10, 10, width=32))
@settings(max_examples=25)
def test_every_prefix_renders_at_any_time_from_any_camera(scene, seed, t):
    data = encode(scene, layers=2, effort=1, verify=False, slices=1500)
    cameras = [camera_ahead(2.0, 20.0, **SIZE), replace(camera_around(np.random.default_rng(seed)), **SIZE)]
    for prefix in every_prefix(data):
        player = drawer(prefix)
        for camera in cameras:
            pictures = {time: player.picture(camera, time) for time in (-2.5, 0.0, 0.3, 1.0, 17.0, t)}
            for picture in pictures.values():
                assert picture.shape == (16, 24, 3) and picture.dtype == np.float32
                assert np.isfinite(picture).all() and picture.min() >= 0 and picture.max() <= 1
            np.testing.assert_array_equal(pictures[-2.5], pictures[0.0])
            np.testing.assert_array_equal(pictures[17.0], pictures[1.0])


def test_levels_show_something_and_move():
    scene = decode(encode(visible_splats(), effort=1))
    camera = scene.info.camera
    shown = {(level, t): render(scene, camera, t, level) for level in range(3) for t in (0.0, 0.6)}
    assert shown[0, 0.0].min() < 0.5, "something is drawn over white"
    np.testing.assert_array_equal(shown[0, 0.0], shown[0, 0.6])
    for level in (1, 2):
        assert np.abs(shown[level, 0.6] - shown[level, 0.0]).max() > 0.2
        assert np.abs(shown[level, 0.6] - shown[level - 1, 0.6]).max() > 0.2
    with pytest.raises(RenderError, match="time is 2"):
        render(scene, camera, 2.0)


def test_the_player_draws_the_gaussians_of_the_scene():
    scene = decode(encode(visible_splats(degree=3), effort=1))
    camera, player = scene.info.camera, drawer(scene)
    for t in (0.3, 0.3, 0.8):  # again at the same time: from what is kept
        g, own = scene.gaussians(t, eye=camera.eye), player.gaussians(camera, t)
        for field in fields(g):
            np.testing.assert_array_equal(getattr(own, field.name), getattr(g, field.name))
        arrays = (g.means, g.quats, g.scales, g.opacities, g.colors)
        expected, _ = draw(*arrays, camera, scene.background(), near_plane=scene.info.near)
        np.testing.assert_array_equal(player.picture(camera, t), expected.clip(0, 1))


def test_a_fill_is_behind_the_gaussians_of_its_prefix():
    scene = replace(visible_splats(), fills=((255, 0, 0), (0, 255, 0), None))
    data = encode(scene, effort=1)
    levels = load_levels(data)
    corners = [level.picture(scene.info.camera, 0.0)[0, 0].tolist() for level in levels]
    assert corners == [[1, 0, 0], [0, 1, 0], [1, 1, 1]]
    assert [level.anchors for level in levels] == [len(scene.anchor_q)] * 3
    assert load_levels(data, background=(0.0, 0.0, 1.0))[0].picture(scene.info.camera, 0.0)[0, 0].tolist() == [0, 0, 1]


def test_a_spread_enlarges_the_gaussians_of_its_prefix():
    plain = visible_splats()
    wide = replace(plain, fills=((0, 0, 0, 64), None, (0, 0, 0, 32)))
    for level, spread in enumerate((2, 1, 1.5)):
        for t in (0.0, 0.6):
            sizes = [decode(encode(scene, effort=1)).gaussians(t, level).scales for scene in (plain, wide)]
            np.testing.assert_allclose(sizes[1], np.float32(spread) * sizes[0], rtol=1e-6)


def test_splats_are_no_model():
    with pytest.raises(DataError, match="^found a scene of splats, which has no networks; .* hold scaffolds only$"):
        from_scene(decode(encode(visible_splats(count=40), effort=1)))
