"""The attributes section of mode ans: 68 channels as they are, or with what one channel tells of another taken out.

Byte 0 is the form. Form 0: the rest is one channels payload of the 68 channels. Form 1: a block of varints, then
three channels payloads, the *stages*, each decoded before the next. All arithmetic is on integers.

*Linear prediction*, channels 1..37 (features, log-scalings): for channel c a varint m <= c, then m terms in ascending
order of the channel j they refer to: a varint j - (previous j) - 1, starting from previous j = -1, and a zigzag weight
w, |w| <= 2^15. Coded is the residual k_c - ((sum_j w_j k_j + 512) >> 10), the shift rounding down.

*Classes*, channels 38..67 (offsets x, y, z of ten Gaussians): per Gaussian a varint f in 0..3: bit 0, y is split by x;
bit 1, z is split by x and y. If f > 0 follow a zigzag centre of x and, if bit 1 is set, one of y, each |.| <= 2^24 - 1.
The symbols of a split y go, in row order, to class min(|x - centre_x|, 4), those of a split z to class
min(|x - centre_x| + |y - centre_y|, 6).

The block ends with the varint lengths of stages 0 and 1. Stage 0 holds the channels that are not split, in order; stage
1 the split y, each as its 5 classes in order; stage 2 the split z, each as its 7 classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.attributes.table import N_CHANNELS
from pd4dgs_codec.entropy.channels import decode_channels, encode_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.entropy.varint import ByteReader, put_varint, put_zigzag
from pd4dgs_codec.errors import Malformed, UnsupportedFeature
from pd4dgs_codec.scene import FEATURE_DIM, N_OFFSETS, SCALING_DIM

PLAIN, PREDICTED = 0, 1
N_PREDICTED = FEATURE_DIM + SCALING_DIM
WEIGHT_SHIFT = 10
MAX_WEIGHT = 1 << 15
Y_CLASSES, Z_CLASSES = 5, 7
SPLIT_Y, SPLIT_Z = 1, 2

#: Encoder: a term must explain this share of its channel's spread; a term costs about so many bits.
MIN_SHARE = 0.03
TERM_BITS = 24


@dataclass(frozen=True)
class Terms:
    """The linear prediction of one channel: channels int64 [m] and weights int64 [m] in units of 2^-10."""

    channels: np.ndarray
    weights: np.ndarray

    def prediction(self, symbols: np.ndarray) -> np.ndarray:
        """int64 [n] from symbols int64 [>= max channel + 1, n]."""
        return (self.weights @ symbols[self.channels] + (1 << WEIGHT_SHIFT >> 1)) >> WEIGHT_SHIFT


@dataclass(frozen=True)
class Split:
    """How one Gaussian's offsets are split into classes: flags and the centres of x and y."""

    flags: int
    centre_x: int = 0
    centre_y: int = 0

    def y_classes(self, x: np.ndarray) -> np.ndarray:
        """int64 [n] in 0..4."""
        return np.minimum(np.abs(x - self.centre_x), Y_CLASSES - 1)

    def z_classes(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """int64 [n] in 0..6."""
        return np.minimum(np.abs(x - self.centre_x) + np.abs(y - self.centre_y), Z_CLASSES - 1)


def _x_of(gaussian: int) -> int:
    return N_PREDICTED + 3 * gaussian


# -- writing -----------------------------------------------------------------------------------------------------------


def write_attributes(attributes: np.ndarray, priors: str, effort: int) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over the 68 channels) of attributes int32 [68, n]; the smaller of both forms.

    With priors "gauss", the model of R(a), the form is plain.
    """
    plain = encode_channels(list(attributes), priors=priors, effort=effort)
    data = bytes([PLAIN]) + plain.payload
    if priors == "best" and effort > 1 and attributes.shape[1] > 1:
        predicted = _write_predicted(attributes.astype(np.int64), effort)
        data = min(data, predicted, key=len)
    return data, plain.rate_bits


def _write_predicted(symbols: np.ndarray, effort: int) -> bytes:
    terms = [_fit_terms(symbols, c) for c in range(1, N_PREDICTED)]
    splits = [_fit_split(*symbols[_x_of(i) : _x_of(i) + 3]) for i in range(N_OFFSETS)]
    out = bytearray([PREDICTED])
    for term in terms:
        put_varint(out, len(term.channels))
        for gap, weight in zip(np.diff(term.channels, prepend=-1) - 1, term.weights, strict=True):
            put_varint(out, int(gap))
            put_zigzag(out, int(weight))
    for split in splits:
        put_varint(out, split.flags)
        if split.flags:
            put_zigzag(out, split.centre_x)
        if split.flags & SPLIT_Z:
            put_zigzag(out, split.centre_y)
    coded = symbols.copy()
    for c, term in enumerate(terms, start=1):
        coded[c] = symbols[c] - term.prediction(symbols)
    stages = [encode_channels(stage, effort=effort).payload for stage in _stages(coded, splits)]
    put_varint(out, len(stages[0]))
    put_varint(out, len(stages[1]))
    return bytes(out) + b"".join(stages)


def _stages(coded: np.ndarray, splits: Sequence[Split]) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    whole, ys, zs = list(coded[:N_PREDICTED]), [], []
    for i, split in enumerate(splits):
        x, y, z = coded[_x_of(i) : _x_of(i) + 3]
        whole.append(x)
        if split.flags & SPLIT_Y:
            ys += [y[split.y_classes(x) == k] for k in range(Y_CLASSES)]
        else:
            whole.append(y)
        if split.flags & SPLIT_Z:
            zs += [z[split.z_classes(x, y) == k] for k in range(Z_CLASSES)]
        else:
            whole.append(z)
    return whole, ys, zs


def _fit_terms(symbols: np.ndarray, c: int) -> Terms:
    """Least squares of channel c on those before it, weak terms dropped; no terms unless the entropy gains by them."""
    nothing = Terms(np.zeros(0, np.int64), np.zeros(0, np.int64))
    centred = (symbols[: c + 1] - symbols[: c + 1].mean(axis=1, keepdims=True)).astype(np.float64)
    covariance = centred @ centred.T / symbols.shape[1] + 0.08 * np.eye(c + 1)  # 1/12: the symbols' own rounding
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
    return terms if _entropy(residual) + TERM_BITS * len(terms.channels) < _entropy(symbols[c]) else nothing


def _fit_split(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Split:
    centre_x, centre_y = _mode(x), _mode(y)
    split = Split(SPLIT_Y | SPLIT_Z, centre_x, centre_y)
    flags = SPLIT_Y * _gains(y, split.y_classes(x)) | SPLIT_Z * _gains(z, split.z_classes(x, y))
    return Split(flags, centre_x, centre_y) if flags else Split(0)


def _gains(symbols: np.ndarray, classes: np.ndarray) -> bool:
    """Whether a prior per class pays, at about 80 bits each."""
    parts = [symbols[classes == k] for k in range(int(classes.max()) + 1)]
    return sum(_entropy(part) + 80 for part in parts) < _entropy(symbols) + 80


def _mode(symbols: np.ndarray) -> int:
    values, counts = np.unique(symbols, return_counts=True)
    return int(values[counts.argmax()])


def _entropy(symbols: np.ndarray) -> float:
    """Empirical order-0 entropy of all symbols, bits."""
    counts = np.unique(symbols, return_counts=True)[1]
    return float(counts @ np.log2(symbols.size / counts)) if symbols.size else 0.0


# -- reading -----------------------------------------------------------------------------------------------------------


def read_attributes(data: bytes, rows: int) -> np.ndarray:
    """attributes int32 [68, rows]; the inverse of write_attributes. rows was checked against the limits before."""
    reader = ByteReader(data)
    form = reader.byte("the form of the attributes")
    if form == PLAIN:
        return np.stack(decode_channels(reader.rest(), [rows] * N_CHANNELS))
    if form != PREDICTED:
        raise UnsupportedFeature(f"form {form} of the attributes, expected {PLAIN} or {PREDICTED}")
    terms = [_read_terms(reader, c) for c in range(1, N_PREDICTED)]
    splits = [_read_split(reader) for _ in range(N_OFFSETS)]
    lengths = [reader.varint(len(data), f"the length of stage {stage}") for stage in (0, 1)]
    rest = reader.rest()
    if sum(lengths) > len(rest):
        raise Malformed(f"stages of {lengths} bytes in the {len(rest)} that are left")
    stages = rest[: lengths[0]], rest[lengths[0] : sum(lengths)], rest[sum(lengths) :]

    whole = 3 * N_OFFSETS - sum(split.flags.bit_count() for split in splits)
    symbols = np.zeros((N_CHANNELS, rows), np.int64)
    unsplit = iter(decode_channels(stages[0], [rows] * (N_PREDICTED + whole)))
    for c in range(N_PREDICTED):
        symbols[c] = next(unsplit)
    for i, split in enumerate(splits):
        symbols[_x_of(i)] = next(unsplit)
        for axis, flag in ((1, SPLIT_Y), (2, SPLIT_Z)):
            if not split.flags & flag:
                symbols[_x_of(i) + axis] = next(unsplit)
    for c, term in enumerate(terms, start=1):
        symbols[c] += term.prediction(symbols)
    split_y = [
        (_x_of(i) + 1, s.y_classes(symbols[_x_of(i)]), Y_CLASSES) for i, s in enumerate(splits) if s.flags & SPLIT_Y
    ]
    _read_classes(stages[1], symbols, split_y)
    split_z = [
        (_x_of(i) + 2, s.z_classes(*symbols[_x_of(i) : _x_of(i) + 2]), Z_CLASSES)
        for i, s in enumerate(splits)
        if s.flags & SPLIT_Z
    ]
    _read_classes(stages[2], symbols, split_z)
    if symbols.size and max(int(symbols.max()), -int(symbols.min())) > K_MAX:
        raise Malformed(f"a predicted attribute over {K_MAX} in magnitude")
    return symbols.astype(np.int32)


def _read_terms(reader: ByteReader, c: int) -> Terms:
    channels, weights, last = [], [], -1
    for _ in range(reader.varint(c, f"the number of terms of channel {c}")):
        last += 1 + reader.varint(N_PREDICTED, f"a term of channel {c}")
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


def _read_classes(data: memoryview, symbols: np.ndarray, channels: Sequence[tuple[int, np.ndarray, int]]) -> None:
    """Decodes a stage's classes into their rows of `symbols`; channels: (channel, class per row, number of classes)."""
    places = [(c, np.flatnonzero(classes == k)) for c, classes, count in channels for k in range(count)]
    for (c, rows), values in zip(places, decode_channels(data, [len(rows) for _, rows in places]), strict=True):
        symbols[c, rows] = values
