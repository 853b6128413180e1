"""Sizes met with the least loss: the search on functions whose best is known, then on a scene's layers."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from strategies import make_scene

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode, encode_with_report
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.quality import target
from pd4dgs_codec.quality.target import SLACK, Fitter, Unreachable, convex_hull, least_loss

GRID = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)


def rate_distortion(counts, weights):
    """(size, loss) of knobs that are log2 of a step: a bit per scalar and octave, squared errors that grow by 4."""

    def size(setting):
        return round(sum(n * (6 - setting[k]) for k, n in counts.items()) / 8)

    def loss(setting):
        return sum(weights[k] * n * 4 ** setting[k] for k, n in counts.items())

    return size, loss


def test_a_layer_that_loses_all_effect_ends_the_search():
    """Its estimated size is then 0."""

    def final_size(setting):
        return 200 if setting["a"] == 0 else 60 if setting["a"] < 2 else 40

    found = least_loss({"a": (0.0, 1.0, 2.0)}, lambda s: 100 * (s["a"] < 0.5), lambda s: s["a"], final_size, 50)
    assert found == {"a": 2.0}


def test_the_search_comes_close_to_the_best_of_all_settings():
    counts, weights = {"a": 40_000, "b": 40_000, "c": 8_000}, {"a": 1.0, "b": 16.0, "c": 0.1}
    size, loss = rate_distortion(counts, weights)
    most = 52_000
    found = least_loss({k: GRID for k in counts}, size, loss, size, most)
    # equal slopes: weight * 4^octave is the same for every knob inside its range
    fine = np.linspace(0, 4, 161)
    best = min(
        loss(setting)
        for a in fine
        for c in fine[::8]
        if size(setting := {"a": a, "b": max(0.0, a - 2), "c": c}) <= most
    )
    assert (1 - SLACK) * most <= size(found) <= most
    assert loss(found) <= 1.12 * best
    even = next(x for x in fine if size(dict.fromkeys(counts, x)) <= most)
    assert loss(found) < 0.7 * loss(dict.fromkeys(counts, even)), "better than one factor for all"


def test_a_size_that_is_met_already_changes_nothing_and_one_out_of_reach_is_named():
    size, loss = rate_distortion({"a": 8_000}, {"a": 1.0})
    assert least_loss({"a": GRID}, size, loss, size, 6_000) == {"a": 0.0}
    with pytest.raises(Unreachable) as error:
        least_loss({"a": GRID}, size, loss, size, 1_999)
    assert error.value.smallest == 2_000


def test_a_size_out_of_reach_is_refused_after_the_given_and_the_smallest_setting():
    size, loss = rate_distortion({"a": 8_000, "b": 8_000}, {"a": 1.0, "b": 1.0})
    tried = []

    def final(setting):
        tried.append(tuple(setting.values()))
        return size(setting)

    never = Mock(side_effect=AssertionError("a setting was measured"))
    with pytest.raises(Unreachable):
        least_loss({"a": GRID, "b": GRID}, never, never, final, 3_999)
    assert {*tried} == {(0.0, 0.0), (4.0, 4.0)}
    assert size(least_loss({"a": GRID, "b": GRID}, size, loss, size, 4_000)) == 4_000, "one byte more is reached"


def test_the_estimate_may_be_off_by_a_factor_that_drifts():
    size, loss = rate_distortion({"a": 9_000, "b": 80_000}, {"a": 1.0, "b": 1.0})

    def final(setting):
        return round(size(setting) * (0.8 - 0.03 * setting["b"]))

    for most in range(20_000, 50_000, 10_000):
        found = least_loss({"a": GRID, "b": GRID}, size, loss, final, most)
        assert (1 - SLACK) * most <= final(found) <= most


@given(st.lists(st.tuples(st.floats(-10, 100), st.floats(-10, 100)), max_size=8))
@example([(0.0, -1.0)])
def test_hulls_are_convex_and_below_all_points(points):
    given_points = [(0.0, 0.0, 0.0), *((float(i), saved, lost) for i, (saved, lost) in enumerate(points, 1))]
    vertices = convex_hull(given_points)
    saved, lost = np.array([v[1] for v in vertices]), np.array([v[2] for v in vertices])
    assert vertices[0] == given_points[0] and (np.diff(saved) > 0).all()
    for _, x, y in given_points:
        if 0 < x <= saved[-1]:  # what saves nothing is no move, whatever it does to the loss
            assert y >= np.interp(x, saved, lost) - 1e-6 * (1 + abs(y))


# -- scenes ------------------------------------------------------------------------------------------------------------


#: Fitting the priors of mode ans takes ten times as long.
FAST = {"mode": "lzma", "effort": 1}


@pytest.fixture(scope="module")
def scene():
    """Layer 0 with 60 anchors, their features between the steps, layer 1 with 10, layer 2 with planes alone."""
    made = make_scene(3, anchors=70, kind="gaussian", sides=(6, 6, 6, 5), channels=4)
    rng = np.random.default_rng(1)
    n = len(made.anchor_q)
    masks = np.full((3, n), 255, np.uint8)
    masks[0, rng.permutation(n)[:10]] = 0
    feature = rng.normal(0, 1, made.feature.shape).astype(np.float32)
    return plan(replace(made, mask=tuple(masks), feature=feature)).scene


@pytest.fixture(autouse=True)
def _few_values(monkeypatch):
    """Each value costs an encode: a few do here."""
    monkeypatch.setattr(target, "OCTAVES", (0.0, 2.0, 4.0))
    monkeypatch.setattr(target, "SHARES", (0.0, 0.5))


def error(scene, level):
    """It rises with the place of an anchor in the order of the voxels."""
    return np.lexsort(scene.anchor_q.T).argsort().astype(np.float64)


def coarseness(given_scene):
    """A loss without pictures: logarithms of the steps, and the error of anchors gone from layer 0 or from all."""

    def loss(decoded):
        steps = sum(np.log2(getattr(decoded.steps, k) / v) for k, v in vars(given_scene.steps).items())
        return float(steps) + 0.1 * (given_scene.rows[0] - decoded.rows[0]) + (given_scene.rows[-1] - decoded.rows[-1])

    return loss


def added(data):
    """Bytes that each layer adds to a file."""
    ends = {row["layer"]: row["end"] for row in info(data)["layers"]}
    return {layer: end - ends.get(layer - 1, 0) for layer, end in ends.items()}


def test_layers_meet_their_targets_and_the_loss_grows_as_they_shrink(scene):
    loss, whole, losses = coarseness(scene), added(encode(scene, **FAST)), []
    for share in (1.01, 0.95, 0.8):
        targets = {layer: round(share * whole[layer]) for layer in (0, 2)}
        fitted, left_out, fits = Fitter(scene, targets, loss, error, EncodeOptions(**FAST)).fit()
        data, report = encode_with_report(fitted, **FAST, left_out=left_out)
        whole_file = encode(fitted, **FAST, omit="nothing")  # at coarser steps more may be left out
        assert len(data) <= len(whole_file) + 4  # cells get values by an estimate of their bits
        sizes = added(whole_file)
        for row in fits:
            assert sizes[row.layer] <= row.bytes <= sizes[row.layer] + 16 and row.bytes <= row.target
            assert share > 1 or row.bytes >= (1 - SLACK) * row.target
            assert (not row.moved and set(row.factors.values()) == {1}) == (share > 1)
        losses.append(loss(decode(data)))
    assert losses[0] == 0 < losses[1] < losses[2]


def test_anchors_of_least_error_move_to_the_next_layer_and_out_of_the_highest(scene, monkeypatch):
    monkeypatch.setattr(target, "OCTAVES", (0.0,))
    targets = {0: round(0.8 * added(encode(scene, **FAST))[0])}
    fitted, left_out, (row,) = Fitter(scene, targets, lambda decoded: 0.0, error, EncodeOptions(**FAST)).fit()
    moved, own = fitted.mask[0] == 0, np.arange(scene.rows[-1]) < scene.rows[0]
    assert row.moved == (moved & own).sum() > 0 and row.to_layer == 1 and not left_out
    assert error(scene, 0)[moved & own].max() == row.omission_error < error(scene, 0)[~moved & own].min()
    assert (fitted.mask[1] > 0).all(), "they are shown from there on"

    alone = plan(scene, EncodeOptions(layers=0)).scene
    fitted, left_out, (row,) = Fitter(alone, targets, lambda decoded: 0.0, error, EncodeOptions(**FAST)).fit()
    assert row.to_layer is None and row.moved == len(alone.anchor_q) - len(fitted.anchor_q) > 0
    report = encode_with_report(fitted, **FAST, left_out=left_out)[1]
    assert [told["what"] for told in report.left_out] == [f"{row.moved} anchors"]
    assert "target size" in report.left_out[0]["why"]


@pytest.mark.parametrize("earlier", [{}, {0: 4000}])
def test_a_target_out_of_reach_says_before_any_search_what_could_be_reached(scene, earlier):
    never = Mock(side_effect=AssertionError("a loss was measured"))
    says = r"layer 2 takes at least [\d,]+ bytes \(steps up to x16.*expected at most 100$"
    with pytest.raises(EncodeError, match=says):
        Fitter(scene, earlier | {2: 100}, never, never, EncodeOptions(**FAST)).fit()


def test_the_quick_bound_is_below_the_smallest_size_and_close(scene):
    for layer in (0, 1, 2, None):
        fitted = target._Layer(Fitter(scene, {}, Mock(), error, EncodeOptions(**FAST)), scene, layer)
        smallest = fitted.final_size(fitted.smallest)
        assert 0.75 * smallest <= fitted.least_size <= 0.95 * smallest, layer


def test_a_file_meets_its_target_in_all_layers(scene):
    loss, whole = coarseness(scene), len(encode(scene, **FAST))
    most = round(0.7 * whole)
    fitted, left_out, (row,) = Fitter(scene, {None: most}, loss, error, EncodeOptions(**FAST)).fit()
    data = encode(fitted, **FAST, omit="nothing")
    assert (1 - SLACK) * most - 16 <= len(data) <= row.bytes <= most
    assert (row.layer, row.to_layer) == (None, None) and set(row.factors) == set(vars(scene.steps))
    assert bool(row.moved) == bool(left_out) and row.moved == scene.rows[-1] - fitted.rows[-1]
    with pytest.raises(EncodeError, match=r"the file takes at least [\d,]+ bytes .*expected at most 500$"):
        Fitter(scene, {None: 500}, Mock(), Mock(), EncodeOptions(**FAST)).fit()


def test_a_layer_that_is_not_there_meets_any_target(scene):
    alone = plan(scene, EncodeOptions(layers=0)).scene
    fitted, left_out, (row,) = Fitter(alone, {2: 1}, coarseness(alone), error, EncodeOptions(**FAST)).fit()
    assert fitted is alone and not left_out and (row.bytes, row.moved, row.factors) == (0, 0, {})


def test_measurements_are_kept_for_another_growth(scene):
    loss, whole = Mock(wraps=coarseness(scene)), added(encode(scene, **FAST))
    targets = {layer: round(0.9 * whole[layer]) for layer in (0, 1)}
    fitters = [Fitter(scene, targets, loss, error, EncodeOptions(**FAST)) for _ in range(2)]
    given = fitters[0].fit()[2]
    for fitter in fitters:
        fitter.growth[1] = 1.03
    grown, once = fitters[0].fit()[2], loss.call_count
    assert given[0] == grown[0] and given[1] != grown[1]
    assert fitters[1].fit()[2] == grown
    assert loss.call_count == 2 * once
