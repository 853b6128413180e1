"""Encoder: decides which parts of a scene a file holds.

Layer l carries the anchors that become active at level l. Anchors inactive at the highest level kept are dropped. When
a layer is left out because it has no deformation, its anchors and masks pass to the highest layer kept, so that the
picture of the highest level stays the same.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec import kinds
from pd4dgs_codec.entropy.channels import Places
from pd4dgs_codec.entropy.fitting import entropy_bits
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import write_slice
from pd4dgs_codec.format.reader import Base
from pd4dgs_codec.kinds import AnyScene, hexplane
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import MAX_CLASS, Deformation, S, Scene, SceneInfo
from pd4dgs_codec.tensors.quantise import NO_CLASSES, WHOLE, Rows, RowTable, expect
from pd4dgs_codec.tensors.symbols import NO_LAYER_ROWS, Growing, LayerSymbols, first_duplicate
from pd4dgs_codec.tensors.tables import NOTHING, Kind, Tensors


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A part that was not written. Its cost is that of `anchors` average anchors if there are any, else that of coding
    the symbols `tensors`, else `bits`, the order-0 entropy that was saved. lossless: no picture changes."""

    what: str
    why: str
    tensors: Tensors | None = None
    anchors: int = 0
    bits: float = 0.0
    lossless: bool = False

    def row(self, options: EncodeOptions, kept: int, kept_bits: int) -> dict[str, Any]:
        """Returns {what, why, lossless, bytes} for the report of a file whose `kept` anchors took kept_bits bits."""
        if self.anchors:
            cost = self.anchors * kept_bits / 8 / kept if kept else 0
        elif self.tensors is not None:
            cost = tensor_bytes(self.tensors, options)
        else:
            cost = self.bits / 8
        return {"what": self.what, "why": self.why, "lossless": self.lossless, "bytes": round(cost)}


def tensor_bytes(symbols: Tensors, options: EncodeOptions) -> int:
    """Returns the bytes of grids and chains, coded as a layer without anchors."""
    empty = np.zeros(0, np.int32)
    alone = LayerSymbols(0, RowTable(), np.zeros((0, 3), np.int32), empty, empty, empty, NO_LAYER_ROWS, symbols)
    return len(write_slice(alone, options)[0])


@dataclass(frozen=True, eq=False)
class SceneSymbols:
    """A scene, or a prefix of its layers, as a file stores it. kind: of the scene. table: of the rows. base: whose rows
    come before those of the layers."""

    info: SceneInfo
    kind: Kind
    table: RowTable
    layers: Sequence[LayerSymbols]
    base: Base | None = None

    @property
    def base_rows(self) -> int:
        """Number of the base's rows, 0 without one."""
        return self.base.reference.rows if self.base else 0

    def scene(self) -> AnyScene:
        """Returns the dequantised scene (clause 11.5)."""
        grown = Growing(self.table, self.info.voxel_size, self.base.grown if self.base else None)
        for layer in self.layers:
            grown.add(layer)
        return kinds.scene_of(self.kind, self.table, self.info, grown)


@dataclass(frozen=True, eq=False)
class Plan:
    """scene: the parts of the given scene that the file holds, with other values where an omission changed symbols.
    symbols: of that scene, as the file stores them. left_out: the parts of the given scene that the file lacks."""

    scene: AnyScene
    symbols: SceneSymbols
    left_out: list[LeftOut]


