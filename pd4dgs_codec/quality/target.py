"""Meeting a size per layer with the least loss: which quantisation steps grow, and which anchors leave the layer.

Each of a layer's knobs (its steps, the share of its anchors that leave) is tried alone at a few values. The lower
convex hull of what a value saves and what it loses gives the knob's segments; the segments of all knobs in the order
of loss per byte are one path from "as given" to "as small as can be" (the allocation of Shoham and Gersho, Efficient
bit allocation for an arbitrary set of quantizers, 1988), and bisection along it over real encodes finds the size. That
takes losses and savings for additive, which they nearly are: measuring them again around what was found, and walking
once more, found nothing better on trained scenes.

Loss and harm are functions given by the caller, so that nothing here needs a renderer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.container import write_chunk
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import write_layer
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.symbols import layer_symbols, rounded
from pd4dgs_codec.scene import Scene

#: Values tried: log2 of the factor on a step, and the share of a layer's anchors that leave it.
OCTAVES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
SHARES = (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8)
#: The knob of the anchors; the others are fields of Steps.
ANCHORS = "anchors"
#: A size is met from this share below it on; sizes are aimed at in the upper part of that range.
SLACK, AIM = 0.03, 0.995
#: Coding effort while searching, and most encodes at the effort that is wanted.
SEARCH_EFFORT, FINAL_TRIES = 1, 6
#: The header names lengths in integers of varying size: so many bytes more than measured are allowed for.
HEADER_MARGIN = 16

Setting = Mapping[str, float]


class Unreachable(Exception):
    """No setting is that small. smallest: the fewest bytes that there are."""

    def __init__(self, smallest: int):
        self.smallest = smallest


@dataclass(frozen=True)
class Segment:
    """A knob's way between two values of its hull. slope: loss per byte saved."""

    knob: str
    start: float
    end: float
    slope: float


# -- the search, over any size and loss --------------------------------------------------------------------------------


def least_loss(
    grids: Mapping[str, Sequence[float]],
    size: Callable[[Setting], int],
    loss: Callable[[Setting], float],
    final_size: Callable[[Setting], int],
    target: int,
) -> dict[str, float]:
    """The setting with final_size <= target, not less than SLACK below it if there is such a one, of least loss found.

    grids: per knob the values to try, ascending, the first of them "as given". size: a fast estimate of final_size up
    to a factor. Raises Unreachable.
    """
    start = {knob: grid[0] for knob, grid in grids.items()}
    if final_size(start) <= target:
        return start
    return _walk(_path(grids, size, loss), start, size, final_size, target)


def _path(
    grids: Mapping[str, Sequence[float]], size: Callable[[Setting], int], loss: Callable[[Setting], float]
) -> list[Segment]:
    """All knobs' segments by slope, each knob measured with the others as given."""
    start = {knob: grid[0] for knob, grid in grids.items()}
    segments = []
    for knob, grid in grids.items():
        points = []
        for value in grid:
            setting = {**start, knob: value}
            points.append((value, float(size(setting)), loss(setting)))
        _, full, least = points[0]
        vertices = convex_hull([(value, full - bytes_, lost - least) for value, bytes_, lost in points])
        for (a, saved_a, loss_a), (b, saved_b, loss_b) in zip(vertices[:-1], vertices[1:], strict=True):
            segments.append(Segment(knob, a, b, (loss_b - loss_a) / (saved_b - saved_a)))
    return sorted(segments, key=lambda s: s.slope)


