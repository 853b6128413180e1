"""The attributes section: both forms give back the symbols; prediction pays where channels depend on each other."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format import attributes as section
from pd4dgs_codec.format.attributes import MAX_WEIGHT, read_attributes, write_attributes
from pd4dgs_codec.format.quantise import MAX_SYMBOL, NO_CLASSES
from pd4dgs_codec.format.stages import PLAIN, STAGED
from pd4dgs_codec.scene import Widths

WIDTHS = Widths()


def correlated(rows: int, seed: int = 0) -> np.ndarray:
    """Features mixed from a few sources, and offsets that are all zero for half of the Gaussians."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(38, 6)) @ rng.normal(size=(6, rows)) * 6 + rng.normal(size=(38, rows))
    alive = rng.random((10, 1, rows)) < 0.5
    offsets = (alive * rng.normal(size=(10, 3, rows)) * 8).reshape(30, rows)
    return np.rint(np.concatenate([mixed, offsets])).astype(np.int32)


def test_dependent_channels_are_predicted_and_come_back():
    attributes = correlated(1500)
    data, rate = write_attributes(attributes, NO_CLASSES, WIDTHS, "best", 5)
    assert data[0] == STAGED
    plain = encode_channels(list(attributes))
    assert len(data) < 0.75 * len(plain.payload)
    assert rate == plain.rate_bits
    np.testing.assert_array_equal(read_attributes(data, WIDTHS, 1500)[1], attributes)


def test_the_rate_model_forbids_prediction():
    data, _ = write_attributes(correlated(800), NO_CLASSES, WIDTHS, "gauss", 5)
    assert data[0] == PLAIN


def test_independent_channels_stay_plain():
    attributes = np.random.default_rng(1).integers(-9, 10, (WIDTHS.channels, 300)).astype(np.int32)
    data, _ = write_attributes(attributes, NO_CLASSES, WIDTHS, "best", 5)
    assert data[0] == PLAIN
    np.testing.assert_array_equal(read_attributes(data, WIDTHS, 300)[1], attributes)


def written_in_stages(attributes, class_count=None, widths=WIDTHS):
    """The section in form 1, even where form 0 is shorter; class_count, if any, instead of the best."""
    choose = section.cheapest_class_count if class_count is None else lambda _: class_count
    with patch.object(section, "cheapest_class_count", choose):
        symbols, past = attributes.astype(np.int64), section.Past()
        block = section._fit_block(symbols, NO_CLASSES, widths)
        return section._write_staged(symbols, NO_CLASSES, block, past, 1).data


@settings(max_examples=10)
@given(st.integers(1, 60), st.integers(0, 1000), st.integers(1, 8), st.sampled_from((1, 50, 1 << 23)))
def test_any_symbols_come_back(rows, seed, class_count, scale):
    """Few channels have the whole scale: fitting priors to wide ones takes time."""
    rng = np.random.default_rng(seed)
    scales = np.where(rng.random((WIDTHS.channels, 1)) < 0.1, scale, min(scale, 3))
    attributes = np.clip(np.rint(rng.standard_t(2, (WIDTHS.channels, rows)) * scales), -MAX_SYMBOL, MAX_SYMBOL)
    attributes = attributes.astype(np.int32)
    attributes[rng.random(WIDTHS.channels) < 0.3] = int(rng.integers(-5, 5))
    for data in (
        written_in_stages(attributes, class_count),
        write_attributes(attributes, NO_CLASSES, WIDTHS, "best", 1)[0],
    ):
        np.testing.assert_array_equal(read_attributes(data, WIDTHS, rows)[1], attributes)


def test_the_largest_symbols_come_back():
    rng, rows = np.random.default_rng(4), 200
    attributes = np.ones((WIDTHS.channels, rows), np.int32)
    wide = [0, 6, 7, 29, 38, 39, 40]
    attributes[wide] = rng.choice([-MAX_SYMBOL, -1, 0, MAX_SYMBOL], (len(wide), rows))
    np.testing.assert_array_equal(read_attributes(written_in_stages(attributes, 3), WIDTHS, rows)[1], attributes)


def test_terms_that_would_break_a_limit_are_left_out():
    """A weight of 40, and one that predicts 2^23 where -2^23 stands."""
    source = np.resize(np.array([1, -1, 0, 2], np.int32), 4200)
    attributes = np.zeros((WIDTHS.channels, 4200), np.int32)
    attributes[0], attributes[1] = source * 100, source * 4000
    attributes[2] = np.where(source > 0, MAX_SYMBOL, -MAX_SYMBOL)
    attributes[3] = attributes[2]
    attributes[3, 0] = -MAX_SYMBOL
    assert abs(attributes[1]).max() > abs(attributes[0]).max() * MAX_WEIGHT >> 10
    np.testing.assert_array_equal(read_attributes(written_in_stages(attributes), WIDTHS, 4200)[1], attributes)


@pytest.mark.parametrize(("priors", "effort", "share"), [("best", 3, 0.97), ("best", 1, 0.9), ("gauss", 3, 0.9)])
def test_step_classes_come_back_and_split_the_channels(priors, effort, share):
    """Symbols shrink with the class: split by it they cost less than as they are, in either form."""
    widths, rng = Widths(5, 2, graded=True), np.random.default_rng(4)
    classes = rng.integers(0, 7, 2000).astype(np.int32)
    attributes = np.rint(rng.normal(size=(widths.channels, 2000)) * 40 / 2.0**classes).astype(np.int32)
    data, rate = write_attributes(attributes, classes, widths, priors, effort)
    found = read_attributes(data, widths, 2000)
    np.testing.assert_array_equal(found[0], classes)
    np.testing.assert_array_equal(found[1], attributes)
    as_they_are, more = write_attributes(attributes, NO_CLASSES, Widths(5, 2), priors, effort)
    assert len(data) < share * len(as_they_are) and rate < 0.9 * more
    if priors == "gauss":
        assert data[0] == PLAIN and 8 * len(data) <= 1.005 * rate + 24 * 7 * (widths.channels + 1)


def test_one_step_class_costs_a_few_bytes():
    attributes = correlated(500)
    alone, rate = write_attributes(attributes, NO_CLASSES, WIDTHS, "best", 3)
    data, graded_rate = write_attributes(attributes, np.full(500, 3, np.int32), replace(WIDTHS, graded=True), "best", 3)
    assert len(data) <= len(alone) + 10 and rate == pytest.approx(graded_rate)


@pytest.mark.parametrize("top, weight", [(9, 1 << 10), (9, MAX_WEIGHT), (1 << 12, 1 << 10), (1 << 18, 1 << 12)])
def test_restored_symbols_are_those_of_integers(top, weight):
    """In binary32 where that is exact, else in binary64."""
    rng, n = np.random.default_rng(top + weight), 50
    residuals = rng.integers(-top, top + 1, (6, n)).astype(np.int32)
    terms = []
    for c in range(1, 6):
        chosen = np.flatnonzero(rng.random(c) < 0.7)
        terms.append(section.Terms(chosen, rng.integers(-weight, weight + 1, len(chosen)) // c))
    expected = residuals.astype(object)
    for c, term in enumerate(terms, start=1):
        sums = sum(
            (int(w) * expected[j] for j, w in zip(term.channels, term.weights, strict=True)), np.zeros(n, object)
        )
        expected[c] = expected[c] + ((sums + 512) >> 10)
    if np.abs(expected).max() > K_MAX:
        with pytest.raises(Malformed, match="a predicted attribute over"):
            section._restore(residuals, terms)
        return
    section._restore(residuals, terms)
    np.testing.assert_array_equal(residuals, expected.astype(np.int64))
