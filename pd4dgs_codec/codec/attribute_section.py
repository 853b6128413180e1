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

The block ends with the varint lengths of stages 0..6. In a stage, channels come in ascending order, a split one as its
classes in order, each with its rows in order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.table import NO_CLASSES
from pd4dgs_codec.codec.stages import (
    PLAIN,
    PRIOR_BITS,
    STAGED,
    activity_classes,
    cheapest_class_count,
    places_of,
    put_stages,
    read_class_count,
    read_stages,
    relative_magnitude,
    smaller_form,
)
from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature
from pd4dgs_codec.scene import MAX_CLASS, Widths

WEIGHT_SHIFT = 10
MAX_WEIGHT = 1 << 15
#: Where the stages of residuals begin and end, of 38 predicted channels; those of another number in proportion.
STAGES = (0, 6, 12, 20, 29, 38)
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


# -- writing -----------------------------------------------------------------------------------------------------------


def write_attributes(
    attributes: np.ndarray, classes: np.ndarray, widths: Widths, priors: str, effort: int
) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over all channels, by step class, and the classes' entropy) of attributes int32
    [channels, n] and classes int32 [n], or NO_CLASSES, in the smaller form."""
    one_row = attributes.shape[1] < 2  # has no spread to predict
    staged = None if one_row else lambda: _write_staged(attributes.astype(np.int64), classes, widths, effort)
    channels = by_class(attributes, classes)
    data, rate_bits = smaller_form(channels, staged, priors, effort)
    if not widths.graded:
        return data, rate_bits
    out = bytearray(data[:1])
    graded = encode_channels([classes], effort=effort).payload
    put_varint(out, len(graded))
    return bytes(out + graded + data[1:]), rate_bits + entropy_bits(classes)


def by_class(attributes: np.ndarray, classes: np.ndarray) -> list[np.ndarray]:
    """The channels of form 0: each channel int [n] as its rows of class 0, 1 .. MAX_CLASS; as it is without classes."""
    if not classes.size:
        return list(attributes)
    parts = places_of(classes, MAX_CLASS + 1)
    return [channel[rows] for channel in attributes for rows in parts]


def _write_staged(symbols: np.ndarray, classes: np.ndarray, widths: Widths, effort: int) -> bytes:
    terms = [_fit_terms(symbols, c) for c in range(1, widths.predicted)]
    splits = [_fit_split(*symbols[x : x + 3]) for x in stage_channels(widths, len(STAGES) - 1)]
    coded = symbols.copy()
    for c, term in enumerate(terms, start=1):
        coded[c] = symbols[c] - term.prediction(symbols)
    counts = [
        cheapest_class_count([(coded[list(stage_channels(widths, stage))], _activity(coded, classes, widths, stage))])
        for stage in _split_stages(widths)
    ]

    out = bytearray([STAGED])
    for term in terms:
        put_varint(out, len(term.channels))
        for gap, weight in zip(np.diff(term.channels, prepend=-1) - 1, term.weights, strict=True):
            put_varint(out, int(gap))
            put_zigzag(out, int(weight))
    for count in counts:
        put_varint(out, count)
    for split in splits:
        put_varint(out, split.flags)
        if split.flags:
            put_zigzag(out, split.centre_x)
        if split.flags & SPLIT_Z:
            put_zigzag(out, split.centre_y)
    stages = [[channel[rows] for channel, rows in places] for places in _places(coded, classes, widths, counts, splits)]
    put_stages(out, stages, effort)
    return bytes(out)


def _places(
    coded: np.ndarray, classes: np.ndarray, widths: Widths, counts: Sequence[int], splits: Sequence[Split]
) -> Iterator[list[tuple[np.ndarray, np.ndarray]]]:
    """Per stage, the (channel, rows) that it codes, in order. `coded` int64 [channels, n] is read only as far as the
    stages before reach."""
    every = np.arange(coded.shape[1])
    for stage, count in enumerate(counts if widths.graded else (1, *counts)):
        parts = (
            places_of(activity_classes(_activity(coded, classes, widths, stage), count), count)
            if count > 1
            else [every]
        )
        yield [(coded[c], part) for c in stage_channels(widths, stage) for part in parts]
    for axis, flag, count in ((1, SPLIT_Y, Y_CLASSES), (2, SPLIT_Z, Z_CLASSES)):
        places = []
        for x, split in zip(stage_channels(widths, len(STAGES) - 1), splits, strict=True):
            parts = [every]
            if split.flags & flag:
                classes = split.y_classes(coded[x]) if axis == 1 else split.z_classes(coded[x], coded[x + 1])
                parts = places_of(classes, count)
            places += [(coded[x + axis], part) for part in parts]
        yield places


def _split_stages(widths: Widths) -> range:
    """The stages whose channels are split by activity."""
    return range(0 if widths.graded else 1, len(STAGES))


def _activity(coded: np.ndarray, classes: np.ndarray, widths: Widths, stage: int) -> np.ndarray:
    """int64 [n] of the rows, by what comes before the stage."""
    known = coded[: stage_bounds(widths)[stage]]
    activity = relative_magnitude(known) if len(known) else np.zeros(coded.shape[1], np.int64)
    if widths.graded:
        activity += GRADE_WEIGHT * relative_magnitude((1 << MAX_CLASS >> classes.astype(np.int64))[None])
    return activity


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


def read_attributes(data: bytes, widths: Widths, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """(classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]); the inverse of write_attributes.
    rows was checked against the limits before."""
    reader = ByteReader(data)
    form = reader.byte("the form of the attributes")
    if form not in (PLAIN, STAGED):
        raise UnsupportedFeature(f"form {form} of the attributes, expected {PLAIN} or {STAGED}")
    classes = _read_classes(reader, rows) if widths.graded else NO_CLASSES
    if form == PLAIN:
        return classes, _read_plain(reader.rest(), classes, widths, rows)
    terms = [_read_terms(reader, widths, c) for c in range(1, widths.predicted)]
    counts = [read_class_count(reader, stage) for stage in _split_stages(widths)]
    splits = [_read_split(reader) for _ in range(widths.slots)]
    symbols = np.zeros((widths.channels, rows), np.int64)
    read_stages(reader, len(STAGES) + 2, _places(symbols, classes, widths, counts, splits))
    for c, term in enumerate(terms, start=1):
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


def _read_plain(data: memoryview, classes: np.ndarray, widths: Widths, rows: int) -> np.ndarray:
    if not widths.graded:
        return np.stack(decode_channels(data, [rows] * widths.channels))
    parts = places_of(classes, MAX_CLASS + 1)
    symbols = np.zeros((widths.channels, rows), np.int32)
    decoded = decode_channels(data, [len(part) for part in parts] * widths.channels)
    for i, values in enumerate(decoded):
        symbols[i // len(parts), parts[i % len(parts)]] = values
    return symbols


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
