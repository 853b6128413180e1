"""Variable-length integers: LEB128, least significant seven bits first, always in the shortest form."""

from pd4dgs_codec.errors import LimitExceeded, Malformed

_MAX_BYTES = 5
VARINT_MAX = (1 << 7 * _MAX_BYTES) - 1


def put_varint(out: bytearray, value: int) -> None:
    """Appends value (0 <= value < 2**35)."""
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)


def put_zigzag(out: bytearray, value: int) -> None:
    """Appends a signed value: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    put_varint(out, 2 * value if value >= 0 else -2 * value - 1)


class ByteReader:
    """Reads a parameter block front to back. Faults raise Malformed or LimitExceeded with their byte offset."""

    def __init__(self, data: bytes | memoryview):
        self._data = memoryview(data)
        self._size = len(self._data)
        self.offset = 0

    @property
    def remaining(self) -> int:
        return self._size - self.offset

    def varint(self, limit: int, what: str) -> int:
        """The next integer, at most `limit`."""
        value, start = 0, self.offset
        if start < self._size and (byte := self._data[start]) < 0x80 and byte <= limit:  # most of them
            self.offset = start + 1
            return byte
        for index in range(_MAX_BYTES):
            if self.offset >= self._size:
                raise Malformed(f"the payload ends inside {what}", offset=start)
            byte = self._data[self.offset]
            self.offset += 1
            value |= (byte & 0x7F) << (7 * index)
            if byte < 0x80:
                if index and byte == 0:
                    raise Malformed(f"{what} is not in its shortest form", offset=start)
                if value > limit:
                    raise LimitExceeded(f"{what} is {value}, limit {limit}", offset=start)
                return value
        raise Malformed(f"{what} is longer than {_MAX_BYTES} bytes", offset=start)

    def take(self, size: int) -> bytes:
        """The next `size` bytes; the caller has checked that they exist."""
        self.offset += size
        return bytes(self._data[self.offset - size : self.offset])

    def byte(self, what: str, limit: int = 255) -> int:
        """The next byte, at most `limit`."""
        if not self.remaining:
            raise Malformed(f"the payload ends before {what}", offset=self.offset)
        value = self._data[self.offset]
        if value > limit:
            raise LimitExceeded(f"{what} is {value}, limit {limit}", offset=self.offset)
        self.offset += 1
        return value

    def zigzag(self, limit: int, what: str) -> int:
        """The next signed integer, at most `limit` in magnitude."""
        code = self.varint(2 * limit, what)
        return -(code + 1) // 2 if code & 1 else code // 2

    def rest(self) -> memoryview:
        """Everything that has not been read."""
        return self._data[self.offset :]
