"""Writes `.pd4` structures from explicit choices, right or wrong ones.

Nothing here searches, fits or rounds: every prior, form, predictor and field is named by the caller or follows from
the symbols by a rule on integers, so the bytes are the same on every machine. Lengths, scene ids and CRCs are right
unless a caller asks for others.
"""

from __future__ import annotations

import hashlib
import itertools
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pd4dgs_codec.entropy.ans import ans_encode
from pd4dgs_codec.entropy.positions import position_channels
from pd4dgs_codec.entropy.priors import (
    FIRST_REUSE,
    Const,
    Gauss,
    Hist,
    Normal,
    Prior,
    Window,
    family_code,
    write_prior,
)
from pd4dgs_codec.entropy.tables import uniform_table
from pd4dgs_codec.entropy.varint import put_varint, put_zigzag
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.container import MAJOR, SCENE_ID_SIZE, SIGNATURE, slice_flags
from pd4dgs_codec.format.header import payload_digest
from pd4dgs_codec.format.kinds import LAYER_KINDS
from pd4dgs_codec.format.layer_meta import Section
from pd4dgs_codec.format.planes import residual
from pd4dgs_codec.format.quantise import dequantise
from pd4dgs_codec.format.symbols import LayerSymbols, merged
from pd4dgs_codec.format.table import NO_CLASSES, Grid
from pd4dgs_codec.scene import ATTRIBUTES, DEFAULT_WIDTHS, PLANES, Widths

from . import lzma2

POSITIONS, MASKS, ATTRIBUTE, PLANE, WEIGHTS, SYMBOLS = (int(s) for s in Section)
FLOATS, LOW_BITS = 6, 7  # left with draft 3: the vectors that use them go next
ANS, LZMA = 0, 1
CODED, FLOAT32 = 0, 1
WEIGHT_SHIFT, CLASSES_Y, CLASSES_Z = 10, 5, 7  # clause 8.7

#: Clause 5.4, of all classes: a file may declare bounds of what it does not hold.
ERROR_BOUNDS: dict[int, object] = {
    0: 0.03125,
    1: 0.015625,
    2: 0.0625,
    3: 2.0**-8,
    4: 0.25,
    5: 2.0**-9,
    6: 0.5,
    7: 2.0**-10,
}
HEADER: dict[int, object] = {
    2: ANS,
    4: [0.0625, 0.03125, 0.125],
    5: 2.0**-7,
    6: [-1.0, -2.0, -3.0, 1.0, 2.0, 3.0],
    7: [0.5, 3.25],
    8: [0.0, 0.5, 1.0],
    9: [0.125, 64.0],
    10: [0.0, -1.0, 0.0],
    11: 1.5,
    13: ERROR_BOUNDS,
    15: [32, 10],
}
CAMERA: dict[int, object] = {
    1: [1.0, 0.0, 0.0, 0.25, 0.0, 0.0, -1.0, 0.5, 0.0, 1.0, 0.0, 4.0],
    2: [500.0, 501.0, 320.0, 240.0],
    3: 640,
    4: 480,
}


# -- primitives --------------------------------------------------------------------------------------------------------


def varint(value: int) -> bytes:
    """Clause 7.1."""
    out = bytearray()
    put_varint(out, value)
    return bytes(out)


def zigzag(value: int) -> bytes:
    """Clause 7.1."""
    out = bytearray()
    put_zigzag(out, value)
    return bytes(out)


def words(*values: int) -> bytes:
    """u32 words of an ANS stream."""
    return struct.pack(f"<{len(values)}I", *values)


def pattern(*shape: int, low: int = -3, high: int = 3, seed: int = 0) -> np.ndarray:
    """int32 of `shape` in low..high that look irregular: a Lehmer generator's upper bits."""
    state, values = seed * 7919 + 12345, []
    for _ in range(int(np.prod(shape))):
        state = state * 48271 % (2**31 - 1)
        values.append(low + (state >> 8) % (high - low + 1))
    return np.array(values, np.int32).reshape(shape)


# -- coded channels (clause 8) -----------------------------------------------------------------------------------------


def gauss(low: int, n: int, *, si: int = 64, offset: int = 0, floor: int = 1, shift: int = 0) -> Gauss:
    """A Gaussian prior over the window; its mean lies `offset` / 256 entries above the window's middle."""
    return Gauss(Window(low, n, shift), Normal(offset + 128 * (n - 1), si), floor)


SMALL = gauss(-3, 7)


