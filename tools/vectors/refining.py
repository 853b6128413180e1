"""Vectors of low bits: slices of coarse attributes, and slices that refine them, good ones and bad ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.priors import CLASS_STEPS, MORE_ENTRIES, Hist, Prior, Window
from pd4dgs_codec.format.limits import MAX_CHUNKS
from pd4dgs_codec.format.quantise import MAX_SYMBOL
from pd4dgs_codec.scene import Widths

from .blocks import (
    CAMERA,
    LIMIT,
    LOW_BITS,
    LZMA,
    MALFORMED,
    File,
    Layer,
    Scale,
    Vector,
    bad,
    coded,
    gauss,
    good,
    make_file,
    make_layer,
    pattern,
    words,
)
from .faulty import PAYLOAD
from .slices import Slices, later
from .valid import line, ordered

KEY = 17  #: of the header: how many low bits
REFINES = 6  #: of a slice's parameters
NARROW = Widths(1, 1)  #: ten channels, so that the vectors are short


def cases() -> Iterator[Vector]:
    """All vectors about low bits."""
    for name, sentence, clauses, file in (*_good(), *_uncommon()):
        yield good(name, sentence, clauses, file)
    yield from (*_headers(), *_parameters(), *_names(), *_symbols(), *_sections())


def shown(layer: Layer, bits: int) -> Layer:
    """A slice whose attributes are meant to be multiples of 2^bits of what is written."""
    return replace(layer, meant=replace(layer.meant, attributes=layer.meant.attributes << bits))


def first(bits: int, number: int = 0, n: int = 5, z: int = 0, **what: Any) -> Layer:
    """The first slice of a layer, n anchors in a row."""
    return shown(make_layer(number, line(n, z), attributes=pattern(10, n, seed=z), widths=NARROW, **what), bits)


def moved(part: Layer, bits: int, seed: int = 0) -> np.ndarray:
    """The attributes of a slice with rests of every size."""
    s, most = part.meant.attributes, 1 << bits - 1
    return _plus(s, pattern(*s.shape, low=-most, high=most, seed=40 + seed))


def _plus(s: np.ndarray, rest: np.ndarray) -> np.ndarray:
    return s + np.where(s < 0, -rest, rest)


def low_bits(bits: int, parts: Sequence[Layer], fine: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The channels of section 7."""
    s, q = np.concatenate([part.meant.attributes for part in parts], axis=1), np.concatenate(fine, axis=1)
    rest = np.where(s < 0, s - q, q - s)
    k = s >> bits
    odd, even = k & 1 == 1, (k & 1 == 0) & (k != 0)
    return [row[chosen] for row, *kinds in zip(rest, k == 0, odd, even, strict=True) for chosen in kinds]


def refining(
    bits: int,
    number: int,
    of: int,
    parts: Sequence[Layer],
    fine: Sequence[np.ndarray],
    priors: Mapping[int, Prior] | None = None,
) -> Layer:
    """A slice of layer `number` that brings the attributes `fine` of the slices `parts` of layer `of`."""
    widths = parts[0].meant.widths
    bare = later(number, (), widths=widths, classes=() if widths.graded else None)
    section = coded(low_bits(bits, parts, fine), priors)
    meta = {**bare.meta, REFINES: [of, len(parts)]}
    return replace(bare, meta=meta, sections={LOW_BITS: section}, brings=(of, fine))


def two_layers(bits: int = 1) -> File:
    """Two layers of one slice each, and their low bits."""
    zero, one = first(bits), first(bits, 1, 3, z=2, before=5)
    fine = moved(zero, bits), moved(one, bits, 1)
    return make_file(
        zero, one, refining(bits, 1, 0, [zero], fine[:1]), refining(bits, 1, 1, [one], fine[1:]), header={KEY: bits}
    )


