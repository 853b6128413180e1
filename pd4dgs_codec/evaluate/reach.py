"""Which cells of a HexPlane a renderer can ever read, and which Gaussians it can ever draw: proven, not sampled.

The global planes are read at the anchors, which stand still. The local ones are read at the Gaussians' means before
the local deformation: each mean lies in a box per stretch of time (see `enclosure`), and every cell that a point of
the box may read counts. A Gaussian whose opacity stays under the threshold for every direction and time is never drawn
(clause 13.4, step 4), so where it lies matters to no picture.

Boxes over a whole stretch, from one instant to the next, may be far wider than what they enclose. But most wide boxes
hold no cell that is not read anyway. Stretches are halved only where a wide box does, and where the opacity of a
Gaussian that no sample shows is in doubt.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec import threads
from pd4dgs_codec.evaluate.enclosure import Enclosure, Range, Ranges, instants, kernels
from pd4dgs_codec.scene import PLANES, SCALING_DIM, Deformation, Scene, plane_sides

Reached = tuple[dict[str, np.ndarray], ...]  #: per scale, plane name -> bool [H, W]

Cells = tuple[np.ndarray, np.ndarray]  #: (first, last) cell on an axis, int64 [n]
Span = tuple[float, float]  #: of time, 0..1

#: Cells by which a position may be off: another renderer rounds its coordinates otherwise.
CELL_SLACK = 0.02
#: Share by which an opacity may be off, for the same reason.
OPACITY_SLACK = 1e-3
#: Halvings of the time between two instants, for cells and for what is shown (whose offsets are few bytes).
HALVINGS, SHOW_HALVINGS = 2, 1
#: A box at most so wide, in cells of the finest plane, is not made narrower.
NARROW = 0.3
#: Points enclosed at once: bounds the memory.
CHUNK = 1024
#: Chunks after which it is first asked again whether going on pays.
SAMPLE = 16
#: Anchors that are looked at at once where nothing is enclosed.
BLOCK = 1 << 13

Known = TypeVar("Known")


#: (what is known of the cells or Gaussians, evaluations of the global networks left) -> whether to go on.
Pays = Callable[[Known, int], bool]


def _always(*_: Any) -> bool:
    return True


class _Boxes:
    """Where points may lie in the unit cube, float32 [n, 3], and over which times, float64 [n]."""

    def __init__(self, low: np.ndarray, high: np.ndarray, start: np.ndarray, end: np.ndarray):
        self.low, self.high, self.start, self.end = low, high, start, end


class _Marks:
    """The cells read so far of all planes of a deformation; threads of `pool` share its scales."""

    def __init__(self, planes: tuple[dict[str, np.ndarray], ...], pool: ThreadPoolExecutor):
        self.sides, self.pool = [plane_sides(scale) for scale in planes], pool
        self.reached = tuple({n: np.zeros(scale[n].shape[1:], bool) for n, _, _ in PLANES} for scale in planes)

    def read(self, boxes: _Boxes) -> None:
        """Points in the boxes may be read."""

        def read(marks: dict[str, np.ndarray], sides: Sequence[int]) -> None:
            axes = _axes(boxes, sides)
            for name, a, b in PLANES:
                change = _one_wider(marks[name])
                _add_rectangles(change, axes[b], axes[a])
                marks[name] |= change.cumsum(0).cumsum(1)[:-1, :-1] > 0

        list(self.pool.map(read, self.reached, self.sides))

    def unread(self, boxes: _Boxes) -> np.ndarray:
        """bool [n]: the boxes that hold a cell not read so far."""

        def unread(marks: dict[str, np.ndarray], sides: Sequence[int]) -> np.ndarray:
            axes, found = _axes(boxes, sides), np.zeros(len(boxes.low), bool)
            for name, a, b in PLANES:
                sums = _one_wider(marks[name])
                np.cumsum(np.cumsum(~marks[name], axis=0), axis=1, out=sums[1:, 1:])
                found |= _counted(sums, axes[b], axes[a])
            return found

        found: np.ndarray = np.any(list(self.pool.map(unread, self.reached, self.sides)), axis=0)
        return found


def _axes(boxes: _Boxes, sides: Sequence[int]) -> list[Cells]:
    """The cells on the axes x, y, z, t of so many."""
    axes = [_cells(boxes.low[:, i], boxes.high[:, i], sides[i]) for i in range(3)]
    return [*axes, _cells(boxes.start, boxes.end, sides[3])]


def _one_wider(marks: np.ndarray) -> np.ndarray:
    """Zeros, int64 [H + 1, W + 1] for marks [H, W]."""
    height, width = marks.shape
    return np.zeros((height + 1, width + 1), np.int64)


def _cells(low: np.ndarray, high: np.ndarray, side: int) -> Cells:
    """(first, last) cell that a sample between low and high, 0..1, reads on an axis of `side` cells."""
    if found := kernels():
        own: Cells = found.cells(low, high, side, CELL_SLACK)
        return own
    last = side - 1
    first = np.clip(np.floor(low * last - CELL_SLACK), 0, max(last - 1, 0)).astype(np.int64)
    return first, np.clip(np.floor(high * last + CELL_SLACK) + 1, 0, last).astype(np.int64)


def _add_rectangles(change: np.ndarray, rows: Cells, columns: Cells) -> None:
    """Adds rectangles rows x columns, each (first, last) with both ends in it, to the mixed differences int64
    [H + 1, W + 1] of how many cover a cell."""
    (top, bottom), (left, right) = rows, columns
    if found := kernels():
        found.add_rectangles(change, top, bottom, left, right)
        return
    for y, x, sign in ((top, left, 1), (bottom + 1, right + 1, 1), (top, right + 1, -1), (bottom + 1, left, -1)):
        np.add.at(change, (y, x), sign)


def _counted(sums: np.ndarray, rows: Cells, columns: Cells) -> np.ndarray:
    """bool [n]: whether rectangles hold anything, from its sums over all cells before, int64 [H + 1, W + 1]."""
    (top, bottom), (left, right) = rows, columns
    if found := kernels():
        counted: np.ndarray = found.counted(sums, top, bottom, left, right)
        return counted
    b, r = bottom + 1, right + 1
    held: np.ndarray = sums[b, r] - sums[top, r] - sums[b, left] + sums[top, left] > 0
    return held


def global_cells(scene: Scene) -> Reached:
    """The cells of the global planes that anchors read; () without such planes."""
    field = scene.global_deformation
    with ThreadPoolExecutor(threads.encoder_threads()) as pool:
        marks = _Marks(field.planes if field else (), pool)
        for rows in _blocks(scene):
            anchor = scene.anchor_at(rows)
            whole = np.zeros(len(anchor)), np.ones(len(anchor))
            marks.read(_Boxes(*_unit(scene.info.box, anchor, anchor), *whole))
    return marks.reached


def shown_gaussians(scene: Scene, pays: Pays[np.ndarray] = _always) -> np.ndarray:
    """bool [N, G]: the Gaussians that some view may show. Those that features without residuals do not show are
    looked at if it `pays`, which is told what is certain, as if no other were shown. In large scenes it is asked again
    now and then, as if the share that was proven not to be shown so far held for all; the rest then counts as shown."""
    shown = np.concatenate([_may_show(scene, rows, None) for rows in _blocks(scene)])
    field = scene.global_deformation
    if field is None or "feature" not in field.networks:
        return shown
    open_, spans = np.flatnonzero(~shown.all(axis=1)), _spans(field)
    if not pays(shown, open_.size * len(spans)):
        return np.ones_like(shown)
    certain, chunks, looked, hidden = shown.copy(), _chunks(open_), 0, 0
    with ThreadPoolExecutor(threads.encoder_threads()) as pool:
        for index, rows in enumerate(chunks):
            if index >= SAMPLE and index & (index - 1) == 0:
                share = max(hidden, 1) / looked
                if not pays(certain, int(open_.size * len(spans) / share)):
                    shown[np.concatenate(chunks[index:])] = True
                    break
            looked += int((~shown[rows]).sum())
            enclosure = Enclosure(field, scene.info.box, scene.anchor_at(rows))
            shown[rows] = _shown(scene, rows, shown[rows], enclosure, spans, pool)
            hidden += int((~shown[rows]).sum())
    return shown


def local_cells(scene: Scene, shown: np.ndarray, pays: Pays[Reached] = _always) -> Reached | None:
    """The cells of the local planes that the Gaussians `shown` bool [N, G] read; () without such planes. None if it
    does not pay to go on: `pays` is told now and then which cells are read by the anchors so far."""
    field, local = scene.global_deformation, scene.local_deformation
    if local is None:
        return ()
    spans, asked, left = _spans(field), 0, len(scene.anchor_q)
    with ThreadPoolExecutor(threads.encoder_threads()) as pool:
        marks = _Marks(local.planes, pool)
        for index, rows in enumerate(_chunks(np.arange(left))):
            if index == 2 * asked or index == 1:  # asking costs as much as some thousand evaluations
                if not pays(marks.reached, left * len(spans)):
                    return None
                asked = index
            anchor = scene.anchor_at(rows)
            enclosure = Enclosure(field, scene.info.box, anchor) if field else None
            _read_local(scene, anchor, rows, shown[rows], marks, enclosure, spans)
            left -= len(rows)
    return marks.reached


def _blocks(scene: Scene) -> Iterable[slice]:
    """All anchors, so many at a time that what is worked out about each takes little memory. Of none one block."""
    yield from (slice(first, first + BLOCK) for first in range(0, max(len(scene.anchor_q), 1), BLOCK))


def _spans(field: Deformation | None) -> list[Span]:
    grid = instants(field) if field else np.array([0.0, 1.0])
    return list(zip(grid[:-1].tolist(), grid[1:].tolist(), strict=True))


def _chunks(rows: np.ndarray) -> list[np.ndarray]:
    """At most CHUNK rows each, every one spread over the scene: the first read most cells."""
    count = -(-len(rows) // CHUNK)
    return [rows[first::count] for first in range(count)]


def _shown(
    scene: Scene,
    rows: np.ndarray,
    certain: np.ndarray,
    enclosure: Enclosure,
    spans: Sequence[Span],
    pool: ThreadPoolExecutor,
) -> np.ndarray:
    """bool [n, G]: the Gaussians of the anchors `rows` that some view may show at some time, with those `certain`."""
    shown: np.ndarray = certain.copy()

    def found(span: Span, open_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gaussians [m, G] that the middle of the span shows, and those that it may show at any of its times."""
        feature = enclosure.ranges(*span, ["feature"], open_)["feature"]
        middle = Range(feature.middle, feature.middle, feature.middle)
        return _may_show(scene, rows[open_], middle), _may_show(scene, rows[open_], feature)

    pending = [(span, np.arange(len(rows))) for span in spans]
    for halving in range(SHOW_HALVINGS + 1):
        results = list(pool.map(lambda pair: found(*pair), pending))
        for (_, at), (sampled, possible) in zip(pending, results, strict=True):
            shown[at] |= possible if halving == SHOW_HALVINGS else sampled
        doubtful = [
            (span, at[(possible & ~shown[at]).any(axis=1)])
            for (span, at), (_, possible) in zip(pending, results, strict=True)
        ]
        pending = [(half, at) for span, at in doubtful if at.size for half in _halves(span)]
    return shown


