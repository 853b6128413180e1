"""Which cells of a HexPlane a renderer can ever read, and which Gaussians it can ever draw: proven, not sampled.

The global planes are read at the anchors, which stand still. The local ones are read at the Gaussians' means before
the local deformation: each mean lies in a box per stretch of time (see `enclosure`), and every cell that a point of
the box may read counts. A Gaussian whose opacity stays under the threshold for every direction and time is never drawn
(clause 13.4, step 4), so where it lies matters to no picture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pd4dgs_codec.evaluate.enclosure import CHUNK, Ranges, residual_ranges, time_grid
from pd4dgs_codec.scene import FEATURE_DIM, N_OFFSETS, PLANES, Scene, plane_sides

Reached = tuple[dict[str, np.ndarray], ...]  #: per scale, plane name -> bool [H, W]

Cells = tuple[np.ndarray, np.ndarray]  #: (first, last) cell on an axis, int [n]

#: Cells by which a position may be off: another renderer rounds its coordinates otherwise.
CELL_SLACK = 0.02
#: Share by which an opacity may be off, for the same reason.
OPACITY_SLACK = 1e-3


class _Marks:
    """The cells read so far of all planes of a deformation."""

    def __init__(self, planes: tuple[dict[str, np.ndarray], ...], box: np.ndarray):
        self.sides = [plane_sides(scale) for scale in planes]
        self.box = box
        self.reached = tuple({n: np.zeros(scale[n].shape[1:], bool) for n, _, _ in PLANES} for scale in planes)

    def read(self, low: np.ndarray, high: np.ndarray, start: float, end: float) -> None:
        """Points may lie anywhere between low and high [n, 3] at any time in start..end; NaN stands for anywhere."""
        extent = np.maximum(self.box[1] - self.box[0], np.finfo(np.float32).tiny)
        low = np.clip(np.nan_to_num((low - self.box[0]) / extent, nan=0.0), 0.0, 1.0)
        high = np.clip(np.nan_to_num((high - self.box[0]) / extent, nan=1.0), 0.0, 1.0)
        for sides, marks in zip(self.sides, self.reached, strict=True):
            ranges = [_cells(low[:, i], high[:, i], sides[i]) for i in range(3)]
            times = _cells(np.array([start]), np.array([end]), sides[3])
            for name, a, b in PLANES:
                rows = times if b == 3 else ranges[b]
                marks[name] |= _rectangles(rows, ranges[a], marks[name].shape)


def _cells(low: np.ndarray, high: np.ndarray, side: int) -> Cells:
    """(first, last) cell that a sample between low and high, 0..1, reads on an axis of `side` cells."""
    last = side - 1
    first = np.clip(np.floor(low * last - CELL_SLACK), 0, max(last - 1, 0)).astype(np.intp)
    return first, np.clip(np.floor(high * last + CELL_SLACK) + 1, 0, last).astype(np.intp)


def _rectangles(rows: Cells, columns: Cells, shape: tuple[int, ...]) -> np.ndarray:
    """bool [H, W]: the union of the rectangles rows x columns, each (first, last) with both ends in it."""
    height, width = shape
    (top, bottom), (left, right) = rows, columns
    if len(top) != len(left):  # the one stretch of time, for all points
        top, bottom = np.broadcast_to(top, left.shape), np.broadcast_to(bottom, left.shape)
    size, line = (height + 1) * (width + 1), width + 1
    change = np.bincount(top * line + left, minlength=size) + np.bincount(
        (bottom + 1) * line + right + 1, minlength=size
    )
    change -= np.bincount(top * line + right + 1, minlength=size)
    change -= np.bincount((bottom + 1) * line + left, minlength=size)
    return change.reshape(height + 1, width + 1).cumsum(0).cumsum(1)[:height, :width] > 0


def reach(scene: Scene) -> tuple[Reached, Reached, np.ndarray]:
    """(cells of the global planes, cells of the local ones, bool [N, 10] Gaussians that some view may show).

    scene: as decoded, whose rows are all active at its highest level. A deformation that it lacks has no cells.
    """
    field, local = scene.global_deformation, scene.local_deformation
    box, anchor = scene.info.box, scene.anchor
    cells = _Marks(field.planes if field else (), box)
    local_cells = _Marks(local.planes if local else (), box)
    cells.read(anchor, anchor, 0.0, 1.0)
    shown = np.zeros((len(anchor), N_OFFSETS), bool)
    for rows, stretches in _stretches(scene):
        shown[rows] |= _may_show(scene, rows, {})
        for _, _, ranges in stretches:
            shown[rows] |= _may_show(scene, rows, ranges)
        if local is None:
            continue
        for start, end, ranges in stretches:
            low, high = (x[shown[rows]] for x in _mean_ranges(scene, anchor[rows], rows, ranges))
            local_cells.read(low, high, start, end)
    return cells.reached, local_cells.reached, shown


def _stretches(scene: Scene) -> Iterator[tuple[slice, list[tuple[float, float, Ranges]]]]:
    """Chunks of rows, each with its (start, end, ranges of the global residuals) over time 0..1."""
    field, anchor = scene.global_deformation, scene.anchor
    chunks = [slice(i, min(i + CHUNK, len(anchor))) for i in range(0, len(anchor), CHUNK)]
    if field is None:
        for rows in chunks:
            yield rows, [(0.0, 1.0, {})]
        return
    grid = time_grid(field).tolist()
    for rows, found in zip(chunks, residual_ranges(field, scene.info.box, anchor), strict=True):
        yield rows, list(zip(grid[:-1], grid[1:], found, strict=True))


def _mean_ranges(scene: Scene, anchor: np.ndarray, rows: slice, ranges: Ranges) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) float32 [n, 10, 3] of the Gaussians' means (13.4, step 3) before the local deformation."""
    zero = (np.float32(0), np.float32(0))
    position, scaling = ranges.get("position", zero), ranges.get("scaling", zero)
    offset = tuple(x.reshape(-1, N_OFFSETS, 3) for x in ranges["offset"]) if "offset" in ranges else zero
    with np.errstate(all="ignore"):
        spread = [np.exp(scene.scaling_log[rows] + s)[:, None, :3] for s in scaling]
        corners = [(scene.offset[rows] + o) * s for o in offset for s in spread]
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)  # NaN, of 0 times infinity, is kept
        centre = [(anchor + p)[:, None] for p in position]
        return low + centre[0], high + centre[1]


