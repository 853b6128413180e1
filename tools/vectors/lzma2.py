"""Raw LZMA2 streams whose bytes hang on nothing but this text: a library's encoder may change with its version."""

from __future__ import annotations

STORED_MAX = 1 << 16  #: bytes in one stored chunk
PACKED_MAX = 1 << 21  #: bytes that one compressed chunk may unpack to
MATCH_MAX = 273
_LC = 3  # bits of the byte before that choose a literal's probabilities; lp = pb = 0
PROPERTIES = _LC
_KEY = 4  # bytes of the shortest match with a distance of its own


def stored(data: bytes) -> bytes:
    """A stream of stored chunks, the first of which resets the dictionary."""
    out = bytearray()
    for start in range(0, len(data), STORED_MAX):
        part = data[start : start + STORED_MAX]
        out += bytes([2 if start else 1]) + (len(part) - 1).to_bytes(2, "big") + part
    return bytes(out) + b"\0"


def packed(data: bytes) -> bytes:
    """A stream of one compressed chunk: literals and matches."""
    assert 0 < len(data) <= PACKED_MAX
    body = _Encoder(data).encode()
    size = len(data) - 1
    head = bytes([0xE0 | size >> 16]) + (size & 0xFFFF).to_bytes(2, "big") + (len(body) - 1).to_bytes(2, "big")
    return head + bytes([PROPERTIES]) + body + b"\0"


class _Encoder:
    """LZMA's range coder with adaptive bits, as the public LZMA specification has it, and a greedy choice of matches.

    A match is the longest of those at the distance of the match before, at distance 1 and at the latest place of the
    same bytes.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._low, self._range, self._out = 0, 0xFFFFFFFF, bytearray()
        self._cache, self._pending = 0, 1
        self._probabilities: dict[tuple, int] = {}

    def encode(self) -> bytes:
        data, latest, state, repeated, at = self._data, dict[bytes, int](), 0, 1, 0
        while at < len(data):
            key = data[at : at + _KEY]
            lengths = {d: self._matching(at, d) for d in (repeated, 1, at - latest.get(key, at))}
            distance = max(lengths, key=lambda d: lengths[d])
            size = lengths[distance]
            is_match = size >= (2 if distance == repeated else _KEY)
            self._bit(("match", state), is_match)
            if not is_match:
                size = 1
                self._literal(at, repeated if state >= 7 else 0)
                state = 0 if state < 4 else state - (3 if state < 10 else 6)
            elif distance == repeated:
                for name, value in (("rep", 1), ("rep0", 0), ("rep0 long", 1)):
                    self._bit((name, state), value)
                self._length("rep", size - 2)
                state = 8 if state < 7 else 11
            else:
                self._bit(("rep", state), 0)
                self._length("match", size - 2)
                self._distance(distance - 1, min(size - 2, 3))
                state, repeated = 7 if state < 7 else 10, distance
            for place in range(at, at + size):
                latest[data[place : place + _KEY]] = place
            at += size
        for _ in range(5):
            self._shift()
        return bytes(self._out)

    def _matching(self, at: int, distance: int) -> int:
        """How many bytes at `at` are those `distance` before them."""
        data, size = self._data, 0
        if 0 < distance <= at:
            while size < MATCH_MAX and at + size < len(data) and data[at + size] == data[at + size - distance]:
                size += 1
        return size

    def _literal(self, at: int, distance: int) -> None:
        """The byte at `at`; behind a match, given the byte that would have gone on with it."""
        byte, before = self._data[at], self._data[at - 1] if at else 0
        expected = self._data[at - distance]
        symbol, offset = 1, 0x100 if distance else 0
        for shift in range(7, -1, -1):
            bit, match = byte >> shift & 1, expected >> shift & 1
            branch = offset + (offset if match else 0)
            self._bit(("literal", before >> 8 - _LC, branch + symbol), bit)
            symbol = symbol << 1 | bit
            offset = offset if match == bit else 0

    def _length(self, kind: str, code: int) -> None:
        """Length - 2 in 0..271."""
        group = 0 if code < 8 else 1 if code < 16 else 2
        self._bit((kind, "choice", 0), group > 0)
        if group:
            self._bit((kind, "choice", 1), group > 1)
        self._tree((kind, group), code - 8 * group, 8 if group == 2 else 3)

    def _distance(self, code: int, length_state: int) -> None:
        """Distance - 1."""
        bits = max(code.bit_length() - 2, 0)  # below the two leading ones
        slot = code if code < 4 else 2 * (bits + 1) + (code >> bits & 1)
        self._tree(("slot", length_state), slot, 6)
        if code < 4:
            return
        if slot < 14:
            self._reverse_tree(("distance", slot), code, bits)
            return
        for shift in range(bits - 1, 3, -1):
            self._range >>= 1
            self._low += self._range * (code >> shift & 1)
            self._normalise()
        self._reverse_tree(("align",), code, 4)

    def _tree(self, name: tuple, value: int, bits: int) -> None:
        symbol = 1
        for shift in range(bits - 1, -1, -1):
            bit = value >> shift & 1
            self._bit((*name, symbol), bit)
            symbol = symbol << 1 | bit

    def _reverse_tree(self, name: tuple, value: int, bits: int) -> None:
        symbol = 1
        for shift in range(bits):
            bit = value >> shift & 1
            self._bit((*name, symbol), bit)
            symbol = symbol << 1 | bit

    def _bit(self, context: tuple, bit: int) -> None:
        p = self._probabilities.get(context, 1 << 10)
        bound = (self._range >> 11) * p
        if bit:
            self._low += bound
            self._range -= bound
            self._probabilities[context] = p - (p >> 5)
        else:
            self._range = bound
            self._probabilities[context] = p + ((1 << 11) - p >> 5)
        self._normalise()

    def _normalise(self) -> None:
        while self._range < 1 << 24:
            self._range <<= 8
            self._shift()

    def _shift(self) -> None:
        if self._low < 0xFF000000 or self._low >= 1 << 32:
            carry = self._low >> 32
            self._out += bytes([self._cache + carry & 0xFF]) + bytes([0xFF + carry & 0xFF]) * (self._pending - 1)
            self._cache, self._pending = self._low >> 24 & 0xFF, 0
        self._pending += 1
        self._low = (self._low & 0x00FFFFFF) << 8