def interleaved(bits: int = 2) -> list[Layer]:
    """Three slices of layer 0, whose rows stand among each other in Morton order."""
    slices = Slices()
    cells = (
        [[0, 0, 1], [6, 3, 0], [2, 2, 2]],
        [[-1, 5, 0], [3, -2, 7], [1, 1, 1], [0, 7, 0]],
        [[4, 4, 4], [-3, 0, 2]],
    )
    parts = list[Layer]()
    for number, own in enumerate(cells):
        k = pattern(10, len(own), seed=7 + number)
        make = later if number else make_layer
        parts.append(slices.add(make(0, ordered(own), attributes=k, widths=NARROW)))
    return [shown(part, bits) for part in parts]


def three_slices(*sizes: int, bits: int = 2) -> File:
    """Those slices, and refining ones that name so many of them."""
    parts, done, refined = interleaved(bits), 0, list[Layer]()
    for size in sizes:
        named = parts[done : done + size]
        refined.append(refining(bits, 0, 0, named, [moved(p, bits, done + i) for i, p in enumerate(named)]))
        done += size
    return make_file(*parts, *refined, header={KEY: bits})


def graded() -> File:
    """Slices with step classes whose attributes are predicted from coarse ones, in a header of every key."""
    slices, block = Slices(), ({5: [(0, 700), (3, -300)]}, {0: (3, 1, 0)}, (3, 4, 2, 1, 5, 2))
    parts = [
        slices.add(make_layer(0, line(9), attributes=pattern(68, 9), classes=[0, 6, 3, 1, 0, 2, 5, 4, 6]), block),
        slices.add(later(0, line(4, z=2), attributes=pattern(68, 4, seed=1), classes=[6, 0, 0, 1]), go_on=True),
    ]
    parts = [shown(part, 2) for part in parts]
    fine = [moved(part, 2, i) for i, part in enumerate(parts)]
    return make_file(*parts, refining(2, 0, 0, parts, fine), header={KEY: 2, 12: CAMERA})


def one_slice(k: np.ndarray, bits: int, rest: np.ndarray) -> File:
    """Layer 0 in one slice of coarse symbols `k` [10, n], and the rests of its rows."""
    zero = shown(make_layer(0, line(k.shape[1]), attributes=k.astype(np.int32), widths=NARROW), bits)
    bringing = refining(bits, 0, 0, [zero], [_plus(zero.meant.attributes, rest.astype(np.int32))])
    return make_file(zero, bringing, header={KEY: bits})


def _rows(*rows: Sequence[int]) -> np.ndarray:
    """[10, n] whose first channels are these, and 0."""
    values = np.zeros((10, len(rows[0])), np.int32)
    values[: len(rows)] = rows
    return values


Case = tuple[str, str, str, File]


def _good() -> Iterator[Case]:
    yield "valid/low-bits", "One low bit; layer 1 brings that of layer 0 and its own.", "11.6 3.6 6.2 6.4", two_layers()
    yield "valid/low-bits-2", "Two low bits.", "11.6", two_layers(2)
    yield (
        "valid/low-bits-slices",
        "Two low bits of three slices, named one by one; rows in another order than the layer's.",
        "11.6 12.2",
        three_slices(1, 1, 1),
    )
    yield "valid/low-bits-slices-named", "Three slices whose low bits come in two.", "11.6 12.2", three_slices(2, 1)
    what = "Two low bits under step classes, prediction and splits, in a header of all keys."
    yield "valid/low-bits-classes", what, "11.6 11.5 8.7 4", graded()
    top = MAX_SYMBOL >> 4
    k = _rows([top, -top, top, -top], [0, 0, 0, 0], [1, -1, 1, -1], [top - 1, 1 - top, 7, -7])
    rest = _rows([-8, -8, 0, 0], [8, -8, 1, -1], [8, 8, -8, -8], [8, 8, -8, 5])
    yield "valid/low-bits-4", "Four low bits, symbols and rests at their limits.", "11.6 14", one_slice(k, 4, rest)
    rest = _rows([-2, -1, 0, 1, 2, 0], [2, 2, 2, -2, -2, -2], [2, -2, 1, 2, -1, -2])
    k = _rows([0, 0, 0, 0, 0, 0], [1, -1, 0, 1, -1, 0], [2, -2, 3, -3, -4, 4])
    yield "valid/low-bits-rests", "Rests of both signs at coarse symbols of all.", "11.6", one_slice(k, 2, rest)


