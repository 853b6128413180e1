"""The deformation kind "tracks" of splats: bases over time that all Gaussians share, and coefficients of each (clause
13.8).

Grids of one axis, time: the instants (id 0), and the bases of head h (id 1 + h). Layer rows h: its coefficients. With
groups also layer rows GROUP, the group of each row, and grids along the groups: their centres (id CENTRES), and maps of
head h (id MAPS + h) from the position to what is added to the coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.kinds import splats
from pd4dgs_codec.kinds.splats import HEADS, SplatScene
from pd4dgs_codec.scene import deformation_unit
from pd4dgs_codec.tensors.quantise import WHOLE, Rows, expect, expect_array, is_step
from pd4dgs_codec.tensors.tables import Grid, Tables, Tensors

NUMBER, NAME = 1, "tracks"

#: Ids of the layer rows of groups, of the grid of their centres, and of their first map.
GROUP, CENTRES, MAPS = 5, 6, 7
NONE = -1  #: the group of a row that has none, as any number outside 0..M - 1
#: `Tracks.of` states times as multiples of 1 / TICKS or of a larger fraction that all of them are multiples of.
TICKS = 65535
#: Products of a matrix product that OpenBLAS computes by one thread. It waits for others far longer than it computes.
ALONE = 1 << 18


@dataclass(frozen=True, eq=False)
class Head:
    """What a head adds: the sum over k of coefficients[:, k] times basis k, linear in time between the instants.

    bases: float32 [K, c, T]. coefficients: float32 [n, K], of the scene's first n rows; others stay. step: of the
    coefficients.
    """

    bases: np.ndarray
    coefficients: np.ndarray
    step: float


@dataclass(frozen=True, eq=False)
class Groups:
    """M groups of Gaussians that move alike. rows: float32 [n, 1], the group of each row, or NONE. centres: float32
    [M, 3] places, see `place`. maps: by head, float32 [M, 4, K]: with d the place less the centre, (d, 1) times the map
    of a row's group is added to its coefficients."""

    rows: np.ndarray
    centres: np.ndarray
    maps: dict[str, np.ndarray]

    def added(self, name: str, places: np.ndarray) -> np.ndarray:
        """Returns what a head that has maps gets added to its coefficients, [n, K] in the dtype of `places` [n, 3]."""
        order = np.argsort(self.rows[:, 0], kind="stable")
        ends = np.searchsorted(self.rows[order, 0], np.arange(len(self.centres) + 1))
        found = np.zeros((len(places), self.maps[name].shape[2]), places.dtype)
        for own, centre, start, end in zip(self.maps[name], self.centres, ends[:-1], ends[1:], strict=True):
            rows = order[start:end]
            found[rows] = (places[rows] - centre) @ own[:3] + own[3]
        return found


