"""Typed, bounded access to a map of registry integers, as canonical msgpack yields it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pd4dgs_codec.errors import LimitExceeded, Malformed, UnsupportedFeature

#: Unknown keys from here on may be ignored; unknown ones below change what the file means.
FIRST_IGNORABLE_KEY = 64


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