def _uncommon() -> Iterator[Case]:
    whole = two_layers(2)
    digest = {14: whole.fields()[14]}
    for count in (1, 2, 3):
        cut = replace(whole, chunks=whole.chunks[:count]).with_header(digest)
        what = f"The file ends after {count} of 4 slices, before all low bits are there."
        yield f"uncommon/low-bits-ended-after-{count}", what, "11.6 3.6 5.5", cut
    yield "uncommon/low-bits-some", "One of three slices is refined.", "11.6", three_slices(1)
    none = make_file(first(3), header={KEY: 3})
    yield "uncommon/low-bits-none", "Low bits, and no slice that brings them.", "11.6", none
    bare = make_layer(0, (), widths=NARROW)
    yield "uncommon/low-bits-no-anchors", "Low bits of no anchors.", "11.6 5.1", make_file(bare, header={KEY: 1})
    zero, empty = first(1), later(0, (), widths=NARROW)
    behind = shown(later(0, line(3, z=4), attributes=pattern(10, 3, seed=4), widths=NARROW), 1)
    two = first(1, 2, 2, z=9, before=8)
    fine = moved(zero, 1), moved(behind, 1, 1), moved(two, 1, 2)
    early = make_file(
        zero, refining(1, 0, 0, [zero], fine[:1]), behind, two, refining(1, 2, 2, [two], fine[2:]), header={KEY: 1}
    )
    what = "A slice with anchors behind a refining one of its layer; layer 2 above layer 0."
    yield "uncommon/low-bits-early", what, "11.6 12.2", early
    named = refining(1, 0, 0, [zero, empty, behind], [fine[0], empty.meant.attributes, fine[1]])
    among = make_file(zero, empty, behind, named, header={KEY: 1})
    yield "uncommon/low-bits-empty-slice", "One of the slices that are named has no anchors.", "11.6", among
    hist = Hist(Window(-2, 4), CLASS_STEPS[0], 3, False, 20, 2, np.array([1, 2, 3, 1]))
    priors = {0: hist, 1: gauss(0, 2), 3: gauss(-3, 2, shift=1), 6: hist}
    rest = _rows([2, -2, 0, 1, -1, 0], [2, -2, 1, 0, -1, 2], [-1, -2, 0, 2, 1, 1])
    k = _rows([0, 1, 0, -1, 0, 2], [0, 1, 0, -1, 0, 2], [0, 3, 0, -2, 0, 1])
    zero = shown(make_layer(0, line(6), attributes=k, widths=NARROW), 2)
    tables = make_file(zero, refining(2, 0, 0, [zero], [_plus(zero.meant.attributes, rest)], priors), header={KEY: 2})
    yield "uncommon/low-bits-priors", "A histogram, exceptions and a scaled prior of rests.", "11.6 8.1 8.3", tables
    what = "Tables of 2^10 entries and one per symbol in section 7."
    yield "uncommon/low-bits-entries-at-limit", what, "8.1 14 11.6", _wide(0)


def _wide(over: int) -> File:
    """Tables of as many entries as section 7 may define, or `over` more."""
    file = one_slice(_rows([0]), 1, _rows([1]))
    bringing = file.layer(1)
    assert bringing.brings is not None
    prior = gauss(-9, MORE_ENTRIES + 10 + over)
    wide = refining(1, 0, 0, [file.layer(0)], bringing.brings[1], dict.fromkeys(range(30), prior))
    return make_file(file.layer(0), wide, header={KEY: 1})


