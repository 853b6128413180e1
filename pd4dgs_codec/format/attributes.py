"""The attributes section of mode ans (clauses 8.5 to 8.7): channels as they are, or predicted from each other.

With D feature numbers and G Gaussians, the first P = D + 6 channels are features and log-scalings, the others are the
offsets x, y, z of each Gaussian. Form 0 codes all channels at once, by step class if anchors are graded. Form 1 has a
prediction block and then eight *stages*, each decoded before the next:

- Stages 0..4 hold residuals of the P channels, each predicted linearly from channels before it (`Terms`).
- Stage 5 holds the offsets x. Stages 1..5 are split into classes of rows by the size of the residuals in earlier
  stages (`stages.Activity`), because the residuals of an anchor tend to be large together.
- Stages 6 and 7 hold the offsets y and z, split by the distance of x and y from a centre (`Split`).

Form 2 uses the block of an earlier slice of the layer (`Past`). All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from pd4dgs_codec.entropy.channels import decode_channels, decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.priors import K_MAX, Prior
from pd4dgs_codec.entropy.tables import entropy_bits
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature
from pd4dgs_codec.format.quantise import NO_CLASSES
from pd4dgs_codec.format.stages import (
    PLAIN,
    PRIOR_BITS,
    STAGED,
    Activity,
    CodedSection,
    Group,
    Places,
    Scale,
    activity_bounds,
    cheapest_class_count,
    classes_within,
    coded_stages,
    parts_of,
    read_class_count,
    read_stages,
    smaller_form,
)
from pd4dgs_codec.scene import MAX_CLASS, Widths

CONTINUED = 2  #: the form that uses the block of an earlier slice
WEIGHT_SHIFT = 10
MAX_WEIGHT = 1 << 15
#: Bounds of the stages of residuals for 38 predicted channels, scaled for other numbers of channels.
STAGES = (0, 6, 12, 20, 29, 38)
N_STAGES = len(STAGES) + 2
Y_CLASSES, Z_CLASSES = 5, 7
SPLIT_Y, SPLIT_Z = 1, 2
#: Rows predicted at a time.
BLOCK_ROWS = 2048
#: Weight of an anchor's step class in its activity; a channel's residual has weight 1.
GRADE_WEIGHT = 4

#: Encoder: the least share of its channel's spread that a term must explain, and about the bits that a term costs.
MIN_SHARE = 0.03
TERM_BITS = 24
#: Encoder: added to each channel's variance when terms are fitted, about the 1/12 that comes from rounding to integers.
#: It keeps the equations solvable where channels are constant or alike. Files depend on this value.
ROUNDING_VARIANCE = 0.08


@dataclass(frozen=True)
class Terms:
    """The linear prediction of one channel: channels int64 [m], ascending, and weights int64 [m] in units of 2^-10."""

    channels: np.ndarray
    weights: np.ndarray

    @cached_property
    def _dense(self) -> np.ndarray:
        dense = np.zeros(int(self.channels.max(initial=-1)) + 1)
        dense[self.channels] = self.weights / (1 << WEIGHT_SHIFT)
        return dense

    @cached_property
    def reach(self) -> int:
        """The largest sum of products for symbols of magnitude 1, in units of 2^-10."""
        return int(np.abs(self.weights).sum())

    def prediction(self, symbols: np.ndarray) -> np.ndarray:
        """Returns predictions [n] from symbols [>= max channel + 1, n] of magnitude <= K_MAX. Both are integers stored
        as binary64, which is exact for sums of products (below 2^45), or as binary32, which is exact for sums below
        2^14. einsum starts no threads."""
        dense = self._dense.astype(symbols.dtype, copy=False)
        predicted: np.ndarray = np.einsum("i,ij->j", dense, symbols[: len(dense)])
        predicted += 0.5
        np.floor(predicted, out=predicted)
        return predicted


@dataclass(frozen=True)
class Split:
    """Classes of one Gaussian's offsets y and z by the distance of x and y from a centre. flags: SPLIT_Y | SPLIT_Z."""

    flags: int
    centre_x: int = 0
    centre_y: int = 0

    def y_classes(self, x: np.ndarray) -> np.ndarray:
        """Returns the classes of offsets y, int [n] in 0..4."""
        classes: np.ndarray = np.minimum(np.abs(x - self.centre_x), Y_CLASSES - 1)
        return classes

    def z_classes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Returns the classes of offsets z, int [n] in 0..6."""
        distance = np.abs(x - self.centre_x) + np.abs(y - self.centre_y)
        classes: np.ndarray = np.minimum(distance, Z_CLASSES - 1)
        return classes


def stage_channels(widths: Widths, stage: int) -> range:
    """Returns the channels of stage 0..5; stage 5 has the offsets x."""
    if stage == len(STAGES) - 1:
        return range(widths.predicted, widths.channels, 3)
    return range(*(widths.predicted * bound // STAGES[-1] for bound in STAGES[stage : stage + 2]))


@dataclass(eq=False)
class Block:
    """The prediction block.

    widths: of the anchors. counts: numbers of classes of stages 1 to 5, or of 0 to 5 with step classes.
    scale, bounds: set while the slice that holds the block is coded, and used by later slices: the scale of activities,
    and by stage the activity [classes - 1] at which each class but the first begins.
    """

    widths: Widths
    terms: list[Terms]
    counts: list[int]
    splits: list[Split]
    scale: Scale | None = None
    bounds: dict[int, np.ndarray] = field(default_factory=dict)

    def classes(self, activity: np.ndarray, stage: int, count: int) -> np.ndarray:
        """Returns classes uint8 [n] of rows by their activity [n] in earlier stages; sets missing bounds."""
        bounds = self.bounds.get(stage)
        if bounds is None:
            bounds = self.bounds[stage] = activity_bounds(activity, count)
        return classes_within(activity, bounds)


AnyPrior = TypeVar("AnyPrior", Prior, Fitted)


@dataclass(eq=False)
class Past(Generic[AnyPrior]):
    """State of a layer's earlier slices that a later slice may use: the latest block, and the priors of each section in
    order of definition. Attributes have one list of priors for the plain form and one per stage."""

    block: Block | None = None
    positions: list[AnyPrior] = field(default_factory=list)
    masks: list[AnyPrior] = field(default_factory=list)
    plain: list[AnyPrior] = field(default_factory=list)
    stages: list[list[AnyPrior]] = field(default_factory=lambda: [[] for _ in range(N_STAGES)])

    def copy(self) -> Past[AnyPrior]:
        """A copy that grows independently."""
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
    """Writes the smaller form: (section bytes, bits of R(a) of all channels by step class and of the step classes).

    attributes: int32 [channels, n]. classes: int32 [n], or NO_CLASSES. past: state of the layer's earlier slices, to
    which this one is added. population: (attributes, classes) of all slices that will use the block, which is fitted to
    them; None for this slice alone.
    """
    past = past or Past()
    everything, grades = (attributes, classes) if population is None else population
    staged = everything.shape[1] > 1 and priors == "best" and effort > 1
    block = past.block or (_fit_block(everything, grades, widths) if staged else None)
    section, rate_bits = smaller_form(
        lambda: by_class(attributes, classes),
        None if block is None else lambda: _write_staged(attributes, classes, block, past, effort),
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


def by_class(attributes: np.ndarray, classes: np.ndarray) -> Iterator[np.ndarray]:
    """Yields the channels of form 0, int [n]: each channel's rows of class 0 .. MAX_CLASS, or all without classes."""
    if not classes.size:
        yield from attributes
        return
    yield from Places.by(classes, MAX_CLASS + 1).parts(attributes)


