"""R(a) and its gradients against mpmath at 60 digits, over sigma/Q in 1e-3..1e6 and z up to 300."""

import math

import mpmath
import pytest
import torch

from pd4dgs_codec.model.rate import (
    channel_moments,
    log_probability,
    rate_bits,
    sampled,
    sampled_reference,
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


@pytest.mark.parametrize("rows", [1, 2, 500])
def test_samples_and_their_gradient_are_those_of_the_plain_form(rows):
    generator = torch.Generator().manual_seed(rows)
    x = torch.randn(600, 5, dtype=torch.float64, generator=generator) * 3 + 7
    x[:, 1] = 4.0  # a channel without spread
    active = torch.randperm(600, generator=generator)[:rows].sort().values
    picked = active[torch.randperm(rows, generator=generator)[: (rows + 1) // 2]]
    weights = torch.randn(2 + len(picked), 5, dtype=torch.float64, generator=generator)
    weights[1, 1] = 0.0  # the rate holds such a sigma at its floor, so that no gradient comes back
    results = []
    for function in (sampled, sampled_reference):
        leaf = x.clone().requires_grad_()
        found = torch.cat([part.view(-1, 5) for part in function(leaf, active, picked)])
        (found * weights).sum().backward()
        results.append((found, leaf.grad))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 2e-11), (torch.float32, 2e-4)])
def test_the_kernels_give_the_plain_forms_rate_and_gradients(dtype, bound):
    """Widths from a thousandth of a step to a thousand steps, distances up to 60 sigma and both sides of Q/2."""
    sigma = torch.logspace(-3, 3, 25, dtype=torch.float64)
    z = torch.cat([torch.linspace(-60, 60, 41, dtype=torch.float64), torch.logspace(-6, 0, 7, dtype=torch.float64)])
    a = torch.cat([z[:, None] * sigma, z[:, None].clamp(-1, 1) * sigma + 0.5]).to(dtype)
    sigma, mu, weights = sigma.to(dtype), torch.zeros(25, dtype=dtype), torch.rand(a.shape, dtype=dtype) + 0.5
    results = []
    for form in (lambda x: x, lambda x: x[None]):  # the plain form takes what has another number of axes
        leaves = [x.clone().requires_grad_() for x in (a, mu, sigma)]
        bits = log_probability(*map(form, leaves), 1.0)
        (bits * weights).sum().backward()
        results.append([bits.detach().reshape(a.shape), *(x.grad for x in leaves)])
    for found, expected in zip(*results, strict=True):
        scale = expected.abs().clamp(min=1.0)
        assert float(((found - expected).abs() / scale).max()) < bound
