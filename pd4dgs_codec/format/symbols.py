"""A scene as integers: Scene -> SceneSymbols -> Scene. A file stores the symbols exactly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.deformation import (
    NOTHING,
    arrays_of,
    dequantise_tensors,
    layer_steps,
    quantise_tensors,
)
from pd4dgs_codec.format.quantise import MAX_SYMBOL, Grid, all_finite, classes_of, row_blocks
from pd4dgs_codec.format.registry import LAYER_KINDS, LayerKind
from pd4dgs_codec.morton import MAX_VOXEL, morton_order
from pd4dgs_codec.scene import Deformation, Grading, Scene, SceneInfo, Steps, Widths


@dataclass(frozen=True, eq=False)
class LayerSymbols:
    """The content of a layer, or of one slice of it; later slices have anchors with masks and attributes alone.

    widths: of the anchors. anchor_q: int32 [n, 3] voxel indices of its own anchors, in Morton order. mask_increase:
    int32 [rows before] rise of the earlier anchors' mask codes. mask_own: int32 [n] codes of its own anchors. classes:
    int32 [n] step classes, or NO_CLASSES. attributes: int32 [channels, n]. tensors: int32 planes and networks, the
    networks in the order of their numbers. steps: the steps in its chunk by name; none if it has no networks.
    """

    kind: LayerKind
    widths: Widths
    anchor_q: np.ndarray
    mask_increase: np.ndarray
    mask_own: np.ndarray
    classes: np.ndarray
    attributes: np.ndarray
    tensors: Deformation
    steps: dict[str, float]

    def arrays(self) -> list[np.ndarray]:
        """All arrays, in the order in which info --hashes digests them."""
        own = [self.anchor_q, self.mask_increase, self.mask_own, self.classes, self.attributes]
        return own + [array for *_, array in arrays_of(self.tensors, self.kind)]

    def bits_per_row(self) -> np.ndarray:
        """float64 [n]: about the bits that each anchor takes, by the frequencies of its symbols in their channels."""
        n = len(self.anchor_q)
        bits = np.full(n, 3.0 * max(n, 2).bit_length())  # of a position
        for channel in (self.mask_own, *self.attributes):
            _, index, counts = np.unique(channel, return_inverse=True, return_counts=True)
            bits += np.log2(n / counts)[index]
        return bits


def layer_symbols(scene: Scene, index: int) -> LayerSymbols:
    """The symbols of scene.layers[index]. Raises EncodeError for a value that has no symbol."""
    kind = LAYER_KINDS[scene.layers[index]]
    first, last = (scene.rows[index - 1] if index else 0), scene.rows[index]
    codes = scene.mask[index].astype(np.int32)
    before = scene.mask[index - 1].astype(np.int32) if index else codes[:0]
    tensors, classes = scene.tensors(kind.layer), classes_of(scene)[first:last]
    return LayerSymbols(
        kind=kind,
        widths=scene.widths,
        anchor_q=scene.anchor_q[first:last],
        mask_increase=codes[:first] - before,
        mask_own=codes[first:],
        classes=classes,
        attributes=Grid.of(scene).quantise({k: v[first:last] for k, v in scene.attributes.items()}, classes),
        tensors=quantise_tensors(tensors, kind, scene.steps),
        steps=layer_steps(scene.steps, kind, tensors),
    )


def merged(slices: Sequence[LayerSymbols]) -> LayerSymbols:
    """The layer that consists of these slices, in order from its first one."""
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


def sliced(layer: LayerSymbols, rows: np.ndarray, first: bool) -> LayerSymbols:
    """A slice of a layer with the anchors `rows` int64 [n]. first: it also carries the rest of the layer."""
    rows = rows[morton_order(layer.anchor_q[rows])]
    part = layer if first else replace(layer, mask_increase=layer.mask_increase[:0], tensors=NOTHING, steps={})
    return replace(
        part,
        anchor_q=layer.anchor_q[rows],
        mask_own=layer.mask_own[rows],
        classes=layer.classes[rows] if layer.widths.graded else layer.classes,
        attributes=layer.attributes[:, rows],
    )


@dataclass(frozen=True, eq=False)
class SceneSymbols:
    """A scene, or a prefix of its layers, as a file stores it. grid: of the attributes."""

    info: SceneInfo
    grid: Grid
    layers: Sequence[LayerSymbols]

    @staticmethod
    def of(scene: Scene) -> SceneSymbols:
        """The symbols of a planned scene. Raises EncodeError for a value that has none."""
        return SceneSymbols(scene.info, Grid.of(scene), [layer_symbols(scene, i) for i in range(len(scene.layers))])

    @property
    def steps(self) -> Steps:
        """All steps; those that no layer uses have the defaults of Steps."""
        return Steps(**self.grid.steps, **{name: q for layer in self.layers for name, q in layer.steps.items()})

    def blocks(self) -> Iterator[tuple[slice, np.ndarray, dict[str, np.ndarray]]]:
        """(rows of the scene, their step classes, their attributes float32 [n, ...] by name), a few rows at a time."""
        first = 0
        for layer in self.layers:
            for rows in row_blocks(len(layer.anchor_q)):
                classes = layer.classes[rows]
                values = self.grid.dequantise(layer.attributes[:, rows], classes)
                yield slice(first + rows.start, first + rows.stop), classes, values
            first += len(layer.anchor_q)

    def scene(self) -> Scene:
        """The dequantised scene (clause 11.5)."""
        masks, steps, widths = _mask_codes(self.layers), self.steps, self.grid.widths
        n = masks[-1].size
        values: dict[str, Any] = {name: np.empty((n, *one), np.float32) for name, one in widths.attributes.items()}
        for rows, _, block in self.blocks():
            for name, x in block.items():
                values[name][rows] = x
        classes = np.concatenate([layer.classes for layer in self.layers]).astype(np.uint8)
        tensors = {x.kind.layer: dequantise_tensors(x.tensors, x.kind, steps) for x in self.layers}
        return Scene(
            info=self.info,
            steps=steps,
            layers=tuple(layer.kind.layer for layer in self.layers),
            rows=tuple(codes.size for codes in masks),
            anchor_q=np.concatenate([layer.anchor_q for layer in self.layers]),
            mask=tuple(codes.astype(np.uint8) for codes in masks),
            networks=tensors[0].networks,
            global_deformation=tensors[1] if 1 in tensors and tensors[1].networks else None,
            local_deformation=tensors[2] if 2 in tensors and tensors[2].networks else None,
            grading=Grading(classes, self.grid.centre_values) if widths.graded else None,
            **values,
        )


def rounded(scene: Scene) -> Scene:
    """A planned scene with the values that come back from its file. Raises EncodeError for one that has no symbol."""
    return replace(SceneSymbols.of(scene).scene(), steps=scene.steps)


def float_tensors(scene: Scene, index: int) -> list[np.ndarray]:
    """The float32 arrays of scene.layers[index] alone: positions, attributes, planes, networks, in coding order."""
    kind = LAYER_KINDS[scene.layers[index]]
    own = slice(scene.rows[index - 1] if index else 0, scene.rows[index])
    attributes = [values[own] for values in scene.attributes.values()]
    return [scene.anchor_at(own), *attributes, *(x for *_, x in arrays_of(scene.tensors(kind.layer), kind))]


def _mask_codes(layers: Sequence[LayerSymbols]) -> list[np.ndarray]:
    """int32 codes of all rows so far, per layer: sums of the rises (clause 11.1)."""
    masks: list[np.ndarray] = []
    for layer in layers:
        raised = masks[-1] + layer.mask_increase if masks else layer.mask_increase
        masks.append(np.concatenate([raised, layer.mask_own]))
    return masks


# -- rules between slices ----------------------------------------------------------------------------------------------


def check_slice(layers: Sequence[LayerSymbols], voxel_size: float, grid: Grid) -> None:
    """Check a slice against the header and the layers before its own; `layers` ends with it.

    Raises Malformed if a mask code is above 255, an attribute lies too many steps from 0, or a dequantised value would
    not be finite.
    """
    layer = layers[-1]
    where = f"layer {layer.kind.layer}"
    if layer.mask_increase.size:
        highest = int((_mask_codes(layers[:-1])[-1] + layer.mask_increase).max())
        if highest > 255:
            raise Malformed(f"{where}: mask code {highest}, expected at most 255")
    farthest = grid.farthest(layer.attributes, layer.classes)
    if max(farthest.values()) > MAX_SYMBOL:
        raise Malformed(f"{where}: an attribute more than {MAX_SYMBOL} steps from 0")
    stored = [(layer.anchor_q, voxel_size), *((np.array(k), grid.steps[name]) for name, k in farthest.items())]
    stored += [(k, layer.steps[name]) for name, _, k in arrays_of(layer.tensors, layer.kind)]
    if not all(all_finite(k, step) for k, step in stored):
        raise Malformed(f"{where}: a dequantised value is not finite")


class TakenVoxels:
    """The voxels of the slices so far."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.uint64)  # ascending

    def take(self, anchor_q: np.ndarray) -> None:
        """Add voxels int32 [n, 3], which differ among themselves. Raises Malformed if one is taken."""
        keys = np.sort(_voxel_keys(anchor_q))
        at = np.searchsorted(self._keys, keys)
        taken = np.flatnonzero(self._keys[np.minimum(at, self._keys.size - 1)] == keys) if self._keys.size else at[:0]
        if taken.size:
            raise Malformed(f"voxel {_voxel_of(keys[taken[0]])} holds more than one anchor, expected one")
        self._keys = np.insert(self._keys, at, keys)


def first_duplicate(anchor_q: np.ndarray) -> list[int] | None:
    """A voxel [x, y, z] that occurs more than once in anchor_q [N, 3], all within ±MAX_VOXEL, or None."""
    keys = np.sort(_voxel_keys(anchor_q), kind="stable")  # layers are sorted already, if by another key
    same = np.flatnonzero(keys[1:] == keys[:-1])
    return _voxel_of(keys[same[0]]) if same.size else None


_SIDE = 2 * MAX_VOXEL + 1  # its third power is just below 2**64


def _voxel_keys(anchor_q: np.ndarray) -> np.ndarray:
    """uint64 [N]: a distinct number for each voxel int [N, 3]."""
    x, y, z = (anchor_q.T.astype(np.int64) + MAX_VOXEL).astype(np.uint64)
    keys: np.ndarray = (x * np.uint64(_SIDE) + y) * np.uint64(_SIDE) + z
    return keys


def _voxel_of(key: np.uint64) -> list[int]:
    rest, z = divmod(int(key), _SIDE)
    x, y = divmod(rest, _SIDE)
    return [v - MAX_VOXEL for v in (x, y, z)]