def place(positions: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Returns positions [n, 3] in units of `deformation_unit`, in their dtype; 0 in a box without extent."""
    unit = deformation_unit(box)
    return positions / unit if unit > 0 else np.zeros_like(positions)


@dataclass(frozen=True, eq=False)
class Tracks:
    """The deformation that a layer adds to those of the layers below. instants: float32 [T], from 0, ascending, in any
    unit; the last stands for normalised time 1. step: of all grids. heads: by name. groups: what they add to the heads'
    coefficients, None for nothing."""

    instants: np.ndarray
    step: float
    heads: dict[str, Head]
    groups: Groups | None = None

    @staticmethod
    def of(times: np.ndarray, step: float, heads: dict[str, Head], groups: Groups | None = None) -> Tracks:
        """Returns the tracks with these normalised times [T], the first 0 and the last 1, up to 1 / (2 TICKS)."""
        exact = np.asarray(times, np.float64)
        fits = (n for n in range(1, TICKS) if np.abs(exact * n - np.rint(exact * n)).max() < 0.01)
        ticks = np.rint(exact * next(fits, TICKS))
        return Tracks((ticks * float(step)).astype(np.float32), step, heads, groups)

    @property
    def times(self) -> np.ndarray:
        """float64 [T]: the normalised times of the instants."""
        found: np.ndarray = self.instants.astype(np.float64) / self.instants[-1]
        return found

    def residuals(self, t: float) -> dict[str, np.ndarray]:
        """Returns what tracks without groups add at normalised time t in 0..1: float32 [n, c] by head."""
        times = self.times
        j = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
        f = np.float32((t - times[j]) / (times[j + 1] - times[j]))
        found = dict[str, np.ndarray]()
        for name, head in self.heads.items():
            basis, columns = head.bases[:, :, j] * (1 - f) + head.bases[:, :, j + 1] * f, head.coefficients.T
            sums = np.empty((basis.shape[1], columns.shape[1]), np.float32)
            for start in range(0, columns.shape[1], block := ALONE // basis.size):
                np.matmul(basis.T, columns[:, start : start + block], out=sums[:, start : start + block])
            found[name] = sums.T
        return found

    def prepared(self, positions: np.ndarray, box: np.ndarray) -> Tracks:
        """Returns the tracks without groups, with coefficients that have what these add, in the order in memory that
        evaluates fastest. positions: float32 [n, 3] of their rows at rest, scene units."""
        heads = dict(self.heads)
        if groups := self.groups:
            for name in groups.maps:
                added = groups.added(name, place(positions, box))
                heads[name] = replace(heads[name], coefficients=heads[name].coefficients + added)
        heads = {n: replace(head, coefficients=np.asfortranarray(head.coefficients)) for n, head in heads.items()}
        return replace(self, heads=heads, groups=None)

    def of_rows(self, rows: np.ndarray | slice) -> Tracks:
        """Returns the tracks of a scene's rows `rows`, an int64 array or the first ones."""

        def taken(values: Any, missing: int = 0) -> Any:
            if not isinstance(rows, slice) and rows.max(initial=0) >= len(values):
                rest = np.full((1, values.shape[1]), missing, np.float32)
                return np.concatenate([values, rest])[np.minimum(rows, len(values))]
            return values[rows]

        heads = {name: replace(head, coefficients=taken(head.coefficients)) for name, head in self.heads.items()}
        groups = self.groups and replace(self.groups, rows=taken(self.groups.rows, NONE))
        return replace(self, heads=heads, groups=groups)

    def scaled(self, factor: float) -> Tracks:
        """Returns the tracks with every step times `factor`, rounded to binary32, at the same normalised times."""
        heads = {n: replace(head, step=float(np.float32(head.step * factor))) for n, head in self.heads.items()}
        instants = self.instants * np.float32(factor)
        return replace(self, instants=instants, step=float(np.float32(self.step * factor)), heads=heads)


OF, DEFORMATION = splats.NAME, Tracks


def check(tensors: Tensors, below: Mapping[int, Tables], widths: None, where: str) -> None:
    """Raises Malformed if the tensors of a layer, or its tables alone, break the rules of the kind."""
    tables, components = tensors.tables, list(HEADS.values())
    if len(tables.kind) > 1:
        raise Malformed(f"{where}: deformation {list(tables.kind)}, expected [{NUMBER}]")
    heads = {rows.id: rows.channels for rows in tables.rows if rows.id != GROUP}
    if tables.chains or not (tables.grids and heads):
        raise Malformed(f"{where}: tracks, expected grids and layer rows of heads and no chains")
    if max(heads) >= len(HEADS):
        raise Malformed(f"{where}: layer rows {max(heads)}, expected 0..{GROUP}")
    groups = [(rows.channels, rows.step) for rows in tables.rows if rows.id == GROUP]
    if groups not in ([], [(1, 1.0)]):
        raise Malformed(f"{where}: layer rows {GROUP} of {groups} (channels, step), expected 1 channel and step 1")
    found = [(grid.id, grid.channels) for grid in tables.grids]
    expected = [(0, 1), *((1 + i, bases * components[i]) for i, bases in heads.items())]
    if groups:
        mapped = {grid.id - MAPS for grid in tables.grids}
        expected += [(CENTRES, 3), *((MAPS + i, 4 * bases) for i, bases in heads.items() if i in mapped)]
    if found != expected:
        raise Malformed(f"{where}: grids {found} (id, channels), expected {expected}")
    for least, grids in ((2, tables.grids[: 1 + len(heads)]), (1, tables.grids[1 + len(heads) :])):
        sides = [list(grid.sides) for grid in grids]
        if any(own != sides[0] or len(own) > 1 or own[0] < least for own in sides):
            raise Malformed(f"{where}: grids of sides {sides}, expected one of {least}.., the same for all")
    if len(tensors.planes):
        instants = tensors.planes[0].ravel()
        if instants[0] or np.any(instants[1:] <= instants[:-1]):
            raise Malformed(f"{where}: instants do not ascend from 0")


def check_arrays(scene: SplatScene, layer: int, own: str) -> None:
    """Raises EncodeError for arrays of other shapes than Tracks documents, for unknown heads and for other steps."""
    given, rows = scene.tracks[layer], scene.rows[-1]
    count = len(given.instants)
    expect_array(f"{own} instants", given.instants, np.float32, (count,))
    unknown = [name for name in given.heads if name not in HEADS]
    expect(not unknown, f"{own}: heads {unknown}, expected some of {list(HEADS)}")
    for name, head in given.heads.items():
        number = len(head.bases)
        expect(number > 0, f"{own}: no bases of {name}, expected some, or no such head")
        expect_array(f"{own} bases of {name}", head.bases, np.float32, (number, HEADS[name], count))
        most = min(len(head.coefficients), rows)
        expect_array(f"{own} coefficients of {name}", head.coefficients, np.float32, (most, number))
        expect(is_step(head.step), f"{own} step of {name}: {head.step!r}, expected a positive normal binary32 value")
    if groups := given.groups:
        fits = groups.maps.keys() <= given.heads.keys()
        expect(fits, f"{own}: maps of {list(groups.maps)}, expected some of {list(given.heads)}")
        expect_array(f"{own} groups", groups.rows, np.float32, (min(len(groups.rows), rows), 1))
        number = len(groups.centres)
        expect_array(f"{own} centres", groups.centres, np.float32, (number, 3))
        for name, maps in groups.maps.items():
            expect_array(f"{own} maps of {name}", maps, np.float32, (number, 4, len(given.heads[name].bases)))


def tensors_of(scene: SplatScene, layer: int) -> Tensors:
    """Returns the grids of the tracks of a layer; `rows_of` has the layer rows."""
    tracks: Tracks = scene.tracks[layer]
    heads = [(i, name, tracks.heads[name]) for i, name in enumerate(HEADS) if name in tracks.heads]
    planes = {0: tracks.instants[None]}
    planes |= {1 + i: head.bases.reshape(-1, head.bases.shape[2]) for i, _, head in heads}
    rows = [Rows(i, head.coefficients.shape[1], head.step) for i, _, head in heads]
    if groups := tracks.groups:
        planes[CENTRES] = groups.centres.T
        maps = [(i, groups.maps[name]) for i, name, _ in heads if name in groups.maps]
        planes |= {MAPS + i: own.reshape(len(own), -1).T for i, own in maps}
        rows.append(Rows(GROUP, 1, 1.0, WHOLE))
    grids = tuple(Grid(i, len(plane), plane.shape[1:]) for i, plane in planes.items())
    arrays = [np.ascontiguousarray(plane[:, None]) for plane in planes.values()]
    return Tensors(Tables(grids, grid_step=tracks.step, kind=(NUMBER,), rows=tuple(rows)), arrays)


def rows_of(scene: SplatScene, layer: int, count: int) -> dict[str, np.ndarray]:
    """Returns the layer rows of the scene's first `count` rows, float32 [count, K] by name in coding order. Raises
    EncodeError for others that are not 0."""
    tracks: Tracks = scene.tracks[layer]
    lost = [name for name, head in tracks.heads.items() if head.coefficients[count:].any()]
    if tracks.groups and tracks.groups.maps and (tracks.groups.rows[count:] != NONE).any():
        lost.append("groups")
    expect(not lost, f"tracks of layer {layer}: {lost} of anchors of a later layer, expected 0 or no group")
    taken = tracks.of_rows(np.arange(count))
    found = {f"tracks.coefficients.{name}": taken.heads[name].coefficients for name in HEADS if name in taken.heads}
    return found | ({"tracks.group": taken.groups.rows} if taken.groups else {})


def deformation_of(tensors: Tensors, rows: Sequence[np.ndarray]) -> Tracks:
    """The inverse of `tensors_of` and `rows_of`."""
    heads, maps, groups = dict[str, Head](), dict[str, np.ndarray](), None
    planes = {grid.id: plane[:, 0] for grid, plane in zip(tensors.tables.grids, tensors.planes, strict=True)}
    for tensor, values in zip(tensors.tables.rows, rows, strict=True):
        if tensor.id == GROUP:
            groups = Groups(values, planes[CENTRES].T, maps)
            continue
        name, bases = list(HEADS)[tensor.id], planes[1 + tensor.id]
        heads[name] = Head(bases.reshape(tensor.channels, -1, bases.shape[1]), values, tensor.step)
        if MAPS + tensor.id in planes:
            maps[name] = planes[MAPS + tensor.id].T.reshape(-1, 4, tensor.channels)
    return Tracks(planes[0][0], tensors.tables.grid_step, heads, groups)


def json_of_layer(tables: Tables, layer: int) -> dict[str, Any]:
    """instants: their number T. heads: number K of bases by name. groups: their number M. steps: of each head's
    coefficients, and of all grids."""
    heads = {list(HEADS)[rows.id]: rows for rows in tables.rows if rows.id != GROUP}
    sides = {grid.id: grid.sides[0] for grid in tables.grids}
    return {
        "steps": {name: rows.step for name, rows in heads.items()} | {"bases": tables.grid_step},
        "instants": sides[0],
        "heads": {name: rows.channels for name, rows in heads.items()},
        "groups": sides.get(CENTRES, 0),
    }


def array_names(tables: Tables) -> list[str]:
    """Returns the names of the planes in coding order."""
    names = ["instants", *(f"bases.{name}" for name in HEADS), "centres", *(f"maps.{name}" for name in HEADS)]
    return [f"tracks.{names[grid.id]}" for grid in tables.grids]
