"""The error bounds that the encoder verifies on every write: per step, in its report, and kept."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.attributes import table
from pd4dgs_codec.codec import bounds, symbols
from pd4dgs_codec.codec.encoder import encode_with_report
from pd4dgs_codec.codec.header import TENSOR_CLASSES
from pd4dgs_codec.errors import EncodeError


def scene_off_the_grid():
    """Values between the multiples of their steps, halves among them."""
    scene = make_scene(2, anchors=30)
    rng = np.random.default_rng(0)
    moved = {
        name: getattr(scene, name) + rng.uniform(-4, 4, getattr(scene, name).shape).astype(np.float32)
        for name in ("feature", "scaling_log", "offset")
    }
    moved["feature"][:, 0] = 2.5 * scene.steps.feature
    return replace(scene, **moved)


def test_every_step_in_use_is_reported_with_an_error_within_its_bound():
    scene = scene_off_the_grid()
    _, report = encode_with_report(scene, layers=2, effort=1)
    assert [row.what for row in report.errors] == list(TENSOR_CLASSES)
    for row in report.errors:
        step = getattr(scene.steps, row.what)
        assert row.step == step and 0.5 * step <= row.bound <= 0.51 * step
        assert 0 <= row.largest <= row.bound
    largest = {row.what: row.largest for row in report.errors}
    assert largest["feature"] == 0.5 * scene.steps.feature  # a tie is as far off as a value can be
    assert largest["weights_local"] == 0  # those lay on the grid


def test_float32_deformations_are_exact():
    scene = make_scene(2, anchors=5)
    _, report = encode_with_report(scene, layers=2, effort=1, deformation="float32")
    rows = {row.what: row for row in report.errors}
    assert (rows["planes_local"].step, rows["planes_local"].bound, rows["planes_local"].largest) == (0, 0, 0)
    assert rows["weights_scaffold"].step == scene.steps.weights_scaffold


def test_only_what_a_file_holds_is_reported():
    _, report = encode_with_report(make_scene(2, anchors=5), layers=0, effort=1)
    assert [row.what for row in report.errors] == ["feature", "scaling_log", "offset", "weights_scaffold"]
    assert encode_with_report(make_scene(2, anchors=5), effort=1, verify=False)[1].errors == []


@pytest.mark.parametrize("module, what", [(table, "feature"), (symbols, "weights_scaffold")])
def test_a_quantiser_that_rounds_wrongly_is_found(monkeypatch, module, what):
    """The file decodes to the symbols that were meant: only the given values show that these are not the nearest."""
    right = module.quantise
    monkeypatch.setattr(module, "quantise", lambda x, step, name: right(x, step, name) + (x.size > 20))
    with pytest.raises(EncodeError, match=f"verification: {what}: .*expected at most .* between them"):
        encode_with_report(scene_off_the_grid(), layers=2, effort=1)


def test_an_empty_scene_has_bounds_too():
    _, report = encode_with_report(make_scene(0, anchors=0), layers=0, effort=1)
    assert report.errors[0] == bounds.ErrorBound("feature", 0.0625, report.errors[0].bound, 0.0)
