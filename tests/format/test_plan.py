"""What a file leaves out, and where the anchors of a layer that goes end up."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import encoder
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.scene import HEADS, PLANES, Deformation, Widths

encode, encode_with_report = (partial(f, effort=1) for f in (encoder.encode, encoder.encode_with_report))
FINE = 2.0**-23  #: a step of weights that takes 1e-8 for 0


def constant_deformation(value, layers=1):
    """Residuals equal to `value` (of some heads, else 1). layers: the number of those whose planes the trunk reads."""
    planes = {n: np.ones((1, 5 if b == 3 else 2, 2), np.float32) for n, _, b in PLANES}
    planes["xy"][:] *= 16
    trunk = ((np.full((1, layers), 1 / 16 / layers, np.float32), np.zeros(1, np.float32)),)
    networks = {"trunk": trunk}
    for name, outputs in Widths().heads.items():
        weight = np.full((outputs, 1), value if np.isscalar(value) else value.get(name, 1.0), np.float32)
        networks[name] = ((weight, np.zeros(outputs, np.float32)),)
    return Deformation((planes,), networks)


def scene_with(global_value=None, local_value=None, weights_step=FINE):
    """Deformations whose residuals are these values everywhere."""
    scene = make_scene(4, anchors=30, heads=({}, {}))
    fields = {"steps": replace(scene.steps, weights_global=weights_step, weights_local=weights_step)}
    if global_value is not None:
        fields["global_deformation"] = constant_deformation(global_value)
    if local_value is not None:
        layers = 1 if global_value is None else 2
        fields["local_deformation"] = constant_deformation(local_value, layers=layers)
    return replace(scene, **fields)


def active_codes(scene, index):
    codes = scene.full_masks()[index]
    return {tuple(c): int(m) for c, m in zip(scene.anchor_q.tolist(), codes, strict=True) if m}


@pytest.mark.parametrize(
    "given_values,kept",
    [((1.0, 1.0), (0, 1, 2)), ((1.0, 1e-8), (0, 1)), ((1.0, None), (0, 1)), ((None, 1.0), (0, 2))]
    + [((1e-8, 1e-8), (0,)), ((None, None), (0,))],
)
def test_layers_go_with_their_deformation_and_the_highest_masks_stay(given_values, kept):
    scene = scene_with(*given_values)
    data, report = encode_with_report(scene)
    got = decode(data)
    assert got.layers == kept
    assert encode(got) == data, "a decoded file loses nothing more"
    assert active_codes(got, -1) == active_codes(scene, 2), "the highest level shows the same anchors and masks"
    for index, layer in enumerate(kept[:-1]):
        assert active_codes(got, index) == active_codes(scene, layer)
    gone = {row["what"]: row for row in report.left_out}
    for layer, value in ((1, given_values[0]), (2, given_values[1])):
        name = f"hexplane of layer {layer}"
        assert (name in gone) == (value == 1e-8)
        if name in gone:
            assert gone[name]["bytes"] > 50 and "zero" in gone[name]["why"]


@pytest.mark.parametrize("value", [1e-8, 0.0])
def test_a_layer_1_whose_planes_layer_2_reads_keeps_them_and_one_head(value):
    scene = scene_with(value, 1.0)
    data, report = encode_with_report(scene)
    got = decode(data)
    assert got.layers == (0, 1, 2) and encode(got) == data
    (given,), (kept,) = scene.global_deformation.planes, got.global_deformation.planes
    assert all(np.array_equal(kept[name], given[name]) for name in given)
    heads = [f"hexplane of layer 1 head {head}" for head in HEADS if head not in got.global_deformation.networks]
    assert len(heads) == len(HEADS) - 1 and set(heads) <= {row["what"] for row in report.left_out}


def test_a_deformation_needs_a_head():
    scene = scene_with(1.0, 1.0)
    field = scene.global_deformation
    without = replace(field, networks={"trunk": field.networks["trunk"]})
    with pytest.raises(EncodeError, match=r"chains \[0\], expected 0 \(trunk\) and at least one"):
        encode(replace(scene, global_deformation=without))


def test_the_layers_have_equally_many_channels():
    scene = scene_with(1.0, 1.0)
    planes = tuple({name: np.tile(x, (2, 1, 1)) for name, x in s.items()} for s in scene.local_deformation.planes)
    with pytest.raises(EncodeError, match="layer 2 grid 0: 4 sides and 2 channels, expected 4 and 1"):
        encode(replace(scene, local_deformation=replace(scene.local_deformation, planes=planes)))


def test_inactive_anchors_are_dropped_and_reported():
    scene = make_scene(4, anchors=30, layers=(0,))
    inactive = int((scene.mask[0] == 0).sum())
    data, report = encode_with_report(scene)
    assert 0 < inactive < 30 and len(decode(data).anchor_q) == len(scene.anchor_q) - inactive
    (row,) = [row for row in report.left_out if not row["lossless"]]
    assert row["what"] == f"{inactive} anchors" and row["bytes"] > 0


def test_heads_that_quantise_to_zero_go_even_when_layers_are_asked_for():
    scene = scene_with(global_value={"feature": 1e-4}, weights_step=2.0**-6)
    data = encode(scene, layers=2)
    got = decode(data)
    assert set(got.global_deformation.networks) == {"trunk", *HEADS} - {"feature"}
    assert got.layers == (0, 1, 2) and got.local_deformation is None
    assert encode(got, layers=2) == data


def test_explicit_layers_cut_the_prefix_as_it_is():
    scene = make_scene(4, anchors=30)
    whole = decode(encode(scene, layers=2))
    for highest in (0, 1):
        data, report = encode_with_report(scene, layers=highest)
        got = decode(data)
        assert got.layers == tuple(range(highest + 1))
        assert active_codes(got, -1) == active_codes(scene, highest)
        np.testing.assert_array_equal(got.anchor_q, whole.prefix(highest).anchor_q)
        np.testing.assert_array_equal(got.feature, whole.prefix(highest).feature)
        named = [row["what"] for row in report.left_out]
        assert [f"layer {layer}" for layer in range(highest + 1, 3)] == [n for n in named if n.startswith("layer")]
