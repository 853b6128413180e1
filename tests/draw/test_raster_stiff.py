"""Degenerate and extreme input: finite pictures and gradients, or a RenderError; never NaN, a hang or a crash."""

import pytest
import torch
from raster_scenes import NAMES, camera, draw_with_gradients, relative_errors, scene

from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.model.autograd.rasterization import rasterization

NAN, INF = float("nan"), float("inf")
NEAR = 0.01

#: (tensor, value put into Gaussians 0..2, must they be invisible)
VALUES = [
    *[("quats", (v, v, v, v), False) for v in (0.0, 1e-20, -1e20, 1e-45, 3e38)],
    *[("scales", v, False) for v in ((0.0,) * 3, (1e-20,) * 3, (0.5, 0.5, 0.0), (5.0, 1e-6, 1e-6), (-0.1,) * 3)],
    *[("scales", (v,) * 3, False) for v in (1e6, 1e18)],
    *[("means", (0.1, 0.0, z), True) for z in (NEAR, 0.0, -0.0, -3.0, 2e10)],
    *[("means", (0.1, 0.0, z), False) for z in (NEAR + 1e-7, 1e9, 1e10)],
    ("means", (0.0, 0.0, 0.0), True),
    ("means", (4.0, -3.0, NEAR + 1e-6), False),
    ("means", (1e8, 1e8, 1e9), False),
    ("means", (1e30, 0.0, 1.0), False),
    *[("opacities", v, True) for v in (0.0, 1 / 256, -0.5, INF)],
    *[("opacities", v, False) for v in (1 / 255, 1 / 255 + 1e-7, 1.0, 1.5, 1e30)],
    *[(name, v, True) for name in ("means", "quats", "scales", "opacities") for v in (NAN, INF, -INF)],
]


def _with(name, value, seed=0):
    tensors = scene(30, seed)
    with torch.no_grad():
        tensors[NAMES.index(name)][:3] = torch.as_tensor(value)
    return tensors


def _assert_finite(result):
    for key, value in result.items():
        if key != "meta":
            assert torch.isfinite(value).all(), key
    for key in ("means2d", "depths", "conics"):
        assert torch.isfinite(result["meta"][key]).all(), key


@pytest.mark.parametrize("name, value, invisible", VALUES)
@pytest.mark.parametrize("eps2d", [0.3, 0.0])
def test_one_bad_value(name, value, invisible, eps2d):
    tensors = _with(name, value)
    found = draw_with_gradients(tensors, *camera(40, 30), 40, 30, "cpu", eps2d=eps2d, near_plane=NEAR)
    _assert_finite(found)
    if not invisible:
        return
    assert (found["meta"]["radii"][0, :3] == 0).all()
    assert all((found["d " + k][:3] == 0).all() for k in NAMES)
    rest = draw_with_gradients([t[3:] for t in tensors], *camera(40, 30), 40, 30, "cpu", eps2d=eps2d, near_plane=NEAR)
    assert torch.equal(found["picture"], rest["picture"])  # the others are drawn as if it were not there
    assert all(torch.equal(found["d " + k][3:], rest["d " + k]) for k in NAMES)


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_bad_colours_and_backgrounds_are_refused(value):
    with pytest.raises(RenderError, match="colors"):
        rasterization(*_with("colors", value), *camera(8, 8), 8, 8)
    with pytest.raises(RenderError, match="backgrounds"):
        rasterization(*scene(5), *camera(8, 8), 8, 8, backgrounds=torch.tensor([[0.0, value, 0.0]]))


@pytest.mark.parametrize(
    "name, value",
    [
        ("quats", (0.0,) * 4), ("quats", (1e-20,) * 4), ("quats", (1e20,) * 4), ("quats", (3e38,) * 4),
        ("scales", (0.0,) * 3), ("scales", (5.0, 1e-6, 1e-6)), ("scales", (-0.1,) * 3),
        ("scales", (1e6,) * 3), ("opacities", 1.0), ("opacities", 1.5), ("opacities", 0.0),
        ("means", (0.1, 0.0, 1e9)), ("means", (0.05, 0.0, 0.02)),
    ],
)  # fmt: skip
def test_extreme_values_agree_with_the_oracle(name, value):
    tensors = _with(name, value, seed=1)
    found, expected = (draw_with_gradients(tensors, *camera(40, 30), 40, 30, b) for b in ("cpu", "reference"))
    for k, error in relative_errors(found, expected).items():
        if not (name == "quats" and k == "d quats"):  # 1e20 times larger than the others' gradients
            assert error < 2e-5, (k, error)


@pytest.mark.parametrize("scale", [1e6, 1e18, 3e37])
def test_enormous_gaussians_cover_the_view(scale):
    tensors = [t[:1] for t in _with("scales", (scale,) * 3)]
    _, alphas, meta = rasterization(*tensors, *camera(40, 30), 40, 30)
    torch.testing.assert_close(alphas, tensors[3].expand(1, 30, 40, 1), rtol=1e-5, atol=0)
    assert (meta["radii"] == 10**9).all() or scale == 1e6


