"""A layer as integers: Scene -> LayerSymbols -> Scene. What lies between is exactly what a file stores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.kinds import LAYER_KINDS, LayerKind
from pd4dgs_codec.format.quantise import MAX_SYMBOL, all_finite, dequantise, quantise
from pd4dgs_codec.format.table import Grid, attribute_rows, classes_of, row_blocks
from pd4dgs_codec.morton import MAX_VOXEL, morton_order
from pd4dgs_codec.scene import PLANES, Deformation, Grading, Network, Planes, Scene, SceneInfo, Steps, Widths

#: (name for messages, array) -> array of the same shape.
ArrayMap = Callable[[str, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class LayerSymbols:
    """What one layer carries, or one slice of it: later slices have anchors with their masks and attributes alone.

    widths: of the anchors. anchor_q: int32 [n, 3] voxel indices of its own anchors, in Morton order. mask_increase:
    int32 [rows before] rise of the earlier anchors' mask codes, mask_own: int32 [n] codes of its own. classes: int32
    [n] step classes, or NO_CLASSES. attributes: int32 [channels, n]. planes, networks: int32 symbols;
    networks in the order of their registry ids. steps: quantisation steps of this layer by name, as in
    LayerKind.step_names; empty if it has no networks.
    """

    kind: LayerKind
    widths: Widths
    anchor_q: np.ndarray
    mask_increase: np.ndarray
    mask_own: np.ndarray
    classes: np.ndarray
    attributes: np.ndarray
    planes: Planes
    networks: dict[str, Network]
    steps: dict[str, float]

    def tensors(self) -> Iterator[np.ndarray]:
        """The planes (scale by scale, in PLANES' order), then weight and bias of each linear layer of each network."""
        for scale in self.planes:
            yield from (scale[name] for name, _, _ in PLANES)
        for network in self.networks.values():
            for weight, bias in network:
                yield weight
                yield bias

    def arrays(self) -> list[np.ndarray]:
        """All arrays in their canonical order, the one in which info --hashes digests the integers among them."""
        return [self.anchor_q, self.mask_increase, self.mask_own, self.classes, self.attributes, *self.tensors()]


def merged(slices: Sequence[LayerSymbols]) -> LayerSymbols:
    """The layer of these slices, its first ones."""
    if len(slices) == 1:
        return slices[0]
    anchor_q = np.concatenate([part.anchor_q for part in slices])
    order = morton_order(anchor_q)
    return replace(
        slices[0],
        anchor_q=anchor_q[order],
        mask_own=np.concatenate([part.mask_own for part in slices])[order],
        classes=np.concatenate([part.classes for part in slices])[order if slices[0].widths.graded else slice(0)],
        attributes=np.concatenate([part.attributes for part in slices], axis=1)[:, order],
    )


def sliced(layer: LayerSymbols, parts: Sequence[np.ndarray]) -> list[LayerSymbols]:
    """The slices of a layer, of these rows int64 [n] each, all rows once. The inverse of `merged`."""
    ordered = [rows[morton_order(layer.anchor_q[rows])] for rows in parts]
    bare = replace(layer, mask_increase=layer.mask_increase[:0], planes=(), networks={}, steps={})
    return [
        replace(
            bare if number else layer,
            anchor_q=layer.anchor_q[rows],
            mask_own=layer.mask_own[rows],
            classes=layer.classes[rows] if layer.widths.graded else layer.classes,
            attributes=layer.attributes[:, rows],
        )
        for number, rows in enumerate(ordered)
    ]


def map_deformation(deformation: Deformation, of_planes: ArrayMap, of_weights: ArrayMap) -> Deformation:
    """`deformation` with of_planes(name, array) and of_weights(name, array) applied to its arrays."""
    planes = tuple({p: of_planes(f"plane {p}", scale[p]) for p, _, _ in PLANES} for scale in deformation.planes)
    return Deformation(planes, map_networks(deformation.networks, of_weights))


def map_networks(networks: dict[str, Network], function: ArrayMap) -> dict[str, Network]:
    """`networks` with function(name, array) applied to every weight and bias."""
    return {
        name: tuple((function(f"{name} weight", w), function(f"{name} bias", b)) for w, b in network)
        for name, network in networks.items()
    }


def quantise_tensors(tensors: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """int32 symbols of a layer's planes and networks."""
    return map_deformation(
        tensors,
        lambda name, x: quantise(x, steps.planes(kind.layer), f"{kind.name} {name}"),
        lambda name, x: quantise(x, steps.weights(kind.layer), f"{kind.name} {name}"),
    )


def dequantise_tensors(tensors: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """The float32 planes and networks of those symbols."""
    return map_deformation(
        tensors,
        lambda _, k: dequantise(k, steps.planes(kind.layer)),
        lambda _, k: dequantise(k, steps.weights(kind.layer)),
    )


def round_tensors(tensors: Deformation, kind: LayerKind, steps: Steps) -> Deformation:
    """A layer's planes and networks with the values that come back. Raises EncodeError for one that has no symbol."""
    return dequantise_tensors(quantise_tensors(tensors, kind, steps), kind, steps)


def layer_steps(steps: Steps, kind: LayerKind) -> dict[str, float]:
    """The steps in the chunk of a layer by name, as in LayerKind.step_names."""
    planes = {} if kind.planes_step is None else {kind.planes_step: steps.planes(kind.layer)}
    return planes | {kind.weights_step: steps.weights(kind.layer)}


def layer_symbols(scene: Scene, index: int) -> LayerSymbols:
    """The symbols of scene.layers[index]. Raises EncodeError for a value that has no symbol."""
    kind = LAYER_KINDS[scene.layers[index]]
    first, last = (scene.rows[index - 1] if index else 0), scene.rows[index]
    codes = scene.mask[index].astype(np.int32)
    before = scene.mask[index - 1].astype(np.int32) if index else codes[:0]
    tensors = quantise_tensors(scene.tensors(kind.layer), kind, scene.steps)
    classes = classes_of(scene)[first:last]
    return LayerSymbols(
        kind=kind,
        widths=scene.widths,
        anchor_q=scene.anchor_q[first:last],
        mask_increase=codes[:first] - before,
        mask_own=codes[first:],
        classes=classes,
        attributes=Grid.of(scene).quantise({k: v[first:last] for k, v in scene.attributes.items()}, classes),
        planes=tensors.planes,
        networks={name: tensors.networks[name] for name in kind.network_ids if name in tensors.networks},
        steps=layer_steps(scene.steps, kind) if tensors.networks else {},
    )


def assemble(info: SceneInfo, grid: Grid, layers: Sequence[LayerSymbols]) -> Scene:
    """The decoded scene of a prefix of layers (clause "dequantisation"), each of which check_last_layer let pass.

    Steps of absent tensors keep Steps' defaults.
    """
    scene = outline(info, grid, layers)
    values: dict[str, Any] = {
        name: np.empty((scene.rows[-1], *x.shape[1:]), np.float32) for name, x in scene.attributes.items()
    }
    for rows, block in attribute_blocks(grid, layers):
        for name, x in block.items():
            values[name][rows] = x
    return replace(scene, **values)


def attribute_blocks(grid: Grid, layers: Sequence[LayerSymbols]) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """(some rows of the decoded scene, float32 [rows, ...] by name of the attribute), together all of them."""
    first = 0
    for layer in layers:
        for rows in row_blocks(len(layer.anchor_q)):
            values = grid.dequantise(layer.attributes[:, rows], layer.classes[rows])
            yield slice(first + rows.start, first + rows.stop), values
        first += len(layer.anchor_q)


def outline(info: SceneInfo, grid: Grid, layers: Sequence[LayerSymbols]) -> Scene:
    """The scene that `assemble` gives, with attributes of no rows: they are most of it."""
    steps = Steps(**grid.steps, **{k: v for layer in layers for k, v in layer.steps.items()})
    classes = np.concatenate([layer.classes for layer in layers])
    values = grid.dequantise(layers[0].attributes[:, :0], classes[:0])
    grading = None
    if grid.widths.graded:
        rows = attribute_rows(grid.centre, grid.widths)
        centre = np.concatenate([dequantise(m, grid.steps[name]) for name, m in rows])
        grading = Grading(classes.astype(np.uint8), centre)
    masks = _mask_codes(layers)
    tensors = {layer.kind.layer: _decoded_tensors(layer, steps) for layer in layers}
    return Scene(
        info=info,
        steps=steps,
        layers=tuple(layer.kind.layer for layer in layers),
        rows=tuple(m.size for m in masks),
        anchor_q=np.concatenate([layer.anchor_q for layer in layers]),
        mask=tuple(m.astype(np.uint8) for m in masks),
        networks=tensors[0].networks,
        global_deformation=tensors[1] if 1 in tensors and tensors[1].networks else None,
        local_deformation=tensors[2] if 2 in tensors and tensors[2].networks else None,
        grading=grading,
        **values,
    )


def _mask_codes(layers: Sequence[LayerSymbols]) -> list[np.ndarray]:
    """int32 codes of all rows so far, per layer: sums of the rises (clause "masks")."""
    masks: list[np.ndarray] = []
    for layer in layers:
        raised = masks[-1] + layer.mask_increase if masks else layer.mask_increase
        masks.append(np.concatenate([raised, layer.mask_own]))
    return masks


class TakenVoxels:
    """The voxels of the slices so far."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.uint64)  # ascending

    def take(self, anchor_q: np.ndarray) -> None:
        """Adds int32 [n, 3], which differ among themselves. Raises Malformed if one is taken."""
        keys = np.sort(_voxel_keys(anchor_q))
        at = np.searchsorted(self._keys, keys)
        taken = np.flatnonzero(self._keys[np.minimum(at, self._keys.size - 1)] == keys) if self._keys.size else at[:0]
        if taken.size:
            raise Malformed(f"voxel {_voxel_of(keys[taken[0]])} holds more than one anchor, expected one")
        self._keys = np.insert(self._keys, at, keys)


def check_last_layer(layers: Sequence[LayerSymbols], taken: TakenVoxels, voxel_size: float, grid: Grid) -> None:
    """The rules for a slice that its payload alone cannot show broken, given the header and what stands before it.

    layers: the slice, after the layers before its own. taken: by the slices before; its own voxels are added. Raises
    Malformed if a mask code is above 255, a voxel is taken, an attribute lies too many steps from 0, or a reconstructed
    value would not be finite.
    """
    layer = layers[-1]
    if layer.mask_increase.size:
        highest = int((_mask_codes(layers[:-1])[-1] + layer.mask_increase).max())
        if highest > 255:
            raise Malformed(f"layer {layer.kind.layer}: mask code {highest}, expected at most 255")
    taken.take(layer.anchor_q)
    check_attributes(layer, grid)
    _check_finite(layer, _with_steps(layer, voxel_size))


def check_attributes(layer: LayerSymbols, grid: Grid) -> None:
    """Raises Malformed if an attribute lies too many steps from 0, or would not be finite."""
    farthest = grid.farthest(layer.attributes, layer.classes)
    if max(farthest.values()) > MAX_SYMBOL:
        raise Malformed(f"layer {layer.kind.layer}: an attribute more than {MAX_SYMBOL} steps from 0")
    _check_finite(layer, ((np.array(steps), grid.steps[name]) for name, steps in farthest.items()))


def _check_finite(layer: LayerSymbols, multiples: Iterable[tuple[np.ndarray, float]]) -> None:
    if not all(all_finite(k, step) for k, step in multiples):
        raise Malformed(f"layer {layer.kind.layer}: a reconstructed value is not finite")


def _with_steps(layer: LayerSymbols, voxel_size: float) -> Iterator[tuple[np.ndarray, float]]:
    """(multiples, their step) of everything in `layer` that is dequantised but the attributes."""
    yield layer.anchor_q, voxel_size
    planes, steps = len(PLANES) * len(layer.planes), list(layer.steps.values())
    yield from ((k, steps[0 if i < planes else -1]) for i, k in enumerate(layer.tensors()))


def _decoded_tensors(layer: LayerSymbols, steps: Steps) -> Deformation:
    return dequantise_tensors(Deformation(layer.planes, layer.networks), layer.kind, steps)


def rounded(scene: Scene) -> Scene:
    """`scene` with the values that come back from its file. Raises EncodeError for one that has no symbol."""
    steps = scene.steps
    grid, classes = Grid.of(scene), classes_of(scene)
    values: dict[str, Any] = {name: grid.rounded(name, x, classes) for name, x in scene.attributes.items()}
    result = replace(scene, **values)
    for kind in LAYER_KINDS:
        if kind.layer == 0 or scene.deformation(kind.layer) is not None:
            result = result.with_tensors(kind.layer, round_tensors(scene.tensors(kind.layer), kind, steps))
    return result


def float_tensors(scene: Scene, index: int) -> list[np.ndarray]:
    """The float32 arrays of scene.layers[index] alone: anchor, attributes in the table's order, planes, networks."""
    kind = LAYER_KINDS[scene.layers[index]]
    own = slice(scene.rows[index - 1] if index else 0, scene.rows[index])
    tensors = scene.tensors(kind.layer)
    ordered = [tensors.networks[name] for name in kind.network_ids if name in tensors.networks]
    return [
        scene.anchor_at(own),
        *(values[own] for values in scene.attributes.values()),
        *(scale[name] for scale in tensors.planes for name, _, _ in PLANES),
        *(array for network in ordered for pair in network for array in pair),
    ]


def first_duplicate(anchor_q: np.ndarray) -> np.ndarray | None:
    """A row [3] that occurs more than once in anchor_q [N, 3], all within ±MAX_VOXEL, or None."""
    keys = np.sort(_voxel_keys(anchor_q), kind="stable")  # layers are sorted already, if by another key
    same = np.flatnonzero(keys[1:] == keys[:-1])
    return np.array(_voxel_of(keys[same[0]])) if same.size else None


_SIDE = 2 * MAX_VOXEL + 1  # its third power is just below 2**64


def _voxel_keys(anchor_q: np.ndarray) -> np.ndarray:
    """uint64 [N]: a number of its own for each voxel int [N, 3]."""
    x, y, z = (anchor_q.T.astype(np.int64) + MAX_VOXEL).astype(np.uint64)
    keys: np.ndarray = (x * np.uint64(_SIDE) + y) * np.uint64(_SIDE) + z
    return keys


def _voxel_of(key: np.uint64) -> list[int]:
    rest, z = divmod(int(key), _SIDE)
    x, y = divmod(rest, _SIDE)
    return [v - MAX_VOXEL for v in (x, y, z)]
