"""The order of a sliced file: which anchors of a layer come first, and which wait until the next layer has come."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.format.plan import in_file_order, passed, tensor_bytes
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
    """(a planned scene, some of whose anchors have passed to the next layer, in the order of a file; float64 [N] the
    utility of all in their layers, see `utility`).

    A layer keeps its most useful anchors until the next layer's planes and networks gain the pictures at `places` more
    per byte than its own next anchors would; with `passing` the others pass. The highest level stays as it is. step is
    called after each round of `utility`.
    """
    shots = [(smaller(camera), time) for camera, time in places]
    whole, found = _pictures(scene, scene.level, shots), list[np.ndarray]()
    for index, layer in enumerate(scene.layers):
        own = utility(scene.prefix(layer), shots, step)
        if passing and layer < scene.level:
            order = np.argsort(-own, kind="stable")
            first = scene.rows[index] - len(own)
            kept, others = np.split(order, [_enough(scene, index, first + order, shots, whole, options)])
            voxels = scene.anchor_q[first + kept]
            scene, _ = in_file_order(passed(scene, index, first + others), scene.layers)
            by_voxel = np.lexsort(scene.anchor_q[first : first + len(kept)].T)
            own = own[kept[np.lexsort(voxels.T)]][np.argsort(by_voxel)]
        found.append(own)
    return scene, np.concatenate(found)


def _enough(
    scene: Scene,
    index: int,
    order: np.ndarray,
    shots: Sequence[Place],
    whole: Sequence[np.ndarray],
    options: EncodeOptions,
) -> int:
    """How many anchors of scene.layers[index] come before the next layer. order: int64 [n], its rows, the most useful
    one first. whole: the pictures of the highest level."""
    level, above = scene.layers[index : index + 2]

    def error(level: int, count: int) -> float:
        """The squared error of the pictures at `level` with so many of the anchors and none of later layers."""
        prefix = scene.prefix(level)
        later = np.arange(scene.rows[index], prefix.rows[-1])
        shown = _pictures(without(prefix, np.concatenate([order[count:], later])), level, shots)
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


def _pictures(scene: Scene, level: int, shots: Sequence[Place]) -> list[np.ndarray]:
    """The pictures [H, W, 3] at `level`."""
    model = from_scene(scene)
    return [render_image(model, level, time, camera) for camera, time in shots]