def _read_local(
    scene: Scene,
    anchor: np.ndarray,
    rows: np.ndarray,
    shown: np.ndarray,
    marks: _Marks,
    enclosure: Enclosure | None,
    spans: Sequence[Span],
) -> None:
    """Marks the cells that the Gaussians `shown` bool [n, G] of the anchors `rows` read."""
    finest = np.array([max(sides[axis] for sides in marks.sides) - 1 for axis in range(3)], np.float32)

    def boxes(span: Span, at: np.ndarray, out: np.ndarray) -> None:
        """Fills out [3, m, G, 3] in the unit cube: in the middle of the span, low, high."""
        ranges = enclosure.ranges(*span, ["position", "offset", "scaling"], at) if enclosure else {}
        _mean_ranges(out, scene, anchor[at], rows[at], ranges)

    pending = [(span, np.arange(len(rows))) for span in spans]
    for halving in range(HALVINGS + 1):
        sizes = [at.size for _, at in pending]
        which = np.repeat(np.arange(len(pending)), sizes)  # the span of each anchor
        taken = np.concatenate([shown[at] for _, at in pending])  # bool [m, G]
        found = np.empty((3, *taken.shape, 3), np.float32)
        outs = np.split(found, np.cumsum(sizes)[:-1], axis=1)  # filled in place: the largest arrays of the encoder
        list(marks.pool.map(boxes, *zip(*pending, strict=True), outs))
        middle, low, high = found.reshape(3, -1, 3)
        start, end = (np.array([span[i] for span, _ in pending])[which] for i in range(2))
        wide = np.zeros(len(taken), bool) if halving == HALVINGS else _wide(found[1], found[2], taken, finest)
        slots = np.flatnonzero(taken & ~wide[:, None])
        of = slots // taken.shape[1]
        marks.read(_Boxes(low[slots], high[slots], start[of], end[of]))
        slots = np.flatnonzero(taken & wide[:, None])
        of = slots // taken.shape[1]
        time = (start[of] + end[of]) / 2
        marks.read(_Boxes(middle[slots], middle[slots], time, time))
        unread = marks.unread(_Boxes(low[slots], high[slots], start[of], end[of]))
        halved = np.zeros(len(wide), bool)
        halved[of[unread]] = True
        parts = np.split(halved, np.cumsum(sizes)[:-1])
        pending = [
            (half, at[part])
            for (span, at), part in zip(pending, parts, strict=True)
            if part.any()
            for half in _halves(span)
        ]
        if not pending:
            return