def plan(scene: AnyScene, options: EncodeOptions = DEFAULTS, base: Base | None = None) -> Plan:
    """Plans a file of `scene` by options.layers and options.omit; options.step_scale is not applied.

    Steps are rounded to binary32, and rows sorted by (layer, Morton order). base: its layer 0 is not written, and its
    rows, the first ones of the scene, stay where they are. Raises EncodeError for a value that has no symbol, for
    voxels with two anchors, and for a scene that differs from its base in what the file does not hold.
    """
    left_out: list[LeftOut] = []
    scene = scene.scaled(1.0)
    auto = options.layers == "auto"
    if not auto:
        scene, left_out = _cut(scene, int(options.layers))
    base_rows = 0
    if base is not None:
        _check_over(scene, base)
        base_rows = base.reference.rows
    tensors = {layer: symbols_of(scene, layer) if layer or not base else NOTHING for layer in scene.layers}
    for layer in reversed(scene.layers[1:]):
        scene, tensors[layer], dropped = _drop_heads(scene, layer, tensors[layer])
        left_out += dropped
    kept = [layer for layer in scene.layers if layer == 0 or not auto or scene.deformation(layer) is not None]
    arranged, rows = in_file_order(scene, tuple(kept), base_rows)
    if inactive := scene.rows[-1] - len(rows):
        why = f"mask at or below the threshold at level {scene.level}"
        left_out.append(LeftOut(f"{inactive} anchors", why, anchors=inactive))
    if options.omit != "nothing" and isinstance(arranged, Scene):
        arranged, unread = _without_unread(arranged, tensors)
        left_out += unread
    table = base.header.table if base else kinds.row_table(arranged)
    if not isinstance(arranged, Scene) and not table.graded and not base:
        table = _predicted(table, list(arranged.attributes.values()), NO_CLASSES)
    layers = [
        layer_symbols(arranged, index, tensors[layer], table, options, base_rows) for index, layer in enumerate(kept)
    ]
    return Plan(arranged, SceneSymbols(arranged.info, kinds.kind_of(arranged), table, layers, base), left_out)


def _check_over(scene: AnyScene, base: Base) -> None:
    """Raises EncodeError unless the scene's first rows and the grids and chains of its layer 0 are those of the base,
    and its other rows are coded alike."""
    header, n = base.header, base.reference.rows
    table, own = header.table, kinds.row_table(scene)
    alike = own.tensors == tuple(replace(tensor, predictor=0) for tensor in table.tensors)
    alike &= kinds.kind_of(scene) == header.kind and scene.info.voxel_size == header.info.voxel_size
    alike &= own.graded == table.graded and np.array_equal(own.centre_values, table.centre_values)
    expect(alike, "kind, widths, steps, centres or voxel size, expected those of the base")
    (voxels, classes, *rows), (codes,), _ = base.grown.arrays(False)
    given = {"anchor_q": scene.anchor_q, **scene.attributes, "step classes": classes}
    given |= {"step classes": scene.grading.classes} if scene.grading else {}
    for (name, x), expected in zip(given.items(), (voxels, *rows, classes), strict=True):
        same = len(x) >= len(expected) and np.array_equal(x[: len(expected)].reshape(expected.shape), expected)
        expect(same, f"{name} of the first {n} anchors, expected those of the base")
    shown = scene.mask[0][:n]
    same = len(shown) == n and bool(((shown == codes) | (shown == 0)).all())
    expect(same, f"mask of layer 0 of the first {n} anchors, expected codes of the base or 0")
    tensors, others = kinds.tensors_of(scene, 0), base.grown.tensors[0]
    same = tensors.tables == others.tables and all(map(np.array_equal, tensors.arrays, others.arrays))
    expect(same, "networks of layer 0, expected those of the base")


def _predicted(table: RowTable, values: Sequence[np.ndarray], classes: np.ndarray) -> RowTable:
    """Returns the table with the predictor of each tensor that takes the fewest bits by order-0 entropy, of those that
    leave values as they are if one does: rows of a decoded file, whose predictors have lattices of their own. values:
    float32 [n, any] of each, in coding order."""

    def cost(tensor: Rows, x: np.ndarray, centre: np.ndarray | None) -> tuple[bool, float]:
        alone = RowTable((tensor,), centre)
        v = alone.quantise([x], classes, [f"rows {tensor.id}"])
        symbols = alone.symbols(v, classes)
        if not alone.graded:
            return False, sum(map(entropy_bits, symbols))
        moved = not np.array_equal(alone.dequantise(v)[0], x.reshape(-1, tensor.channels))
        return moved, sum(map(entropy_bits, Places.by(classes, MAX_CLASS + 1).parts(symbols)))

    centres = [None] * len(values) if table.centre is None else [m for _, m in table.of_each(table.centre)]
    chosen = [
        tensor
        if tensor.predictor == WHOLE
        else min((replace(tensor, predictor=p) for p in (0, 1)), key=lambda one: cost(one, x, m))  # noqa: B023
        for tensor, x, m in zip(table.tensors, values, centres, strict=True)
    ]
    return RowTable(tuple(chosen), table.centre)


