"""Vectors that use what every encoder uses, and the extremes of it."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator

import numpy as np

from pd4dgs_codec.entropy.priors import (
    CLASS_STEPS,
    FREE_ENTRIES,
    K_MAX,
    MAX_WINDOW,
    MU8_MAX,
    Const,
    Hist,
    Mixture,
    Normal,
    Prior,
    Window,
    top_limit,
)
from pd4dgs_codec.entropy.tables import SI_MAX, SI_MIN
from pd4dgs_codec.format.layer_meta import FREE_ROWS, FREE_SYMBOLS, ROWS_PER_BYTE, SYMBOLS_PER_BYTE
from pd4dgs_codec.format.limits import MAX_NETWORK_LAYERS, MAX_NETWORK_WIDTH, MAX_PLANE_CHANNELS, MAX_PLANE_SIDE
from pd4dgs_codec.format.planes import restore
from pd4dgs_codec.format.quantise import MAX_SYMBOL
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import Widths

from . import lzma2
from .blocks import (
    ATTRIBUTE,
    CAMERA,
    FLOAT32,
    FLOATS,
    LZMA,
    ONE_CLASS,
    PLANE,
    SMALL,
    SYMBOLS,
    File,
    Layer,
    Scale,
    Vector,
    classes_of_plane,
    gauss,
    good,
    lzma_floats,
    lzma_symbols,
    make_file,
    make_layer,
    pattern,
    plain_attributes,
    plain_planes,
    plane_channels,
    predicted_attributes,
    staged_planes,
)

LOCAL_HEADS = {0: (3,), 1: (3,), 2: (2, 3), 3: (4,), 4: (1,), 5: (3,)}
LEAST_NORMAL, LARGEST = 2.0**-126, (2.0 - 2.0**-23) * 2.0**127


def ordered(cells: object) -> list[list[int]]:
    """Cells in Morton order."""
    array = np.array(cells, np.int32).reshape(-1, 3)
    return array[morton_order(array)].tolist()


def line(n: int, z: int = 0) -> list[list[int]]:
    """n cells in a row."""
    return [[i, 0, z] for i in range(n)]


def three_layers(**fields: object) -> File:
    """Layers 0, 1 and 2 with anchors, rises and deformations of their own."""
    first = make_layer(0, line(3), codes=[3, 77, 200], attributes=pattern(68, 3))
    second = make_layer(1, line(2, z=5), before=3, rises=[0, 1, 5], codes=[9, 255], scales=[Scale()])
    third = make_layer(
        2, line(1, z=9), before=5, rises=[252, 0, 50, 3, 0], scales=[Scale()], attributes=pattern(68, 1, seed=4)
    )
    return make_file(first, second, third, **fields)  # type: ignore[arg-type]


def _global_heads(widths: Widths) -> dict[int, tuple[int, ...]]:
    """The outputs of the linear layers of layer 1's networks by id."""
    return {0: (4, 3), 1: (3,), 2: (5, widths.feature), 3: (3 * widths.slots,), 4: (6,)}


def cases() -> Iterator[Vector]:
    """All vectors under valid/."""
    for make in (
        _scenes,
        _widths,
        _step_classes,
        _priors,
        _histograms,
        _exceptions,
        _attributes,
        _planes,
        _positions,
        _lzma,
        _floats,
        _ranges,
    ):
        for name, sentence, clauses, file in make():
            yield good("valid/" + name, sentence, clauses, file)


Case = tuple[str, str, str, File]


def _scenes() -> Iterator[Case]:
    yield (
        "one-anchor",
        "One anchor in layer 0; every channel is constant.",
        "3.1 3.2 3.3 5.1 6.1 6.2 6.3 6.4 8.1",
        make_file(make_layer()),
    )
    yield "camera", "A default camera.", "5.3", make_file(make_layer(), header={12: CAMERA})
    yield "empty-scene", "No anchor at all: networks alone.", "6.2 6.4", make_file(make_layer(cells=()))
    empty = [make_layer(number, ()) for number in (0, 1, 2)]
    yield "empty-layers", "Layers 1 and 2 with neither anchors nor deformation.", "6.2 6.4", make_file(*empty)
    yield (
        "layers-0-1-2",
        "Anchors, rises of masks and a deformation in every layer.",
        "6.1 11.1 12.1 12.2 12.4",
        three_layers(),
    )
    base, deformed = make_layer(0, line(2)), dict(before=2, scales=[Scale()])
    yield "layers-0-1", "Layer 2 is not there.", "5.2 12.2", make_file(base, make_layer(1, [[0, 0, 1]], **deformed))
    yield "layers-0-2", "Layer 1 is not there.", "5.2 12.2", make_file(base, make_layer(2, [[0, 0, 1]], **deformed))
    bare = make_layer(1, [[0, 0, 1]], before=2), make_layer(2, (), before=3, rises=[1, 2, 3])
    yield (
        "layers-without-deformation",
        "Layer 1 has anchors only, layer 2 rises only.",
        "6.2 6.4",
        make_file(base, *bare),
    )
    only = make_layer(1, (), scales=[Scale()])
    yield "deformation-without-anchors", "A deformation in a scene without anchors.", "6.4", make_file(empty[0], only)
    one, two = Scale(1, (1, 3, 2, 4)), Scale(1, (2, 6, 4, 4))
    first = make_layer(1, (), before=1, scales=[one, two], networks=_global_heads(Widths()))
    second = make_layer(2, (), before=1, scales=[two], networks=LOCAL_HEADS)
    scaffold = make_layer(networks={0: (5, 10), 1: (3, 2, 70), 2: (30,)})
    yield "all-heads", "Every network, two scales, hidden layers.", "6.3 6.4", make_file(scaffold, first, second)


