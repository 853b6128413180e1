"""Canonical msgpack (clause 4), where each value has exactly one encoding, and checked access to its maps and lists.

Values are bool, int, float (a finite binary32), str, bytes, list, and dict with non-negative integer keys. Keys ascend,
every form is the shortest, and nesting is at most MAX_DEPTH.
"""

import math
import struct
from collections.abc import Mapping
from typing import Any

import msgpack

from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed, UnsupportedFeature
from pd4dgs_codec.format.registry import MAX_DEPTH

#: Unknown keys from here on are ignored; an unknown key below may change the meaning of the file and is an error.
FIRST_IGNORABLE_KEY = 64

_SINGLE_MAX = (2.0 - 2.0**-23) * 2.0**127


def pack(obj: Any) -> bytes:
    """Returns the canonical bytes of a value. Raises EncodeError for a value that the format cannot hold."""
    try:
        data: bytes = msgpack.packb(_canonical(obj), use_single_float=True)
    except ValueError as error:
        raise EncodeError(f"cannot be written as canonical msgpack: {error}") from None
    return data


def unpack(data: bytes | memoryview, *, offset: int = 0) -> Any:
    """Returns the value of canonical bytes. Raises Malformed for any other bytes, cut and trailing ones included.

    offset: of `data` in the file, for messages. Memory is linear in the number of bytes, whatever they declare.
    """
    reader = _Reader(bytes(data), offset)
    value = reader.value(0)
    if reader.at != len(reader.data):
        raise reader.fault(f"{len(reader.data) - reader.at} bytes follow the value")
    return value


#: By first byte of a kind's shortest form: kind, least number that needs each form, struct codes of the forms.
_SIZED = {
    0xC4: ("bytes", (0, 1 << 8, 1 << 16), "BHI"),
    0xCC: ("int", (1 << 7, 1 << 8, 1 << 16, 1 << 32), "BHIQ"),
    0xD0: ("negative", (1 << 5, 1 << 7, 1 << 15, 1 << 31), "bhiq"),  # the number of an integer n is -1 - n
    0xD9: ("str", (1 << 5, 1 << 8, 1 << 16), "BHI"),
    0xDC: ("list", (1 << 4, 1 << 16), "HI"),
    0xDE: ("map", (1 << 4, 1 << 16), "HI"),
}
_HEADS = {
    first + i: (kind, least, struct.Struct(">" + form))
    for first, (kind, sizes, forms) in _SIZED.items()
    for i, (least, form) in enumerate(zip(sizes, forms, strict=True))
}
_REAL = struct.Struct(">f")


class _Reader:
    """Reads values front to back. msgpack's own reader trusts the declared size of every nested list."""

    def __init__(self, data: bytes, offset: int):
        self.data, self.offset, self.at = data, offset, 0

    def fault(self, reason: str) -> Malformed:
        found = f"{len(self.data)} bytes are not canonical msgpack"
        return Malformed(f"{found}: {reason} at byte {self.at}", offset=self.offset + self.at)

    def value(self, depth: int) -> Any:
        """The next value, with `depth` lists and maps around it."""
        kind, n = self._head()
        if kind in ("int", "real"):
            return n
        if kind in ("bytes", "str"):
            return self._bytes(kind, n)
        if depth == MAX_DEPTH:
            raise self.fault(f"nested deeper than {MAX_DEPTH}")
        if kind == "list":
            return [self.value(depth + 1) for _ in range(n)]
        entries: dict[int, Any] = {}
        last = -1
        for _ in range(n):
            key = self.value(depth + 1)
            if type(key) is not int or not last < key < 1 << 32:
                raise self.fault(f"map key {key!r}, expected integers that ascend, in 0..2**32 - 1")
            entries[key], last = self.value(depth + 1), key
        return entries

    def _head(self) -> tuple[str, Any]:
        """Reads a value's head: (kind, the number itself or the count of bytes or entries that follow)."""
        (first,) = self._take(1)
        if first < 0x80 or first >= 0xE0:
            return "int", first if first < 0x80 else first - 256
        if first < 0xC0:
            short = first & 15
            return ("map", short) if first < 0x90 else ("list", short) if first < 0xA0 else ("str", first & 31)
        if first in (0xC2, 0xC3):
            return "int", first == 0xC3
        if first == 0xCA:
            (real,) = _REAL.unpack(self._take(4))
            if not math.isfinite(real):
                raise self.fault(f"{real!r}, expected a finite binary32")
            return "real", real
        if first not in _HEADS:
            raise self.fault(f"a value of type {first:#x}")
        kind, least, form = _HEADS[first]
        (n,) = form.unpack(self._take(form.size))
        if (-1 - n if kind == "negative" else n) < least:
            raise self.fault(f"{n} is not in its shortest form")
        return ("int" if kind == "negative" else kind), n

    def _bytes(self, kind: str, size: int) -> bytes | str:
        data = self._take(size)
        try:
            return data if kind == "bytes" else data.decode()
        except UnicodeDecodeError:
            raise self.fault("a string that is not UTF-8") from None

    def _take(self, size: int) -> bytes:
        part = self.data[self.at : self.at + size]
        if len(part) < size:
            raise self.fault(f"truncated: {len(part)} bytes left, expected {size}")
        self.at += size
        return part


