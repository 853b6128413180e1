"""Files that are a handful of choices, each of which some part of a decoder pays for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.priors import Gauss, Hist, Mixture, Normal, Prior, Window
from pd4dgs_codec.format.table import NO_CLASSES
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import DEFAULT_WIDTHS, Widths

from . import blocks
from .blocks import Known

PRIORS = ("const", "gauss", "mixture", "hist", "scaled", "exceptions")


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


def file_of(recipe: Recipe) -> blocks.File:
    """The file. Raises Pd4Error or ValueError where the parts of a recipe exclude each other."""
    widths = Widths(recipe.feature, recipe.slots, recipe.graded)
    slices, before = list[blocks.Layer](), 0
    for number, layer in enumerate(recipe.layers):
        slices += _slices(number, layer, before, widths)
        before += layer.anchors
    return blocks.make_file(*slices)


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
