"""Canonical msgpack: one value, one byte string.

Allowed: bool, int, float (stored as float 32, so it must be one and finite), str, bytes, list, and dict whose keys are
non-negative integers. Keys ascend, every form is the shortest, nesting is at most MAX_DEPTH; nil, float 64, ext and
timestamp do not exist. The reader encodes what it read again and compares, so no second form of a value can pass.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import msgpack

from pd4dgs_codec.errors import EncodeError, Malformed
from pd4dgs_codec.format.limits import MAX_DEPTH

_SINGLE_MAX = (2.0 - 2.0**-23) * 2.0**127


def pack(obj: Any) -> bytes:
    """Canonical bytes of a value. Raises EncodeError for what the format has no form for."""
    try:
        data: bytes = msgpack.packb(_canonical(obj), use_single_float=True)
    except ValueError as error:
        raise EncodeError(f"cannot be written as canonical msgpack: {error}") from None
    return data


def unpack(data: bytes | memoryview, *, offset: int = 0) -> Any:
    """The value that `data` is the canonical form of; Malformed for anything else, cut or trailing bytes included.

    offset: where `data` begins in the file, for the error's text. msgpack itself bounds every declared size by
    len(data).
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