# -- faults ------------------------------------------------------------------------------------------------------------


def _headers() -> Iterator[Vector]:
    """Key 17."""
    file = make_file(first(1))
    for name, value, error in (("0", 0, MALFORMED), ("5", 5, LIMIT), ("real", 1.0, MALFORMED)):
        what = f"Header key {KEY} is {value!r}."
        yield bad(f"header-low-bits-{name}", what, "5.1", error, file.with_header({KEY: value}))
    packed = make_file(make_layer(mode=LZMA), header={2: LZMA, KEY: 1})
    yield bad("header-low-bits-lzma", "Low bits in mode lzma.", "5.1", MALFORMED, packed)
    zero, one = (make_layer(number, line(2, z=number), widths=NARROW, before=2 * number) for number in (0, 1))
    bringing = refining(1, 1, 0, [zero], [zero.meant.attributes])
    refined = make_file(zero, one, bringing)
    yield bad("low-bits-without-header-key", "A refining slice without key 17.", "11.6", MALFORMED, refined, chunk=2)


def _parameters() -> Iterator[Vector]:
    """Key 6, and what stands beside it."""
    file = two_layers()
    bringing = file.layer(2)

    def of(name: str, error: str, what: str, payload: bytes) -> Vector:
        return bad(f"low-bits-{name}", what, "6.2", error, file.with_payload(2, payload), chunk=2)

    def named(value: object) -> Callable[[dict], dict]:
        return lambda m: {**m, REFINES: value}

    values: tuple[tuple[str, object, str], ...] = (
        ("layer-above", [2, 1], LIMIT),
        ("layer-real", [0.0, 1], MALFORMED),
        ("slices-0", [0, 0], MALFORMED),
        ("slices-1025", [0, MAX_CHUNKS + 1], LIMIT),
        ("slices-boolean", [0, True], MALFORMED),
        ("list-of-one", [0], MALFORMED),
        ("list-of-three", [0, 1, 0], MALFORMED),
        ("list-integer", 1, MALFORMED),
    )
    for name, value, error in values:
        yield of(name, error, f"Key 6 is {value!r}.", bringing.payload(named(value)))
    without = bringing.payload(lambda m: {k: v for k, v in m.items() if k != REFINES})
    yield of("key-missing", MALFORMED, "Section 7 without key 6.", without)
    none = bringing.with_sections({LOW_BITS: None}).payload()
    yield of("section-missing", MALFORMED, "Key 6 without section 7.", none)
    other = bringing.with_sections({1: b"\0"}).payload()
    yield of("section-besides", MALFORMED, "Key 6 with a section of masks.", other)
    rows = later(1, line(1, z=8), widths=NARROW)
    both = replace(rows, meta={**rows.meta, REFINES: [0, 1]}).with_sections({LOW_BITS: bringing.sections[LOW_BITS]})
    yield of("with-rows", MALFORMED, "A refining slice with an anchor of its own.", both.payload())
    zero = file.layer(0)
    one = make_layer(1, (), before=5, widths=NARROW)
    head = replace(one, meta={**one.meta, REFINES: [0, 1]}).with_sections({LOW_BITS: bringing.sections[LOW_BITS]})
    what = "The first slice of a layer refines another."
    yield bad("low-bits-in-first-slice", what, "6.2", MALFORMED, make_file(zero, head, header={KEY: 1}), chunk=1)


