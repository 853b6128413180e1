"""Start points that stereo finds, against the points of synthetic scenes, which lie on their surfaces."""

import dataclasses

import numpy as np
import pytest
import torch

from pd4dgs_codec.data import dataset
from pd4dgs_codec.data.view import shrunk_view
from pd4dgs_codec.train import initialise
from pd4dgs_codec.train.stereo import PIXELS, with_points


def distances(points, surface):
    """The distance of each point from the nearest point of the surface, as a share of the surface's extent."""
    apart = torch.cdist(torch.from_numpy(np.asarray(points, np.float32)), torch.from_numpy(surface)).amin(1)
    return apart.numpy() / np.linalg.norm(np.ptp(surface, axis=0))


@pytest.fixture(scope="module")
def room():
    """A room in which large objects move, seen from nine places."""
    return dataset.load("synthetic:global?frames=9&path=jump&seed=5")


@pytest.fixture(scope="module")
def found(room):
    return with_points(dataclasses.replace(room, points=None), 0.5)


def test_points_lie_on_the_surfaces_whatever_the_exposure_of_each_camera(room, found):
    assert len(found.points) > len(room.train) * PIXELS / 6
    apart = distances(found.points, room.points)
    assert np.median(apart) < 0.02 and np.percentile(apart, 90) < 0.1
    random = np.random.default_rng(0).uniform(*found.box, (500, 3))
    assert np.median(distances(random, room.points)) > 3 * np.median(apart)
    exposed = [
        dataclasses.replace(view, image=(view.image * (0.6 + 0.4 * (i % 2))).astype(np.uint8))
        for i, view in enumerate(room.train)
    ]
    again = with_points(dataclasses.replace(room, points=None, train=tuple(exposed)), 0.5)
    assert len(again.points) > 0.8 * len(found.points)
    assert np.median(distances(again.points, room.points)) < 0.02


def test_box_and_depths_span_the_points(room, found):
    low, high = found.box
    assert ((found.points >= low) & (found.points <= high)).all(1).mean() > 0.95
    viewmat = room.train[0].viewmat
    depths = found.points @ viewmat[2, :3] + viewmat[2, 3]
    assert 0 < found.near < np.percentile(depths[depths > 0], 5) and found.far > np.percentile(depths, 95)


def test_no_point_is_found_where_views_are_not_valid(room):
    left = np.arange(room.train[0].width) < room.train[0].width // 2
    masked = tuple(dataclasses.replace(view, mask=np.tile(left, (view.height, 1))) for view in room.train)
    half = with_points(dataclasses.replace(room, points=None, train=masked), 0.5).points
    assert len(half) > len(masked) * PIXELS / 6
    seen = np.zeros(len(half), bool)
    for view in masked:
        _, column, inside = view.project(*half.T)
        seen |= inside & (column < view.width // 2)
    assert seen.all()


def test_views_without_texture_or_neighbours_keep_the_dataset(room):
    blank = dataclasses.replace(
        room,
        points=None,
        train=tuple(dataclasses.replace(view, image=np.full_like(view.image, 90)) for view in room.train),
    )
    assert with_points(blank, 0.5) is blank
    tiny = dataclasses.replace(room, points=None, train=tuple(shrunk_view(view, 30) for view in room.train))
    assert tiny.train[0].image.shape == (4, 5, 3)
    assert with_points(tiny, 0.5) is tiny
    alone = dataclasses.replace(room, points=None, train=room.train[:1])
    assert with_points(alone, None) is alone


@pytest.mark.parametrize("source, searched", [("synthetic:global?frames=9", True), ("synthetic:flyby?frames=9", False)])
def test_only_captures_without_points_and_plain_background_are_searched(source, searched, monkeypatch):
    calls = []
    monkeypatch.setattr(initialise, "with_points", lambda data, key: calls.append(key) or data)
    given = dataset.load(source)
    for points in (given.points, None):
        initialise.start_points(dataclasses.replace(given, points=points), 0.25, moves=False)
    assert calls == [0.25] * searched
