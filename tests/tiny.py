"""A model so small that a training step takes milliseconds, and a dataset of a few tiny pictures."""

from __future__ import annotations

import math

import numpy as np

from pd4dgs_codec.data import Dataset, View
from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS

#: The preset `tiny` with few anchors and cells.
TINY = ModelConfig(
    DeformationConfig(4, 4, 4, (1,), 8, tuple(GLOBAL_HEADS)),
    DeformationConfig(4, 4, 4, (1,), 8, tuple(LOCAL_HEADS)),
    hidden=8,
    initial_anchors=300,
    max_anchors=600,
)
W, H = 32, 24


def view(t: float) -> View:
    """A bright disc that moves to the right over a grey ground; the camera sways a little."""
    y, x = np.mgrid[0:H, 0:W] + 0.5
    image = np.full((H, W, 3), 90, np.uint8)
    image[(x - 8 - 16 * t) ** 2 + (y - 12) ** 2 < 16] = (230, 60, 40)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3], viewmat[2, 3] = 0.1 * math.sin(6 * t), 3.0
    K = np.array([[30, 0, W / 2], [0, 30, H / 2], [0, 0, 1]], np.float32)
    return View(viewmat=viewmat, K=K, width=W, height=H, time=t, image=image, mask=None, name=f"{t}", camera_id=0)


def disc() -> Dataset:
    """Six training views of the disc and one held out."""
    views = tuple(view(t) for t in np.linspace(0, 1, 6))
    return Dataset(
        name="disc", train=views, test=(view(0.5),), points=None, point_colors=None,
        box=np.array([[-1.5, -1.2, -1], [1.5, 1.2, 1]], np.float32), near=0.1, far=10.0, background=(0.0, 0.0, 0.0),
        time_range=(0.0, 1.0), up=(0.0, -1.0, 0.0), unit=0.0, masked=False,
    )  # fmt: skip
