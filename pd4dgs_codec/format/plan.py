"""Encoder: what a file holds of a scene, and what it leaves out.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer is left out because it has no deformation, its anchors and masks pass to the highest layer kept, so that the
picture of the highest level stays the same, within the bounds of its heads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import deformation
from pd4dgs_codec.format.deformation import Anchors, Omissions, arrays_of, with_arrays
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import write_layer
from pd4dgs_codec.format.quantise import dequantise
from pd4dgs_codec.format.registry import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.symbols import LayerSymbols, SceneSymbols, first_duplicate
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import HEADS, Deformation, Scene, Steps, Widths

#: A head is left out if it moves no position by more than this many voxels ...
NEGLIGIBLE_VOXELS = 1e-3
#: ... and no other attribute by half its quantisation step or more.
NEGLIGIBLE_STEPS = 0.5

#: Samples (points x times) of a first look, which usually finds a head at work, and of the look before one is left out.
QUICK_SAMPLES = 1 << 12
FULL_SAMPLES = 1 << 18
MIN_TIMES = 17


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A part that was not written. Its cost is found by coding `tensors`, else is that of `anchors` average anchors,
    else `bits`, the order-0 entropy that was saved. lossless: no picture changes."""

    what: str
    why: str
    kind: LayerKind | None = None
    tensors: Deformation | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False

    def row(self, steps: Steps, options: EncodeOptions, kept: int, kept_bits: int) -> dict[str, Any]:
        """{what, why, lossless, bytes} for the report of a file whose `kept` anchors took kept_bits bits."""
        if self.anchors:
            cost = self.anchors * kept_bits / 8 / kept if kept else 0
        elif self.tensors is not None and self.kind is not None:
            cost = tensor_bytes(self.tensors, self.kind, steps, options)
        else:
            cost = self.bits / 8
        return {"what": self.what, "why": self.why, "lossless": self.lossless, "bytes": round(cost)}


def tensor_bytes(tensors: Deformation, kind: LayerKind, steps: Steps, options: EncodeOptions) -> int:
    """Bytes of planes and networks as a layer without anchors."""
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
    for layer in reversed(scene.layers[1:]):
        scene, dropped = _drop_heads(scene, LAYER_KINDS[layer], auto and options.omit == "bounded")
        left_out += dropped
    kept = [layer for layer in scene.layers if layer == 0 or not auto or scene.deformation(layer) is not None]
    arranged, inactive = _arranged(scene, tuple(kept))
    if inactive:
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    symbols = SceneSymbols.of(arranged)
    if options.omit != "nothing":
        arranged, symbols, unseen = _without_unseen(arranged, symbols)
        left_out += unseen
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


def _drop_heads(scene: Scene, kind: LayerKind, bounded: bool) -> tuple[Scene, list[LeftOut]]:
    """(`scene` without the heads of a layer that have no effect, or without its deformation if none is left and no
    layer above reads its planes; the heads left out). bounded: also leave out heads within head_bounds, not only those
    that are exactly zero."""
    given = scene.deformation(kind.layer)
    if given is None:
        return scene, []
    decoded = _decoded_motion(scene, kind.layer)
    heads = deformation.heads_of(decoded)
    why = {name: "zero after quantisation" for name in heads if deformation.is_zero(decoded, name)}
    if bounded:
        why |= _negligible(scene, deformation.with_heads(decoded, [name for name in heads if name not in why]))
    if len(why) == len(heads) and any(map(scene.deformation, range(kind.layer + 1, 3))):
        why.pop(next(iter(why), ""), None)  # a deformation has a head
    if not why and heads:
        return scene, []
    if len(why) == len(heads):
        reason = "; ".join(f"{name}: {text}" for name, text in why.items()) or "it has no heads"
        return scene.with_tensors(kind.layer, None), [LeftOut(kind.name, reason, kind, given)]
    rest = deformation.with_heads(given, [name for name in heads if name not in why])
    gone = [
        LeftOut(f"{kind.name} head {name}", text, kind, deformation.head_alone(given, name))
        for name, text in why.items()
    ]
    return scene.with_tensors(kind.layer, rest), gone


def _decoded_motion(scene: Scene, layer: int) -> Deformation:
    """`Scene.motion` with the values of its symbols."""
    for kind in LAYER_KINDS[1 : layer + 1]:
        if (given := scene.deformation(kind.layer)) is not None:
            symbols = deformation.quantise_tensors(given, kind, scene.steps)
            scene = scene.with_tensors(kind.layer, deformation.dequantise_tensors(symbols, kind, scene.steps))
    found = scene.motion(layer)
    assert found is not None
    return found


