"""Planes: predictors are undone exactly and follow their definition; residuals come back, and classes pay where samples
are large in some places."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import assert_same_symbols, busy, memory_below

from pd4dgs_codec.entropy.channels import ChannelReader, ChannelWriter, Places
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.tensors.planes import (
    CLASSES,
    MEDIAN,
    UP,
    activity_classes,
    choose_predictor,
    read_planes,
    relative_magnitude,
    residual,
    restore,
    write_planes,
)
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL

shapes = st.tuples(st.integers(1, 3), st.integers(1, 9), st.integers(1, 9))


def random_plane(shape, seed, top):
    return np.random.default_rng(seed).integers(-top, top + 1, shape, dtype=np.int32)


def scalar_prediction(predictor, k, i, j):
    """The registry's definition for one sample, in Python integers."""
    w = int(k[i, j - 1]) if j else None
    n = int(k[i - 1, j]) if i else None
    nw = int(k[i - 1, j - 1]) if i and j else None
    if w is None and n is None:
        w = n = nw = 0
    elif i == 0:
        n = nw = w
    elif j == 0:
        w = nw = n
    return {0: n, 1: sorted((w, n, w + n - nw))[1]}[predictor]


@given(shapes, st.integers(0, 1000), st.sampled_from((1, 50, MAX_SYMBOL // 4)))
def test_every_predictor_is_undone_exactly(shape, seed, top):
    k = random_plane(shape, seed, top)
    for predictor in (UP, MEDIAN):
        np.testing.assert_array_equal(restore([(predictor, residual(predictor, k))])[0], k, err_msg=str(predictor))


@given(shapes, st.integers(0, 1000))
@settings(max_examples=30)
def test_predictions_follow_their_definition(shape, seed):
    k = random_plane(shape, seed, 100)
    for predictor in (UP, MEDIAN):
        expected = [
            [[int(c[i, j]) - scalar_prediction(predictor, c, i, j) for j in range(shape[2])] for i in range(shape[1])]
            for c in k
        ]
        np.testing.assert_array_equal(residual(predictor, k), expected, err_msg=str(predictor))


def test_planes_restored_together_equal_planes_restored_alone():
    planes = [random_plane((1 + i % 3, 5, 7 if i % 2 else 40), i, 30) for i in range(14)]
    assert_same_symbols(restore([(i // 2 % 2, residual(i // 2 % 2, k)) for i, k in enumerate(planes)]), planes)


@pytest.mark.parametrize("shape", [(1, 1, 900), (1, 900, 1), (2, 900, 5), (1, 90, 90)])
@pytest.mark.parametrize("predictor", (UP, MEDIAN))
def test_memory_is_linear_in_the_samples_of_any_shape(shape, predictor):
    """A plane of one column took H * H cells once: 2 kB of a file asked for 47 GB."""
    coded = [(predictor, np.ones(shape, np.int32))] * 6
    samples = 6 * int(np.prod(shape))
    with memory_below(40 * samples + (1 << 18)):
        restore(coded)


@pytest.mark.parametrize("predictor", (UP, MEDIAN))
def test_residuals_of_the_largest_samples_stay_within_the_limit(predictor):
    """Each prediction lies between two neighbours."""
    k = np.where(np.indices((1, 6, 6)).sum(axis=0) % 2, MAX_SYMBOL, -MAX_SYMBOL).astype(np.int32)
    r = residual(predictor, k)
    assert np.abs(r).max() == K_MAX
    np.testing.assert_array_equal(restore([(predictor, r)])[0], k)


def test_the_choice_suits_the_plane():
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.integers(-50, 50, (4, 1, 40), dtype=np.int32), 30, axis=1)
    assert choose_predictor(rows)[0] == UP
    steps = np.cumsum(rng.integers(0, 9, (4, 30, 40), dtype=np.int32), axis=2)
    assert choose_predictor(np.cumsum(steps, axis=1))[0] == MEDIAN


# -- coded channels ----------------------------------------------------------------------------------------------------


def coded(planes, *options):
    """(codes, stream, sum of R(a)) of residuals. options: of ChannelWriter."""
    writer = ChannelWriter(*options)
    rate = write_planes(planes, writer)
    return *writer.finish()[:2], rate


def decoded(codes, stream, planes):
    reader = ChannelReader(codes, stream, sum(plane.size for plane in planes))
    found = read_planes(reader, [plane.shape for plane in planes])
    reader.finish()
    return found


def plainly(planes):
    """(bits, sum of R(a)) of the channels without classes."""
    writer = ChannelWriter()
    rate = writer.write([channel.ravel() for plane in planes for channel in plane])
    return writer.finish()[2][0], rate


@pytest.mark.parametrize("channels", [4, 7])
def test_classes_pay_where_cells_are_busy(channels):
    rng = np.random.default_rng(0)
    planes = [busy((channels, *size), rng) for size in ((40, 50), (30, 45))]
    (codes, stream, rate), (plain, same) = coded(planes), plainly(planes)
    assert 8 * (len(codes) + len(stream)) < 0.95 * plain
    assert rate == pytest.approx(same)
    assert_same_symbols(decoded(codes, stream, planes), planes)


def test_classes_cost_little_where_cells_are_alike():
    planes = [np.random.default_rng(0).integers(-9, 10, (4, 20, 20)).astype(np.int32)]
    codes, stream, _ = coded(planes, "best", 3)
    assert 8 * (len(codes) + len(stream)) < 1.05 * plainly(planes)[0]


@given(
    st.lists(st.tuples(st.integers(1, 9), st.integers(1, 8), st.integers(1, 8)), max_size=6),
    st.sampled_from((("best", 1), ("best", 3), ("gauss", 3))),
    st.integers(0, 1000),
)
@settings(max_examples=40)
def test_any_shapes_come_back(shapes, options, seed):
    """Planes of different numbers of channels are done after different numbers of stages."""
    rng = np.random.default_rng(seed)
    planes = [busy(shape, rng) for shape in shapes]
    assert_same_symbols(decoded(*coded(planes, *options)[:2], planes), planes)


@given(st.integers(0, 1000), st.sampled_from((1, 2, 5)))
@settings(max_examples=8)
def test_the_largest_residuals_come_back(seed, channels):
    rng = np.random.default_rng(seed)
    planes = [rng.choice([-K_MAX, -1, 0, K_MAX], (channels, 9, 9)).astype(np.int32)]
    assert_same_symbols(decoded(*coded(planes, "best", 1)[:2], planes), planes)


# -- classes of cells: magnitudes and classes are those of clause 8.7, on integers -------------------------------------


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
