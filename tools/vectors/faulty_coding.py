"""Vectors that break one rule each of how symbols are coded and put together: clauses 7 to 12."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from pd4dgs_codec.entropy.ans import MAX_COUNT, ans_encode
from pd4dgs_codec.entropy.priors import (
    FIRST_REUSE,
    K_MAX,
    MAX_SHIFT,
    MAX_WINDOW,
    MU8_MAX,
    SCALED,
    Hist,
    Prior,
    Window,
    top_limit,
    write_prior,
)
from pd4dgs_codec.entropy.varint import VARINT_MAX
from pd4dgs_codec.format.quantise import MAX_SYMBOL
from pd4dgs_codec.morton import MAX_VOXEL

from . import lzma2
from .blocks import (
    ANS,
    ATTRIBUTE,
    FEATURE,
    FLOAT32,
    FLOATS,
    LIMIT,
    LZMA,
    MALFORMED,
    MASKS,
    ONE_CLASS,
    PLANE,
    POSITIONS,
    SMALL,
    SYMBOLS,
    Layer,
    Scale,
    Vector,
    attribute_stages,
    bad,
    coded,
    constant_networks,
    gauss,
    graded_part,
    in_layer,
    lzma_floats,
    lzma_symbols,
    make_file,
    make_layer,
    pattern,
    plain_attributes,
    plain_planes,
    predicted_attributes,
    prediction_block,
    staged,
    staged_planes,
    varint,
    words,
    zigzag,
)
from .valid import LARGEST, line, tables_at_limit

CODES = [5, 9, 7]
#: Name, clauses with the broken one first, error, the section, what is wrong.
Row = tuple[str, str, str, bytes, str]


def cases() -> Iterator[Vector]:
    """All of them, by clause."""
    parts = _varints, _priors, _histograms, _streams, _exceptions, _prediction, _grades, _staged_planes, _lzma, _floats
    for part in (*parts, _positions, _ranges):
        yield from part()


def _masked(name: str, clauses: str, error: str, section: bytes, what: str) -> Vector:
    """Three anchors of layer 0 whose MASKS section, one channel of three codes, is this one."""
    layer = make_layer(0, line(3), codes=CODES)
    payload = layer.with_sections({MASKS: section}).payload()
    return in_layer(0, name, what, clauses, error, payload, make_file(layer))


def _attributed(name: str, clauses: str, error: str, section: bytes, what: str) -> Vector:
    """Three anchors of layer 0 whose ATTRIBUTES section is this one."""
    layer = make_layer(0, line(3))
    payload = layer.with_sections({ATTRIBUTE: section}).payload()
    return in_layer(0, name, what, clauses, error, payload, make_file(layer))


# -- clause 7 ----------------------------------------------------------------------------------------------------------


def _varints() -> Iterator[Vector]:
    rows: tuple[Row, ...] = (
        ("overlong", "7.1", MALFORMED, b"\x80\x00\x9a\x01", "0 in two bytes."),
        ("overlong-parameter", "7.1", MALFORMED, b"\x00\x9a\x81\x00", "154 in three bytes."),
        ("six-bytes", "7.1", MALFORMED, b"\x00\x80\x80\x80\x80\x80\x01", "A varint of six bytes."),
        ("cut", "7.1 15", MALFORMED, b"\x00\x9a", "The section ends inside a varint."),
        ("over-limit", "7.1", LIMIT, b"\x00" + varint(2 * K_MAX + 1), "A constant of −2^24."),
        ("largest", "7.1", LIMIT, b"\x00" + varint((1 << 35) - 1), "A varint of 35 bits."),
    )
    for name, *row in rows:
        yield _masked(f"varint-{name}", *row)


def _streams() -> Iterator[Vector]:
    section = coded([CODES], {0: gauss(3, 10, si=60)})
    block, stream = section[:-4], section[-4:]
    constant = b"\0\x9a\1"
    other = words(struct.unpack("<I", stream)[0] ^ 1 << 20)
    for name, section, what in (
        ("odd-length", block + stream + b"\0", "A stream of five bytes."),
        ("short", block + stream[:3], "A stream of three bytes."),
        ("zero-word-first", block + words(0) + stream, "A zero word before the stream."),
        ("other-word", block + other, "A stream that ends in another state."),
        ("one-for-constants", constant + words(1), "A word where every channel is constant."),
        ("zero-for-constants", constant + words(0), "A zero word where every channel is constant."),
        ("byte-for-constants", constant + b"\1", "A byte where every channel is constant."),
    ):
        yield _masked(f"stream-{name}", "7.7", MALFORMED, section, what)
    long = plain_attributes(pattern(68, 3), {0: SMALL})
    for name, section, what in (
        ("word-left", long + words(7), "A word behind the stream."),
        ("zero-word-left", long + words(0), "A zero word behind the stream."),
        ("word-missing", long[:-4], "A stream without its last word."),
        ("words-swapped", long[:-8] + long[-4:] + long[-8:-4], "The last two words are swapped."),
    ):
        yield _attributed(f"stream-{name}", "7.7", MALFORMED, section, what)


# -- clause 8 ----------------------------------------------------------------------------------------------------------


def _new(family: int, *parameters: bytes) -> bytes:
    """The token and parameters of a new prior."""
    return varint(2 * family) + b"".join(parameters)


def _below(kmin: int) -> bytes:
    """CODES as exceptions of a window that begins at kmin."""
    return varint(len(CODES) - 1) + b"".join(varint(0) + varint(2 * (kmin - 1 - code) + 1) for code in CODES)


def _steep_plane(mode: int = ANS, sign: int = 1) -> Layer:
    """Layer 1 with a plane whose samples are within 2^23, while its second residual is K + 1, or −K − 1."""
    samples = np.array([-MAX_SYMBOL, MAX_SYMBOL], np.int32) * sign
    scale = Scale(1, (2, 1, 1, 1), (1, 0, 0, 0, 0, 0), lambda name, shape: np.resize(samples * (name == "xy"), shape))
    return make_layer(1, (), before=1, scales=[scale], mode=mode)


def _steep(name: str, clauses: str, prior: Prior, what: str, sign: int = 1) -> Vector:
    """The residuals of `_steep_plane` under this prior."""
    layer = _steep_plane(sign=sign)
    residuals = [[-MAX_SYMBOL * sign, 2 * MAX_SYMBOL * sign], [0] * 2, [0] * 2, [0], [0], [0]]
    written = layer.with_sections({PLANE: plain_planes(residuals, {0: prior})})
    return bad(name, what, clauses, MALFORMED, make_file(make_layer(), written), chunk=1)


def _priors() -> Iterator[Vector]:
    window = zigzag(3) + varint(8)  # ten entries from 3
    normal = zigzag(0) + varint(2 * 700)
    stream = coded([CODES], {0: gauss(3, 10, si=60)})[-4:]
    top, reserved = MAX_WINDOW - 2, varint(2 * 700 + 1)
    # All three symbols as exceptions below the window, so that nothing but its end is wrong.
    last, entry = K_MAX, K_MAX - 4095
    past = varint(2 * 1 + 1) + zigzag(last) + varint(0) + normal + _below(last)
    past_scaled = varint(2 * SCALED + 1) + b"\x0c\1" + zigzag(entry) + varint(0) + normal + _below(entry)
    shift_13 = _new(SCALED, bytes([MAX_SHIFT + 1, 1]), window, normal)
    reserved_bit = _new(2, window, normal, zigzag(0), reserved, b"\x80", stream)
    mean_over = _new(1, window, zigzag(MU8_MAX + 1), varint(1400), stream)
    mean_under = _new(1, window, varint(2 * MU8_MAX + 1), varint(1400), stream)
    wide = _new(1, zigzag(3), varint(top + 1), normal, stream)
    rows: tuple[Row, ...] = (
        ("token-over-limit", "8.1", LIMIT, varint(2 * (FIRST_REUSE + MAX_COUNT) + 1), "A token over its limit."),
        ("family-5", "8.1", FEATURE, _new(5, window), "Prior family 5."),
        ("family-7", "8.1", FEATURE, _new(7, window), "Prior family 7."),
        ("scaled-family-4", "8.1", FEATURE, _new(SCALED, b"\1\4", window), "A scaled prior of family 4."),
        ("scaled-family-255", "8.1", FEATURE, _new(SCALED, b"\1\xff", window), "A scaled prior of family 255."),
        ("scaled-family-0", "8.1", MALFORMED, _new(SCALED, b"\1\0", zigzag(5)), "A scaled constant."),
        (
            "scaled-shift-0",
            "8.1",
            MALFORMED,
            _new(SCALED, b"\0\1", window, normal, stream),
            "A scaled prior of shift 0.",
        ),
        ("scaled-shift-13", "8.1", LIMIT, shift_13, "A scaled prior of shift 13."),
        (
            "reuse-before-first",
            "8.1",
            MALFORMED,
            varint(2 * FIRST_REUSE),
            "A reference to a prior where there is none.",
        ),
        ("constant-over-limit", "8.2", LIMIT, _new(0, zigzag(K_MAX + 1)), "A constant of 2^24."),
        (
            "window-over-limit",
            "8.2",
            LIMIT,
            _new(1, zigzag(-K_MAX - 1), varint(8), normal, stream),
            "A window from −2^24.",
        ),
        ("window-too-wide", "8.2", LIMIT, wide, "A window of 2^14 + 1 entries."),
        ("window-past-k", "8.2", MALFORMED, past, "A window that ends at 2^24."),
        ("window-past-k-scaled", "8.2", MALFORMED, past_scaled, "A scaled window whose last entry begins at 2^24."),
        ("mean-over-limit", "8.2", LIMIT, mean_over, "A mean over its limit."),
        ("mean-under-limit", "8.2", LIMIT, mean_under, "A mean under its limit."),
        ("width-over-limit", "8.2", LIMIT, _new(1, window, zigzag(0), varint(3842), stream), "A deviation over 2^20."),
        (
            "mixture-weight-0",
            "8.2",
            MALFORMED,
            _new(2, window, normal, normal, b"\0", stream),
            "A mixture of weight 0.",
        ),
        ("mixture-reserved-bit", "8.2", MALFORMED, reserved_bit, "The second normal's floor bit."),
        ("mixture-cut", "8.2 15", MALFORMED, _new(2, window, normal, normal), "A mixture without a weight."),
        ("parameters-cut", "8.2 15", MALFORMED, _new(1, window, zigzag(0)), "A Gaussian without a width."),
    )
    for name, *row in rows:
        yield _masked(f"prior-{name}", *row)
    section = coded([[2] * 3] * 68)
    far = b"\0" + section[:5] + varint(2 * (FIRST_REUSE + 1)) + section[6:]
    yield _attributed("prior-reuse-too-far", "8.1", MALFORMED, far, "A reference to a prior before the first.")
    one, more = (b"\0" + coded([[2] * 3] * count) for count in (67, 69))
    yield _attributed("channel-missing", "8.1 15", MALFORMED, one, "67 channels of attributes.")
    yield _attributed("channel-too-many", "7.7 8.1", MALFORMED, more, "69 channels of attributes.")
    over = tables_at_limit(more=True)
    yield bad(
        "prior-tables-over-limit",
        "Tables of an entry more than 2^18 and one per symbol of their section.",
        "14 8.2",
        LIMIT,
        over,
        chunk=1,
    )
    yield _steep("symbol-over-k", "8.4", gauss(K_MAX - 2 * 4095, 2, shift=12), "A scaled symbol of K + 1.")


def _histograms() -> Iterator[Vector]:
    def masked(
        name: str, error: str, prior: Hist, what: str, block: bytes | None = None, classes: list[int] | None = None
    ) -> Vector:
        """block: instead of the prior's parameters. classes: instead of its symbols in the stream; the codes behind
        them are written for what they mean, if that is a table at all."""
        out = bytearray(varint(2 * prior.id))
        write_prior(out, prior)
        symbols = prior.class_symbols if classes is None else np.array(classes)
        meant = np.cumsum(symbols - prior.top) if prior.differences else symbols
        if not 0 < meant.max() <= prior.top:
            meant = np.full(prior.window.n, 5)
        entries = np.array(CODES) - prior.window.kmin
        stream = ans_encode([symbols, entries], [prior.class_cum, replace(prior, classes=meant).cum])
        return _masked(f"histogram-{name}", "8.2", error, (bytes(out) if block is None else block) + stream, what)

    n = 10
    plain = Hist(Window(3, n), 8, 5, False, 30, 8, np.array([5] * n))
    signed = Hist(Window(3, n), 8, 5, True, 30, 0, np.array([5] * n))
    head = varint(2 * plain.id) + zigzag(3) + varint(n - 2)
    for bit in range(3, 8):
        block = head + bytes([4 | 1 << bit]) + varint(5) + b"\x1e"
        yield masked(f"mode-bit-{bit}", MALFORMED, signed, f"Bit {bit} of the mode, which is reserved.", block)
    yield masked("top-0", MALFORMED, plain, "No classes.", head + b"\0" + varint(0) + b"\x1e" + varint(0))
    for i, d in enumerate((8, 64)):
        block = head + bytes([3 * i]) + varint(top_limit(d) + 1) + b"\x1e" + varint(8)
        yield masked(f"top-over-limit-{d}", LIMIT, plain, f"More classes than a step of {d} allows.", block)
    block = head + b"\0" + varint(5)
    yield masked("width-over-limit", LIMIT, plain, "A class width of 64.", block + b"\x40" + varint(8))
    yield masked("mean-over-limit", LIMIT, plain, "A class mean of 16·top + 1.", block + b"\x1e" + varint(81))
    for name, prior, classes, what in (
        ("all-zero", plain, [0] * n, "Every class is 0."),
        ("below-zero", signed, [6, 3, 7, *[5] * 7], "Differences that lead below 0."),
        ("above-top", signed, [10, 6, 4, *[5] * 7], "Differences that lead above the top."),
        ("all-zero-differences", signed, [5] * n, "Differences of 0 alone."),
    ):
        yield masked(name, MALFORMED, prior, what, classes=classes)


def _exceptions() -> Iterator[Vector]:
    def listed(*numbers: int) -> bytes:
        return varint(1) + zigzag(9) + b"".join(map(varint, numbers))

    for name, sign in (("above-k", 1), ("below-k", -1)):
        yield _steep(f"exceptions-{name}", "8.3", SMALL, f"An exception of {sign * (K_MAX + 1)}.", sign)
    rows: tuple[Row, ...] = (
        ("beyond-channel", "8.3", MALFORMED, listed(0, 3, 0), "An exception at place 3 of three symbols."),
        ("second-beyond-channel", "8.3", MALFORMED, listed(1, 1, 0, 1, 0), "A second one at place 3 of three symbols."),
        ("more-than-symbols", "8.3", MALFORMED, listed(3, *[0, 0] * 4), "Four exceptions among three symbols."),
        ("number-largest", "8.3", MALFORMED, listed(VARINT_MAX, 0, 0), "2^35 exceptions, the most a varint can say."),
        (
            "place-largest",
            "8.3",
            MALFORMED,
            listed(0, VARINT_MAX, 0),
            "An exception at place 2^35 − 1 of three symbols.",
        ),
        ("counts-that-lie", "8.3", MALFORMED, listed(MAX_COUNT - 1, 0, 0), "2^26 exceptions in four bytes."),
        ("cut", "8.3 15", MALFORMED, listed(1, 0, 0, 0), "The section ends inside an exception."),
        ("code-over-limit", "8.3", LIMIT, listed(0, 0, 4 * K_MAX + 3), "A code over 4·K + 2."),
    )
    for name, *row in rows:
        yield _masked(f"exceptions-{name}", *row)


def _prediction() -> Iterator[Vector]:
    k = np.full((68, 3), 3, np.int32)

    def block(terms=None, splits=None, counts=None) -> bytes:
        return b"\1" + prediction_block(terms or {}, splits or {}, counts or {})

    def whole(terms) -> bytes:
        """With stages as without terms."""
        return block(terms) + predicted_attributes(k, {}, {})[len(block()) :]

    def said(change) -> bytes:
        """Other lengths of the stages."""
        return predicted_attributes(k, {}, {0: (3, 3, 3)}, lengths=change)

    nine, none = (predicted_attributes(k, {}, {}, (1, 1, count, 1, 1)) for count in (9, 0))
    stages = [coded(stage) for stage in attribute_stages(k, {}, ONE_CLASS)]
    stages[1] = varint(2 * FIRST_REUSE) * 6
    reused = block() + b"".join([*(varint(len(stage)) for stage in stages[:-1]), *stages])
    beyond = said(lambda sizes: [*sizes[:-1], sizes[-1] + 40])
    left = predicted_attributes(k, {}, {}, tail=words(1))
    rows: tuple[Row, ...] = (
        ("form-3", "8.5", FEATURE, b"\3" + coded(k), "Form 3 of the attributes."),
        ("form-255", "8.5", FEATURE, b"\xff" + coded(k), "Form 255 of the attributes."),
        ("form-alone", "8.6 15", MALFORMED, b"\1", "The section ends after its form."),
        ("block-cut", "8.6 15", MALFORMED, block()[:30], "The section ends inside the prediction block."),
        ("terms-over-limit", "8.6", LIMIT, block({2: [(0, 1)] * 3}), "Three terms for channel 2."),
        ("term-of-itself", "8.6", MALFORMED, whole({2: [(2, 1)]}), "Channel 2 is predicted from itself."),
        ("term-of-later-channel", "8.6", MALFORMED, whole({2: [(1, 1), (30, 1)]}), "Channel 2 is predicted from 32."),
        ("term-gap-over-limit", "8.6", LIMIT, block({37: [(39, 1)]}), "A gap of 39 channels."),
        ("weight-over-limit", "8.6", LIMIT, whole({1: [(0, (1 << 15) + 1)]}), "A weight of 2^15 + 1."),
        ("weight-under-limit", "8.6", LIMIT, whole({1: [(0, -(1 << 15) - 1)]}), "A weight of −2^15 − 1."),
        ("term-missing", "8.6 15", MALFORMED, block(counts={37: 1})[:-15], "The section ends before a term."),
        ("split-unknown", "8.6", LIMIT, block(splits={9: (4, 0, 0)}), "Split 4."),
        ("split-x-over-limit", "8.6", LIMIT, block(splits={4: (1, K_MAX + 1, 0)}), "A centre of x of K + 1."),
        ("split-y-under-limit", "8.6", LIMIT, block(splits={4: (2, 0, -K_MAX - 1)}), "A centre of y of −K − 1."),
        ("classes-0", "8.9", MALFORMED, none, "No class in stage 3."),
        ("classes-9", "8.9", LIMIT, nine, "Nine classes in stage 3."),
        ("classes-cut", "8.9 15", MALFORMED, block()[:-13], "The section ends after two class counts."),
        ("stage-over-rest", "8.9", LIMIT, said(lambda sizes: [999, *sizes[1:]]), "A stage longer than the section."),
        ("stages-over-rest", "8.9", MALFORMED, beyond, "Stages longer than what is left."),
        ("stage-0-short", "8.1 8.9 15", MALFORMED, said(lambda s: [s[0] - 1, *s[1:]]), "Stage 0 is a byte short."),
        ("stage-6-short", "8.1 8.9 15", MALFORMED, said(lambda s: [*s[:-1], s[-1] - 1]), "Stage 6 is a byte short."),
        ("prior-of-earlier-stage", "8.1 8.7", MALFORMED, reused, "Stage 1 refers to a prior of stage 0."),
        ("stage-left", "7.7 8.7", MALFORMED, left, "A word behind the last stage."),
        ("result-over-k", "8.7", MALFORMED, _over_k(), "A predicted symbol of K + 1."),
    )
    for name, *row in rows:
        yield _attributed(f"predicted-{name}", *row)


def _grades() -> Iterator[Vector]:
    own, k = np.array([0, 6, 2], np.int32), np.full((68, 3), 3, np.int32)
    rest = plain_attributes(k, classes=own)[1 + len(graded_part(own)) :]

    def held(part: bytes) -> bytes:
        return b"\0" + part + rest

    over, under = (graded_part(np.array([0, symbol, 2], np.int32)) for symbol in (7, -1))
    staged_over = predicted_attributes(k, {}, {}, (1,) * 6, grades=own).replace(graded_part(own), over, 1)
    rows: tuple[Row, ...] = (
        ("7", "8.5", MALFORMED, held(over), "A step class of 7."),
        ("negative", "8.5", MALFORMED, held(under), "A step class of −1."),
        ("7-staged", "8.5", MALFORMED, staged_over, "A step class of 7 in form 1."),
        ("length-over-rest", "8.5 8.9", LIMIT, b"\0" + graded_part(own, 999), "Step classes longer than the section."),
        ("short", "7.7 8.5", MALFORMED, held(graded_part(own, len(graded_part(own)) - 2)), "A byte short."),
        ("nothing", "8.5 15", MALFORMED, b"\0", "The section ends after its form."),
    )
    for name, said, symbol in (("7", "7", 7), ("negative", "−1", -1)):
        layer = make_layer(0, line(3), attributes=k, classes=[0, symbol, 2], mode=LZMA)
        packed = make_file(layer, header={2: LZMA})
        what = f"A step class of {said} in mode lzma."
        yield bad(f"step-classes-{name}-lzma", what, "8.5", MALFORMED, packed, chunk=0)
    for name, clauses, error, section, what in rows:
        layer = make_layer(0, line(3), attributes=k, classes=own.tolist())
        yield bad(
            f"step-classes-{name}", what, clauses, error, make_file(layer.with_sections({ATTRIBUTE: section})), chunk=0
        )
    edge = np.full((68, 1), 2, np.int32)
    edge[5] = MAX_SYMBOL >> 6
    far = make_file(make_layer(0, line(1), attributes=edge, classes=[6]), header={16: [0] * 5 + [1] + [0] * 62})
    yield bad("step-classes-value-over-limit", "A value of 2^23 + 1 steps.", "11.5", MALFORMED, far, chunk=0)
    near = make_file(make_layer(0, line(1), attributes=-edge, classes=[6]), header={16: [0] * 5 + [-1] + [0] * 62})
    yield bad("step-classes-value-under-limit", "A value of −2^23 − 1 steps.", "11.5", MALFORMED, near, chunk=0)
    for name, clauses, symbol, centre, what in (
        ("symbol-over-limit", "11.2 11.5", MAX_SYMBOL + 1, -1, "A symbol of 2^23 + 1, the value of 2^23."),
        ("symbol-under-limit", "11.2 11.5", -MAX_SYMBOL - 1, 1, "A symbol of −2^23 − 1, the value of −2^23."),
        ("sum-over-limit", "11.5 11.2", MAX_SYMBOL, 1, "A symbol of 2^23 in class 0, the value of 2^23 + 1."),
    ):
        edge[5] = symbol
        layer = make_layer(0, line(1), attributes=edge.copy(), classes=[0])
        file = make_file(layer, header={16: [0] * 5 + [centre] + [0] * 62})
        yield bad(f"step-classes-{name}", what, clauses, MALFORMED, file, chunk=0)


def _over_k() -> bytes:
    """Form 1 with every residual just over K / 2, and channel 3 predicted as channel 0."""
    e = np.full((68, 3), (K_MAX >> 1) + 1)
    stages = staged(attribute_stages(e, {}, ONE_CLASS))
    return b"\1" + prediction_block({3: [(0, 1 << 10)]}, {}, {}) + stages


def _staged_planes() -> Iterator[Vector]:
    layer = make_layer(1, (), before=1, scales=[Scale(5)])
    file, planes = make_file(make_layer(), layer), list(layer.meant.planes[0].values())
    plain = layer.sections[PLANE]

    def said(change: Callable[[list[int]], list[int]]) -> bytes:
        """Other lengths of the stages."""
        return staged_planes(planes, (3, 2), change)

    def of_the_rest(more: int) -> bytes:
        """Stage 0 as long as what is left of the section where its length begins, or longer."""
        said = 0
        for _ in range(3):  # the length's own bytes count
            section = staged_planes(planes, (3, 2), lambda sizes, said=said: [said + more, sizes[1]])  # type: ignore[misc]
            said = len(section) - len(b"\1\3\2")
        return section

    rows: tuple[Row, ...] = (
        ("form-2", "8.8", FEATURE, b"\2" + plain[1:], "Form 2 of the planes."),
        ("form-alone", "8.9 15", MALFORMED, b"\1", "The section ends after its form."),
        ("classes-0", "8.9", MALFORMED, staged_planes(planes, (1, 0)), "No class in stage 2."),
        ("classes-9", "8.9", LIMIT, staged_planes(planes, (9, 1)), "Nine classes in stage 1."),
        ("stage-over-rest", "8.9", LIMIT, said(lambda s: [9999, s[1]]), "A stage longer than the section."),
        ("stages-over-rest", "8.9", MALFORMED, said(lambda s: [s[0] + 60, s[1] + 60]), "Stages longer than the rest."),
        ("stage-0-short", "7.7 8.9", MALFORMED, said(lambda s: [s[0] - 1, s[1]]), "Stage 0 is a byte short."),
        (
            "stage-of-rest",
            "8.9",
            MALFORMED,
            of_the_rest(0),
            "A stage as long as all that its length and the rest take.",
        ),
        ("stage-over-rest-by-1", "8.9", LIMIT, of_the_rest(1), "A stage of a byte more than that."),
        ("stage-left", "7.7 8.8", MALFORMED, staged_planes(planes, (3, 2), tail=words(7)), "A word behind the stages."),
    )
    for name, clauses, error, section, what in rows:
        payload = layer.with_sections({PLANE: section}).payload()
        yield in_layer(1, f"planes-{name}", what, clauses, error, payload, file)
    same = make_layer(1, (), before=1, scales=[Scale(3, (1, 1, 1, 1), fill=lambda name, shape: np.full(shape, 4))])
    first, again = coded([[4]] * 12), varint(2 * FIRST_REUSE)
    section = b"\1\1" + varint(len(first)) + first + again * 6
    payload = same.with_sections({PLANE: section}).payload()
    what = "A stage refers to a prior of the stage before."
    file = make_file(make_layer(), same)
    yield in_layer(1, "planes-prior-of-earlier-stage", what, "8.1 8 8.8", MALFORMED, payload, file)


# -- clause 9 ----------------------------------------------------------------------------------------------------------

#: Bytes of the numbers in the section of `_lzma`, and where they are cut into two chunks.
LZMA_BYTES, LZMA_CUT = 4098, 1000


def _lzma() -> Iterator[Vector]:
    layer = make_layer(0, line(2), mode=LZMA, attributes=pattern(68, 2))
    file, channels = make_file(layer, header={2: LZMA}), layer.channels
    right = lzma_symbols(channels, width=0, stream=lzma2.packed)
    head = right[2 : 2 + sum(c.size > 0 for c in channels)]
    rows: tuple[Row, ...] = (
        ("note-over-limit", "9.1 2.3", LIMIT, b"\xe1" + right[1:], "The first byte is 225."),
        ("flags-reserved", "9.1 2.3", MALFORMED, right[:1] + b"\2" + right[2:], "A reserved bit of the second byte."),
        (
            "flags-high-bit",
            "9.1 2.3",
            MALFORMED,
            right[:1] + b"\x80" + right[2:],
            "The highest bit of the second byte.",
        ),
        ("head-alone", "9.1 15", MALFORMED, right[:2], "The section ends after its two bytes."),
        ("head-cut", "9.1 15", MALFORMED, right[:20], "The section ends among the channels' bases."),
        ("eight-bytes", "9.1", MALFORMED, right[:2] + varint(3) + right[3:], "A channel of integers of 8 bytes."),
        ("base-over-limit", "9.1", LIMIT, right[:2] + varint(8 * K_MAX + 4) + right[3:], "A base of −K − 1."),
        ("nothing-packed", "9.3 15", MALFORMED, right[:2] + head, "No stream."),
        ("end-alone", "9.3", MALFORMED, right[:2] + head + b"\0", "A stream of an end marker."),
        ("end-missing", "9.3 15", MALFORMED, right[:-1], "No end marker."),
        ("bytes-after-end", "9.3", MALFORMED, right + b"\0", "A byte behind the end marker."),
        ("cut", "9.3 15", MALFORMED, right[:-9], "The stream ends in its chunk."),
    )
    for name, clauses, error, section, what in rows:
        payload = layer.with_sections({SYMBOLS: section}).payload()
        yield in_layer(0, f"lzma-{name}", what, clauses, error, payload, file)
    for name, what, stream in _lzma_streams():
        payload = layer.with_sections({SYMBOLS: lzma_symbols(channels, width=0, stream=stream)}).payload()
        yield in_layer(0, f"lzma-{name}", what, "9.3 9.1", MALFORMED, payload, file)
    steep = make_file(make_layer(mode=LZMA), _steep_plane(LZMA), header={2: LZMA})
    yield bad("lzma-symbol-over-k", "A symbol of K + 1.", "9.1", MALFORMED, steep, chunk=1)
    constant = make_layer(0, line(2), mode=LZMA)
    narrow, wide = (lzma_symbols(constant.channels, base=None, width=width, stream=lambda d: b"") for width in (1, 2))
    stream = lzma_symbols(constant.channels, base=None, width=2)[len(wide) :]
    payload, what = constant.with_sections({SYMBOLS: narrow + stream}).payload(), "Widths of 2 bytes over numbers of 4."
    file = make_file(constant, header={2: LZMA})
    yield in_layer(0, "lzma-width-lies", what, "9.3 9.1", MALFORMED, payload, file)


def _lzma_streams() -> Iterator[tuple[str, str, Callable[[bytes], bytes]]]:
    """(name, sentence, what makes the stream of the right numbers)."""
    packed, stored, plain = lzma2.packed, lzma2.stored, lzma2.Properties()

    def cut(first: int, second: int, *properties: lzma2.Properties, **how: bool) -> Callable[[bytes], bytes]:
        """Two chunks of these control bytes."""
        plan = [(first, LZMA_CUT), (second, LZMA_BYTES - LZMA_CUT)]
        return lambda d: lzma2.chunks(d, plan, properties, **how)

    def body(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        """One compressed chunk with other packed bytes."""
        return lambda d: packed(d, body=change)

    yield "byte-short", "The stream unpacks to a byte less.", lambda d: packed(d[:-1])
    yield "byte-long", "The stream unpacks to a byte more.", lambda d: packed(d + b"\0")
    yield "stored-short", "Stored chunks of a byte less.", lambda d: stored(d[:-1])
    largest = lzma2.PACKED_MAX
    yield "bomb", "A stream that unpacks to 2^21 bytes.", lambda d: packed(d + bytes(largest - len(d)))
    bomb = packed(bytes(largest))[:-1]
    what = "A stream that unpacks to more than 2^24 bytes."
    yield "bomb-chunks", what, lambda d: packed(d)[:-1] + bomb * 8 + b"\0"
    for control in (3, 0x7F):
        yield f"control-byte-{control}", f"A control byte of {control}.", cut(lzma2.STORED_RESET, control)
    what = "The first chunk does not reset the dictionary."
    yield "dictionary-not-reset", what, lambda d: bytes([lzma2.STORED]) + stored(d)[1:]
    yield "properties", "lc + lp is 5.", lambda d: packed(d, lc=4, lp=1)
    yield "properties-over-limit", "Properties of 225.", lambda d: packed(d, lc=0, pb=5)
    for name, control in (("kept", lzma2.KEPT), ("state", lzma2.STATE)):
        what = f"A compressed chunk of control byte {control} before any properties."
        yield f"without-properties-{name}", what, cut(lzma2.STORED_RESET, control)
    again = [(lzma2.ALL_RESET, 1000), (lzma2.STORED_RESET, 1000), (lzma2.STATE, LZMA_BYTES - 2000)]
    what = "The properties of before a reset of the dictionary."
    yield "properties-of-before", what, lambda d: lzma2.chunks(d, again, [plain])
    yield "first-byte", "A compressed chunk begins with 1.", body(lambda b: b"\1" + b[1:])
    yield "end-state", "A compressed chunk that ends in a code of 1.", body(lambda b: b[:-1] + bytes([b[-1] + 1]))
    yield "chunk-byte-left", "A byte more in a compressed chunk.", body(lambda b: b + b"\0")
    yield "chunk-byte-missing", "A byte less in a compressed chunk.", body(lambda b: b[:-1])
    yield "range-coder", "A bit of a chunk is flipped.", body(lambda b: b[:-20] + bytes([b[-20] ^ 0x40]) + b[-19:])
    what = "A match of what lies before the dictionary's reset."
    yield "match-before-reset", what, cut(lzma2.ALL_RESET, lzma2.ALL_RESET, plain, plain, remember=True)
    size = (LZMA_BYTES - 2).to_bytes(2, "big")
    what = "A chunk that says a byte less than its last match gives."
    yield "match-beyond-chunk", what, lambda d: packed(d)[:1] + size + packed(d)[3:]


def _floats() -> Iterator[Vector]:
    layer = make_layer(1, (), before=1, scales=[Scale()], raw=True)
    file, arrays = make_file(make_layer(), layer, header={3: FLOAT32}), list(layer.meant.tensors())

    def of(name: str, clauses: str, error: str, section: bytes, what: str) -> Vector:
        payload = layer.with_sections({FLOATS: section}).payload()
        return in_layer(1, f"float32-{name}", what, clauses, error, payload, file)

    for name, value in (("nan", math.nan), ("infinity", math.inf), ("negative-infinity", -math.inf)):
        for where, at in (("plane", 0), ("weight", -1)):
            changed = [a.copy() for a in arrays]
            changed[at].reshape(-1)[-1] = value
            yield of(f"{name}-in-{where}", "9.2", MALFORMED, lzma_floats(changed), f"A {where} holds {value}.")
    right = lzma_floats(arrays)
    less, more = lzma_floats([*arrays[:-1], arrays[-1][:-1]]), lzma_floats([*arrays, np.zeros(1, np.float32)])
    rows: tuple[Row, ...] = (
        ("value-missing", "9.3 9.2", MALFORMED, less, "A value less."),
        ("value-more", "9.3 9.2", MALFORMED, more, "A value more."),
        ("note-over-limit", "9.2 9.1 2.3", LIMIT, b"\xe1" + right[1:], "The first byte is 225."),
        ("flags-reserved", "9.2 2.3", MALFORMED, right[:1] + b"\2" + right[2:], "A reserved bit of the second byte."),
        ("end-missing", "9.3 15", MALFORMED, right[:-1], "No end marker."),
        ("one-byte", "9.2 15", MALFORMED, right[:1], "The section ends after one byte."),
    )
    for row in rows:
        yield of(*row)


# -- clause 10 ---------------------------------------------------------------------------------------------------------


def _octree(
    depth: int,
    counts: Sequence[tuple[int, int]] = (),
    sizes: Sequence[int] = (),
    channels: Sequence[Sequence[int]] = (),
    low: Sequence[int] = (0, 0, 0),
) -> bytes:
    """A positions section of these fields. counts: per level (s, e). sizes: nodes with 2 .. 7 children."""
    numbers = [number for pair in counts for number in pair] + list(sizes)
    return b"".join(map(zigzag, low)) + bytes([depth]) + b"".join(map(varint, numbers)) + coded(channels)


def _positions() -> Iterator[Vector]:
    def of(name: str, clauses: str, error: str, rows: int, section: bytes, what: str) -> Vector:
        layer = make_layer(0, line(rows))
        payload = layer.with_sections({POSITIONS: section}).payload()
        return in_layer(0, f"positions-{name}", what, clauses, error, payload, make_file(layer))

    # Two anchors side by side: one level, whose one node has two children, the first of the patterns.
    pair, none = ((0, 0),), (0,) * 6
    one = (1, 0, 0, 0, 0, 0)
    right = _octree(1, pair, one, [[1], [0]])
    # Five anchors: a root with three children, of which one has one child.
    five = ((0, 1), (1, 0))
    above = _octree(1, pair, one, [[1], [0]], (MAX_VOXEL, 0, 0))
    over = 2 * MAX_VOXEL + 1
    rows: tuple[tuple[str, str, str, int, bytes, str], ...] = (
        ("cut", "10.1 15", MALFORMED, 1, right[:3], "The section ends before the depth."),
        ("cut-counts", "10.2 15", MALFORMED, 2, right[:5], "The section ends inside the counts."),
        ("index-above", "10.1 14", LIMIT, 1, varint(over + 1) + bytes(3), "A minimum of 2^20 + 1."),
        ("index-below", "10.1 14", LIMIT, 1, b"\0" + varint(over) + bytes(2), "A minimum of −2^20 − 1."),
        ("index-over-limit", "10.1 14", MALFORMED, 2, above, "The second of two voxels lies at 2^20 + 1."),
        ("depth-over-limit", "10.1 14", LIMIT, 1, _octree(22), "A depth of 22."),
        ("depth-255", "10.1 14", LIMIT, 1, _octree(255), "A depth of 255."),
        ("minimum-not-0", "10.1", MALFORMED, 1, _octree(1, channels=[[1]]), "No anchor has the smallest coordinate."),
        (
            "depth-too-large",
            "10.1",
            MALFORMED,
            1,
            _octree(1, channels=[[0]]),
            "No anchor has a coordinate of as many bits as the depth.",
        ),
        ("single-over-nodes", "10.2", MALFORMED, 2, _octree(1, ((2, 0),), none), "Two nodes of one have one child."),
        ("single-over-limit", "10.2", LIMIT, 2, _octree(1, ((MAX_COUNT + 1, 0),), none), "2^26 + 1 such nodes."),
        ("further-over-six", "10.2", MALFORMED, 9, _octree(1, ((0, 7),), none), "A node with nine children."),
        ("further-over-limit", "10.2", LIMIT, 9, _octree(1, ((0, MAX_COUNT + 1),), none), "2^26 + 1 further children."),
        (
            "more-than-declared",
            "10.2",
            MALFORMED,
            2,
            _octree(1, ((0, 1),), none, [[2]]),
            "Three for two anchors.",
        ),
        ("fewer-than-declared", "10.2", MALFORMED, 3, right, "Two nodes at the end for three anchors."),
        ("no-level", "10.2", MALFORMED, 2, _octree(0, (), none), "Two anchors in one voxel."),
        (
            "sizes-over-nodes",
            "10.2",
            MALFORMED,
            2,
            _octree(1, pair, (1, 1, 0, 0, 0, 0), [[1], [0], [0]]),
            "Two nodes with two and with three children, where one has more than one.",
        ),
        ("size-over-limit", "10.2", LIMIT, 2, _octree(1, pair, (MAX_COUNT + 1, 0, 0, 0, 0, 0)), "2^26 + 1 nodes."),
        (
            "sizes-other",
            "10.3",
            MALFORMED,
            2,
            _octree(1, pair, (0, 1, 0, 0, 0, 0), [[1], [0]]),
            "Two, said three.",
        ),
        ("sizes-fewer", "10.3", MALFORMED, 2, _octree(1, pair, none, [[1]]), "Two children, said none."),
        (
            "single-other",
            "10.3",
            MALFORMED,
            5,
            _octree(2, five, (0, 2, 0, 0, 0, 0), [[2], [2, 0, 0], [0], [0, 0]]),
            "Two nodes have one child, said one.",
        ),
        (
            "children-nine",
            "10.3",
            MALFORMED,
            11,
            _octree(2, ((0, 0), (0, 7)), (2, 0, 0, 0, 0, 0), [[1], [8, 1], [6, 0]]),
            "A node with nine children.",
        ),
        (
            "children-none",
            "10.3",
            MALFORMED,
            4,
            _octree(2, pair * 2, (1, 0, 1, 0, 0, 0), [[1], [-1, 3], [6], [0]]),
            "A node without children.",
        ),
        (
            "children-sum",
            "10.3",
            MALFORMED,
            2,
            _octree(1, pair, (0, 1, 0, 0, 0, 0), [[2], [0]]),
            "Three, said two.",
        ),
        ("child-eight", "10.3", MALFORMED, 2, _octree(2, pair, one, [[1], [0, 8], [6]]), "A child's number of 8."),
        ("child-negative", "10.3", MALFORMED, 2, _octree(2, pair, one, [[1], [0, -1], [6]]), "A child's number of −1."),
        ("pattern-28", "10.3", MALFORMED, 2, _octree(1, pair, one, [[1], [28]]), "The 29th of 28 patterns."),
        ("pattern-negative", "10.3", MALFORMED, 2, _octree(1, pair, one, [[1], [-28]]), "A pattern's index of −28."),
        ("stream-of-nothing", "7.7", MALFORMED, 1, _octree(0) + words(1), "A word, and nothing is coded."),
        ("stream-odd", "7.7", MALFORMED, 1, _octree(0) + b"\1", "A byte where nothing is coded."),
    )
    for row in rows:
        yield of(*row)


# -- clauses 11 and 12 -------------------------------------------------------------------------------------------------


def _ranges() -> Iterator[Vector]:
    def of(name: str, clauses: str, what: str, *layers: Layer, header: dict[int, object] | None = None) -> Vector:
        """The fault lies in the last layer."""
        file = make_file(*layers, header=header)
        return bad(name, what, clauses, MALFORMED, file, chunk=len(layers) - 1)

    for name, code in (("0", 0), ("1", 1), ("2", 2), ("negative", -3), ("256", 256)):
        yield of(f"mask-code-{name}", "11.1", f"A mask code of {code}.", make_layer(0, line(3), codes=[77, code, 77]))
    base = make_layer(0, line(2), codes=[3, 200])
    for name, rises, what in (
        ("negative", [0, -1], "A mask that falls."),
        ("over-255", [256, 0], "A rise of 256."),
        ("sum-over-255", [0, 56], "A code of 200 and a rise of 56."),
    ):
        yield of(f"mask-rise-{name}", "11.1", what, base, make_layer(1, (), before=2, rises=rises))
    second, third = make_layer(1, (), before=2, rises=[100, 50]), make_layer(2, (), before=2, rises=[153, 0])
    what = "Rises of two layers that sum to 256."
    yield of("mask-sum-over-255-in-layer-2", "11.1", what, base, second, third)

    for name, sign in (("above", 1), ("below", -1)):
        k = np.full((68, 2), 1, np.int32)
        k[5, 1] = sign * (MAX_SYMBOL + 1)
        what = f"An attribute's symbol of {sign * (MAX_SYMBOL + 1)}."
        centre = {16: [*[0] * 5, -sign, *[0] * 62]}  # so that the value itself is within its range
        file = make_file(make_layer(0, line(2), attributes=k, classes=[0, 0]), header=centre)
        yield bad(f"attribute-{name}", what, "11.2", MALFORMED, file, chunk=0)
    networks = constant_networks(0, {0: (10,), 1: (70,), 2: (30,)}, 35)
    networks["color"][0][1][:] = MAX_SYMBOL + 1
    yield of("weight-above", "11.2 11.4", "A bias of 2^23 + 1.", make_layer(networks=networks))

    def plane(predictor: int, *values: int) -> Layer:
        fill = lambda name, shape: np.resize(values, shape).astype(np.int32)  # noqa: E731
        return make_layer(1, (), before=1, scales=[Scale(1, (2, 1, 1, 1), (predictor, 0, 0, 0, 0, 0), fill)])

    yield of("plane-above", "11.2 11.3", "A sample of 2^23 + 1.", make_layer(), plane(0, MAX_SYMBOL + 1, 0))
    for predictor, name in ((1, "left"), (3, "median"), (4, "gradient"), (5, "average")):
        what, layer = (
            f"A sample that predictor {predictor} restores to −2^23 − 1.",
            plane(predictor, -9, -MAX_SYMBOL - 1),
        )
        yield of(f"plane-{name}-below", "11.2 11.3", what, make_layer(), layer)

    half, three = 2.0**127, make_layer(0, line(3))
    for name, layers, header, what in (
        ("attributes", (three,), {4: [half] * 3}, "A step that makes attributes infinite."),
        ("positions", (three,), {5: half}, "A step that makes positions infinite."),
        ("weights", (make_layer(steps=[LARGEST]),), {}, "A step that makes weights infinite."),
        (
            "planes",
            (make_layer(), make_layer(1, (), before=1, scales=[Scale()], steps=[LARGEST, 1.0])),
            {},
            "A step that makes planes infinite.",
        ),
    ):
        yield of(f"overflow-{name}", "11.5", what, *layers, header=header)
    rounded = Scale(1, (2, 1, 1, 1), (0,) * 6, lambda name, shape: np.full(shape, 31 * 601, np.int32))
    layer = make_layer(1, (), before=1, scales=[rounded], steps=[1801 * 2.0**103, 1.0])
    yield of("overflow-by-rounding", "11.5", "Samples of 2^128 - 2^103, which rounds to infinity.", make_layer(), layer)

    what = "A voxel of layer 0 again in layer 1."
    yield of("voxel-twice", "12.1", what, three, make_layer(1, [[2, 0, 0]], before=3))
    what = "A voxel of layer 0 again in layer 2."
    first, middle = make_layer(0, line(1)), make_layer(1, [[5, 0, 0]], before=1)
    yield of("voxel-twice-in-layer-2", "12.1", what, first, middle, make_layer(2, [[0, 0, 0]], before=2))
