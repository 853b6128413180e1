"""The attributes section: symbols and step classes come back, and step classes split the channels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.format.payload import read_attributes, write_attributes
from pd4dgs_codec.format.quantise import MAX_SYMBOL, NO_CLASSES
from pd4dgs_codec.scene import Widths

WIDTHS = Widths()


@settings(max_examples=10)
@given(st.integers(1, 60), st.integers(0, 1000), st.booleans(), st.sampled_from((1, 50, MAX_SYMBOL)))
def test_any_symbols_come_back(rows, seed, graded, scale):
    """Few channels have the whole scale: fitting priors to wide ones takes time."""
    rng, widths = np.random.default_rng(seed), Widths(graded=graded)
    scales = np.where(rng.random((widths.channels, 1)) < 0.1, scale, min(scale, 3))
    attributes = np.clip(np.rint(rng.standard_t(2, (widths.channels, rows)) * scales), -MAX_SYMBOL, MAX_SYMBOL)
    attributes = attributes.astype(np.int32)
    attributes[rng.random(widths.channels) < 0.3] = int(rng.integers(-5, 5))
    classes = rng.integers(0, 7, rows).astype(np.int32) if graded else NO_CLASSES
    data, _ = write_attributes(attributes, classes, "best", 1, [])
    found = read_attributes(data, widths, rows)
    np.testing.assert_array_equal(found[0], classes)
    np.testing.assert_array_equal(found[1], attributes)


@pytest.mark.parametrize(("priors", "effort"), [("best", 3), ("best", 1), ("gauss", 3)])
def test_step_classes_come_back_and_split_the_channels(priors, effort):
    """Symbols shrink with the class: split by it they cost less than as they are."""
    widths, rng = Widths(5, 2, graded=True), np.random.default_rng(4)
    classes = rng.integers(0, 7, 2000).astype(np.int32)
    attributes = np.rint(rng.normal(size=(widths.channels, 2000)) * 40 / 2.0**classes).astype(np.int32)
    data, rate = write_attributes(attributes, classes, priors, effort, [])
    found = read_attributes(data, widths, 2000)
    np.testing.assert_array_equal(found[0], classes)
    np.testing.assert_array_equal(found[1], attributes)
    as_they_are, more = write_attributes(attributes, NO_CLASSES, priors, effort, [])
    assert len(data) < 0.9 * len(as_they_are) and rate < 0.9 * more
    if priors == "gauss":
        assert 8 * len(data) <= 1.005 * rate + 24 * 7 * (widths.channels + 1)


def test_one_step_class_costs_a_few_bytes():
    attributes = np.random.default_rng(1).integers(-9, 10, (WIDTHS.channels, 500)).astype(np.int32)
    alone, rate = write_attributes(attributes, NO_CLASSES, "best", 3, [])
    data, graded_rate = write_attributes(attributes, np.full(500, 3, np.int32), "best", 3, [])
    assert len(data) <= len(alone) + 10 and rate == pytest.approx(graded_rate)


def test_a_later_slice_refers_to_the_priors_of_the_first():
    attributes = np.rint(np.random.default_rng(2).normal(size=(WIDTHS.channels, 400)) * 5).astype(np.int32)
    known, defined = [], []
    first, _ = write_attributes(attributes[:, :200], NO_CLASSES, "best", 3, known)
    second, _ = write_attributes(attributes[:, 200:], NO_CLASSES, "best", 3, known)
    alone, _ = write_attributes(attributes[:, 200:], NO_CLASSES, "best", 3, [])
    assert len(second) < len(alone)
    parts = [read_attributes(data, WIDTHS, 200, defined)[1] for data in (first, second)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), attributes)
