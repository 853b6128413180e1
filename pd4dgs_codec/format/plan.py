"""Encoder: the anchors of each layer in their order, and the deformations and heads that a file needs.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer is left out because it has no deformation, its anchors and masks pass to the highest layer kept, so that the
picture of the highest level stays the same, within the bounds of `heads`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.heads import drop_heads
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.omissions import leave_out_unseen, with_omissions
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.symbols import SceneSymbols, first_duplicate
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Scene


@dataclass(frozen=True, eq=False)
class Plan:
    """scene: as given, as far as the file holds it, with other values where an omission changed the symbols. symbols:
    of that scene, what the file will hold. left_out: the parts of the given scene that it lacks."""

    scene: Scene
    symbols: SceneSymbols
    left_out: list[LeftOut]


def plan(scene: Scene, options: EncodeOptions = DEFAULTS) -> tuple[Scene, list[LeftOut]]:
    """(the scene of Plan, its left_out)."""
    planned = make_plan(scene, options)
    return planned.scene, planned.left_out


def make_plan(scene: Scene, options: EncodeOptions = DEFAULTS) -> Plan:
    """What a file of `scene` holds, by options.layers and options.omit; steps are not scaled.

    Steps are rounded to binary32, and rows sorted by (layer, Morton order). Raises EncodeError for a value that has no
    symbol, and for voxels with two anchors.
    """
    left_out: list[LeftOut] = []
    scene = replace(scene, steps=scene.steps.scaled(1.0))
    auto = options.layers == "auto"
    if not auto:
        scene, left_out = _cut(scene, int(options.layers))
    kept = [0]
    for layer in scene.layers[1:]:
        scene, dropped = drop_heads(scene, LAYER_KINDS[layer], auto and options.omit == "bounded")
        left_out += dropped
        if not auto or scene.deformation(layer) is not None:
            kept.append(layer)
    arranged, inactive = _arranged(scene, tuple(kept))
    if inactive:
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    symbols = SceneSymbols.of(arranged)
    if options.omit != "nothing":
        less, lossless = leave_out_unseen(symbols)
        arranged, symbols = with_omissions(arranged, symbols, less), less
        left_out += lossless
    return Plan(arranged, symbols, left_out)


def _cut(scene: Scene, highest: int) -> tuple[Scene, list[LeftOut]]:
    """(the layers <= highest as they are, a row for each layer above)."""
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


def _arranged(scene: Scene, kept: tuple[int, ...]) -> tuple[Scene, int]:
    """(scene with the layers `kept` and rows sorted by (layer, Morton order), number of anchors dropped)."""
    codes = scene.full_masks()
    by_layer = dict(zip(scene.layers, codes, strict=True))
    masks = np.stack([*(by_layer[layer] for layer in kept[:-1]), codes[-1]])
    first = np.where(masks[-1] > 0, (masks > 0).argmax(axis=0), len(kept))
    groups = [np.flatnonzero(first == i) for i in range(len(kept))]
    order = np.concatenate([group[morton_order(scene.anchor_q[group])] if group.size else group for group in groups])
    rows = tuple(int(n) for n in np.cumsum([group.size for group in groups]))
    if (voxel := first_duplicate(scene.anchor_q[order])) is not None:
        raise EncodeError(f"anchor_q: voxel {voxel} holds more than one anchor, expected one")
    if scene.grading is not None and not scene.grading.classes[order].any():
        scene = replace(scene, grading=None)
    masks_of = tuple(m[order][:n] for m, n in zip(masks, rows, strict=True))
    arranged = replace(scene, layers=kept, rows=rows, mask=masks_of, **scene.of_anchors(order))
    return arranged, scene.rows[-1] - order.size