def _fit_block(symbols: np.ndarray, grades: np.ndarray, widths: Widths) -> Block:
    covariance = _covariance(symbols[: widths.predicted])
    terms = [_fit_terms(symbols, covariance[: c + 1, : c + 1]) for c in range(1, widths.predicted)]
    splits = [_fit_split(*symbols[x : x + 3]) for x in stage_channels(widths, len(STAGES) - 1)]
    counts, activity = [], _activity(symbols.shape[1], grades)
    for stage in range(len(STAGES)):
        residuals = _residuals(symbols, terms, stage_channels(widths, stage))
        if stage in _split_stages(widths):
            counts.append(cheapest_class_count([(residuals, activity.now)]))
        if stage < len(STAGES) - 1:
            activity.add(residuals)
    return Block(widths, terms, counts, splits)


def _residuals(symbols: np.ndarray, terms: Sequence[Terms], channels: Sequence[int]) -> np.ndarray:
    """Returns the residuals int32 [len(channels), n] of some channels, ascending, of symbols int32 [channels, n].
    Offsets are not predicted."""
    coded: np.ndarray = symbols[list(channels)]
    for rows in _row_blocks(symbols):
        block = symbols[: min(channels[-1], len(terms)) + 1, rows].astype(np.float64)
        for at, c in enumerate(channels):
            if 0 < c <= len(terms) and terms[c - 1].channels.size:
                coded[at, rows] = block[c] - terms[c - 1].prediction(block)
    return coded


