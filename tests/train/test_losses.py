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
