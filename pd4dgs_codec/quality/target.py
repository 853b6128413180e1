"""Fits layers, or a whole file, to target sizes at the least loss: grows quantisation steps, and moves anchors out.

Each of a layer's parameters (its steps, the share of its anchors that leave) is tried alone at a few values. The lower
convex hull of bytes saved and loss added gives the parameter's segments. The segments of all parameters, sorted by loss
per byte, form one path from the given setting to the smallest (Shoham and Gersho, Efficient bit allocation for an
arbitrary set of quantizers, 1988). Bisection along the path over real encodes finds the target size. This assumes that
losses and savings add up, which is nearly true: on trained scenes a second search around the first result found nothing
better.

The caller passes the loss and the error of omitted anchors as functions, so that this module needs no renderer.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.container import write_chunk
from pd4dgs_codec.format.encoder import encode_with_report, header_size
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.payload import write_slice
from pd4dgs_codec.format.plan import LeftOut, Plan, in_file_order, passed, plan
from pd4dgs_codec.format.registry import MAX_PAYLOAD
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.kinds.scaffold import step_names
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.tensors.symbols import LayerSymbols, sliced

#: Values tried: log2 of the factor on a step, and the share of a layer's anchors that leave it.
OCTAVES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
SHARES = (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.8)
#: The parameter of the anchors; the others are fields of Steps.
ANCHORS = "anchors"
#: Shares of the target size: the search aims at AIM, and accepts sizes up to SLACK below the target.
SLACK, AIM = 0.03, 0.995
#: Share of the estimated smallest size that no setting is below: the estimate drops the anchors of most bits.
BOUND = 0.9
#: Coding effort of the search, and the most encodes at the effort of the file.
SEARCH_EFFORT, FINAL_TRIES = 1, 6

Setting = Mapping[str, float]


class Unreachable(Exception):
    """Raised if no setting is small enough. smallest: the fewest bytes that were reached."""

    def __init__(self, smallest: int):
        self.smallest = smallest


@dataclass(frozen=True)
class Segment:
    """A parameter's range between two neighbouring values of its hull. slope: loss per byte saved."""

    name: str
    start: float
    end: float
    slope: float


def least_loss(
    grids: Mapping[str, Sequence[float]],
    size: Callable[[Setting], int],
    loss: Callable[[Setting], float],
    final_size: Callable[[Setting], int],
    target: int,
) -> dict[str, float]:
    """Returns the setting of least loss found with final_size <= target, if possible at most SLACK below it.

    grids: by parameter the values to try, from the given one to that of the smallest size. size: a fast estimate of
    final_size, up to a factor. Raises Unreachable, before any loss is measured, if the last values take more.
    """
    start = {name: grid[0] for name, grid in grids.items()}
    most = needed(grids, final_size, target)
    return start if most == start else _walk(_path(grids, size, loss), start, size, final_size, target) or most


def needed(grids: Mapping[str, Sequence[float]], final_size: Callable[[Setting], int], target: int) -> dict[str, float]:
    """Returns the given setting if it takes at most `target`, else that of the smallest size, or raises Unreachable."""
    start, smallest = ({name: grid[i] for name, grid in grids.items()} for i in (0, -1))
    if final_size(start) <= target:
        return start
    if final_size(smallest) > target:
        raise Unreachable(final_size(smallest))
    return smallest


def _path(
    grids: Mapping[str, Sequence[float]], size: Callable[[Setting], int], loss: Callable[[Setting], float]
) -> list[Segment]:
    """Returns the segments of all parameters, sorted by slope; each parameter is measured with the others as given."""
    start = {name: grid[0] for name, grid in grids.items()}
    segments = []
    for name, grid in grids.items():
        points = []
        for value in grid:
            setting = {**start, name: value}
            points.append((value, float(size(setting)), loss(setting)))
        _, full, least = points[0]
        vertices = convex_hull([(value, full - bytes_, lost - least) for value, bytes_, lost in points])
        for (a, saved_a, loss_a), (b, saved_b, loss_b) in zip(vertices[:-1], vertices[1:], strict=True):
            segments.append(Segment(name, a, b, (loss_b - loss_a) / (saved_b - saved_a)))
    return sorted(segments, key=lambda s: s.slope)


