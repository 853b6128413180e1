"""Raw LZMA2 streams whose bytes hang on nothing but this text: a library's encoder may change with its version."""

from __future__ import annotations

STORED_MAX = 1 << 16  #: bytes in one stored chunk
PACKED_MAX = 1 << 21  #: bytes that one compressed chunk may unpack to
MATCH_MAX = 273
_LC = 3  # bits of the byte before that choose a literal's probabilities; lp = pb = 0
PROPERTIES = _LC


def stored(data: bytes) -> bytes:
    """A stream of stored chunks, the first of which resets the dictionary."""
    out = bytearray()
    for start in range(0, len(data), STORED_MAX):
        part = data[start : start + STORED_MAX]
        out += bytes([2 if start else 1]) + (len(part) - 1).to_bytes(2, "big") + part
    return bytes(out) + b"\0"


def packed(data: bytes) -> bytes:
    """A stream of one compressed chunk: literals, and matches with the byte before where it repeats."""
    assert 0 < len(data) <= PACKED_MAX
    body = _Encoder().encode(data)
    size = len(data) - 1
    head = bytes([0xE0 | size >> 16]) + (size & 0xFFFF).to_bytes(2, "big") + (len(body) - 1).to_bytes(2, "big")
    return head + bytes([PROPERTIES]) + body + b"\0"


class _Encoder:
    """LZMA's range coder with adaptive bits, as the public LZMA specification has it; every match is a rep0 match."""

    def __init__(self) -> None:
        self._low, self._range, self._out = 0, 0xFFFFFFFF, bytearray()
        self._cache, self._pending = 0, 1
        self._probabilities: dict[tuple, int] = {}

    def encode(self, data: bytes) -> bytes:
        state, at = 0, 0
        while at < len(data):
            before = data[at - 1] if at else 0
            run = 0
            while at and run < MATCH_MAX and at + run < len(data) and data[at + run] == before:
                run += 1
            if run < 2:
                self._bit(("match", state), 0)
                self._literal(data[at], before, matched=state >= 7)
                state = 0 if state < 4 else state - (3 if state < 10 else 6)
                at += 1
                continue
            for name, value in (("match", 1), ("rep", 1), ("rep0", 0), ("rep0 long", 1)):
                self._bit((name, state), value)
            self._length(run - 2)
            state, at = 8 if state < 7 else 11, at + run
        for _ in range(5):
            self._shift()
        return bytes(self._out)

    def _literal(self, byte: int, before: int, matched: bool) -> None:
        symbol, offset = 1, 0x100 if matched else 0
        for shift in range(7, -1, -1):
            bit, match = byte >> shift & 1, before >> shift & 1
            branch = offset + (offset if match else 0)
            self._bit(("literal", before >> 8 - _LC, branch + symbol), bit)
            symbol = symbol << 1 | bit
            offset = offset if match == bit else 0

    def _length(self, code: int) -> None:
        """Length - 2 in 0..271."""
        group = 0 if code < 8 else 1 if code < 16 else 2
        self._bit(("length", 0), group > 0)
        if group:
            self._bit(("length", 1), group > 1)
        self._tree(("low", "middle", "high")[group], code - 8 * group, 8 if group == 2 else 3)

    def _tree(self, name: str, value: int, bits: int) -> None:
        symbol = 1
        for shift in range(bits - 1, -1, -1):
            bit = value >> shift & 1
            self._bit((name, symbol), bit)
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
