"""The graph: levels, residuals, gate, culling; the model against numpy, against its scene and against its file."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pd4dgs_codec import decode, encode, open_stream
from pd4dgs_codec.draw.hexplane import Field
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.model import checkpoint, fused
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model, fresh_networks, from_scene, to_scene
from pd4dgs_codec.model.networks import EXACT, level_mask, mask_logits
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.scene import (
    DEFAULT_WIDTHS,
    HEADS,
    MASK_STEP,
    MASK_THRESHOLD,
    PLANES,
    Camera,
    Deformation,
    Head,
    Network,
    SceneInfo,
    Steps,
)
from pd4dgs_codec.train.phases.quantisation import centre

WIDTH, HEIGHT = 40, 30
VOXEL = 2.0**-6
BOX = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]], np.float32)
VIEWMAT = np.eye(4, dtype=np.float32)
VIEWMAT[2, 3] = 4.0
CAMERA = Camera(VIEWMAT, np.array([[40.0, 0, 19.5], [0, 40.0, 15.5], [0, 0, 1]], np.float32), WIDTH, HEIGHT)
FLAT = (200, 200, 200)  #: one mask at all levels


ALL_HEADS = (tuple(HEADS), tuple(HEADS))


def small_model(
    heads=ALL_HEADS, masks=FLAT, *, anchors=80, seed=0, channels=8, reach=1.0, opacity=1.0, widths=DEFAULT_WIDTHS
) -> Model:
    """An untrained model with `anchors` of different looks within +-reach; masks: codes per level, for all anchors or
    [anchors, 3]. Deformations without heads are None."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    side = int(reach / VOXEL)
    cells = np.unique(rng.integers(-side, side + 1, (2 * anchors, 3), dtype=np.int32), axis=0)
    cells = rng.permutation(cells)[:anchors]
    info = SceneInfo(VOXEL, BOX, (0.0, 1.0), (0.25, 0.5, 0.75), 0.125, 64.0, (0.0, -1.0, 0.0), 0.0, CAMERA)
    networks = fresh_networks(widths, 16)
    torch.nn.init.constant_(networks["opacity"].linears[-1].bias, opacity)
    config = DeformationConfig(((5, 4), (10, 4)), channels, 8)
    fields = [
        DeformationField.fresh(replace(config, heads=names), BOX, widths.heads, None, below) if names else None
        for names, below in zip(heads, (0, 2 * channels if heads[0] else 0), strict=True)
    ]
    codes = np.broadcast_to(np.asarray(masks, np.float64), (anchors, 3)) * MASK_STEP
    values = [0.5 * rng.normal(size=(anchors, *shape)) for shape in widths.attributes.values()]
    feature, scaling_log, offset = (torch.from_numpy(v.astype(np.float32)) for v in values)
    logits = torch.from_numpy(mask_logits(codes))
    steps = Steps().scaled(1.0)
    return Model(info, steps, torch.from_numpy(cells), feature, scaling_log - 2.5, offset, logits, networks, *fields)


@torch.no_grad()
def stir(model: Model, amount: float, seed: int = 1) -> Model:
    """Gives every deformation planes that vary and heads that move things by about `amount`."""
    generator = torch.Generator().manual_seed(seed)
    for field in (model.global_deformation, model.local_deformation):
        if field is not None:
            field.planes.grid.copy_(0.5 + torch.rand(field.planes.grid.shape, generator=generator))
            for head in field.heads.values():
                for parameter in head.parameters():
                    parameter.copy_(amount * (torch.rand(parameter.shape, generator=generator) - 0.5))
    return model


@torch.no_grad()
def gaussians(model: Model, level: int, t: float = 0.3, camera=CAMERA):
    return model.gaussians(level, t, camera)


def picture(model: Model, level: int, t: float = 0.3, camera=CAMERA) -> np.ndarray:
    image = render_image(model, level, t, camera)
    assert np.abs(image - model.info.background).max() > 0.1  # something is drawn, or the tests compare nothing
    return image


def set_bias(field: DeformationField, head: str) -> torch.Tensor:
    """Makes the head answer one constant everywhere, and returns it."""
    bias = field.heads[head].linears[0].bias
    with torch.no_grad():
        bias.copy_(0.1 * torch.cos(torch.arange(len(bias)) + 0.5))
    return bias.detach().clone()


