"""R(a): the kernels beside the plain form, and their gradients; `tests/stability` holds them against mpmath."""

import pytest
import torch
from trainer_rate import moments, plain_bits

from pd4dgs_codec.model.rate import row_bits


def test_gradient_through_the_moments_matches_finite_differences():
    torch.manual_seed(0)
    x = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    classes, rows = torch.zeros(7, dtype=torch.int8), torch.arange(7)
    assert torch.autograd.gradcheck(lambda values: row_bits([(values, 0.3)], classes, rows), (x,), atol=1e-7)


def row_bits_reference(parts, classes, rows):
    """The plain torch form of `row_bits`."""
    of_rows = classes[rows]
    bits = parts[0][0].new_zeros(len(rows))
    for c in sorted(set(of_rows.tolist())):
        own = (of_rows == c).nonzero()[:, 0]
        for values, step in parts:
            mu, sigma = moments(values[classes == c])
            bits = bits.index_add(0, own, plain_bits(values[rows[own]], mu, sigma, step * 2.0**c).sum(1))
    return bits


@pytest.mark.parametrize("active", [1, 2, 5000])
def test_the_kernels_give_the_plain_form_s_bits_and_gradients(active):
    """Columns from a thousandth of a step to a thousand steps wide, without spread, and with values far outside. The
    kernels compute in float64 and round what they return."""
    generator = torch.Generator().manual_seed(active)
    width = torch.logspace(-3, 3, 7)
    values = 2.0 + torch.randn(6000, 9, generator=generator) * torch.cat([width, torch.zeros(2)])
    values[::50, 8] = 60.0
    chosen = torch.randperm(6000, generator=generator)[:active]
    classes = torch.full((6000,), -1, dtype=torch.int8)
    classes[chosen] = torch.randint(0, 3, (active,), generator=generator).to(torch.int8) * 2
    rows, weights = chosen[: (active + 9) // 10], torch.rand((active + 9) // 10, generator=generator) + 0.5
    results = []
    for form, dtype in ((row_bits, torch.float32), (row_bits_reference, torch.float64)):
        leaf = values.to(dtype, copy=True).requires_grad_()
        bits = form([(leaf[:, :4].contiguous(), 0.25), (leaf[:, 4:].contiguous(), 0.25)], classes, rows)
        (bits * weights.to(dtype)).sum().backward()
        results.append((bits.detach().double(), leaf.grad.double()))
    for found, expected in zip(*results, strict=True):
        scale = expected.abs().clamp(min=1.0)
        assert float(((found - expected).abs() / scale).max()) < 2e-6
