"""Random Gaussians in front of a camera, and the comparison of a backend with the float64 oracle."""

from __future__ import annotations

import torch

from pd4dgs_codec.model.autograd.rasterization import rasterization

NAMES = ("means", "quats", "scales", "opacities", "colors")


def camera(width, height, focal=1.2, shift=(0.0, 0.0)):
    """(viewmats [1, 4, 4], Ks [1, 3, 3]) at the origin looking along z; shift moves the principal point, pixels."""
    f = focal * width
    K = torch.tensor([[f, 0.0, width / 2 + shift[0]], [0.0, 1.1 * f, height / 2 + shift[1]], [0.0, 0.0, 1.0]])
    return torch.eye(4)[None], K[None]


def turned_camera(width, height):
    """A camera that is moved, rotated about two axes and off-centre."""
    viewmats, Ks = camera(width, height, shift=(3.3, -2.6))
    a, b = torch.tensor(0.3), torch.tensor(-0.2)
    one, zero = torch.tensor(1.0), torch.tensor(0.0)
    about_y = torch.stack([a.cos(), zero, a.sin(), zero, one, zero, -a.sin(), zero, a.cos()]).view(3, 3)
    about_x = torch.stack([one, zero, zero, zero, b.cos(), -b.sin(), zero, b.sin(), b.cos()]).view(3, 3)
    viewmats[0, :3, :3] = about_x @ about_y
    viewmats[0, :3, 3] = torch.tensor([-0.8, 0.3, 0.4])
    return viewmats, Ks


def scene(n, seed=0, scale=0.1, spread=1.0, channels=3, opacity=(0.05, 0.95)):
    """Leaf tensors (means, quats, scales, opacities, colors) of n Gaussians at depths 2..6 in a 1.2-focal view."""
    g = torch.Generator().manual_seed(seed)
    z = torch.rand(n, generator=g) * 4 + 2
    xy = (torch.rand(n, 2, generator=g) - 0.5) * spread / 1.2 * z[:, None]
    tensors = [
        torch.cat([xy, z[:, None]], -1),
        torch.randn(n, 4, generator=g),
        torch.exp(torch.randn(n, 3, generator=g) * 0.6) * scale,
        torch.rand(n, generator=g) * (opacity[1] - opacity[0]) + opacity[0],
        torch.rand(n, channels, generator=g),
    ]
    return [t.requires_grad_() for t in tensors]


def draw_with_gradients(tensors, viewmats, Ks, width, height, backend, background=None, seed=0, **options):
    """dict of the pictures, and of the gradients of a random weighting of them, all float64."""
    leaves = dict(zip(NAMES, [t.detach().clone().requires_grad_() for t in tensors], strict=True))
    if background is not None:
        leaves["backgrounds"] = background.detach().clone().requires_grad_()
    out, alphas, meta = rasterization(
        *[leaves[k] for k in NAMES], viewmats, Ks, width, height, backgrounds=leaves.get("backgrounds"),
        backend=backend, **options,
    )  # fmt: skip
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64) for t in (out, alphas)]
    ((out.double() * weights[0]).sum() + (alphas.double() * weights[1]).sum()).backward()
    result = {"picture": out.detach().double(), "alphas": alphas.detach().double()}
    for name, leaf in leaves.items():
        result["d " + name] = torch.zeros_like(leaf).double() if leaf.grad is None else leaf.grad.double()
    return result | {"d means2d": means2d_gradient(meta, tensors[0].shape[0]), "meta": meta}


def means2d_gradient(meta, n):
    """[C, N, 2] from either backend's meta."""
    if isinstance(meta["means2d"], list):
        rows = [
            torch.zeros(n, 2, dtype=torch.float64).index_copy(0, index, values.grad)
            for index, values in zip(meta["index"], meta["means2d"], strict=True)
        ]
        return torch.stack(rows)
    return meta["means2d"].grad.double()


def relative_errors(found, expected):
    """||found - expected|| / ||expected|| of every tensor of two draw_with_gradients results."""
    return {
        k: float((found[k] - expected[k]).norm() / expected[k].norm().clamp(min=1e-12)) for k in expected if k != "meta"
    }
