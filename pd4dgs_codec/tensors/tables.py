"""The tables from which the tensors of a file follow, and the tensors of a layer, by form and id (clauses 5.4 to 6.5).

A tensor is *rows* (channels of each anchor), a *grid* (planes of every pair of its axes) or a *chain* (weights and
biases of linear layers that follow each other). What it means is the business of `kinds`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from pd4dgs_codec.scene import Network
from pd4dgs_codec.tensors.planes import PlaneShape
from pd4dgs_codec.tensors.quantise import Rows, dequantise, quantise

Kind = tuple[int, ...]  #: the number of a kind and its parameters, see `kinds`
Fill = tuple[int, ...]  #: RGB, 0..255, and with four entries the spread, see `scene.LayeredScene.spread`


@dataclass(frozen=True)
class Grid:
    """A grid. sides: of its axes, 1 to 4. predictors: an id per plane, empty before they are chosen."""

    id: int
    channels: int
    sides: tuple[int, ...]
    predictors: tuple[int, ...] = ()

    @property
    def planes(self) -> list[PlaneShape]:
        """[C, H, W] of its planes: of the pairs of axes i < j in lexicographic order, H along j and W along i. One axis
        has one plane of one row."""
        pairs = combinations(self.sides, 2) if len(self.sides) > 1 else [(self.sides[0], 1)]
        return [(self.channels, height, width) for width, height in pairs]


@dataclass(frozen=True)
class Chain:
    """A chain of linear layers. widths: of its input and of the outputs of each layer."""

    id: int
    widths: tuple[int, ...]

    @property
    def arrays(self) -> list[tuple[int, ...]]:
        """Shapes of weight [outputs, inputs], bias [outputs], weight, bias ..."""
        return [shape for inputs, outputs in pairwise(self.widths) for shape in ((outputs, inputs), (outputs,))]


@dataclass(frozen=True)
class Tables:
    """The grids, chains and layer rows of a layer, by ascending id. grid_step, chain_step: their steps, 0 without any.
    kind: of the deformation, empty if none is stated. rows: tensors with a row for each earlier and each own anchor."""

    grids: tuple[Grid, ...] = ()
    chains: tuple[Chain, ...] = ()
    grid_step: float = 0.0
    chain_step: float = 0.0
    kind: Kind = ()
    rows: tuple[Rows, ...] = ()

    @property
    def planes(self) -> list[PlaneShape]:
        """[C, H, W] of all planes, grid by grid."""
        return [shape for grid in self.grids for shape in grid.planes]

    @property
    def weights(self) -> list[tuple[int, ...]]:
        """Shapes of all weights and biases, chain by chain."""
        return [shape for chain in self.chains for shape in chain.arrays]

    @property
    def cells(self) -> int:
        """Number of plane samples."""
        return sum(map(math.prod, self.planes))

    @property
    def symbols(self) -> int:
        """Number of plane samples, weights and biases."""
        return self.cells + sum(map(math.prod, self.weights))

    @property
    def steps(self) -> list[float]:
        """The step of each plane, then of each weight and bias."""
        return [self.grid_step] * len(self.planes) + [self.chain_step] * len(self.weights)

    def json(self) -> dict[str, Any]:
        """grids: [id, C, sides ...] each. chains: [id, widths ...] each. kind: numbers, None if not stated. layer_rows:
        [id, C, step, predictor] each."""
        return {
            "layer_rows": [[t.id, t.channels, t.step, t.predictor] for t in self.rows],
            "grids": [[grid.id, grid.channels, *grid.sides] for grid in self.grids],
            "chains": [[chain.id, *chain.widths] for chain in self.chains],
            "grid_step": self.grid_step or None,
            "chain_step": self.chain_step or None,
            "kind": list(self.kind) or None,
        }


@dataclass(frozen=True, eq=False)
class Tensors:
    """The grids and chains of a layer: float32 values, or int32 symbols. planes: [C, H, W] each, weights: weights and
    biases, both in the order of `tables`."""

    tables: Tables
    planes: Sequence[np.ndarray] = ()
    weights: Sequence[np.ndarray] = ()

    @property
    def arrays(self) -> list[np.ndarray]:
        """All arrays in coding order."""
        return [*self.planes, *self.weights]

    @property
    def grids(self) -> dict[int, tuple[np.ndarray, ...]]:
        """The planes by id of their grid."""
        left = iter(self.planes)
        return {grid.id: tuple(next(left) for _ in grid.planes) for grid in self.tables.grids}

    @property
    def chains(self) -> dict[int, Network]:
        """(weight, bias) of each linear layer by id of its chain."""
        left = iter(self.weights)
        return {chain.id: tuple((next(left), next(left)) for _ in chain.widths[1:]) for chain in self.tables.chains}

    def with_arrays(self, arrays: Iterable[np.ndarray]) -> Tensors:
        """Returns tensors of the same tables with these arrays, in coding order."""
        found, planes = list(arrays), len(self.planes)
        return replace(self, planes=found[:planes], weights=found[planes:])

    def quantised(self, name: Callable[[int], str]) -> Tensors:
        """Returns the symbols. name: of an array by its place, for messages. Raises EncodeError for a value without a
        symbol."""
        pairs = zip(self.arrays, self.tables.steps, strict=True)
        return self.with_arrays(quantise(x, step, name(i)) for i, (x, step) in enumerate(pairs))

    def dequantised(self) -> Tensors:
        """Returns the values of symbols."""
        return self.with_arrays(dequantise(k, step) for k, step in zip(self.arrays, self.tables.steps, strict=True))


NOTHING = Tensors(Tables())