def _wide(low: np.ndarray, high: np.ndarray, taken: np.ndarray, finest: np.ndarray) -> np.ndarray:
    """bool [m]: the anchors of which one of the boxes, low to high float32 [m, G, 3] in the unit cube, of the Gaussians
    `taken` [m, G] is wider than NARROW cells, of which the cube has `finest` float32 [3] at most; NaN is wide."""
    if found := kernels():
        own: np.ndarray = found.wide(low, high, taken, finest, NARROW)
        return own
    wide: np.ndarray = ~((((high - low) * finest).max(axis=2) <= NARROW) | ~taken).all(axis=1)
    return wide


def _halves(span: Span) -> tuple[Span, Span]:
    middle = (span[0] + span[1]) / 2
    return (span[0], middle), (middle, span[1])


def _unit(box: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) float32 [..., 3] in the unit cube of points in scene units; NaN stands for anywhere."""
    extent = _extent(box)
    low, high = (low - box[0]) / extent, (high - box[0]) / extent
    return np.fmin(np.fmax(low, 0), 1), np.fmax(np.fmin(high, 1), 0)


def _extent(box: np.ndarray) -> np.ndarray:
    extent: np.ndarray = np.maximum(box[1] - box[0], np.finfo(np.float32).tiny)
    return extent


def _mean_ranges(out: np.ndarray, scene: Scene, anchor: np.ndarray, rows: np.ndarray, ranges: Ranges) -> None:
    """Fills out float32 [3, n, G, 3], in the middle, low, high, with where the Gaussians' means (13.4, step 3) of the
    anchors [n, 3] at `rows` lie before the local deformation, in the unit cube."""
    widths = {"position": 3, "offset": 3 * scene.widths.slots, "scaling": SCALING_DIM}
    still = {name: Range(*[np.zeros((len(rows), width), np.float32)] * 3) for name, width in widths.items()}
    position, offset, scaling = (ranges.get(name, still[name]) for name in widths)
    with np.errstate(all="ignore"):
        spread = tuple(np.exp((scene.scaling_log[rows] + s)[:, :3]) for s in scaling)
        centre = tuple(anchor + p for p in position)
        box = scene.info.box
        if found := kernels():
            found.mean_ranges(out, scene.offset, rows, tuple(offset), spread, centre, box[0], _extent(box))
            return
        offsets = [scene.offset[rows] + o.reshape(-1, scene.widths.slots, 3) for o in offset]
        corners = [o * s[:, None] for o in offsets[1:] for s in spread[1:]]
        low, high = np.minimum(corners[0], corners[1]), np.maximum(corners[0], corners[1])
        for corner in corners[2:]:  # NaN, of 0 times infinity, is kept
            low, high = np.minimum(low, corner), np.maximum(high, corner)
        middle = offsets[0] * spread[0][:, None] + centre[0][:, None]
        out[0] = _unit(box, middle, middle)[0]
        out[1:] = _unit(box, low + centre[1][:, None], high + centre[2][:, None])


def _may_show(scene: Scene, rows: np.ndarray | slice, feature: Range | None) -> np.ndarray:
    """bool [n, G]: the opacity may reach the threshold from some direction, with residuals of the features anywhere
    in `feature`, or 0."""
    low, high = (scene.feature[rows] + r for r in ((np.float32(0),) * 2 if feature is None else feature[1:]))
    (weight, bias), *rest = scene.networks["opacity"]
    width = scene.widths.feature
    with np.errstate(all="ignore"):
        middle, radius = (low + high) / 2, (high - low) / 2
        value = middle @ weight[:, :width].T + bias
        reach = radius @ np.abs(weight[:, :width]).T + np.linalg.norm(weight[:, width:], axis=1)
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
