"""The errors that the encoder measures on every write: per step, and within the bound of rounding."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.scene import Widths
from pd4dgs_codec.tensors import quantise, tables


def scene_off_the_grid(graded=False):
    """Values between the multiples of their steps, halves among them."""
    scene = make_scene(2, anchors=30, widths=Widths(graded=graded))
    rng = np.random.default_rng(0)
    given = scene.attributes.items()
    moved = {name: values + rng.uniform(-4, 4, values.shape).astype(np.float32) for name, values in given}
    moved["feature"][:, 0] = 2.5 * scene.steps.feature
    return replace(scene, **moved)


@pytest.mark.parametrize("graded", [False, True])
def test_every_step_in_use_is_reported_with_an_error_within_its_bound(graded):
    scene = scene_off_the_grid(graded)
    _, report = encode_with_report(scene, layers=2, effort=1)
    assert {row.what for row in report.errors} == set(vars(scene.steps))
    for row in report.errors:
        step = getattr(scene.steps, row.what)
        assert row.step == step and 0.5 * step <= row.bound <= 0.51 * step
        assert 0 <= row.largest <= row.bound
    largest = {row.what: row.largest for row in report.errors}
    assert graded or largest["feature"] == 0.5 * scene.steps.feature  # a tie is as far off as a value can be
    assert largest["weights_local"] == 0  # those lay on the grid


def test_only_what_a_file_holds_is_reported():
    _, report = encode_with_report(make_scene(2, anchors=5), layers=0, effort=1)
    assert [row.what for row in report.errors] == ["feature", "scaling_log", "offset", "weights_scaffold"]
    assert encode_with_report(make_scene(2, anchors=5), effort=1, verify=False)[1].errors == []


@pytest.mark.parametrize("module, what", [(quantise, "feature"), (tables, "weights_scaffold")])
def test_a_quantiser_that_rounds_wrongly_is_found(monkeypatch, module, what):
    """The file decodes to the symbols that were meant: only the given values show that these are not the nearest."""
    right = module.quantise
    monkeypatch.setattr(module, "quantise", lambda x, *rest: right(x, *rest) + (x.size > 20))
    with pytest.raises(EncodeError, match=f"verification: {what}: .*expected an error of at most "):
        encode_with_report(scene_off_the_grid(), layers=2, effort=1)
