"""Classes of places: magnitudes and classes are those of clause 8.7, on integers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.format.classes import CLASSES, Places, activity_classes, relative_magnitude


def test_the_check_values_of_the_specification():
    assert relative_magnitude(np.array([[3, -1, 0, 4]])).tolist() == [341, 113, 0, 455]
    assert activity_classes(np.array([5, 1, 5, 9, 1, 7])).tolist() == [5, 2, 5, 7, 2, 6]


@given(st.lists(st.integers(0, 2**40) | st.integers(0, 3), min_size=1, max_size=30))
def test_the_class_of_a_place_is_the_number_of_bounds_it_reaches(activity):
    ascending = sorted(activity)
    bounds = [ascending[i * len(activity) // CLASSES] for i in range(1, CLASSES)]
    classes = activity_classes(np.array(activity))
    assert classes.tolist() == [sum(bound <= a for bound in bounds) for a in activity]
    places, channels = Places.by(classes, CLASSES), np.arange(2 * len(activity)).reshape(2, -1)
    parts, back = list(places.parts(channels)), np.zeros_like(channels)
    assert [part.tolist() for part in parts] == [c[classes == k].tolist() for c in channels for k in range(CLASSES)]
    places.put(np.concatenate(parts), back)
    np.testing.assert_array_equal(back, channels)


def test_different_activities_make_classes_of_about_equal_size():
    places = Places.by(activity_classes(np.random.default_rng(0).permutation(100)), CLASSES)
    assert set(places.sizes) <= {12, 13}


@given(st.lists(st.sampled_from((-K_MAX, -1, 0, 1, 7, K_MAX)), min_size=1, max_size=40), st.integers(0, 3))
def test_relative_magnitudes_at_the_limits(symbols, channels):
    n, total = len(symbols), 1 + sum(abs(k) for k in symbols)
    found = relative_magnitude(np.array([symbols] * channels, np.int64).reshape(channels, n))
    assert found.tolist() == [channels * (abs(k) * 256 * n // total) for k in symbols]


def test_relative_magnitudes_of_many_places_are_exact():
    """In binary64 the first quotient would round up to 939180039."""
    residuals = np.zeros((1, 1 << 22), np.int64)
    residuals[0, :2] = (1 << 24) - 2, -2403768
    total = (1 << 24) - 1 + 2403768
    assert (((1 << 24) - 2) << 30) // total == 939180038
    assert relative_magnitude(residuals)[:3].tolist() == [939180038, (2403768 << 30) // total, 0]
