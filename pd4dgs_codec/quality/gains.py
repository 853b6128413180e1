"""Layers whose level does not pay: measured quality per byte on a dataset's views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.left_out import LeftOut, tensor_bytes
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.symbols import rounded
from pd4dgs_codec.scene import Scene

if TYPE_CHECKING:
    from pd4dgs_codec.data.view import View


def leave_out_unpaid(
    scene: Scene,
    views: Sequence[View],
    *,
    min_gain: float,
    options: EncodeOptions = DEFAULTS,
    step: Callable[[], None] = lambda: None,
) -> tuple[Scene, list[LeftOut]]:
    """(scene without the deformations that gain less than min_gain dB per megabyte, each of them with its figures).

    From the highest layer down, the scene is quantised with and without the layer's deformation; a layer's gain is the
    largest, over the levels from its own one up, of the mean mPSNR over `views` that it adds. The deformation's
    bytes are those that it takes alone; its anchors pass to a lower layer and are not counted. The plan drops a layer
    without a deformation. mPSNR is of the views' true images. The steps of `scene` are binary32.
    """
    left_out: list[LeftOut] = []
    with_all = None
    for kind in reversed(LAYER_KINDS[1:]):
        deformation = scene.deformation(kind.layer)
        if deformation is None:
            continue
        if with_all is None:
            with_all = _measure(scene, views, options, step)
        if kind.layer not in with_all:  # without effect: the plan leaves it out and says why
            continue
        without = scene.with_tensors(kind.layer, None)
        remaining = _measure(without, views, options, step)
        gain = max(
            with_all[level] - remaining[max(lower for lower in remaining if lower <= level)]
            for level in with_all
            if level >= kind.layer
        )
        size = tensor_bytes(deformation, kind, scene.steps, options)
        if gain * 1e6 < min_gain * size:
            why = (
                f"level {kind.layer} gains {gain:.3f} dB for {size:,} bytes on {len(views)} views: "
                f"{gain * 1e6 / size:.2f} dB per MB, expected at least {min_gain:,g}"
            )
            left_out.append(LeftOut(kind.name, why, kind, deformation))
            scene, with_all = without, remaining
    return scene, left_out


def _measure(scene: Scene, views: Sequence[View], options: EncodeOptions, step: Callable[[], None]) -> dict[int, float]:
    from pd4dgs_codec.quality.rendered import true_psnr

    planned, _ = plan(scene, replace(options, layers="auto", omit="nothing"))
    return true_psnr(rounded(planned), views, step)
