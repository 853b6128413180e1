"""`rasterization`: both backends against the float64 oracle, the oracle by finite differences and by hand; refusals."""

import importlib.metadata
import math
import sys
import types
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from pd4dgs_codec import threads
from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.model import reference
from pd4dgs_codec.model.picture import check_gsplat, rasterization, rasterize_gsplat
from pd4dgs_codec.scene import Camera

LIMIT = 1e-5
needs_two = pytest.mark.skipif(threads.available() < 2, reason="needs 2 CPUs")
NAMES = ("means", "quats", "scales", "opacities", "colors")


def camera(width, height, focal=1.2, shift=(0.0, 0.0)) -> Camera:
    """At the origin looking along z; shift moves the principal point, pixels."""
    f = focal * width
    K = np.array([[f, 0, width / 2 + shift[0]], [0, 1.1 * f, height / 2 + shift[1]], [0, 0, 1]], np.float32)
    return Camera(np.eye(4, dtype=np.float32), K, width, height)


def turned_camera(width, height) -> Camera:
    """A camera that is moved, rotated about two axes and off-centre."""
    (c, s), (d, e) = ((np.cos(a), np.sin(a)) for a in (0.3, -0.2))
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3] = np.array([[1, 0, 0], [0, d, -e], [0, e, d]]) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    viewmat[:3, 3] = -0.8, 0.3, 0.4
    return replace(camera(width, height, shift=(3.3, -2.6)), viewmat=viewmat)


def scene(n, seed=0, scale=0.1, spread=1.0, opacity=(0.05, 0.95)):
    """Leaf tensors (means, quats, scales, opacities, colors) of n Gaussians at depths 2..6 in a 1.2-focal view."""
    g = torch.Generator().manual_seed(seed)
    z = torch.rand(n, generator=g) * 4 + 2
    xy = (torch.rand(n, 2, generator=g) - 0.5) * spread / 1.2 * z[:, None]
    tensors = [
        torch.cat([xy, z[:, None]], -1),
        torch.randn(n, 4, generator=g),
        torch.exp(torch.randn(n, 3, generator=g) * 0.6) * scale,
        torch.rand(n, generator=g) * (opacity[1] - opacity[0]) + opacity[0],
        torch.rand(n, 3, generator=g),
    ]
    return [t.requires_grad_() for t in tensors]


def with_values(name, value, seed=0):
    """Thirty Gaussians of which the first three have `value` in the tensor `name`."""
    tensors = scene(30, seed)
    with torch.no_grad():
        tensors[NAMES.index(name)][:3] = torch.as_tensor(value)
    return tensors


def draw_with_gradients(tensors, view, backend, background=(0.0, 0.0, 0.0), **options):
    """dict of the picture, and of the gradients of a random weighting of it, all float64."""
    leaves = [t.detach().clone().requires_grad_() for t in tensors]
    image, alpha, meta = rasterization(*leaves, view, background, backend=backend, **options)
    g = torch.Generator().manual_seed(0)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t.device) for t in (image, alpha)]
    ((image.double() * weights[0]).sum() + (alpha.double() * weights[1]).sum()).backward()
    result = {"picture": image.detach().double(), "alpha": alpha.detach().double()}
    for name, leaf in zip(NAMES, leaves, strict=True):
        result["d " + name] = torch.zeros_like(leaf).double() if leaf.grad is None else leaf.grad.double()
    return result | {"d means2d": meta["means2d"].grad.double(), "meta": meta}


def relative_errors(found, expected):
    """||found - expected|| / ||expected|| of every tensor of two draw_with_gradients results."""
    names = expected.keys() - {"meta"}
    return {k: float((found[k] - expected[k]).norm() / expected[k].norm().clamp(min=1e-12)) for k in names}


def oracle_errors(tensors, view, background=(0.0, 0.0, 0.0)):
    """(relative errors of the CPU backend against the oracle, the result of the one, that of the other)."""
    found, expected = (draw_with_gradients(tensors, view, backend, background) for backend in ("cpu", "reference"))
    return relative_errors(found, expected), found, expected


CASES = {
    "plain": (scene(300, 1), camera(50, 40)),
    "turned": (scene(300, 2), turned_camera(50, 40)),
    "one pixel": (scene(30, 3), camera(1, 1)),
    "one row": (scene(60, 4), camera(70, 1)),
    "tile edges": (scene(200, 5, scale=0.05), camera(64, 32)),
    "small": (scene(2000, 6, scale=0.004), camera(48, 33)),
    "huge": (scene(40, 7, scale=3.0, opacity=(0.02, 0.3)), camera(40, 40)),
    "wide": (scene(300, 8, spread=4.0, scale=0.4), camera(33, 50, focal=0.5)),
    "dense": (scene(1500, 9, scale=0.3, opacity=(0.3, 0.999)), camera(24, 24)),
    "off centre": (scene(300, 10), camera(40, 40, shift=(17.0, -9.5))),
}


