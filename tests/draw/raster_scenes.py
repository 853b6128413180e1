"""Random Gaussians in front of a camera, and the comparison of a backend with the float64 oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from pd4dgs_codec.model.picture import rasterization
from pd4dgs_codec.scene import Camera

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
    return {
        k: float((found[k] - expected[k]).norm() / expected[k].norm().clamp(min=1e-12)) for k in expected if k != "meta"
    }


def oracle_errors(tensors, view, background=(0.0, 0.0, 0.0)):
    """(relative errors of the CPU backend against the oracle, the result of the one, that of the other)."""
    found, expected = (draw_with_gradients(tensors, view, backend, background) for backend in ("cpu", "reference"))
    return relative_errors(found, expected), found, expected