def default_prior(symbols: np.ndarray) -> Prior:
    """The prior that stands where a vector is about something else: by range, on integers."""
    low, high = int(symbols.min()), int(symbols.max())
    if low == high:
        return Const(Window(low, 1))
    if -3 <= low and high <= 3:
        return SMALL
    shift = max(0, (high - low).bit_length() - 14)
    n = max(2, ((high - low) >> shift) + 1)
    return gauss(low, n, si=64 * n.bit_length() - 128, shift=shift)


Known = list[tuple[bytes, bytes]]


class Channels:
    """A section of coded channels, one `add` per channel. known: the priors of slices before, which it adds to."""

    def __init__(self, known: Known | None = None) -> None:
        self.block = bytearray()
        self._defined = [] if known is None else known
        self._tables: list[Hist] = []
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, symbols: Iterable[int], prior: Prior | None = None) -> Channels:
        """Symbols outside the prior's window become exceptions; a prior defined before is referred to."""
        k = np.asarray(symbols, np.int64)
        if not k.size:
            return self
        prior = prior or default_prior(k)
        window = prior.window
        inside = (k >= window.kmin) & (k < window.end)
        self._write_prior(prior, listed=not inside.all())
        if not inside.all():
            self._write_exceptions(k, inside, window)
        entries = k[inside] - window.kmin
        self._parts.append((entries >> window.shift, prior.cum))
        if window.shift:
            self._parts.append((entries & ((1 << window.shift) - 1), uniform_table(window.shift)))
        return self

    def _write_prior(self, prior: Prior, listed: bool) -> None:
        parameters = bytearray()
        write_prior(parameters, prior)
        classes = np.asarray(prior.classes).tobytes() if isinstance(prior, Hist) else b""
        key = (bytes([family_code(prior)]) + parameters, classes)
        if key in self._defined:
            back = self._defined[::-1].index(key)
            self.block += varint(2 * (FIRST_REUSE + back) + listed)
            return
        self.block += varint(2 * family_code(prior) + listed) + parameters
        self._defined.append(key)
        if isinstance(prior, Hist):
            self._tables.append(prior)

    def _write_exceptions(self, k: np.ndarray, inside: np.ndarray, window: Window) -> None:
        places = np.flatnonzero(~inside).tolist()
        self.block += varint(len(places) - 1)
        for last, at in zip([-1, *places], places, strict=False):
            value = int(k[at])
            self.block += varint(at - last - 1)
            self.block += varint(2 * (window.kmin - 1 - value) + 1 if value < window.kmin else 2 * (value - window.end))

    def done(self) -> bytes:
        """The parameter block and the ANS stream."""
        parts = [(table.class_symbols, table.class_cum) for table in self._tables] + self._parts
        return bytes(self.block) + ans_encode([symbols for symbols, _ in parts], [cum for _, cum in parts])


def coded(
    channels: Iterable[Iterable[int]], priors: Mapping[int, Prior] | None = None, known: Known | None = None
) -> bytes:
    """A section of coded channels; `priors` names those of some channels by their number."""
    section = Channels(known)
    for number, channel in enumerate(channels):
        section.add(channel, (priors or {}).get(number))
    return section.done()


def positions(cells: np.ndarray, known: Known | None = None) -> bytes:
    """Section POSITIONS of cells int32 [n, 3] in Morton order (clause 10)."""
    head, channels = position_channels(cells)
    return head + coded(channels, known=known)


def plain_attributes(
    k: np.ndarray,
    priors: Mapping[int, Prior] | None = None,
    known: Known | None = None,
    *,
    classes: np.ndarray = NO_CLASSES,
) -> bytes:
    """Section ATTRIBUTES of int32 [channels, n], form 0 (clause 8.5)."""
    if not classes.size:
        return b"\0" + coded(k, priors, known)
    by_class = [channel[classes == c] for channel in k for c in range(7)]
    return b"\0" + graded_part(classes) + coded(by_class, priors, known)


def graded_part(classes: np.ndarray, length: int | None = None) -> bytes:
    """What says the step classes of the rows; nothing where there are none. length: what is said instead of the true
    one."""
    if not classes.size:
        return b""
    section = coded([classes])
    return varint(len(section) if length is None else length) + section


def plain_planes(residuals: Iterable[Iterable[int]], priors: Mapping[int, Prior] | None = None) -> bytes:
    """Section PLANES of the channels of all planes, form 0 (clause 8.8)."""
    return b"\0" + coded(residuals, priors)


