"""Vectors of layers that come in slices, good ones and bad ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pd4dgs_codec.entropy.priors import (
    CLASS_STEPS,
    FIRST_REUSE,
    FREE_ENTRIES,
    MAX_WINDOW,
    MORE_ENTRIES,
    Hist,
    Window,
)
from pd4dgs_codec.format.layer_meta import FREE_ROWS, ROWS_PER_BYTE
from pd4dgs_codec.format.limits import MAX_CHUNKS
from pd4dgs_codec.format.symbols import LayerSymbols

from .blocks import (
    ATTRIBUTE,
    FEATURE,
    FLOAT32,
    LIMIT,
    LZMA,
    MALFORMED,
    MASKS,
    ONE_CLASS,
    PLANE,
    POSITIONS,
    WEIGHTS,
    File,
    Known,
    Layer,
    Scale,
    Splits,
    Terms,
    Vector,
    ancillary,
    bad,
    coded,
    gauss,
    good,
    graded_part,
    make_file,
    make_layer,
    pattern,
    plain_attributes,
    plain_planes,
    positions,
    predicted_attributes,
    varint,
)
from .faulty import FLAGS, PAYLOAD, SCENE_ID
from .valid import line, ordered

MORE, NUMBER = 2, 64  # flags: bit 1, and the slice of number 1


def cases() -> Iterator[Vector]:
    """All vectors about slices."""
    for name, sentence, clauses, file in _good():
        yield good(name, sentence, clauses, file)
    yield from (*_frames(), *_payloads(), *_limits())


@dataclass
class Slices:
    """Writes the slices of a layer in turn, each with what those before defined."""

    positions: Known = field(default_factory=list)
    masks: Known = field(default_factory=list)
    plain: Known = field(default_factory=list)
    stages: list[Known] = field(default_factory=lambda: [[] for _ in range(8)])
    block: tuple[Terms, Splits, Sequence[int]] = ({}, {}, ONE_CLASS)
    of: LayerSymbols | None = None  #: the slice that the block stands in

    def add(self, layer: Layer, block: tuple[Terms, Splits, Sequence[int]] | None = None, go_on: bool = False) -> Layer:
        """The slice as it is written: in form 1 with this block, in form 2 with the one before, else in form 0."""
        m = layer.meant
        sections: dict[int, bytes | None] = {}
        if m.mask_increase.size or m.mask_own.size:
            sections[MASKS] = coded([m.mask_increase, m.mask_own], known=self.masks)
        if m.mask_own.size:
            sections[POSITIONS] = positions(m.anchor_q, self.positions)
            if block is not None:
                self.block, self.of = block, m
                sections[ATTRIBUTE] = predicted_attributes(m.attributes, *block, known=self.stages, grades=m.classes)
            elif go_on:
                assert self.of is not None
                sections[ATTRIBUTE] = predicted_attributes(
                    m.attributes,
                    *self.block,
                    known=self.stages,
                    grades=m.classes,
                    of=self.of.attributes,
                    of_grades=self.of.classes,
                )
            else:
                sections[ATTRIBUTE] = plain_attributes(m.attributes, known=self.plain, classes=m.classes)
        return layer.with_sections(sections)


def later(number: int, cells: Sequence[Sequence[int]], **what: Any) -> Layer:
    """A slice behind a layer's first."""
    return make_layer(number, ordered(cells), networks={}, **what)


def three_slices(**header: object) -> File:
    """Layer 0 in three slices, then layer 1 in two; attributes and codes that differ."""
    zero, one = Slices(), Slices()
    return make_file(
        zero.add(make_layer(0, line(4), codes=[3, 77, 200, 9], attributes=pattern(68, 4))),
        zero.add(later(0, line(3, z=2), codes=[5, 77, 5], attributes=pattern(68, 3, seed=1))),
        zero.add(later(0, line(4, z=5), codes=[80, 7, 3, 255], attributes=pattern(68, 4, seed=2))),
        one.add(make_layer(1, line(1, z=9), before=11, rises=[0, 1, 5, 0, 7, 0, 0, 0, 0, 9, 0], scales=[Scale()])),
        one.add(later(1, line(2, z=12), attributes=pattern(68, 2, seed=4))),
        header=dict(header),
    )


Case = tuple[str, str, str, File]


