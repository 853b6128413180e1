"""R(a) and its gradients against mpmath at 60 digits, over sigma/Q in 1e-3..1e6 and z up to 300."""

import math

import mpmath
import pytest
import torch

from pd4dgs_codec.model.rate import (
    channel_moments,
    log_probability,
    rate_bits,
    row_bits,
    row_bits_reference,
)

RATIOS = [1e-3, 0.01, 0.1, 0.3, 0.5, 1.0, 2.0, 7.0, 50.0, 1e3, 1e6]
DISTANCES = [0.0, 1e-6, 0.3, 0.5, 1.0, 2.7, 4.9, 6.0, 20.0, 300.0]


def exact(a, mu, sigma, q):
    """ln P and its gradients at the exact binary inputs."""
    with mpmath.workdps(60 + int(0.25 * (abs(a - mu) / sigma + 1) ** 2 % 2000)):
        a, mu, sigma, q = (mpmath.mpf(x) for x in (a, mu, sigma, q))
        d = abs(a - mu)
        u, v = (d - q / 2) / sigma, (d + q / 2) / sigma
        p = (mpmath.erfc(u / mpmath.sqrt(2)) - mpmath.erfc(v / mpmath.sqrt(2))) / 2
        phi_u, phi_v = mpmath.npdf(u), mpmath.npdf(v)
        sign = mpmath.sign(a - mu)
        grads = (
            sign * (phi_v - phi_u) / (p * sigma),
            (u * phi_u - v * phi_v) / (p * sigma),
            (phi_u + phi_v) / (2 * sigma * p),
        )
        return float(mpmath.log(p)), [float(g) for g in grads]


@pytest.mark.parametrize(
    ("dtype", "tolerance", "gradient_tolerance"), [(torch.float64, 2e-12, 1e-9), (torch.float32, 2e-5, 1e-4)]
)
def test_value_and_gradients(dtype, tolerance, gradient_tolerance):
    for ratio in RATIOS:
        for distance in DISTANCES:
            for mu in (0.0, -1.5):
                q = 0.125
                values = (mu + distance * ratio * q, mu, ratio * q, q)
                tensors = [torch.tensor(x, dtype=dtype, requires_grad=True) for x in values]
                a, m, s, step = tensors
                value = log_probability(a, m, s, step)
                value.backward()
                want, (da, ds, dq) = exact(*(float(x.detach()) for x in tensors))
                assert abs(float(value.detach()) - want) <= tolerance * max(1.0, abs(want)), (ratio, distance)
                for got, exact_gradient in ((a.grad, da), (s.grad, ds), (step.grad, dq)):
                    scale = max(abs(exact_gradient), 1e-3)
                    assert abs(float(got) - exact_gradient) <= gradient_tolerance * scale, (ratio, distance)
                assert float(m.grad) == -float(a.grad)


def test_probabilities_of_all_symbols_sum_to_one():
    k = torch.arange(-400, 401, dtype=torch.float64)
    p = log_probability(k * 0.5, torch.tensor(0.13).double(), torch.tensor(7.0).double(), 0.5).exp()
    assert abs(float(p.sum()) - 1) < 1e-12


def test_the_clip_hides_the_value_but_not_the_gradient():
    a = torch.tensor([0.0, 50.0], requires_grad=True)
    sigma = torch.tensor(1.0, requires_grad=True)
    bits = rate_bits(a, torch.tensor(0.0), sigma, 1.0)
    bits.sum().backward()
    assert float(bits[1].detach()) == pytest.approx(math.log2(1e6))
    assert float(a.grad[1]) > 10
    assert float(sigma.grad) < -10


def test_gradient_through_the_moments_matches_finite_differences():
    torch.manual_seed(0)
    x = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)

    def total(values):
        mu, sigma = channel_moments(values)
        return -log_probability(values, mu, sigma, 0.3)

    assert torch.autograd.gradcheck(total, (x,), atol=1e-7)


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
