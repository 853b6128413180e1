"""The layers of a file as integers and as values, slice by slice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.morton import MAX_VOXEL, morton_order
from pd4dgs_codec.scene import MASK_MIN_CODE, Network
from pd4dgs_codec.tensors.quantise import NO_CLASSES, RowTable, all_finite, dequantise
from pd4dgs_codec.tensors.tables import Fill, Tables, Tensors

NO_LAYER_ROWS = np.zeros((0, 0), np.int32)


@dataclass(frozen=True, eq=False)
class LayerSymbols:
    """The content of a layer, or of one slice of it; later slices have only anchors.

    anchor_q: int32 [n, 3] voxel indices of its own anchors, in Morton order. rises: int32 [rows before], of the earlier
    anchors' mask codes. codes: int32 [n], of its own anchors. classes: int32 [n] step classes, or NO_CLASSES. rows:
    int32 [W, n], in steps. tensors: int32. fill: what a prefix that ends here has behind its Gaussians; None: the
    background. earlier: int32 [rows before], the step classes of earlier anchors, empty without any and in a later
    slice. layer_rows: int32 [channels, rows before + n], in steps; in a later slice only of its own anchors. bits: that
    each group of channels took in the file, by its name, if it was read from one. base_rows: so many of the earlier
    anchors are those of the file's base; in its layer 0 a rise is 1 for those that it hides, else 0.
    """

    layer: int
    table: RowTable
    anchor_q: np.ndarray
    rises: np.ndarray
    codes: np.ndarray
    classes: np.ndarray
    rows: np.ndarray
    tensors: Tensors
    fill: Fill | None = None
    earlier: np.ndarray = field(default_factory=lambda: NO_CLASSES)
    layer_rows: np.ndarray = field(default_factory=lambda: NO_LAYER_ROWS)
    bits: Mapping[str, int] = field(default_factory=dict)
    base_rows: int = 0

    @property
    def layer_table(self) -> RowTable:
        """The table of the layer rows."""
        rows = RowTable(self.tensors.tables.rows)
        return RowTable(rows.tensors, np.zeros(rows.channels, np.int32)) if self.table.graded else rows

    @property
    def all_classes(self) -> np.ndarray:
        """int32 [rows before + n], or NO_CLASSES: the step classes of the layer rows."""
        return np.concatenate([self.earlier, self.classes])

    def arrays(self) -> list[np.ndarray]:
        """All arrays, in the order in which info --hashes digests them."""
        own = [self.anchor_q, self.rises, self.codes, self.classes, self.rows, self.layer_rows]
        return own + self.tensors.arrays

    def bits_per_row(self) -> np.ndarray:
        """Estimates the bits of each anchor, float64 [n], from the frequencies of its symbols in their channels."""
        n = len(self.anchor_q)
        bits = np.full(n, 3.0 * max(n, 2).bit_length())  # of a position
        for channel in (self.codes, *self.table.symbols(self.rows, self.classes)):
            _, index, counts = np.unique(channel, return_inverse=True, return_counts=True)
            bits += np.log2(n / counts)[index]
        return bits


def merged(slices: Sequence[LayerSymbols]) -> LayerSymbols:
    """Returns the layer that consists of these slices, in order from its first one."""
    if len(slices) == 1:
        return slices[0]
    anchor_q = np.concatenate([part.anchor_q for part in slices])
    order, earlier = morton_order(anchor_q), len(slices[0].rises)
    classes = np.concatenate([part.classes for part in slices])
    layer_rows = np.concatenate([part.layer_rows for part in slices], axis=1)
    if layer_rows.size:
        layer_rows = layer_rows[:, np.concatenate([np.arange(earlier), earlier + order])]
    return replace(
        slices[0],
        anchor_q=anchor_q[order],
        codes=np.concatenate([part.codes for part in slices])[order],
        classes=classes[order] if len(classes) else classes,
        rows=np.concatenate([part.rows for part in slices], axis=1)[:, order],
        fill=slices[-1].fill,
        layer_rows=layer_rows,
        bits={name: sum(part.bits.get(name, 0) for part in slices) for name in slices[0].bits},
    )


def sliced(layer: LayerSymbols, rows: np.ndarray, first: bool) -> LayerSymbols:
    """Returns a slice with the anchors `rows` int64 [n] of a layer. first: whether it carries the layer's rest too."""
    rows, earlier = rows[morton_order(layer.anchor_q[rows])], len(layer.rises)
    part, kept = layer, np.concatenate([np.arange(earlier if first else 0), earlier + rows])
    if not first:
        tensors = Tensors(Tables(rows=layer.tensors.tables.rows))
        part = replace(layer, rises=layer.rises[:0], tensors=tensors, earlier=NO_CLASSES, base_rows=0)
    return replace(
        part,
        layer_rows=layer.layer_rows[:, kept] if layer.layer_rows.size else layer.layer_rows,
        anchor_q=layer.anchor_q[rows],
        codes=layer.codes[rows],
        classes=layer.classes[rows] if len(layer.classes) else layer.classes,
        rows=layer.rows[:, rows],
    )


