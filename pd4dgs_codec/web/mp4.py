"""ISO base media files (ISO/IEC 14496-12) with opaque payloads: one metadata track per slice, of one fragment.

The writer makes the few boxes that readers require; the reader finds the fragments of other files.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.headers import MEDIA_TYPES

TIMESCALE = 1000  #: ticks per second of every track
MAX_BOX = (1 << 32) - 1

_IDENTITY = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
_SYNC = 0x02000000  # the sample depends on no other of its track
_DEFAULT_BASE_IS_MOOF = 0x020000
_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"mvex", b"moof", b"traf"}


def ticks(seconds: float) -> int:
    """A duration in units of TIMESCALE, at least 1."""
    return max(1, round(seconds * TIMESCALE))


def box(kind: bytes, *parts: bytes) -> bytes:
    """One box. Raises DeliveryError if its size exceeds 32 bits."""
    size = 8 + sum(map(len, parts))
    if size > MAX_BOX:
        raise DeliveryError(f"a layer of {size:,} bytes, an MP4 box holds at most {MAX_BOX:,}")
    return struct.pack(">I4s", size, kind) + b"".join(parts)


def _full(kind: bytes, version: int, flags: int, *parts: bytes) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags), *parts)


def initialisation(tracks: int, ticks: int) -> bytes:
    """`ftyp` and `moov` of `tracks` metadata tracks, ids from 1, that last `ticks` (32 bits) each; samples follow."""
    times = struct.pack(">QQIQ", 0, 0, TIMESCALE, ticks)
    rate_volume = struct.pack(">IH10x", 1 << 16, 1 << 8)
    header = _full(b"mvhd", 1, 0, times, rate_volume, _IDENTITY, bytes(24), struct.pack(">I", tracks + 1))
    traks = [_track(number, ticks) for number in range(1, tracks + 1)]
    extends = [_full(b"trex", 0, 0, struct.pack(">5I", n, 1, ticks, 0, _SYNC)) for n in range(1, tracks + 1)]
    brands = struct.pack(">4sI4s4s", b"iso6", 0, b"iso6", b"dash")
    return box(b"ftyp", brands) + box(b"moov", header, *traks, box(b"mvex", *extends))


def _track(number: int, ticks: int) -> bytes:
    enabled_in_movie = 3
    place = struct.pack(">QQIIQ8xHHHH", 0, 0, number, 0, ticks, 0, 0, 0, 0)
    head = _full(b"tkhd", 1, enabled_in_movie, place, _IDENTITY, bytes(8))
    undetermined = sum((ord(c) - 0x60) << shift for c, shift in zip("und", (10, 5, 0), strict=True))
    media = _full(b"mdhd", 1, 0, struct.pack(">QQIQHH", 0, 0, TIMESCALE, ticks, undetermined, 0))
    handler = _full(b"hdlr", 0, 0, struct.pack(">I4s12x", 0, b"meta"), f"layer {number - 1}\0".encode())
    here = _full(b"url ", 0, 1)
    data = box(b"dinf", _full(b"dref", 0, 0, struct.pack(">I", 1), here))
    entry = box(b"mett", struct.pack(">6xH", 1), b"\0", MEDIA_TYPES[".pd4"].encode() + b"\0")
    none = struct.pack(">I", 0)
    table = box(
        b"stbl",
        _full(b"stsd", 0, 0, struct.pack(">I", 1), entry),
        *(_full(kind, 0, 0, none) for kind in (b"stts", b"stsc")),
        _full(b"stsz", 0, 0, none, none),
        _full(b"stco", 0, 0, none),
    )
    return box(b"trak", head, box(b"mdia", media, handler, box(b"minf", _full(b"nmhd", 0, 0), data, table)))


def fragment(number: int, track: int, payload: bytes, ticks: int) -> bytes:
    """`moof` and `mdat` of one sample that lasts from 0 to `ticks`."""

    def moof(data_offset: int) -> bytes:
        run_flags = 0x000301  # data offset, and each sample's duration and size
        return box(
            b"moof",
            _full(b"mfhd", 0, 0, struct.pack(">I", number)),
            box(
                b"traf",
                _full(b"tfhd", 0, _DEFAULT_BASE_IS_MOOF, struct.pack(">I", track)),
                _full(b"tfdt", 1, 0, struct.pack(">Q", 0)),
                _full(b"trun", 0, run_flags, struct.pack(">IiII", 1, data_offset, ticks, len(payload))),
            ),
        )

    return moof(len(moof(0)) + 8) + box(b"mdat", payload)


class Box(NamedTuple):
    """kind, and the offsets of its first byte, of its content and of its end (exclusive)."""

    kind: bytes
    start: int
    content: int
    end: int


def boxes(data: bytes, start: int = 0, end: int | None = None) -> Iterator[Box]:
    """The sequence of boxes in data[start:end]. Raises DeliveryError if they do not fill it."""
    end = len(data) if end is None else end
    while start < end:
        size, kind = struct.unpack_from(">I4s", data, start) if end - start >= 8 else (0, b"")
        content = start + 8
        if size == 1 and end - start >= 16:
            (size,), content = struct.unpack_from(">Q", data, content), content + 8
        if size < content - start or start + size > end:
            raise DeliveryError(f"an MP4 box of {size} bytes at byte {start}, {end - start} are there")
        yield Box(kind, start, content, start + size)
        start += size


def find(data: bytes, kind: bytes, inside: Sequence[Box]) -> Iterator[Box]:
    """All boxes of a kind inside others, at any depth."""
    for parent in inside:
        for child in boxes(data, parent.content, parent.end):
            if child.kind == kind:
                yield child
            elif child.kind in _CONTAINERS:
                yield from find(data, kind, [child])


class Fragment(NamedTuple):
    """Offsets of a `moof` and the `mdat` after it, and their number of samples."""

    start: int
    end: int
    samples: int


def fragments(data: bytes) -> tuple[int, list[Fragment]]:
    """(bytes before the first fragment, fragments) of a fragmented file."""
    top = list(boxes(data))
    result = []
    for moof, mdat in zip(top, top[1:], strict=False):
        if (moof.kind, mdat.kind) == (b"moof", b"mdat"):
            runs = find(data, b"trun", [moof])
            samples = sum(struct.unpack_from(">I", data, run.content + 4)[0] for run in runs)
            result.append(Fragment(moof.start, mdat.end, samples))
    if not result:
        raise DeliveryError("an MP4 file without fragments, expected some")
    return result[0].start, result
