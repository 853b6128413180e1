"""What packing does to the pictures: decoded scenes against the unquantised one, and how much each anchor shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from pd4dgs_codec.data.view import View
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.harm import anchor_harm
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.level_psnr import level_psnr
from pd4dgs_codec.scene import Scene


class RenderedLoss:
    """The error of decoded scenes in the pictures of `frames`, against those of `scene` before quantisation.

    Levels are those of `scene`. step is called after each picture.
    """

    def __init__(self, scene: Scene, frames: Sequence[Frame], step: Callable[[], None] = lambda: None):
        self.frames, self.levels, self.step = frames, scene.layers, step
        self.references = self._pictures(scene)

    def mse(self, scene: Scene) -> dict[int, float]:
        """Per level the mean squared error over all pictures, colours in 0..1."""
        pictures = self._pictures(scene)
        return {
            level: float(np.mean([np.square(a - b).mean() for a, b in zip(pictures[level], references, strict=True)]))
            for level, references in self.references.items()
        }

    def mean_mse(self, scene: Scene) -> float:
        """The mean of `mse` over the levels."""
        return float(np.mean(list(self.mse(scene).values())))

    def harm(self, scene: Scene, level: int) -> np.ndarray:
        """float64 [N]: the squared error, summed over pictures and colours, of leaving out an anchor at `level`, about;
        see `anchor_harm`. Infinite where no picture comes near the anchor, so that nothing is known of it."""
        model = from_scene(scene)
        total, met = np.zeros(len(scene.anchor_q)), np.zeros(len(scene.anchor_q), bool)
        generator = torch.Generator().manual_seed(0)
        for frame in self.frames:
            harm, near, _ = anchor_harm(model, level, frame.time, frame.camera, generator)
            total += harm.numpy()
            met |= near.numpy()
            self.step()
        return np.where(met, total, np.inf)

    def _pictures(self, scene: Scene) -> dict[int, list[np.ndarray]]:
        model = from_scene(scene)
        pictures: dict[int, list[np.ndarray]] = {}
        for level in self.levels:
            pictures[level] = []
            for frame in self.frames:
                pictures[level].append(render_image(model, level, frame.time, frame.camera))
                self.step()
        return pictures


def psnr_of(mse: float) -> float:
    """dB, infinite where nothing differs."""
    return -10.0 * math.log10(mse) if mse else math.inf


def true_psnr(
    scene: Scene,
    views: Sequence[View],
    step: Callable[[], None] = lambda: None,
    *,
    levels: Sequence[int] | None = None,
) -> dict[int, float]:
    """Per level of a decoded scene, of all of them if None, the mean mPSNR over views, dB."""
    model = from_scene(scene)

    def draw(level: int, view: View) -> np.ndarray:
        return render_image(model, level, view.time, view.camera)

    return level_psnr(draw, scene.layers if levels is None else levels, views, step)