def symbols_of(scene: AnyScene, layer: int) -> Tensors:
    """Returns the symbols of the grids and chains of a layer. Raises EncodeError for a value without a symbol."""
    given = kinds.tensors_of(scene, layer)
    names, own = kinds.array_names(scene, layer, given.tables), kinds.layer_name(scene, layer)
    return given.quantised(lambda i: f"{own} {names[i]}")


def layer_symbols(
    scene: AnyScene,
    index: int,
    tensors: Tensors = NOTHING,
    table: RowTable | None = None,
    options: EncodeOptions = DEFAULTS,
    base_rows: int = 0,
) -> LayerSymbols:
    """Returns scene.layers[index] of a scene in file order, with these symbols of its grids and chains. table: of its
    rows. base_rows: its first rows, which belong to its base. Raises EncodeError for a value that has no symbol."""
    first, last = scene.rows[index - 1] if index else base_rows, scene.rows[index]
    table = kinds.row_table(scene) if table is None else table
    codes = scene.mask[index].astype(np.int32)
    rises = codes[:first] - scene.mask[index - 1] if index else (codes[:first] == 0).astype(np.int32)
    classes = NO_CLASSES if scene.grading is None else scene.grading.classes[first:last].astype(np.int32)
    values = {name: x[first:last] for name, x in scene.attributes.items()}
    own = LayerSymbols(
        layer=scene.layers[index],
        table=table,
        anchor_q=scene.anchor_q[first:last],
        rises=rises,
        codes=codes[first:],
        classes=classes,
        rows=table.quantise(list(values.values()), classes, list(values)),
        tensors=tensors,
        fill=scene.fills[index] if scene.fills else None,
        base_rows=base_rows,
    )
    return _with_layer_rows(own, scene, last, options) if tensors.tables.rows else own


def _with_layer_rows(own: LayerSymbols, scene: AnyScene, last: int, options: EncodeOptions) -> LayerSymbols:
    """Adds the layer rows of the scene's first `last` rows. Raises EncodeError for others that are not 0."""
    earlier = NO_CLASSES if scene.grading is None else scene.grading.classes[: last - len(own.codes)].astype(np.int32)
    own, values = replace(own, earlier=earlier), kinds.rows_of(scene, own.layer, last)
    table = own.layer_table
    if not (options.slices and table.graded and len(own.codes)):  # else a row's predecessor depends on its slice
        table = _predicted(table, list(values.values()), own.all_classes)
    names = [f"{kinds.layer_name(scene, own.layer)} {name}" for name in values]
    tensors = replace(own.tensors, tables=replace(own.tensors.tables, rows=table.tensors))
    return replace(own, tensors=tensors, layer_rows=table.quantise(list(values.values()), own.all_classes, names))


def _cut(scene: AnyScene, highest: int) -> tuple[AnyScene, list[LeftOut]]:
    """Returns (the layers <= highest with the anchors of all layers, a LeftOut for each layer above)."""
    why = f"only layers up to {highest} were requested"
    above = [layer for layer in scene.layers if layer > highest]
    left_out = [LeftOut(f"layer {layer}", why, symbols_of(scene, layer)) for layer in above]
    kept = len(scene.layers) - len(left_out)
    cut = replace(
        scene.prefix(highest),
        rows=(scene.rows[-1],) * kept,
        mask=tuple(scene.full_masks()[:kept]),
        **scene.of_anchors(slice(None)),
    )
    return replace(cut, **cut.of_layers()), left_out