def _good() -> Iterator[Case]:
    whole = three_slices()
    yield "valid/slices", "Layer 0 in three slices, layer 1 in two.", "3.6 8 12.2 12.4", whole
    yield (
        "valid/slices-continued",
        "Attributes that go on with a block, and with a second one.",
        "8.5 8.7 8.9",
        _continued(),
    )
    graded, block = Slices(), ({5: [(0, 700), (3, -300)]}, {0: (3, 1, 0)}, (3, 4, 2, 1, 5, 2))
    classes = (
        graded.add(make_layer(0, line(9), attributes=pattern(68, 9), classes=[0, 6, 3, 1, 0, 2, 5, 4, 6]), block),
        graded.add(later(0, line(4, z=2), attributes=pattern(68, 4, seed=1), classes=[6, 0, 0, 1]), go_on=True),
        graded.add(later(0, line(3, z=4), attributes=pattern(68, 3, seed=2), classes=[2, 2, 5])),
        graded.add(later(0, line(3, z=-4), attributes=pattern(68, 3, seed=3), classes=[0, 1, 0])),
    )
    yield "valid/slices-classes", "Slices with step classes, in all forms.", "3.6 8.5 8.7 11.2", make_file(*classes)
    yield "uncommon/slices-classes-wide", "Step classes under a wide table in slice 1.", "8.5 14 8", _of_classes(False)
    apart = Slices()
    mixed = (
        apart.add(make_layer(0, ordered([[0, 0, 1], [6, 3, 0]]), codes=[40, 50], attributes=pattern(68, 2))),
        apart.add(later(0, [[-1, 5, 0], [3, -2, 7], [1, 1, 1]], codes=[60, 70, 80], attributes=pattern(68, 3, seed=1))),
        make_layer(1, (), before=5, rises=[1, 2, 3, 4, 5]),
    )
    what = "Slices among each other in Morton order, whose codes change with the layer's minimum; rises in that order."
    yield "valid/slices-interleaved", what, "12.2 11.1", make_file(*mixed)
    zero, one = Slices(), Slices()
    bare = (
        zero.add(make_layer(0, ())),
        zero.add(later(0, line(2), attributes=pattern(68, 2))),
        one.add(make_layer(1, (), before=2, scales=[Scale()])),
        one.add(later(1, line(2, z=3))),
    )
    yield "valid/slices-first-without-anchors", "First slices without anchors.", "3.6 6.4", make_file(*bare)
    yield "uncommon/slices-empty", "A later slice without anchors.", "3.6 6.2 6.4", make_file(*bare[:2], later(0, ()))
    floats = make_layer(1, line(2, z=3), before=1, scales=[Scale()], raw=True)
    raw = make_file(make_layer(), floats, later(1, line(1, z=4)), header={3: FLOAT32})
    yield "uncommon/slices-floats", "Layer 1 in two slices, planes and weights as float32 values.", "3.6 9.2", raw
    classes = np.array([1, 2, 3, 3, 3, 2, 1])
    hist = Hist(Window(-3, 7), CLASS_STEPS[0], 3, False, 20, 2, classes)
    parts = make_layer(0, line(3)), later(0, line(2, z=3))
    spiky, lists = list[Layer](), Known()
    for seed, part in enumerate(parts):
        k = pattern(68, len(part.meant.mask_own), seed=seed)
        part = replace(part, meant=replace(part.meant, attributes=k))
        spiky.append(part.with_sections({ATTRIBUTE: plain_attributes(k, {0: hist}, lists)}))
    yield "valid/slices-histogram", "A histogram that slice 1 takes from slice 0.", "8 8.4", make_file(*spiky)
    digest = {14: whole.fields()[14]}
    for count in (1, 2, 4):
        cut = replace(whole, chunks=whole.chunks[:count]).with_header(digest)
        yield f"uncommon/slices-ended-after-{count}", "The file ends before its last slice.", "3.6 3.3 5.5", cut
    between = replace(whole, chunks=(*whole.chunks[:2], ancillary(9, b"x"), *whole.chunks[2:]))
    yield "uncommon/slices-around-ancillary", "An ancillary chunk between slices.", "3.4 3.6", between
    many = make_file(make_layer(), *[later(0, ()) for _ in range(MAX_CHUNKS - 2)], later(0, line(2)))
    yield "uncommon/slices-1024", "A layer of 1024 slices.", "3.6 5.2 14", many
    what = "Tables of 2^18 entries in a slice, of 2^10 and one per symbol in the next."
    yield "uncommon/slices-entries-at-limit", what, "8.1 14", _wide(0)


