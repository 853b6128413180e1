"""The deformation kind "tracks" of splats: bases over time that all Gaussians share, and coefficients of each (clause
13.8).

Grids of one axis, time: the instants (id 0), and the bases of head h (id 1 + h). Layer rows h: its coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.tensors.quantise import Rows
from pd4dgs_codec.tensors.tables import Grid, Tables, Tensors

NUMBER, NAME = 1, "tracks"

#: Components of each head, in the order of their numbers.
HEADS = {"position": 3, "rotation": 4, "scale": 3, "opacity": 1, "color": 3}
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
class Tracks:
    """The deformation that a layer adds to those of the layers below. instants: float32 [T], from 0, ascending, in any
    unit; the last stands for normalised time 1. step: of instants and bases. heads: by name."""

    instants: np.ndarray
    step: float
    heads: dict[str, Head]

    @staticmethod
    def of(times: np.ndarray, step: float, heads: dict[str, Head]) -> Tracks:
        """Returns the tracks with these normalised times [T], the first 0 and the last 1, up to 1 / (2 TICKS)."""
        exact = np.asarray(times, np.float64)
        fits = (n for n in range(1, TICKS) if np.abs(exact * n - np.rint(exact * n)).max() < 0.01)
        ticks = np.rint(exact * next(fits, TICKS))
        return Tracks((ticks * float(step)).astype(np.float32), step, heads)

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
        return replace(self, heads=heads)

    def scaled(self, factor: float) -> Tracks:
        """Returns the tracks with every step times `factor`, rounded to binary32, at the same normalised times."""
        heads = {n: replace(head, step=float(np.float32(head.step * factor))) for n, head in self.heads.items()}
        return Tracks(self.instants * np.float32(factor), float(np.float32(self.step * factor)), heads)


def check(tensors: Tensors, below: Mapping[int, Tables], widths: None, where: str) -> None:
    """Raises Malformed if the tensors of a layer, or its tables alone, break the rules of the kind."""
    tables = tensors.tables
    if len(tables.kind) > 1:
        raise Malformed(f"{where}: deformation {list(tables.kind)}, expected [{NUMBER}]")
    if tables.chains or not (tables.grids and tables.rows):
        raise Malformed(f"{where}: tracks, expected grids and layer rows and no chains")
    sides = {grid.sides for grid in tables.grids}
    if len(sides) > 1 or not (len(side := sides.pop()) == 1 and side[0] > 1):
        raise Malformed(f"{where}: grids of sides {[list(grid.sides) for grid in tables.grids]}, expected one of 2..")
    components = list(HEADS.values())
    expected = [(0, 1)]
    for rows in tables.rows:
        if rows.id >= len(HEADS):
            raise Malformed(f"{where}: layer rows {rows.id}, expected 0..{len(HEADS) - 1}")
        expected.append((1 + rows.id, rows.channels * components[rows.id]))
    found = [(grid.id, grid.channels) for grid in tables.grids]
    if found != expected:
        raise Malformed(f"{where}: grids {found} (id, channels), expected {expected}")
    if len(tensors.planes):
        instants = tensors.planes[0].ravel()
        if instants[0] or np.any(instants[1:] <= instants[:-1]):
            raise Malformed(f"{where}: instants do not ascend from 0")


def tensors_of(tracks: Tracks) -> Tensors:
    """Returns the grids of tracks; `coefficients` has the layer rows."""
    heads = [(i, tracks.heads[name]) for i, name in enumerate(HEADS) if name in tracks.heads]
    planes = [tracks.instants[None, None], *(head.bases.reshape(-1, 1, head.bases.shape[2]) for _, head in heads)]
    grids = tuple(Grid(i, len(p), p.shape[2:]) for i, p in zip((0, *(1 + i for i, _ in heads)), planes, strict=True))
    rows = tuple(Rows(i, head.coefficients.shape[1], head.step) for i, head in heads)
    return Tensors(Tables(grids, grid_step=tracks.step, kind=(NUMBER,), rows=rows), planes)


def coefficients(tracks: Tracks, count: int) -> dict[str, np.ndarray]:
    """Returns the coefficients of the scene's first `count` rows, float32 [count, K] by head in the order of HEADS."""
    rows = tracks.of_rows(np.arange(count))
    return {name: rows.heads[name].coefficients for name in HEADS if name in rows.heads}


def tracks_of(tensors: Tensors, rows: list[np.ndarray]) -> Tracks:
    """The inverse of `tensors_of` and `coefficients`."""
    names, (instants, *planes) = list(HEADS), tensors.planes
    heads = {}
    for tensor, plane, values in zip(tensors.tables.rows, planes, rows, strict=True):
        bases = plane.reshape(tensor.channels, -1, plane.shape[2])
        heads[names[tensor.id]] = Head(bases, values, tensor.step)
    return Tracks(instants.ravel(), tensors.tables.grid_step, heads)


def json_of_layer(tables: Tables) -> dict[str, Any]:
    """instants: their number T. heads: number K of bases by name. steps: of each head's coefficients, and of bases. All
    are empty without tracks."""
    if not tables.grids:
        return {"steps": {}, "instants": 0, "heads": {}}
    names = list(HEADS)
    steps = {names[rows.id]: rows.step for rows in tables.rows} | {"bases": tables.grid_step}
    heads = {names[rows.id]: rows.channels for rows in tables.rows}
    return {"steps": steps, "instants": tables.grids[0].sides[0], "heads": heads}


def array_names(tables: Tables) -> list[str]:
    """Returns the names of the planes in coding order."""
    names = list(HEADS)
    return ["tracks.instants", *(f"tracks.bases.{names[grid.id - 1]}" for grid in tables.grids[1:])]


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