def test_a_zero_quaternion_is_the_identity_without_gradient():
    zero, one = _with("quats", (0.0,) * 4), _with("quats", (1.0, 0.0, 0.0, 0.0))
    a, b = (draw_with_gradients(t, *camera(40, 30), 40, 30, "cpu") for t in (zero, one))
    assert torch.equal(a["picture"], b["picture"])
    assert (a["d quats"][:3] == 0).all() and (b["d quats"][:3] != 0).any()


@pytest.mark.parametrize("n, z", [(0, 1.0), (20, -1.0)])
def test_nothing_to_draw(n, z):
    tensors = scene(n)
    with torch.no_grad():
        tensors[0][:, 2] *= z
    background = torch.tensor([[0.25, 0.5, 0.75]])
    found = draw_with_gradients(tensors, *camera(20, 10), 20, 10, "cpu", background)
    assert (found["alphas"] == 0).all() and (found["picture"] == background.double()).all()
    assert all((found["d " + k] == 0).all() for k in NAMES)


@pytest.mark.parametrize("n, opacity", [(64, 1.0), (2000, 0.005)])
def test_coincident_gaussians(n, opacity):
    tensors = scene(n, 2)
    with torch.no_grad():
        tensors[0][:] = torch.tensor([0.1, -0.1, 3.0])
        tensors[1][:] = tensors[1][0].clone()
        tensors[2][:], tensors[3][:] = 0.4, opacity
    found, expected = (draw_with_gradients(tensors, *camera(16, 16), 16, 16, b) for b in ("cpu", "reference"))
    _assert_finite(found)
    errors = relative_errors(found, expected)
    assert errors["picture"] < 1e-5 and errors["d colors"] < 1e-4, errors


def test_opaque_centre_exactly_on_a_pixel():
    """alpha is clamped to 0.999 there: no gradient to opacity or position from that pixel, and T = 1e-3 behind it."""
    tensors = scene(2, 3)
    with torch.no_grad():
        tensors[0][:] = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
        tensors[2][:], tensors[3][:] = 0.001, 1.0
    found, expected = (draw_with_gradients(tensors, *camera(1, 1), 1, 1, b) for b in ("cpu", "reference"))
    assert found["alphas"].item() == pytest.approx(0.999, abs=1e-6)
    assert found["d opacities"][0] == 0 and (found["d means"][0] == 0).all()
    assert max(relative_errors(found, expected).values()) < 1e-5


def test_depth_ties_under_permutation():
    tensors = scene(80, 4, opacity=(0.3, 0.8))
    with torch.no_grad():
        tensors[0][:, 2] = 3.0
    out, _, _ = rasterization(*tensors, *camera(40, 30), 40, 30)
    for backend in ("cpu", "reference"):  # ties break by index in both
        again, _, _ = rasterization(*tensors, *camera(40, 30), 40, 30, backend=backend)
        torch.testing.assert_close(again.float(), out, rtol=1e-5, atol=1e-6)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    permuted, alphas, _ = rasterization(*[t[order] for t in tensors], *camera(40, 30), 40, 30)
    assert torch.isfinite(permuted).all() and not torch.allclose(permuted, out)
    tensors[0].data[:, 2] += torch.arange(80) * 1e-4
    out, _, _ = rasterization(*tensors, *camera(40, 30), 40, 30)
    permuted, _, _ = rasterization(*[t[order] for t in tensors], *camera(40, 30), 40, 30)
    assert torch.equal(permuted, out)  # without ties the order of the input does not matter


def test_near_and_far_off_axis():
    """The planes cut camera z, not distance."""
    means = torch.tensor([[0.9, 0.0, 2.0], [0.9, 0.0, 1.9], [-1.0, 0.0, 4.0], [-1.0, 0.0, 4.1]])
    tensors = [means, torch.ones(4, 4), torch.full((4, 3), 0.1), torch.full((4,), 0.5), torch.ones(4, 3)]
    _, _, meta = rasterization(*tensors, *camera(40, 30, focal=0.8), 40, 30, near_plane=1.95, far_plane=4.0)
    assert (meta["radii"][0, :, 0] > 0).tolist() == [True, False, True, False]


def test_radius_clip():
    tensors = scene(50, 5, scale=0.02)
    _, _, meta = rasterization(*tensors, *camera(40, 30), 40, 30)
    largest = meta["radii"][0].max(-1).values
    clip = int(largest[largest > 0].float().median())
    _, _, clipped = rasterization(*tensors, *camera(40, 30), 40, 30, radius_clip=clip)
    assert torch.equal(clipped["radii"][0, :, 0] > 0, largest > clip)


@pytest.mark.parametrize("gradient", [NAN, INF])
def test_a_bad_upstream_gradient_does_not_hang(gradient):
    tensors = scene(30, 6)
    out, _, _ = rasterization(*tensors, *camera(20, 20), 20, 20)
    weights = torch.zeros_like(out)
    weights[0, 10, 10, 0] = gradient
    out.backward(weights)  # passes on what is not finite; the trainer counts and skips the step
    assert not torch.isfinite(tensors[4].grad).all()
