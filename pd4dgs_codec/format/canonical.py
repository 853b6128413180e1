"""Canonical msgpack (clause 4), in which a value has one byte string, and checked access to its maps and lists.

Values are bool, int, float (a finite binary32), str, bytes, list, and dict with non-negative integer keys. Keys ascend,
every form is the shortest, and nesting is at most MAX_DEPTH. The reader encodes the value again and compares, so that
no second form of a value passes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import msgpack

from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed, UnsupportedFeature
from pd4dgs_codec.format.registry import MAX_DEPTH

#: Unknown keys from here on are ignored; unknown ones below change what the file means.
FIRST_IGNORABLE_KEY = 64

_SINGLE_MAX = (2.0 - 2.0**-23) * 2.0**127


def pack(obj: Any) -> bytes:
    """Canonical bytes of a value. Raises EncodeError for a value that the format cannot hold."""
    try:
        data: bytes = msgpack.packb(_canonical(obj), use_single_float=True)
    except ValueError as error:
        raise EncodeError(f"cannot be written as canonical msgpack: {error}") from None
    return data


def unpack(data: bytes | memoryview, *, offset: int = 0) -> Any:
    """The value of canonical bytes. Raises Malformed for any other bytes, cut and trailing ones included.

    offset: where `data` begins in the file, for messages. msgpack bounds every declared size by len(data).
    """
    data = bytes(data)
    try:
        obj = msgpack.unpackb(data, raw=False, use_list=True, strict_map_key=False)
        again = msgpack.packb(_canonical(obj), use_single_float=True)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise Malformed(f"{len(data)} bytes are not canonical msgpack: {reason}", offset=offset) from None
    if again != data:
        at = next((i for i, (a, b) in enumerate(zip(again, data, strict=False)) if a != b), min(len(again), len(data)))
        raise Malformed(f"{len(data)} bytes of msgpack leave the canonical form at byte {at}", offset=offset + at)
    return obj


def _canonical(obj: Any, depth: int = 0) -> Any:
    """The same value with sorted keys; ValueError for a type, a key, a number or a depth that is not allowed."""
    if type(obj) in (dict, list, tuple):
        if depth == MAX_DEPTH:
            raise ValueError(f"nested deeper than {MAX_DEPTH}")
        if type(obj) is not dict:
            return [_canonical(item, depth + 1) for item in obj]
        for key in obj:
            if type(key) is not int or not 0 <= key < 1 << 32:
                raise ValueError(f"map key {key!r}, expected an integer in 0..2**32 - 1")
        return {key: _canonical(obj[key], depth + 1) for key in sorted(obj)}
    if type(obj) is float:
        return _single(obj)
    if type(obj) is int and not -(1 << 63) <= obj < 1 << 64:
        raise ValueError(f"integer {obj} does not fit 64 bits")
    if type(obj) not in (bool, int, str, bytes):
        raise ValueError(f"a value of type {type(obj).__name__}, expected bool, int, float, str, bytes, list or dict")
    return obj


def _single(value: float) -> float:
    fits = math.isfinite(value) and abs(value) <= _SINGLE_MAX
    if not fits or struct.unpack("<f", struct.pack("<f", value))[0] != value:
        raise ValueError(f"real {value!r} is not a finite binary32 value")
    return value


# -- checked access ----------------------------------------------------------------------------------------------------


class Fields:
    """A map with a name for messages. Every getter checks type and range; nothing is converted silently."""

    def __init__(self, data: object, where: str, known: set[int]):
        if not isinstance(data, dict):
            raise Malformed(f"{where}: {type(data).__name__}, expected a map")
        unknown = [key for key in data if key not in known and key < FIRST_IGNORABLE_KEY]
        if unknown:
            raise UnsupportedFeature(f"{where}: unknown key {unknown[0]} below {FIRST_IGNORABLE_KEY}, so critical")
        self._data = data
        self._where = where

    def __contains__(self, key: int) -> bool:
        return key in self._data

    def get(self, key: int) -> object:
        """The value of `key`, which must be there."""
        if key not in self._data:
            raise Malformed(f"{self._where}: key {key} is missing")
        return self._data[key]

    def integer(self, key: int, high: int, low: int = 0) -> int:
        """An integer in low..high."""
        return as_integer(self.get(key), high, f"{self._where} key {key}", low)

    def choice(self, key: int, table: dict[str, int]) -> str:
        """The name of an enumerated value; a number outside the table is a feature this decoder does not know."""
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
    """`value` as an integer in low..high, else Malformed, or LimitExceeded above `high`."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Malformed(f"{where}: {type(value).__name__}, expected an integer")
    if value > high:
        raise LimitExceeded(f"{where}: {value}, expected at most {high}")
    if value < low:
        raise Malformed(f"{where}: {value}, expected at least {low}")
    return value


def as_registered(value: object, known: Mapping[int, object], where: str) -> int:
    """`value` as one of the `known` numbers of a registry; another integer is a feature this decoder does not know."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Malformed(f"{where}: {type(value).__name__}, expected an integer")
    if value not in known:
        raise UnsupportedFeature(f"{where}: {value}, expected one of {list(known)}")
    return value


def as_list(value: object, where: str, count: int | None = None) -> list[Any]:
    """`value` as a list, of `count` entries if given."""
    if not isinstance(value, list):
        raise Malformed(f"{where}: {type(value).__name__}, expected a list")
    if count is not None and len(value) != count:
        raise Malformed(f"{where}: {len(value)} entries, expected {count}")
    return value