@dataclass(frozen=True, eq=False)
class LayerTensors:
    """A decoded layer: the values of its slices, by form and id.

    layer: its number. kind: of its deformation (number, parameters), empty if it states none. fill: RGB 0..255 behind
    its Gaussians, None for the background. voxels: int32 [n, 3] and positions: float32 [n, 3] of its own anchors.
    codes: uint8 [N], the mask codes of the anchors of all layers so far. classes: uint8 [n] step classes, 0 without
    any. rows: float32 [n, C] by id. layer_rows: float32 [N, C] by id. grids: planes float32 [C, H, W] by id. chains:
    (weight [outputs, inputs], bias [outputs]) of each linear layer by id, float32.
    """

    layer: int
    kind: tuple[int, ...]
    fill: Fill | None
    voxels: np.ndarray
    positions: np.ndarray
    codes: np.ndarray
    classes: np.ndarray
    rows: dict[int, np.ndarray]
    layer_rows: dict[int, np.ndarray]
    grids: dict[int, tuple[np.ndarray, ...]]
    chains: dict[int, Network]


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


class Growing:
    """The values of the slices so far. Each slice is dequantised only once.

    The rows of a layer are in order of arrival until the next layer begins or `sort` is called, and then in the order
    of clause 12.2. base: of the base's layer 0, whose rows are the first ones of layer 0.
    """

    def __init__(self, table: RowTable, voxel_size: float, base: Growing | None = None):
        self._table, self._voxel_size = table, voxel_size
        self._anchor_q, self._classes = _Column(np.int32, 3), _Column(np.uint8)
        self._rows = [_Column(np.float32, tensor.channels) for tensor in table.tensors]
        self._codes = list[_Column]()
        self._layer_rows = list[list[_Column]]()  # by layer present
        self.tensors = dict[int, Tensors]()  #: float32, by layer
        self.fills = dict[int, Fill | None]()  #: by layer
        self._first = 0  # row of the layer in progress
        self._sorted = True  # whether its rows are
        if base is not None:
            self._codes, self._layer_rows = [_Column(np.uint8)], [[]]
            own, others = (
                (one._anchor_q, one._classes, *one._rows, one._codes[0])  # noqa: SLF001
                for one in (self, base)
            )
            for column, values in zip(own, others, strict=True):
                column.grow(values.size)[:] = values.values
            self.tensors, self.fills = dict(base.tensors), dict(base.fills)

    def add(self, part: LayerSymbols, first: bool = True) -> None:
        """Adds a slice. first: whether it is the first one of its layer."""
        n = len(part.anchor_q)
        if first:
            self.sort()
            self._first, codes = self._anchor_q.size, _Column(np.uint8)
            codes.grow(self._first)[:] = raised(self.codes, part)
            if part.layer in self.tensors:  # its rows follow those of the base's layer 0
                self._codes.pop()
                self._layer_rows.pop()
            else:
                self.tensors[part.layer] = part.tensors.dequantised()
            self._codes.append(codes)
            self._layer_rows.append([_Column(np.float32, tensor.channels) for tensor in part.tensors.tables.rows])
        self.fills[part.layer] = part.fill
        self._sorted = first or (self._sorted and not n)
        self._codes[-1].grow(n)[:] = part.codes
        self._anchor_q.grow(n)[:] = part.anchor_q
        self._classes.grow(part.classes.size)[:] = part.classes
        tables = ((self._table, self._rows, part.rows), (part.layer_table, self._layer_rows[-1], part.layer_rows))
        for table, columns, v in tables if part.layer_rows.size else tables[:1]:
            table.dequantise(v, [column.grow(v.shape[1]) for column in columns])

    def sort(self) -> None:
        """Sorts the rows of the layer in progress by Morton order."""
        if self._sorted:
            return
        order = morton_order(self._anchor_q.values[self._first :])
        for column in (self._anchor_q, self._classes, *self._rows, self._codes[-1], *self._layer_rows[-1]):
            if column.size:
                column.reorder(self._first, order)
        self._sorted = True

    @property
    def codes(self) -> np.ndarray:
        """uint8 [rows so far]: the mask codes of the latest layer."""
        return self._codes[-1].values if self._codes else np.zeros(0, np.uint8)

    @property
    def classes(self) -> np.ndarray:
        """int32 [rows so far], or NO_CLASSES: the step classes."""
        return self._classes.values.astype(np.int32)

    def arrays(self, writeable: bool = True) -> tuple[list[np.ndarray], list[np.ndarray], list[list[np.ndarray]]]:
        """Returns (voxels int32 [N, 3], classes uint8 [N or 0] and the rows of each tensor float32 [N, C]; the mask
        codes of each layer, uint8 [rows so far]; its layer rows of each tensor, float32 [rows so far, C]). Later calls
        may return the same arrays."""
        values = [column.give() for column in (self._anchor_q, self._classes, *self._rows)]
        codes = [column.give() for column in self._codes]
        layer_rows = [[column.give() for column in columns] for columns in self._layer_rows]
        for array in (*values, *codes, *chain(*layer_rows)):
            array.flags.writeable = writeable
        return values, codes, layer_rows

    def layers(self) -> list[LayerTensors]:
        """Returns the layers so far."""
        (voxels, classes, *rows), codes, layer_rows = self.arrays()
        classes = classes if self._table.graded else np.zeros(len(voxels), np.uint8)
        found, first = list[LayerTensors](), 0
        for (layer, tensors), own_codes, of_layer in zip(self.tensors.items(), codes, layer_rows, strict=True):
            own, first = slice(first, len(own_codes)), len(own_codes)
            found.append(
                LayerTensors(
                    layer=layer,
                    kind=tensors.tables.kind,
                    fill=self.fills[layer],
                    voxels=voxels[own],
                    positions=dequantise(voxels[own], self._voxel_size),
                    codes=own_codes,
                    classes=classes[own],
                    rows={tensor.id: x[own] for tensor, x in zip(self._table.tensors, rows, strict=True)},
                    layer_rows={tensor.id: x for tensor, x in zip(tensors.tables.rows, of_layer, strict=True)},
                    grids=tensors.grids,
                    chains=tensors.chains,
                )
            )
        return found


