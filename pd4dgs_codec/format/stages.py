"""Channels split into classes of places (clauses 8.5 and 8.7), and stages: groups of channels decoded in turn.

A place is an anchor or a cell of a plane. Each class of a channel has its own prior. Anchors have step classes. The
residuals of one cell tend to be large together, so planes are split by the *activity* of the channels in earlier
stages. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from pd4dgs_codec.entropy.channels import decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import split_bits
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed

MAX_CLASSES = 8
EXACT = 1 << 53  #: binary64 holds every integer up to here
SHARES = 1 << 16  #: values added to an activity at a time: many channels of small planes, few of large ones
#: Encoder: numbers of classes to try, and about the bits that a further prior costs.
CLASS_COUNTS = (1, 2, 3, 4, 5, 6, 8)
PRIOR_BITS = 40


class Activity:
    """Running sum over channels, at each of n places, of the magnitudes of residuals relative to their channel's mean,
    in units of 1/256. It is below 2^8 m n after m channels."""

    def __init__(self, places: int):
        self.now = np.zeros(places)  #: the current sum, integers below 2^53, float64 [n]; `add` changes it in place

    def add(self, residuals: np.ndarray) -> None:
        """Adds channels int [m, n]."""
        step = max(1, SHARES // max(1, residuals.shape[1]))
        for first in range(0, len(residuals), step):
            self._add(residuals[first : first + step])

    def _add(self, residuals: np.ndarray) -> None:
        shares = residuals.astype(np.float64)
        np.abs(shares, out=shares)
        sums, unit = shares.sum(axis=1, keepdims=True), len(self.now) << 8  # sums are below 2^53
        if int(shares.max(initial=0)) * unit < EXACT:
            # for integers below 2^53 the rounded quotient has the right floor, and floats divide faster
            shares *= unit
            shares /= sums + 1
            np.floor(shares, out=shares)
        else:
            shares = (shares.astype(np.int64) * unit // (sums.astype(np.int64) + 1)).astype(np.float64)
        self.now += shares.sum(axis=0)


def activity_classes(activity: np.ndarray, count: int) -> np.ndarray:
    """Returns classes uint8 [n], 0..count-1, of about equal size of places by their activity [n]."""
    at = np.arange(1, count) * len(activity) // count
    classes = np.zeros(len(activity), np.uint8)
    for bound in np.sort(activity)[at]:  # sort takes a tenth of the time of np.partition; a search of 7, several times
        classes += (activity >= bound).view(np.uint8)
    return classes


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


def coded_stages(front: bytearray, stages: Iterable[Sequence[np.ndarray]], effort: int) -> bytes:
    """Codes stages to a section: `front`, the payload lengths of all stages but the last, and the payloads.
    stages: consumed one by one."""
    out = bytearray(front)
    payloads = [encode_channels(stage, effort=effort).payload for stage in stages]
    for payload in payloads[:-1]:
        put_varint(out, len(payload))
    return bytes(out) + b"".join(payloads)


def read_class_count(reader: ByteReader, stage: int) -> int:
    """Reads a number of classes, 1..MAX_CLASSES. Raises Malformed or LimitExceeded."""
    count = reader.varint(MAX_CLASSES, f"the number of classes of stage {stage}")
    if not count:
        raise Malformed(f"stage {stage} has 0 classes, expected 1..{MAX_CLASSES}")
    return count


def read_stages(reader: ByteReader, number: int, groups: Iterator[list[Group]]) -> None:
    """Decodes `number` stages. groups: yields the targets of a stage once all earlier stages are decoded."""
    lengths = [reader.varint(reader.remaining, f"the length of stage {stage}") for stage in range(number - 1)]
    rest = reader.rest()
    if sum(lengths) > len(rest):
        raise Malformed(f"stages of {sum(lengths)} bytes or more, {len(rest)} bytes are left")
    bounds = [0, *accumulate(lengths), len(rest)]
    for stage, targets in enumerate(groups):
        payload = rest[bounds[stage] : bounds[stage + 1]]
        counts = [count for channels, places in targets for count in places.sizes * len(channels)]
        decoded, end = decode_joined(payload, counts), 0
        for channels, places in targets:
            first, end = end, end + len(channels) * sum(places.sizes)
            places.put(decoded[first:end], channels)