# -- levels ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("t", [0.0, 0.37, 1.0])
def test_a_fresh_model_looks_the_same_at_every_level(t):
    model = small_model()
    assert model.level == 2
    base = picture(model, 0, t)
    for level in (1, 2):
        np.testing.assert_allclose(picture(model, level, t), base, atol=1e-6)


def test_a_fresh_model_differs_between_levels_by_its_gate_alone():
    model = small_model(masks=(100, 150, 250), opacity=2.0)  # no Gaussian so faint that a gate hides it
    low, high = gaussians(model, 0), gaussians(model, 2)
    assert torch.equal(low.slots, high.slots) and len(low.slots) == 800
    for name in ("means", "quats", "colors"):
        torch.testing.assert_close(getattr(low, name), getattr(high, name), rtol=0, atol=1e-6)
    for name in ("opacities", "scales"):
        torch.testing.assert_close(getattr(high, name), 2.5 * getattr(low, name), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("level,reached", [(0, [0]), (1, [1]), (2, [1, 2])])
def test_above_level_0_no_gradient_reaches_its_mask(level, reached):
    logits = torch.zeros(4, 3, requires_grad=True)
    level_mask(logits, level).sum().backward()
    assert logits.grad.any(0).nonzero()[:, 0].tolist() == reached


@given(hnp.arrays(np.float64, (5, 3), elements=st.floats(0, 1)))
@settings(max_examples=40)
def test_mask_logits_invert_level_mask(masks):
    masks = np.sort(masks, axis=1)
    logits = torch.from_numpy(mask_logits(masks))
    for level in range(3):
        np.testing.assert_allclose(level_mask(logits, level).numpy(), masks[:, level], atol=1.5e-6)


def test_only_anchors_above_the_threshold_take_part():
    codes = np.tile(np.array([[0, 0, 3], [0, 3, 200], [3, 3, 3], [2, 2, 2]]), (20, 1))
    model = small_model(masks=codes)
    for level in range(3):
        evaluated = gaussians(model, level).anchors.tolist()
        assert evaluated == [i for i in range(80) if codes[i, level] * MASK_STEP > MASK_THRESHOLD]


# -- deformations ------------------------------------------------------------------------------------------------------


def deformed_at(level: int, head: str) -> tuple[Model, torch.Tensor]:
    """A model with one constant residual at `level`, and that; residuals of another level vary."""
    model = stir(small_model(), 0.1)
    bias = set_bias(model.deformations[level], head)
    with torch.no_grad():
        for name, net in model.deformations[level].heads.items():
            net.linears[0].weight.zero_()
            net.linears[0].bias.mul_(name == head)
    return model, bias


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("head", ["feature", "offset", "scaling"])
def test_a_residual_is_added_to_its_attribute_in_place_of_that_below(level, head):
    plain, (model, bias) = small_model(), deformed_at(level, head)
    attribute = plain.scaling_log if head == "scaling" else getattr(plain, head)
    with torch.no_grad():
        attribute += bias.view(attribute.shape[1:])
    got, expected = gaussians(model, level), gaussians(plain, 0)
    assert torch.equal(got.slots, expected.slots)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), rtol=1e-5, atol=1e-5)
    assert not np.allclose(picture(model, level), picture(model, 0), atol=1e-3)


