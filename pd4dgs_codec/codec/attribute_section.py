"""The attributes section of mode ans: the channels as they are, or with what one tells of another taken out.

Byte 0 is the form. Where anchors are graded, a varint follows, the length of one channels payload, and that: the step
class of each row. Form 0: the rest is one channels payload of all channels. Form 1: a block of varints, then eight
channels payloads, the *stages*, each decoded before the next. All arithmetic is on integers. With D feature numbers and
G Gaussians, the first P = D + 6 channels are features and log-scalings, the others G offsets x, y, z.

*Step classes*. In form 0 each channel is split into the step classes 0..6 of its rows. In form 1 an anchor's activity
(below) begins with GRADE_WEIGHT times the relative magnitude of a channel that holds 2^(6 - class), and stage 0 is
split by it as well.

*Linear prediction*, channels 1 .. P - 1: for channel c a varint m <= c, then m terms in ascending
order of the channel j they refer to: a varint j - (previous j) - 1, starting from previous j = -1, and a zigzag weight
w, |w| <= 2^15. Coded is the residual e_c = k_c - ((sum_j w_j k_j + 512) >> 10), the shift rounding down.

*Activity*. The residuals of an anchor tend to be large together. Stages 0..4 hold the residuals of channels 0 .. P - 1
in the runs that `stage_bounds` names, stage 5 the offsets x. For each of stages 1..5 the block has a varint C in 1..8:
each channel of the stage is split into C classes of rows by how large the residuals of the earlier stages are
(`activity`).

*Distance*, the offsets y and z: per Gaussian a varint f in 0..3: bit 0, y is split by x; bit 1, z is
split by x and y. If f > 0 follow a zigzag centre of x and, if bit 1 is set, one of y, each |.| <= 2^24 - 1. The symbols
of a split y go to class min(|x - centre_x|, 4), those of a split z to class min(|x - centre_x| + |y - centre_y|, 6).
Stage 6 holds the y, stage 7 the z.

Form 2, of a slice behind another one of its layer: the lengths and the stages alone. Terms, splits and classes are
those of the latest block before (`Past`), the classes with the bounds that they had in the slice of that block.

The block ends with the varint lengths of stages 0..6. In a stage, channels come in ascending order, a split one as its
classes in order, each with its rows in order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from pd4dgs_codec.attributes.table import NO_CLASSES
from pd4dgs_codec.codec.stages import (
    PLAIN,
    PRIOR_BITS,
    STAGED,
    CodedSection,
    activity_bounds,
    cheapest_class_count,
    coded_stages,
    places_of,
    read_class_count,
    read_stages,
    relative_magnitude,
    smaller_form,
)
from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.priors import K_MAX, Prior
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature
from pd4dgs_codec.scene import MAX_CLASS, Widths

CONTINUED = 2  #: the form that goes on with an earlier block
WEIGHT_SHIFT = 10
MAX_WEIGHT = 1 << 15
#: Where the stages of residuals begin and end, of 38 predicted channels; those of another number in proportion.
STAGES = (0, 6, 12, 20, 29, 38)
N_STAGES = len(STAGES) + 2
Y_CLASSES, Z_CLASSES = 5, 7
SPLIT_Y, SPLIT_Z = 1, 2
#: How much an anchor's step class counts for its activity, beside the channels' residuals, which count 1 each.
GRADE_WEIGHT = 4

#: Encoder: a term must explain this share of its channel's spread; a term costs about so many bits.
MIN_SHARE = 0.03
TERM_BITS = 24
#: Encoder: added to each channel's variance when terms are fitted, about the 1/12 that rounding to integers puts there.
#: It keeps the equations solvable where channels are constant or alike. Another value means other files.
ROUNDING_VARIANCE = 0.08


@dataclass(frozen=True)
class Terms:
    """The linear prediction of one channel: channels int64 [m] and weights int64 [m] in units of 2^-10."""

    channels: np.ndarray
    weights: np.ndarray

    def prediction(self, symbols: np.ndarray) -> np.ndarray:
        """int64 [n] from symbols int64 [>= max channel + 1, n]."""
        predicted: np.ndarray = (self.weights @ symbols[self.channels] + (1 << WEIGHT_SHIFT >> 1)) >> WEIGHT_SHIFT
        return predicted


@dataclass(frozen=True)
class Split:
    """How one Gaussian's offsets are split into classes: flags and the centres of x and y."""

    flags: int
    centre_x: int = 0
    centre_y: int = 0

    def y_classes(self, x: np.ndarray) -> np.ndarray:
        """int64 [n] in 0..4."""
        classes: np.ndarray = np.minimum(np.abs(x - self.centre_x), Y_CLASSES - 1)
        return classes

    def z_classes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """int64 [n] in 0..6."""
        distance = np.abs(x - self.centre_x) + np.abs(y - self.centre_y)
        classes: np.ndarray = np.minimum(distance, Z_CLASSES - 1)
        return classes


