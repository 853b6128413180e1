"""Measures packed scenes: the error of their pictures, and the gain of their layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from pd4dgs_codec.data.view import View
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.plan import LeftOut, plan, tensor_bytes
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.sensitivity import omission_error
from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.image import level_psnr
from pd4dgs_codec.scene import Scene


class RenderedLoss:
    """The error of decoded scenes in the pictures of `frames`, relative to the unquantised `scene`, at its levels.

    step is called after each picture.
    """

    def __init__(self, scene: Scene, frames: Sequence[Frame], step: Callable[[], None] = lambda: None):
        self.frames, self.levels, self.step = frames, scene.layers, step
        self.references = self._pictures(scene)

    def mse(self, scene: Scene) -> dict[int, float]:
        """Returns per level the mean squared error over all pictures, colours in 0..1."""
        pictures = self._pictures(scene)
        return {
            level: float(np.mean([np.square(a - b).mean() for a, b in zip(pictures[level], references, strict=True)]))
            for level, references in self.references.items()
        }

    def mean_mse(self, scene: Scene) -> float:
        """Returns the mean of `mse` over the levels."""
        return float(np.mean(list(self.mse(scene).values())))

    def omission_error(self, scene: Scene, level: int) -> np.ndarray:
        """Estimates the squared error, summed over pictures and colours, of leaving out each anchor at `level`: float64
        [N], see `sensitivity.omission_error`; infinite, as unknown, for anchors that no picture shows."""
        model = from_scene(scene)
        total, met = np.zeros(len(scene.anchor_q)), np.zeros(len(scene.anchor_q), bool)
        generator = torch.Generator().manual_seed(0)
        for frame in self.frames:
            error, near, _ = omission_error(model, level, frame.time, frame.camera, generator)
            total += error.numpy()
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


def true_psnr(
    scene: Scene, views: Sequence[View], step: Callable[[], None] = lambda: None, *, levels: Sequence[int] | None = None
) -> dict[int, float]:
    """Returns the mean mPSNR over views, dB, by level of a decoded scene; `levels` defaults to all."""
    model = from_scene(scene)

    def draw(level: int, view: View) -> np.ndarray:
        return render_image(model, level, view.time, view.camera)

    return level_psnr(draw, scene.layers if levels is None else levels, views, step)


def leave_out_low_gain(
    scene: Scene,
    views: Sequence[View],
    *,
    min_gain: float,
    options: EncodeOptions = DEFAULTS,
    step: Callable[[], None] = lambda: None,
) -> tuple[Scene, list[LeftOut]]:
    """Leaves out deformations that gain less than min_gain dB per megabyte. Returns the scene and the parts left out.

    From the highest layer down until one is kept (its trunk reads the planes below), the scene is quantised with and
    without the layer's deformation. A layer's gain is the increase of the mean mPSNR over `views` at its level. Only
    the deformation's own bytes count: its anchors pass to a lower layer. `plan` drops layers without a deformation.
    The steps of `scene` are binary32.
    """
    left_out: list[LeftOut] = []
    present = None
    for kind in reversed(LAYER_KINDS[1:]):
        deformation = scene.deformation(kind.layer)
        if deformation is None:
            continue
        if present is None:
            present = _measure(scene, views, options, step)
        if kind.layer not in present:  # without effect: the plan leaves it out and reports why
            continue
        without = scene.with_tensors(kind.layer, None)
        remaining = _measure(without, views, options, step)
        gain = present[max(present)] - remaining[max(remaining)]
        size = tensor_bytes(deformation, kind, scene.steps, options)
        if gain * 1e6 >= min_gain * size:
            break
        why = (
            f"level {kind.layer} gains {gain:.3f} dB for {size:,} bytes on {len(views)} views: "
            f"{gain * 1e6 / size:.2f} dB per MB, expected at least {min_gain:,g}"
        )
        left_out.append(LeftOut(kind.name, why, kind, deformation))
        scene, present = without, remaining
    return scene, left_out


def _measure(scene: Scene, views: Sequence[View], options: EncodeOptions, step: Callable[[], None]) -> dict[int, float]:
    planned = plan(scene, replace(options, layers="auto", omit="nothing"))
    return true_psnr(planned.symbols.scene(), views, step)
