"""Channels split into classes of places, each with its own prior (clauses 8.5 to 8.7), and the attributes section.

A place is an anchor or a cell of a plane. Anchors have step classes. The residuals of one cell tend to be large
together, so the channels of a plane are split by the *activity* of the channels before. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.entropy.channels import decode_channels, decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted, entropy_bits
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.quantise import NO_CLASSES
from pd4dgs_codec.scene import MAX_CLASS, Widths

CLASSES = 8  #: of the cells of a plane by their activity
EXACT = 1 << 53  #: binary64 holds every integer up to here


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


# -- activity ----------------------------------------------------------------------------------------------------------


def relative_magnitude(residuals: np.ndarray) -> np.ndarray:
    """Returns, at each of n places, the sum over channels int [m, n] of the magnitudes relative to their channel's
    mean, in units of 1/256: integers below 2^8 m n in float64 [n]."""
    total, unit = np.zeros(residuals.shape[1]), residuals.shape[1] << 8
    for channel in residuals:
        shares = np.abs(channel.astype(np.float64))
        divisor = shares.sum() + 1  # below 2^53
        if int(shares.max(initial=0)) * unit < EXACT:
            # for integers below 2^53 the rounded quotient has the right floor, and floats divide faster
            shares *= unit
            shares /= divisor
            total += np.floor(shares, out=shares)
        else:
            total += shares.astype(np.int64) * unit // int(divisor)
    return total


def activity_classes(activity: np.ndarray) -> np.ndarray:
    """Returns classes uint8 [n], 0..CLASSES-1, of about equal size of places by their activity [n]."""
    at = np.arange(1, CLASSES) * len(activity) // CLASSES
    classes = np.zeros(len(activity), np.uint8)
    for bound in np.sort(activity)[at]:  # sort takes a tenth of the time of np.partition; a search of 7, several times
        classes += (activity >= bound).view(np.uint8)
    return classes


# -- the attributes section of mode ans (clause 8.5): features, log-scalings and offsets by step class -----------------


def write_attributes(
    attributes: np.ndarray, classes: np.ndarray, priors: str, effort: int, known: list[Fitted]
) -> tuple[bytes, float]:
    """Returns (section bytes, bits of R(a) of all channels by step class and of the step classes).

    attributes: int32 [channels, n]. classes: int32 [n], or NO_CLASSES. known: priors of the layer's earlier slices, to
    which those of this one are added.
    """
    coded = encode_channels(list(by_class(attributes, classes)), priors=priors, effort=effort, known=known)
    known += coded.defined
    if not classes.size:
        return coded.payload, coded.rate_bits
    out, graded = bytearray(), encode_channels([classes], effort=effort).payload
    put_varint(out, len(graded))
    return bytes(out + graded + coded.payload), coded.rate_bits + entropy_bits(classes)


def by_class(attributes: np.ndarray, classes: np.ndarray) -> Iterator[np.ndarray]:
    """Yields the coded channels, int [n]: each channel's rows of class 0 .. MAX_CLASS, or all without classes."""
    yield from Places.by(classes, MAX_CLASS + 1).parts(attributes) if classes.size else attributes


def read_attributes(
    data: bytes, widths: Widths, rows: int, known: list[Prior] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (classes int32 [rows] or NO_CLASSES, attributes int32 [channels, rows]); the inverse of write_attributes.
    rows: already checked against the limits. known: priors of the layer's earlier slices, to which those of this one
    are added."""
    if not widths.graded:
        return NO_CLASSES, decode_joined(data, [rows] * widths.channels, known).reshape(widths.channels, rows)
    reader = ByteReader(data)
    length = reader.varint(reader.remaining, "the length of the step classes")
    (classes,) = decode_channels(reader.take(length), [rows])
    check_classes(classes)
    places, attributes = Places.by(classes, MAX_CLASS + 1), np.empty((widths.channels, rows), np.int32)
    places.put(decode_joined(reader.rest(), places.sizes * widths.channels, known), attributes)
    return classes, attributes


def check_classes(classes: np.ndarray) -> None:
    """Raises Malformed unless classes int32 [n] are in 0..MAX_CLASS."""
    if classes.size and not (0 <= classes.min() and classes.max() <= MAX_CLASS):
        raise Malformed(f"step classes in {int(classes.min())}..{int(classes.max())}, expected 0..{MAX_CLASS}")
