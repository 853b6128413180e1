"""Baking: exact for scenes without view dependence, least squares otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from tiny import camera_ahead, disc, sighted, trained_like_scene

from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.interchange.export import (
    _fitted,
    bake,
    cost,
    eyes_of_cameras,
    eyes_of_scene,
    upright,
)
from pd4dgs_codec.interchange.splats import picture
from pd4dgs_codec.kinds.splats import harmonics, unit
from pd4dgs_codec.quality.frames import turned
from pd4dgs_codec.scene import Camera, Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A scene to export, as a file gives it."""
    return decode(encode(trained_like_scene(), layers=2, effort=1))


@pytest.fixture
def player(scene) -> Player:
    return Player(scene)


@pytest.fixture
def blind_player(scene) -> Player:
    """Of the scene with networks that do not see the view direction: its Gaussians are the same from everywhere."""
    return Player(sighted(scene))


def _cameras(count: int = 12) -> list[Camera]:
    """Cameras on a half circle around the scene."""
    return [turned(camera_ahead(), np.zeros(3), (0, 1, 0), angle) for angle in np.linspace(-1.2, 1.2, count)]


@pytest.mark.parametrize("degree", [0, 3])
def test_a_scene_that_looks_the_same_from_everywhere_keeps_its_pictures(blind_player, degree):
    cameras = _cameras()
    splats, slots = bake(blind_player, 0.4, eyes_of_cameras(cameras), degree)
    assert len(splats.means) == len(slots) == len(np.unique(slots)) and splats.degree == degree
    contrast = 0.0
    for camera in cameras[::4]:
        direct = blind_player.picture(camera, 0.4)
        np.testing.assert_allclose(picture(splats, camera, blind_player.info.background), direct, atol=2e-3)
        contrast += float(np.ptp(direct))
    assert contrast > 0.5, "the pictures show something"


def test_a_turned_world_looks_the_same_to_turned_cameras(player):
    cameras = _cameras()
    turn = upright((0.3, -0.8, 0.5))
    eyes = eyes_of_cameras(cameras)
    plain, _ = bake(player, 0.7, eyes, 3)
    turned, _ = bake(player, 0.7, eyes, 3, turn)
    assert np.abs(turned.means - plain.means).max() > 0.1
    for camera in cameras[::5]:
        expected = picture(plain, camera, (0.0, 0.0, 0.0))
        camera.viewmat[:3, :3] = camera.viewmat[:3, :3] @ turn.T
        np.testing.assert_allclose(picture(turned, camera, (0.0, 0.0, 0.0)), expected, atol=1e-3)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0.3, -2.0, 0.1)])
def test_upright_carries_up_to_y(up):
    turn = upright(up)
    np.testing.assert_allclose(turn @ unit(np.array(up, float)), (0, 1, 0), atol=1e-9)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_least_squares_find_the_harmonics_that_colours_were_made_of():
    rng = np.random.default_rng(0)
    directions = unit(rng.normal(size=(64, 5, 3)))
    truth = rng.normal(0, 0.2, (5, 16, 3))
    basis = harmonics(directions, 3)
    colors = 0.5 + np.einsum("ekj,kjc->ekc", basis, truth)
    weights = rng.uniform(0.5, 1, (64, 5))
    weights /= weights.sum(axis=0)
    np.testing.assert_allclose(_fitted(basis, colors, weights), truth, atol=0.02)  # the ridge takes a little
    weights[:, 2] = 0
    np.testing.assert_array_equal(_fitted(basis, colors, weights)[2], 0)


def test_gaussians_of_eyes_equal_those_of_cameras(player):
    cameras = _cameras(3)
    eyes = eyes_of_cameras(cameras)
    for rows in (player.active, player.active[5:9]):
        seen = player.gaussians_of_eyes(rows, 0.3, eyes.places)
        per_eye = [part.reshape(3, -1, *part.shape[1:]) for part in vars(seen).values()]
        for i, camera in enumerate(cameras):
            direct = player.gaussians(camera, 0.3)
            means, _, scales, opacities, colors, slots = (part[i] for part in per_eye)
            _, here, there = np.intersect1d(slots, direct.slots, return_indices=True)
            assert len(here) > 3
            np.testing.assert_allclose(means[here], direct.means[there], atol=1e-5)
            np.testing.assert_allclose(scales[here], direct.scales[there], atol=1e-5)
            np.testing.assert_allclose(opacities[here], direct.opacities[there], atol=1e-5)
            np.testing.assert_allclose(colors[here], direct.colors[there], atol=1e-5)
            inside = np.isin(slots // player.slots, direct.slots // player.slots)
            unseen = np.setdiff1d(np.flatnonzero(inside), here)
            np.testing.assert_array_equal(opacities[unseen], 0)


def test_a_bake_is_exact_where_colours_alone_depend_on_the_view(scene):
    cameras, player = _cameras(), Player(sighted(scene, "color"))
    splats, _ = bake(player, 0.5, eyes_of_cameras(cameras), 3)
    for camera in cameras[::4]:
        difference = picture(splats, camera, player.info.background) - player.picture(camera, 0.5)
        assert np.square(difference).mean() < 1e-5


def test_the_cost_is_measured_on_held_out_views(player):
    report = cost(player, eyes_of_scene(player, 6), 1, disc(held_out=(0.2, 0.6)).test)
    assert report["views"] == 2 and 0 < report["exported_to_direct_psnr"] < 100
    assert 0 < report["exported_mpsnr"] < 60 and 0 < report["direct_mpsnr"] < 60


@pytest.mark.parametrize("camera", [True, False])
def test_eyes_around_a_scene_look_at_it(player, scene, camera):
    chosen = player if camera else Player(replace(scene, info=replace(scene.info, camera=None)))
    eyes = eyes_of_scene(chosen, 20)
    middle = np.median(chosen.positions[chosen.active], axis=0)
    assert len(eyes.cameras) == 20 and (eyes.weights > 0).all()
    for seen in eyes.cameras:
        rotation = seen.viewmat[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
        x, y, depth = rotation @ middle + seen.viewmat[:3, 3]
        assert depth > 0 and abs(x) < 0.1 * depth and abs(y) < 0.1 * depth
    if camera:  # the nearest to the file's camera counts most
        where = np.linalg.norm(eyes.places - (0, 0, -3), axis=1)
        assert eyes.weights.argmax() == where.argmin()
