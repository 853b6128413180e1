"""The order of anchors in a sliced file: which come first in a layer, and which pass to the next layer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import in_file_order, passed, tensor_bytes
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.format.symbols import layer_symbols
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.sensitivity import Viewpoint, smaller, utility, without
from pd4dgs_codec.scene import Scene

#: A layer's bytes are divided into so many parts; the next layer may begin after any of them.
PARTS = 16


def in_order(
    scene: Scene,
    viewpoints: Sequence[Viewpoint],
    options: EncodeOptions,
    step: Callable[[], None] = lambda: None,
    *,
    passing: bool = True,
) -> tuple[Scene, np.ndarray]:
    """Orders the anchors of a planned scene. Returns the scene in file order, with some anchors passed to the next
    layer, and float64 [N], the utility of each anchor in its layer, see `utility`.

    A layer keeps its most useful anchors until the next layer's planes and networks improve the pictures at
    `viewpoints` more per byte than its own next anchors; with `passing` the other anchors pass. The highest level is
    unchanged. step is called after each round of `utility`.
    """
    viewpoints = [(smaller(camera), time) for camera, time in viewpoints]
    whole, found = _pictures(scene, scene.level, viewpoints), list[np.ndarray]()
    for index, layer in enumerate(scene.layers):
        own = utility(scene.prefix(layer), viewpoints, step)
        if passing and layer < scene.level:
            order = np.argsort(-own, kind="stable")
            first = scene.rows[index] - len(own)
            kept, others = np.split(order, [_enough(scene, index, first + order, viewpoints, whole, options)])
            scene, rows = in_file_order(passed(scene, index, first + others), scene.layers)
            own = own[rows[first : first + len(kept)] - first]
        found.append(own)
    return scene, np.concatenate(found)


def _enough(
    scene: Scene,
    index: int,
    order: np.ndarray,
    viewpoints: Sequence[Viewpoint],
    whole: Sequence[np.ndarray],
    options: EncodeOptions,
) -> int:
    """Returns how many anchors of scene.layers[index] come before the next layer. order: int64 [n], its rows, the most
    useful one first. whole: the pictures of the highest level."""
    level, above = scene.layers[index : index + 2]

    def error(level: int, count: int) -> float:
        """Returns the pictures' squared error at `level` with `count` of the anchors and none of later layers."""
        prefix = scene.prefix(level)
        later = np.arange(scene.rows[index], prefix.rows[-1])
        shown = _pictures(without(prefix, np.concatenate([order[count:], later])), level, viewpoints)
        return float(sum(np.square(a - b).sum() for a, b in zip(shown, whole, strict=True)))

    motion = tensor_bytes(scene.tensors(above), LAYER_KINDS[above], scene.steps, options)
    size = np.cumsum(layer_symbols(scene, index).bits_per_row()[order - (scene.rows[index] - len(order))]) / 8
    parts = np.linspace(0.0, size[-1] if len(size) else 0.0, PARTS + 1)
    counts = np.searchsorted(size, parts, side="right")
    start = 1 if index == 0 else 0  # a picture needs anchors
    before = error(level, counts[start])
    for i in range(start, PARTS):
        after, moved = error(level, counts[i + 1]), error(above, counts[i])
        if (before - moved) * (parts[i + 1] - parts[i]) > (before - after) * motion:
            return int(counts[i])
        before = after
    return len(order)


def _pictures(scene: Scene, level: int, viewpoints: Sequence[Viewpoint]) -> list[np.ndarray]:
    """Renders the pictures [H, W, 3] at `level`."""
    model = from_scene(scene)
    return [render_image(model, level, time, camera) for camera, time in viewpoints]