def _canonical(obj: Any, depth: int = 0) -> Any:
    """Returns the value with sorted keys. Raises ValueError for a type, key, number or depth that is not allowed."""
    if type(obj) in (dict, list, tuple):
        if depth == MAX_DEPTH:
            raise ValueError(f"nested deeper than {MAX_DEPTH}")
        if type(obj) is not dict:
            return [_canonical(item, depth + 1) for item in obj]
        for key in obj:
            if type(key) is not int or not 0 <= key < 1 << 32:
                raise ValueError(f"map key {key!r}, expected an integer in 0..2**32 - 1")
        return {key: _canonical(obj[key], depth + 1) for key in sorted(obj)}
    if type(obj) is float and not (abs(obj) <= _SINGLE_MAX and _REAL.unpack(_REAL.pack(obj))[0] == obj):
        raise ValueError(f"real {obj!r} is not a finite binary32 value")
    if type(obj) is int and not -(1 << 63) <= obj < 1 << 64:
        raise ValueError(f"integer {obj} does not fit 64 bits")
    if type(obj) not in (bool, int, float, str, bytes):
        raise ValueError(f"a value of type {type(obj).__name__}, expected bool, int, float, str, bytes, list or dict")
    return obj


# -- checked access ----------------------------------------------------------------------------------------------------


class Fields:
    """A map with a name for messages. Every getter checks type and range; nothing is converted silently."""

    def __init__(self, data: object, where: str, known: set[int]):
        if not isinstance(data, dict):
            raise Malformed(f"{where}: {type(data).__name__}, expected a map")
        unknown = [key for key in data if key not in known and key < FIRST_IGNORABLE_KEY]
        if unknown:
            raise UnsupportedFeature(f"{where}: unknown critical key {unknown[0]} (below {FIRST_IGNORABLE_KEY})")
        self._data = data
        self._where = where

    def __contains__(self, key: int) -> bool:
        return key in self._data

    def get(self, key: int) -> object:
        """The value of `key`. Raises Malformed if it is missing."""
        if key not in self._data:
            raise Malformed(f"{self._where}: key {key} is missing")
        return self._data[key]

    def integer(self, key: int, high: int, low: int = 0) -> int:
        """An integer in low..high."""
        return as_integer(self.get(key), high, f"{self._where} key {key}", low)

    def choice(self, key: int, table: dict[str, int]) -> str:
        """The name of an enumerated value. Raises UnsupportedFeature for a number outside the table."""
        names = {number: name for name, number in table.items()}
        return names[as_registered(self.get(key), names, f"{self._where} key {key}")]

    def sequence(self, key: int, count: int | None = None) -> list[Any]:
        """A list, of `count` entries if given."""
        return as_list(self.get(key), f"{self._where} key {key}", count)

    def reals(self, key: int, count: int) -> tuple[float, ...]:
        """A list of `count` finite binary32 values."""
        values = self.sequence(key, count)
        if not all(isinstance(v, float) for v in values):
            raise Malformed(f"{self._where} key {key}: expected {count} float 32 values")
        return tuple(values)

    def real(self, key: int) -> float:
        """One finite binary32 value."""
        value = self.get(key)
        if not isinstance(value, float):
            raise Malformed(f"{self._where} key {key}: {type(value).__name__}, expected a float 32")
        return value


def as_integer(value: object, high: int, where: str, low: int = 0) -> int:
    """Returns `value` as an integer in low..high. Raises LimitExceeded above `high`, Malformed for anything else."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Malformed(f"{where}: {type(value).__name__}, expected an integer")
    if value > high:
        raise LimitExceeded(f"{where}: {value}, expected at most {high}")
    if value < low:
        raise Malformed(f"{where}: {value}, expected at least {low}")
    return value


def as_registered(value: object, known: Mapping[int, object], where: str) -> int:
    """Returns `value` as one of the `known` numbers of a registry. Raises UnsupportedFeature for another integer."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Malformed(f"{where}: {type(value).__name__}, expected an integer")
    if value not in known:
        raise UnsupportedFeature(f"{where}: {value}, expected one of {list(known)}")
    return value


def as_list(value: object, where: str, count: int | None = None) -> list[Any]:
    """Returns `value` as a list, of `count` entries if given. Raises Malformed for anything else."""
    if not isinstance(value, list):
        raise Malformed(f"{where}: {type(value).__name__}, expected a list")
    if count is not None and len(value) != count:
        raise Malformed(f"{where}: {len(value)} entries, expected {count}")
    return value


def as_long(value: object, where: str, most: int, least: int = 1) -> list[Any]:
    """Returns `value` as a list of least..most entries. Raises LimitExceeded for more, Malformed for anything else."""
    entries = as_list(value, where)
    as_integer(len(entries), most, f"{where}: number of entries", least)
    return entries
