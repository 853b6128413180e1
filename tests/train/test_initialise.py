"""Where a fresh model's anchors stand."""

import dataclasses

import numpy as np
import pytest
import torch

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.train.initialise import initial_cells, nearest_distances, scene_info


@pytest.mark.parametrize("n", [2, 3, 50, 2000])
def test_nearest_distances_are_those_of_all_pairs(n):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(n)).round(decimals=1)  # some in one place
    apart = (points[:, None].double() - points).square().sum(2)
    k = min(3, n - 1)
    expected = apart.sort(dim=1).values[:, 1 : k + 1].mean(1).sqrt()  # the first is the point itself
    torch.testing.assert_close(nearest_distances(points).double(), expected, rtol=1e-6, atol=0)


def test_a_point_alone_has_a_distance_too():
    assert nearest_distances(torch.zeros(1, 3)).tolist() == [1.0] and not len(nearest_distances(torch.zeros(0, 3)))


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
    for box in (dataset.box + 1024 * size.max(), np.zeros((2, 3), np.float32)):
        with pytest.raises(DataError, match="expected one with a side and at most 1024 sides from 0"):
            scene_info(dataclasses.replace(dataset, box=box))