@pytest.mark.parametrize("level", [1, 2])
def test_the_position_residual_moves_anchors_and_the_view_direction(level):
    """Moving every anchor by b is moving the camera by -b, the networks' view direction included."""
    model, bias = deformed_at(level, "position")
    bias = bias * model.deformations[level].unit
    moved = gaussians(model, level)
    viewmat = VIEWMAT.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ bias.numpy()
    camera = replace(CAMERA, viewmat=viewmat)
    expected = gaussians(model, 0, camera=camera)
    assert torch.equal(moved.slots, expected.slots)
    torch.testing.assert_close(moved.means, expected.means + bias, rtol=0, atol=1e-6)
    for name in ("quats", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(moved, name), getattr(expected, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(picture(model, level), picture(model, 0, camera=camera), atol=1e-4)
    assert (gaussians(model, 0).colors - moved.colors).abs().max() > 1e-4


@pytest.mark.parametrize("columns", [slice(0, 16), slice(16, 32)])
def test_level_2_reads_the_planes_of_both_layers(columns):
    model = stir(small_model(), 0.3)
    before = picture(model, 1), picture(model, 2)
    with torch.no_grad():
        weight = model.local_deformation.trunk.linears[0].weight
        assert weight.shape[1] == 32
        weight[:, columns] = 0
    np.testing.assert_array_equal(picture(model, 1), before[0])
    assert not np.allclose(picture(model, 2), before[1], atol=1e-3)


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("head", HEADS)
def test_each_head_can_stand_alone(head, level):
    model = stir(small_model(tuple((head,) if layer == level else () for layer in (1, 2))), 0.3)
    assert set(model.deformations[level].heads) == {head} and model.level == level
    assert not np.allclose(picture(model, level), picture(model, level - 1), atol=1e-3)
    np.testing.assert_array_equal(picture(model, 2), picture(model, level))


def test_a_level_without_deformation_is_the_level_below():
    model = stir(small_model(((), tuple(HEADS))), 0.1)
    np.testing.assert_array_equal(picture(model, 1), picture(model, 0))
    assert not np.allclose(picture(model, 2), picture(model, 1), atol=1e-3)
    assert small_model(((), ())).level == 0


# -- what is not evaluated ---------------------------------------------------------------------------------------------


def everything(model, masks, *_):
    return (masks > MASK_THRESHOLD).nonzero()[:, 0]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_culling_changes_no_pixel(level, monkeypatch):
    """Anchors all around the camera, some of them half in the picture."""
    model = stir(small_model(anchors=1500, reach=3.0), 0.02)
    cameras = []
    for angle in (0.3, 2.0, 4.1):
        viewmat = np.eye(4, dtype=np.float32)
        c, s = np.cos(angle), np.sin(angle)
        viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        cameras.append(replace(CAMERA, viewmat=viewmat))
    culled = [(picture(model, level, camera=c), len(gaussians(model, level, camera=c).anchors)) for c in cameras]
    monkeypatch.setattr(Model, "_visible", everything)
    for camera, (image, evaluated) in zip(cameras, culled, strict=True):
        assert 0 < evaluated < 750  # fewer than half
        np.testing.assert_allclose(picture(model, level, camera=camera), image, atol=1e-5)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_faint_gaussians_left_out_change_no_pixel(level, monkeypatch):
    model = stir(small_model(opacity=0.0), 0.05)
    with torch.no_grad():  # from clearly negative over just visible to opaque
        model.networks["opacity"].linears[-1].bias.copy_(torch.linspace(-0.3, 0.4, 10))
    image, kept = picture(model, level), len(gaussians(model, level).slots)
    monkeypatch.setattr(fused, "MIN_OPACITY", -2.0)
    assert 0.2 * 800 < kept < 0.8 * len(gaussians(model, level).slots)
    np.testing.assert_allclose(picture(model, level), image, atol=1e-5)


# -- the model elsewhere -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [8, 3])
def test_playback_moves_anchors_as_the_model_does(channels):
    """Inside the box, on its corners, outside it; at and beyond both ends of time."""
    model = stir(small_model(channels=channels), 0.7)
    points = np.random.default_rng(4).uniform(-2, 2, (200, 3)).astype(np.float32)
    points[:2] = BOX
    columns, scene = model.widths.head_columns, to_scene(model)
    rows = torch.zeros(len(points), columns["offset"].stop)
    rows[:, :3] = torch.from_numpy(points)
    for level in (1, 2):
        for t in (-0.5, 0.0, 0.123, 0.5, 1.0, 2.0):
            with torch.no_grad():
                moved = model._moved(level, rows, t, EXACT, channels == 8) - rows
            got = np.zeros(rows.shape, np.float32)
            Field(scene.motion(level), BOX, columns).move(got, points, t)
            np.testing.assert_allclose(got, moved.numpy(), rtol=0, atol=1e-5)
            assert np.abs(got).max(axis=0).min() > 0.01


@pytest.mark.parametrize("deep,kernels", [(False, True), (False, False), (True, False)])
def test_heads_of_one_quantity_add_to_the_same_columns(monkeypatch, deep, kernels):
    before = DEFAULT_WIDTHS.head_columns
    monkeypatch.setitem(HEADS, "tint", Head(lambda widths: widths.feature, "feature"))
    columns = DEFAULT_WIDTHS.head_columns
    assert columns == before | {"tint": before["feature"]}
    rng, networks = np.random.default_rng(0), dict[str, Network]()
    for name, width in {"trunk": 8, "feature": 32, "tint": 32}.items():
        last = (rng.normal(size=(width, 8)).astype(np.float32), rng.normal(size=width).astype(np.float32))
        networks[name] = ((np.eye(8, dtype=np.float32), np.zeros(8, np.float32)), last) if deep else (last,)
    planes = ({name: rng.normal(size=(8, 3, 3)).astype(np.float32) for name, _, _ in PLANES},)
    points, t = rng.uniform(-1, 1, (20, 3)).astype(np.float32), 0.3

    def residuals(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        given = Deformation(planes, {name: networks[name] for name in ("trunk", *names)})
        field, played = DeformationField.from_arrays(given, BOX), np.zeros((20, columns["offset"].stop), np.float32)
        Field(given, BOX, columns).move(played, points, t)
        still, at = torch.zeros(played.shape), torch.from_numpy(points)
        moved = field.moved(still, lambda time: field.planes(at, time), columns, t, None, kernels)
        return played, moved.detach().numpy()

    feature, tint, both = (residuals(names) for names in (("feature",), ("tint",), ("feature", "tint")))
    for one, other, together in zip(feature, tint, both, strict=True):
        assert np.abs(one).max() > 0.1 and np.abs(other).max() > 0.1
        np.testing.assert_allclose(together, one + other, atol=1e-4)
    np.testing.assert_allclose(*both, atol=1e-4)


MIXED = np.sort(np.random.default_rng(9).choice(np.array([0, 3, 4, 90, 255]), (80, 3)), axis=1)


@pytest.mark.parametrize(
    "heads,layers",
    [
        ((("position",), ("position", "feature")), (0, 1, 2)),
        (((), ("scaling",)), (0, 2)),
        ((tuple(HEADS), ()), (0, 1)),
        (((), ()), (0,)),
    ],
)
def test_the_model_of_its_scene_renders_the_same(heads, layers):
    model = stir(small_model(heads, MIXED), 0.2)
    scene = to_scene(model)
    assert scene.layers == layers
    again = from_scene(scene)
    for level in layers:
        for t in (0.0, 0.61):
            np.testing.assert_allclose(picture(again, level, t), picture(model, level, t), atol=1e-5)


def test_a_decoded_file_encodes_to_the_same_bytes_through_the_model():
    options = {"effort": 1, "priors": "gauss"}
    data = encode(to_scene(stir(small_model(masks=MIXED), 0.5)), **options)
    decoded = decode(data)
    assert decoded.layers == (0, 1, 2)
    assert encode(to_scene(from_scene(decoded)), **options) == data


def graded_model() -> Model:
    """Anchors of all step classes, off their grids."""
    model = stir(small_model(anchors=70), 0.1)
    model.step_class.copy_(torch.arange(70) % 7)
    model.centre.copy_(centre(model))
    return model


@pytest.mark.filterwarnings("error")
def test_a_scene_of_a_stream_becomes_a_model_of_its_own():
    stream = open_stream()
    scene = stream.feed(encode(to_scene(graded_model()), effort=1))[-1]
    model = from_scene(scene)
    assert torch.equal(model.step_class, torch.from_numpy(scene.grading.classes.copy()))


def test_what_training_rounds_is_what_the_file_holds():
    """Rounded attributes are those of the decoded file, which encodes to the same bytes, through a model as well."""
    model = graded_model()
    model.round_to_steps()
    data = encode(to_scene(model), layers=2, omit="nothing", effort=1)
    scene = decode(data)
    assert scene.grading is not None and set(scene.grading.classes) == set(range(7))
    decoded = from_scene(scene)
    assert encode(to_scene(decoded), layers=2, omit="nothing", effort=1) == data
    own, other = (np.lexsort(m.anchor_q.numpy().T) for m in (model, decoded))
    assert torch.equal(decoded.step_class[other], model.step_class[own])
    for name, values in scene.attributes.items():
        np.testing.assert_allclose(values[other], getattr(model, name).detach().numpy()[own], atol=1e-6)


def test_a_checkpoint_keeps_the_step_classes(tmp_path):
    model = graded_model()
    checkpoint.save(tmp_path / "m.pt", model)
    found = checkpoint.load(tmp_path / "m.pt")[0]
    assert torch.equal(found.step_class, model.step_class) and torch.equal(found.centre, model.centre)
    model.step_class[3] = 7
    with pytest.raises(DataError, match="step classes: 7, expected at most 6"):
        checkpoint.save(tmp_path / "bad.pt", model)
    assert not (tmp_path / "bad.pt").exists()


def test_a_model_with_a_nan_becomes_no_scene():
    model = small_model()
    with torch.no_grad():
        model.offset[3, 1, 0] = float("nan")
    with pytest.raises(DataError, match="offset"):
        to_scene(model)
