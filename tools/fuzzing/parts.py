"""Files taken apart into what mutations change, and put together again."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

from vectors import refdec
from vectors.blocks import Chunk as Framed
from vectors.blocks import File, pack

CODES = 2  # key of the parameters of a slice: the length of its codes


@dataclass
class Chunk:
    """A chunk. meta: the parameters of a slice, without the length of its codes; None for other chunks, and for a slice
    whose payload was changed as bytes."""

    type: int
    flags: int
    payload: bytes
    meta: dict[int, Any] | None = None
    codes: bytes = b""
    stream: bytes = b""

    def packed(self) -> bytes:
        """The payload, written anew if it was taken apart."""
        if self.meta is None:
            return self.payload
        meta = pack(dict(sorted({**self.meta, CODES: len(self.codes)}.items())))
        return b"".join([struct.pack("<I", len(meta)), meta, self.codes, self.stream])


@dataclass
class Parts:
    """A file taken apart."""

    header: dict[int, Any]
    chunks: list[Chunk]


def take_apart(data: bytes) -> Parts:
    """The parts of a valid file, each a copy."""
    (size,) = struct.unpack_from("<I", data, 12)
    header, chunks, offset = refdec.unpack(data[20 : 20 + size]), list[Chunk](), 20 + size
    while offset < len(data):
        kind, flags, length = struct.unpack_from("<HHI", data, offset)
        part = Chunk(kind, flags, data[offset + 16 : offset + 16 + length])
        if kind < 3:
            at = 4 + struct.unpack_from("<I", part.payload)[0]
            part.meta = refdec.unpack(part.payload[4:at])
            end = at + part.meta.pop(CODES)
            part.codes, part.stream = part.payload[at:end], part.payload[end:]
        chunks.append(part)
        offset += 20 + length
    return Parts(header, chunks)


def put_together(parts: Parts, header: bytes | None = None) -> bytes:
    """The file of `parts`, or with other bytes for a header, which may be none. ValueError if a value has no canonical
    form."""
    fields = {14: None} | {key: value for key, value in parts.header.items() if key != 1}
    try:
        return File(tuple(Framed(c.type, c.packed(), c.flags) for c in parts.chunks), fields, header).data()
    except (struct.error, OverflowError, TypeError) as error:
        raise ValueError("a value without a form") from error
