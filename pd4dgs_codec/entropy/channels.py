"""Entropy coding of channels: int32 symbols <-> the codes and the ANS stream of a slice.

The *codes* have a record per non-empty channel: a varint token (family << 1 | has_exceptions), the parameters of a new
prior if the family is below 8, and the exceptions, if any: their number, and for each the gap to the previous position
and the distance outside the window. Family 8 + i stands for the prior defined i definitions before the latest of the
channel's prior list. The stream holds the symbols of all channels. Both are written and read in batches of channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pd4dgs_codec.entropy import EFFORTS, PRIORS
from pd4dgs_codec.entropy.ans import MAX_COUNT, AnsDecoder, ans_encode
from pd4dgs_codec.entropy.fitting import Fit, Fitted, fit_best, fit_gauss, histogram, plan_priors
from pd4dgs_codec.entropy.priors import (
    FIRST_REUSE,
    FREE_ENTRIES,
    K_MAX,
    Prior,
    Window,
    make_models,
    read_prior,
)
from pd4dgs_codec.entropy.varint import VARINT_MAX, ByteReader, put_varint
from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed


@dataclass(frozen=True, eq=False)
class _Exceptions:
    positions: np.ndarray  #: int64 [M], ascending
    values: np.ndarray  #: int [M]


def check_channels(channels: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Returns the channels as int32 [N]. Raises EncodeError unless each is a 1-D integer array, |k| <= 2**24."""
    checked = []
    for index, channel in enumerate(channels):
        array = np.asarray(channel)
        if array.ndim != 1 or array.dtype.kind not in "iu" or array.size > MAX_COUNT:
            raise EncodeError(
                f"channel {index}: expected 1-D integers, at most {MAX_COUNT}, found {array.dtype} {array.shape}"
            )
        if array.size and (int(array.min()) < -K_MAX or int(array.max()) > K_MAX):
            raise EncodeError(f"channel {index}: symbols {array.min()}..{array.max()}, limit |k| <= {K_MAX}")
        checked.append(array.astype(np.int32, copy=False))
    return checked