def _may_show(scene: Scene, rows: slice, ranges: Ranges) -> np.ndarray:
    """bool [n, 10]: the opacity may reach the threshold from some direction, with the features anywhere in `ranges`."""
    low, high = (scene.feature[rows] + r for r in ranges.get("feature", (np.float32(0), np.float32(0))))
    (weight, bias), *rest = scene.networks["opacity"]
    with np.errstate(all="ignore"):
        middle, radius = (low + high) / 2, (high - low) / 2
        value = middle @ weight[:, :FEATURE_DIM].T + bias
        reach = radius @ np.abs(weight[:, :FEATURE_DIM]).T + np.linalg.norm(weight[:, FEATURE_DIM:], axis=1)
        low, high = value - reach, value + reach
        low, high = _through(rest, low, high)
        code = scene.mask[-1][rows].astype(np.float32)[:, None]
        slack = OPACITY_SLACK * (1 + np.abs(low) + np.abs(high))
        shown: np.ndarray = ~((np.tanh(high + slack) * code) < 1.0)  # NaN may show
    return shown


def _through(
    network: Sequence[tuple[np.ndarray, np.ndarray]], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges after ReLU and a linear layer, for each layer of `network`."""
    for weight, bias in network:
        low, high = np.maximum(low, 0), np.maximum(high, 0)
        up, down = np.maximum(weight, 0).T, np.minimum(weight, 0).T
        low, high = low @ up + high @ down + bias, high @ up + low @ down + bias
    return low, high
