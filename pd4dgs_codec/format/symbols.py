"""A scene as integers: Scene -> SceneSymbols -> Scene. A file stores the symbols exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.deformation import NOTHING, arrays_of, dequantise_tensors, layer_steps, quantise_tensors
from pd4dgs_codec.format.quantise import MAX_SYMBOL, Grid, all_finite, classes_of, row_blocks
from pd4dgs_codec.format.registry import LAYER_KINDS, LayerKind
from pd4dgs_codec.morton import MAX_VOXEL, morton_order
from pd4dgs_codec.scene import Deformation, Grading, Scene, SceneInfo, Steps, Widths


@dataclass(frozen=True, eq=False)
class LayerSymbols:
    """The content of a layer, or of one slice of it; later slices have only anchors with masks and attributes.

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
        """Estimates the bits of each anchor, float64 [n], from the frequencies of its symbols in their channels."""
        n = len(self.anchor_q)
        bits = np.full(n, 3.0 * max(n, 2).bit_length())  # of a position
        for channel in (self.mask_own, *self.attributes):
            _, index, counts = np.unique(channel, return_inverse=True, return_counts=True)
            bits += np.log2(n / counts)[index]
        return bits


def layer_symbols(scene: Scene, index: int) -> LayerSymbols:
    """Returns the symbols of scene.layers[index]. Raises EncodeError for a value that has no symbol."""
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
    """Returns the layer that consists of these slices, in order from its first one."""
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
    """Returns a slice with the anchors `rows` int64 [n] of a layer. first: whether it carries the layer's rest too."""
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
        """Returns the symbols of a planned scene. Raises EncodeError for a value that has no symbol."""
        return SceneSymbols(scene.info, Grid.of(scene), [layer_symbols(scene, i) for i in range(len(scene.layers))])

    @property
    def steps(self) -> Steps:
        """All steps; those that no layer uses have the defaults of Steps."""
        return Steps(**self.grid.steps, **{name: q for layer in self.layers for name, q in layer.steps.items()})

    def scene(self) -> Scene:
        """Returns the dequantised scene (clause 11.5)."""
        grown = GrowingScene(self.info, self.grid)
        for layer in self.layers:
            grown.add(layer)
        return grown.scene()


# -- slices as they come -----------------------------------------------------------------------------------------------


