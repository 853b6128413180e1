"""What a file of this scene needs: which anchors, in which layer and order, which deformations and which heads.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer goes because its deformation is left out, its anchors and masks pass to the highest layer kept, so that the
highest level's picture stays what it was, within the bounds below.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.heads import drop_heads
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.omissions import leave_out_unseen
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.symbols import first_duplicate
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Scene


def plan(scene: Scene, options: EncodeOptions = DEFAULTS) -> tuple[Scene, list[LeftOut]]:
    """(the scene that the file will hold, what it leaves out) by options.layers and omit; steps are not scaled.

    Steps come out as binary32, rows sorted by (layer, Morton order).
    """
    left_out: list[LeftOut] = []
    scene = replace(scene, steps=scene.steps.scaled(1.0))
    judge = options.layers == "auto"
    if not judge:
        scene, left_out = _cut(scene, int(options.layers))
    kept = [0]
    for layer in scene.layers[1:]:
        kind = LAYER_KINDS[layer]
        scene, dropped = drop_heads(scene, kind, judge and options.omit == "bounded")
        left_out += dropped
        if not judge or scene.deformation(layer) is not None:
            kept.append(layer)
    arranged, inactive = _arrange(scene, tuple(kept))
    if inactive:
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    if options.omit != "nothing":
        given = [arranged]
        del arranged  # nobody keeps what takes other values: arrays as large as the scene's
        arranged, lossless = leave_out_unseen(given.pop())
        left_out += lossless
    return arranged, left_out


def _cut(scene: Scene, highest: int) -> tuple[Scene, list[LeftOut]]:
    """The layers <= highest as they are, and a note for each one above."""
    why = f"layers up to {highest} were asked for"
    left_out = [
        LeftOut(f"layer {layer}", why, LAYER_KINDS[layer], scene.deformation(layer))
        for layer in scene.layers
        if layer > highest
    ]
    kept = len(scene.layers) - len(left_out)
    cut = replace(
        scene.prefix(highest),
        rows=(scene.rows[-1],) * kept,
        mask=tuple(scene.full_masks()[:kept]),
        **scene.of_anchors(slice(None)),
    )
    return cut, left_out


def _arrange(scene: Scene, kept: tuple[int, ...]) -> tuple[Scene, int]:
    """(scene with rows sorted by (layer, Morton) and the layers `kept`, number of anchors dropped)."""
    codes = scene.full_masks()
    by_layer = dict(zip(scene.layers, codes, strict=True))
    masks = np.stack([*(by_layer[layer] for layer in kept[:-1]), codes[-1]])
    first = np.where(masks[-1] > 0, (masks > 0).argmax(axis=0), len(kept))
    groups = [np.flatnonzero(first == i) for i in range(len(kept))]
    order = np.concatenate([group[morton_order(scene.anchor_q[group])] if group.size else group for group in groups])
    rows = tuple(int(n) for n in np.cumsum([group.size for group in groups]))
    if (row := first_duplicate(scene.anchor_q[order])) is not None:
        raise EncodeError(f"anchor_q: voxel {row.tolist()} holds more than one anchor, expected one")
    if scene.grading is not None and not scene.grading.classes[order].any():
        scene = replace(scene, grading=None)
    masks_of = tuple(m[order][:n] for m, n in zip(masks, rows, strict=True))
    arranged = replace(scene, layers=kept, rows=rows, mask=masks_of, **scene.of_anchors(order))
    return arranged, scene.rows[-1] - order.size
