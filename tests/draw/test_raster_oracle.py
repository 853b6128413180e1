"""The CPU kernels against the float64 oracle, the oracle against finite differences, both against hand computation."""

import math

import pytest
import torch
from raster_scenes import camera, draw_with_gradients, relative_errors, scene, turned_camera

from pd4dgs_codec.model.autograd import reference
from pd4dgs_codec.model.autograd.rasterization import rasterization

LIMIT = 1e-5

CASES = {
    "plain": (scene(300, 1), camera(50, 40), 50, 40),
    "turned": (scene(300, 2), turned_camera(50, 40), 50, 40),
    "one pixel": (scene(30, 3), camera(1, 1), 1, 1),
    "one row": (scene(60, 4), camera(70, 1), 70, 1),
    "tile edges": (scene(200, 5, scale=0.05), camera(64, 32), 64, 32),
    "small": (scene(2000, 6, scale=0.004), camera(48, 33), 48, 33),
    "huge": (scene(40, 7, scale=3.0, opacity=(0.02, 0.3)), camera(40, 40), 40, 40),
    "wide": (scene(300, 8, spread=4.0, scale=0.4), camera(33, 50, focal=0.5), 33, 50),
    "dense": (scene(1500, 9, scale=0.3, opacity=(0.3, 0.999)), camera(24, 24), 24, 24),
    "off centre": (scene(300, 10), camera(40, 40, shift=(17.0, -9.5)), 40, 40),
}


@pytest.mark.parametrize("name", CASES)
def test_kernels_agree_with_the_oracle(name):
    tensors, cameras, width, height = CASES[name]
    background = torch.tensor([[0.2, -0.5, 0.9]])
    found, expected = (
        draw_with_gradients(tensors, *cameras, width, height, backend, background) for backend in ("cpu", "reference")
    )
    errors = relative_errors(found, expected)
    assert max(errors.values()) < LIMIT, errors
    assert expected["alphas"].max() > 0.05  # something was drawn
    for key in ("radii", "depths", "conics"):
        torch.testing.assert_close(found["meta"][key].double(), expected["meta"][key].double(), rtol=1e-5, atol=1e-6)