class _Column:
    """An array [n, ...] that grows at its end. Its room grows by a quarter, so that copies take little of the time of
    decoding. Arrays that `give` returned keep their values."""

    def __init__(self, dtype: type, *shape: int):
        self._room: np.ndarray = np.empty((0, *shape), dtype)
        self.size = 0
        self._given = 0  # rows of the room that others may hold

    @property
    def values(self) -> np.ndarray:
        return self._room[: self.size]

    def give(self) -> np.ndarray:
        """Returns `values` for a caller that keeps them."""
        self._given = self.size
        return self.values

    def grow(self, n: int) -> np.ndarray:
        """Appends n rows and returns them, to be written."""
        end = self.size + n
        if end > len(self._room):
            room = np.empty((max(end, len(self._room) * 5 // 4), *self._room.shape[1:]), self._room.dtype)
            room[: self.size] = self.values
            self._room, self._given = room, 0
        first, self.size = self.size, end
        return self._room[first:end]

    def reorder(self, first: int, order: np.ndarray) -> None:
        """Reorders the rows from `first` on, in a copy if `give` returned any of them."""
        values = self.values
        if self._given <= first:
            values[first:] = values[first:][order]
            return
        self._room, self._given = np.empty_like(self._room), 0
        self._room[:first] = values[:first]
        np.take(values[first:], order, axis=0, out=self._room[first : self.size], mode="clip")  # other modes copy `out`


class GrowingScene:
    """The dequantised scene of the slices so far. Each slice is dequantised only once.

    The rows of a layer are in order of arrival until the next layer begins or `sort` is called, and then in the order
    of clause 12.2.
    """

    def __init__(self, info: SceneInfo, grid: Grid):
        self._info, self._grid = info, grid
        shapes = {name: (np.float32, shape) for name, shape in grid.widths.attributes.items()}
        columns = {"anchor_q": (np.int32, (3,)), **shapes, "classes": (np.uint8, ())}
        self._columns = {name: _Column(dtype, *shape) for name, (dtype, shape) in columns.items()}
        self._masks = list[_Column]()
        self._tensors = dict[int, Deformation]()
        self._steps = Steps(**grid.steps)
        self._first = 0  # row of the layer in progress
        self._sorted = True  # whether its rows are
        self._centre = grid.centre_values

    def add(self, part: LayerSymbols, first: bool = True) -> None:
        """Adds a slice. first: whether it is the first one of its layer."""
        n, layer = len(part.anchor_q), part.kind.layer
        if first:
            self.sort()
            self._first, codes = self._columns["anchor_q"].size, _Column(np.uint8)
            before = self.codes
            raised = codes.grow(len(before))
            np.add(before, part.mask_increase, out=raised, casting="unsafe")
            self._masks.append(codes)
            self._steps = replace(self._steps, **part.steps)
            self._tensors[layer] = dequantise_tensors(part.tensors, part.kind, self._steps)
        self._sorted = first or (self._sorted and not n)
        self._masks[-1].grow(n)[:] = part.mask_own
        self._columns["anchor_q"].grow(n)[:] = part.anchor_q
        self._columns["classes"].grow(part.classes.size)[:] = part.classes
        rows = {name: self._columns[name].grow(n) for name in self._grid.widths.attributes}
        for at in row_blocks(n):
            for name, x in self._grid.dequantise(part.attributes[:, at], part.classes[at]).items():
                rows[name][at] = x

    def sort(self) -> None:
        """Sorts the rows of the layer in progress by Morton order."""
        if self._sorted:
            return
        order = morton_order(self._columns["anchor_q"].values[self._first :])
        for column in (*self._columns.values(), self._masks[-1]):
            if column.size:
                column.reorder(self._first, order)
        self._sorted = True

    @property
    def codes(self) -> np.ndarray:
        """uint8 [rows so far]: the mask codes of the latest layer."""
        return self._masks[-1].values if self._masks else np.zeros(0, np.uint8)

    def scene(self, writeable: bool = True) -> Scene:
        """Returns the scene so far, of at least one slice. Scenes share their arrays: write to at most one of them."""
        arrays = {name: column.give() for name, column in self._columns.items()}
        masks = tuple(column.give() for column in self._masks)
        for array in (*arrays.values(), *masks):
            array.flags.writeable = writeable
        classes, tensors = arrays.pop("classes"), self._tensors
        return Scene(
            info=self._info,
            steps=self._steps,
            layers=tuple(tensors),
            rows=tuple(codes.size for codes in masks),
            mask=masks,
            networks=tensors[0].networks,
            global_deformation=tensors[1] if 1 in tensors and tensors[1].networks else None,
            local_deformation=tensors[2] if 2 in tensors and tensors[2].networks else None,
            grading=Grading(classes, self._centre) if self._grid.widths.graded else None,
            **arrays,
        )


# -- rules between slices ----------------------------------------------------------------------------------------------


def check_slice(layer: LayerSymbols, before: np.ndarray, voxel_size: float, grid: Grid) -> None:
    """Checks a slice against the header and the mask codes before it, uint8 [rows before].

    Raises Malformed if a mask code is above 255, an attribute lies too many steps from 0, or a dequantised value would
    not be finite.
    """
    where = f"layer {layer.kind.layer}"
    if layer.mask_increase.size:
        highest = int((before + layer.mask_increase).max())
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
        self._runs = list[np.ndarray]()  # ascending keys, each run more than twice as long as the next

    def take(self, anchor_q: np.ndarray) -> None:
        """Adds distinct voxels int32 [n, 3]. Raises Malformed if one of them is taken already."""
        keys = np.sort(_voxel_keys(anchor_q))
        for run in self._runs:
            taken = np.flatnonzero(run[np.minimum(np.searchsorted(run, keys), run.size - 1)] == keys)
            if taken.size:
                raise Malformed(f"voxel {_voxel_of(keys[taken[0]])} holds more than one anchor, expected one")
        while keys.size and self._runs and self._runs[-1].size <= 2 * keys.size:
            keys = np.sort(np.concatenate([self._runs.pop(), keys]), kind="stable")
        self._runs += [keys] if keys.size else []


def first_duplicate(anchor_q: np.ndarray) -> list[int] | None:
    """Returns a voxel [x, y, z] that occurs more than once in anchor_q [N, 3], all within ±MAX_VOXEL, or None."""
    keys = np.sort(_voxel_keys(anchor_q), kind="stable")  # fast: layers are already sorted, by another key
    same = np.flatnonzero(keys[1:] == keys[:-1])
    return _voxel_of(keys[same[0]]) if same.size else None


_SIDE = 2 * MAX_VOXEL + 1  # its third power is below 2**64


def _voxel_keys(anchor_q: np.ndarray) -> np.ndarray:
    """Returns a distinct number, uint64 [N], for each voxel int [N, 3]."""
    x, y, z = (anchor_q.T.astype(np.int64) + MAX_VOXEL).astype(np.uint64)
    keys: np.ndarray = (x * np.uint64(_SIDE) + y) * np.uint64(_SIDE) + z
    return keys


def _voxel_of(key: np.uint64) -> list[int]:
    rest, z = divmod(int(key), _SIDE)
    x, y = divmod(rest, _SIDE)
    return [v - MAX_VOXEL for v in (x, y, z)]