@pytest.mark.parametrize("name", CASES)
def test_kernels_agree_with_the_oracle(name):
    errors, found, expected = oracle_errors(*CASES[name], (0.2, -0.5, 0.9))
    assert max(errors.values()) < LIMIT, errors
    assert expected["alpha"].max() > 0.05  # something was drawn
    for key in ("radii", "means2d"):
        torch.testing.assert_close(found["meta"][key].double(), expected["meta"][key].double(), rtol=1e-5, atol=1e-5)


def test_needles_keep_their_digits():
    tensors = scene(200, 11, opacity=(0.3, 0.9))
    with torch.no_grad():
        tensors[2].copy_(torch.tensor([1.5, 1e-4, 1e-4]))
    errors, *_ = oracle_errors(tensors, camera(64, 48))
    assert max(errors.values()) < 2 * LIMIT, errors


def test_oracle_gradients_by_finite_differences():
    tensors = [t.detach().double().requires_grad_() for t in scene(6, 15, scale=0.25, opacity=(0.3, 0.7))]

    def draw(*leaves):
        # Far inside the extents, alpha stays clear of 1/255: the whole window is within 3.3 sigma of every Gaussian.
        leaves = (leaves[0] * torch.tensor([0.2, 0.2, 1.0]), leaves[1], leaves[2] + 1.0, *leaves[3:])
        return rasterization(*leaves, camera(6, 5), backend="reference")[:2]

    assert torch.autograd.gradcheck(draw, tensors, eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_one_gaussian_by_hand(backend):
    values = ((0.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0), (0.2,) * 3, 0.6, (1.0, 0.5, 0.25))
    tensors = [torch.tensor([v]) for v in values]
    image, alphas, meta = rasterization(*tensors, camera(33, 33, focal=1.0), (0.0, 0.0, 1.0), backend=backend)
    # On the optical axis J is diagonal: variance (f s / z)^2 + 0.3, fx = 33, fy = 36.3; the axis meets pixel (16, 16).
    var_x, var_y = (33 * 0.2 / 2) ** 2 + 0.3, (36.3 * 0.2 / 2) ** 2 + 0.3
    for dx, dy in ((0, 0), (2, 0), (0, -3), (-4, 5)):
        alpha = 0.6 * math.exp(-0.5 * (dx * dx / var_x + dy * dy / var_y))
        assert alphas[16 + dy, 16 + dx].item() == pytest.approx(alpha, rel=1e-6)
        expected = [alpha, 0.5 * alpha, 0.25 * alpha + 1 - alpha]
        assert image[16 + dy, 16 + dx].tolist() == pytest.approx(expected, rel=1e-6)
    extent = math.sqrt(2 * math.log(255 * 0.6))
    assert meta["radii"][0, 0].tolist() == [math.ceil(extent * math.sqrt(v)) for v in (var_x, var_y)]


def test_side_clamp_of_the_jacobian_matters_and_agrees():
    """A large Gaussian beside the frustum, where x/z passes 1.3 x the field of view."""
    tensors = scene(3, 16, opacity=(0.9, 0.95))
    with torch.no_grad():
        tensors[0].copy_(torch.tensor([[1.9, 0.1, 1.0], [-1.2, 1.5, 1.1], [0.0, 0.0, 3.0]]))
        tensors[2].copy_(torch.tensor([0.8, 0.4, 0.2]))
    view = camera(40, 40)
    errors, *_ = oracle_errors(tensors, view)
    assert max(errors.values()) < LIMIT, errors
    # A view wide enough for no clamp has another covariance: the clamp was active.
    matrices = [t.detach().double() for t in (*tensors[:3], *map(torch.from_numpy, (view.viewmat, view.K)))]
    clamped, wide = (reference.project(*matrices, size, size)[1] for size in (40, 4000))
    assert not torch.allclose(clamped[:2], wide[:2], rtol=0.1) and torch.equal(clamped[2], wide[2])


def test_cropping_a_view_changes_no_pixel():
    """Tiles lie elsewhere over the same Gaussians, so a pixel that depended on its tile would show."""
    tensors, view = [t.detach() for t in scene(400, 17, scale=0.08, spread=0.4)], camera(96, 80)
    whole, _, _ = rasterization(*tensors, view)
    for left, top in ((8, 5), (24, 16), (13, 9)):
        K = view.K - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]], np.float32)
        # The side clamp depends on the view's size, so all views are wider than the Gaussians' spread.
        part, _, _ = rasterization(*tensors, replace(view, K=K, width=96 - left, height=80 - top))
        torch.testing.assert_close(part, whole[top:, left:], rtol=0, atol=2e-5)


