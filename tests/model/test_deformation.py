"""A deformation: planes sampled by kernels, in plain torch and by definition; its regularisers and its rate."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from pd4dgs_codec import threads
from pd4dgs_codec.draw.hexplane import SPATIAL, TEMPORAL, TIME_AXIS, PlaneLayout
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.hexplane import HexPlane, _Sample, sample_reference
from pd4dgs_codec.model.networks import round_straight_through
from pd4dgs_codec.model.plane_terms import TERMS, proxy_bits, regularisers
from pd4dgs_codec.scene import HEADS, PLANES

BOX = np.array([[-1.0, -2.0, 0.5], [1.0, 3.0, 4.5]], np.float32)
SHAPES = [((7, 5, 9, 4), 8, (1, 2)), ((7, 1, 9, 1), 24, (1, 2, 3)), ((1, 2, 3, 2), 16, (1,))]


def scales(resolution, multires):
    return [(*(m * r for r in resolution[:3]), resolution[3]) for m in multires]


def plane_of(resolution=(7, 5, 9, 4), channels=8, multires=(1, 2), dtype=torch.float64, seed=0):
    plane = HexPlane(BOX, scales(resolution, multires), channels).to(dtype)
    with torch.no_grad():
        plane.grid.normal_(generator=torch.Generator().manual_seed(seed))
    return plane


def points_in(n, spread=1.3, dtype=torch.float64, seed=1):
    """Random points, some outside the box when spread > 1."""
    unit = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) - 0.5
    low, high = torch.tensor(BOX, dtype=dtype)
    return ((low + high) / 2 + unit * spread * (high - low)).requires_grad_()


def value_and_gradients(plane, features, points):
    weights = torch.linspace(-1, 1, features.numel(), dtype=features.dtype).view_as(features)
    return features.detach(), *torch.autograd.grad((features * weights).sum(), [plane.grid, points])


@pytest.mark.parametrize("t", [0.0, 0.37, 1.0, -3.0, 7.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_equals_reference(shape, t):
    plane, points = plane_of(*shape), points_in(200)
    fast = value_and_gradients(plane, plane(points, t), points)
    slow = value_and_gradients(plane, sample_reference(plane.grid, plane.layout, plane.box, points, t), points)
    torch.testing.assert_close(fast, slow, rtol=1e-10, atol=1e-12)
    assert fast[2].abs().sum() > 0


def test_gradcheck():
    plane = plane_of((3, 2, 3, 3), 8, (1,))
    points = points_in(4, spread=0.9)
    layout, box = plane.layout, plane.box.double()
    torch.autograd.gradcheck(lambda g, p: _Sample.apply(g, layout, box, p, 0.3, None), (plane.grid, points), eps=1e-6)
    torch.autograd.gradcheck(lambda g, p: sample_reference(g, layout, box, p, 0.3), (plane.grid, points), eps=1e-6)


def test_at_the_nodes_it_is_the_product_of_plane_cells():
    """Orientation, axis order, normalisation of points and time, concatenation: from the definition alone."""
    reso = (3, 4, 5, 6)
    plane = plane_of(reso, 8, (1, 2), torch.float32)
    arrays = plane.arrays()
    for cell in [(0, 0, 0, 0), (2, 3, 4, 5), (1, 2, 3, 4), (2, 0, 1, 3)]:
        unit = np.array(cell) / (np.array(reso) - 1)
        point = torch.tensor(BOX[0] + unit[:3] * (BOX[1] - BOX[0]), dtype=torch.float32)[None]
        found = plane(point, float(unit[3]))[0, :8].detach().numpy()
        expected = np.prod([arrays[0][name][:, cell[b], cell[a]] for name, a, b in PLANES], axis=0)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_start_values():
    plane = HexPlane(BOX, scales((9, 10, 12, 3), (1, 2)), 8)
    torch.manual_seed(3)
    plane.start()
    for scale in plane.arrays():
        for name, array in scale.items():
            if "t" in name:
                assert (array == 1).all()
                continue
            assert 0.5 <= array.min() < array.max() <= 1.5 and len(np.unique(array[:, 0, 0])) == 8
            ratio = np.abs(np.diff(array, 2, axis=1)).mean() / np.abs(np.diff(array, axis=1)).mean()
            assert ratio < 0.6  # linear between draws, up to the ends


def test_planes_draw_before_the_networks():
    """Another order would change every trained file."""
    torch.manual_seed(3)
    field = DeformationField.fresh(DeformationConfig(((9, 3),), 8, 4), BOX, {name: 3 for name in HEADS})
    planes = HexPlane(BOX, [(9, 9, 9, 3)], 8)
    torch.manual_seed(3)
    planes.start()
    assert torch.equal(field.planes.grid, planes.grid)


@pytest.mark.parametrize("channels", [8, 5])
def test_rounding_is_straight_through(channels):
    plane, points, step = plane_of(channels=channels), points_in(100), 0.25
    rounded = plane_of(channels=channels)
    with torch.no_grad():
        rounded.grid.copy_(round_straight_through(plane.grid, step))
    assert not torch.equal(rounded.grid, plane.grid)
    found = value_and_gradients(plane, plane(points, 0.4, step=step), points)
    expected = value_and_gradients(rounded, rounded(points, 0.4), points)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("channels", [8, 5])
def test_no_points(channels):
    plane = plane_of(channels=channels)
    points = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
    features = plane(points, 0.5)
    assert features.shape == (0, 2 * channels)
    features.sum().backward()
    assert plane.grid.grad.eq(0).all() and points.grad.shape == (0, 3)


@pytest.mark.skipif(threads.available() < 2, reason="needs two CPUs")
@pytest.mark.parametrize("multires", [(1,), (1, 2)])
def test_threads(multires, kernel_threads):
    """Bitwise repeatable; one scale on two threads is split over points, two scales are not and so equal one thread."""
    plane, points = plane_of(multires=multires, dtype=torch.float32), points_in(501, dtype=torch.float32)
    runs = {}
    for name, count in (("one", 1), ("two", 2), ("again", 2)):
        kernel_threads(count)
        runs[name] = value_and_gradients(plane, plane(points, 0.3), points)
    for one, two, again in zip(*runs.values(), strict=True):
        assert torch.equal(two, again)
        assert torch.equal(one, two) if len(multires) == 2 else torch.allclose(one, two, rtol=1e-4, atol=1e-5)


def regularisers_reference(grid: Tensor, layout: PlaneLayout) -> dict[str, Tensor]:
    """The plain torch form of `regularisers`."""

    def bend(plane: Tensor, axis: int) -> Tensor:
        n = plane.shape[axis]
        if n < 3:
            return plane.new_zeros(())
        before, here, after = (plane.narrow(axis, first, n - 2) for first in range(3))
        return (before - 2 * here + after).square().mean()

    terms = {name: grid.new_zeros(()) for name in TERMS}
    for scale in layout.views(grid):
        for name, _, _ in SPATIAL:
            terms["plane_smooth"] = terms["plane_smooth"] + bend(scale[name], 0) + bend(scale[name], 1)
        for name, _, _ in TEMPORAL:
            terms["time_smooth"] = terms["time_smooth"] + bend(scale[name], 0)
            terms["time_l1"] = terms["time_l1"] + (1 - scale[name]).abs().mean()
    return terms


@pytest.mark.parametrize("shape", [*SHAPES, ((4, 3, 6, 3), 8, (1,)), ((7, 5, 9, 4), 5, (1, 2))])
def test_regularisers_equal_reference(shape):
    plane = plane_of(*shape, dtype=torch.float32)
    results = []
    for form, grid in ((regularisers, plane.grid), (regularisers_reference, plane.grid.detach().double())):
        terms = form(grid.requires_grad_(), plane.layout)
        total = sum(w * terms[name] for w, name in zip((0.3, 0.7, -0.2), TERMS, strict=True))
        results.append((*(terms[name].detach() for name in TERMS), torch.autograd.grad(total, grid)[0]))
    for found, expected in zip(*results, strict=True):
        assert float((found - expected).abs().max()) <= 2e-6 * float(expected.abs().max())


def test_regularisers_by_definition():
    """A parabola a i^2 along an axis has second difference 2 a; a ramp has none; time planes at 1 are free."""
    plane = HexPlane(BOX, [(6, 5, 4, 7)], 8)
    (views,) = plane.layout.views(plane.grid.detach())
    for name in ("xy", "xz", "yz"):
        views[name].copy_(3.0 * torch.arange(views[name].shape[1])[None, :, None])
    assert all(abs(float(v.detach())) < 1e-20 for v in regularisers(plane.grid, plane.layout).values())
    views["xy"].copy_(0.5 * torch.arange(6)[None, :, None] ** 2)
    views["yz"].copy_(1.5 * torch.arange(4)[:, None, None] ** 2)
    views["xt"].copy_(torch.arange(7)[:, None, None] ** 2)
    terms = {name: term.detach() for name, term in regularisers(plane.grid, plane.layout).items()}
    assert float(terms["plane_smooth"]) == pytest.approx(1.0 + 9.0)
    assert float(terms["time_smooth"]) == pytest.approx(4.0)
    assert float(terms["time_l1"]) == pytest.approx(np.abs(1 - np.arange(7) ** 2).mean())


def test_layout_covers_every_cell_once():
    layout = PlaneLayout.build([(2, 3, 4, 5), (4, 6, 8, 5)])
    grid = torch.zeros(layout.n_cells, 1)
    for scale in layout.views(grid):
        for view in scale.values():
            view += 1
    assert grid.eq(1).all() and layout.n_spatial == 6 + 8 + 12 + 24 + 32 + 48


# -- rate --------------------------------------------------------------------------------------------------------------

LAYOUTS = {
    "two scales": [(5, 6, 7, 4), (10, 12, 14, 4)],
    "one cell": [(1, 1, 1, 1)],
    "one instant": [(3, 2, 4, 1)],
    "one row": [(1, 9, 1, 5)],
}


def grid_of(layout: PlaneLayout, channels: int, spread: float = 0.3) -> torch.Tensor:
    """Values around 1 of some steps' spread, a third of them equal: ties are where predictors change over. Multiples
    of 2^-20, so that float32 holds their differences."""
    noise = torch.randn(layout.n_cells, channels, generator=torch.Generator().manual_seed(3))
    return exact(1 + spread * torch.where(noise.abs() < 0.4, torch.zeros(()), noise)).requires_grad_()


def exact(values: torch.Tensor) -> torch.Tensor:
    return (values * 2**20).round() / 2**20


def proxy_bits_reference(grid: Tensor, layout: PlaneLayout, step: float) -> Tensor:
    """The plain torch form of `proxy_bits`."""
    scale, total = 2 * math.e / step, grid.new_zeros(())
    for planes in layout.views(grid):
        for name, _, b in PLANES:
            r = _residuals(planes[name], b == TIME_AXIS).abs()
            cells, channels = r.shape[0] * r.shape[1], r.shape[2]
            by_channel = torch.log2(1 + scale * r.mean((0, 1))).sum() * cells
            by_cell = torch.log2(1 + scale * r.mean(2)).sum() * channels
            total = total + 0.5 * (by_channel + by_cell)
    return total


def _residuals(x: Tensor, temporal: bool) -> Tensor:
    """Returns the residuals of a plane [H, W, C], 0 for its first value."""
    first_row = torch.cat([torch.zeros_like(x[:1, :1]), x[:1, 1:] - x[:1, :-1]], dim=1)
    if temporal:
        return torch.cat([first_row, x[1:] - x[:-1]])
    w, n, nw = x[1:, :-1], x[:-1, 1:], x[:-1, :-1]
    low, high = torch.minimum(w, n), torch.maximum(w, n)
    inner = x[1:, 1:] - torch.maximum(low, torch.minimum(high, w + n - nw))
    return torch.cat([first_row, torch.cat([x[1:, :1] - x[:-1, :1], inner], dim=1)])


@pytest.mark.parametrize("shape", LAYOUTS)
@pytest.mark.parametrize("channels", [8, 16, 5])
def test_the_kernels_equal_the_reference(shape, channels):
    layout = PlaneLayout.build(LAYOUTS[shape])
    grid = grid_of(layout, channels)
    expected = proxy_bits_reference(grid.double(), layout, 0.1).item()
    assert proxy_bits(grid, layout, 0.1).item() == pytest.approx(expected, rel=1e-6)
    smooth = grid.detach()  # where W, N and the plane through them tie, either side is a gradient
    noise = 0.1 * torch.rand(smooth.shape, generator=torch.Generator().manual_seed(5))
    grid = exact(smooth + noise).requires_grad_()
    wide = grid.detach().double().requires_grad_()
    (3 * proxy_bits(grid, layout, 0.1)).backward()
    (3 * proxy_bits_reference(wide, layout, 0.1)).backward()
    torch.testing.assert_close(grid.grad.double(), wide.grad, rtol=1e-6, atol=2e-6 * float(wide.grad.abs().max()))


def test_flat_planes_are_free_and_one_bump_costs_what_the_formula_says():
    layout = PlaneLayout.build([(4, 4, 4, 3)])
    grid = torch.full((layout.n_cells, 8), 0.75)
    assert float(proxy_bits(grid, layout, 0.1)) == 0
    grid[int(layout.start[0, 2]) + 1, 5] += 0.2  # xt, first instant, second place: the right, and the next instant
    first, second, third = (1 + 2 * math.e * x / 0.1 for x in (0.6 / 12, 0.2 / 8, 0.2 / 8))
    expected = 0.5 * (12 * math.log2(first) + 8 * (math.log2(second) + 2 * math.log2(third)))
    assert float(proxy_bits(grid, layout, 0.1)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("spread", [1.0, 4.0])
def test_the_proxy_is_near_the_exact_rate(spread):
    """Lines whose steps are Laplacian, of `spread` quantisation steps on average: within 12 %."""
    planes, step = HexPlane(BOX, [(500, 1, 1, 1)], 8), float(np.float32(0.1))
    moves = spread * step * np.random.default_rng(1).laplace(size=(1, 500, 8))
    for name in ("xy", "xz", "xt"):
        planes.layout.views(planes.grid.detach())[0][name].copy_(torch.from_numpy(moves.cumsum(1)))
    assert planes.rate(planes.grid, step).item() == pytest.approx(planes.bits(step), rel=0.12)
