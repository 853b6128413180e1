"""Where a fresh model's anchors stand."""

import dataclasses

import numpy as np
import pytest
import torch

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.morton import MAX_VOXEL
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.initialise import initial_cells, nearest_distances, scene_info
from pd4dgs_codec.train.schedule import Schedule
from pd4dgs_codec.train.state import TrainState


@pytest.mark.parametrize("n", [2, 3, 50, 2000])
def test_nearest_distances_are_those_of_all_pairs(n):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(n)).round(decimals=1)  # some in one place
    apart = (points[:, None].double() - points).square().sum(2)
    k = min(3, n - 1)
    expected = apart.sort(dim=1).values[:, 1 : k + 1].mean(1).sqrt()  # the first is the point itself
    torch.testing.assert_close(nearest_distances(points).double(), expected, rtol=1e-6, atol=0)


def test_a_point_alone_has_no_distance():
    assert nearest_distances(torch.zeros(1, 3)).tolist() == [0.0] and not len(nearest_distances(torch.zeros(0, 3)))


@pytest.mark.parametrize("count", [30, 40, 50])
def test_as_many_cells_as_asked_start_at_fewer_as_many_or_more_points(dataset, count):
    points = np.random.default_rng(0).uniform(*dataset.box / 2, (40, 3)).astype(np.float32)
    given = dataclasses.replace(dataset, points=points)
    cells = initial_cells(given, count, 1e-4, torch.Generator().manual_seed(0))
    assert len(cells) == count
    own = {tuple(cell) for cell in np.round(points / 1e-4).astype(int).tolist()}
    assert sum(tuple(cell) in own for cell in cells.tolist()) >= min(count, 40) - 1  # one may round otherwise


def test_a_box_that_the_format_cannot_number_is_refused(dataset):
    size = dataset.box[1] - dataset.box[0]
    assert scene_info(dataclasses.replace(dataset, box=dataset.box + 1000 * size.max())).voxel_size > 0
    for box in (dataset.box + 1024 * size.max(), np.zeros((2, 3)), 1e-6 * dataset.box, 1e9 * dataset.box):
        with pytest.raises(DataError, match="longest side of 1e-05 to 1e[+]09 and at most 1024 sides from 0"):
            scene_info(dataclasses.replace(dataset, box=box))


def moved(dataset, scale: float = 1.0, by: float = 0.0) -> Dataset:
    """The dataset with its box and points at another place; its cameras stay."""
    points = None if dataset.points is None else dataset.points * scale + by
    return dataclasses.replace(dataset, box=dataset.box * scale + by, points=points)


def test_a_scene_that_no_picture_shows_is_refused(dataset):
    blind = [dataclasses.replace(view, K=view.K * ((1e-4,), (1e-4,), (1,)) + 0.0) for view in dataset.train]
    for given in (moved(dataset, by=100.0), dataclasses.replace(dataset, train=tuple(blind))):
        with pytest.raises(DataError, match="start points are at [01] different pixels .*, expected poses, focal"):
            TrainState(TrainConfig(preset="tiny"), given, Schedule(10), torch.device("cpu"))


@pytest.mark.parametrize("count", [4, 8, 300])
@pytest.mark.parametrize("far", [0.0, 1020.0])
def test_no_anchor_starts_beyond_the_limits_of_the_format(dataset, count, far):
    """The few points, of which copies are spread, may lie farther apart than a box is long."""
    sides = dataset.box + np.float32(far * 3)
    points = np.random.default_rng(count).uniform(*sides, (count, 3)).astype(np.float32)
    points[0] = points[1] + 3
    given = dataclasses.replace(dataset, points=points, box=sides.astype(np.float32))
    info = scene_info(given)
    cells = initial_cells(given, 300, info.voxel_size, torch.Generator().manual_seed(0))
    assert len(cells) > 200 and int(cells.abs().max()) <= MAX_VOXEL
    place = (cells * info.voxel_size).numpy()
    assert (np.abs(place - sides.mean(0)) <= 3 * 1.01).all(), "an anchor starts far outside the box"


def test_points_in_the_box_that_span_no_volume_are_as_good_as_none(dataset):
    flat = np.stack([np.linspace(-1, 1, 50), np.zeros(50), np.zeros(50)], 1).astype(np.float32)
    given = dataclasses.replace(dataset, points=flat)
    cells = initial_cells(given, 300, 1e-3, torch.Generator().manual_seed(0))
    assert len(cells) > 250 and (cells.float().std(0) > 300).all()