def test_termination_stops_before_the_limit():
    """T would fall to 1e-4 or less: that Gaussian is not drawn. 0.5^13 = 1.2e-4 stays, 0.5^14 = 6e-5 would not."""
    n = 20
    tensors = [t.detach().clone() for t in scene(n, 18)]
    tensors[0][:] = torch.tensor([0.0, 0.0, 3.0])
    tensors[0][:, 2] += torch.arange(n) * 1e-3
    tensors[1][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    tensors[2][:], tensors[3][:] = 50.0, 0.5
    for backend in ("cpu", "reference"):
        _, alpha, _ = rasterization(*tensors, camera(3, 3), backend=backend)
        assert alpha[1, 1].item() == pytest.approx(1 - 0.5**13, abs=2e-6)


def test_front_hides_back_whatever_the_order():
    front, back = (0.0, 0.0, 2.0), (0.0, 0.0, 4.0)
    rest = torch.ones(2, 4), torch.full((2, 3), 0.5), torch.full((2,), 0.9), torch.eye(3)[:2]
    for means, first in (([front, back], 0), ([back, front], 1)):
        image, _, _ = rasterization(torch.tensor(means), *rest, camera(9, 9))
        assert image[4, 4, first] > 0.85 and image[4, 4, 1 - first] < 0.1


def test_float16_float64_and_strided_inputs():
    tensors, view = scene(100, 19), camera(30, 20)
    expected, _, _ = rasterization(*tensors, view)
    double = [t.detach().double().requires_grad_() for t in tensors]
    image, _, _ = rasterization(*double, view)
    assert torch.equal(image, expected)
    image.sum().backward()
    assert all(t.grad.dtype == torch.float64 and t.grad.abs().sum() > 0 for t in double)
    strided = [torch.stack([t.detach(), t.detach()], -1)[..., 0] for t in tensors]
    assert not strided[0].is_contiguous()
    assert torch.equal(rasterization(*strided, view)[0], expected)
    half = [t.detach().half().requires_grad_() for t in tensors]
    rounded, _, _ = rasterization(*[t.detach().float() for t in half], view)
    assert torch.equal(rasterization(*half, view)[0], rounded)


def test_no_gradient_wanted():
    for tensors, enabled in (([t.detach() for t in scene(50, 20)], True), (scene(50, 20), False)):
        with torch.set_grad_enabled(enabled):
            image, alpha, meta = rasterization(*tensors, camera(20, 20))
        assert not (image.requires_grad or alpha.requires_grad or meta["means2d"].requires_grad)


def test_second_derivatives_are_refused():
    tensors = scene(5)
    image, _, _ = rasterization(*tensors, camera(8, 8))
    (first,) = torch.autograd.grad(image.square().sum(), tensors[4], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiat"):
        first.sum().backward()


# -- threads: the same bits for any number of them, at once from two callers -------------------------------------------


def _draw_in_threads(count, seed=0):
    threads.set_kernel_threads(count)
    return draw_with_gradients(scene(3000, seed, scale=0.04), camera(150, 110), "cpu")


def _same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a if k != "meta")


@needs_two
@pytest.mark.usefixtures("kernel_threads")
def test_one_and_two_threads_give_the_same_bits():
    one, two, again = _draw_in_threads(1), _draw_in_threads(2), _draw_in_threads(2)
    assert _same(one, two) and _same(two, again)
    assert not _same(one, _draw_in_threads(1, seed=1))


@needs_two
@pytest.mark.usefixtures("kernel_threads")
def test_two_callers_at_once():
    expected = [_draw_in_threads(2, seed) for seed in (0, 1)]
    results = ThreadPoolExecutor(2).map(lambda n: [_draw_in_threads(2, n) for _ in range(5)], (0, 1), timeout=120)
    for n, found in enumerate(results):
        assert len(found) == 5 and all(_same(each, expected[n]) for each in found)


# -- degenerate and extreme input --------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
NEAR = 0.01
VIEW = camera(40, 30)


@pytest.mark.parametrize(
    "name, value",
    [
        *[("quats", (v,) * 4) for v in (-1e20, 1e-45)],
        *[("scales", (v,) * 3) for v in (1e6, 1e18)],
        *[("means", v) for v in ((0.1, 0.0, 1e10), (4.0, -3.0, NEAR + 1e-6), (1e8, 1e8, 1e9), (1e30, 0.0, 1.0))],
        *[("opacities", v) for v in (1 / 256, 1.0, 1e30, INF)],
    ],
)
def test_extreme_values_give_finite_pictures_and_gradients(name, value):
    """Beside the values that `tests/stability` holds against the oracle."""
    found = draw_with_gradients(with_values(name, value), VIEW, "cpu", near_plane=NEAR)
    assert all(torch.isfinite(tensor).all() for key, tensor in found.items() if key != "meta")
    assert torch.isfinite(found["meta"]["means2d"]).all()


@pytest.mark.parametrize("scale", [1e6, 1e18, 3e37])
def test_enormous_gaussians_cover_the_view(scale):
    tensors = [t[:1] for t in with_values("scales", (scale,) * 3)]
    _, alpha, meta = rasterization(*tensors, VIEW)
    torch.testing.assert_close(alpha, tensors[3].expand(30, 40), rtol=1e-5, atol=0)
    assert (meta["radii"] == 10**9).all() or scale == 1e6


def test_a_line_of_any_length_is_drawn():
    """Discs and lines up to 10^27 scene units long, some edge-on: in float64 p r - q^2 has no digit left of them."""
    tensors = scene(6, 21, opacity=(0.6, 0.9))
    with torch.no_grad():
        tensors[2].copy_(
            torch.tensor([[0, 1e27, 0], [1e-28, 2e14, 0], [1e12, 1e12, 0], [0, 0, 0], [5e17, 1e-9, 1], [1, 1e20, 1e20]])
        )
        found, expected = (rasterization(*tensors, camera(40, 40), backend=b)[0] for b in ("cpu", "reference"))
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1 / 255)
    assert float(expected.max()) > 0.3


