"""Raw LZMA2 streams whose bytes hang on nothing but this text: a library's encoder may change with its version."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

STORED_MAX = 1 << 16  #: bytes in one stored chunk
MATCH_MAX = 273
KEY = 4  #: bytes of the shortest match with a distance of its own
#: Control bytes (clause 9.3); a compressed chunk's has the upper bits of its size added.
STORED_RESET, STORED, KEPT, STATE, PROPERTIES_READ, ALL_RESET = 1, 2, 0x80, 0xA0, 0xC0, 0xE0
Properties = tuple[int, int, int]  #: lc, lp, pb


def stored(data: bytes) -> bytes:
    """A stream of stored chunks, the first of which resets the dictionary."""
    sizes = [min(STORED_MAX, len(data) - start) for start in range(0, len(data), STORED_MAX)]
    return chunks(data, [(STORED if i else STORED_RESET, size) for i, size in enumerate(sizes)])


def packed(data: bytes, properties: Properties = (3, 0, 0), **how: Any) -> bytes:
    """A stream of one compressed chunk: literals and matches. how: see chunks."""
    return chunks(data, [(ALL_RESET, len(data))], [properties], **how)


def chunks(
    data: bytes,
    plan: Sequence[tuple[int, int]],
    properties: Sequence[Properties] = (),
    *,
    remember: bool = False,
    body: Callable[[bytes], bytes] = lambda packed: packed,
) -> bytes:
    """A stream of `data` in chunks. plan: control byte and unpacked size of each. properties: of those chunks that hold
    them, in order. remember: match what lies before a reset of the dictionary, which is wrong. body: changes the packed
    bytes of each compressed chunk."""
    out, encoder, start, given = bytearray(), _Encoder(data), 0, iter(properties)
    for control, size in plan:
        head, content = (size - 1 & 0xFFFF).to_bytes(2, "big"), data[start : start + size]
        if control in (STORED_RESET, ALL_RESET):
            encoder.origin = start
            encoder.reach = 0 if remember else start
        if control >= PROPERTIES_READ:
            encoder.lc, encoder.lp, encoder.pb = next(given)
        if control >= KEPT:
            if control >= STATE:
                encoder.reset()
            content = body(encoder.encode(start, start + size))
            head += (len(content) - 1).to_bytes(2, "big")
        if control >= PROPERTIES_READ:
            head += bytes([encoder.lc + 9 * (encoder.lp + 5 * encoder.pb)])
        out += bytes([control | size - 1 >> 16]) + head + content
        start += size
    return bytes(out) + b"\0"


class _Encoder:
    """LZMA's range coder with adaptive bits, as the public LZMA specification has it, and greedy matches: the
    longest of those at the last four distances, at distance 1 and at the latest place of the same bytes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._latest = data, dict[bytes, int]()
        self.origin = self.reach = self.lc = self.lp = self.pb = 0
        self.reset()

    def reset(self) -> None:
        """Forget the state."""
        self._probabilities: dict[tuple, int] = {}
        self._state, self._distances = 0, [1] * 4

    def encode(self, start: int, end: int) -> bytes:
        """The packed bytes of data[start:end]."""
        self._low, self._range, self._shifts = 0, 0xFFFFFFFF, 0  # low has all bytes so far
        data, at = self._data, start
        while at < end:
            key, last = data[at : at + KEY], self._distances
            lengths = {d: self._matching(at, d, end) for d in (*last, 1, at - self._latest.get(key, at))}
            distance = max(lengths, key=lengths.__getitem__)
            if (size := lengths[distance]) < (2 if distance in last else KEY):
                distance, size = last[0], min(1, lengths[last[0]])
            if size:
                self._match(at, distance, last.index(distance) if distance in last else None, size)
            else:
                self._literal(at)
            for place in range(at, at + max(1, size)):
                self._latest[data[place : place + KEY]] = place
            at += max(1, size)
        return self._low.to_bytes(5 + self._shifts, "big")

    def _matching(self, at: int, distance: int, end: int) -> int:
        """How many bytes at `at` are those `distance` before them."""
        if not 0 < distance <= at - self.reach:
            return 0
        longest = min(MATCH_MAX, end - at)
        here, before = (self._data[place : place + longest] for place in (at, at - distance))
        if here == before:  # at once: a bomb of 2^21 zeros is nothing else
            return longest
        return next(size for size in range(longest) if here[size] != before[size])

    def _match(self, at: int, distance: int, which: int | None, size: int) -> None:
        """A match; which: of the last distances, None for a distance of its own."""
        state, low = self._state, at - self.origin & (1 << self.pb) - 1
        self._bit(("match", state, low), 1)
        self._bit(("rep", state), which is not None)
        if which is None:
            self._length("match", size - 2, low)
            self._distance(distance - 1, min(size - 2, 3))
            self._distances = [distance, *self._distances[:3]]
            self._state = 7 if state < 7 else 10
            return
        self._bit(("rep0", state), which > 0)
        if which == 0:
            self._bit(("rep0 long", state, low), size > 1)
        else:
            self._bit(("rep1", state), which > 1)
            if which > 1:
                self._bit(("rep2", state), which > 2)
            self._distances.insert(0, self._distances.pop(which))
        if size > 1:
            self._length("rep", size - 2, low)
        self._state = (8 if size > 1 else 9) if state < 7 else 11

    def _literal(self, at: int) -> None:
        """The byte at `at`; behind a match, given the byte that would have gone on with it."""
        state, place = self._state, at - self.origin
        self._bit(("match", state, place & (1 << self.pb) - 1), 0)
        byte, before = self._data[at], self._data[at - 1] if place else 0
        expected, symbol, offset = self._data[at - self._distances[0]], 1, 0x100 if state >= 7 else 0
        for shift in range(7, -1, -1):
            bit, match = byte >> shift & 1, expected >> shift & 1
            branch = offset + (offset if match else 0)
            self._bit(("literal", place & (1 << self.lp) - 1, before >> 8 - self.lc, branch + symbol), bit)
            symbol = symbol << 1 | bit
            offset = offset if match == bit else 0
        self._state = 0 if state < 4 else state - (3 if state < 10 else 6)

    def _length(self, kind: str, code: int, low: int) -> None:
        """Length - 2 in 0..271."""
        group = (code >= 8) + (code >= 16)
        self._bit((kind, "choice", 0), group > 0)
        if group:
            self._bit((kind, "choice", 1), group > 1)
        self._tree((kind, group, 0 if group == 2 else low), code - 8 * group, range(7 if group == 2 else 2, -1, -1))

    def _distance(self, code: int, length_state: int) -> None:
        """Distance - 1."""
        bits = max(code.bit_length() - 2, 0)  # below the two leading ones
        slot = code if code < 4 else 2 * (bits + 1) + (code >> bits & 1)
        self._tree(("slot", length_state), slot, range(5, -1, -1))
        if code >= 4 and slot < 14:
            self._tree(("distance", slot), code, range(bits))
        elif code >= 4:
            for shift in range(bits - 1, 3, -1):
                self._range >>= 1
                self._low += self._range * (code >> shift & 1)
                self._normalise()
            self._tree(("align",), code, range(4))

    def _tree(self, name: tuple, value: int, shifts: Iterable[int]) -> None:
        """The bits of `value` at these shifts, each by the probability that belongs to those before it."""
        symbol = 1
        for shift in shifts:
            bit = value >> shift & 1
            self._bit((*name, symbol), bit)
            symbol = symbol << 1 | bit

    def _bit(self, context: tuple, bit: int) -> None:
        p = self._probabilities.get(context, 1 << 10)
        bound = (self._range >> 11) * p
        if bit:
            self._low += bound
            self._range -= bound
        else:
            self._range = bound
        self._probabilities[context] = p - (p >> 5) if bit else p + ((1 << 11) - p >> 5)
        self._normalise()

    def _normalise(self) -> None:
        if self._range < 1 << 24:
            self._range <<= 8
            self._low <<= 8
            self._shifts += 1
