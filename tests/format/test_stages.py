"""Stages: magnitudes and classes are those of clause 8.7, on integers; what is put in stages comes back."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.entropy.varint import ByteReader
from pd4dgs_codec.format.stages import (
    CLASS_COUNTS,
    MAX_CLASSES,
    Activity,
    Places,
    activity_classes,
    cheapest_class_count,
    coded_stages,
    parts_of,
    read_stages,
)


def relative_magnitude(residuals):
    activity = Activity(residuals.shape[1])
    activity.add(residuals)
    return activity.now


def test_the_check_values_of_the_specification():
    activity = np.array([5, 1, 5, 9, 1, 7])
    assert activity_classes(activity, 3).tolist() == [1, 0, 1, 2, 0, 2]
    assert relative_magnitude(np.array([[3, -1, 0, 4]])).tolist() == [341, 113, 0, 455]


@given(st.lists(st.integers(0, 2**40) | st.integers(0, 3), min_size=1, max_size=30), st.integers(1, MAX_CLASSES))
def test_the_class_of_a_place_is_the_number_of_bounds_it_reaches(activity, count):
    ascending = sorted(activity)
    bounds = [ascending[i * len(activity) // count] for i in range(1, count)]
    classes = activity_classes(np.array(activity), count)
    assert classes.tolist() == [sum(bound <= a for bound in bounds) for a in activity]
    places, channels = Places.by(classes, count), np.arange(2 * len(activity)).reshape(2, -1)
    parts, back = list(places.parts(channels)), np.zeros_like(channels)
    assert [part.tolist() for part in parts] == [c[classes == k].tolist() for c in channels for k in range(count)]
    places.put(np.concatenate(parts), back)
    np.testing.assert_array_equal(back, channels)


def test_different_activities_make_classes_of_about_equal_size():
    places = Places.by(activity_classes(np.random.default_rng(0).permutation(100), 8), 8)
    assert set(places.sizes) <= {12, 13}


@given(st.lists(st.sampled_from((-K_MAX, -1, 0, 1, 7, K_MAX)), min_size=1, max_size=40), st.integers(0, 3))
def test_relative_magnitudes_at_the_limits(symbols, channels):
    n, total = len(symbols), 1 + sum(abs(k) for k in symbols)
    found = relative_magnitude(np.array([symbols] * channels, np.int64).reshape(channels, n))
    assert found.tolist() == [channels * (abs(k) * 256 * n // total) for k in symbols]


def test_relative_magnitudes_of_many_places_are_exact():
    """In binary64 the first quotient would round up to 939180039."""
    residuals = np.zeros((1, 1 << 22), np.int64)
    residuals[0, :2] = K_MAX - 1, -2403768
    total = K_MAX + 2403768
    assert ((K_MAX - 1) << 30) // total == 939180038
    assert relative_magnitude(residuals)[:3].tolist() == [939180038, (2403768 << 30) // total, 0]


def test_classes_are_chosen_where_they_pay():
    rng = np.random.default_rng(1)
    activity = rng.integers(0, 1000, 2000)
    alike = np.rint(rng.normal(size=(3, 2000)) * 5).astype(np.int64)
    louder = np.rint(rng.normal(size=(3, 2000)) * (1 + activity / 20)).astype(np.int64)
    assert cheapest_class_count([(alike, activity)]) == 1
    assert cheapest_class_count([(louder, activity), (louder, activity)]) in CLASS_COUNTS[1:]


def halves(target):
    """Two stages: the places of `target` that are even, then the others, by whether the one before is 0."""
    channels = target.reshape(-1, 2).T
    yield [(channels[:1], Places.whole(channels.shape[1]))]
    yield [(channels[1:], Places.by(channels[0] != 0, 2))]


def in_halves(symbols):
    return coded_stages(bytearray(), map(parts_of, halves(symbols)), 1)


@given(st.lists(st.integers(-2, 2), max_size=20).map(lambda v: v + v))
@settings(max_examples=30)
def test_what_is_put_in_stages_comes_back(values):
    symbols = np.array(values, np.int64)
    found = np.zeros_like(symbols)
    read_stages(ByteReader(in_halves(symbols)), 2, halves(found))
    assert found.tolist() == values