def convex_hull(points: Sequence[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Returns the lower convex hull of points (value, saved, lost) from the first one on, rising in saved and slope."""

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
) -> dict[str, float] | None:
    """Returns the first setting found along the path with final_size <= target, None if there is none."""

    def at(position: float) -> dict[str, float]:
        whole = min(math.floor(position), len(path) - 1)
        setting = {**start, **{segment.name: segment.end for segment in path[:whole]}}
        segment = path[whole]
        setting[segment.name] = segment.start + (position - whole) * (segment.end - segment.start)
        return setting

    ratio = final_size(start) / size(start)
    low, high = 0.0, float(len(path))
    met = None
    for _ in range(FINAL_TRIES if path else 0):
        position = _first(lambda s: ratio * size(at(s)) <= AIM * target, low, high)  # noqa: B023
        got = final_size(at(position))
        if got <= target:
            met = high = position
            if got >= (1 - SLACK) * target:
                break
        elif position == high:
            break
        else:
            low = position
        if estimate := size(at(position)):  # 0 if the layer has no effect at this setting
            ratio = got / estimate
    return None if met is None else at(met)


def _first(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Returns about the least position in low..high where a monotone condition holds, or high if it holds nowhere."""
    while high - low > 1 / 32:
        middle = (low + high) / 2
        if high - low > 1:  # try ends of segments first: they were measured, and are few
            middle = float(round(middle))
            if not low < middle < high:
                middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


@dataclass(frozen=True)
class Fit:
    """How a layer, or the whole file (layer None), met its target.

    bytes: size that it adds to the file, or a few more for layer 0, with the header. factors: on the steps, by field of
    Steps. steps: the resulting steps. moved: number of anchors that left the layer. to_layer: the layer that they went
    to, None if they were dropped. omission_error: the largest among them, None without any.
    """

    layer: int | None
    target: int
    bytes: int = 0
    factors: dict[str, float] = field(default_factory=dict)
    moved: int = 0
    to_layer: int | None = None
    omission_error: float | None = None
    steps: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Fitter:
    """Fits a planned scene to targets, and keeps its measurements from one fit to the next.

    targets: most bytes by layer, or {None: most bytes of the file}; an absent layer meets any. loss: of a decoded
    scene, to be minimised. omission_error: float64 [N], the error of omitting each anchor of the scene at a level;
    anchors of least error move to the next layer first, or are dropped from the highest. options: of the file to be
    written. growth: by layer, a factor on its bytes, for slices, which are measured with the largest anchors first; the
    caller may change it between fits.
    """

    scene: Scene
    targets: Mapping[int | None, int]
    loss: Callable[[AnyScene], float]
    omission_error: Callable[[Scene, int], np.ndarray]
    options: EncodeOptions = DEFAULTS
    growth: defaultdict[int | None, float] = field(default_factory=lambda: defaultdict(lambda: 1.0))
    _layers: dict[tuple[Any, ...], "_Layer"] = field(default_factory=dict)

    def fit(self) -> tuple[Scene, list[LeftOut], list[Fit]]:
        """Returns the scene, the dropped anchors, and how each layer met its target. Raises EncodeError naming the
        layer and its smallest size, before any loss is measured if no setting of earlier layers helps."""
        targets, fits = self.targets, list[Fit]()
        order = sorted(targets, key=lambda layer: layer or 0)
        present = [layer for layer in order if layer is None or layer in self.scene.layers]
        try:
            for quick in (True, False):  # refuses sizes before any search, first those that need no omission_error
                scene, settings = self.scene, list[Setting]()
                for layer in present:
                    fitted, target = self._layer(scene, layer, settings), targets[layer]
                    if quick and fitted.least_size > target:
                        raise Unreachable(fitted.least_size)
                    most = fitted.smallest if quick else needed(fitted.grids, fitted.final_size, target)
                    settings.append({**most, ANCHORS: 0.0})  # anchors that leave make later layers larger
                    scene = fitted.apply(settings[-1])
            scene, settings = self.scene, []
            for layer in order:
                target = targets[layer]
                if layer not in present:
                    fits.append(Fit(layer, target))
                    continue
                fitted = self._layer(scene, layer, settings)
                settings.append(least_loss(fitted.grids, fitted.size, fitted.loss, fitted.final_size, target))
                fits.append(fitted.describe(settings[-1], target))
                scene = fitted.apply(settings[-1])
        except Unreachable as error:
            what = "the file" if layer is None else f"layer {layer}"
            raise EncodeError(
                f"target size: {what} takes at least {error.smallest:,} bytes "
                f"(steps up to x{2 ** OCTAVES[-1]:g}, {SHARES[-1]:.0%} of its anchors moved out), "
                f"expected at most {targets[layer]:,}"
            ) from None
        dropped = sum(row.moved for row in fits if row.to_layer is None)
        if not dropped:
            return scene, [], fits
        scene, _ = in_file_order(scene, scene.layers)  # removes dropped anchors, else a plan would report them too
        why = "least error in the pictures, left out to reach the target size"
        return scene, [LeftOut(f"{dropped} anchors", why, anchors=dropped)], fits

    def _layer(self, scene: Scene, layer: int | None, settings: Sequence[Setting]) -> "_Layer":
        """Returns the layer of a scene whose earlier layers have these settings."""
        key = layer, *(tuple(setting.items()) for setting in settings)
        if key not in self._layers:
            self._layers[key] = _Layer(self, scene, layer)
        return self._layers[key]


class _Layer:
    """The parameters of one layer, or of all (layer None), and the scenes, sizes and losses of their settings."""

    def __init__(self, fitter: Fitter, scene: Scene, layer: int | None):
        self.fitter, self.scene, self.layer = fitter, scene, layer
        self.layers = scene.layers if layer is None else (layer,)
        self.indices = [scene.layers.index(layer) for layer in self.layers]
        self.options = replace(fitter.options, omit="nothing")  # planning has made unread cells cheap already
        steps = list(scene.attributes) if 0 in self.layers else []
        for number in self.layers:
            if number == 0 or scene.deformation(number) is not None:
                steps += step_names(number)
        masks = scene.full_masks()
        active = masks[self.indices[-1]] > 0
        if self.indices[0]:
            active &= masks[self.indices[0] - 1] == 0
        self.own = np.flatnonzero(active)
        self.grids = {**{step: OCTAVES for step in steps}, **({ANCHORS: SHARES} if len(self.own) else {})}
        self.smallest = {name: grid[-1] for name, grid in self.grids.items()}
        self.header = 0
        if 0 in self.layers:
            symbols = self._planned({}).symbols
            self.header = header_size(symbols, self.options.mode, len(symbols.layers), MAX_PAYLOAD)
        self._sizes: dict[tuple[int, frozenset[tuple[str, float]]], int] = {}
        self._losses: dict[frozenset[tuple[str, float]], float] = {}

    @cached_property
    def leaving(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of the layer's anchors in the order in which they leave, and their errors."""
        errors = self.fitter.omission_error(self.scene, self.layers[-1])[self.own]
        order = np.argsort(errors, kind="stable")
        return self.own[order], errors[order]

    @cached_property
    def least_size(self) -> int:
        """A lower bound of the sizes, from the coarsest steps and the anchors that take the fewest bits."""
        total = self.header
        for symbols in self._symbols({**self.smallest, ANCHORS: 0.0}):
            bits = symbols.bits_per_row()
            kept = np.argsort(bits, kind="stable")[: len(bits) - round(SHARES[-1] * len(bits))]
            total += len(write_chunk(0, 0, bytes(8), write_slice(sliced(symbols, kept, True), self.options)[0]))
        return math.floor(BOUND * total)

    def apply(self, setting: Setting) -> Scene:
        """Returns the scene at a setting, not planned: steps are not rounded, rows include the anchors that left."""
        given = vars(self.scene.steps)
        steps = replace(self.scene.steps, **{k: given[k] * 2.0**v for k, v in setting.items() if k != ANCHORS})
        scene, moved = self.scene, self._moved(setting)
        rows = self.leaving[0][:moved] if moved else self.own[:0]
        for index in self.indices:
            scene = passed(scene, index, rows)
        return replace(scene, steps=steps)

    def size(self, setting: Setting, effort: int = SEARCH_EFFORT) -> int:
        """Returns the bytes that the layer adds to the file, 0 if the plan leaves it out."""
        key = effort, frozenset(setting.items())
        if key not in self._sizes:
            self._sizes[key] = self._added_bytes(setting, effort)
        return math.ceil(self.fitter.growth[self.layer] * self._sizes[key])

    def _added_bytes(self, setting: Setting, effort: int) -> int:
        if self.options.slices and effort == self.options.effort:
            report = encode_with_report(self.apply(setting), self.options, verify=False)[1]
            added = report.added_bytes()
            return sum(added.get(layer, 0) for layer in self.layers)
        options, symbols = replace(self.options, effort=effort), self._symbols(setting)
        chunks = [len(write_chunk(0, 0, bytes(8), write_slice(layer, options)[0])) for layer in symbols]
        return self.header + sum(chunks) if chunks else 0

    def _symbols(self, setting: Setting) -> list[LayerSymbols]:
        return [symbols for symbols in self._planned(setting).symbols.layers if symbols.layer in self.layers]

    def final_size(self, setting: Setting) -> int:
        """`size` at the effort of the file."""
        return self.size(setting, self.options.effort)

    def loss(self, setting: Setting) -> float:
        key = frozenset(setting.items())
        if key not in self._losses:
            self._losses[key] = self.fitter.loss(self._planned(setting).symbols.scene())
        return self._losses[key]

    def _planned(self, setting: Setting) -> Plan:
        return plan(self.apply(setting), self.options)

    def _moved(self, setting: Setting) -> int:
        return round(setting.get(ANCHORS, 0.0) * len(self.own))

    def describe(self, setting: Setting, target: int) -> Fit:
        moved, steps = self._moved(setting), self._planned(setting).scene.all_steps
        factors = {k: 2.0**v for k, v in setting.items() if k != ANCHORS}
        return Fit(
            layer=self.layer,
            target=target,
            bytes=self.final_size(setting),
            factors=factors,
            moved=moved,
            to_layer=next(iter(self.scene.layers[self.indices[-1] + 1 :]), None),
            omission_error=float(self.leaving[1][moved - 1]) if moved else None,
            steps={k: steps[k] for k in factors},
        )