def _row_blocks(symbols: np.ndarray) -> Iterator[slice]:
    """Yields slices of the rows of symbols [channels, n], small enough for a processor's cache."""
    yield from (slice(first, first + BLOCK_ROWS) for first in range(0, symbols.shape[1], BLOCK_ROWS))


def _activity(rows: int, grades: np.ndarray, scale: Scale | None = None) -> Activity:
    """Returns the activity before stage 0. Step classes count like GRADE_WEIGHT channels that hold 2^(6 - class)."""
    activity = Activity(rows, scale)
    if grades.size:
        activity.add(1 << (MAX_CLASS - grades[None]), GRADE_WEIGHT)
    return activity


def _write_staged(
    symbols: np.ndarray, grades: np.ndarray, block: Block, past: Past[Fitted], effort: int
) -> CodedSection:
    out = bytearray([CONTINUED])
    if past.block is None:
        out = bytearray([STAGED])
        _put_block(out, block)
    coded = (_residuals(symbols, block.terms, channels) for channels in _measured_stages(block.widths))
    return coded_stages(out, map(parts_of, _groups(symbols, coded, grades, block)), effort, past.stages)


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


def _groups(
    symbols: np.ndarray, residuals: Iterator[np.ndarray], grades: np.ndarray, block: Block
) -> Iterator[list[Group]]:
    """Yields the groups of each stage. residuals: int32 [channels, n] of each of `_measured_stages`. symbols: int32
    [channels, n], read for the offsets. Both are read only as far as earlier stages have filled them."""
    counts = block.counts if block.widths.graded else [1, *block.counts]
    activity, whole = _activity(symbols.shape[1], grades, block.scale), Places.whole(symbols.shape[1])
    block.scale = activity.scale
    offsets = stage_channels(block.widths, len(STAGES) - 1)
    for stage, count in enumerate(counts):
        places = whole
        if count > 1:
            places = Places.by(block.classes(activity.now, stage, count), count)
        channels = next(residuals) if stage < len(STAGES) - 1 else symbols[offsets.start :: offsets.step]
        yield [(channels, places)]
        if any(later > 1 for later in counts[stage + 1 :]):
            activity.add(channels)
    for axis, flag, count in ((1, SPLIT_Y, Y_CLASSES), (2, SPLIT_Z, Z_CLASSES)):
        groups: list[Group] = []
        for first, split in zip(offsets, block.splits, strict=True):
            x, y, places = symbols[first], symbols[first + 1], whole
            if split.flags & flag:
                places = Places.by(split.y_classes(x) if axis == 1 else split.z_classes(x, y), count)
            groups.append((symbols[first + axis : first + axis + 1], places))
        yield groups


def _measured_stages(widths: Widths) -> list[range]:
    """Returns the channels of the stages of residuals, whose activity splits later stages."""
    return [stage_channels(widths, stage) for stage in range(len(STAGES) - 1)]


def _split_stages(widths: Widths) -> range:
    """Returns the stages whose channels are split by activity."""
    return range(0 if widths.graded else 1, len(STAGES))


def _covariance(symbols: np.ndarray) -> np.ndarray:
    """Returns the covariance float64 [channels, channels] of symbols int32 [channels, n], plus ROUNDING_VARIANCE."""
    mean, products = symbols.mean(axis=1, keepdims=True), np.zeros((len(symbols), len(symbols)))
    for rows in _row_blocks(symbols):
        centred = symbols[:, rows] - mean
        products += centred @ centred.T
    covariance: np.ndarray = products / symbols.shape[1] + ROUNDING_VARIANCE * np.eye(len(symbols))
    return covariance


def _fit_terms(symbols: np.ndarray, covariance: np.ndarray) -> Terms:
    """Fits channel c to the channels before it by least squares, without weak terms, from their covariance float64
    [c + 1, c + 1]. Returns no terms unless they lower the entropy."""
    nothing, c = Terms(np.zeros(0, np.int64), np.zeros(0, np.int64)), len(covariance) - 1
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
    if not terms.channels.size:
        return nothing
    residual = np.empty(symbols.shape[1], np.int64)
    for rows in _row_blocks(symbols):
        block = symbols[: c + 1, rows].astype(np.float64)
        residual[rows] = block[c] - terms.prediction(block)
    if np.abs(residual).max() > K_MAX:
        return nothing
    return terms if entropy_bits(residual) + TERM_BITS * len(terms.channels) < entropy_bits(symbols[c]) else nothing