def test_a_zero_quaternion_is_the_identity_without_gradient():
    zero, one = with_values("quats", (0.0,) * 4), with_values("quats", (1.0, 0.0, 0.0, 0.0))
    a, b = (draw_with_gradients(t, VIEW, "cpu") for t in (zero, one))
    assert torch.equal(a["picture"], b["picture"])
    assert (a["d quats"][:3] == 0).all() and (b["d quats"][:3] != 0).any()


def test_depth_ties_under_permutation():
    tensors = scene(80, 4, opacity=(0.3, 0.8))
    with torch.no_grad():
        tensors[0][:, 2] = 3.0
    image, _, _ = rasterization(*tensors, VIEW)
    for backend in ("cpu", "reference"):  # ties break by index in both
        again, _, _ = rasterization(*tensors, VIEW, backend=backend)
        torch.testing.assert_close(again.float(), image, rtol=1e-5, atol=1e-6)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    permuted, _, _ = rasterization(*[t[order] for t in tensors], VIEW)
    assert torch.isfinite(permuted).all() and not torch.allclose(permuted, image)
    tensors[0].data[:, 2] += torch.arange(80) * 1e-4
    image, _, _ = rasterization(*tensors, VIEW)
    permuted, _, _ = rasterization(*[t[order] for t in tensors], VIEW)
    assert torch.equal(permuted, image)  # without ties the order of the input does not matter


def test_the_near_plane_cuts_z_and_not_distance():
    means = torch.tensor([[0.9, 0.0, 2.0], [0.9, 0.0, 1.9], [-1.0, 0.0, 4.0]])
    tensors = [means, torch.ones(3, 4), torch.full((3, 3), 0.1), torch.full((3,), 0.5), torch.ones(3, 3)]
    _, _, meta = rasterization(*tensors, camera(40, 30, focal=0.8), near_plane=1.95)
    assert (meta["radii"][0, :, 0] > 0).tolist() == [True, False, True]


@pytest.mark.parametrize("gradient", [NAN, INF])
def test_a_bad_upstream_gradient_does_not_hang(gradient):
    tensors = scene(30, 6)
    image, _, _ = rasterization(*tensors, camera(20, 20))
    weights = torch.zeros_like(image)
    weights[10, 10, 0] = gradient
    image.backward(weights)  # passes on what is not finite; the trainer counts and skips the step
    assert not torch.isfinite(tensors[4].grad).all()


