"""The ends of what a file may hold: very many anchors, steps near the largest and the least binary32."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Widths

MANY = 300_000


def many(widths):
    """A scene of layer 0 with MANY anchors, which fill a box."""
    rng, base = np.random.default_rng(0), make_scene(5, layers=(0,), anchors=1, widths=widths, hidden=())
    index = np.arange(MANY)
    cells = np.stack([index % 97, index // 97 % 89, index // (97 * 89)], axis=1).astype(np.int32)
    rows = rng.permutation(MANY)
    values = {
        name: rng.integers(-3, 4, (MANY, *shape)).astype(np.float32) * np.float32(base.steps.attributes[name])
        for name, shape in widths.attributes.items()
    }
    mask = (rng.integers(3, 256, MANY).astype(np.uint8),)
    return replace(base, rows=(MANY,), anchor_q=cells[rows], mask=mask, **values)


@pytest.mark.parametrize("slices", [0, pytest.param(200_000, marks=pytest.mark.slow)])
def test_three_hundred_thousand_anchors(slices):
    scene = many(Widths(1, 1))
    got = decode(encode(scene, layers=0, effort=1, slices=slices, omit="nothing", verify=False))
    assert got.rows == (MANY,)
    order = morton_order(scene.anchor_q)
    for name in ("anchor_q", "feature", "scaling_log", "offset"):
        np.testing.assert_array_equal(getattr(got, name), getattr(scene, name)[order])
    np.testing.assert_array_equal(got.mask[0], scene.mask[0][order])


@pytest.mark.parametrize("step", [1e30, 3.1e31, 2.0**-126, 1e-37])
def test_values_are_rounded_to_the_nearest_at_the_ends_of_binary32(step):
    """In exact arithmetic, value by value: within half a step and half a unit in the last place."""
    step = float(np.float32(step))
    scene = make_scene(6, anchors=60, with_camera=False)
    scene = replace(scene, steps=replace(scene.steps, feature=step, scaling_log=step, offset=step))
    rng = np.random.default_rng(1)

    def spread(x):
        return (rng.uniform(-9, 9, x.shape) * step).astype(np.float32)

    scene = replace(scene, **{name: spread(value) for name, value in scene.attributes.items()})
    got = decode(encode(scene, layers=2, effort=1, omit="nothing"))
    places = {tuple(q): i for i, q in enumerate(scene.anchor_q.tolist())}
    rows = [places[tuple(q)] for q in got.anchor_q.tolist()]
    assert len(rows) > 20
    for name, given in scene.attributes.items():
        found = getattr(got, name)
        bounds = (Fraction(step) + Fraction(float(unit)) for unit in np.spacing(np.abs(found)).ravel())
        rows_of = zip(given[rows].ravel().tolist(), found.ravel().tolist(), bounds, strict=True)
        assert all(2 * abs(Fraction(a) - Fraction(b)) <= bound for a, b, bound in rows_of)
