"""The attributes section of mode ans (clause 8.5): the channels of features, log-scalings and offsets by step class."""

from collections.abc import Iterator

import numpy as np

from pd4dgs_codec.entropy.channels import decode_channels, decode_joined, encode_channels
from pd4dgs_codec.entropy.fitting import Fitted
from pd4dgs_codec.entropy.priors import Prior
from pd4dgs_codec.entropy.tables import entropy_bits
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format.classes import Places
from pd4dgs_codec.format.quantise import NO_CLASSES
from pd4dgs_codec.scene import MAX_CLASS, Widths


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
