"""The order of a sliced file: which anchors of a layer come first, and which wait until the next layer has come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import tensor_bytes
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.format.symbols import layer_symbols
from pd4dgs_codec.model.convert import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.sensitivity import Place, smaller, utility, without
from pd4dgs_codec.scene import Scene

#: So many parts of a layer's bytes, after each of which the next layer may begin.
PARTS = 16


def in_order(
    scene: Scene,
    places: Sequence[Place],
    options: EncodeOptions,
    step: Callable[[], None] = lambda: None,
    *,
    passing: bool = True,
) -> tuple[Scene, np.ndarray]:
    """(a planned scene, some of whose anchors have passed to the next layer, float64 [N] the utility of all in their
    layers, see `utility`).

    A layer keeps its most useful anchors until the next layer's planes and networks gain the pictures at `places` more
    per byte than its own next anchors would; with `passing` the others pass. The highest level stays as it is. step is
    called after each round of `utility`.
    """
    places = [(smaller(camera), time) for camera, time in places]
    found = list[np.ndarray]()
    for index, layer in enumerate(scene.layers):
        own = utility(scene.prefix(layer), places, step)
        if passing and layer < scene.level:
            first, order = scene.rows[index] - len(own), np.argsort(-own, kind="stable")
            order = order[: _enough(scene, index, first + order, places, options)]
            scene, own = _keeping(scene, index, first + order), own[order]
        found.append(own)
    return scene, np.concatenate(found)


def _enough(scene: Scene, index: int, order: np.ndarray, places: Sequence[Place], options: EncodeOptions) -> int:
    """How many anchors of scene.layers[index] come before the next layer. order: int64 [n], its rows, the most useful
    one first."""
    level, above = scene.layers[index : index + 2]
    whole = from_scene(scene)
    references = [render_image(whole, scene.level, time, camera) for camera, time in places]

    def error(level: int, count: int) -> float:
        """The squared error of the pictures at `level` with so many of the anchors and none of later layers."""
        later = np.arange(scene.rows[index], scene.prefix(level).rows[-1])
        model = from_scene(without(scene.prefix(level), np.concatenate([order[count:], later])))
        pictures = (render_image(model, level, time, camera) for camera, time in places)
        return float(sum(np.square(a - b).sum() for a, b in zip(pictures, references, strict=True)))

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


def _keeping(scene: Scene, index: int, rows: np.ndarray) -> Scene:
    """The scene in which scene.layers[index] keeps the anchors `rows`, int64 [n], in this order; the others pass to the
    next layer."""
    first, end = (scene.rows[index - 1] if index else 0), scene.rows[index]
    passed = np.setdiff1d(np.arange(first, end), rows)
    order = np.concatenate([np.arange(first), rows, passed, np.arange(end, scene.rows[-1])])
    counts = (*scene.rows[:index], first + len(rows), *scene.rows[index + 1 :])
    masks = tuple(codes[order][:n] for codes, n in zip(scene.full_masks(), counts, strict=True))
    return replace(scene, rows=counts, mask=masks, **scene.of_anchors(order))
