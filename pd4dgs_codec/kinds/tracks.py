"""The deformation kind "tracks" of splats: bases over time that all Gaussians share, and coefficients of each (clause
13.8).

Grids of one axis, time: the instants (id 0), and the bases of head h (id 1 + h). Layer rows h: its coefficients. With
groups also layer rows GROUP: the group of each row, and grids along the groups: their centres (id CENTRES), and their
maps of head h (id CENTRES + 1 + h), which tell the coefficients from the position.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.quantise import WHOLE, Rows
from pd4dgs_codec.format.tables import Grid, Tables, Tensors

NUMBER, NAME = 1, "tracks"

#: Components of each head, in the order of their numbers.
HEADS = {"position": 3, "rotation": 4, "scale": 3, "opacity": 1, "color": 3}
#: Ids of the layer rows of groups, and of the grid of their centres.
GROUP, CENTRES = len(HEADS), 1 + len(HEADS)
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
    """M groups of Gaussians that move alike. rows: float32 [n, 1], the group of each row. centres: float32 [M, 3], in
    units of `deformation_unit`. maps: by head, float32 [M, 4, K]: with d the position less the centre, (d, 1) times
    the map of a row's group is added to its coefficients."""

    rows: np.ndarray
    centres: np.ndarray
    maps: dict[str, np.ndarray]

    def added(self, name: str, positions: np.ndarray) -> np.ndarray | float:
        """What a head's coefficients get at positions [n, 3], in units of `deformation_unit`: float32 [n, K]."""
        if name not in self.maps:
            return 0.0
        groups = self.rows[:, 0].astype(np.int64)
        apart, maps = positions[: len(groups)] - self.centres[groups], self.maps[name]
        return np.asarray(np.einsum("nd,ndk->nk", apart, maps[groups, :3]) + maps[groups, 3], np.float32)


@dataclass(frozen=True, eq=False)
class Tracks:
    """The deformation that a layer adds to those of the layers below. instants: float32 [T], from 0, ascending, in any
    unit; the last stands for normalised time 1. step: of all grids. heads: by name."""

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
        """Returns what is added at normalised time t in 0..1: float32 [n, c] by head."""
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

    def alone(self, positions: np.ndarray) -> Tracks:
        """Returns the tracks without groups, whose coefficients have what the groups add. positions: [N, 3] of the
        scene's rows, in units of `deformation_unit`."""
        if self.groups is None:
            return self
        heads = {
            name: replace(head, coefficients=head.coefficients + self.groups.added(name, positions))
            for name, head in self.heads.items()
        }
        return replace(self, heads=heads, groups=None)

    def by_columns(self) -> Tracks:
        """Returns the tracks with coefficients in the order in memory that evaluates fastest."""
        heads = {n: replace(head, coefficients=np.asfortranarray(head.coefficients)) for n, head in self.heads.items()}
        return replace(self, heads=heads)

    def of_rows(self, rows: np.ndarray | slice) -> Tracks:
        """Returns the tracks of a scene's rows `rows`, an int64 array or the first ones."""

        def taken(values: Any) -> Any:
            if not isinstance(rows, slice) and rows.max(initial=0) >= len(values):
                rest = np.zeros((1, values.shape[1]), np.float32)
                return np.concatenate([values, rest])[np.minimum(rows, len(values))]
            return values[rows]

        heads = {name: replace(head, coefficients=taken(head.coefficients)) for name, head in self.heads.items()}
        groups = self.groups and replace(self.groups, rows=taken(self.groups.rows))
        return replace(self, heads=heads, groups=groups)

    def scaled(self, factor: float) -> Tracks:
        """Returns the tracks with every step times `factor`, rounded to binary32, at the same normalised times."""
        heads = {n: replace(head, step=float(np.float32(head.step * factor))) for n, head in self.heads.items()}
        return replace(
            self, instants=self.instants * np.float32(factor), step=float(np.float32(self.step * factor)), heads=heads
        )


def check(tensors: Tensors, below: Mapping[int, Tables], widths: None, where: str) -> None:
    """Raises Malformed if the tensors of a layer, or its tables alone, break the rules of the kind."""
    tables = tensors.tables
    if len(tables.kind) > 1:
        raise Malformed(f"{where}: deformation {list(tables.kind)}, expected [{NUMBER}]")
    if tables.chains or not (tables.grids and tables.rows):
        raise Malformed(f"{where}: tracks, expected grids and layer rows and no chains")
    components, expected = list(HEADS.values()), [(0, 1)]
    instants, groups = tables.grids[0].sides, next((g.sides for g in tables.grids if g.id == CENTRES), None)
    mapped = {grid.id for grid in tables.grids if grid.id > CENTRES}
    for rows in tables.rows:
        if rows.id > GROUP or (rows.id == GROUP and (groups is None or rows.channels > 1)):
            known = f"0..{GROUP - 1}, or {GROUP} of one channel with centres"
            raise Malformed(f"{where}: layer rows {rows.id}, expected {known}")
        if rows.id < GROUP:
            expected.append((1 + rows.id, rows.channels * components[rows.id]))
    if groups is not None:
        maps = {CENTRES + 1 + rows.id: rows.channels * 4 for rows in tables.rows if rows.id < GROUP}
        expected += [(CENTRES, 3), *((i, maps.get(i, 0)) for i in sorted(mapped))]
    found = [(grid.id, grid.channels) for grid in tables.grids]
    if found != expected or (groups is None) != (tables.rows[-1].id < GROUP):
        raise Malformed(f"{where}: grids {found} (id, channels), expected {expected}")
    wrong = [list(g.sides) for g in tables.grids if g.sides != (instants if g.id < CENTRES else groups)]
    if wrong or len(instants) != 1 or instants[0] < 2 or (groups and len(groups) != 1):
        found_sides = [list(grid.sides) for grid in tables.grids]
        raise Malformed(f"{where}: grids of sides {found_sides}, expected one of 2.. along time, one along groups")
    if len(tensors.planes):
        times = tensors.planes[0].ravel()
        if times[0] or np.any(times[1:] <= times[:-1]):
            raise Malformed(f"{where}: instants do not ascend from 0")


