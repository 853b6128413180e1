"""Where the planes of a HexPlane lie in its one parameter tensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pd4dgs_codec.scene import PLANES

if TYPE_CHECKING:
    from torch import Tensor

TIME_AXIS = 3
SPATIAL = tuple(p for p in PLANES if TIME_AXIS not in p[1:])
TEMPORAL = tuple(p for p in PLANES if TIME_AXIS in p[1:])


@dataclass(frozen=True, eq=False)
class PlaneLayout:
    """Where each plane lies in the one parameter [cells, C]: the spatial planes of all scales, then the time planes.

    One tensor, because the optimiser, the rounding and the kernels then make one pass instead of twelve.

    reso: int64 [S, 4] cells along x, y, z, t.
    start: int64 [S, 6] first cell of each plane, in the order of `PLANES`; cell (j, i) of plane (a, b) is
    start + j * reso[a] + i.
    rows: int64 [S, 3] first row of xt, yt, zt in the [n_rows, C] table that remains of them at one time.
    lines: int64 [R, 5], each row of each plane: first cell of the plane, height, width, row, 1 if spatial.
    """

    reso: np.ndarray
    start: np.ndarray
    rows: np.ndarray
    lines: np.ndarray
    n_spatial: int
    n_cells: int
    n_rows: int

    @classmethod
    def build(cls, resolutions: Sequence[Sequence[int]]) -> PlaneLayout:
        """resolutions: per scale, cells along x, y, z, t."""
        reso = np.array(resolutions, np.int64)
        start = np.zeros((len(reso), len(PLANES)), np.int64)
        lines = []
        cell = 0
        for temporal in (False, True):
            for s in range(len(reso)):
                for k, (_, a, b) in enumerate(PLANES):
                    if (b == TIME_AXIS) == temporal:
                        start[s, k] = cell
                        lines += [(cell, reso[s, b], reso[s, a], j, not temporal) for j in range(reso[s, b])]
                        cell += int(reso[s, a] * reso[s, b])
            if not temporal:
                n_spatial = cell
        rows = (np.cumsum(reso[:, :3]) - reso[:, :3].ravel()).reshape(-1, 3)
        return cls(reso, start, rows, np.array(lines, np.int64), n_spatial, cell, int(reso[:, :3].sum()))

    def views(self, grid: Tensor) -> tuple[dict[str, Tensor], ...]:
        """Per scale, plane name -> view [reso[b], reso[a], C] of `grid` [cells, C]."""
        out = []
        for s, r in enumerate(self.reso.tolist()):
            scale = {}
            for k, (name, a, b) in enumerate(PLANES):
                scale[name] = grid.narrow(0, int(self.start[s, k]), r[a] * r[b]).view(r[b], r[a], -1)
            out.append(scale)
        return tuple(out)
