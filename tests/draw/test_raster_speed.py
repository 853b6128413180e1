"""Speed, as ratios within one run, on quiet cores: `pytest -m slow`."""

import time

import pytest
import torch
from raster_scenes import camera, scene

from pd4dgs_codec import threads
from pd4dgs_codec.model import reference
from pd4dgs_codec.model.picture import rasterization

pytestmark = pytest.mark.slow
TILE = 16


def _seconds(function, repeat=5):
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


@pytest.mark.skipif(threads.available() < 2, reason="needs 2 CPUs")
def test_two_threads_are_faster():
    """Goal: 1.7 x at 20,000 Gaussians on two quiet cores."""
    tensors, view = scene(20_000, 0, scale=0.02), camera(256, 256)
    weights = torch.randn(256, 256, 3)

    def step(count):
        threads.set_kernel_threads(count)
        torch.autograd.backward(rasterization(*tensors, view)[0], weights)

    step(2)
    one, two = (_seconds(lambda n=n: step(n), 15) for n in (1, 2))
    print(f"one thread / two threads: {one / two:.2f}")
    assert one / two > 1.4


def _tile_looped_torch(tensors, viewmat, K, width, height):
    """float32 torch, autograd, a Python loop over 16 x 16 tiles: the usual plain implementation."""
    means2d, covariance, det, depths = reference.project(*tensors[:3], viewmat, K, width, height)
    p, q, r = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    conics = torch.stack([r, -q, p], -1) / det[:, None]
    order = torch.argsort(depths.detach())
    means2d, conics, opacities, colors = (t[order] for t in (means2d, conics, tensors[3], tensors[4]))
    radii = 3.33 * torch.sqrt(torch.stack([p, r], -1).detach())[order]
    low, high = (means2d.detach() + s * radii for s in (-1, 1))
    rows = []
    for y in range(0, height, TILE):
        row = []
        for x in range(0, width, TILE):
            corner = torch.tensor([x, y])
            hit = torch.nonzero(((high > corner) & (low < corner + TILE)).all(-1))[:, 0]
            out, _ = reference.composite(means2d[hit] - corner, conics[hit], opacities[hit], colors[hit], TILE, TILE)
            row.append(out)
        rows.append(torch.cat(row, 1))
    return torch.cat(rows, 0)


def test_faster_than_tile_looped_torch():
    """Goal: forward and backward at least 25 x faster, one thread each, 128 x 128 and 5,000 Gaussians."""
    tensors, view = scene(5000, 0, scale=0.03), camera(128, 128)
    viewmat, K = map(torch.from_numpy, (view.viewmat, view.K))
    torch.set_num_threads(1)
    threads.set_kernel_threads(1)

    def plain():
        picture = _tile_looped_torch(tensors, viewmat, K, 128, 128)
        picture.square().sum().backward()
        return picture

    def ours():
        picture = rasterization(*tensors, view)[0]
        picture.square().sum().backward()
        return picture

    torch.testing.assert_close(plain(), ours(), rtol=1e-3, atol=5e-3)
    ratio = _seconds(plain, 2) / _seconds(ours)
    print(f"tile-looped torch / kernels: {ratio:.0f}")
    assert ratio > 25