def tensors_of(tracks: Tracks) -> Tensors:
    """Returns the grids of tracks; `coefficients` has the layer rows."""
    heads = [(i, name, tracks.heads[name]) for i, name in enumerate(HEADS) if name in tracks.heads]
    planes = {0: tracks.instants[None, None]}
    planes |= {1 + i: head.bases.reshape(-1, 1, head.bases.shape[2]) for i, _, head in heads}
    rows = [Rows(i, head.coefficients.shape[1], head.step) for i, _, head in heads]
    if groups := tracks.groups:
        planes[CENTRES] = groups.centres.T[:, None]
        for i, name, _ in heads:
            if name in groups.maps:
                planes[CENTRES + 1 + i] = groups.maps[name].reshape(len(groups.centres), -1).T[:, None]
        rows.append(Rows(GROUP, 1, 1.0, WHOLE))
    grids = tuple(Grid(i, len(plane), plane.shape[2:]) for i, plane in planes.items())
    arrays = [np.ascontiguousarray(plane, np.float32) for plane in planes.values()]
    return Tensors(Tables(grids, grid_step=tracks.step, kind=(NUMBER,), rows=tuple(rows)), arrays)


def coefficients(tracks: Tracks, count: int) -> dict[str, np.ndarray]:
    """Returns the layer rows of the scene's first `count` rows, float32 [count, K] by name in coding order."""
    taken = tracks.of_rows(np.arange(count))
    found = {name: taken.heads[name].coefficients for name in HEADS if name in taken.heads}
    return found | ({"group": taken.groups.rows} if taken.groups else {})


def tracks_of(tensors: Tensors, rows: list[np.ndarray]) -> Tracks:
    """The inverse of `tensors_of` and `coefficients`."""
    names, heads, maps = list(HEADS), dict[str, Head](), dict[str, np.ndarray]()
    planes = {grid.id: plane[:, 0] for grid, plane in zip(tensors.tables.grids, tensors.planes, strict=True)}
    for tensor, values in zip(tensors.tables.rows, rows, strict=True):
        if tensor.id == GROUP:
            continue
        bases = planes[1 + tensor.id]
        heads[names[tensor.id]] = Head(bases.reshape(tensor.channels, -1, bases.shape[1]), values, tensor.step)
        if (own := planes.get(CENTRES + 1 + tensor.id)) is not None:
            maps[names[tensor.id]] = own.T.reshape(-1, 4, tensor.channels)
    groups = Groups(rows[-1], planes[CENTRES].T, maps) if CENTRES in planes else None
    if groups and len(groups.rows) and not 0 <= groups.rows.min() <= groups.rows.max() < len(groups.centres):
        raise Malformed(f"a row in group {groups.rows.max():g}, expected 0..{len(groups.centres) - 1}")
    return Tracks(planes[0][0], tensors.tables.grid_step, heads, groups)


def json_of_layer(tables: Tables) -> dict[str, Any]:
    """instants: their number T. heads: number K of bases by name. steps: of each head's coefficients, and of bases. All
    are empty without tracks."""
    if not tables.grids:
        return {"steps": {}, "instants": 0, "heads": {}}
    names = [*HEADS, "group"]
    steps = {names[rows.id]: rows.step for rows in tables.rows} | {"bases": tables.grid_step}
    heads = {names[rows.id]: rows.channels for rows in tables.rows}
    return {"steps": steps, "instants": tables.grids[0].sides[0], "heads": heads}


def array_names(tables: Tables) -> list[str]:
    """Returns the names of the planes in coding order."""
    names = ["instants", *(f"bases.{name}" for name in HEADS), "centres", *(f"maps.{name}" for name in HEADS)]
    return [f"tracks.{names[grid.id]}" for grid in tables.grids]


def total(layers: Mapping[int, Tracks], t: float, count: int) -> dict[str, np.ndarray]:
    """Returns the sum of the residuals of all layers at normalised time t: float32 [count, c] by head."""
    found = dict[str, np.ndarray]()
    for tracks in layers.values():
        for name, added in tracks.residuals(t).items():
            if name not in found and len(added) == count:
                found[name] = added
                continue
            found.setdefault(name, np.zeros((count, HEADS[name]), np.float32))[: len(added)] += added
    return found