def _widths() -> Iterator[Case]:
    for name, what, widths in (
        ("least", "One feature and one Gaussian per anchor.", Widths(1, 1)),
        ("16-4", "16 features and four Gaussians per anchor.", Widths(16, 4)),
        ("most", "64 features and 16 Gaussians per anchor.", Widths(64, 16)),
    ):
        k = pattern(widths.channels, ROWS) * (1 + np.arange(ROWS) % 4)
        base = make_layer(0, line(ROWS), attributes=k, widths=widths)
        moves = make_layer(
            1, (), before=ROWS, scales=[Scale(1, (1, 3, 2, 4))], networks=_global_heads(widths), widths=widths
        )
        yield f"widths-{name}", what, "5.1 6.3 6.4 11.2", make_file(base, moves)
        p = widths.predicted
        terms = {c: [(j, 97 * c - 1800 + 31 * j) for j in range(c % 7, c, 5)] for c in range(1, p)}
        terms[p - 1] = [(p - 2, 512)]  # the longest gap
        flags = {i: (i % 4, i - 4, 5 - i) for i in range(widths.slots)}
        section = predicted_attributes(k, terms, flags, (8, 3, 2, 6, 4), widths=widths)
        file = make_file(base.with_sections({ATTRIBUTE: section}))
        yield f"widths-{name}-staged", what + " Form 1.", "8.5 8.6 8.7", file


def _step_classes() -> Iterator[Case]:
    own = np.resize([0, 6, 3, 1, 0, 2, 5, 4, 6, 1, 0], ROWS).astype(np.int32)
    k, grades = pattern(68, ROWS) * (1 + np.arange(ROWS) % 3), own.tolist()
    base = make_layer(0, line(ROWS), attributes=k, classes=grades)
    yield "classes", "Anchors of all step classes.", "5.1 8.5 11.2 11.5", make_file(base)
    more = make_layer(1, line(2, z=5), before=ROWS, attributes=pattern(68, 2), classes=[6, 0], scales=[Scale()])
    two = make_file(base, more)
    yield "classes-layers", "Step classes of two layers, which share their centres.", "5.1 11.5 12.4", two
    yield "classes-alike", "Every anchor has class 2.", "8.5", make_file(make_layer(0, line(3), classes=[2] * 3))
    empty = make_file(make_layer(0, (), classes=()), header={16: [7] * 68})
    yield "classes-of-no-anchors", "Centres and no anchor.", "5.1 6.4", empty
    ladder = {c: [(j, 97 * c - 1800 + 31 * j) for j in range(c % 7, c, 5)] for c in range(1, 38)}
    flags = {i: (i % 4, i - 4, 5 - i) for i in range(10)}
    for name, what, terms, splits, counts in (
        ("one", "Form 1, one class by activity in each stage.", {}, {}, (1,) * 6),
        ("first", "Stage 0 split by the step classes alone.", {}, {}, (7, 1, 1, 1, 1, 1)),
        ("all", "Step classes, terms, splits, and classes by activity.", ladder, flags, (4, 8, 3, 2, 6, 5)),
    ):
        section = predicted_attributes(k, terms, splits, counts, grades=own)
        file = make_file(base.with_sections({ATTRIBUTE: section}))
        yield f"classes-staged-{name}", what, "8.5 8.6 8.7 8.9", file
    near, small = pattern(11, low=4, high=6, seed=1), pattern(68, 11, low=-1, high=1, seed=2)
    section = predicted_attributes(small, {}, {}, (4,) * 6, grades=near)
    layer = make_layer(0, line(11), attributes=small, classes=near.tolist()).with_sections({ATTRIBUTE: section})
    what = "Activities so near each other that 2^(7 − c) in place of 2^(6 − c) gives other classes."
    yield "classes-staged-near", what, "8.7 8.9", make_file(layer)
    edge = np.full((68, 2), 2, np.int32)
    edge[0], edge[1], edge[2] = MAX_SYMBOL >> 6, -MAX_SYMBOL >> 6, [0, MAX_SYMBOL]
    centres = [0, 0, -MAX_SYMBOL, MAX_SYMBOL, *[0] * 64]
    edge[3] = [0, -MAX_SYMBOL]
    extremes = make_layer(0, line(2), attributes=edge, classes=[6, 0])
    yield (
        "classes-extremes",
        "The largest values and centres.",
        "11.2 11.5 14",
        make_file(extremes, header={16: centres}),
    )
    coded = make_layer(0, line(ROWS), attributes=k, classes=grades, mode=LZMA)
    yield "classes-lzma", "Step classes in mode lzma.", "6.4 8.5 9.1", make_file(coded, header={2: LZMA})
    wide = make_layer(0, line(ROWS), attributes=pattern(15, ROWS), classes=grades, widths=Widths(3, 2))
    yield "classes-other-widths", "Step classes and other widths.", "5.1 8.5 11.5", make_file(wide)


# -- priors ------------------------------------------------------------------------------------------------------------

ROWS = 40


def _with_priors(priors: dict[int, Prior], attributes: np.ndarray | None = None) -> File:
    k = pattern(68, ROWS) if attributes is None else attributes
    layer = make_layer(0, line(ROWS), attributes=k)
    return make_file(layer.with_sections({ATTRIBUTE: plain_attributes(k, priors)}))


def _of_widths(*highs: int) -> np.ndarray:
    """Attributes, the first channels -high..high, the others small."""
    k = pattern(68, ROWS)
    for c, high in enumerate(highs):
        k[c] = pattern(ROWS, low=-high, high=high, seed=c)
    return k