def convex_hull(points: Sequence[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Of points (value, saved, lost) the lower convex hull from the first one on: rising in saved and in slope."""

    def slope(p: tuple[float, float, float], q: tuple[float, float, float]) -> float:
        return (q[2] - p[2]) / (q[1] - p[1])

    kept = [points[0]]
    for point in sorted(points[1:], key=lambda p: (p[1], p[2])):
        if point[1] <= kept[-1][1]:
            continue
        while len(kept) > 1 and slope(kept[-2], kept[-1]) >= slope(kept[-2], point):
            kept.pop()
        kept.append(point)
    return kept


def _walk(
    path: Sequence[Segment],
    start: Setting,
    size: Callable[[Setting], int],
    final_size: Callable[[Setting], int],
    target: int,
) -> dict[str, float]:
    """The first setting along the path that final_size puts within the target."""

    def at(place: float) -> dict[str, float]:
        whole = min(math.floor(place), len(path) - 1)
        setting = {**start, **{segment.knob: segment.end for segment in path[:whole]}}
        segment = path[whole]
        setting[segment.knob] = segment.start + (place - whole) * (segment.end - segment.start)
        return setting

    ratio = final_size(start) / size(start)
    low, high = 0.0, float(len(path))
    met = None
    for _ in range(FINAL_TRIES if path else 0):
        place = _first(lambda s: ratio * size(at(s)) <= AIM * target, low, high)  # noqa: B023
        got = final_size(at(place))
        if got <= target:
            met = high = place
            if got >= (1 - SLACK) * target:
                break
        elif place == high:
            break
        else:
            low = place
        ratio = got / size(at(place))
    if met is not None:
        return at(met)
    smallest = at(float(len(path))) if path else dict(start)
    if final_size(smallest) > target:
        raise Unreachable(final_size(smallest))
    return smallest


def _first(holds: Callable[[float], bool], low: float, high: float) -> float:
    """About the least place in low..high where a condition that stays true begins to hold; high if it never does."""
    while high - low > 1 / 32:
        middle = (low + high) / 2
        if high - low > 1:  # ends of segments were measured, and are few
            middle = float(round(middle))
            if not low < middle < high:
                middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


# -- a scene's layers --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """How a layer met its target.

    bytes: what it adds to the file, with layer 0 the header and HEADER_MARGIN. factors: on the steps, by field of
    Steps; steps: what became of them. moved: anchors that left it, to_layer where they went, None if they were dropped;
    harm: that of the most harmful of them, in the unit of the harm given, None if there is none.
    """

    layer: int
    target: int
    bytes: int
    factors: dict[str, float]
    moved: int
    to_layer: int | None
    harm: float | None
    steps: dict[str, float]


def fit(
    scene: Scene,
    targets: Mapping[int, int],
    loss: Callable[[Scene], float],
    harm: Callable[[Scene, int], np.ndarray],
    options: EncodeOptions = DEFAULTS,
) -> tuple[Scene, list[LeftOut], list[Fit]]:
    """(scene whose file keeps the targets, anchors that it drops, how) of a planned scene.

    targets: most bytes by layer; a layer that the scene lacks meets any. loss: of a decoded scene, to be kept low.
    harm: float64 [N], what is lost if an anchor of the scene is missing at a level: those of least harm leave first,
    for the next layer or, from the highest, for good. options: of the file that is to be written. Raises EncodeError
    naming the layer and what it could reach.
    """
    fits, dropped = [], 0
    for layer in sorted(targets):
        if layer not in scene.layers:
            fits.append(Fit(layer, targets[layer], 0, {}, 0, None, None, {}))
            continue
        fitted = _Layer(scene, layer, loss, harm, options)
        try:
            found = least_loss(fitted.grids, fitted.size, fitted.loss, fitted.final_size, targets[layer])
        except Unreachable as error:
            raise EncodeError(
                f"target size: layer {layer} takes at least {error.smallest:,} bytes "
                f"(steps up to x{2 ** OCTAVES[-1]:g}, {SHARES[-1]:.0%} of its anchors out of it), "
                f"expected at most {targets[layer]:,}"
            ) from None
        row = fitted.describe(found, targets[layer])
        if row.to_layer is None:
            dropped += row.moved
        fits.append(row)
        scene = fitted.apply(found)
    why = "the least harm to the pictures, left out for the target size"
    return scene, [LeftOut(f"{dropped} anchors", why, anchors=dropped)] if dropped else [], fits


class _Layer:
    """One layer's knobs, and the scenes, sizes and losses of their settings."""

    def __init__(
        self,
        scene: Scene,
        layer: int,
        loss: Callable[[Scene], float],
        harm: Callable[[Scene, int], np.ndarray],
        options: EncodeOptions,
    ):
        self.scene, self.layer, self.index = scene, layer, scene.layers.index(layer)
        self.of_scene = loss
        self.options = replace(options, omit="nothing")  # what no picture needs went before
        steps = list(scene.attributes) if layer == 0 else []
        if layer == 0 or scene.deformation(layer) is not None:
            steps += LAYER_KINDS[layer].step_names
        self.masks = scene.full_masks()
        active = self.masks[self.index] > 0
        if self.index:
            active &= self.masks[self.index - 1] == 0
        own = np.flatnonzero(active)
        harms = harm(scene, layer)[own]
        order = np.argsort(harms, kind="stable")
        self.order, self.harms = own[order], harms[order]
        self.grids = {**{step: OCTAVES for step in steps}, **({ANCHORS: SHARES} if len(own) else {})}
        self.header = 0
        if layer == 0:
            first = encode(scene, self.options, effort=SEARCH_EFFORT, verify=False)
            self.header = info(first)["layers"][0]["offset"] + HEADER_MARGIN
        self._sizes: dict[tuple[int, frozenset[tuple[str, float]]], int] = {}
        self._losses: dict[frozenset[tuple[str, float]], float] = {}

    def apply(self, setting: Setting) -> Scene:
        """The scene at a setting, not planned: steps not rounded, rows with those that went."""
        given = vars(self.scene.steps)
        steps = replace(self.scene.steps, **{k: given[k] * 2.0**v for k, v in setting.items() if k != ANCHORS})
        masks = [codes.copy() for codes in self.masks]
        masks[self.index][self.order[: self._moved(setting)]] = 0
        rows = (len(self.scene.anchor_q),) * len(masks)
        return replace(self.scene, steps=steps, mask=tuple(masks), rows=rows)

    def size(self, setting: Setting) -> int:
        """Bytes at SEARCH_EFFORT."""
        return self._size(setting, SEARCH_EFFORT)

    def final_size(self, setting: Setting) -> int:
        """Bytes at the effort wanted."""
        return self._size(setting, self.options.effort)

    def loss(self, setting: Setting) -> float:
        """What the given loss says of the decoded scene."""
        key = frozenset(setting.items())
        if key not in self._losses:
            self._losses[key] = self.of_scene(rounded(self._planned(setting)))
        return self._losses[key]

    def _planned(self, setting: Setting) -> Scene:
        return plan(self.apply(setting), self.options)[0]

    def _size(self, setting: Setting, effort: int) -> int:
        """Bytes that the layer adds to the file; none if the plan leaves it out."""
        key = effort, frozenset(setting.items())
        if key not in self._sizes:
            planned, size = self._planned(setting), 0
            if self.layer in planned.layers:
                index = planned.layers.index(self.layer)
                symbols = layer_symbols(planned, index)
                payload, _ = write_layer(symbols, replace(self.options, effort=effort))
                size = self.header + len(write_chunk(symbols.kind.chunk_type, 0, bytes(8), payload))
            self._sizes[key] = size
        return self._sizes[key]

    def _moved(self, setting: Setting) -> int:
        return round(setting.get(ANCHORS, 0.0) * len(self.order))

    def describe(self, setting: Setting, target: int) -> Fit:
        """The report of the setting that was taken."""
        moved = self._moved(setting)
        above = self.scene.layers[self.index + 1 :]
        factors = {k: 2.0**v for k, v in setting.items() if k != ANCHORS}
        steps = self._planned(setting).steps
        return Fit(
            layer=self.layer,
            target=target,
            bytes=self.final_size(setting),
            factors=factors,
            moved=moved,
            to_layer=above[0] if above else None,
            harm=float(self.harms[moved - 1]) if moved else None,
            steps={k: vars(steps)[k] for k in factors},
        )
