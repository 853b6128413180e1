"""Stages (clause 8.9): groups of channels that are decoded in turn, each split by the contents of earlier stages.

The sections of attributes and of planes share them. Residuals of one place (an anchor, a cell of a plane) tend to be
large together, so a channel is split into classes of places by the *activity* of earlier channels, and each class has
its own prior. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, repeat

import numpy as np

from pd4dgs_codec.entropy.channels import decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted, histogram, split_bits
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.tables import entropy_bits
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed

#: The two forms of a section: all channels as they are, or a block and stages.
PLAIN, STAGED = 0, 1
MAX_CLASSES = 8
EXACT = 1 << 53  #: binary64 holds every integer up to here
SHARES = 1 << 16  #: values added to an activity at a time: many channels of small planes, or one of many anchors
#: Encoder: numbers of classes to try, and about the bits that a further prior costs.
CLASS_COUNTS = (1, 2, 3, 4, 5, 6, 8)
PRIOR_BITS = 40


@dataclass(frozen=True, eq=False)
class Scale:
    """The scale of relative magnitudes. places: n. sums: of the magnitudes of each channel so far. A magnitude above
    its channel's sum counts as that sum."""

    places: int
    sums: list[int] = field(default_factory=list)


class Activity:
    """Running sum over channels, at each of n places, of the magnitudes of residuals relative to their channel's mean,
    in units of 1/256. It is below 2^8 m n after m channels. scale: of an earlier slice, whose means are used; channels
    that it lacks are added to it."""

    def __init__(self, places: int, scale: Scale | None = None):
        self.scale = scale or Scale(places)
        self._total = np.zeros(places)  # integers below 2^53
        self._channels = 0

    @property
    def now(self) -> np.ndarray:
        """The current sum, integers in float64 [n]; the next `add` changes it in place."""
        return self._total

    def add(self, residuals: np.ndarray, times: int = 1) -> None:
        """Adds channels int [m, n], each `times` times."""
        step = max(1, SHARES // max(1, residuals.shape[1]))
        for first in range(0, len(residuals), step):
            self._add(residuals[first : first + step], times)

    def _add(self, residuals: np.ndarray, times: int) -> None:
        shares, sums = residuals.astype(np.float64), self.scale.sums
        np.abs(shares, out=shares)
        end = self._channels + len(shares)
        sums += map(int, shares[len(sums) - end :].sum(axis=1).tolist() if len(sums) < end else ())  # below 2^53
        of_each = np.array(sums[self._channels : end], np.float64)[:, None]
        self._channels = end
        np.minimum(shares, of_each, out=shares)
        unit = self.scale.places << 8
        if (int(of_each.max()) + 1) * unit <= EXACT or int(shares.max(initial=0)) * unit < EXACT:
            # for integers below 2^53 the rounded quotient has the right floor, and floats divide faster
            shares *= unit
            shares /= of_each + 1
            np.floor(shares, out=shares)
        else:
            shares = (shares.astype(np.int64) * unit // (of_each.astype(np.int64) + 1)).astype(np.float64)
        if times > 1:
            shares *= times
        self._total += shares.sum(axis=0)


def activity_bounds(activity: np.ndarray, count: int) -> np.ndarray:
    """Returns the activities [count - 1] at which all classes but the first begin, so that places with this activity
    [n] form classes of about equal size."""
    at = np.arange(1, count) * len(activity) // count
    bounds: np.ndarray = np.sort(activity)[at]  # a tenth of the time of np.partition
    return bounds


def classes_within(activity: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Returns the classes uint8 [n] of places by their activity [n] and the bounds of `activity_bounds`."""
    classes = np.zeros(len(activity), np.uint8)
    for bound in bounds:  # at most 7: a search would take several times as long
        classes += (activity >= bound).view(np.uint8)
    return classes


def activity_classes(activity: np.ndarray, count: int) -> np.ndarray:
    """Returns classes uint8 [n], 0..count-1, of about equal size of places by their activity [n]."""
    return classes_within(activity, activity_bounds(activity, count))


@dataclass(frozen=True, eq=False)
class Places:
    """The places of a channel's symbols in coding order: by class, then ascending.

    order: int64 [n], or slice(None) for the order as it is. sizes: number of places in each class.
    """

    order: np.ndarray | slice
    sizes: tuple[int, ...]

    @staticmethod
    def whole(n: int) -> Places:
        """Returns all n places in one class."""
        return Places(slice(None), (n,))

    @staticmethod
    def by(classes: np.ndarray, count: int) -> Places:
        """Returns places by classes int [n] in 0..count-1, with count below 256; classes may be empty."""
        classes = classes.astype(np.uint8, copy=False)  # numpy sorts bytes by counting
        sizes = tuple(np.bincount(classes, minlength=count).tolist())
        return Places(np.argsort(classes, kind="stable"), sizes)

    def parts(self, channels: np.ndarray) -> Iterator[np.ndarray]:
        """Yields the coded parts of channels [m, n]: for each channel in turn, each class."""
        for channel in channels:
            ordered, end = channel[self.order], 0
            for size in self.sizes:
                yield ordered[end : end + size]
                end += size

    def put(self, coded: np.ndarray, channels: np.ndarray) -> None:
        """Writes the concatenated `parts` back into channels [m, n]."""
        rows = coded.reshape(len(channels), -1)
        if isinstance(self.order, slice):
            channels[:, self.order] = rows
            return
        rank = np.empty(channels.shape[1], np.int64)  # gathering by rank beats scattering by order
        rank[self.order] = np.arange(len(self.order))
        for symbols, channel in zip(rows, channels, strict=True):
            channel[:] = symbols.take(rank)


#: Channels of a stage, int [m, n], and where their symbols belong.
Group = tuple[np.ndarray, Places]


def parts_of(groups: Iterable[Group]) -> list[np.ndarray]:
    """Returns the channels that a stage codes."""
    return [part for channels, places in groups for part in places.parts(channels)]


def cheapest_class_count(groups: Sequence[tuple[np.ndarray, np.ndarray]]) -> int:
    """Encoder: the number of classes that takes the fewest bits, for (residuals int32 [m, n], activity [n])."""
    costs = []
    for count in CLASS_COUNTS:
        bits = 0.0
        for residuals, activity in groups:
            classes = activity_classes(activity, count).astype(np.int64)
            bits += split_bits(residuals, classes, count) + PRIOR_BITS * count * len(residuals)
        costs.append((bits, count))
    return min(costs)[1]


@dataclass(frozen=True, eq=False)
class CodedSection:
    """Bytes of a section, its form first, and the priors that each of its stages defines; one stage if plain."""

    data: bytes
    defined: list[list[Fitted]]


def smaller_form(
    channels: Callable[[], Iterable[np.ndarray]],
    staged: Callable[[], CodedSection] | None,
    priors: str,
    effort: int,
    known: Sequence[Fitted] = (),
) -> tuple[CodedSection, float]:
    """Returns (section, sum of R(a) over all channels): plain, or the result of `staged` if that is shorter.

    channels: returns the int32 channels at each call. The form is always plain with priors "gauss", at effort 1, and
    without `staged`. known: priors that the plain form may refer to.
    """
    found = list[CodedSection]()
    if staged is not None and priors == "best" and effort > 1:
        found.append(staged())
        if 8 * (len(found[0].data) - 1) <= sum(
            entropy_bits(channel) for channel in channels()
        ):  # the plain form is not shorter
            return found[0], sum(histogram(channel).rate_bits for channel in channels() if channel.size)
    plain = encode_channels(list(channels()), priors=priors, effort=effort, known=known)
    found.insert(0, CodedSection(bytes([PLAIN]) + plain.payload, [plain.defined]))
    return min(found, key=lambda section: len(section.data)), plain.rate_bits


def coded_stages(
    front: bytearray,
    stages: Iterable[Sequence[np.ndarray]],
    effort: int,
    known: Iterable[Sequence[Fitted]] | None = None,
) -> CodedSection:
    """Codes stages to a section: `front`, the payload lengths of all stages but the last, and the payloads.
    stages: consumed one by one. known: priors that each stage may refer to."""
    out = bytearray(front)
    pairs = zip(stages, repeat(()) if known is None else known, strict=known is not None)
    coded = [encode_channels(stage, effort=effort, known=k) for stage, k in pairs]
    for stage in coded[:-1]:
        put_varint(out, len(stage.payload))
    return CodedSection(bytes(out) + b"".join(stage.payload for stage in coded), [stage.defined for stage in coded])


def read_class_count(reader: ByteReader, stage: int) -> int:
    """Reads a number of classes, 1..MAX_CLASSES. Raises Malformed or LimitExceeded."""
    count = reader.varint(MAX_CLASSES, f"the number of classes of stage {stage}")
    if not count:
        raise Malformed(f"stage {stage} has 0 classes, expected 1..{MAX_CLASSES}")
    return count


def read_stages(
    reader: ByteReader, number: int, groups: Iterator[list[Group]], known: Sequence[list[Prior]] | None = None
) -> None:
    """Decodes `number` stages. groups: yields the targets of a stage once all earlier stages are decoded. known: priors
    of earlier slices by stage, to which new ones are appended."""
    lengths = [reader.varint(reader.remaining, f"the length of stage {stage}") for stage in range(number - 1)]
    rest = reader.rest()
    if sum(lengths) > len(rest):
        raise Malformed(f"stages of {sum(lengths)} bytes or more, {len(rest)} bytes are left")
    bounds = [0, *accumulate(lengths), len(rest)]
    for stage, targets in enumerate(groups):
        payload = rest[bounds[stage] : bounds[stage + 1]]
        counts = [count for channels, places in targets for count in places.sizes * len(channels)]
        decoded, end = decode_joined(payload, counts, known[stage] if known else None), 0
        for channels, places in targets:
            first, end = end, end + len(channels) * sum(places.sizes)
            places.put(decoded[first:end], channels)