def _priors() -> Iterator[Case]:
    different = {c: gauss(-3 - c % 5, 7 + c % 11, si=16 * c - 160, offset=37 * c - 900) for c in range(0, 68, 2)}
    yield "prior-gauss", "Gaussian priors of many windows, means and widths.", "7.3 8.2", _with_priors(different)
    extremes = {c: gauss(-3, 7, si=si) for c, si in enumerate((SI_MIN, SI_MIN + 1, -1, 0, 511, 512, SI_MAX))}
    extremes[9] = gauss(-3, 7, si=SI_MAX, floor=16)
    extremes |= {7 + i: gauss(-3, 7, offset=g) for i, g in enumerate((-MU8_MAX, MU8_MAX))}
    yield "prior-gauss-extremes", "The least and largest widths and means.", "7.3 8.2", _with_priors(extremes)
    floors = {c: gauss(-20 - c % 2, 60, si=0, floor=(1, 16)[c // 2 % 2]) for c in range(16)}
    yield "prior-gauss-floors", "Both floors, symbols far out in the tails.", "7.3 8.2", _with_priors(floors)
    mixtures = {
        c: Mixture(Window(-9, 20), Normal(512 + 64 * c, 8 * c - 64), Normal(3000 - 9 * c, 128), weight, (1, 16)[c % 2])
        for c, weight in enumerate((1, 2, 64, 128, 254, 255))
    }
    yield "prior-mixture", "Mixtures of two Gaussians, the extremes of the weight.", "7.4 8.2", _with_priors(mixtures)
    highs = (7, 100, 5000, 1 << 16, 1 << 20, MAX_SYMBOL)
    wide: dict[int, Prior] = {
        0: gauss(-8, 8, si=100, shift=1),
        1: gauss(-100, 101, si=300, shift=1),
        2: gauss(-5000, 40, si=256, shift=8),
        3: Mixture(Window(-(1 << 16), 1025, 7), Normal(30000, 500), Normal(200000, 400), 100, 1),
        4: gauss(-(1 << 20), 1 << 10, si=700, shift=11),
        5: gauss(-MAX_SYMBOL, (1 << 12) + 1, si=700, shift=12),
    }
    yield (
        "prior-scaled",
        "Scaled priors, the least and largest shift.",
        "7.6 8.1 8.2 8.4",
        _with_priors(wide, _of_widths(*highs)),
    )
    windows: dict[int, Prior] = {
        0: gauss(0, 2),
        1: gauss(-8000, MAX_WINDOW, si=900),
        2: gauss(-8000, MAX_WINDOW, si=700, floor=16),
    }
    k = _of_widths(0, 8000, 8000)
    k[0] = pattern(ROWS, low=0, high=1)
    yield "prior-windows", "Windows of 2 and of 2^14 entries.", "7.2 8.2 14", _with_priors(windows, k)
    wide_tables = [gauss(-(MAX_WINDOW >> 1), MAX_WINDOW, si=200 + c) for c in range(14)]
    what = "Tables of 2^18 entries and one per symbol in one section."
    yield "prior-tables-at-limit", what, "8.2 14", tables_at_limit()
    many = Scale(32, (1, 1, 1, 1))
    deformed = make_layer(1, (), before=1, scales=[many])
    own = {3: dict(enumerate(wide_tables[:7])), 4: dict(enumerate(wide_tables))}
    section = staged_planes(list(deformed.meant.planes[0].values()), (1,) * 4, priors=own)
    yield (
        "prior-tables-per-stage",
        "Tables of more than 2^18 entries in all stages, not in any of them.",
        "8 8.8 14",
        make_file(make_layer(), deformed.with_sections({PLANE: section})),
    )
    yield "prior-constants", "A constant of its own per channel, to the largest symbols.", "8.1 8.2", _constants()
    four = [SMALL, gauss(-3, 7, si=10), gauss(-3, 7, si=20), Const(Window(1, 1))]
    k = pattern(68, ROWS)
    k[3::5] = 1
    reused = {c: (four[3] if c % 5 == 3 else four[c % 3]) for c in range(68)}
    yield (
        "prior-reuse",
        "Channels that refer to priors up to three definitions before the latest.",
        "8.1",
        _with_priors(reused, k),
    )
    far: dict[int, Prior] = {c: gauss(-3, 7, si=c) for c in range(67)}
    yield (
        "prior-reuse-farthest",
        "The last channel refers to the first of 67 definitions.",
        "8.1",
        _with_priors(far | {67: far[0]}),
    )
    again = {c: (gauss(-3, 7, si=5) if c % 2 else SMALL) for c in range(4)}
    section = plain_attributes(pattern(68, ROWS), again)
    layer = make_layer(0, line(ROWS), attributes=pattern(68, ROWS), codes=np.abs(pattern(ROWS)) + 3)
    yield (
        "prior-per-section",
        "Equal priors defined again in each section.",
        "8 8.1",
        make_file(layer.with_sections({ATTRIBUTE: section})),
    )


def tables_at_limit(more: bool = False) -> File:
    """A section of 16 windows of 2^14 entries, 2^18 in all, and one of as many as its symbols; and one of a single
    entry if there are to be more."""
    layer = make_layer(1, (), before=1, scales=[Scale(32, (1, 1, 1, 1))])
    channels = [c for plane in layer.meant.planes[0].values() for c in plane_channels(plane)]
    different: list[Prior] = [
        gauss(-(MAX_WINDOW >> 1), MAX_WINDOW, si=200 + c) for c in range(FREE_ENTRIES // MAX_WINDOW)
    ]
    different.append(gauss(-(len(channels) >> 1), len(channels)))
    priors = {c: different[c % len(different)] for c in range(len(channels))}
    if more:
        last = len(channels) - 1
        priors[last] = Const(Window(int(channels[last][0]), 1))
    return make_file(make_layer(), layer.with_sections({PLANE: plain_planes(channels, priors)}))


def _constants() -> File:
    k = np.repeat(np.arange(-34, 34, dtype=np.int32)[:, None], 2, axis=1)
    k[0], k[67] = -MAX_SYMBOL, MAX_SYMBOL
    return make_file(make_layer(0, line(2), attributes=k))


def _classes(top: int, count: int) -> np.ndarray:
    """count classes in 0..top: the extremes at the edges, the middle populated."""
    classes = pattern(count, low=0, high=top, seed=top)
    classes[0], classes[1], classes[-1] = 0, min(1, top), top
    return classes


def _histogram(d: int, top: int, count: int, differences: bool, si16: int = 20, m: int = 0) -> Hist:
    return Hist(Window(-3, count), d, top, differences, si16, m, _classes(top, count))


def _histograms() -> Iterator[Case]:
    for differences in (False, True):
        form = "differences" if differences else "classes"
        priors: dict[int, Prior] = {}
        for i, d in enumerate(CLASS_STEPS):
            for j, top in enumerate((1, 5, top_limit(d))):
                priors[3 * i + j] = _histogram(d, top, 7 + 2 * j, differences, 24 + 8 * j, 8 * top)
        sentence = f"Histograms coded as {form}, of every class step, from 1 to the most classes."
        yield f"prior-histogram-{form}", sentence, "7.5 8.2 8.4", _with_priors(priors)
    extremes: dict[int, Prior] = {
        0: _histogram(8, 5, 7, False, 0, 0),
        1: _histogram(8, 5, 7, False, 63, 16 * 5),
        2: _histogram(16, 31, 7, True, 0),
        3: _histogram(16, 31, 7, True, 63),
        4: Hist(Window(-3, 2), 64, 3, False, 30, 24, np.array([0, 3])),
    }
    k = pattern(68, ROWS)
    k[4] = pattern(ROWS, low=-3, high=-2)
    yield (
        "prior-histogram-extremes",
        "The least and largest parameters of the classes' own table.",
        "8.2",
        _with_priors(extremes, k),
    )
    many = np.full(MAX_WINDOW, 9)
    many[::37], many[5::1001] = 12, 1
    wide: dict[int, Prior] = {
        0: Hist(Window(-500, 1000), 8, 40, False, 30, 300, pattern(1000, low=0, high=40)),
        1: Hist(Window(-8000, MAX_WINDOW), 32, 12, True, 4, 0, many),
    }
    k = _of_widths(490, 8000)
    yield "prior-histogram-widest", "Histograms of 1000 and of 2^14 entries.", "7.5 8.2", _with_priors(wide, k)
    below = {0: Hist(Window(-3, 7), 8, 9, False, 20, 40, np.array([2, 3, 0, 1, 4, 0, 2]))}
    yield "prior-histogram-below-top", "No entry has the largest class.", "7.5 8.2", _with_priors(below)
    scaled: dict[int, Prior] = {0: Hist(Window(-5000, 40, 8), 16, 9, True, 20, 0, _classes(9, 40))}
    yield "prior-histogram-scaled", "A scaled histogram.", "8.1 8.4", _with_priors(scaled, _of_widths(5000))


def _exceptions() -> Iterator[Case]:
    k = pattern(68, ROWS)
    k[0, [0, 7, 39]] = 90000, -MAX_SYMBOL, MAX_SYMBOL
    k[1, :20] = 12
    k[2, 39] = -4
    priors: dict[int, Prior] = {
        0: SMALL,
        1: SMALL,
        2: gauss(-3, 20, si=100),
        3: gauss(K_MAX - 1, 2),
        4: Const(Window(-K_MAX, 1)),
    }
    priors[5] = Const(Window(K_MAX, 1))
    sentence = "Symbols outside their windows: first, last, in a row, all of a channel; windows at the largest symbols."
    yield "exceptions", sentence, "8.3 8.4", _with_priors(priors, k)
    wide = _of_widths(600)
    wide[0, [3, 4]] = -9000, 9000
    yield (
        "exceptions-scaled",
        "Exceptions beside a scaled prior.",
        "8.3 8.4",
        _with_priors({0: gauss(-600, 76, shift=4)}, wide),
    )
    ends = np.array([MAX_SYMBOL, 1 - MAX_SYMBOL], np.int32)  # residuals of the left predictor: 2^23 and -K, and back
    scale = Scale(
        1, (2, 1, 1, 1), (1, 1, 0, 0, 0, 0), lambda name, shape: np.resize(ends[:: -1 if name == "xz" else 1], shape)
    )
    plane = make_layer(1, (), before=1, scales=[scale])
    residuals = [[MAX_SYMBOL, -K_MAX], [1 - MAX_SYMBOL, K_MAX], ends, [MAX_SYMBOL], [MAX_SYMBOL], [MAX_SYMBOL]]
    section = plain_planes(residuals, dict.fromkeys(range(6), SMALL))
    largest = make_file(make_layer(), plane.with_sections({PLANE: section}))
    yield "exceptions-extremes", "Exceptions of K and -K.", "8.3 14", largest
    reuse = pattern(68, ROWS)
    reuse[:, 5] = 50
    yield (
        "exceptions-reuse",
        "Exceptions of a channel that refers to an earlier prior.",
        "8.1 8.3",
        _with_priors(dict.fromkeys(range(68), SMALL), reuse),
    )


# -- attributes --------------------------------------------------------------------------------------------------------


def _attributes() -> Iterator[Case]:
    k = pattern(68, ROWS)

    def predicted(terms, splits, k=k, classes=ONE_CLASS) -> File:
        layer = make_layer(0, line(len(k[0])), attributes=k)
        return make_file(layer.with_sections({ATTRIBUTE: predicted_attributes(k, terms, splits, classes)}))

    yield "predicted-nothing", "Form 1 without terms or splits.", "8.5 8.6", predicted({}, {})
    ladder = {c: [(j, 97 * c - 1800 + 31 * j) for j in range(c % 7, c, 5)] for c in range(1, 38)}
    yield (
        "predicted-terms",
        "Terms in nearly every channel, predictions of both signs.",
        "8.6 8.7",
        predicted(ladder, {}),
    )
    most = {37: [(j, (1 << 15) * (-1) ** j) for j in range(37)], 1: [(0, -(1 << 15))], 3: [(2, 1 << 15)]}
    yield (
        "predicted-terms-extremes",
        "All terms a channel may have, the largest weights.",
        "8.6 14",
        predicted(most, {}),
    )
    halves = k.copy()
    halves[0] = np.resize([-3, -1, 1, 3, 0, -2, 2], ROWS)
    yield (
        "predicted-halves",
        "Predictions that lie half-way between symbols.",
        "8.7",
        predicted({c: [(0, 512)] for c in range(1, 38)}, {}, halves),
    )
    flags = {i: (i % 4, i - 4, 5 - i) for i in range(10)}
    yield "predicted-splits", "Offsets split by x, by x and y, and not at all.", "8.6 8.7", predicted({}, flags)
    distant = {0: (3, K_MAX, -K_MAX), 1: (3, -K_MAX, K_MAX), 2: (1, 0, 0), 3: (2, 0, 0)}
    yield (
        "predicted-split-centres",
        "The extremes of the centres; classes without a symbol.",
        "8.6 8.7",
        predicted({}, distant),
    )
    yield "predicted-both", "Terms and splits together.", "8.6 8.7", predicted(ladder, flags)
    spread = pattern(68, 2, low=-40, high=40)
    yield "predicted-two-anchors", "More classes than symbols.", "8.7", predicted(ladder, flags, spread)
    lively = pattern(68, ROWS) * (np.arange(ROWS) % 5)  # rows of different activity
    yield "staged-classes", "Channels split by activity.", "8.7 8.9", predicted({}, {}, lively, (3, 5, 8, 2, 7))
    yield "staged-all", "Terms, splits and classes.", "8.6 8.7 8.9", predicted(ladder, flags, lively, (8, 3, 1, 6, 4))
    few = predicted(ladder, flags, spread, (8,) * 5)
    yield "staged-two-anchors", "More classes than anchors.", "8.9", few
    fractions = pattern(68, ROWS, seed=1)
    yield (
        "staged-fractions",
        "Classes that hang on the floor of each quotient, not on that of their sum.",
        "8.9",
        predicted({}, {}, fractions, (8,) * 5),
    )
    large = pattern(68, 12)
    large[:6] = pattern(6, 12, low=-MAX_SYMBOL, high=MAX_SYMBOL)
    yield (
        "staged-extremes",
        "Activities of the largest symbols.",
        "8.9 14",
        predicted({}, {}, large, (8, 3, 5, 2, 4)),
    )
    still = np.full((68, ROWS), 0, np.int32)
    yield (
        "staged-no-activity",
        "Every activity is 0: all rows are of the last class.",
        "8.9",
        predicted({}, {}, still, (8,) * 5),
    )
    full = np.full((68, 2), MAX_SYMBOL, np.int32)
    full[::2] *= -1
    yield (
        "attributes-extremes",
        "The largest symbols of every attribute.",
        "11.2 14",
        make_file(make_layer(0, line(2), attributes=full)),
    )


# -- planes ------------------------------------------------------------------------------------------------------------


def _planes() -> Iterator[Case]:
    names = ("none", "left", "up", "median", "gradient", "average")

    def deformed(scales: list[Scale], **fields) -> File:
        return make_file(make_layer(), make_layer(1, (), before=1, scales=scales, **fields))

    for p, name in enumerate(names):
        smooth = Scale(2, (5, 4, 3, 6), (p,) * 6, lambda name, shape: pattern(*shape, low=-50, high=50, seed=len(name)))
        yield f"planes-{name}", f"Predictor {p} on every plane.", "11.3", deformed([smooth])
    mixed = [Scale(1, (4, 1, 1, 5), (0, 1, 2, 3, 4, 5)), Scale(1, (1, 7, 2, 1), (5, 4, 3, 2, 1, 0))]
    yield (
        "planes-mixed",
        "A predictor of its own per plane; planes of one row, one column, one cell.",
        "6.3 11.3",
        deformed(mixed),
    )
    lone = [Scale(1, (1, 1, 1, 1), (p,) * 6) for p in range(6)]
    yield "planes-one-cell", "Planes of one cell under each predictor.", "11.3", deformed(lone)

    def steep(name: str, shape: tuple[int, ...]) -> np.ndarray:
        corner = np.indices(shape)[1:].sum(axis=0) % 2
        return np.where(corner == 0, MAX_SYMBOL, 1 - MAX_SYMBOL).astype(np.int32)

    edge = Scale(1, (2, 2, 2, 2), (1, 2, 1, 2, 1, 2), steep)
    yield "planes-extremes", "The largest samples, with residuals of the largest symbols.", "11.3 14", deformed([edge])
    for channels, counts in ((1, ()), (2, ()), (3, (3,)), (5, (8, 2)), (9, (1, 5, 8))):
        uneven = Scale(
            channels, (5, 4, 1, 3), (0,) * 6, lambda name, s: pattern(*s) * (np.arange(np.prod(s)).reshape(s) % 4)
        )
        layer = make_layer(1, (), before=1, scales=[uneven])
        section = staged_planes([p for p in layer.meant.planes[0].values()], counts)
        file = make_file(make_layer(), layer.with_sections({PLANE: section}))
        yield f"planes-staged-{channels}", f"{channels} plane channels in stages.", "8.8 8.9", file
    yield (
        "planes-products-over-2-53",
        "A relative magnitude whose product is over 2^53 and whose quotient lies just below an integer.",
        "8.9",
        _large_products(),
    )
    flat = Scale(1, (MAX_PLANE_SIDE, 1, 1, 2), (0,) * 6, lambda name, shape: np.full(shape, 1, np.int32))
    yield "planes-longest", "A side of 4096 cells.", "6.3 14", deformed([flat])
    many = Scale(MAX_PLANE_CHANNELS, (1, 1, 1, 1), (0,) * 6)
    yield "planes-most-channels", "256 channels.", "6.3 14", deformed([many])
    yield "planes-most-scales", "Eight scales.", "6.3 14", deformed([Scale(1, (s, 1, 1, 1)) for s in range(1, 9)])
    deep = {0: tuple(range(1, MAX_NETWORK_LAYERS + 1)), 1: (3,)}
    yield "networks-deepest", "A trunk of 16 linear layers.", "6.3 14", deformed([Scale()], networks=deep)
    wide = make_layer(networks={0: (10,), 1: (70,), 2: (MAX_NETWORK_WIDTH, 30)})
    yield "networks-widest", "A hidden layer of 4096 outputs.", "6.3 14", make_file(wide)
    least = {0: (1,), 5: (3,)}
    last = make_layer(2, (), before=1, scales=[Scale(1, (1, 1, 1, 1))], networks=least)
    yield "networks-least", "A trunk of one output and the last head alone.", "6.3", make_file(make_layer(), last)
    yield "networks-weights", "Weights and biases of many symbols.", "11.4", make_file(_with_weights())
    yield "symbols-at-limit", "As many constant symbols as the payload may declare.", "6.5", symbols_at_limit()


def _large_products() -> File:
    """Plane xy of 4096 by 521 cells, N in all. In channel 0 the sum of all magnitudes is M − 1, and 256·N·E + 1 is a
    multiple of M: the quotient of E is its integer less 1 / M, which binary64 cannot tell from the integer. Magnitudes
    of E + 1 make up more than an eighth of the cells around them, so they are of the last class, and E is not."""
    height, width, total, e = 521, MAX_PLANE_SIDE, 549756251549, 16669554
    product = 256 * height * width * e
    assert product % total == total - 1 and int(product / total) == product // total + 1
    residuals = np.zeros((3, height, width), np.int64)
    residuals[0, 0, 0] = -MAX_SYMBOL  # from here every other magnitude leads up, and the next one down
    left = total - 1 - MAX_SYMBOL
    places = itertools.product(range(3, height - 1, 3), range(20, 20 * 204 + 1, 20))
    pairs = zip(*[iter(places)] * 2, strict=False)
    for (i, j), (same, k) in pairs:
        size = e if i == 252 and j == 20 * 51 else e + 1
        if i != same or left < 2 * size:
            continue
        residuals[0, i, [j, k]] = size, -size
        left -= 2 * size
    for i in (1, 2):  # the rest, where nothing follows in its row
        residuals[0, height - i, width - 1] = min(left, e)
        left -= min(left, e)
    assert left == 0
    residuals[2] = classes_of_plane(residuals[:2], 8) == 7
    samples = restore([(1, residuals.astype(np.int32))])[0]
    zeros = np.zeros((3, 1, 1), np.int32)
    sides, predictors = (width, height, 1, 1), (1, *[0] * 5)
    scale = Scale(3, sides, predictors, lambda name, shape: samples if name == "xy" else np.broadcast_to(zeros, shape))
    layer = make_layer(1, (), scales=[scale])
    others = list(layer.meant.planes[0].values())[1:]
    section = staged_planes([residuals, *others], (8,), priors={0: {0: Const(Window(0, 1))}})
    return make_file(make_layer(cells=()), layer.with_sections({PLANE: section}))


def _with_weights() -> Layer:
    networks = {}
    for name, outputs in (("opacity", 10), ("covariance", 70), ("color", 30)):
        weight = np.zeros((outputs, 35), np.int32)
        weight[:, :4] = pattern(outputs, 4, low=-9, high=9, seed=outputs)
        networks[name] = ((weight, pattern(outputs, low=-MAX_SYMBOL, high=MAX_SYMBOL, seed=outputs)),)
    return make_layer(networks=networks)


def symbols_at_limit(over: int = 0, rows: int = 0, graded: bool = False) -> File:
    """As many constant channels as clause 6.5 allows a file, or `over` more, and `rows` anchors in either layer, which
    may have step classes."""
    classes = [1] * rows if graded else None
    plane = Scale(1, (2048, 1920, 1, 1), (0,) * 6, lambda name, shape: np.full(shape, 1, np.int32))

    def layer(first: int, second: int, hidden: int) -> Layer:
        networks = {0: (first, second), 1: (hidden, 3)}
        return make_layer(1, line(rows, z=5), before=rows, scales=[plane], networks=networks, classes=classes)

    below = make_layer(cells=line(rows), classes=classes)
    size = len(below.payload()) + len(layer(300, 300, 1).payload())  # the same while no width takes more bytes
    spent = sum(a.size for a in below.meant.arrays()) + (2048 * 1920 + 2 * (2048 + 1920) + 1) + (73 + graded) * rows
    weights = FREE_SYMBOLS + SYMBOLS_PER_BYTE * size + over - spent
    for first, hidden in itertools.product(range(256, 400), range(1, 100)):
        # weights = (1 + 1) first + (first + 1) second + (second + 1) hidden + (hidden + 1) 3
        second, rest = divmod(weights - 3 - 2 * first - 4 * hidden, first + 1 + hidden)
        if rest == 0 and second >= 256:
            return make_file(below, layer(first, second, hidden))
    raise AssertionError("no widths reach the limit")


def rows_at_limit(over: int = 0) -> File:
    """As many anchors as clause 6.5 allows a payload of 600 bytes, or `over` more."""
    size = 600
    layer = make_layer(0, line(FREE_ROWS + ROWS_PER_BYTE * size + over))
    bare = layer.payload()
    payload = layer.padded(struct.unpack_from("<I", bare)[0] + size - len(bare))
    return make_file(layer).with_payload(0, payload)


# -- positions ---------------------------------------------------------------------------------------------------------


def _positions() -> Iterator[Case]:
    def at(cells) -> File:
        return make_file(make_layer(0, ordered(cells)))

    far = 1 << 20
    yield (
        "positions-corners",
        "The largest box: 2^21 voxels along every axis.",
        "10.1 14",
        at([[-far] * 3, [far - 1] * 3]),
    )
    yield "positions-least-index", "One anchor at the least voxel index.", "10.1 14", at([[-far] * 3])
    yield "positions-largest-index", "One anchor at the largest voxel index.", "10.1 14", at([[far] * 3])
    example = [[5, 7, 1], [6, 7, 1], [6, 8, 1], [5, 7, 3]]
    yield "positions-example", "The worked example.", "10.4 10.2 10.3", at(example)
    yield "positions-line", "A line.", "10.2 10.3", at(line(40))
    yield (
        "positions-uneven-box",
        "A box of other bit lengths.",
        "10.1",
        at([[i % 4, i * 37 % 400, i * 11 % 30] for i in range(50)]),
    )
    yield (
        "positions-full-box",
        "Every voxel of a box: all nodes have eight children.",
        "10.3",
        at(list(itertools.product(range(8), repeat=3))),
    )
    around = range(-14, 15)
    sphere = [c for c in itertools.product(around, around, around) if abs(c[0] ** 2 + c[1] ** 2 + c[2] ** 2 - 180) < 14]
    yield "positions-sphere", "A sphere: dense levels.", "10.2 10.3", at(sphere)
    scattered = pattern(300, 3, low=-(1 << 14), high=1 << 14).tolist()
    yield "positions-scattered", "Scattered voxels: levels with as many nodes as anchors.", "10.2 10.3", at(scattered)
    every = [
        [2 * (byte % 16) + (c & 1), 2 * (byte // 16) + (c >> 1 & 1), c >> 2]
        for byte in range(1, 256)
        for c in range(8)
        if byte >> c & 1
    ]
    yield "positions-every-pattern", "Nodes with every set of children.", "10.3", at(every)
    chain = [[v, v // 3, v // 5] for v in (0, 1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1023)]
    yield "positions-chain", "Nodes with two children, one of which has two again.", "10.2 10.3", at(chain)
    second = make_layer(1, ordered([[i, 1, 0] for i in range(5)]), before=5)
    yield (
        "positions-two-layers",
        "Neighbouring voxels in two layers.",
        "10.1 12.1",
        make_file(make_layer(0, line(5)), second),
    )


# -- LZMA --------------------------------------------------------------------------------------------------------------


def _lzma() -> Iterator[Case]:
    mode = {2: LZMA}

    def of(layers: list[Layer], **how) -> File:
        written = [x.with_sections({SYMBOLS: lzma_symbols(x.channels, **how)}) for x in layers]
        return make_file(*written, header=mode)

    fields: dict = dict(mode=LZMA, attributes=pattern(68, 3))
    layers = [make_layer(0, line(3), **fields), make_layer(1, line(3, z=2), before=3, scales=[Scale()], **fields)]
    yield "lzma-stored", "Stored LZMA2 chunks.", "9.1", of(layers)
    yield "lzma-packed", "A compressed LZMA2 chunk.", "9.1", of(layers, stream=lzma2.packed)
    yield (
        "lzma-planes",
        "Byte planes, four bytes a number.",
        "9.1",
        of(layers, stream=lzma2.packed, planar=True, width=2),
    )
    yield "lzma-two-bytes", "Two bytes a number.", "9.1", of(layers, stream=lzma2.packed, width=1)
    yield "lzma-base", "A base of its own under every channel.", "9.1", of(layers, base=-100, stream=lzma2.packed)
    wide = pattern(68, 3, low=-MAX_SYMBOL, high=MAX_SYMBOL)
    wide[0] = MAX_SYMBOL
    large = [make_layer(0, line(3), mode=LZMA, attributes=wide)]
    yield (
        "lzma-extremes",
        "The largest symbols, from the largest base.",
        "9.1",
        of(large, base=K_MAX, width=2, stream=lzma2.packed),
    )
    empty = make_layer(0, (), mode=LZMA)
    yield (
        "lzma-empty-scene",
        "No anchors: the networks under LZMA.",
        "6.4 9.1",
        make_file(empty, make_layer(1, (), mode=LZMA), header=mode),
    )
    far = np.full((68, 1100), 2, np.int32)
    far[0] = far[67] = pattern(1100)
    long = make_layer(0, line(1100), mode=LZMA, attributes=far)
    stream = [long.with_sections({SYMBOLS: lzma_symbols(long.channels, width=0, stream=lzma2.packed)})]
    yield (
        "lzma-dictionary",
        "More than 2^16 bytes, of which the last repeat the first.",
        "9.1",
        make_file(*stream, header=mode),
    )
    phrases = [pattern(9, low=0, high=9, seed=s).tolist() for s in range(6)]
    text = [n for s in pattern(400, low=0, high=5, seed=8) for n in [*phrases[s][: 4 + s], int(s)]]
    told = make_layer(0, line(40), mode=LZMA, attributes=np.resize(text, (68, 40)).astype(np.int32))
    yield (
        "lzma-chunks",
        "LZMA2 chunks of every control byte, other properties, all repeated distances.",
        "9.3 9.1",
        make_file(
            told.with_sections({SYMBOLS: lzma_symbols(told.channels, width=0, stream=_every_chunk)}), header=mode
        ),
    )
    note = layers[0].sections[SYMBOLS]
    noted = layers[0].with_sections({SYMBOLS: b"\xe0" + note[1:]})
    yield "lzma-note", "The unused first byte at its largest value.", "9.1", make_file(noted, header=mode)


def _every_chunk(data: bytes) -> bytes:
    properties = [lzma2.Properties(*p) for p in ((3, 0, 2), (0, 4, 0), (2, 1, 3), (1, 3, 1))]
    controls = [
        *(lzma2.ALL_RESET, lzma2.KEPT, lzma2.STORED, lzma2.KEPT, lzma2.STATE, lzma2.PROPERTIES_READ, lzma2.STORED),
        *(lzma2.STORED, lzma2.STATE, lzma2.ALL_RESET, lzma2.KEPT, lzma2.STORED_RESET, lzma2.STORED),
        *(lzma2.PROPERTIES_READ, lzma2.KEPT),
    ]
    sizes = [211 + 7 * i for i in range(len(controls) - 1)]
    plan = list(zip(controls, [*sizes, len(data) - sum(sizes)], strict=True))
    return lzma2.chunks(data, plan, properties, every_repeat=True)


def _floats() -> Iterator[Case]:
    raw = {3: FLOAT32}
    for mode, name in ((0, "ans"), (LZMA, "lzma")):
        first = make_layer(mode=mode)
        second = make_layer(1, [[3, 0, 0]], before=1, scales=[Scale()], raw=True, mode=mode)
        sentence = f"Planes and weights of a deformation as float32 values, mode {name}."
        yield f"float32-{name}", sentence, "6.4 9.2", make_file(first, second, header=raw | {2: mode})
    odd = np.array([0.0, -0.0, 2.0**-149, -LEAST_NORMAL, LARGEST, -LARGEST, 1 / 3, 0.1], np.float32)
    layer = make_layer(1, (), before=1, scales=[Scale()], raw=True)
    for scale in layer.meant.planes:
        for plane in scale.values():
            plane.reshape(-1)[:] = np.resize(odd, plane.size)
    floats = lzma_floats(list(layer.meant.tensors()), planar=True, stream=lzma2.packed)
    planar = layer.with_sections({FLOATS: b"\xe0" + floats[1:]})
    yield (
        "float32-extremes",
        "Signed zeros, subnormals and the largest values; byte planes; the largest first byte.",
        "9.2",
        make_file(make_layer(), planar, header=raw),
    )
    bare = make_layer(1, [[3, 0, 0]], before=1)
    yield (
        "float32-without-deformation",
        "Deformation 1 in a file without one.",
        "6.4",
        make_file(make_layer(), bare, header=raw),
    )


# -- ranges ------------------------------------------------------------------------------------------------------------


def _ranges() -> Iterator[Case]:
    codes = list(range(3, 256))
    raised = make_layer(1, (), before=253, rises=[255 - code for code in codes])
    yield (
        "masks-all-codes",
        "Every code of an own row, each raised to 255.",
        "11.1",
        make_file(make_layer(0, line(253), codes=codes), raised),
    )
    still = make_layer(2, (), before=253, rises=[0] * 253)
    yield "masks-no-rise", "Rises of 0 alone.", "11.1", make_file(make_layer(0, line(253), codes=codes), still)
    bounds = {6: [1.0, 2.0, 3.0] * 2, 7: [4.0, 4.0], 8: [1.0, 0.0, 1.0], 9: [0.0, 2.0**-149], 10: [0.0] * 3, 11: 0.0}
    yield (
        "header-bounds",
        "A box of no size, no time, near 0, no up and an unknown unit.",
        "5.1",
        make_file(make_layer(), header=bounds),
    )
    far = {
        6: [-LARGEST] * 3 + [LARGEST] * 3,
        7: [-LARGEST, LARGEST],
        9: [LEAST_NORMAL, LARGEST],
        10: [LARGEST] * 3,
        11: LARGEST,
    }
    yield "header-largest-reals", "The largest reals in the header.", "4 5.1", make_file(make_layer(), header=far)
    zero, largest = dict.fromkeys(range(8), 0.0), dict.fromkeys(range(8), LARGEST)
    base = {key: bound for key, bound in zero.items() if key < 4}
    yield "bounds-zero", "Error bounds of 0.", "5.4", three_layers(header={13: zero})
    yield "bounds-negative-zero", "Error bounds of −0.", "5.4", three_layers(header={13: dict.fromkeys(zero, -0.0)})
    yield "bounds-largest", "The largest error bounds.", "5.4", three_layers(header={13: largest})
    yield (
        "bounds-of-layer-0",
        "No error bounds but those of layer 0.",
        "5.4",
        make_file(make_layer(), header={13: base}),
    )
    flat = make_file(make_layer(0, line(2)), make_layer(1, (), before=2), make_layer(2, [[0, 0, 1]], before=2))
    yield (
        "bounds-without-deformations",
        "No error bounds but those of layer 0, as neither layer 1 nor layer 2 has a deformation.",
        "5.4",
        flat.with_header({13: base}),
    )
    negative = {6: [-0.0] * 6, 7: [-0.0, 0.0], 8: [-0.0] * 3, 9: [-0.0, 1.0], 11: -0.0}
    yield "header-negative-zeros", "Negative zeros in the header.", "4 5.1", make_file(make_layer(), header=negative)
    edge = {1: [-LARGEST] * 12, 2: [LEAST_NORMAL, LARGEST, -1.0, 0.0], 3: 65535, 4: 1}
    yield "camera-bounds", "A camera of the extreme sizes and reals.", "5.3", make_file(make_layer(), header={12: edge})
    rounded = {4: [float(np.float32(v)) for v in (0.1, 0.3, 0.7)], 5: float(np.float32(0.01))}
    k = pattern(68, 3, low=-MAX_SYMBOL, high=MAX_SYMBOL, seed=9)
    layer = make_layer(
        0, ordered([[-99991, 7, 1 << 20], [3, 3, 3], [1, 2, 77777]]), attributes=k, steps=[float(np.float32(1e-3))]
    )
    everywhere = dict.fromkeys(range(68), gauss(-MAX_SYMBOL, (1 << 13) + 1, si=900, shift=11))
    yield (
        "dequantise-rounding",
        "Steps whose multiples are rounded to binary32.",
        "11.5",
        make_file(layer.with_sections({ATTRIBUTE: plain_attributes(k, everywhere)}), header=rounded),
    )
    ties = {4: [1.0 + 2.0**-23, 3.0 * 2.0**-3, 2.0**-126 * 1.5]}
    close = (1 << 23) - np.arange(68 * 3, dtype=np.int32).reshape(68, 3)
    yield (
        "dequantise-ties",
        "Products half-way between two binary32 values.",
        "11.5",
        make_file(make_layer(0, line(3), attributes=close), header=ties),
    )
    least = {4: [LEAST_NORMAL] * 3, 5: LEAST_NORMAL}
    small = pattern(68, 3, low=-2, high=2)
    tiny = make_layer(0, line(3), attributes=small, steps=[LEAST_NORMAL])
    yield "dequantise-least-steps", "The least steps and voxel size.", "5.1 11.5", make_file(tiny, header=least)
    most = {4: [LARGEST] * 3, 5: LARGEST}
    signs = pattern(68, 2, low=-1, high=1)
    ones = {name: tuple((np.sign(w), np.sign(b)) for w, b in n) for name, n in make_layer().meant.networks.items()}
    huge = make_layer(0, line(2), attributes=signs, networks=ones, steps=[LARGEST])
    yield "dequantise-largest-steps", "The largest steps and voxel size.", "5.1 11.5", make_file(huge, header=most)