def _drop_heads(scene: AnyScene, layer: int, symbols: Tensors) -> tuple[AnyScene, Tensors, list[LeftOut]]:
    """Removes the heads of a layer that are zero after quantisation, or its deformation if no head is left and no layer
    above reads its planes. Returns (scene, symbols of the layer, parts left out)."""
    given, name = scene.deformation(layer), kinds.layer_name(scene, layer)
    if not isinstance(scene, Scene) or not isinstance(given, Deformation):
        return scene, symbols, []
    whole = hexplane.deformation_of(symbols)
    zero, heads = hexplane.zero_heads(whole), len(given.networks) - 1
    if len(zero) == heads and any(map(scene.deformation, range(layer + 1, 3))):
        zero = zero[1:]  # a deformation has at least one head
    why = "zero after quantisation"
    if len(zero) == heads:
        return scene.with_deformation(layer, None), NOTHING, [LeftOut(name, why, symbols)]

    def with_networks(of: Deformation, names: Iterable[str]) -> Deformation:
        return replace(of, networks={n: of.networks[n] for n in names})

    rest, steps = [n for n in given.networks if n not in zero], (symbols.tables.grid_step, symbols.tables.chain_step)
    alone = [replace(with_networks(whole, [n]), planes=()) for n in zero]
    gone = [
        LeftOut(f"{name} head {n}", why, hexplane.tensors_of_parts(part, *steps))
        for n, part in zip(zero, alone, strict=True)
    ]
    kept = hexplane.tensors_of_parts(with_networks(whole, rest), *steps)
    return scene.with_deformation(layer, with_networks(given, rest)), kept, gone


def passed(scene: Scene, index: int, rows: np.ndarray) -> Scene:
    """Moves the anchors `rows` (int64 [n]) of scene.layers[index] to the next layer by setting their mask codes of this
    one to 0. The scene returned is not planned."""
    masks = scene.full_masks()
    masks[index][rows] = 0
    return replace(scene, rows=(scene.rows[-1],) * len(masks), mask=tuple(masks))


def in_file_order(scene: S, kept: tuple[int, ...], base_rows: int = 0) -> tuple[S, np.ndarray]:
    """Returns (scene with the layers `kept` and rows sorted by (layer, Morton order), int64 [n], rows of the given
    scene in this order). Anchors with masks of 0 in all of these layers are dropped. The first base_rows rows, those of
    a base, stay as they are."""
    codes = scene.full_masks()
    by_layer = dict(zip(scene.layers, codes, strict=True))
    masks = np.stack([*(by_layer[layer] for layer in kept[:-1]), codes[-1]])
    first = np.where(masks[-1] > 0, (masks > 0).argmax(axis=0), len(kept))
    first[:base_rows] = -1
    groups = [np.flatnonzero(first == i) for i in range(len(kept))]
    ordered = [group[morton_order(scene.anchor_q[group])] if group.size else group for group in groups]
    order = np.concatenate([np.arange(base_rows), *ordered])
    rows = tuple(int(n) for n in base_rows + np.cumsum([group.size for group in groups]))
    if (voxel := first_duplicate(scene.anchor_q[order])) is not None:
        raise EncodeError(f"anchor_q: voxel {voxel} holds more than one anchor, expected one")
    if scene.grading is not None and not (scene.grading.classes[order].any() or base_rows):
        scene = replace(scene, grading=None)
    masks_of = tuple(m[order][:n] for m, n in zip(masks, rows, strict=True))
    fills = dict(zip(scene.layers, scene.fills, strict=False))
    of_kept = (*(fills[layer] for layer in kept[:-1]), scene.fills[-1]) if fills else ()
    arranged = replace(scene, layers=kept, rows=rows, mask=masks_of, fills=of_kept, **scene.of_anchors(order))
    return arranged, order


def _without_unread(scene: Scene, tensors: dict[int, Tensors]) -> tuple[Scene, list[LeftOut]]:
    """Gives plane cells that no anchor reads values of little cost. Returns (scene, parts left out).

    scene: in file order, with all rows active at its highest level. tensors: symbols by layer, which change; the values
    of the scene change where they do.
    """
    low, high = scene.info.box
    unit = np.clip((scene.anchor - low) / np.maximum(high - low, np.finfo(np.float32).tiny), 0.0, 1.0)
    left_out = list[LeftOut]()
    for layer in scene.layers[1:]:
        before, given = tensors[layer], kinds.tensors_of(scene, layer)
        after, what, bits = hexplane.without_unread(before, unit)
        if after is not before:
            own = kinds.layer_name(scene, layer)
            left_out.append(LeftOut(f"{own}: {what}", "no anchor reads them", bits=bits, lossless=True))
            rows = zip(given.arrays, before.arrays, after.arrays, after.dequantised().arrays, strict=True)
            values = given.with_arrays(np.where(old == new, x, restored) for x, old, new, restored in rows)
            scene, tensors[layer] = scene.with_deformation(layer, hexplane.deformation_of(values)), after
    return scene, left_out
