"""Stages: channels payloads decoded one after another, so that a later one may be split by what an earlier one held.

What the sections of attributes and of planes share. Residuals that belong to one place (an anchor, a plane's cell)
tend to be large together; a channel is split into classes of places by the *activity* of the channels before it, and
each class has a prior of its own. All arithmetic is on integers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate

import numpy as np

from pd4dgs_codec.entropy.bits import entropy_bits
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.fitting import histogram, split_bits
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import Malformed

#: The two forms of a section: one payload of all its channels as they are, or a block and stages.
PLAIN, STAGED = 0, 1
MAX_CLASSES = 8
EXACT = 1 << 53  #: binary64 holds every integer up to here
#: Encoder: numbers of classes to try, and about what each further prior costs.
CLASS_COUNTS = (1, 2, 3, 4, 5, 6, 8)
PRIOR_BITS = 40


def relative_magnitude(residuals: np.ndarray) -> np.ndarray:
    """int64 [n]: sum over channels of the magnitudes of residuals int64 [m, n] relative to their channel's mean, in
    units of 1/256. Below 2^8 m n."""
    magnitude = np.abs(residuals)
    total: np.ndarray
    if int(magnitude.max(initial=0)) * (magnitude.shape[1] << 8) < EXACT:
        # of integers below 2^53 the rounded quotient has the floor of the true one, and processors divide reals faster
        shares = (magnitude * float(magnitude.shape[1] << 8)) / (magnitude.sum(axis=1, keepdims=True) + 1)
        total = np.floor(shares, out=shares).sum(axis=0).astype(np.int64)
    else:
        total = (magnitude * (magnitude.shape[1] << 8) // (magnitude.sum(axis=1, keepdims=True) + 1)).sum(axis=0)
    return total


def activity_classes(activity: np.ndarray, count: int) -> np.ndarray:
    """int64 [n] in 0..count-1: places by their activity int64 [n], in classes of about equal size."""
    bounds = np.sort(activity)[[i * len(activity) // count for i in range(1, count)]]
    return np.searchsorted(bounds, activity, side="right")


def places_of(classes: np.ndarray, count: int) -> list[np.ndarray]:
    """The places of each class, ascending."""
    return [np.flatnonzero(classes == k) for k in range(count)]


def cheapest_class_count(groups: Sequence[tuple[np.ndarray, np.ndarray]]) -> int:
    """Encoder: how many classes cost the (residuals int64 [m, n], activity int64 [n]) of a stage least."""
    costs = []
    for count in CLASS_COUNTS:
        bits = 0.0
        for residuals, activity in groups:
            bits += split_bits(residuals, activity_classes(activity, count), count) + PRIOR_BITS * count * len(
                residuals
            )
        costs.append((bits, count))
    return min(costs)[1]


def smaller_form(
    channels: Sequence[np.ndarray], staged: Callable[[], bytes] | None, priors: str, effort: int
) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over all channels) of channels int32: plain, or what `staged` makes if it is shorter.

    The form is plain with priors "gauss", the model of R(a), at effort 1, and without `staged`.
    """
    data = list[bytes]()
    if staged is not None and priors == "best" and effort > 1:
        data.append(staged())
        if 8 * (len(data[0]) - 1) <= sum(entropy_bits(channel) for channel in channels):  # plain cannot be shorter
            return data[0], sum(histogram(channel).rate_bits for channel in channels if channel.size)
    plain = encode_channels(channels, priors=priors, effort=effort)
    return min([bytes([PLAIN]) + plain.payload, *data], key=len), plain.rate_bits


def put_stages(out: bytearray, stages: Sequence[Sequence[np.ndarray]], effort: int) -> None:
    """Appends the lengths of all stages but the last, then their payloads."""
    payloads = [encode_channels(stage, effort=effort).payload for stage in stages]
    for payload in payloads[:-1]:
        put_varint(out, len(payload))
    out += b"".join(payloads)


def read_class_count(reader: ByteReader, stage: int) -> int:
    """A number of classes, 1..MAX_CLASSES."""
    count = reader.varint(MAX_CLASSES, f"the number of classes of stage {stage}")
    if not count:
        raise Malformed(f"stage {stage} has 0 classes, expected 1..{MAX_CLASSES}")
    return count


def read_stages(reader: ByteReader, number: int, places: Iterator[list[tuple[np.ndarray, np.ndarray]]]) -> None:
    """Decodes `number` stages. `places` yields per stage, after those before are decoded, its channels: (int64 [n] to
    decode into, the places int64 [k] there)."""
    lengths = [reader.varint(reader.remaining, f"the length of stage {stage}") for stage in range(number - 1)]
    rest = reader.rest()
    if sum(lengths) > len(rest):
        raise Malformed(f"stages of {sum(lengths)} bytes and more in the {len(rest)} that are left")
    bounds = [0, *accumulate(lengths), len(rest)]
    for stage, targets in enumerate(places):
        payload = rest[bounds[stage] : bounds[stage + 1]]
        decoded = decode_channels(payload, [len(at) for _, at in targets])
        for (channel, at), values in zip(targets, decoded, strict=True):
            channel[at] = values
