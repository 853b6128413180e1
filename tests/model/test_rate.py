"""R(a): sums, moments and the kernels beside the plain form; `tests/stability` holds it against mpmath."""

import pytest
import torch

from pd4dgs_codec.model.rate import channel_moments, log_probability, rate_bits, row_bits


def test_probabilities_of_all_symbols_sum_to_one():
    k = torch.arange(-400, 401, dtype=torch.float64)
    p = log_probability(k * 0.5, torch.tensor(0.13).double(), torch.tensor(7.0).double(), 0.5).exp()
    assert abs(float(p.sum()) - 1) < 1e-12


def test_gradient_through_the_moments_matches_finite_differences():
    torch.manual_seed(0)
    x = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)

    def total(values):
        mu, sigma = channel_moments(values)
        return -log_probability(values, mu, sigma, 0.3)

    assert torch.autograd.gradcheck(total, (x,), atol=1e-7)


def row_bits_reference(parts, classes, rows):
    """The plain torch form of `row_bits`."""
    of_rows = classes[rows]
    bits = parts[0][0].new_zeros(len(rows))
    for c in sorted(set(of_rows.tolist())):
        own = (of_rows == c).nonzero()[:, 0]
        for values, step in parts:
            mu, sigma = channel_moments(values[classes == c])
            bits = bits.index_add(0, own, rate_bits(values[rows[own]], mu, sigma, step * 2.0**c).sum(1))
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