def head_bounds(scene: Scene) -> dict[str, float]:
    """By head, the largest negligible residual, in the head's unit; lengths in scene units."""
    of_unit = {
        "length": NEGLIGIBLE_VOXELS * scene.info.voxel_size,
        **{name: NEGLIGIBLE_STEPS * step for name, step in scene.steps.attributes.items()},
    }
    return {name: of_unit[head.unit] for name, head in HEADS.items()}


def _negligible(scene: Scene, field: Deformation) -> dict[str, str]:
    """The heads whose residuals stay within head_bounds at all samples, each with the reason."""
    times = max(MIN_TIMES, deformation.time_rows(field))
    bounds = head_bounds(scene)
    largest: dict[str, float] = {}
    for n_times, samples in ((MIN_TIMES, QUICK_SAMPLES), (times, FULL_SAMPLES)):
        heads = [name for name in deformation.heads_of(field) if largest.get(name, 0.0) <= bounds[name]]
        if not heads:
            return {}
        field = deformation.with_heads(field, heads)
        largest = _largest_residuals(scene, field, n_times, samples)
    return {
        name: f"largest residual {value:.3g}, negligible up to {bounds[name]:.3g}"
        for name, value in largest.items()
        if value <= bounds[name]
    }


def _largest_residuals(scene: Scene, field: Deformation, n_times: int, samples: int) -> dict[str, float]:
    """By head, the largest |residual| (NaN counts as infinite) over times and evenly chosen anchors."""
    rows = np.flatnonzero(scene.full_masks()[-1] > 0)
    rows = rows[:: max(1, -(-rows.size // max(1, samples // n_times)))]
    points, largest = scene.anchor_at(rows), dict.fromkeys(deformation.heads_of(field), 0.0)
    for t in np.linspace(0.0, 1.0, n_times):
        with np.errstate(all="ignore"):
            found = deformation.residuals(field, scene.info.box, points, float(t)) if len(points) else {}
        for name, value in found.items():
            top = float(np.abs(value).max())
            largest[name] = max(largest[name], top if top == top else np.inf)
    return largest


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


def _without_unseen(scene: Scene, symbols: SceneSymbols) -> tuple[Scene, SceneSymbols, list[LeftOut]]:
    """(scene, its symbols, what was left out) with 0 or values of little cost in parts that no picture depends on.

    scene: planned, all rows active at its highest level. Where its symbols change, its values do.
    """
    tensors = {layer.kind.layer: layer.tensors for layer in symbols.layers if layer.tensors.networks}
    omissions = Omissions(tensors, vars(symbols.steps), _anchors(scene, symbols))
    omissions.run()
    layers, feature, width = [], scene.feature, symbols.grid.widths.feature
    if omissions.unread.any():
        feature = feature.copy()
    first = 0
    for layer in symbols.layers:
        kind, edited, rows = layer.kind, layer, slice(first, first + len(layer.anchor_q))
        if omissions.unread.any():
            edited = replace(edited, attributes=layer.attributes.copy())
            edited.attributes[:width][omissions.unread] = 0
            values = symbols.grid.dequantise(edited.attributes, edited.classes)["feature"]
            same = (layer.attributes == edited.attributes)[:width].T
            feature[rows] = np.where(same, feature[rows], values)
        if (new := omissions.tensors.get(kind.layer, layer.tensors)) is not layer.tensors:
            edited = replace(edited, tensors=new)
            given = scene.tensors(kind.layer)
            both = zip(arrays_of(given, kind), arrays_of(layer.tensors, kind), arrays_of(new, kind), strict=True)
            arrays = [
                np.where(k == now, x, dequantise(now, layer.steps[of])) for (of, _, x), (*_, k), (*_, now) in both
            ]
            scene = scene.with_tensors(kind.layer, with_arrays(given, kind, arrays))
        layers.append(edited)
        first = rows.stop
    found = [LeftOut(what, why, bits=bits, lossless=True) for what, why, bits in omissions.found]
    return replace(scene, feature=feature), replace(symbols, layers=layers), found


def _anchors(scene: Scene, symbols: SceneSymbols) -> Anchors:
    grid, width = symbols.grid, symbols.grid.widths.feature
    centre, largest, nonzero = grid.centre[:width].astype(np.int64), np.zeros(width), np.zeros(width, bool)
    for layer in symbols.layers:
        features, spacing = layer.attributes[:width], 1 << int(layer.classes.max(initial=0))
        most = np.abs(features).max(axis=1, initial=0).astype(np.float64)
        largest = np.maximum(largest, (np.abs(centre) + most * spacing) * grid.steps["feature"])
        shift = layer.classes if grid.widths.graded else 0
        nonzero |= [bool((m + (k.astype(np.int64) << shift)).any()) for m, k in zip(centre, features, strict=True)]
    low, high = scene.info.box
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    unit = np.clip((scene.anchor - low) / extent, 0.0, 1.0)
    return Anchors([layer.attributes[:width] for layer in symbols.layers], nonzero, largest, unit)