BLOCK: tuple[Terms, Splits, Sequence[int]] = (
    {3: [(0, 512), (2, -700)], 20: [(7, 1024)], 37: [(0, 90), (36, 300)]},
    {0: (3, 1, -1), 4: (1, 0, 0), 9: (2, 0, 2)},
    (2, 3, 4, 8, 5),
)


def _continued() -> File:
    """Four slices under one block and two under another. Among the rows of the second slice are some whose residuals
    are larger than all of the first slice together, and in the first slice some channels are 0."""
    slices = Slices()
    k = pattern(68, 24, low=-9, high=9)
    k[[5, 11, 25]] = 0
    loud, quiet = pattern(68, 9, low=-40, high=40, seed=5), pattern(68, 5, low=0, high=1, seed=6)
    other: tuple[Terms, Splits, Sequence[int]] = ({1: [(0, -1024)]}, {2: (3, 0, 0)}, (3, 1, 2, 1, 2))
    return make_file(
        slices.add(make_layer(0, line(24), attributes=k), BLOCK),
        slices.add(later(0, line(9, z=2), attributes=loud), go_on=True),
        slices.add(later(0, line(5, z=3), attributes=quiet), go_on=True),
        slices.add(later(0, line(4, z=4), attributes=pattern(68, 4, seed=8))),
        slices.add(later(0, line(1, z=5), attributes=loud[:, 3:4]), go_on=True),
        slices.add(later(0, line(7, z=6), attributes=pattern(68, 7, low=-5, high=5, seed=9)), other),
        slices.add(later(0, line(6, z=7), attributes=k[:, 4:10]), go_on=True),
    )


def _of_classes(go_on: bool) -> File:
    """Two slices with step classes; those of the second one under the prior of the first one's, or under one of its own
    of more entries than a section may define that goes on."""
    known, grades = Known(), ([0, 3, 6], [6, 0, 3])
    coded([grades[0]], known=known)
    wide = {} if go_on else {0: gauss(0, 2 * MORE_ENTRIES)}
    part = coded([grades[1]], wide, known if go_on else None)
    first = make_layer(0, line(3), attributes=pattern(68, 3), classes=grades[0])
    second = later(0, line(3, z=2), attributes=pattern(68, 3, seed=1), classes=grades[1])
    form, own = b"\0", graded_part(second.meant.classes)
    rest = second.sections[ATTRIBUTE][len(form + own) :]
    return make_file(first, second.with_sections({ATTRIBUTE: form + varint(len(part)) + part + rest}))