def test_needles_keep_their_digits():
    tensors = scene(200, 11, opacity=(0.3, 0.9))
    with torch.no_grad():
        tensors[2].copy_(torch.tensor([1.5, 1e-4, 1e-4]))
    found, expected = (draw_with_gradients(tensors, *camera(64, 48), 64, 48, b) for b in ("cpu", "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) < 2 * LIMIT, errors


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("channels", [3, 5])
def test_depth_modes(mode, channels):
    tensors = scene(200, 12, channels=channels)
    background = torch.full((1, channels), 0.3)
    found, expected = (
        draw_with_gradients(tensors, *camera(40, 30), 40, 30, b, background, render_mode=mode)
        for b in ("cpu", "reference")
    )
    errors = relative_errors(found, expected)
    assert max(errors.values()) < LIMIT, errors
    assert found["picture"].shape[-1] == (1 if mode in ("D", "ED") else channels + 1)


@pytest.mark.parametrize("channels", [1, 2, 4, 7])
def test_any_number_of_channels(channels):
    tensors = scene(150, 13, channels=channels)
    found, expected = (draw_with_gradients(tensors, *camera(40, 30), 40, 30, b) for b in ("cpu", "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) < LIMIT, errors


@pytest.mark.parametrize("per_camera", [False, True])
def test_several_cameras(per_camera):
    tensors = scene(200, 14)
    if per_camera:
        tensors[4] = torch.rand(2, 200, 3, generator=torch.Generator().manual_seed(5)).requires_grad_()
    views = [torch.cat(pair) for pair in zip(camera(40, 30), turned_camera(40, 30), strict=True)]
    background = torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
    found, expected = (draw_with_gradients(tensors, *views, 40, 30, b, background) for b in ("cpu", "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) < LIMIT, errors


def test_oracle_gradients_by_finite_differences():
    tensors = [t.detach().double().requires_grad_() for t in scene(6, 15, scale=0.25, opacity=(0.3, 0.7))]
    viewmats, Ks = camera(6, 5)

    def draw(*leaves):
        # Far inside the extents, alpha stays clear of 1/255: the whole window is within 3.3 sigma of every Gaussian.
        leaves = (leaves[0] * torch.tensor([0.2, 0.2, 1.0]), leaves[1], leaves[2] + 1.0, *leaves[3:])
        out, alphas, _ = rasterization(*leaves, viewmats, Ks, 6, 5, backend="reference", render_mode="RGB+D")
        return out, alphas

    assert torch.autograd.gradcheck(draw, tensors, eps=1e-6, atol=1e-7, rtol=1e-5)


def _single(mean, scale, opacity, color=(1.0, 0.5, 0.25), **options):
    tensors = [torch.tensor([v]) for v in (mean, (1.0, 0.0, 0.0, 0.0), (scale,) * 3, opacity, color)]
    return rasterization(*tensors, *camera(33, 33, focal=1.0), 33, 33, **options)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_one_gaussian_by_hand(backend):
    background = torch.tensor([[0.0, 0.0, 1.0]])
    out, alphas, meta = _single((0.0, 0.0, 2.0), 0.2, 0.6, backgrounds=background, backend=backend)
    # On the optical axis J is diagonal: variance (f s / z)^2 + 0.3, fx = 33, fy = 36.3; the axis meets pixel (16, 16).
    var_x, var_y = (33 * 0.2 / 2) ** 2 + 0.3, (36.3 * 0.2 / 2) ** 2 + 0.3
    for dx, dy in ((0, 0), (2, 0), (0, -3), (-4, 5)):
        alpha = 0.6 * math.exp(-0.5 * (dx * dx / var_x + dy * dy / var_y))
        assert alphas[0, 16 + dy, 16 + dx, 0].item() == pytest.approx(alpha, rel=1e-6)
        expected = [alpha, 0.5 * alpha, 0.25 * alpha + 1 - alpha]
        assert out[0, 16 + dy, 16 + dx].tolist() == pytest.approx(expected, rel=1e-6)
    extent = math.sqrt(2 * math.log(255 * 0.6))
    assert meta["radii"][0, 0].tolist() == [math.ceil(extent * math.sqrt(v)) for v in (var_x, var_y)]
    assert meta["depths"][0, 0].item() == 2.0


def test_side_clamp_of_the_jacobian_matters_and_agrees():
    """A large Gaussian beside the frustum, where x/z passes 1.3 x the field of view."""
    tensors = scene(3, 16, opacity=(0.9, 0.95))
    with torch.no_grad():
        tensors[0].copy_(torch.tensor([[1.9, 0.1, 1.0], [-1.2, 1.5, 1.1], [0.0, 0.0, 3.0]]))
        tensors[2].copy_(torch.tensor([0.8, 0.4, 0.2]))
    found, expected = (draw_with_gradients(tensors, *camera(40, 40), 40, 40, b) for b in ("cpu", "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) < LIMIT, errors
    # A view wide enough for no clamp has another covariance: the clamp was active.
    matrices = [t.detach().double() for t in tensors[:3]], [t[0].double() for t in camera(40, 40)]
    clamped, wide = (reference.project(*matrices[0], *matrices[1], size, size, 0.3)[1] for size in (40, 4000))
    assert not torch.allclose(clamped[:2], wide[:2], rtol=0.1) and torch.equal(clamped[2], wide[2])


def test_cropping_a_view_changes_no_pixel():
    """Tiles lie elsewhere over the same Gaussians, so a pixel that depended on its tile would show."""
    tensors = [t.detach() for t in scene(400, 17, scale=0.08, spread=0.4)]
    viewmats, Ks = camera(96, 80)
    whole, _, _ = rasterization(*tensors, viewmats, Ks, 96, 80)
    for left, top in ((8, 5), (24, 16), (13, 9)):
        moved = Ks.clone()
        moved[0, 0, 2] -= left
        moved[0, 1, 2] -= top
        # The side clamp depends on the view's size, so all views are wider than the Gaussians' spread.
        part, _, _ = rasterization(*tensors, viewmats, moved, 96 - left, 80 - top)
        torch.testing.assert_close(part[0], whole[0, top:, left:], rtol=0, atol=2e-5)


def test_termination_stops_before_the_limit():
    """T would fall to 1e-4 or less: that Gaussian is not drawn. 0.5^13 = 1.2e-4 stays, 0.5^14 = 6e-5 would not."""
    n = 20
    tensors = [t.detach().clone() for t in scene(n, 18)]
    tensors[0][:] = torch.tensor([0.0, 0.0, 3.0])
    tensors[0][:, 2] += torch.arange(n) * 1e-3
    tensors[1][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    tensors[2][:], tensors[3][:] = 50.0, 0.5
    for backend in ("cpu", "reference"):
        _, alphas, _ = rasterization(*tensors, *camera(3, 3), 3, 3, backend=backend)
        assert alphas[0, 1, 1, 0].item() == pytest.approx(1 - 0.5**13, abs=2e-6)


def test_front_hides_back_whatever_the_order():
    front, back = (0.0, 0.0, 2.0), (0.0, 0.0, 4.0)
    for means, first in (([front, back], 0), ([back, front], 1)):
        tensors = [
            torch.tensor(means), torch.ones(2, 4), torch.full((2, 3), 0.5), torch.full((2,), 0.9), torch.eye(3)[:2]
        ]  # fmt: skip
        out, _, _ = rasterization(*tensors, *camera(9, 9), 9, 9)
        assert out[0, 4, 4, first] > 0.85 and out[0, 4, 4, 1 - first] < 0.1


def test_float16_float64_and_strided_inputs():
    tensors, (viewmats, Ks) = scene(100, 19), camera(30, 20)
    expected, _, _ = rasterization(*tensors, viewmats, Ks, 30, 20)
    double = [t.detach().double().requires_grad_() for t in tensors]
    out, _, _ = rasterization(*double, viewmats.double(), Ks.double(), 30, 20)
    assert torch.equal(out, expected)
    out.sum().backward()
    assert all(t.grad.dtype == torch.float64 and t.grad.abs().sum() > 0 for t in double)
    strided = [torch.stack([t.detach(), t.detach()], -1)[..., 0] for t in tensors]
    assert not strided[0].is_contiguous()
    assert torch.equal(rasterization(*strided, viewmats, Ks, 30, 20)[0], expected)
    half = [t.detach().half().requires_grad_() for t in tensors]
    out, _, _ = rasterization(*half, viewmats, Ks, 30, 20)
    rounded, _, _ = rasterization(*[t.detach().float() for t in half], viewmats, Ks, 30, 20)
    assert torch.equal(out, rounded)


def test_no_gradient_wanted():
    tensors = [t.detach() for t in scene(50, 20)]
    out, alphas, meta = rasterization(*tensors, *camera(20, 20), 20, 20)
    assert not (out.requires_grad or alphas.requires_grad or meta["means2d"].requires_grad)
    with torch.no_grad():
        again, _, meta = rasterization(*scene(50, 20), *camera(20, 20), 20, 20)
    assert torch.equal(out, again) and not meta["means2d"].requires_grad


def test_a_line_of_any_length_is_drawn():
    """Discs and lines up to 10^27 scene units long, some edge-on: in float64 p r - q^2 has no digit left of them."""
    tensors = scene(6, 21, opacity=(0.6, 0.9))
    with torch.no_grad():
        tensors[2].copy_(
            torch.tensor([[0, 1e27, 0], [1e-28, 2e14, 0], [1e12, 1e12, 0], [0, 0, 0], [5e17, 1e-9, 1], [1, 1e20, 1e20]])
        )
    with torch.no_grad():
        found, expected = (rasterization(*tensors, *camera(40, 40), 40, 40, backend=b)[0] for b in ("cpu", "reference"))
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1 / 255)
    assert float(expected.max()) > 0.3