def relative_magnitude(e: np.ndarray, of: np.ndarray | None = None) -> np.ndarray:
    """int64 [n] of residuals int64 [m, n], N and s_c those of the residuals `of` if given (clause 8.9)."""
    of = e if of is None else of
    sums = [int(abs(c).sum()) for c in of]
    parts = (np.minimum(abs(c), s) * 256 * of.shape[1] // (1 + s) for c, s in zip(e, sums, strict=True))
    return sum(parts, np.zeros(e.shape[1], np.int64))


def classes_by_activity(activity: np.ndarray, count: int, of: np.ndarray | None = None) -> np.ndarray:
    """The class of each place, 0 .. count − 1, by the bounds of the activity `of` if given (clause 8.9)."""
    of = activity if of is None else of
    return np.searchsorted(np.sort(of)[[i * len(of) // count for i in range(1, count)]], activity, side="right")


def split_by_activity(
    channel: np.ndarray, activity: np.ndarray, count: int, of: np.ndarray | None = None
) -> list[np.ndarray]:
    """The symbols of each of `count` classes (clause 8.9)."""
    classes = classes_by_activity(activity, count, of)
    return [channel[classes == q] for q in range(count)]


def plane_activity(e: np.ndarray) -> np.ndarray:
    """int64 [H, W] from residuals int64 [m, H, W] of the stages before (clause 8.8)."""
    _, height, width = e.shape
    size = relative_magnitude(e.reshape(len(e), -1)).reshape(height, width)
    i, j = np.indices((height, width))
    near = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return sum(
        (size[np.clip(i + a, 0, height - 1), np.clip(j + b, 0, width - 1)] for a, b in near), np.zeros_like(size)
    )


def classes_of_plane(e: np.ndarray, count: int) -> np.ndarray:
    """The class [H, W] of each cell, given the residuals int64 [m, H, W] of the stages before."""
    return classes_by_activity(plane_activity(e).ravel(), count).reshape(e.shape[1:])


Lengths = Callable[[list[int]], list[int]]


def staged(
    stages: Iterable[Iterable[np.ndarray]],
    lengths: Lengths = lambda sizes: sizes,
    tail: bytes = b"",
    priors: Mapping[int, Mapping[int, Prior]] | None = None,
    known: Sequence[Known] | None = None,
) -> bytes:
    """The lengths of all stages but the last, then the stages. lengths: what is said, from the true lengths. priors: by
    stage, then by channel of the stage. known: by stage."""
    payloads = [
        coded(stage, (priors or {}).get(number), known[number] if known else None)
        for number, stage in enumerate(stages)
    ]
    said = lengths([len(p) for p in payloads[:-1]])
    return b"".join(map(varint, said)) + b"".join(payloads) + tail


def staged_planes(
    planes: Sequence[np.ndarray],
    counts: Sequence[int],
    lengths: Lengths = lambda sizes: sizes,
    tail: bytes = b"",
    priors: Mapping[int, Mapping[int, Prior]] | None = None,
) -> bytes:
    """Section PLANES of residuals int32 [C, H, W] per plane, form 1 (clause 8.8). counts: classes of stages 1 on."""
    stages = []
    for stage in range(max(1, (len(planes[0]) - 1).bit_length())):
        first, end = (1 << stage if stage else 0), 2 << stage
        channels: list[np.ndarray] = []
        for plane in planes:
            e = plane.astype(np.int64)
            if stage == 0:
                channels += [channel.ravel() for channel in e[:end]]
                continue
            activity = plane_activity(e[:first]).ravel()
            for channel in e[first:end]:
                channels += split_by_activity(channel.ravel(), activity, counts[stage - 1])
        stages.append(channels)
    return b"\1" + b"".join(map(varint, counts)) + staged(stages, lengths, tail, priors)


Terms = Mapping[int, Sequence[tuple[int, int]]]
Splits = Mapping[int, tuple[int, int, int]]
ONE_CLASS = (1,) * 5  # in each of the stages 1 to 5


def prediction_block(
    terms: Terms,
    splits: Splits,
    counts: Mapping[int, int],
    classes: Sequence[int] = ONE_CLASS,
    widths: Widths = DEFAULT_WIDTHS,
) -> bytes:
    """Items 1 to 3 of clause 8.6. terms: channel -> (g, w) as they are stored; counts: other numbers of terms."""
    out = b""
    for c in range(1, widths.predicted):
        own = terms.get(c, ())
        out += varint(counts.get(c, len(own))) + b"".join(varint(g) + zigzag(w) for g, w in own)
    out += b"".join(map(varint, classes))
    for i in range(widths.slots):
        flags, a, b = splits.get(i, (0, 0, 0))
        out += varint(flags) + (zigzag(a) if flags else b"") + (zigzag(b) if flags & 2 else b"")
    return out


def gaps(terms: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """(channel, weight), channels ascending -> (g, weight)."""
    return [(j - last - 1, w) for last, (j, w) in zip([-1, *(j for j, _ in terms)], terms, strict=False)]


def attribute_stages(
    e: np.ndarray,
    splits: Splits,
    classes: Sequence[int],
    widths: Widths = DEFAULT_WIDTHS,
    of: np.ndarray | None = None,
    grades: tuple[np.ndarray, np.ndarray] = (NO_CLASSES, NO_CLASSES),
) -> list[list[np.ndarray]]:
    """The channels of the eight stages of clause 8.7, of residuals and offsets int64 [channels, n]. of: those of the
    slice that the block stands in, if it is another one. grades: step classes of both."""
    of, p, stages = e if of is None else of, widths.predicted, list[list[np.ndarray]]()
    graded = bool(grades[0].size)
    bounds = [p * a // 38 for a in (0, 6, 12, 20, 29, 38)]
    for stage, count in enumerate(classes if graded else (1, *classes)):
        first = bounds[stage]
        channels = e[first : bounds[stage + 1]] if stage < 5 else e[p::3]
        measured, by = (
            np.concatenate([*[(64 >> g.astype(np.int64))[None]] * 4, x[:first]]) if graded else x[:first]
            for x, g in zip((e, of), grades, strict=True)
        )
        activity, measure = relative_magnitude(measured, by), relative_magnitude(by, by)
        stages.append([part for channel in channels for part in split_by_activity(channel, activity, count, measure)])
    ys, zs = list[np.ndarray](), list[np.ndarray]()
    for i in range(widths.slots):
        x, y, z = e[p + 3 * i : p + 3 * i + 3]
        flags, a, b = splits.get(i, (0, 0, 0))
        near_x, near_xy = np.minimum(abs(x - a), CLASSES_Y - 1), np.minimum(abs(x - a) + abs(y - b), CLASSES_Z - 1)
        ys += [y[near_x == q] for q in range(CLASSES_Y)] if flags & 1 else [y]
        zs += [z[near_xy == q] for q in range(CLASSES_Z)] if flags & 2 else [z]
    return [*stages, ys, zs]


def predicted_attributes(
    k: np.ndarray,
    terms: Terms,
    splits: Splits,
    classes: Sequence[int] = ONE_CLASS,
    *,
    widths: Widths = DEFAULT_WIDTHS,
    grades: np.ndarray = NO_CLASSES,
    lengths: Lengths = lambda sizes: sizes,
    tail: bytes = b"",
    known: Sequence[Known] | None = None,
    of: np.ndarray | None = None,
    of_grades: np.ndarray = NO_CLASSES,
) -> bytes:
    """Section ATTRIBUTES of int32 [channels, n], form 1 (clauses 8.5 to 8.9).

    terms: channel -> (channel, weight) ascending. classes: of stages 1 to 5. lengths: what the block says of stages 0
    to 6, from the true lengths. tail: after the last stage. of, of_grades: the attributes and step classes of the slice
    that the block stands in, if it is another one: form 2.
    """
    e = residuals(k, terms, widths)
    before = None if of is None else residuals(of, terms, widths)
    stages = attribute_stages(e, splits, classes, widths, before, (grades, grades if of is None else of_grades))
    block = prediction_block({c: gaps(own) for c, own in terms.items()}, splits, {}, classes, widths)
    front = b"\1" + graded_part(grades) + block if of is None else b"\2" + graded_part(grades)
    return front + staged(stages, lengths, tail, known=known)


def residuals(k: np.ndarray, terms: Terms, widths: Widths = DEFAULT_WIDTHS) -> np.ndarray:
    """int64 [channels, n]: attributes int32 [channels, n], the predicted ones without their prediction (clause 8.7)."""
    e = k.astype(np.int64)
    for c in range(1, widths.predicted):
        total = sum((w * k[j].astype(np.int64) for j, w in terms.get(c, ())), np.zeros_like(e[c]))
        e[c] -= total + 512 >> WEIGHT_SHIFT
    return e


# -- LZMA sections (clause 9) ------------------------------------------------------------------------------------------

Stream = Callable[[bytes], bytes]


def lzma_layout(numbers: Sequence[np.ndarray], planar: bool) -> bytes:
    """The bytes under an LZMA2 stream, of arrays of the dtypes that are stored."""
    if not planar:
        return b"".join(n.tobytes() for n in numbers)
    return b"".join(n.view(np.uint8).reshape(-1, n.itemsize).T.tobytes() for n in numbers)


def lzma_symbols(
    channels: Sequence[np.ndarray],
    *,
    base: int | None = 0,
    width: int | None = None,
    planar: bool = False,
    stream: Stream = lzma2.stored,
) -> bytes:
    """Section SYMBOLS. base: of all channels; None takes each channel's first symbol. width: log2 of the bytes of every
    number; None takes the narrowest."""
    out, numbers, common = bytes([lzma2.PROPERTIES, planar]), [], base
    for channel in channels:
        if channel.size:
            base = int(channel[0]) if common is None else common
            v = channel.astype(np.int64) - base
            reach = max(int(v.max()) + 1, -int(v.min()))
            w = (
                next(w for w, high in enumerate((1 << 7, 1 << 15, 1 << 31)) if reach <= high)
                if width is None
                else width
            )
            out += varint(4 * (2 * base if base >= 0 else -2 * base - 1) + w)
            numbers.append(v.astype(("<i1", "<i2", "<i4")[w]))
    return out + stream(lzma_layout(numbers, planar))


def lzma_floats(arrays: Sequence[np.ndarray], *, planar: bool = False, stream: Stream = lzma2.stored) -> bytes:
    """Section FLOATS."""
    data = lzma_layout([a.astype("<f4").ravel() for a in arrays], planar)
    return bytes([lzma2.PROPERTIES, planar]) + stream(data)


# -- layers (clause 6) -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Layer:
    """A layer as it is meant and as it is written. meta: the layer parameters without the lengths of the sections.
    brings: of a refining slice, the layer and the attributes of the slices that it names, as they are then."""

    meant: LayerSymbols
    meta: dict[int, object]
    sections: dict[int, bytes]
    brings: tuple[int, Sequence[np.ndarray]] | None = None

    def payload(self, meta: Callable[[dict], dict] = lambda m: m, pack: Callable[[object], bytes] = canonical.pack):
        """Its bytes, the parameters changed by `meta` and written by `pack`."""
        lengths = {s: len(self.sections[s]) for s in sorted(self.sections)}
        packed = pack(meta({**self.meta, 2: lengths}))
        body = b"".join(self.sections[s] for s in sorted(self.sections))
        return struct.pack("<I", len(packed)) + packed + body

    def padded(self, parameters: int) -> bytes:
        """Its bytes, an ignored key among the parameters filling them up to so many bytes."""
        bare = struct.unpack_from("<I", self.payload())[0]
        form, size = next(
            (form, parameters - bare - 1 - form)
            for form in (2, 3)
            if parameters - bare - 1 - form < 1 << 8 * (form - 1)
        )
        return self.payload(lambda m: {**m, 64: bytes(size)})

    def with_sections(self, sections: Mapping[int, bytes | None]) -> Layer:
        """With other bytes in some sections; None takes one out."""
        merged = {**self.sections, **sections}
        return replace(self, sections={s: data for s, data in merged.items() if data is not None})

    @property
    def channels(self) -> list[np.ndarray]:
        """The channels of sections 1 to 4 in their order, planes under predictor 0."""
        m = self.meant
        tensors = list(m.tensors())
        return [m.mask_increase, m.mask_own, *m.attributes, *(row for t in tensors for row in plane_channels(t))]


def plane_channels(tensor: np.ndarray) -> list[np.ndarray]:
    """Channels of a plane [C, H, W]; a weight or bias is one."""
    return [channel.ravel() for channel in tensor] if tensor.ndim == 3 else [tensor.ravel()]


def constant_networks(number: int, widths: Mapping[int, Sequence[int]], inputs: int) -> dict:
    """Networks by name, every tensor of one symbol of its own. widths: id -> outputs; inputs: of the first of them."""
    names = {i: name for name, i in LAYER_KINDS[number].network_ids.items()}
    networks, symbol = {}, 2
    for i, outputs in widths.items():
        wide = inputs if number == 0 or i == 0 else widths[0][-1]
        layers = []
        for out in outputs:
            layers.append((np.full((out, wide), symbol, np.int32), np.full(out, symbol - 5, np.int32)))
            wide, symbol = out, symbol + 1
        networks[names[i]] = tuple(layers)
    return networks


@dataclass(frozen=True)
class Scale:
    """One scale of a HexPlane. fill: makes the symbols of one plane from its name and shape."""

    channels: int = 2
    sides: tuple[int, int, int, int] = (3, 2, 4, 2)
    predictors: tuple[int, ...] = (0,) * 6
    fill: Callable[[str, tuple[int, ...]], np.ndarray] = lambda name, shape: pattern(*shape, seed=ord(name[0]))

    def planes(self) -> dict[str, np.ndarray]:
        """int32 [C, H, W] by name."""
        return {n: self.fill(n, (self.channels, self.sides[b], self.sides[a])) for n, a, b in PLANES}


def make_layer(
    number: int = 0,
    cells: Sequence[Sequence[int]] = ((-1, 0, 2),),
    *,
    before: int = 0,
    rises: Sequence[int] | None = None,
    codes: Sequence[int] | None = None,
    attributes: np.ndarray | None = None,
    scales: Sequence[Scale] = (),
    networks: Mapping[int, Sequence[int]] | dict | None = None,
    steps: Sequence[float] | None = None,
    mode: int = ANS,
    raw: bool = False,
    widths: Widths = DEFAULT_WIDTHS,
    classes: Sequence[int] | None = None,
) -> Layer:
    """A layer of `cells` (in Morton order) after `before` earlier rows.

    Without further words: every rise 0, every code 77, attributes all 2, in layer 0 the networks without hidden layers,
    elsewhere no deformation unless `scales` are given, then with a trunk and the head 1. networks: outputs by id,
    or the tensors by name. raw: planes and weights are those symbols times their step, as float32 values.
    """
    n, kind = len(cells), LAYER_KINDS[number]
    if networks is None:
        networks = (
            {i: (n,) for i, n in enumerate(widths.networks.values())}
            if number == 0
            else {0: (3,), 1: (3,)}
            if scales
            else {}
        )
    if not any(isinstance(key, str) for key in networks):
        inputs = widths.inputs if number == 0 else sum(s.channels for s in scales)
        networks = constant_networks(number, networks, inputs)
    steps = list(steps or ([2.0**-7] if number == 0 else [2.0**-4, 2.0**-6]))
    planes = tuple(s.planes() for s in scales)
    if raw:
        planes = tuple({name: dequantise(p, steps[0]) for name, p in scale.items()} for scale in planes)
        networks = {
            k: tuple((dequantise(w, steps[1]), dequantise(b, steps[1])) for w, b in v) for k, v in networks.items()
        }
    meant = LayerSymbols(
        kind=kind,
        widths=replace(widths, graded=classes is not None),
        anchor_q=np.array(cells, np.int32).reshape(-1, 3),
        mask_increase=np.array([0] * before if rises is None else rises, np.int32),
        mask_own=np.array([77] * n if codes is None else codes, np.int32),
        classes=NO_CLASSES if classes is None else np.array(classes, np.int32),
        attributes=np.full((widths.channels, n), 2, np.int32) if attributes is None else attributes,
        planes=planes,
        networks=networks,
        steps=dict(zip(kind.step_names, steps, strict=True)) if networks else {},
    )
    meta: dict[int, object] = {1: n}
    if networks:
        meta[3] = steps
    if scales:
        meta[4] = [[s.channels, *s.sides, *s.predictors] for s in scales]
    if networks:
        own = networks.items()
        meta[5] = [[kind.network_ids[name], *(len(bias) for _, bias in layers)] for name, layers in own]
    return Layer(meant, meta, _sections(meant, [p for s in scales for p in s.predictors], mode))


def _sections(meant: LayerSymbols, predictors: Sequence[int], mode: int) -> dict[int, bytes]:
    n = len(meant.anchor_q)
    sections = {POSITIONS: positions(meant.anchor_q)} if n else {}
    tensors = list(meant.tensors())
    planes = [residual(p, k) if k.size else k for p, k in zip(predictors, tensors, strict=False)]
    weights = [k.ravel() for k in tensors[len(planes) :]]
    flat = [row for r in planes for row in plane_channels(r)]
    masks = [meant.mask_increase, meant.mask_own]
    if mode == LZMA:
        grades = [meant.classes] if meant.widths.graded else []
        channels = [*masks, *grades, *meant.attributes, *flat, *weights]
        if any(c.size for c in channels):
            sections[SYMBOLS] = lzma_symbols(channels, stream=lzma2.packed)
    else:
        if meant.mask_increase.size or n:
            sections[MASKS] = coded(masks)
        if n:
            sections[ATTRIBUTE] = plain_attributes(meant.attributes, classes=meant.classes)
        if flat:
            sections[PLANE] = plain_planes(flat)
        if weights:
            sections[WEIGHTS] = coded(weights)
    return sections


# -- files (clause 3) --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Chunk:
    """A chunk. What is None follows from the payload: the type and length that the header lists, the length and the
    scene id in the frame. crc: xored to the right CRC-32. layer: what a layer's payload means."""

    type: int
    payload: bytes
    flags: int = 0
    layer: Layer | None = None
    listed: tuple[int, int] | None = None
    length: int | None = None
    scene_id: bytes | None = None
    crc: int = 0

    def frame(self, scene_id: bytes) -> bytes:
        """Its bytes in a file with that scene id."""
        length = len(self.payload) if self.length is None else self.length
        head = struct.pack("<HHI8s", self.type, self.flags, length, self.scene_id or scene_id)
        body = head + self.payload
        return body + struct.pack("<I", zlib.crc32(body) ^ self.crc)


def ancillary(type: int, payload: bytes = b"", **fields: object) -> Chunk:
    """An ancillary chunk."""
    return Chunk(type, payload, flags=1, **fields)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class File:
    """A file. header: without the chunk list and the digest, which follow from the chunks unless they are there; what
    is None is taken out. packed: the header's
    bytes if they are not the canonical ones. declared: the header length in the preamble. crc: xored to the right
    CRC-32. tail: after the last chunk."""

    chunks: tuple[Chunk, ...]
    header: dict[int, object] = field(default_factory=lambda: HEADER)
    packed: bytes | None = None
    signature: bytes = SIGNATURE
    major: int = MAJOR
    minor: int = 0
    declared: int | None = None
    crc: int = 0
    tail: bytes = b""

    def fields(self) -> dict[int, object]:
        """The header map."""
        chunk_list = [list(c.listed or (c.type, len(c.payload))) for c in self.chunks]
        own = {k: v for k, v in self.header.items() if v is not None}
        fields = {1: chunk_list, 14: payload_digest(c.payload for c in self.chunks if not c.flags & 1), **own}
        return {k: fields[k] for k in sorted(fields) if k not in self.header or self.header[k] is not None}

    def header_bytes(self) -> bytes:
        """The header."""
        return canonical.pack(self.fields()) if self.packed is None else self.packed

    def start(self, index: int) -> int:
        """Offset of a chunk; that of the file's end for the number of chunks."""
        return 20 + len(self.header_bytes()) + sum(20 + len(c.payload) for c in self.chunks[:index])

    @property
    def scene_id(self) -> bytes:
        """Clause 3.3, of the header as it is written; a header without its chunk list counts as a whole."""
        header, chunk_list = self.header_bytes(), canonical.pack(1) + canonical.pack(self.fields()[1])
        described = header[header.find(chunk_list) + len(chunk_list) :] if chunk_list in header else header
        return hashlib.sha256(described).digest()[:SCENE_ID_SIZE]

    def data(self) -> bytes:
        """Its bytes."""
        header = self.header_bytes()
        declared = len(header) if self.declared is None else self.declared
        front = struct.pack("<8sHHI", self.signature, self.major, self.minor, declared)
        crc = zlib.crc32(header, zlib.crc32(front)) ^ self.crc
        scene_id = self.scene_id  # once: it takes the whole header, of up to thousands of chunks
        frames = b"".join(c.frame(scene_id) for c in self.chunks)
        return front + struct.pack("<I", crc) + header + frames + self.tail

    def with_header(self, fields: Mapping[int, object]) -> File:
        """With other fields in the header; the value None takes one out."""
        return replace(self, header={**self.header, **fields})

    def with_chunk(self, index: int, **fields: object) -> File:
        """With other fields in one chunk."""
        chunks = list(self.chunks)
        chunks[index] = replace(chunks[index], **fields)  # type: ignore[arg-type]
        return replace(self, chunks=tuple(chunks))

    def with_payload(self, index: int, payload: bytes) -> File:
        """With another payload in one chunk."""
        return self.with_chunk(index, payload=payload)

    def layer(self, index: int) -> Layer:
        """What the payload of a layer's chunk means."""
        layer = self.chunks[index].layer
        assert layer is not None
        return layer

    def slices(self, chunks: int | None = None) -> tuple[int, ...]:
        """The layer of each slice among the first `chunks` chunks."""
        return tuple(c.layer.meant.kind.layer for c in self.chunks[:chunks] if c.layer is not None)

    def hashes(self, chunks: int | None = None) -> list[dict]:
        """Clause 12.4 of the layers among the first `chunks` chunks, from what they mean."""
        meant, refined = list[LayerSymbols](), set[int]()
        for layer in (c.layer for c in self.chunks[:chunks] if c.layer is not None):
            meant.append(layer.meant)
            number, brought = layer.brings or (0, ())
            waiting = [i for i, m in enumerate(meant) if m.kind.layer == number and i not in refined]
            for i, attributes in zip(waiting, brought, strict=False):
                meant[i] = replace(meant[i], attributes=attributes)
                refined.add(i)
        layers = [merged(list(slices)) for _, slices in itertools.groupby(meant, key=lambda m: m.kind)]
        return [_hashes(m, self.header) for m in layers]

    def prefixes(self, chunks: int | None = None) -> dict[int, list[dict]]:
        """By their highest layer, the hashes of those prefixes of layers whose low bits come behind them."""
        whole, found = self.hashes(chunks), {}
        for count, row in enumerate(whole[:-1], start=1):
            numbers = [c.layer.meant.kind.layer if c.layer else -1 for c in self.chunks[:chunks]]
            end = max(i for i, number in enumerate(numbers) if number == row["layer"])
            prefix = self.hashes(end + 1)
            if prefix != whole[:count]:
                found[row["layer"]] = prefix
        return found


def make_file(*layers: Layer, header: Mapping[int, object] | None = None) -> File:
    """A file of these layers in their chunks. Layers of one kind are its slices, numbered as they come."""
    chunks = []
    for kind, slices in itertools.groupby(layers, key=lambda x: x.meant.kind):
        own = list(slices)
        chunks += [
            Chunk(kind.chunk_type, x.payload(), slice_flags(number, len(own)), layer=x) for number, x in enumerate(own)
        ]
    widths = layers[0].meant.widths
    centres = {16: [i % 5 - 2 for i in range(widths.channels)]} if widths.graded else {}
    return File(tuple(chunks)).with_header({15: [widths.feature, widths.slots], **centres, **(header or {})})


def _hashes(m: LayerSymbols, header: Mapping[int, object]) -> dict:
    steps = dict(zip(ATTRIBUTES, header[4], strict=True))  # type: ignore[call-overload]
    centre = np.array(header.get(16, [0] * m.widths.channels), np.int32)
    values = Grid(steps, m.widths, centre).dequantise(m.attributes, m.classes)
    tensors = [dequantise(m.anchor_q, header[5]), *(values[name] for name in ATTRIBUTES)]  # type: ignore[arg-type]
    own = list(m.tensors())
    count = len(PLANES) * len(m.planes)
    if own:
        of_steps = list(m.steps.values())
        tensors += [dequantise(k, of_steps[0 if i < count else -1]) for i, k in enumerate(own)]
    integers = [a for a in m.arrays() if a.dtype.kind == "i"]
    digests = [
        hashlib.sha256(b"".join(a.astype(t).tobytes() for a in x)) for x, t in ((integers, "<i4"), (tensors, "<f4"))
    ]
    return {"layer": m.kind.layer, "symbols": digests[0].hexdigest(), "tensors": digests[1].hexdigest()}


# -- vectors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vector:
    """One file of spec/vectors. layers: the hashes of what decodes, of all of a valid file or of the layers before a
    fault. error: its name (clause 15), None for a valid file. chunk, offset: where the fault lies, if in a chunk and
    if at a field that the frame fixes. slices: the layer of each slice that decodes. prefixes: the hashes of those
    prefixes that are not the first of `layers`, by their highest layer."""

    name: str
    sentence: str
    clauses: tuple[str, ...]
    data: bytes
    layers: list[dict]
    error: str | None = None
    chunk: int | None = None
    offset: int | None = None
    slices: tuple[int, ...] = ()
    prefixes: Mapping[int, list[dict]] = field(default_factory=dict)


def good(name: str, sentence: str, clauses: str, file: File) -> Vector:
    """A file that decodes."""
    return Vector(
        name,
        sentence,
        tuple(clauses.split()),
        file.data(),
        file.hashes(),
        slices=file.slices(),
        prefixes=file.prefixes(),
    )


def bad(
    name: str,
    sentence: str,
    clauses: str,
    error: str,
    file: File,
    *,
    chunk: int | None = None,
    at: int | None = None,
    size: int | None = None,
    whole: bool = False,
) -> Vector:
    """A file with one fault: in `chunk`; before all chunks if None; behind them if `whole`.

    at: byte of the chunk's frame, or of the file outside chunks, where the field at fault begins. size: cut to so many
    bytes, which is then where the fault lies.
    """
    data = file.data()[:size]
    offset = size if at is None else at + (0 if chunk is None else file.start(chunk))
    count = None if whole else chunk or 0
    layers, slices, prefixes = file.hashes(count), file.slices(count), file.prefixes(count)
    clauses_of = tuple(clauses.split())
    return Vector("faulty/" + name, sentence, clauses_of, data, layers, error, chunk, offset, slices, prefixes)


MALFORMED, LIMIT, FEATURE = "Malformed", "LimitExceeded", "UnsupportedFeature"


def in_layer(layer: int, name: str, what: str, clauses: str, error: str, payload: bytes, file: File) -> Vector:
    """A vector whose fault lies in the payload of one layer of `file`."""
    return bad(name, what, clauses, error, file.with_payload(layer, payload), chunk=layer)
