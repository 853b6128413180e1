"""Hand-computed cases of the mask terms."""

import math

import pytest
import torch

from pd4dgs_codec.train import losses


def test_binary_term_is_the_mean_entropy_in_bits():
    assert float(losses.binary_term(torch.full((5,), 0.5))) == pytest.approx(1.0)
    assert float(losses.binary_term(torch.tensor([0.0, 1.0]))) < 1e-4
    quarter = -(0.25 * math.log2(0.25) + 0.75 * math.log2(0.75))
    assert float(losses.binary_term(torch.tensor([0.25, 0.75]))) == pytest.approx(quarter, rel=1e-5)


def test_binary_term_is_differentiated_right():
    mask = torch.rand(30, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    torch.autograd.gradcheck(losses.binary_term, mask)
    outside = torch.tensor([0.0, 1.0, 1e-7], requires_grad=True)
    losses.binary_term(outside).backward()
    assert not outside.grad.any()


def _curve(count: int, side: int = 12) -> losses.Neighbours:
    grid = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = grid[torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))[:count]].int()
    return losses.Neighbours(cells, 4.0)


def test_smooth_term_weighs_differences_by_distance():
    near = losses.Neighbours(torch.tensor([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), 4.0)
    assert near.order.tolist() == [0, 1, 2]
    found = losses.smooth_term(torch.tensor([0.0, 1.0, 0.5]), near, torch.tensor([1, 1, 1]))
    assert float(found) == pytest.approx((math.exp(-1 / 4) + 0.5 * math.exp(-2 / 4)) / 2)
    found = losses.smooth_term(torch.tensor([0.0, 1.0, 0.5]), near, torch.tensor([2, 7, 1]))
    assert float(found) == pytest.approx(0.5 * math.exp(-3 / 4))  # of the pairs that are on the curve


def test_smooth_term_is_differentiated_right():
    near, generator = _curve(40, 4), torch.Generator().manual_seed(1)
    mask = torch.rand(40, dtype=torch.float64, generator=generator).requires_grad_()
    away = near.draw(generator)
    assert set(near.draw(torch.Generator().manual_seed(0)).tolist()) <= set(range(1, 9))
    torch.autograd.gradcheck(lambda m: losses.smooth_term(m, near, away), mask)


def test_neighbours_are_near():
    near = _curve(12**3)
    distance = -4 * near.weights[:-8].log()
    assert float(distance.mean()) < 4  # random pairs of this cube are 8 apart on average
    cells = near.anchor_q[near.order].float()
    torch.testing.assert_close(distance[:, 2], (cells[3:-5] - cells[:-8]).norm(dim=1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1])
def test_no_pairs_without_two_anchors(count):
    near = losses.Neighbours(torch.zeros(count, 3, dtype=torch.int32), 4.0)
    away = near.draw(torch.Generator())
    assert away.shape == (count,) and float(losses.smooth_term(torch.ones(count), near, away)) == 0