def _names() -> Iterator[Vector]:
    """Slices that cannot be named."""
    bits = 2
    parts = interleaved(bits)
    fine = [moved(part, bits, i) for i, part in enumerate(parts)]

    def of(name: str, what: str, *layers: Layer, chunk: int) -> Vector:
        return bad(f"low-bits-{name}", what, "11.6", MALFORMED, make_file(*layers, header={KEY: bits}), chunk=chunk)

    def saying(layer: Layer, value: Sequence[int]) -> Layer:
        return replace(layer, meta={**layer.meta, REFINES: list(value)})

    one = first(bits, 1, 2, z=30, before=9)
    four = saying(refining(bits, 1, 0, parts, fine), (0, 4))
    yield of("slices-not-there", "Four slices are named, three are there.", *parts, one, four, chunk=4)
    early = saying(refining(bits, 0, 0, parts[:2], fine[:2]), (0, 3))
    what = "A slice is named before it has come."
    yield of("slices-not-yet-there", what, *parts[:2], early, parts[2], chunk=2)
    whole = [replace(p, meant=replace(p.meant, attributes=q)) for p, q in zip(parts, fine, strict=True)]
    twice = [refining(bits, 0, 0, layers[:1], fine[:1]) for layers in (parts, whole)]
    yield of("slices-twice", "The one slice of layer 0 is named twice.", parts[0], *twice, chunk=2)
    above = [refining(bits, 1, 0, parts, fine), refining(bits, 1, 0, whole[2:], [moved(whole[2], bits, 5)])]
    yield of("slices-named-again", "Layer 1 names the slices of layer 0 twice.", *parts, one, *above, chunk=5)
    two = first(bits, 2, 2, z=9, before=3)
    missing = saying(refining(bits, 2, 2, [two], [moved(two, bits)]), (1, 1))
    yield of("layer-missing", "The layer that is named is not there.", parts[0], two, missing, chunk=2)
    itself = saying(refining(bits, 0, 0, parts[1:2], fine[1:2]), (0, 2))
    early = refining(bits, 0, 0, parts[:1], fine[:1])
    what = "A refining slice is named with the slice behind it."
    yield of("of-refining-slice", what, parts[0], early, parts[1], itself, chunk=3)
    passed = refining(bits, 0, 0, parts[1:2], fine[1:2])
    what = "The slice that is named is a refining one; low bits are those of the slice behind it."
    yield of("behind-refining-slice", what, parts[0], early, parts[1], passed, chunk=3)
    empty = later(0, (), widths=NARROW)
    nothing = replace(saying(empty, (0, 1)), sections={LOW_BITS: bytes(4)})
    what = "Only a slice without anchors is named."
    yield of("of-no-rows", what, parts[0], empty, refining(bits, 0, 0, parts[:1], fine[:1]), nothing, chunk=3)


def _symbols() -> Iterator[Vector]:
    """Values out of their ranges."""
    for name, k, rest in (
        ("rest-over-limit", 1, 3),
        ("rest-under-limit", 1, -3),
        ("rest-of-zero-over-limit", 0, 3),
        ("rest-of-zero-under-limit", 0, -3),
    ):
        file = one_slice(_rows([k, 0]), 2, _rows([rest, 1]))
        yield bad(f"low-bits-{name}", f"A rest of {rest} with two low bits.", "11.6", MALFORMED, file, chunk=1)
    for sign, name in ((1, "over"), (-1, "under")):
        centre = {16: [-8 * sign] + [0] * 9}  # with which it lies within the range of clause 11.5
        k, rest = _rows([sign * ((MAX_SYMBOL >> 1) + 1)]), _rows([0])
        part, fine = _graded(k, rest, 1, 0)
        coarse = make_file(part, header={KEY: 1, **centre})
        what = f"A coarse symbol {name} its limit."
        yield bad(f"low-bits-coarse-{name}-limit", what, "11.6", MALFORMED, coarse, chunk=0)
        part, fine = _graded(_rows([sign * (MAX_SYMBOL >> 1)]), _rows([1]), 1, 0)
        refined = make_file(part, refining(1, 0, 0, [part], [fine]), header={KEY: 1, **centre})
        what = f"A refined symbol {name} its limit."
        yield bad(f"low-bits-refined-{name}-limit", what, "11.6", MALFORMED, refined, chunk=1)
    part, fine = _graded(_rows([MAX_SYMBOL >> 8]), _rows([1]), 2, 6)
    wide = make_file(part, refining(2, 0, 0, [part], [fine]), header={KEY: 2, 16: [0] * 10})
    what = "Under its step class a refined symbol lies over 2^23 steps from 0."
    yield bad("low-bits-refined-over-steps", what, "11.5 11.6", MALFORMED, wide, chunk=1)
    infinite = one_slice(_rows([0]), 2, _rows([2])).with_header({4: [2.0**127, 1.0, 1.0]})
    what = "A refined value is not finite."
    yield bad("low-bits-not-finite", what, "11.5 11.6", MALFORMED, infinite, chunk=1)
    yield _many()