def _wide(over: int) -> File:
    """Windows of 2^18 entries in a first slice; in a second one of as many as it may define, or `over` more."""
    layers, known = list[Layer](), list[Any]()
    for number, (count, n) in enumerate(((FREE_ENTRIES // MAX_WINDOW, MAX_WINDOW), (1, MORE_ENTRIES + 68 + over))):
        k = np.full((68, 1), number, np.int32)
        priors = {c: gauss(min(c, count - 1) - 20, n) for c in range(68)}
        layer = make_layer(0, line(1)) if number == 0 else later(0, line(1, z=4))
        layer = replace(layer, meant=replace(layer.meant, attributes=k))
        layers.append(layer.with_sections({ATTRIBUTE: plain_attributes(k, priors, known)}))
    return make_file(*layers)


def _frames() -> Iterator[Vector]:
    """Slices that are not where they belong."""
    zero = Slices()
    alike = [zero.add(make_layer(0, line(2)))]
    alike += [zero.add(later(0, line(2, z=z))) for z in (4, 5, 6)]
    file = make_file(*alike)
    sizes = {len(c.payload) for c in file.chunks[1:]}
    assert len(sizes) == 1, "slices of one length, so that the chunk list shows nothing"

    def of(name: str, what: str, order: Sequence[int], at: int) -> Vector:
        """The file's slices in another order; digest and scene id are those of the encode."""
        other = replace(file, chunks=tuple(file.chunks[i] for i in order)).with_header({14: file.fields()[14]})
        return bad(f"slices-{name}", what, "3.6", MALFORMED, other, chunk=at, at=FLAGS)

    yield of("swapped", "Slices 1 and 2 have changed places.", (0, 2, 1, 3), 1)
    yield of("left-out", "Slice 2 is left out.", (0, 1, 3), 2)
    first, last = file.chunks[0], file.chunks[-1]
    numbered = file.with_chunk(3, flags=last.flags + (1 << 9))
    yield bad("slices-number-upper-bit", "Slice 3 says 11.", "3.6", MALFORMED, numbered, chunk=3, at=FLAGS)
    silent = file.with_chunk(0, flags=first.flags & ~MORE)
    what = "Slice 0 does not say that slice 1 follows."
    yield bad("slices-more-missing", what, "3.6", MALFORMED, silent, chunk=0, at=FLAGS)

    whole = three_slices()
    single = make_file(make_layer(), *[later(0, ())] * 2, make_layer(1, line(1, z=5), before=1))
    digest = {14: single.fields()[14]}
    cut = replace(single, chunks=(*single.chunks[:2], single.chunks[3])).with_header(digest)
    what = "Layer 1 follows layer 0 without its last slice, which has no anchors."
    yield bad("slices-layer-not-whole", what, "3.6", MALFORMED, cut, chunk=1, at=FLAGS)
    twice = replace(single, chunks=(*single.chunks[:2], *single.chunks[1:])).with_header(digest)
    yield bad("slices-doubled", "Slice 1 comes twice.", "3.6", MALFORMED, twice, chunk=2, at=FLAGS)
    single = make_file(make_layer(), make_layer(1, line(1, z=5), before=1))
    what = "A layer of one slice says that more follow, and the next layer does."
    yield bad("slices-more-untrue", what, "3.6", MALFORMED, single.with_chunk(0, flags=MORE), chunk=0, at=FLAGS)
    said = single.with_chunk(1, flags=NUMBER)
    yield bad("slices-layer-1-from-1", "Layer 1 begins with slice 1.", "3.6", MALFORMED, said, chunk=1, at=FLAGS)
    for name, flags in (("more", 1 | MORE), ("number", 1 | NUMBER)):
        chunks = (*whole.chunks[:1], replace(ancillary(9), flags=flags), *whole.chunks[1:])
        noted = replace(whole, chunks=chunks)
        what = f"An ancillary chunk with flags {flags}."
        yield bad(f"slices-ancillary-{name}", what, "3.2 2.3", MALFORMED, noted, chunk=1, at=FLAGS)
    alien = whole.with_chunk(2, scene_id=file.scene_id)
    yield bad(
        "slices-of-another-scene", "Slice 2 is from another scene.", "3.3", MALFORMED, alien, chunk=2, at=SCENE_ID
    )
    broken, at = whole.with_chunk(1, crc=1 << 7), PAYLOAD + len(whole.chunks[1].payload)
    yield bad("slices-crc", "The CRC-32 of slice 1.", "3.2", "ChecksumMismatch", broken, chunk=1, at=at)
    for chunk in (1, 4):
        size = whole.start(chunk) + PAYLOAD + 9
        what = f"The file ends in chunk {chunk}, a later slice."
        yield bad(f"slices-cut-{chunk}", what, "3.2 12.3 15", "Truncated", whole, chunk=chunk, size=size)
    packed = [make_layer(mode=LZMA), make_layer(0, line(1, z=3), networks={}, mode=LZMA)]
    what = "A layer in two slices in mode lzma."
    yield bad("slices-lzma", what, "5.2", MALFORMED, make_file(*packed, header={2: LZMA}))


def _payloads() -> Iterator[Vector]:
    """What a later slice may not hold, or not refer to."""
    slices = Slices()
    first = slices.add(make_layer(0, line(3), attributes=pattern(68, 3)))
    second = slices.add(later(0, line(3, z=2), attributes=pattern(68, 3, seed=1)))
    file = make_file(first, second)

    def of(name: str, clauses: str, error: str, what: str, payload: bytes) -> Vector:
        return bad(f"slices-{name}", what, clauses, error, file.with_payload(1, payload), chunk=1)

    for key, value in ((3, [0.5]), (4, [[1, 2, 2, 2, 2, 0, 0, 0, 0, 0, 0]]), (5, [[0, 10], [1, 70], [2, 30]])):
        what = f"A later slice with key {key}."
        yield of(f"later-key-{key}", "6.2", MALFORMED, what, second.payload(lambda m, k=key, v=value: {**m, k: v}))
    what = "A later slice with the networks of the first."
    yield of("later-networks", "6.2", MALFORMED, what, make_layer(0, line(3, z=2)).payload())
    what = "A later slice with planes."
    yield of("later-planes", "6.4", MALFORMED, what, second.with_sections({PLANE: plain_planes([[1]])}).payload())
    weights = {WEIGHTS: first.sections[WEIGHTS]}
    yield of("later-weights", "6.4", MALFORMED, "A later slice with weights.", second.with_sections(weights).payload())
    raised = second.with_sections({MASKS: coded([[0, 1, 0], second.meant.mask_own])})
    yield of("later-rises", "7.7 6.4", MALFORMED, "A later slice with rises.", raised.payload())
    many = second.payload(lambda m: {**m, 1: (1 << 24) - 2})
    yield of("later-rows-over-limit", "6.2 14", LIMIT, "More than 2^24 anchors in two slices.", many)
    twice = Slices()
    twice.add(make_layer(0, line(3), attributes=pattern(68, 3)))
    again = twice.add(later(0, [[7, 0, 0], [2, 0, 0], [9, 0, 0]], attributes=pattern(68, 3, seed=1)))
    yield of("voxel-twice", "12.1", MALFORMED, "A voxel of slice 0 again in slice 1.", again.payload())
    above = later(0, line(1, z=2), codes=[256])
    yield of("mask-code-256", "11.1", MALFORMED, "A mask code of 256 in a later slice.", above.payload())

    known: Known = []
    plain_attributes(first.meant.attributes, known=known)
    token = varint(2 * (FIRST_REUSE + len(known)))
    far = second.with_sections({ATTRIBUTE: b"\0" + token + second.sections[ATTRIBUTE][2:]})
    yield of("prior-before-first", "8.1 8", MALFORMED, "A prior before the first of slice 0.", far.payload())
    staged = predicted_attributes(second.meant.attributes, {}, {}, known=[list(known) for _ in range(8)])
    other = second.with_sections({ATTRIBUTE: staged})
    what = "Form 1 refers to priors of form 0."
    yield of("prior-of-another-form", "8.1 8", MALFORMED, what, other.payload())
    form = second.with_sections({ATTRIBUTE: b"\2" + bytes(7)})
    yield of("block-missing", "8.5", MALFORMED, "Form 2 behind a slice of form 0.", form.payload())

    what = "Step classes under the prior of those of slice 0."
    yield bad("slices-step-classes-go-on", what, "8.1 8.5", MALFORMED, _of_classes(True), chunk=1)
    block, one = Slices(), make_layer(0, line(5), attributes=pattern(68, 5))
    base = block.add(one, ({}, {}, ONE_CLASS))
    on = block.add(later(0, line(4, z=3), attributes=pattern(68, 4, seed=2)), go_on=True)
    alone = make_file(one.with_sections({ATTRIBUTE: b"\2" + bytes(7)}))
    yield bad("slices-block-in-first", "Form 2 in the first slice.", "8.5", MALFORMED, alone, chunk=0)
    upper = make_layer(1, line(4, z=7), before=5, attributes=on.meant.attributes)
    what = "Form 2 in layer 1, the block in layer 0."
    lone = make_file(base, upper.with_sections({ATTRIBUTE: on.sections[ATTRIBUTE]}))
    yield bad("slices-block-of-another-layer", what, "8.5 3.6", MALFORMED, lone, chunk=1)
    for name, clauses, section, what in (
        ("block-cut", "8.9 15 8.5", b"\2\0", "Form 2 ends among its lengths."),
        ("block-left", "7.7 8.5", on.sections[ATTRIBUTE] + bytes(4), "A word behind the last stage of form 2."),
    ):
        payload = on.with_sections({ATTRIBUTE: section}).payload()
        yield bad(f"slices-{name}", what, clauses, MALFORMED, make_file(base, on).with_payload(1, payload), chunk=1)
    unknown = on.with_sections({ATTRIBUTE: b"\3" + on.sections[ATTRIBUTE][1:]})
    what = "Form 3 of the attributes in a later slice."
    yield bad("slices-form-3", what, "8.5", FEATURE, make_file(base, on).with_payload(1, unknown.payload()), chunk=1)


def _limits() -> Iterator[Vector]:
    what = "Tables of an entry more than 2^10 and one per symbol in a second slice."
    yield bad("slices-entries-over-limit", what, "8.1 14", LIMIT, _wide(1), chunk=1)
    first = make_layer()
    least = FREE_ROWS + ROWS_PER_BYTE * len(first.payload())
    second = later(0, line(least, z=3))
    over = second.payload(lambda m: {**m, 1: least + ROWS_PER_BYTE * len(second.payload())})
    file = make_file(first, second).with_payload(1, over)
    yield bad("slices-rows-over-limit", "More anchors than both slices may declare.", "6.5 14", LIMIT, file, chunk=1)
