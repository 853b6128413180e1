"""The proxy of the planes' rate against its plain form, against closed forms, and beside what the coder spends."""

import math

import numpy as np
import pytest
import torch

from pd4dgs_codec.draw.plane_layout import PlaneLayout
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.model.plane_rate import exact_bits, proxy_bits, proxy_bits_reference
from pd4dgs_codec.scene import PLANES

SHAPES = {
    "two scales": [(5, 6, 7, 4), (10, 12, 14, 4)],
    "one cell": [(1, 1, 1, 1)],
    "one instant": [(3, 2, 4, 1)],
    "one row": [(1, 9, 1, 5)],
}


def _grid(layout: PlaneLayout, channels: int, spread: float = 0.3) -> torch.Tensor:
    """Values around 1 of some steps' spread, a third of them equal: ties are where predictors change over. Multiples
    of 2^-20, so that float32 holds their differences."""
    noise = torch.randn(layout.n_cells, channels, generator=torch.Generator().manual_seed(3))
    return _exact(1 + spread * torch.where(noise.abs() < 0.4, torch.zeros(()), noise)).requires_grad_()


def _exact(values: torch.Tensor) -> torch.Tensor:
    return (values * 2**20).round() / 2**20


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("channels", [8, 16])
def test_the_kernels_equal_the_reference(shape, channels):
    layout = PlaneLayout.build(SHAPES[shape])
    grid = _grid(layout, channels)
    expected = proxy_bits_reference(grid.double(), layout, 0.1).item()
    assert proxy_bits(grid, layout, 0.1).item() == pytest.approx(expected, rel=1e-6)
    smooth = grid.detach()  # where W, N and the plane through them tie, either side is a gradient
    noise = 0.1 * torch.rand(smooth.shape, generator=torch.Generator().manual_seed(5))
    grid = _exact(smooth + noise).requires_grad_()
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
    layout, step = PlaneLayout.build([(500, 1, 1, 1)]), float(np.float32(0.1))
    moves = spread * step * np.random.default_rng(1).laplace(size=(1, 500, 8))
    grid = torch.zeros(layout.n_cells, 8)
    for name in ("xy", "xz", "xt"):
        layout.views(grid)[0][name].copy_(torch.from_numpy(moves.cumsum(1)))
    planes = [{name: view.permute(2, 0, 1).numpy() for name, view in s.items()} for s in layout.views(grid)]
    assert float(proxy_bits(grid, layout, step)) == pytest.approx(exact_bits(tuple(planes), step), rel=0.12)


def test_the_exact_rate_is_the_coders(trained_like_scene):
    """The trainer's sum over planes, in the groups of `--priors gauss`, is what the encoder reports, within 2 %."""
    scene = trained_like_scene
    _, report = encode_with_report(scene, priors="gauss", omit="nothing", layers=2, effort=1, verify=False)
    for layer in (1, 2):
        coded = {s.name: s for s in report.layers[layer].streams}["planes"]
        own = exact_bits(scene.deformation(layer).planes, scene.steps.scaled(1.0).planes(layer))
        assert own == pytest.approx(coded.rate_bits, rel=0.02)
        cells = sum(plane.size for scale in scene.deformation(layer).planes for plane in scale.values())
        assert coded.symbols == cells


@pytest.fixture
def trained_like_scene():
    """Planes that wander by a step or two from cell to cell, with flat parts, as training leaves them."""
    from dataclasses import replace

    from strategies import make_scene

    scene = make_scene(4, anchors=200, extent=300, hidden=(8,), channels=8, sides=(24, 20, 16, 12), width=8)
    rng = np.random.default_rng(8)

    def wander(shape: tuple[int, ...], step: float) -> np.ndarray:
        steps = rng.normal(0, 1, shape) * (rng.random(shape) < 0.3)
        return (1 + step * steps.cumsum(1)).astype(np.float32)

    def field(deformation, step):
        planes = tuple({n: wander(s[n].shape, step) for n, _, _ in PLANES} for s in deformation.planes)
        return replace(deformation, planes=planes)

    return replace(
        scene,
        global_deformation=field(scene.global_deformation, scene.steps.planes_global),
        local_deformation=field(scene.local_deformation, scene.steps.planes_local),
    )