# -- rules between slices ----------------------------------------------------------------------------------------------


def raised(before: np.ndarray, part: LayerSymbols) -> np.ndarray:
    """Returns the mask codes int32 [rows before] in a layer, by its first slice. before: uint8, in the layer before."""
    codes: np.ndarray = before + part.rises if part.layer else before * (1 - part.rises)
    return codes


def check_slice(part: LayerSymbols, before: np.ndarray, voxel_size: float) -> None:
    """Checks a slice against the header and the mask codes before it, uint8 [rows before].

    Raises Malformed if a mask code is above 255 or 1 or 2, or a dequantised value would not be finite.
    """
    where = f"layer {part.layer}"
    if part.rises.size:
        codes = raised(before, part)
        if (odd := codes[(codes > 255) | ((codes > 0) & (codes < MASK_MIN_CODE))]).size:
            raise Malformed(f"{where}: mask code {int(odd.max())}, expected 0 or {MASK_MIN_CODE}..255")
    stored = [(part.anchor_q, voxel_size), *zip(part.tensors.arrays, part.tensors.tables.steps, strict=True)]
    for table, v in ((part.table, part.rows), (part.layer_table, part.layer_rows)):
        stored += [(own, tensor.step) for tensor, own in table.of_each(v)]
    if not all(all_finite(k, step) for k, step in stored):
        raise Malformed(f"{where}: a dequantised value is not finite")


class TakenVoxels:
    """The voxels of the slices so far."""

    def __init__(self) -> None:
        self._runs = list[np.ndarray]()  # ascending keys, each run more than twice as long as the next
        self._latest = np.zeros(0, np.uint64)  # keys that no run has yet: of a single slice none are sorted

    def copy(self) -> TakenVoxels:
        """A copy that grows independently."""
        found = TakenVoxels()
        found._runs, found._latest = list(self._runs), self._latest
        return found

    def take(self, anchor_q: np.ndarray) -> None:
        """Adds distinct voxels int32 [n, 3]. Raises Malformed if one of them is taken already."""
        keys, self._latest = self._latest, self._latest[:0]
        while keys.size and self._runs and self._runs[-1].size <= 2 * keys.size:
            keys = np.concatenate([self._runs.pop(), keys])
        self._runs += [np.sort(keys, kind="stable")] if keys.size else []
        keys = _voxel_keys(anchor_q)
        for run in self._runs:
            keys.sort(kind="stable")  # in no time if it is
            taken = np.flatnonzero(run[np.minimum(np.searchsorted(run, keys), run.size - 1)] == keys)
            if taken.size:
                raise Malformed(f"voxel {_voxel_of(keys[taken[0]])} holds more than one anchor, expected one")
        self._latest = keys


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