class ChannelWriter:
    """Codes the channels of a slice, batch by batch in the order of decoding.

    priors: "gauss" allows only const and gauss, the model of R(a). "best" allows every prior. effort: 1..9, time spent
    on fitting. known: the priors that earlier slices of the layer have defined; new ones are appended. Raises
    EncodeError.
    """

    def __init__(self, priors: str = "best", effort: int = 5, known: list[Fitted] | None = None):
        if priors not in PRIORS or effort not in EFFORTS:
            raise EncodeError(f"expected priors best or gauss and effort 1..9, found {priors!r} and {effort}")
        self.codes = bytearray()
        self._ends = [(0, 0)]  # of the batches so far: channels and bytes of codes
        self._fit: Fit = (lambda h: fit_best(h, effort)) if priors == "best" and effort > 1 else fit_gauss
        self._share = effort > 2
        self._known = [] if known is None else known
        # window entries that the batches may have beyond their symbols
        self._spare = max(FREE_ENTRIES - sum(fitted.prior.window.n for fitted in self._known), 0)
        self._symbols, self._cums = list[np.ndarray](), list[np.ndarray]()

    def write(self, channels: Sequence[np.ndarray], counted: int | None = None) -> float:
        """Codes channels int [any], |k| <= 2**24, as the next batch. Returns the sum of R(a).

        counted: symbols for which the windows may have an entry each, by default all; of further entries a batch uses
        at most half of what is left.
        """
        known, arrays = self._known, [array for array in check_channels(channels) if len(array)]
        histograms, first = [histogram(a) for a in arrays], len(known)
        counted = sum(map(len, arrays)) if counted is None else counted
        plan = plan_priors(histograms, self._fit, self._share, known, counted + self._spare // 2)
        for array, fitted in zip(arrays, plan, strict=True):
            window = fitted.prior.window
            inside, exceptions = _split(array, window)
            _write_channel(self.codes, fitted, exceptions, known)
            self._symbols.append(inside - window.kmin)
            self._cums.append(fitted.prior.cum)
        self._spare -= max(sum(fitted.prior.window.n for fitted in known[first:]) - counted, 0)
        self._ends.append((len(self._symbols), len(self.codes)))
        return sum(h.rate_bits for h in histograms)

    def finish(self) -> tuple[bytes, bytes, list[int]]:
        """Returns (codes, ANS stream, bits of each batch in both, but for the stream's rounding to words)."""
        sizes = list[int]()
        stream = ans_encode(self._symbols, self._cums, sizes)
        left = [*sizes[::-1], 0]  # of each channel and those behind it
        bits = [left[a] - left[b] + 8 * (end - start) for (a, start), (b, end) in pairwise(self._ends)]
        return bytes(self.codes), stream, bits


def _split(array: np.ndarray, window: Window) -> tuple[np.ndarray, _Exceptions]:
    if window.kmin <= int(array.min()) and int(array.max()) < window.end:  # nearly always
        nothing = np.zeros(0, np.int64)
        return array, _Exceptions(nothing, nothing)
    out = (array < window.kmin) | (array >= window.end)
    positions = np.flatnonzero(out)
    return array[~out], _Exceptions(positions, array[positions])


def _write_channel(out: bytearray, fitted: Fitted, exceptions: _Exceptions, known: list[Fitted]) -> None:
    """Writes a channel's record. If it defines its prior, this is appended to `known`."""
    prior = fitted.prior
    back = next((i for i, other in enumerate(reversed(known)) if other.prior is prior), None)
    family = prior.family if back is None else FIRST_REUSE + back
    put_varint(out, 2 * family + (len(exceptions.positions) > 0))
    if back is None:
        prior.write(out)
        known.append(fitted)
    if len(exceptions.positions):
        put_varint(out, len(exceptions.positions) - 1)
        kmin, end = prior.window.kmin, prior.window.end
        gaps = np.diff(exceptions.positions, prepend=-1) - 1
        for gap, value in zip(gaps.tolist(), exceptions.values.tolist(), strict=True):
            put_varint(out, gap)
            put_varint(out, 2 * (kmin - 1 - value) + 1 if value < kmin else 2 * (value - end))


def _read_exceptions(reader: ByteReader, count: int, window: Window) -> _Exceptions:
    at = reader.offset
    number = 1 + reader.varint(VARINT_MAX, "the number of exceptions")
    if number > (most := min(count, reader.remaining // 2)):
        raise Malformed(f"{number} exceptions, expected at most {most}", offset=at)
    positions, values, position = [], [], -1
    for _ in range(number):
        at = reader.offset
        position += 1 + reader.varint(VARINT_MAX, "an exception's position")
        code = reader.varint(4 * K_MAX + 2, "an exception's value")
        value = window.kmin - 1 - code // 2 if code & 1 else window.end + code // 2
        if position >= count or abs(value) > K_MAX:
            raise Malformed(f"exception {value} at symbol {position} of {count}, limit |k| <= {K_MAX}", offset=at)
        positions.append(position)
        values.append(value)
    return _Exceptions(np.array(positions, dtype=np.int64), np.array(values, dtype=np.int64))


class ChannelReader:
    """Decodes the channels of a slice, batch by batch: the inverse of ChannelWriter.

    symbols: number of symbols that the slices so far declare, which the caller has checked against its limits. known:
    the priors that earlier slices of the layer have defined; new ones are appended. Raises Malformed (cut, trailing or
    corrupt bytes), LimitExceeded, or UnsupportedFeature (a prior outside the registry).
    """

    def __init__(
        self, codes: bytes | memoryview, stream: bytes | memoryview, symbols: int, known: list[Prior] | None = None
    ):
        self.codes = ByteReader(codes)
        self._stream = AnsDecoder(stream)
        self._known = [] if known is None else known
        self._most = symbols + FREE_ENTRIES
        self._entries = sum(prior.window.n for prior in self._known)

    def read(self, counts: Sequence[int]) -> np.ndarray:
        """Decodes channels of these lengths into one array, int32 [sum of counts]."""
        known, heads = self._known, list[_Head]()
        first = len(known)
        for count in filter(None, counts):
            before = len(known)
            head = _read_channel(self.codes, count, known)
            if len(known) > before:
                self._entries += known[-1].window.n
                if self._entries > self._most:
                    raise LimitExceeded(f"tables of {self._entries} entries in one layer, limit {self._most}")
            elif heads and head[0] == heads[-1][0] and (longer := _joined(heads[-1], head)):
                heads[-1] = longer
                continue
            heads.append(head)
        make_models(known[first:])
        symbols, end = np.empty(sum(counts), np.int32), 0
        for index, count, exceptions in heads:
            end += count
            _take_channel(self._stream, known[index], exceptions, symbols[end - count : end])
        return symbols

    @property
    def bits(self) -> int:
        """Bits read from codes and stream, up to a constant; the difference of two values is what lies between."""
        return 8 * self.codes.offset - self._stream.left

    def finish(self) -> None:
        """Raises Malformed unless all codes and exactly the stream's symbols have been read."""
        if self.codes.remaining:
            raise Malformed(f"{self.codes.remaining} bytes of codes behind the last channel", offset=self.codes.offset)
        self._stream.finish()


def split(symbols: np.ndarray, counts: Sequence[int]) -> list[np.ndarray]:
    """Returns the parts of these lengths of an array [sum of counts]."""
    return np.split(symbols, np.cumsum(counts)[:-1]) if len(counts) else []


#: (index of a channel's prior, number of its symbols, its exceptions).
_Head = tuple[int, int, _Exceptions | None]


def _joined(one: _Head, next: _Head) -> _Head | None:
    """Returns one head for two consecutive channels of one prior, None if exceptions or MAX_COUNT forbid it."""
    (index, some, exceptions), (_, more, others) = one, next
    apart = exceptions or others or some + more > MAX_COUNT
    return None if apart else (index, some + more, None)


def _read_channel(reader: ByteReader, count: int, defined: list[Prior]) -> _Head:
    at = reader.offset
    token = reader.varint(2 * (FIRST_REUSE + MAX_COUNT), "a channel's prior")
    family = token >> 1
    if family < FIRST_REUSE:
        defined.append(read_prior(reader, family))
        index = len(defined) - 1
    else:
        index = len(defined) - 1 - (family - FIRST_REUSE)
        if index < 0:
            raise Malformed(f"a channel reuses prior {index}, expected 0..{len(defined) - 1}", offset=at)
    return index, count, _read_exceptions(reader, count, defined[index].window) if token & 1 else None


def _take_channel(stream: AnsDecoder, prior: Prior, exceptions: _Exceptions | None, out: np.ndarray) -> None:
    """Decodes a channel into `out` int32 [count]."""
    kmin = prior.window.kmin
    inside = stream.take(len(out) - (0 if exceptions is None else len(exceptions.positions)), prior.model)
    if exceptions is None:
        np.add(inside, kmin, out=out)
        return
    listed = np.zeros(len(out), dtype=bool)
    listed[exceptions.positions] = True
    out[listed], out[~listed] = exceptions.values, inside + np.int32(kmin)


# -- classes of places (clauses 8.5 to 8.7) ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Places:
    """The places of a channel's symbols, anchors or cells of a plane, in coding order: by class, then ascending. Each
    class of a channel is coded as a channel, with a prior of its own.

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
        """Writes the concatenated `parts` back into channels [m, n], which may be themselves."""
        rows = coded.reshape(len(channels), -1)
        if isinstance(self.order, slice):
            channels[:, self.order] = rows
            return
        rank = np.empty(channels.shape[1], np.int64)  # gathering by rank beats scattering by order
        rank[self.order] = np.arange(len(self.order))
        for symbols, channel in zip(rows, channels, strict=True):
            channel[:] = symbols.take(rank)
