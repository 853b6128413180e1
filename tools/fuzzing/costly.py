"""A search for legal files that cost a decoder most for their bytes, in processor time or in memory.

A file is built from a `Recipe`, a handful of choices each of which some part of a decoder pays for. The search changes
the recipes that cost most so far and keeps what costs more: a hill climb from several places, seeded. What no decoder
takes, because a choice breaks a limit, is dropped.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from vectors import blocks
from vectors.blocks import Known

from fuzzing.check import memory_bound, peak_memory
from pd4dgs_codec import decode
from pd4dgs_codec.attributes.table import NO_CLASSES
from pd4dgs_codec.entropy.priors import Gauss, Hist, Mixture, Normal, Prior, Window
from pd4dgs_codec.errors import DecodeError, Pd4Error
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import DEFAULT_WIDTHS, PLANES, Widths

PRIORS = ("const", "gauss", "mixture", "hist", "scaled", "exceptions")
LARGEST = 1 << 18  #: bytes of a file that is kept: what is dear by the byte shows in small ones
MOST_SYMBOLS = (1 << 22) + 64 * LARGEST  #: fewer than clause 6.5 allows, so that many files are tried
MOST_SLICES = 64  #: of a layer, so that many files are tried: what a slice costs besides shows in a few
#: What a file may cost, in seconds of a processor of 2023 and in bytes of memory: once, and for each of its bytes. The
#: symbols of clause 6.5 at 48 bytes and some 0.1 microseconds each.
SECONDS, MEMORY = (0.4, 25e-6), (48 << 22, 48 << 8)


@dataclass(frozen=True)
class Coded:
    """How the channels of a section are coded. window: entries of each prior. own: a prior for each channel, else one
    for all. staged: form 1, with so many classes."""

    prior: str = "const"
    window: int = 2
    own: bool = False
    staged: bool = False
    classes: int = 1


@dataclass(frozen=True)
class LayerRecipe:
    """A layer. scales: (channels, x, y, z, t) each, all of as many channels. terms: of each predicted channel. spread:
    voxels between anchors. widths: of hidden layers. slices: among which the anchors are divided, some of them empty.
    redefined: later slices define priors of their own."""

    anchors: int = 1
    spread: int = 1
    attributes: Coded = Coded()
    terms: int = 0
    scales: tuple[tuple[int, ...], ...] = ()
    predictor: int = 0
    planes: Coded = Coded()
    widths: tuple[int, ...] = ()
    slices: int = 1
    redefined: bool = False


@dataclass(frozen=True)
class Recipe:
    """A file. feature, slots: the widths of its anchors. graded: whether they have step classes."""

    layers: tuple[LayerRecipe, ...] = (LayerRecipe(),)
    feature: int = DEFAULT_WIDTHS.feature
    slots: int = DEFAULT_WIDTHS.slots
    graded: bool = False


@dataclass(order=True)
class Found:
    """What a recipe costs: `share` is that of the seconds or of the memory that a file of its length may cost. bound:
    the most memory that decoding it may take (clause 15), 0 where none was measured."""

    share: float
    seconds: float = field(compare=False)
    memory: int = field(compare=False)
    bound: int = field(compare=False)
    data: bytes = field(compare=False, repr=False)
    recipe: Recipe = field(compare=False)

    def row(self) -> dict[str, Any]:
        """What a table shows."""
        return {
            "share": round(self.share, 3),
            "bytes": len(self.data),
            "seconds": round(self.seconds, 3),
            "memory": self.memory,
            "bound": self.bound,
            "recipe": asdict(self.recipe),
        }


# -- files of recipes --------------------------------------------------------------------------------------------------


def build(recipe: Recipe) -> bytes:
    """The file. Raises Pd4Error or ValueError where the parts of a recipe exclude each other."""
    widths = Widths(recipe.feature, recipe.slots, recipe.graded)
    if sum(_symbols(layer, widths) for layer in recipe.layers) > MOST_SYMBOLS:
        raise ValueError("more symbols than a file of LARGEST bytes may declare")
    slices, before = list[blocks.Layer](), 0
    for number, layer in enumerate(recipe.layers):
        slices += _slices(number, layer, before, widths)
        before += layer.anchors
    return blocks.make_file(*slices).data()


def _symbols(layer: LayerRecipe, widths: Widths) -> int:
    planes = sum(s[0] * s[1 + a] * s[1 + b] for s in layer.scales for _, a, b in PLANES)
    return planes + layer.anchors * widths.channels


def _slices(number: int, recipe: LayerRecipe, before: int, widths: Widths) -> Iterator[blocks.Layer]:
    """The slices of a layer. Later ones go on with the block of the first one and, unless redefined, its priors."""
    scales = [blocks.Scale(s[0], s[1:], (recipe.predictor,) * 6, lambda _, shape: np.zeros(shape, np.int32))
              for s in recipe.scales if number > 0]  # fmt: skip
    networks = {0: (*recipe.widths, 3), 1: (3,)} if scales else None
    plain, stages, first = Known(), [Known() for _ in range(8)], None
    for index, cells in enumerate(np.array_split(_cells(recipe.anchors, recipe.spread, number), recipe.slices)):
        ordered = cells[morton_order(cells)]
        own: dict[str, Any] = {"networks": {}} if index else {"networks": networks, "scales": scales, "before": before}
        classes = np.arange(len(cells)) % 7 if widths.graded else None
        layer = blocks.make_layer(number, ordered, widths=replace(widths, graded=False), classes=classes, **own)
        sections: dict[int, bytes | None] = {}
        if len(cells):
            symbols, grades = _filled(layer.meant.attributes, recipe.attributes), layer.meant.classes
            if recipe.attributes.staged:
                written = _staged(symbols, grades, recipe, first, stages, widths)
                first = first or (symbols, grades)
            else:
                shift = index * recipe.redefined
                written = b"\0" + blocks.graded_part(grades) + _channels(
                    _by_class(symbols, grades), recipe.attributes, plain, shift)  # fmt: skip
            sections[blocks.ATTRIBUTE] = written
        if scales and not index:
            planes = [p for scale in scales for p in scale.planes().values()]
            sections[blocks.PLANE] = _planes(planes, recipe.planes)
        yield layer.with_sections(sections)


def _cells(count: int, spread: int, number: int) -> np.ndarray:
    """int32 [count, 3] in Morton order, `spread` voxels apart on a cube's corners."""
    side = max(1, round(count ** (1 / 3)) + 1)
    index = np.arange(count)
    cells = np.stack([index % side, index // side % side, index // side**2], axis=1) * spread
    cells[:, 2] += number << 18  # where no layer before has any
    if np.abs(cells).max(initial=0) > 1 << 20:
        raise ValueError("the voxels do not fit")
    return cells[morton_order(cells)].astype(np.int32)


def _by_class(symbols: np.ndarray, grades: np.ndarray) -> list[np.ndarray]:
    """The channels, each in its step classes if there are any."""
    return [channel[grades == c] for channel in symbols for c in range(7)] if grades.size else list(symbols)


def _staged(
    symbols: np.ndarray,
    grades: np.ndarray,
    recipe: LayerRecipe,
    first: tuple[np.ndarray, np.ndarray] | None,
    known: Sequence[Known],
    widths: Widths,
) -> bytes:
    """Form 1, or form 2 behind the slice with the attributes and step classes `first`."""
    terms = {c: [(j, 0) for j in range(min(c, recipe.terms))] for c in range(1, widths.predicted)}
    splits = {i: (3, 2, 2) for i in range(widths.slots)}
    classes = (recipe.attributes.classes,) * (6 if widths.graded else 5)
    of, of_grades = first or (None, NO_CLASSES)
    return blocks.predicted_attributes(
        symbols, terms, splits, classes, widths=widths, grades=grades, known=known, of=of, of_grades=of_grades
    )


def _planes(planes: Sequence[np.ndarray], coded: Coded) -> bytes:
    if coded.staged:
        return blocks.staged_planes(planes, [coded.classes] * max(0, (len(planes[0]) - 1).bit_length() - 1))
    return b"\0" + _channels([c.ravel() for p in planes for c in _filled(p, coded)], coded)


def _filled(symbols: np.ndarray, coded: Coded) -> np.ndarray:
    """With one symbol in each channel that is not like the others, if the priors are to be of that kind."""
    symbols = symbols.copy()
    if coded.prior == "exceptions" and symbols.size:
        symbols.reshape(len(symbols), -1)[:, 0] = 1 << 20
    return symbols


def _channels(channels: Sequence[np.ndarray], coded: Coded, known: Known | None = None, shift: int = 0) -> bytes:
    """shift: makes the priors differ from those of other slices."""
    section = blocks.Channels(known)
    for i, channel in enumerate(channels):
        number = shift + (i if coded.own else 0)
        section.add(channel, _prior(coded, number, int(channel[-1])) if channel.size else None)
    return section.done()


def _prior(coded: Coded, i: int, symbol: int) -> Prior | None:
    """One under which `symbol` costs next to nothing; `i` makes it differ from others."""
    place = i % 64
    n = max(place + 2, coded.window)
    window, normal = Window(symbol - place, n), Normal(256 * place, -640)
    if coded.prior == "gauss":
        return Gauss(window, normal, 1)
    if coded.prior == "mixture":
        return Mixture(window, normal, normal, 128, 1)
    if coded.prior == "hist":
        return Hist(window, 8, 1, False, 0, 0, (np.arange(n) == place).astype(np.int64))
    if coded.prior == "scaled":
        return Gauss(Window(symbol - (place << 12), max(2, min(n, 1 << 11)), 12), normal, 1)
    return None


# -- changes -----------------------------------------------------------------------------------------------------------


def changed(rng: random.Random, recipe: Recipe) -> Recipe:
    """With one to three choices made otherwise."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        layers = list(recipe.layers)
        if len(layers) < 3 and rng.random() < 0.1:
            layers.append(replace(rng.choice(layers)))
        elif len(layers) > 1 and rng.random() < 0.05:
            layers.pop()
        else:
            at = rng.randrange(len(layers))
            layers[at] = _changed_layer(rng, layers[at])
        recipe = replace(recipe, layers=tuple(layers))
        if rng.random() < 0.15:
            recipe = _changed_widths(rng, recipe)
    return recipe


def _changed_widths(rng: random.Random, recipe: Recipe) -> Recipe:
    what = rng.choice(("feature", "slots", "graded"))
    choices: dict[str, Callable[[], Any]] = {
        "feature": lambda: rng.choice((1, 2, 32, 64)),
        "slots": lambda: rng.choice((1, 4, 10, 16)),
        "graded": lambda: not recipe.graded,
    }
    return replace(recipe, **{what: choices[what]()})


def _changed_layer(rng: random.Random, layer: LayerRecipe) -> LayerRecipe:
    what = rng.choice(
        (
            "anchors",
            "spread",
            "attributes",
            "terms",
            "scales",
            "scales",
            "predictor",
            "planes",
            "widths",
            "slices",
            "redefined",
        )  # fmt: skip
    )
    if what in ("attributes", "planes"):
        return replace(layer, **{what: _changed_coded(rng, getattr(layer, what))})
    if what == "scales":
        return replace(layer, scales=_changed_scales(rng, layer.scales))
    choices: dict[str, Callable[[], Any]] = {
        "anchors": lambda: _scaled(rng, layer.anchors, 1 << 16),
        "spread": lambda: _scaled(rng, layer.spread, 1 << 19),
        "terms": lambda: rng.choice((0, 1, 8, 37)),
        "predictor": lambda: rng.randrange(6),
        "widths": lambda: tuple(rng.choice((1, 16, 64, 1024)) for _ in range(rng.randrange(4))),
        "slices": lambda: _scaled(rng, layer.slices, MOST_SLICES),
        "redefined": lambda: not layer.redefined,
    }
    return replace(layer, **{what: choices[what]()})


def _changed_coded(rng: random.Random, coded: Coded) -> Coded:
    what = rng.choice(("prior", "window", "own", "staged", "classes"))
    choices: dict[str, Callable[[], Any]] = {
        "prior": lambda: rng.choice(PRIORS),
        "window": lambda: _scaled(rng, coded.window, 1 << 14),
        "own": lambda: not coded.own,
        "staged": lambda: not coded.staged,
        "classes": lambda: rng.randint(1, 8),
    }
    return replace(coded, **{what: choices[what]()})


def _changed_scales(rng: random.Random, scales: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
    if not scales or (len(scales) < 8 and rng.random() < 0.2):
        channels = scales[0][0] if scales else rng.choice((1, 2, 8, 32))
        return (*scales, (channels, *(rng.choice((1, 2, 16, 64, 256, 4096)) for _ in range(4))))
    rows = [list(scale) for scale in scales]
    if rng.random() < 0.3:
        channels = _scaled(rng, rows[0][0], 256)
        return tuple((channels, *row[1:]) for row in rows)
    row = rng.choice(rows)
    at = rng.randint(1, 4)
    row[at] = _scaled(rng, row[at], 4096)
    return tuple(tuple(row) for row in rows)


def _scaled(rng: random.Random, value: int, most: int) -> int:
    """Near `value`, half or twice it, or anything up to `most`."""
    near = (value + 1, max(1, value - 1), max(1, value // 2), 2 * value, 1 << rng.randrange(most.bit_length()))
    return min(rng.choice(near), most)


# -- the search --------------------------------------------------------------------------------------------------------


def measured(recipe: Recipe, of_memory: bool) -> Found | None:
    """What the file of a recipe costs; None if there is none within the limits."""
    try:
        data = build(recipe)
    except (Pd4Error, ValueError, IndexError, KeyError, MemoryError):
        return None
    if len(data) > LARGEST:
        return None
    try:
        start = time.process_time()
        decode(data)
        seconds = time.process_time() - start
    except DecodeError:
        return None
    memory, bound = (peak_memory(data), memory_bound(data)) if of_memory else (0, 0)
    (once, per_byte), cost = (MEMORY, memory) if of_memory else (SECONDS, seconds)
    return Found(cost / (once + per_byte * len(data)), seconds, memory, bound, data, recipe)


def search(
    seed: int, seconds: float, of_memory: bool, keep: int = 10, report: Callable[[str], None] = print
) -> list[Found]:
    """The `keep` files that cost most, found in so many seconds. seconds of wall time; a run of another length finds
    others."""
    rng, end = random.Random(seed), time.monotonic() + seconds
    best: list[Found] = []
    tried = legal = 0
    while time.monotonic() < end:
        parent = rng.choice(best).recipe if best and rng.random() < 0.9 else Recipe()
        recipe = changed(rng, parent)
        tried += 1
        if any(recipe == found.recipe for found in best):
            continue
        found = measured(recipe, of_memory)
        if found is None:
            continue
        legal += 1
        if len(best) < keep or found > best[-1]:
            best = sorted([*best, found], reverse=True)[:keep]
            if found is best[0]:
                report(f"{tried} tried, {legal} legal: {found.row()}")
    return best
