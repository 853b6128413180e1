"""pack without pictures is encode; options are checked once, and scaled steps are scaled once."""

import pytest
from strategies import make_scene

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.options import CHOICES, EncodeOptions
from pd4dgs_codec.quality.packing import pack

FAST = EncodeOptions(mode="lzma", effort=1)


def test_without_pictures_it_is_the_encoder():
    scene = make_scene(3, anchors=30)
    packed = pack(scene, FAST)
    assert packed.data == encode(scene, FAST) and packed.target is None
    ends = {row["layer"]: row["end"] for row in info(packed.data)["layers"]}
    added = packed.report.added_bytes()
    assert {layer: sum(added[lower] for lower in added if lower <= layer) for layer in added} == ends
    for row in packed.json()["layers"]:
        assert row["ratio"] == (row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None)


def test_steps_are_scaled_once():
    scene = make_scene(3, anchors=30)
    packed = pack(scene, EncodeOptions(mode="lzma", effort=1, step_scale=2.0))
    assert packed.data == encode(scene, FAST, step_scale=2.0) == encode(packed.scene, FAST)
    assert packed.scene.steps == scene.steps.scaled(2.0)


@pytest.mark.parametrize("name", CHOICES)
def test_a_choice_that_is_none_is_named(name):
    with pytest.raises(EncodeError, match=rf"^{name} 'other', expected one of \["):
        EncodeOptions(**{name: "other"})


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf"), float("nan")])
def test_a_scale_that_is_none_is_named(scale):
    with pytest.raises(EncodeError, match="step_scale .*, expected a positive number"):
        EncodeOptions(step_scale=scale)
