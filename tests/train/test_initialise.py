"""Where a fresh model's anchors stand."""

import pytest
import torch

from pd4dgs_codec.train.initialise import nearest_distances


@pytest.mark.parametrize("n", [2, 3, 50, 2000])
def test_nearest_distances_are_those_of_all_pairs(n):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(n)).round(decimals=1)  # some in one place
    apart = (points[:, None].double() - points).square().sum(2)
    k = min(3, n - 1)
    expected = apart.sort(dim=1).values[:, 1 : k + 1].mean(1).sqrt()  # the first is the point itself
    torch.testing.assert_close(nearest_distances(points).double(), expected, rtol=1e-6, atol=0)


def test_a_point_alone_has_a_distance_too():
    assert nearest_distances(torch.zeros(1, 3)).tolist() == [1.0] and not len(nearest_distances(torch.zeros(0, 3)))