def _fit_split(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Split:
    centre_x, centre_y = _mode(x), _mode(y)
    split = Split(SPLIT_Y | SPLIT_Z, centre_x, centre_y)
    flags = SPLIT_Y * _gains(y, split.y_classes(x)) | SPLIT_Z * _gains(z, split.z_classes(x, y))
    return Split(flags, centre_x, centre_y) if flags else Split(0)


def _gains(symbols: np.ndarray, classes: np.ndarray) -> bool:
    """Whether a prior per class costs less than one prior."""
    parts = [symbols[classes == k] for k in range(int(classes.max()) + 1)]
    return sum(entropy_bits(part) + PRIOR_BITS for part in parts) < entropy_bits(symbols) + PRIOR_BITS


def _mode(symbols: np.ndarray) -> int:
    values, counts = np.unique(symbols, return_counts=True)
    return int(values[counts.argmax()])


# -- reading -----------------------------------------------------------------------------------------------------------


def read_attributes(
    data: bytes, widths: Widths, rows: int, past: Past[Prior] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]); the inverse of write_attributes.
    rows: already checked against the limits. past: state of the layer's earlier slices, to which this one is added."""
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
        raise Malformed("attributes continue a prediction block, but no earlier slice has one")
    symbols = np.zeros((widths.channels, rows), np.int32)
    coded = (symbols[channels.start : channels.stop] for channels in _measured_stages(widths))
    read_stages(reader, N_STAGES, _groups(symbols, coded, classes, block), past.stages if past else None)
    if past:
        past.block = block
    _restore(symbols[: widths.predicted], block.terms)
    return classes, symbols


def _restore(symbols: np.ndarray, terms: Sequence[Terms]) -> None:
    """Turns residuals int32 [channels, n] into symbols in place. Raises Malformed if one is over K_MAX."""
    predicted = [(c, term) for c, term in enumerate(terms, start=1) if term.channels.size]
    reach = max([term.reach for _, term in predicted], default=0)
    for rows in _row_blocks(symbols) if predicted else ():
        block, largest = _predicted(symbols[:, rows].astype(np.float32), predicted)
        # sums of products and 1/2 are multiples of 2^-10; below 2^14 binary32 holds them exactly
        if not largest * reach + 512 < 1 << 24:
            block, largest = _predicted(symbols[:, rows].astype(np.float64), predicted)
        if largest > K_MAX:
            raise Malformed(f"a predicted attribute over {K_MAX} in magnitude")
        symbols[:, rows] = block


def _predicted(block: np.ndarray, terms: Sequence[tuple[int, Terms]]) -> tuple[np.ndarray, float]:
    """Turns residuals [channels, n] into symbols in place. Returns (symbols, their largest magnitude)."""
    with np.errstate(all="ignore"):  # if binary32 overflows, the caller repeats it in binary64
        for c, term in terms:
            block[c] += term.prediction(block)
    return block, max(float(block.max()), -float(block.min()))


def _read_classes(reader: ByteReader, rows: int) -> np.ndarray:
    length = reader.varint(reader.remaining, "the length of the step classes")
    (classes,) = decode_channels(reader.take(length), [rows])
    check_classes(classes)
    return classes


def check_classes(classes: np.ndarray) -> None:
    """Raises Malformed unless classes int32 [n] are in 0..MAX_CLASS."""
    if classes.size and not (0 <= classes.min() and classes.max() <= MAX_CLASS):
        raise Malformed(f"step classes in {int(classes.min())}..{int(classes.max())}, expected 0..{MAX_CLASS}")


def _read_plain(
    data: memoryview, classes: np.ndarray, widths: Widths, rows: int, known: list[Prior] | None
) -> np.ndarray:
    if not widths.graded:
        return decode_joined(data, [rows] * widths.channels, known).reshape(widths.channels, rows)
    places = Places.by(classes, MAX_CLASS + 1)
    symbols = np.empty((widths.channels, rows), np.int32)
    places.put(decode_joined(data, places.sizes * widths.channels, known), symbols)
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
