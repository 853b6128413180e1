"""Plane cells that no anchor reads are left out, and no picture changes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from strategies import assert_same_scene, make_scene

from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.scene import DEFAULT_WIDTHS, PLANES, Deformation, Scene, Widths
from pd4dgs_codec.tensors.planes import PREDICTORS, cells_read, fill_plane, residual

SIDES = (6, 5, 7, 5)


def lively_scene(widths: Widths = DEFAULT_WIDTHS) -> Scene:
    """A scene with plane cells that nothing reaches."""
    options = dict(hidden=(12,), channels=8, sides=SIDES, scales=2, width=8, extent=30, widths=widths)
    scene = make_scene(5, anchors=60, kind="gaussian", **options)
    scaling_log = scene.scaling_log.copy()
    scaling_log[:, :3] = -4  # Gaussians stay near their anchors
    field = scene.global_deformation
    ((weight, bias),) = field.networks["position"]
    heads = {**field.networks, "position": ((weight * np.float32(0.05), bias * np.float32(0.05)),)}
    near_one = tuple({name: 1 + np.clip(plane, -0.25, 0.25) for name, plane in s.items()} for s in field.planes)
    masks = tuple(np.maximum(codes, 77) for codes in scene.mask)
    return replace(scene, mask=masks, scaling_log=scaling_log, global_deformation=Deformation(near_one, heads))


@cache
def coded(omit: str) -> Scene:
    """The lively scene, encoded and decoded."""
    return decode(encode(lively_scene(), layers=2, effort=1, omit=omit))


@pytest.mark.parametrize("widths", [Widths(), Widths(graded=True), Widths(viewing=("color",))])
def test_the_planned_scene_is_rounded_to_the_planned_symbols(widths):
    planned = plan(lively_scene(widths), EncodeOptions(layers=2))
    assert len(planned.left_out) == 2
    assert_same_scene(planned.symbols.scene(), plan(planned.scene, EncodeOptions(omit="nothing")).symbols.scene())


def test_no_pixel_changes():
    pytest.importorskip("torch")
    pytest.importorskip("numba")
    from tiny import camera_around

    from pd4dgs_codec.model.model import from_scene
    from pd4dgs_codec.model.picture import render_image

    whole, less = (from_scene(coded(omit)) for omit in ("nothing", "lossless"))
    rng = np.random.default_rng(3)
    seen = 0.0
    for level in (0, 1, 2):
        for _ in range(4):
            camera, t = camera_around(rng), float(rng.random())
            a, b = (render_image(model, level, t, camera) for model in (whole, less))
            np.testing.assert_array_equal(a, b)
            seen += float(np.ptp(a))
    assert seen > 1, "the pictures show something"


def test_nothing_that_matters_goes():
    """Only cells that nothing reaches go, and what is kept stays as given."""
    left_out = plan(lively_scene(), EncodeOptions(layers=2)).left_out
    assert all("cells" in item.what for item in left_out)
    planned, untouched = coded("lossless"), coded("nothing")
    low, high = untouched.info.box
    unit, free = np.clip((untouched.anchor - low) / (high - low), 0, 1), 0
    for layer in (1, 2):
        both = untouched.deformation(layer).planes, planned.deformation(layer).planes
        for given, got in zip(*both, strict=True):
            for name, a, b in PLANES:
                read = cells_read(given[name].shape, unit[:, a], unit[:, b] if b < 3 else None)
                assert np.array_equal(given[name][:, read], got[name][:, read])
                free += int((~read).sum())
    assert free > 0
    without = [replace(s, global_deformation=None, local_deformation=None) for s in (planned, untouched)]
    assert_same_scene(*without)


def test_a_filled_plane_keeps_what_is_given_and_costs_less():
    rng = np.random.default_rng(2)
    plane = rng.integers(-9, 10, (3, 12, 10), dtype=np.int32)
    given = rng.random((12, 10)) < 0.5
    filled, saved = fill_plane(plane, given)
    assert saved > 0
    assert np.array_equal(filled[:, given], plane[:, given])
    assert np.array_equal(fill_plane(filled, given)[0], filled)
    zeros = [(residual(p, filled)[:, ~given] == 0).all() for p in PREDICTORS]
    assert any(zeros)
    assert np.array_equal(fill_plane(plane, np.ones_like(given))[0], plane)
    assert not fill_plane(plane, np.zeros_like(given))[0].any()
