"""The error bounds that the encoder declares in the header and verifies on every write: per step, and kept."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import make_scene

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import deformation, encoder, quantise
from pd4dgs_codec.format.check import ErrorBound
from pd4dgs_codec.format.container import read_preamble
from pd4dgs_codec.format.encoder import encode, encode_with_report
from pd4dgs_codec.format.header import TENSOR_KINDS, unpack_header
from pd4dgs_codec.format.info import info


def scene_off_the_grid():
    """Values between the multiples of their steps, halves among them."""
    scene = make_scene(2, anchors=30)
    rng = np.random.default_rng(0)
    given = scene.attributes.items()
    moved = {name: values + rng.uniform(-4, 4, values.shape).astype(np.float32) for name, values in given}
    moved["feature"][:, 0] = 2.5 * scene.steps.feature
    return replace(scene, **moved)


def test_every_step_in_use_is_reported_with_an_error_within_its_bound():
    scene = scene_off_the_grid()
    _, report = encode_with_report(scene, layers=2, effort=1)
    assert [row.what for row in report.errors] == list(TENSOR_KINDS)
    for row in report.errors:
        step = getattr(scene.steps, row.what)
        assert row.step == step and 0.5 * step <= row.bound <= 0.51 * step
        assert 0 <= row.largest <= row.bound
    largest = {row.what: row.largest for row in report.errors}
    assert largest["feature"] == 0.5 * scene.steps.feature  # a tie is as far off as a value can be
    assert largest["weights_local"] == 0  # those lay on the grid


def test_only_what_a_file_holds_is_reported():
    _, report = encode_with_report(make_scene(2, anchors=5), layers=0, effort=1)
    assert [row.what for row in report.errors] == ["feature", "scaling_log", "offset", "weights_scaffold"]
    assert encode_with_report(make_scene(2, anchors=5), effort=1, verify=False)[1].errors == []


def declared(data):
    return unpack_header(read_preamble(data).header).error_bounds


@pytest.mark.parametrize("options", [{}, {"mode": "lzma"}, {"layers": 0}])
def test_the_header_declares_what_is_verified(options):
    options = {"layers": 2, "effort": 1, **options}
    data, report = encode_with_report(scene_off_the_grid(), **options)
    assert declared(data) == {row.what: row.bound for row in report.errors}
    assert all(bound == np.float32(bound) for bound in declared(data).values())
    assert encode(scene_off_the_grid(), **options, verify=False) == data
    assert declared(data) == info(data)["error_bounds"]


def test_bounds_allow_for_the_rounding_of_large_values():
    """Near 2^23 steps a decoded value is itself rounded, by nearly a third of a step where the step is .1."""
    step = float(np.float32(0.1))
    scene = make_scene(2, anchors=5, layers=(0,))
    feature = np.zeros_like(scene.feature)
    feature[0, :3] = 2**23 * step, 2.5 * step, -0.3 * step
    scene = replace(scene, steps=replace(scene.steps, feature=step), feature=feature)
    data, report = encode_with_report(scene, effort=1)
    assert report.errors[0].largest <= declared(data)["feature"]
    assert declared(data)["feature"] == pytest.approx(step / 2 + 0.03125, rel=1e-6)


def test_an_error_above_the_declared_bound_is_refused(monkeypatch):
    """The bound is read back from the bytes written, not taken from where it was computed."""
    low = {name: 0.4 * step for name, step in vars(scene_off_the_grid().steps).items()}
    low = {name: float(np.float32(low[name])) for name in TENSOR_KINDS}
    monkeypatch.setattr(encoder, "rounding_bounds", lambda *args: low)
    with pytest.raises(EncodeError, match=r"verification: feature: .* expected an error of at most 0.025"):
        encode(scene_off_the_grid(), layers=2, effort=1)
    assert declared(encode(scene_off_the_grid(), layers=2, effort=1, verify=False)) == low


@pytest.mark.parametrize("module, what", [(quantise, "feature"), (deformation, "weights_scaffold")])
def test_a_quantiser_that_rounds_wrongly_is_found(monkeypatch, module, what):
    """The file decodes to the symbols that were meant: only the given values show that these are not the nearest."""
    right = module.quantise
    monkeypatch.setattr(module, "quantise", lambda x, *rest: right(x, *rest) + (x.size > 20))
    with pytest.raises(EncodeError, match=f"verification: {what}: .*expected an error of at most "):
        encode_with_report(scene_off_the_grid(), layers=2, effort=1)


def test_an_empty_scene_has_bounds_too():
    _, report = encode_with_report(make_scene(0, anchors=0), layers=0, effort=1)
    assert report.errors[0] == ErrorBound("feature", 0.0625, report.errors[0].bound, 0.0)