# -- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, word",
    [({"backend": "opengl"}, "backend"), ({"backend": "gsplat"}, "gsplat"), ({"near_plane": -1.0}, "near_plane")],
)
def test_options_that_are_refused(options, word):
    """Those of drawing arrays, which are checked alike, are in tests/draw/test_rasteriser.py."""
    with pytest.raises(RenderError, match=word) as caught:
        rasterization(*scene(5), camera(8, 8), **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_types_that_are_refused(name):
    for change in (lambda t: t[:-1], lambda t: t[..., None], lambda t: t.int(), lambda t: t.tolist()):
        tensors = [t.detach() for t in scene(5)]
        tensors[NAMES.index(name)] = change(tensors[NAMES.index(name)])
        with pytest.raises(RenderError, match="expected"):
            rasterization(*tensors, camera(8, 8))


# -- gsplat: the adapter with a stand-in module; with CUDA, the real one against the CPU -------------------------------


def install(monkeypatch, version):
    """Makes a stand-in for gsplat importable; returns the list of its calls."""
    calls = []

    def fake(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        calls.append((means, quats, scales, opacities, viewmats, Ks, options))
        meta = {"means2d": means[None, :, :2] * 2, "radii": 0, "depths": 1, "conics": 2}
        return torch.zeros(1, height, width, 3), torch.zeros(1, height, width, 1), meta

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=fake))
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    return calls


def rasterize_with_gsplat(tensors):
    return rasterize_gsplat(tensors, camera(8, 6), np.zeros(3, np.float32), NEAR)


@pytest.mark.parametrize("version", ["1.6.0", "2.0.1", "1.4.0"])
def test_other_versions_of_gsplat_are_refused(monkeypatch, version):
    install(monkeypatch, version)
    with pytest.raises(RenderError, match=version):
        rasterize_with_gsplat(scene(4))


def test_missing_gsplat_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.5.3")
    with pytest.raises(RenderError, match="install"):
        rasterize_with_gsplat(scene(4))


@pytest.mark.parametrize("kernels, says", [(object(), None), (None, "no CUDA kernels"), ("absent", "do not load")])
def test_the_check_of_gsplat_wants_its_compiled_kernels(monkeypatch, kernels, says):
    install(monkeypatch, "1.5.3")
    monkeypatch.setitem(sys.modules, "gsplat.cuda", types.SimpleNamespace())
    backend = None if kernels == "absent" else types.SimpleNamespace(_C=kernels)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    if says is None:
        check_gsplat()
        return
    with pytest.raises(RenderError, match=says) as caught:
        check_gsplat()
    assert "\n" not in str(caught.value)


def test_arguments_that_gsplat_gets(monkeypatch):
    calls, tensors = install(monkeypatch, "1.5.3+pt24cu124"), scene(4)
    with torch.no_grad():
        tensors[0][0, 0], tensors[3][1] = NAN, INF
        tensors[1][2] = 0.0
    image, alpha, meta = rasterize_with_gsplat(tensors)
    means, quats, _, opacities, viewmats, Ks, options = calls[0]
    assert options["packed"] is False and options["rasterize_mode"] == "classic"
    assert options["eps2d"] == 0.3 and options["near_plane"] == NEAR and options["far_plane"] == 1e10
    assert torch.isfinite(means).all() and opacities[:2].tolist() == [0.0, 0.0] and opacities[3] == tensors[3][3]
    assert quats[2].tolist() == [1.0, 0.0, 0.0, 0.0] and viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
    assert set(meta) == {"means2d", "radii"} and image.shape == (6, 8, 3) and alpha.shape == (6, 8)
    meta["means2d"].sum().backward()
    assert meta["means2d"].grad is not None and torch.isfinite(tensors[0].grad).all()


def test_gsplat_is_not_asked_to_draw_nothing(monkeypatch):
    """gsplat 1.5.3 divides by the number of Gaussians and ends the process."""
    calls, tensors = install(monkeypatch, "1.5.3"), scene(0)
    image, alpha, meta = rasterize_gsplat(tensors, camera(8, 6), np.full(3, 0.5, np.float32), NEAR)
    assert not calls and (image == 0.5).all() and image.shape == (6, 8, 3) and not alpha.any()
    assert meta["means2d"].shape == meta["radii"].shape == (1, 0, 2)
    image.sum().backward()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_gsplat_draws_what_the_cpu_draws():
    pytest.importorskip("gsplat")
    tensors, background = scene(300, 1), (0.2, 0.4, 0.9)
    expected = draw_with_gradients(tensors, camera(50, 40), "cpu", background)
    found = draw_with_gradients([t.detach().cuda() for t in tensors], camera(50, 40), "gsplat", background)
    errors = relative_errors({k: v.cpu() for k, v in found.items() if k != "meta"}, expected)
    assert max(errors.values()) < 1e-3, errors
