"""Pictures without torch: those of the torch model, to rounding, and in a process where torch cannot be imported."""

import hashlib
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from PIL import Image
from strategies import make_scene
from tiny import camera_ahead, camera_around

from pd4dgs_codec.draw.layers import Layers
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.quality.levels import level_of
from pd4dgs_codec.scene import SCAFFOLD_NETWORKS, Camera, Deformation, Scene, Widths, instant

KEYED = {"key": 40_000}


def _camera(seed: int) -> Camera:
    return camera_around(np.random.default_rng(seed))


def _scene(**changes: object) -> Scene:
    """A scene as the decoder would return it."""
    settings = {"hidden": (12,), "channels": 8, "scales": 2, "width": 8, "extent": 30}
    scene = make_scene(5, anchors=60, kind="gaussian", **(settings | changes))
    masks = tuple(np.maximum(codes, 77) for codes in scene.mask)
    return plan(replace(scene, mask=masks), EncodeOptions(layers=2, omit="nothing")).symbols.scene()


KINDS = {
    "usual": {},
    "deep": {"hidden": (16, 8)},
    "odd": {"channels": 5, "width": 7},
    "narrow": {"widths": Widths(16, 4)},
    "odd widths": {"widths": Widths(3, 13)},
    "views of color": {"widths": Widths(viewing=("color",))},
    "views of covariance": {"widths": Widths(viewing=("covariance",)), "hidden": (16,)},
    "key instant": KEYED,
}


@pytest.mark.parametrize("changes", KINDS.values(), ids=KINDS)
def test_pictures_are_those_of_the_torch_model(changes):
    scene = _scene(**changes)
    seen = 0.0
    for layers in (0, 1, 2):
        level = scene.prefix(layers)
        player, model = Player(level), from_scene(level)
        for seed, t in ((0, 0.0), (1, 0.37), (2, 0.37), (2, 1.0)):
            camera = _camera(seed)
            expected = render_image(model, level.level, t, camera)
            got = player.picture(camera, t)
            assert got.dtype == np.float32 and got.shape == expected.shape
            # sums in another order; a Gaussian next to the threshold of opacity may come or go at 1/255
            assert np.abs(got - expected).max() < 5e-3 and np.abs(got - expected).mean() < 5e-5
            seen += float(np.ptp(got))
    assert seen > 2, "the pictures show something"


