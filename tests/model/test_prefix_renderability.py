"""Every layer prefix of any file renders: a finite picture at any time, from any camera."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import LAYER_SETS, make_scene, scenes
from tiny import camera_ahead

from pd4dgs_codec import decode, encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.scene import Camera, Deformation, Scene

WIDTH, HEIGHT = 24, 16
CAMERA = camera_ahead(2.0, 20.0, WIDTH, HEIGHT)
#: Normalised times; those outside 0..1 are clamped to it.
TIMES = (-2.5, 0.0, 0.3, 1.0, 17.0)


def own_camera(scene: Scene) -> Camera:
    """The file's own camera with a small picture."""
    camera = scene.info.camera
    assert camera is not None
    shrink = np.array([[WIDTH / camera.width], [HEIGHT / camera.height], [1]], np.float32)
    return Camera(camera.viewmat, camera.K * shrink, WIDTH, HEIGHT)


def camera_near(scene: Scene, seed: int) -> Camera:
    """Any rotation, looking at one of the anchors from nearby or from within."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation[0] *= np.linalg.det(rotation)
    target = rng.permutation(scene.anchor)[0] if len(scene.anchor) else np.zeros(3)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, [0, 0, rng.choice([0.01, 0.5, 4.0])] - rotation @ target
    f = 10 ** rng.uniform(0, 3)
    K = np.array([[f, 0, WIDTH / 2], [0, f, HEIGHT / 2], [0, 0, 1]], np.float32)
    return Camera(viewmat.astype(np.float32), K, WIDTH, HEIGHT)


def shoot(model, level: int, t: float, camera: Camera) -> np.ndarray:
    """The picture, which must be finite and in 0..1."""
    image = render_image(model, level, t, camera)
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32
    assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1
    return image


def prefixes(scene: Scene) -> list[tuple[int, Scene]]:
    """(layer, scene) per layer prefix of the scene's file, from the prefix's bytes alone."""
    data = encode(scene, layers=2, effort=1, verify=False)
    return [(row["layer"], decode(data[: row["end"]], max_layer=row["layer"])) for row in info(data)["layers"]]


@given(scenes(), st.integers(0, 2**32 - 1), st.floats(-10, 10, width=32))
@settings(max_examples=10)
def test_every_prefix_renders_at_any_time_from_any_camera(scene, seed, t):
    for layer, prefix in prefixes(scene):
        model = from_scene(prefix)
        cameras = [camera_near(prefix, seed)] + ([own_camera(prefix)] if prefix.info.camera else [])
        for camera in cameras:
            pictures = [shoot(model, layer, time, camera) for time in (*TIMES, t)]
            for outside, border in ((0, 1), (-2, -3)):
                np.testing.assert_equal(pictures[outside], pictures[border])


@pytest.mark.parametrize("channels", [2, 8])
@pytest.mark.parametrize("layers", LAYER_SETS)
def test_prefixes_of_a_visible_scene_show_something_at_their_level(layers, channels):
    """8 channels go through the kernels, 2 through the reference. A level whose layer is missing looks like the one
    below it, and a moving layer moves."""
    for layer, prefix in prefixes(visible_scene(layers, channels)):
        model = from_scene(prefix)
        image = shoot(model, layer, 0.0, CAMERA)
        assert np.abs(image - np.array(prefix.info.background, np.float32)).max() > 0.1
        for above in range(layer + 1, 3):
            np.testing.assert_array_equal(shoot(model, above, 0.0, CAMERA), image)
        moves = shoot(model, layer, 0.7, CAMERA)
        assert np.array_equal(moves, image) == (layer == 0)
        np.testing.assert_array_equal(shoot(model, layer, -1.0, CAMERA), image)


@pytest.mark.parametrize("flat", [[0], [0, 1, 2]])
def test_a_box_without_extent(flat):
    scene = visible_scene((0, 1, 2), 8)
    box = scene.info.box.copy()
    box[1, flat] = box[0, flat]
    for layer, prefix in prefixes(replace(scene, info=replace(scene.info, box=box))):
        shoot(from_scene(prefix), layer, 0.3, CAMERA)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=2)
def test_log_scalings_beyond_float32_leave_pictures_finite(seed):
    """exp overflows from 88.7 on: such a Gaussian is skipped, the rest of the picture stays."""
    rng = np.random.default_rng(seed)
    scene = visible_scene((0, 1, 2), 2, seed=seed % 97)
    some = rng.random(scene.scaling_log.shape) < 0.1
    step = scene.steps.scaling_log
    extreme = rng.choice(np.array([-(1 << 23), -4000, 2800, 2839, 2840, 4000, 1 << 23]), scene.scaling_log.shape) * step
    scene = replace(scene, scaling_log=np.where(some, extreme, scene.scaling_log).astype(np.float32))
    for layer, prefix in prefixes(scene):
        model = from_scene(prefix)
        for t in (0.0, 0.6):
            shoot(model, layer, t, CAMERA)


def test_features_that_overflow_hide_their_gaussians():
    """Planes of 2e6 multiply to 6e37, the trunk takes them to infinity, and infinity times a weight of 0 is NaN."""
    scene = visible_scene((0, 2), 2)
    field = scene.local_deformation
    assert field is not None
    planes = tuple({name: np.full_like(plane, 2e6) for name, plane in scale.items()} for scale in field.planes)
    (weight, bias), (feature, shift) = field.networks["trunk"][0], field.networks["feature"][0]
    networks = {"trunk": ((np.full_like(weight, 1000), bias),), "feature": ((0 * feature, np.full_like(shift, 0.5)),)}
    found = prefixes(replace(scene, local_deformation=Deformation(planes, networks)))
    base, top = (from_scene(prefix) for _, prefix in found)
    background = np.float32(scene.info.background)
    assert np.abs(shoot(base, 0, 0.3, CAMERA) - background).max() > 0.1
    np.testing.assert_array_equal(shoot(top, 2, 0.3, CAMERA), np.broadcast_to(background, (HEIGHT, WIDTH, 3)))


def visible_scene(layers: tuple[int, ...], channels: int, seed: int = 0) -> Scene:
    """Forty opaque Gaussians or more near the origin, deformed gently."""
    scene = make_scene(seed, layers=layers, anchors=40, extent=60, channels=channels, width=8, with_camera=False)
    rng = np.random.default_rng(seed)
    scaling_log = np.float32(-2.0) + scene.scaling_log
    networks = dict(scene.networks)
    weight, bias = networks["opacity"][-1]
    networks["opacity"] = (*networks["opacity"][:-1], (weight, np.full_like(bias, 1.0)))
    codes = np.sort(rng.choice(np.array([0, 100, 255], np.uint8), (len(scaling_log), len(layers))), axis=1)
    codes[: len(codes) // 2] = 255
    return replace(scene, scaling_log=scaling_log, networks=networks, mask=tuple(codes.T.copy()))
