"""The kernels for kept Gaussians against their plain torch forms, values and gradients."""

import pytest
import torch

from pd4dgs_codec import threads
from pd4dgs_codec.model import slots

N = 40


@pytest.fixture(params=["some", "all", "none", "one"])
def keep(request) -> torch.Tensor:
    count = {"some": 90, "all": 10 * N, "none": 0, "one": 1}[request.param]
    return torch.randperm(10 * N, generator=torch.Generator().manual_seed(1))[:count].sort().values


@pytest.fixture(params=[1, 2, 5])
def several_threads(request, monkeypatch):
    monkeypatch.setattr("numba.get_num_threads", lambda: request.param)  # the number of parts, whatever runs them


def draw(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def check(function, reference, inputs, keep) -> None:
    """float32 values as of the reference in float64, and the same gradients of one random weighting of them."""
    found = [x.clone().requires_grad_() for x in inputs]
    expected = [x.double().requires_grad_() for x in inputs]
    outputs = [f(*leaves, keep) for f, leaves in ((function, found), (reference, expected))]
    both = [o if isinstance(o, tuple) else (o,) for o in outputs]
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)
    for results in both:
        sum((result * (draw(*result.shape) + 0.5)).sum() for result in results).backward()
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.grad.double(), b.grad, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("width", [3, 7])
def test_slot_linear_is_the_layer_at_the_kept_slots(keep, several_threads, width):
    inputs = [draw(N, 16), draw(10 * width, 16), draw(10 * width)]
    check(slots.slot_linear, slots.slot_linear_reference, inputs, keep)


def test_slot_linear_of_an_odd_width_takes_the_plain_form(keep):
    inputs = [draw(N, 11), draw(30, 11), draw(30)]
    check(slots.slot_linear, slots.slot_linear_reference, inputs, keep)


def test_a_hidden_layer_that_is_part_of_another_needs_no_copy_by_the_caller(keep):
    inputs = [draw(N, 24), draw(30, 8), draw(30)]

    def part(function):
        return lambda hidden, *rest: function(hidden[:, 8:16], *rest)

    check(part(slots.slot_linear), part(slots.slot_linear_reference), inputs, keep)


def test_assembled_gaussians(keep, several_threads):
    inputs = [draw(N, 3), draw(N, 6).exp(), draw(N, 10, 3), draw(N, 10), draw(N).sigmoid(), draw(len(keep), 7)]
    check(slots.assemble, slots.assemble_reference, inputs, keep)


def test_a_quaternion_of_no_length(keep):
    shape = draw(len(keep), 7)
    shape[::2, 3:] = 0
    shape[1::2, 3:] *= 1e-14
    inputs = [draw(N, 3), draw(N, 6).exp(), draw(N, 10, 3), draw(N, 10), draw(N).sigmoid(), shape]
    check(slots.assemble, slots.assemble_reference, inputs, keep)


def test_repeated_runs_give_the_same_bits(keep):
    threads.configure(1)
    inputs = [draw(N, 16), draw(70, 16), draw(70)]

    def gradients():
        leaves = [x.clone().requires_grad_() for x in inputs]
        slots.slot_linear(*leaves, keep).square().sum().backward()
        return [x.grad for x in leaves]

    assert all(torch.equal(a, b) for a, b in zip(gradients(), gradients(), strict=True))
