"""Packing without training: ellipsoids stay, voxels are distinct, errors are as predicted, bodies move in groups."""

import numpy as np
import pytest
from explicit import covariances
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.data.view import rotation_matrix
from pd4dgs_codec.interchange.direct import EACH, Leaving
from pd4dgs_codec.interchange.pack import Grid, Pictures, absence, sensitivity, tensors_of, turned, voxels
from pd4dgs_codec.interchange.splats import picture
from pd4dgs_codec.interchange.tracks import Change, Grouping, _runs, between, knots, tracks_of
from pd4dgs_codec.kinds.splats import Splats, splats_of, unit
from pd4dgs_codec.kinds.tracks import place
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Camera

UPRIGHT = np.array([1.0, 0, 0, 0])
BOX = np.array([[-1.0, -2, 0], [3, 1, 2]], np.float32)


def cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    parts = rng.normal(0, 0.5, (count, 3)), unit(rng.normal(size=(count, 4))), rng.uniform(0.05, 0.2, (count, 3))
    return Splats(
        *(x.astype(np.float32) for x in (*parts, rng.uniform(0.2, 0.9, count), rng.normal(size=(count, 1, 3))))
    )


# -- still -------------------------------------------------------------------------------------------------------------


def test_the_nearest_description_is_of_the_same_ellipsoid():
    given_ = cloud(300)
    quats, scales = turned(given_.quats.astype(np.float64), given_.scales, UPRIGHT)
    np.testing.assert_allclose(covariances(quats, scales), covariances(given_.quats, given_.scales), atol=1e-7)
    assert quats[:, 0].min() > 0.853  # no rotation is more than 62.8 degrees from one of the 24 of a cube
    again, _ = turned(quats, scales, quats)
    np.testing.assert_allclose(again, quats, atol=1e-12)


def test_tensors_give_the_gaussians_back():
    given_ = cloud(100)
    found = splats_of(tensors_of(given_))
    np.testing.assert_allclose(
        covariances(found.quats, found.scales), covariances(given_.quats, given_.scales), atol=1e-6
    )
    for name in ("means", "opacities", "sh"):
        np.testing.assert_allclose(getattr(found, name), getattr(given_, name), atol=1e-5)


@pytest.mark.parametrize("same", (1, 40))
def test_voxels_are_distinct_and_near(same):
    at = np.repeat(np.random.default_rng(1).normal(size=(500, 3)), same, axis=0)
    size, cells = voxels(at)
    assert len(np.unique(cells, axis=0)) == len(at)
    assert np.abs(cells * size - at).max() <= 4.5 * size


@pytest.mark.parametrize("name", ("color", "opacity", "scale"))
def test_errors_of_pictures_are_as_predicted(name):
    given_, rng = cloud(60), np.random.default_rng(2)
    cameras = [
        Camera.look_at(3 * unit(rng.normal(size=3)), np.zeros(3), (0, 0, 1), width=64, height=64) for _ in range(16)
    ]
    pictures = Pictures([(camera, given_) for camera in cameras])
    weights, values = sensitivity(pictures)[0][name], tensors_of(given_)
    error, found = 0.02, []
    for _ in range(4):
        moved = values | {name: values[name] + error * rng.choice([-1, 1], values[name].shape)}
        images = [picture(splats_of(moved), camera, (0.0, 0.0, 0.0)) for camera in cameras]
        found.append(np.mean(np.square(np.subtract(images, pictures.images))))
    assert np.mean(found) == pytest.approx(weights.sum() * values[name].shape[1] * error**2, rel=0.5)


def test_the_absence_of_a_gaussian_adds_what_is_predicted():
    given_, rng = cloud(60), np.random.default_rng(3)
    cameras = [
        Camera.look_at(3 * unit(rng.normal(size=3)), np.zeros(3), (0, 0, 1), width=64, height=64) for _ in range(16)
    ]
    gray, kept = (0.5, 0.5, 0.5), np.arange(60) >= 10
    pictures = Pictures([(camera, given_) for camera in cameras], gray)

    def images(shown):
        return np.array([picture(given_.taken(np.flatnonzero(shown)), cam, gray) for cam in cameras])

    shown = images(kept).astype(np.float64)
    apart = [shown - images(kept & (np.arange(60) != i)) for i in range(10, 60)]
    crossed = [np.mean(c * (shown - pictures.images)) for c in apart]
    exact = np.mean(np.square(apart), axis=(1, 2, 3, 4)) - 2 * np.minimum(crossed, 0)
    added = absence(pictures, kept)
    assert not added[:10].any() and 4 < np.count_nonzero(np.greater(crossed, 0)) < 45
    assert added[10:].sum() == pytest.approx(exact.sum(), rel=0.3)
    assert np.corrcoef(added[10:], exact)[0, 1] > 0.8


def test_gaussians_that_a_few_views_show_stay_and_what_adds_little_leaves():
    sides, given_ = np.eye(3).repeat(20, axis=0) * [1, 1, 1], cloud(60)  # a third each is in view of one part
    faint = np.arange(60) % 2 == 1
    given_ = Splats(
        *(vars(given_) | {"means": np.float32(9 * sides), "opacities": np.float32(0.9 - 0.899 * faint)}).values()
    )
    cameras = [Camera.look_at(6 * side, 9 * side, (1, 2, 3), width=64, height=64) for side in np.eye(3)]
    parts = [Pictures([(camera, given_)]) for camera in cameras[:EACH]]
    added = sensitivity(Pictures([(camera, given_) for camera in cameras]))[1]
    leaving = Leaving(parts, 1.0, np.ones(60, bool), added, np.full(60, np.inf))
    leaving.until(added[~faint].min() / 8)
    assert (leaving.thetas[faint] < np.inf).sum() > 20 and (leaving.thetas[~faint] == np.inf).all()


