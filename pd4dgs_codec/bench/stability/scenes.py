"""Small scenes that the rooms bend: a few anchors in front of a camera, with or without deformations."""

from __future__ import annotations

import numpy as np
import torch

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import render
from pd4dgs_codec.render.autograd.rasterization import rasterization
from pd4dgs_codec.scene import SCAFFOLD_NETWORKS, Camera, Deformation, Network, Scene, SceneInfo, Steps

WIDTH, HEIGHT = 40, 30
BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
CAMERA = Camera(
    np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], np.float32),
    np.array([[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]], np.float32),
    WIDTH,
    HEIGHT,
)


def small_scene(deformation: Deformation | None = None, anchors: int = 40, mask: int = 255) -> Scene:
    """A scene of layer 0, or of layers 0 and 1 with a global deformation. mask: the code of every anchor."""
    rng = np.random.default_rng(3)
    cells = rng.choice(21**3, anchors, replace=False)
    layers = (0,) if deformation is None else (0, 1)
    networks: dict[str, Network] = {
        name: ((rng.normal(0, 0.3, (n, 35)).astype(np.float32), np.full(n, 0.2, np.float32)),)
        for name, n in SCAFFOLD_NETWORKS.items()
    }
    return Scene(
        info=SceneInfo(
            0.0625, BOX, (0.0, 1.0), (0.25, 0.5, 0.75), 0.0625, 100.0, (0.0, -1.0, 0.0), 0.0, CAMERA
        ),
        steps=Steps(),
        layers=layers,
        rows=(anchors,) * len(layers),
        anchor_q=np.stack(np.unravel_index(cells, (21, 21, 21)), 1).astype(np.int32) - 10,
        feature=rng.normal(0, 1, (anchors, 32)).astype(np.float32),
        scaling_log=rng.normal(-2.5, 0.3, (anchors, 6)).astype(np.float32),
        offset=rng.normal(0, 1, (anchors, 10, 3)).astype(np.float32),
        mask=(np.full(anchors, mask, np.uint8),) * len(layers),
        networks=networks,
        global_deformation=deformation,
    )  # fmt: skip


@torch.no_grad()
def picture_error(model: Model, level: int, t: float, camera: Camera = CAMERA) -> float:
    """Largest difference of a channel of a pixel between the float32 picture and the float64 oracle's picture of the
    same Gaussians; NaN where the former is not finite."""
    viewmat, K = torch.from_numpy(camera.viewmat), torch.from_numpy(camera.K)
    picture = render(model, level, t, camera)
    g = picture.gaussians
    drawn = g.colors.isfinite().all(1)
    expected, _, _ = rasterization(
        g.means[drawn],
        g.quats[drawn],
        g.scales[drawn],
        g.opacities[drawn],
        g.colors[drawn],
        viewmat[None],
        K[None],
        camera.width,
        camera.height,
        near_plane=max(float(model.info.near), 1e-6),
        backgrounds=torch.tensor([model.info.background]),
        backend="reference",
    )
    return float((picture.image.double() - expected[0]).abs().max())
