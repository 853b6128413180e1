"""Encoder: decides which parts of a scene a file holds.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer is left out because it has no deformation, its anchors and masks pass to the highest layer kept, so that the
picture of the highest level stays the same.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import deformation
from pd4dgs_codec.format.deformation import arrays_of, with_arrays
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import write_layer
from pd4dgs_codec.format.quantise import dequantise
from pd4dgs_codec.format.registry import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.symbols import LayerSymbols, SceneSymbols, first_duplicate
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import TRUNK, Deformation, Scene, Steps, Widths


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A part that was not written. Its cost is that of `anchors` average anchors if there are any, else that of coding
    `tensors`, else `bits`, the order-0 entropy that was saved. lossless: no picture changes."""

    what: str
    why: str
    kind: LayerKind | None = None
    tensors: Deformation | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False

    def row(self, steps: Steps, options: EncodeOptions, kept: int, kept_bits: int) -> dict[str, Any]:
        """Returns {what, why, lossless, bytes} for the report of a file whose `kept` anchors took kept_bits bits."""
        if self.anchors:
            cost = self.anchors * kept_bits / 8 / kept if kept else 0
        elif self.tensors is not None and self.kind is not None:
            cost = tensor_bytes(self.tensors, self.kind, steps, options)
        else:
            cost = self.bits / 8
        return {"what": self.what, "why": self.why, "lossless": self.lossless, "bytes": round(cost)}


def tensor_bytes(tensors: Deformation, kind: LayerKind, steps: Steps, options: EncodeOptions) -> int:
    """Returns the bytes of planes and networks, coded as a layer without anchors."""
    empty = np.zeros(0, np.int32)
    alone = LayerSymbols(
        kind=kind,
        widths=Widths(),
        anchor_q=np.zeros((0, 3), np.int32),
        mask_increase=empty,
        mask_own=empty,
        classes=empty,
        attributes=np.zeros((0, 0), np.int32),
        tensors=deformation.quantise_tensors(tensors, kind, steps),
        steps=deformation.layer_steps(steps, kind, tensors),
    )
    return len(write_layer(alone, options)[0])


@dataclass(frozen=True, eq=False)
class Plan:
    """scene: the parts of the given scene that the file holds, with other values where an omission changed symbols.
    symbols: of that scene, as the file stores them. left_out: the parts of the given scene that the file lacks."""

    scene: Scene
    symbols: SceneSymbols
    left_out: list[LeftOut]


def plan(scene: Scene, options: EncodeOptions = DEFAULTS) -> Plan:
    """Plans a file of `scene` by options.layers and options.omit; options.step_scale is not applied.

    Steps are rounded to binary32, and rows sorted by (layer, Morton order). Raises EncodeError for a value that has no
    symbol, and for voxels with two anchors.
    """
    left_out: list[LeftOut] = []
    scene = replace(scene, steps=scene.steps.scaled(1.0))
    auto = options.layers == "auto"
    if not auto:
        scene, left_out = _cut(scene, int(options.layers))
    for layer in reversed(scene.layers[1:]):
        scene, dropped = _drop_heads(scene, LAYER_KINDS[layer])
        left_out += dropped
    kept = [layer for layer in scene.layers if layer == 0 or not auto or scene.deformation(layer) is not None]
    arranged, rows = in_file_order(scene, tuple(kept))
    if inactive := scene.rows[-1] - len(rows):
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    symbols = SceneSymbols.of(arranged)
    if options.omit != "nothing":
        arranged, symbols, unread = _without_unread(arranged, symbols)
        left_out += unread
    return Plan(arranged, symbols, left_out)


def _cut(scene: Scene, highest: int) -> tuple[Scene, list[LeftOut]]:
    """Returns (the layers <= highest with the anchors of all layers, a LeftOut for each layer above)."""
    why = f"only layers up to {highest} were requested"
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


def _drop_heads(scene: Scene, kind: LayerKind) -> tuple[Scene, list[LeftOut]]:
    """Removes the heads of a layer that are zero after quantisation, or its deformation if no head is left and no layer
    above reads its planes. Returns (scene, parts left out)."""
    given = scene.deformation(kind.layer)
    if given is None:
        return scene, []
    symbols = deformation.quantise_tensors(given, kind, scene.steps)
    heads = [name for name in given.networks if name != TRUNK]
    zero = [name for name in heads if deformation.is_zero(symbols, name)]
    if len(zero) == len(heads) and any(map(scene.deformation, range(kind.layer + 1, 3))):
        zero = zero[1:]  # a deformation has at least one head
    why = "zero after quantisation" if heads else "no heads"
    if len(zero) == len(heads):
        return scene.with_tensors(kind.layer, None), [LeftOut(kind.name, why, kind, given)]
    rest = {name: network for name, network in given.networks.items() if name not in zero}
    gone = [
        LeftOut(f"{kind.name} head {name}", why, kind, Deformation((), {name: given.networks[name]})) for name in zero
    ]
    return scene.with_tensors(kind.layer, replace(given, networks=rest)), gone


def passed(scene: Scene, index: int, rows: np.ndarray) -> Scene:
    """Moves the anchors `rows` (int64 [n]) of scene.layers[index] to the next layer by setting their mask codes of this
    one to 0. The scene returned is not planned."""
    masks = scene.full_masks()
    masks[index][rows] = 0
    return replace(scene, rows=(scene.rows[-1],) * len(masks), mask=tuple(masks))


def in_file_order(scene: Scene, kept: tuple[int, ...]) -> tuple[Scene, np.ndarray]:
    """Returns (scene with the layers `kept` and rows sorted by (layer, Morton order), int64 [n], rows of the given
    scene in this order). Anchors with masks of 0 in all of these layers are dropped."""
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
    return arranged, order


def _without_unread(scene: Scene, symbols: SceneSymbols) -> tuple[Scene, SceneSymbols, list[LeftOut]]:
    """Gives plane cells that no anchor reads values of little cost. Returns (scene, its symbols, parts left out).

    scene: planned, with all rows active at its highest level. Its values change where its symbols change.
    """
    low, high = scene.info.box
    unit = np.clip((scene.anchor - low) / np.maximum(high - low, np.finfo(np.float32).tiny), 0.0, 1.0)
    layers, left_out = [], list[LeftOut]()
    for layer in symbols.layers:
        kind, given = layer.kind, scene.tensors(layer.kind.layer)
        tensors, what, bits = deformation.without_unread(layer.tensors, unit)
        if tensors is not layer.tensors:
            left_out.append(LeftOut(f"{kind.name}: {what}", "no anchor reads them", bits=bits, lossless=True))
            rows = zip(arrays_of(given, kind), arrays_of(layer.tensors, kind), arrays_of(tensors, kind), strict=True)
            arrays = [
                np.where(before == k, x, dequantise(k, layer.steps[of])) for (of, _, x), (*_, before), (*_, k) in rows
            ]
            scene = scene.with_tensors(kind.layer, with_arrays(given, kind, arrays))
        layers.append(replace(layer, tensors=tensors))
    return scene, replace(symbols, layers=layers), left_out