def test_gaussians_that_pictures_depend_on_less_get_coarser_steps_within_bounds():
    rng = np.random.default_rng(3)
    weights = {name: np.exp(rng.normal(0, 3, 2000)) for name in ("position", "color")}
    channels, bounds = {"position": 3, "color": 3}, {"position": np.where(np.arange(2000) % 2, 0.5, 1e9)}
    grid = Grid.of(weights, channels, bounds, 0.01)
    total = weights["position"] + weights["color"]
    assert np.corrcoef(grid.classes[::2], np.log(total[::2]))[0, 1] < -0.8
    assert (grid.steps["position"] * 2.0 ** grid.classes[1::2] <= 0.5).all()
    spacing = grid.steps["color"] * 2.0 ** grid.classes[:, None]
    values = rng.normal(0, 30, (2000, 3))
    found = grid.rounded(values, grid.steps["color"], weights["color"])
    np.testing.assert_allclose(np.rint(found / spacing) * spacing, found, rtol=1e-6)
    assert (np.abs(found - values) <= 0.81 * spacing + 1e-5).all()


# -- moving ------------------------------------------------------------------------------------------------------------


def bodies(per_body=600, instants=21):
    """Three boxes of points side by side that turn and fly: values [n, 3, T] against the middle instant, places [n, 3]
    in Morton order, times."""
    rng, times = np.random.default_rng(4), np.linspace(0, 1, instants)
    parts, moved = [], []
    for i in range(3):
        at = rng.uniform(-0.5, 0.5, (per_body, 3)) + [1.2 * i, 0, 0]
        turns = [rotation_matrix([np.cos(a), 0, np.sin(a), 0]) for a in (i - 1) * (times - 0.5)]
        parts.append(at)
        moved.append(np.stack([at @ turn.T + [0, t * i, 0] for turn, t in zip(turns, times, strict=True)], axis=2))
    values = np.concatenate(moved)
    _, cells = voxels(np.concatenate(parts))
    order = morton_order(cells)
    values = values[order]
    key = instants // 2
    return (values - values[:, :, key : key + 1]).astype(np.float32), np.concatenate(parts)[order], times


def fitted(grouped):
    values, places, times = bodies()
    n = len(values)
    change = Change.of(values, np.ones(n))
    grid = Grid(1e-6, {"position": np.ones(n)}, {"position": 2e-3}, np.zeros(n, np.uint8))
    chosen = {"position": np.flatnonzero(change.gains(grid.theta) > 0)}
    grouping = Grouping.of({"position": change}, place(places, BOX), grid.theta)
    return (
        tracks_of({"position": change}, chosen, grid, times, 10, 1e-9, grouping if grouped else None),
        change,
        places,
        times,
    )


@pytest.mark.parametrize("grouped", (False, True))
def test_tracks_follow_the_bodies(grouped):
    tracks, change, places, times = fitted(grouped)
    whole = tracks.prepared(places.astype(np.float32), BOX)
    for i in (0, 7, 20):
        off = whole.residuals(times[i])["position"] - change.values.reshape(len(places), 3, -1)[:, :, i]
        assert np.abs(off).max() < 0.03 and np.sqrt(np.mean(np.square(off))) < 4e-3
    assert np.abs(whole.residuals(times[10])["position"]).max() < 0.01  # the key instant stays


def test_groups_leave_little_to_code():
    plain, *_ = fitted(False)
    shared, *_ = fitted(True)
    assert shared.groups is not None and plain.groups is None
    counts = [np.count_nonzero(tracks.heads["position"].coefficients) for tracks in (plain, shared)]
    assert counts[1] < 0.1 * counts[0]


def test_knots_are_where_paths_bend():
    times = np.linspace(0, 1, 31)
    paths = np.stack([np.abs(times - times[12]), np.maximum(times - times[20], 0)])
    found = knots(paths, times, 5, 1e-12)
    assert found.tolist() == [0, 5, 12, 20, 30]
    np.testing.assert_allclose(between(times[found], paths[:, found], times), paths, atol=1e-12)


@given(st.integers(1, 6), st.integers(1, 3), st.integers(0, 10**6))
def test_runs_have_the_least_cost(n, groups, seed):
    costs = np.random.default_rng(seed).uniform(0, 3, (n, groups)).astype(np.float32)

    def cost(labels):
        return costs[np.arange(n), labels].sum() + 1.5 * np.count_nonzero(np.diff(labels))

    every = np.stack(np.meshgrid(*[np.arange(groups)] * n), axis=-1).reshape(-1, n)
    assert cost(_runs(costs, np.float32(1.5))) == pytest.approx(min(map(cost, every)), abs=1e-4)


def test_maps_that_no_symbol_can_say_are_left_out():
    x, places = np.arange(300.0)[:, None] @ np.ones((1, 2)), np.repeat(np.arange(300.0)[:, None], 3, axis=1)
    for far, found in ((1.0, True), (1e7, False)):
        grouping = Grouping(places * far, np.zeros(300, np.int64))
        groups = grouping.fitted({"position": x}, {"position": np.ones(300)}, 1e-4, 2**-4)
        assert (groups is not None) == found
