"""Stages: channels payloads decoded one after another, so that a later one may be split by what an earlier one held.

What the sections of attributes and of planes share. Residuals that belong to one place (an anchor, a plane's cell)
tend to be large together; a channel is split into classes of places by the *activity* of the channels before it, and
each class has a prior of its own. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, repeat

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted, histogram, split_bits
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed

#: The two forms of a section: one payload of all its channels as they are, or a block and stages.
PLAIN, STAGED = 0, 1
MAX_CLASSES = 8
EXACT = 1 << 53  #: binary64 holds every integer up to here
#: Places of a channel: int64 [k], or slice(None), which is all of them.
Cells = np.ndarray | slice
#: Encoder: numbers of classes to try, and about what each further prior costs.
CLASS_COUNTS = (1, 2, 3, 4, 5, 6, 8)
PRIOR_BITS = 40


def relative_magnitude(residuals: np.ndarray, scale: Scale | None = None) -> np.ndarray:
    """int64 [n]: sum over channels of the magnitudes of residuals int [m, n] relative to their channel's mean, in
    units of 1/256. Below 2^8 m n.

    scale: of other residuals, if theirs are the means that count.
    """
    activity = Activity(residuals.shape[1], scale)
    for channel in residuals:
        activity.add(channel)
    return activity.now


@dataclass(frozen=True, eq=False)
class Scale:
    """By what relative magnitudes are measured. places: n. sums: of the magnitudes of each channel so far. A magnitude
    counts as no more than its channel's sum."""

    places: int
    sums: list[int] = field(default_factory=list)


class Activity:
    """The running sum of relative magnitudes, of n places and a scale. It adds the sums of channels that the scale does
    not have."""

    def __init__(self, places: int, scale: Scale | None = None):
        self.scale = scale or Scale(places)
        self._total = np.zeros(places)  # integers below 2^53
        self._channels = 0

    @property
    def now(self) -> np.ndarray:
        """int64 [n]."""
        return self._total.astype(np.int64)

    def add(self, residuals: np.ndarray, times: int = 1) -> None:
        """One more channel, int [n], as if it stood there so many times."""
        magnitude, sums = np.abs(residuals), self.scale.sums
        if self._channels == len(sums):
            sums.append(int(magnitude.sum(dtype=np.int64)))
        else:
            magnitude = np.minimum(magnitude, sums[self._channels])
        unit, divisor = self.scale.places << 8, sums[self._channels] + 1
        if int(magnitude.max(initial=0)) * unit < EXACT:
            # of integers below 2^53 the rounded quotient has the floor of the true one: processors divide reals faster
            shares = magnitude * float(unit)
            shares /= divisor
            np.floor(shares, out=shares)
        else:
            shares = (magnitude.astype(np.int64) * unit // divisor).astype(np.float64)
        self._total += shares * times if times > 1 else shares
        self._channels += 1


def activity_bounds(activity: np.ndarray, count: int) -> np.ndarray:
    """int64 [count - 1]: the activity at which each class but the first begins, so that places of this activity int64
    [n] fall into classes of about equal size."""
    bounds: np.ndarray = np.sort(activity)[[i * len(activity) // count for i in range(1, count)]]
    return bounds


def activity_classes(activity: np.ndarray, count: int) -> np.ndarray:
    """int64 [n] in 0..count-1: places by their activity int64 [n], in classes of about equal size."""
    return np.searchsorted(activity_bounds(activity, count), activity, side="right")


def places_of(classes: np.ndarray, count: int) -> list[np.ndarray]:
    """The places of each class, ascending."""
    return [np.flatnonzero(classes == k) for k in range(count)]


def cheapest_class_count(groups: Sequence[tuple[np.ndarray, np.ndarray]]) -> int:
    """Encoder: how many classes cost the (residuals int32 [m, n], activity int64 [n]) of a stage least."""
    costs = []
    for count in CLASS_COUNTS:
        bits = 0.0
        for residuals, activity in groups:
            bits += split_bits(residuals, activity_classes(activity, count), count) + PRIOR_BITS * count * len(
                residuals
            )
        costs.append((bits, count))
    return min(costs)[1]


@dataclass(frozen=True, eq=False)
class CodedSection:
    """Bytes of a section with its form in front, and the priors that each of its stages defined; one stage if plain."""

    data: bytes
    defined: list[list[Fitted]]


def smaller_form(
    channels: Callable[[], Iterable[np.ndarray]],
    staged: Callable[[], CodedSection] | None,
    priors: str,
    effort: int,
    known: Sequence[Fitted] = (),
) -> tuple[CodedSection, float]:
    """(section, sum of R(a) over all channels) of the int32 channels that `channels` gives anew at each call: plain, or
    what `staged` makes if it is shorter.

    The form is plain with priors "gauss", the model of R(a), at effort 1, and without `staged`. known: priors that the
    plain form may refer to.
    """
    found = list[CodedSection]()
    if staged is not None and priors == "best" and effort > 1:
        found.append(staged())
        if 8 * (len(found[0].data) - 1) <= sum(entropy_bits(channel) for channel in channels()):  # no plain is shorter
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
    """`front`, the lengths of all stages but the last, then their payloads. stages: taken one by one. known: by stage
    what it may refer to."""
    out = bytearray(front)
    pairs = zip(stages, repeat(()) if known is None else known, strict=known is not None)
    coded = [encode_channels(stage, effort=effort, known=k) for stage, k in pairs]
    for stage in coded[:-1]:
        put_varint(out, len(stage.payload))
    return CodedSection(bytes(out) + b"".join(stage.payload for stage in coded), [stage.defined for stage in coded])


def read_class_count(reader: ByteReader, stage: int) -> int:
    """A number of classes, 1..MAX_CLASSES."""
    count = reader.varint(MAX_CLASSES, f"the number of classes of stage {stage}")
    if not count:
        raise Malformed(f"stage {stage} has 0 classes, expected 1..{MAX_CLASSES}")
    return count


def read_stages(
    reader: ByteReader,
    number: int,
    places: Iterator[list[tuple[np.ndarray, Cells]]],
    known: Sequence[list[Prior]] | None = None,
) -> None:
    """Decodes `number` stages. `places` yields per stage, after those before are decoded, its channels: (int32 [n] to
    decode into, the places int64 [k] there). known: by stage the priors of payloads before, to which its own are
    appended."""
    lengths = [reader.varint(reader.remaining, f"the length of stage {stage}") for stage in range(number - 1)]
    rest = reader.rest()
    if sum(lengths) > len(rest):
        raise Malformed(f"stages of {sum(lengths)} bytes and more in the {len(rest)} that are left")
    bounds = [0, *accumulate(lengths), len(rest)]
    for stage, targets in enumerate(places):
        payload = rest[bounds[stage] : bounds[stage + 1]]
        decoded = decode_channels(
            payload,
            [len(channel) if isinstance(at, slice) else len(at) for channel, at in targets],
            known[stage] if known else None,
        )
        for (channel, at), values in zip(targets, decoded, strict=True):
            channel[at] = values