def _graded(k: np.ndarray, rest: np.ndarray, bits: int, step_class: int) -> tuple[Layer, np.ndarray]:
    """A first slice of one anchor with this step class, and its refined attributes."""
    part = shown(make_layer(0, line(1), attributes=k, widths=NARROW, classes=[step_class]), bits)
    return part, _plus(part.meant.attributes, rest)


def _many() -> Vector:
    """As many symbols as a file may declare, but for those of a refining slice."""
    n, widths = 8000, Widths(64, 16)
    zero = shown(make_layer(0, line(n), widths=widths), 1)
    flat = Scale(1, (1700, 1700, 1, 1), fill=lambda _, shape: np.zeros(shape, np.int32))
    one = make_layer(1, (), before=n, scales=[flat], widths=widths)
    file = make_file(zero, one, refining(1, 1, 0, [zero], [zero.meant.attributes]), header={KEY: 1})
    what = "More symbols than a file may declare, those of a refining slice counted."
    return bad("low-bits-symbols-over-limit", what, "6.5 14 11.6", LIMIT, file, chunk=2)


def _sections() -> Iterator[Vector]:
    """Section 7 that does not hold what it should."""
    file = two_layers()
    bringing = file.layer(2)
    section = bringing.sections[LOW_BITS]

    def of(name: str, clauses: str, what: str, data: bytes, error: str = MALFORMED) -> Vector:
        payload = bringing.with_sections({LOW_BITS: data}).payload()
        return bad(f"low-bits-{name}", what, clauses, error, file.with_payload(2, payload), chunk=2)

    same = one_slice(_rows([1]), 1, _rows([0]))
    left = same.layer(1).with_sections({LOW_BITS: same.layer(1).sections[LOW_BITS] + words(5)}).payload()
    what = "A word behind the last symbol of section 7."
    yield bad("low-bits-left", what, "7.7 11.6", MALFORMED, same.with_payload(1, left), chunk=1)
    yield of("cut", "15 11.6", "Section 7 ends in its parameters.", section[:3])
    yield of("byte-missing", "7.7 11.6", "Section 7 lacks its last byte.", section[:-1])
    parts, known = interleaved(), list[tuple[bytes, bytes]]()
    fine = [moved(part, 2, i) for i, part in enumerate(parts)]
    slices = [refining(2, 0, 0, [part], [q]) for part, q in zip(parts[:2], fine, strict=False)]
    own = [low_bits(2, [part], [q]) for part, q in zip(parts, fine, strict=True)]
    slices = [x.with_sections({LOW_BITS: coded(c, known=known)}) for x, c in zip(slices, own, strict=False)]
    both = make_file(*parts, *slices, header={KEY: 2})
    what = "The second refining slice goes on with a prior of the first."
    yield bad("low-bits-prior-goes-on", what, "8.1 8 11.6", MALFORMED, both, chunk=4)
    what = "Section 7 defines tables of an entry more than 2^10 and one per symbol."
    yield bad("low-bits-entries-over-limit", what, "14 8.1 11.6", LIMIT, _wide(1), chunk=1)
    end = file.start(3) + PAYLOAD + 3
    what = "The file ends in a refining slice."
    yield bad("low-bits-file-cut", what, "3.2 12.3 15", "Truncated", file, chunk=3, size=end)