def stage_bounds(widths: Widths) -> list[int]:
    """First channel of each stage of residuals, and the end of the last."""
    return [widths.predicted * bound // STAGES[-1] for bound in STAGES]


def stage_channels(widths: Widths, stage: int) -> range:
    """The channels of stages 0..5; those of the last are the offsets x."""
    if stage == len(STAGES) - 1:
        return range(widths.predicted, widths.channels, 3)
    return range(*stage_bounds(widths)[stage : stage + 2])


@dataclass(frozen=True, eq=False)
class Scale:
    """What the classes of one stage are measured by. places, sums: of the residuals of the stages before, int64 [m] the
    sums of their magnitudes. bounds: int64 [classes - 1], where each class but the first begins."""

    places: int
    sums: np.ndarray
    bounds: np.ndarray


@dataclass(frozen=True, eq=False)
class Block:
    """The prediction block.

    widths: of the anchors. counts: of classes, of stages 1 to 5, with step classes 0 to 5. scales: by stage, of the
    slice that the block stands in; known once that slice has been coded so far.
    """

    widths: Widths
    terms: list[Terms]
    counts: list[int]
    splits: list[Split]
    scales: dict[int, Scale] = field(default_factory=dict)

    def classes(self, coded: np.ndarray, grades: np.ndarray, stage: int) -> np.ndarray:
        """int64 [n] of rows whose residuals in the stages before are in coded int64 [channels, n], of those step
        classes."""
        residuals = _measured(coded, grades, stage_bounds(self.widths)[stage])
        scale = self.scales.get(stage)
        if scale is None:
            activity = relative_magnitude(residuals)
            bounds = activity_bounds(activity, self.counts[stage - (not self.widths.graded)])
            self.scales[stage] = Scale(residuals.shape[1], np.abs(residuals).sum(axis=1), bounds)
        else:
            activity, bounds = relative_magnitude(residuals, scale.places, scale.sums), scale.bounds
        classes: np.ndarray = np.searchsorted(bounds, activity, side="right")
        return classes


AnyPrior = TypeVar("AnyPrior", Prior, Fitted)


@dataclass(eq=False)
class Past(Generic[AnyPrior]):
    """What a slice may refer to of its layer's slices before it: the latest block, and in order of definition the
    priors of each section, of which the attributes have one list for the plain form and one per stage."""

    block: Block | None = None
    positions: list[AnyPrior] = field(default_factory=list)
    masks: list[AnyPrior] = field(default_factory=list)
    plain: list[AnyPrior] = field(default_factory=list)
    stages: list[list[AnyPrior]] = field(default_factory=lambda: [[] for _ in range(N_STAGES)])

    def copy(self) -> Past[AnyPrior]:
        """One that grows without this one."""
        stages = [list(known) for known in self.stages]
        return Past(self.block, list(self.positions), list(self.masks), list(self.plain), stages)


# -- writing -----------------------------------------------------------------------------------------------------------


def write_attributes(
    attributes: np.ndarray,
    classes: np.ndarray,
    widths: Widths,
    priors: str,
    effort: int,
    past: Past[Fitted] | None = None,
    population: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over all channels, by step class, and the classes' entropy) of attributes int32
    [channels, n] and classes int32 [n], or NO_CLASSES, in the smallest form.

    past: of the layer's slices before, to which this one is added. population: (attributes, classes) that a
    block is fitted to: of this slice and of those that may refer to it; these alone if None.
    """
    past = past or Past()
    everything, grades = (attributes, classes) if population is None else population
    one_row = everything.shape[1] < 2  # has no spread to predict
    block = past.block or (None if one_row else _fit_block(everything.astype(np.int64), grades, widths))
    section, rate_bits = smaller_form(
        by_class(attributes, classes),
        None if block is None else lambda: _write_staged(attributes.astype(np.int64), classes, block, past, effort),
        priors,
        effort,
        past.plain,
    )
    if section.data[0] == PLAIN:
        past.plain += section.defined[0]
    else:
        past.block = block
        for known, defined in zip(past.stages, section.defined, strict=True):
            known += defined
    if not widths.graded:
        return section.data, rate_bits
    out, graded = bytearray(section.data[:1]), encode_channels([classes], effort=effort).payload
    put_varint(out, len(graded))
    return bytes(out + graded + section.data[1:]), rate_bits + entropy_bits(classes)


def by_class(attributes: np.ndarray, classes: np.ndarray) -> list[np.ndarray]:
    """The channels of form 0: each channel int [n] as its rows of class 0, 1 .. MAX_CLASS; as it is without classes."""
    if not classes.size:
        return list(attributes)
    parts = places_of(classes, MAX_CLASS + 1)
    return [channel[rows] for channel in attributes for rows in parts]


def _fit_block(symbols: np.ndarray, grades: np.ndarray, widths: Widths) -> Block:
    terms = [_fit_terms(symbols, c) for c in range(1, widths.predicted)]
    splits = [_fit_split(*symbols[x : x + 3]) for x in stage_channels(widths, len(STAGES) - 1)]
    coded, bounds = _residuals(symbols, terms), stage_bounds(widths)
    counts = [
        cheapest_class_count(
            [(coded[list(stage_channels(widths, stage))], relative_magnitude(_measured(coded, grades, bounds[stage])))]
        )
        for stage in _split_stages(widths)
    ]
    return Block(widths, terms, counts, splits)


def _residuals(symbols: np.ndarray, terms: Sequence[Terms]) -> np.ndarray:
    coded: np.ndarray = symbols.copy()
    for c, term in enumerate(terms, start=1):
        coded[c] = symbols[c] - term.prediction(symbols)
    return coded


def _write_staged(
    symbols: np.ndarray, grades: np.ndarray, block: Block, past: Past[Fitted], effort: int
) -> CodedSection:
    out = bytearray([CONTINUED])
    if past.block is None:
        out = bytearray([STAGED])
        _put_block(out, block)
    places = _places(_residuals(symbols, block.terms), grades, block)
    stages = [[channel[rows] for channel, rows in channels] for channels in places]
    return coded_stages(out, stages, effort, past.stages)


def _put_block(out: bytearray, block: Block) -> None:
    for term in block.terms:
        put_varint(out, len(term.channels))
        for gap, weight in zip(np.diff(term.channels, prepend=-1) - 1, term.weights, strict=True):
            put_varint(out, int(gap))
            put_zigzag(out, int(weight))
    for count in block.counts:
        put_varint(out, count)
    for split in block.splits:
        put_varint(out, split.flags)
        if split.flags:
            put_zigzag(out, split.centre_x)
        if split.flags & SPLIT_Z:
            put_zigzag(out, split.centre_y)


def _places(coded: np.ndarray, grades: np.ndarray, block: Block) -> Iterator[list[tuple[np.ndarray, np.ndarray]]]:
    """Per stage, the (channel, rows) that it codes, in order. `coded` int64 [channels, n] is read only as far as the
    stages before reach."""
    every = np.arange(coded.shape[1])
    for stage, count in enumerate(block.counts if block.widths.graded else (1, *block.counts)):
        parts = places_of(block.classes(coded, grades, stage), count) if count > 1 else [every]
        yield [(coded[c], part) for c in stage_channels(block.widths, stage) for part in parts]
    for axis, flag, count in ((1, SPLIT_Y, Y_CLASSES), (2, SPLIT_Z, Z_CLASSES)):
        places = []
        for x, split in zip(stage_channels(block.widths, len(STAGES) - 1), block.splits, strict=True):
            parts = [every]
            if split.flags & flag:
                classes = split.y_classes(coded[x]) if axis == 1 else split.z_classes(coded[x], coded[x + 1])
                parts = places_of(classes, count)
            places += [(coded[x + axis], part) for part in parts]
        yield places


def _split_stages(widths: Widths) -> range:
    """The stages whose channels are split by activity."""
    return range(0 if widths.graded else 1, len(STAGES))


def _measured(coded: np.ndarray, grades: np.ndarray, end: int) -> np.ndarray:
    """int64 [m, n], of which rows have their activity: the first `end` channels of coded, and for step classes `grades`
    GRADE_WEIGHT times one that holds 2^(6 - class)."""
    if not grades.size:
        return coded[:end]
    own = 1 << (MAX_CLASS - grades.astype(np.int64))
    return np.concatenate([np.repeat(own[None], GRADE_WEIGHT, axis=0), coded[:end]])


def _fit_terms(symbols: np.ndarray, c: int) -> Terms:
    """Least squares of channel c on those before it, weak terms dropped; no terms unless the entropy gains by them."""
    nothing = Terms(np.zeros(0, np.int64), np.zeros(0, np.int64))
    centred = (symbols[: c + 1] - symbols[: c + 1].mean(axis=1, keepdims=True)).astype(np.float64)
    covariance = centred @ centred.T / symbols.shape[1] + ROUNDING_VARIANCE * np.eye(c + 1)
    spread = np.sqrt(np.diag(covariance))
    chosen = np.arange(c)
    for _ in range(2):
        if not chosen.size:
            return nothing
        weights = np.linalg.solve(covariance[np.ix_(chosen, chosen)], covariance[chosen, c])
        strong = np.abs(weights) * spread[chosen] > MIN_SHARE * spread[c]
        if strong.all():
            break
        chosen, weights = chosen[strong], weights[strong]
    integers = np.rint(weights * (1 << WEIGHT_SHIFT)).astype(np.int64)
    kept = (integers != 0) & (np.abs(integers) <= MAX_WEIGHT)
    terms = Terms(chosen[kept].astype(np.int64), integers[kept])
    residual = symbols[c] - terms.prediction(symbols)
    if not terms.channels.size or np.abs(residual).max() > K_MAX:
        return nothing
    return terms if entropy_bits(residual) + TERM_BITS * len(terms.channels) < entropy_bits(symbols[c]) else nothing


def _fit_split(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Split:
    centre_x, centre_y = _mode(x), _mode(y)
    split = Split(SPLIT_Y | SPLIT_Z, centre_x, centre_y)
    flags = SPLIT_Y * _gains(y, split.y_classes(x)) | SPLIT_Z * _gains(z, split.z_classes(x, y))
    return Split(flags, centre_x, centre_y) if flags else Split(0)


def _gains(symbols: np.ndarray, classes: np.ndarray) -> bool:
    """Whether a prior per class pays."""
    parts = [symbols[classes == k] for k in range(int(classes.max()) + 1)]
    return sum(entropy_bits(part) + PRIOR_BITS for part in parts) < entropy_bits(symbols) + PRIOR_BITS


def _mode(symbols: np.ndarray) -> int:
    values, counts = np.unique(symbols, return_counts=True)
    return int(values[counts.argmax()])


# -- reading -----------------------------------------------------------------------------------------------------------


def read_attributes(
    data: bytes, widths: Widths, rows: int, past: Past[Prior] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]); the inverse of write_attributes.
    rows was checked against the limits before. past: of the layer's slices before, to which this one is added."""
    reader, block = ByteReader(data), past.block if past else None
    form = reader.byte("the form of the attributes")
    if form not in (PLAIN, STAGED, CONTINUED):
        raise UnsupportedFeature(f"form {form} of the attributes, expected {PLAIN}, {STAGED} or {CONTINUED}")
    classes = _read_classes(reader, rows) if widths.graded else NO_CLASSES
    if form == PLAIN:
        return classes, _read_plain(reader.rest(), classes, widths, rows, past.plain if past else None)
    if form == STAGED:
        block = _read_block(reader, widths)
    if block is None:
        raise Malformed("attributes that go on with a prediction block, but no slice before has one")
    symbols = np.zeros((widths.channels, rows), np.int64)
    read_stages(reader, N_STAGES, _places(symbols, classes, block), past.stages if past else None)
    if past:
        past.block = block
    for c, term in enumerate(block.terms, start=1):
        symbols[c] += term.prediction(symbols)
    if symbols.size and max(int(symbols.max()), -int(symbols.min())) > K_MAX:
        raise Malformed(f"a predicted attribute over {K_MAX} in magnitude")
    return classes, symbols.astype(np.int32)


def _read_classes(reader: ByteReader, rows: int) -> np.ndarray:
    length = reader.varint(reader.remaining, "the length of the step classes")
    (classes,) = decode_channels(reader.take(length), [rows])
    check_classes(classes)
    return classes


def check_classes(classes: np.ndarray) -> None:
    """Raise Malformed unless int32 [n] are step classes."""
    if classes.size and not (0 <= classes.min() and classes.max() <= MAX_CLASS):
        raise Malformed(f"step classes in {int(classes.min())}..{int(classes.max())}, expected 0..{MAX_CLASS}")


def _read_plain(
    data: memoryview, classes: np.ndarray, widths: Widths, rows: int, known: list[Prior] | None
) -> np.ndarray:
    if not widths.graded:
        return np.stack(decode_channels(data, [rows] * widths.channels, known))
    parts = places_of(classes, MAX_CLASS + 1)
    symbols = np.zeros((widths.channels, rows), np.int32)
    decoded = decode_channels(data, [len(part) for part in parts] * widths.channels, known)
    for i, values in enumerate(decoded):
        symbols[i // len(parts), parts[i % len(parts)]] = values
    return symbols


def _read_block(reader: ByteReader, widths: Widths) -> Block:
    terms = [_read_terms(reader, widths, c) for c in range(1, widths.predicted)]
    counts = [read_class_count(reader, stage) for stage in _split_stages(widths)]
    return Block(widths, terms, counts, [_read_split(reader) for _ in range(widths.slots)])


def _read_terms(reader: ByteReader, widths: Widths, c: int) -> Terms:
    channels, weights, last = [], [], -1
    for _ in range(reader.varint(c, f"the number of terms of channel {c}")):
        last += 1 + reader.varint(widths.predicted, f"a term of channel {c}")
        if last >= c:
            raise Malformed(f"channel {c} is predicted from channel {last}, expected one before it")
        channels.append(last)
        weights.append(reader.zigzag(MAX_WEIGHT, f"a weight of channel {c}"))
    return Terms(np.array(channels, np.int64), np.array(weights, np.int64))


def _read_split(reader: ByteReader) -> Split:
    flags = reader.varint(SPLIT_Y | SPLIT_Z, "the split of a Gaussian")
    centre_x = reader.zigzag(K_MAX, "the centre of x") if flags else 0
    centre_y = reader.zigzag(K_MAX, "the centre of y") if flags & SPLIT_Z else 0
    return Split(flags, centre_x, centre_y)