@pytest.mark.parametrize("changes", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_gaussians_of_a_scene_are_those_that_are_drawn(changes, level):
    scene, eye = _scene(**changes), np.array([1.0, -2.0, 8.0], np.float32)
    for t in (0.0, 0.37, 1.0):
        player = Player(scene.prefix(level))
        drawn, found = player.gaussians_of_eyes(player.active, t, eye[None]), scene.gaussians(t, level, eye)
        both = np.intersect1d(drawn.slots, found.slots)  # one at the threshold of opacity may come or go
        assert len(both) > 50 and len(both) >= max(len(drawn.slots), len(found.slots)) - 2
        for field in fields(found):
            own, other = (getattr(g, field.name)[np.isin(g.slots, both)] for g in (found, drawn))
            assert own.dtype == other.dtype
            np.testing.assert_allclose(own, other, rtol=5e-3, atol=1e-4, err_msg=field.name)


@pytest.mark.parametrize("level", [1, 2])
def test_motion_changes_nothing_at_its_key_instant(level):
    scene = _scene(**KEYED)
    rows = (len(scene.anchor_q),) * 3  # all anchors in every layer
    scene = replace(scene, rows=rows, mask=tuple(np.full(n, 255, np.uint8) for n in rows))
    still, moving = Player(scene.prefix(0)), Player(scene.prefix(level))
    at = instant(KEYED["key"])
    np.testing.assert_allclose(moving.picture(_camera(1), at), still.picture(_camera(1), at), atol=1e-5)
    assert np.abs(moving.picture(_camera(1), 0.0) - still.picture(_camera(1), 0.0)).max() > 0.05


@pytest.mark.parametrize("t", [float("nan"), float("inf")])
def test_a_time_that_is_no_number_is_refused(t):
    scene = _scene()
    with pytest.raises(RenderError, match="time is"):
        Player(scene).picture(_camera(0), t)
    with pytest.raises(RenderError, match="time is"):
        render_image(from_scene(scene), 0, t, _camera(0))


@pytest.mark.parametrize("viewing", [SCAFFOLD_NETWORKS, ("color",), ()])
def test_what_depends_on_time_alone_is_kept_and_changes_nothing(viewing):
    scene = _scene(widths=Widths(viewing=viewing))
    player = Player(scene)
    one, other = _camera(0), _camera(1)
    expected = [Player(scene).picture(camera, 0.4) for camera in (one, other)]
    np.testing.assert_array_equal(player.picture(one, 0.4), expected[0])
    for _ in range(2):
        np.testing.assert_array_equal(player.picture(other, 0.4), expected[1])
    assert player._known.any()
    np.testing.assert_array_equal(player.picture(one, 0.9), Player(scene).picture(one, 0.9))


class Untouchable:
    """Stands for what nothing may ask."""


def test_where_shapes_do_not_take_the_direction_another_eye_evaluates_colours_alone():
    scene = _scene(widths=Widths(viewing=("color",)), heads=(None, {"position": 3, "scaling": 6}))
    mild = tuple((weight / 64, bias / 64) for weight, bias in scene.networks["color"])  # no sigmoid is at its end
    scene = replace(scene, networks={**scene.networks, "color": mild})
    player, eyes = Player(scene), np.array([[0, 0, -4], [3, 1, 2]], np.float32)
    for _ in range(2):  # from the second view on
        first = player.gaussians_of_eyes(player.active, 0.4, eyes[:1])
    player._decoders.look = player._decoders.make = player._field = Untouchable()
    second = player.gaussians_of_eyes(player.active, 0.4, eyes[1:])
    both = Player(scene).gaussians_of_eyes(player.active, 0.4, eyes)
    for name, values in vars(both).items():
        np.testing.assert_array_equal(values, np.concatenate([getattr(first, name), getattr(second, name)]))
    assert (first.colors != second.colors).any()
    assert (first.opacities == second.opacities).all() and len(first.slots) > 50


def test_scenes_without_gaussians_in_view_show_the_background():
    """That of an incomplete file's level is its fill."""
    scene, camera = replace(_scene(), fills=((51, 0, 255), None, None)), camera_ahead(-1000.0, 40.0, 48, 36)
    for level, background in ((0, (0.2, 0.0, 1.0)), (1, scene.info.background), (2, scene.info.background)):
        for picture in (
            Player(scene.prefix(level)).picture(camera, 0.5),
            render_image(from_scene(scene), level, 0.5, camera),
            level_of(scene.prefix(level)).picture(camera, 0.5),
        ):
            np.testing.assert_array_equal(picture, np.broadcast_to(np.float32(background), picture.shape))
        assert level_of(scene.prefix(level)).background == background


def test_a_spread_enlarges_all_gaussians_of_its_level():
    """In every evaluation alike, and alone the scales."""
    scene, camera = _scene(), _camera(0)
    wide = replace(scene, fills=((0, 0, 0, 32), None, (0, 0, 0, 64)))
    for level, spread in enumerate((1.5, 1, 2)):
        plain, grown = (own.gaussians(0.4, level, camera.eye) for own in (scene, wide))
        np.testing.assert_allclose(grown.scales, plain.scales * np.float32(spread), rtol=1e-6)
        for name in ("means", "quats", "opacities", "colors", "slots"):
            np.testing.assert_array_equal(getattr(grown, name), getattr(plain, name))
        drawn = Player(wide.prefix(level)).picture(camera, 0.4)
        np.testing.assert_allclose(drawn, render_image(from_scene(wide), level, 0.4, camera), atol=2e-5)
        assert (np.abs(drawn - Player(scene.prefix(level)).picture(camera, 0.4)).max() > 0.05) == (spread > 1)


def test_features_that_overflow_hide_their_gaussians():
    scene = _scene()
    field = scene.local_deformation
    heads = dict(field.networks)
    ((weight, bias),) = heads["feature"]
    heads["feature"] = ((weight, np.full_like(bias, np.inf)),)
    scene = replace(scene, local_deformation=Deformation(field.planes, heads))
    assert np.isfinite(Player(scene).picture(_camera(0), 0.5)).all()


@pytest.mark.parametrize("count", [1, 31, 100])
def test_layers_are_those_of_torch(count):
    rng = np.random.default_rng(count)
    layers = tuple(
        (rng.normal(size=shape).astype(np.float32), rng.normal(size=shape[0]).astype(np.float32))
        for shape in ((40, 13), (7, 40), (21, 7))
    )
    x = rng.normal(size=(count, 13)).astype(np.float32)
    expected = torch.from_numpy(x)
    for i, pair in enumerate(layers):
        expected = torch.nn.functional.linear(expected.relu() if i else expected, *map(torch.from_numpy, pair))
    np.testing.assert_allclose(Layers(layers)(x), expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(Layers(layers, relu_last=True)(x), expected.relu(), rtol=1e-4, atol=1e-4)
    assert np.isnan(Layers(layers)(np.full_like(x, np.nan))).all()


RENDER = """
import hashlib, pkgutil, sys
from pathlib import Path
sys.modules["torch"] = None
from pd4dgs_codec.cli.render import main
code = main([sys.argv[1], "-o", sys.argv[2], "--frames", "1"])
late = "data.transforms", "data.captures", "interchange.teacher", "quality.perceptual", "train", "web.client"
loaded = {f"pd4dgs_codec.{name}" for name in late} & set(sys.modules)
assert not loaded, f"a file of its own camera waits for {loaded}"
import pd4dgs_codec.draw
for module in pkgutil.iter_modules(pd4dgs_codec.draw.__path__, "pd4dgs_codec.draw."):
    __import__(module.name)
from pd4dgs_codec import decode
from pd4dgs_codec.draw.player import Player
scene = decode(Path(sys.argv[1]).read_bytes())
picture = Player(scene).picture(scene.info.camera, 0.5)
print(hashlib.sha256(picture.tobytes()).hexdigest())
sys.exit(code)
"""


def test_rendering_a_file_needs_no_torch_and_no_datasets(tmp_path, python):
    """Without torch the picture has the same bits."""
    scene = _scene()
    data = encode(replace(scene, info=replace(scene.info, camera=_camera(0))), layers=2, effort=1)
    (tmp_path / "scene.pd4").write_bytes(data)
    told = python(RENDER, tmp_path / "scene.pd4", tmp_path / "out.png")
    assert Image.open(tmp_path / "out.png").size == (48, 36)
    picture = Player(decode(data)).picture(_camera(0), 0.5)
    assert (picture != picture[0, 0]).any() and told.split()[-1] == hashlib.sha256(picture.tobytes()).hexdigest()
