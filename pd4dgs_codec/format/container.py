"""The container: preamble and chunk framing, bytes <-> fields. All integers are little-endian.

    preamble  signature 8 | major u16 | minor u16 | header length u32 | CRC-32 u32 | header
    chunk     type u16 | flags u16 | length u32 | scene id 8 | payload | CRC-32 u32

The preamble's CRC covers its first 16 bytes and the header; a chunk's CRC covers all of the chunk before it.
"""

import struct
import zlib
from dataclasses import dataclass

from pd4dgs_codec.errors import (
    BadSignature,
    ChecksumMismatch,
    EncodeError,
    LimitExceeded,
    Malformed,
    Truncated,
    UnsupportedVersion,
)
from pd4dgs_codec.format.registry import MAX_HEADER, MAX_PAYLOAD

# As in PNG: a high bit and both line ends, so that a text-mode transfer breaks it, and 0x1A to stop a DOS listing.
SIGNATURE = bytes.fromhex("89504434 0D0A1A0A")
MAJOR, MINOR = 5, 0
PREAMBLE_SIZE = 20
CHUNK_HEAD_SIZE = 16
CHUNK_OVERHEAD = CHUNK_HEAD_SIZE + 4
SCENE_ID_SIZE = 8
FLAG_ANCILLARY = 1  #: a decoder that does not know the type may skip the chunk; its other flag bits are zero
FLAG_MORE = 2  #: further slices of the same layer follow
SLICE_SHIFT = 6  #: the number of a slice is the flags' upper bits; bits 2 to 5 are reserved, zero
_RESERVED = ((1 << SLICE_SHIFT) - 1) & ~(FLAG_ANCILLARY | FLAG_MORE)

_PREAMBLE = struct.Struct("<8sHHI")
_CHUNK = struct.Struct("<HHI8s")
_CRC = struct.Struct("<I")

Buffer = bytes | bytearray | memoryview


@dataclass(frozen=True)
class Preamble:
    major: int
    minor: int
    header: bytes
    size: int  #: bytes of preamble and header: the offset of the first chunk


@dataclass(frozen=True)
class Chunk:
    type: int
    flags: int
    scene_id: bytes
    payload: bytes
    end: int  #: offset of the byte after the chunk

    @property
    def ancillary(self) -> bool:
        return bool(self.flags & FLAG_ANCILLARY)

    @property
    def slice(self) -> int:
        """Number of the slice within its layer."""
        return self.flags >> SLICE_SHIFT

    @property
    def more(self) -> bool:
        """Whether further slices of its layer follow."""
        return bool(self.flags & FLAG_MORE)


def slice_flags(number: int, of: int) -> int:
    """Returns the flags of slice `number` of a layer of `of` slices."""
    return number << SLICE_SHIFT | FLAG_MORE * (number + 1 < of)


def _reserved(flags: int) -> int:
    """Returns the bits that are set although they must be zero."""
    return flags & ~FLAG_ANCILLARY if flags & FLAG_ANCILLARY else flags & _RESERVED


def write_preamble(header: bytes) -> bytes:
    """Returns preamble and header. Raises EncodeError for a header over MAX_HEADER bytes."""
    if len(header) > MAX_HEADER:
        raise EncodeError(f"a header of {len(header)} bytes, limit {MAX_HEADER}")
    front = _PREAMBLE.pack(SIGNATURE, MAJOR, MINOR, len(header))
    return front + _CRC.pack(zlib.crc32(header, zlib.crc32(front))) + header


def read_preamble(data: Buffer) -> Preamble:
    """Reads preamble and header from the first bytes of a file; bytes after the header are ignored.

    Raises BadSignature, Truncated, UnsupportedVersion (the major version), LimitExceeded or ChecksumMismatch.
    """
    with memoryview(data) as view:  # an open view in a traceback would keep a stream's buffer from growing
        start = bytes(view[: len(SIGNATURE)])
        if not SIGNATURE.startswith(start):
            found = start.hex(" ") + (" (a checkpoint? pd4dgs-encode takes one)" if start.startswith(b"PK") else "")
            raise BadSignature(f"not a .pd4 file: it begins with {found}, expected {SIGNATURE.hex(' ')}", offset=0)
        _need(view, PREAMBLE_SIZE, "the preamble")
        _, major, minor, length = _PREAMBLE.unpack_from(view)
        if major != MAJOR:
            told = "; drafts before 5.0 are not read any more: encode the scene again" if major < MAJOR else ""
            found = f"format version {major}.{minor}, this decoder reads {MAJOR}.x"
            raise UnsupportedVersion(found + told, offset=8)
        if length > MAX_HEADER:
            raise LimitExceeded(f"a header of {length} bytes, limit {MAX_HEADER}", offset=12)
        size = PREAMBLE_SIZE + length
        _need(view, size, "the header")
        header = bytes(view[PREAMBLE_SIZE:size])
        _check_crc(view, _PREAMBLE.size, zlib.crc32(header, zlib.crc32(view[: _PREAMBLE.size])), "preamble and header")
        return Preamble(major, minor, header, size)


def write_chunk(type: int, flags: int, scene_id: bytes, payload: bytes) -> bytes:
    """Returns one framed chunk. Raises EncodeError for a field out of range."""
    if not (0 <= type < 1 << 16 and 0 <= flags < 1 << 16) or _reserved(flags) or len(scene_id) != SCENE_ID_SIZE:
        raise EncodeError(f"chunk type {type}, flags {flags}, scene id of {len(scene_id)} bytes: out of range")
    if len(payload) > MAX_PAYLOAD:
        raise EncodeError(f"a payload of {len(payload)} bytes, limit {MAX_PAYLOAD}")
    head = _CHUNK.pack(type, flags, len(payload), scene_id)
    return head + payload + _CRC.pack(zlib.crc32(payload, zlib.crc32(head)))


def read_chunk(
    data: Buffer,
    offset: int,
    *,
    type: int | None = None,
    length: int | None = None,
    scene_id: bytes | None = None,
    index: int | None = None,
    start: int = 0,
) -> Chunk:
    """Reads the chunk at `offset` of a file. type, length (of the payload), scene_id: as the header announces them.

    index: number of the chunk in the file, for messages. start: offset of `data` in the file. Raises Truncated,
    LimitExceeded, ChecksumMismatch, or Malformed if the chunk is not the one announced or sets a reserved flag.
    """
    with memoryview(data) as view:
        at = offset - start
        _need(view, at + CHUNK_HEAD_SIZE, "a chunk's head", index, start)
        found_type, flags, found_length, found_id = _CHUNK.unpack_from(view, at)
        if found_length > MAX_PAYLOAD:
            raise LimitExceeded(
                f"a payload of {found_length} bytes, limit {MAX_PAYLOAD}", offset=offset + 4, chunk=index
            )
        if length is not None and found_length != length:
            raise Malformed(f"payload length {found_length}, the header says {length}", offset=offset + 4, chunk=index)
        body_end = at + CHUNK_HEAD_SIZE + found_length
        _need(view, body_end + _CRC.size, "a chunk", index, start)
        _check_crc(view, body_end, zlib.crc32(view[at:body_end]), "chunk", index, start)
        if _reserved(flags):
            raise Malformed(f"flags {flags:#06x}, reserved bits must be zero", offset=offset + 2, chunk=index)
        if type is not None and found_type != type:
            raise Malformed(f"chunk type {found_type}, the header says {type}", offset=offset, chunk=index)
        if scene_id is not None and found_id != scene_id:
            message = f"the chunk belongs to scene {found_id.hex()}, this file is {scene_id.hex()}"
            raise Malformed(message, offset=offset + 8, chunk=index)
        payload = bytes(view[at + CHUNK_HEAD_SIZE : body_end])
        return Chunk(found_type, flags, found_id, payload, start + body_end + _CRC.size)


def _need(view: memoryview, size: int, what: str, index: int | None = None, start: int = 0) -> None:
    if len(view) < size:
        end, needs = start + len(view), start + size
        raise Truncated(f"truncated in {what}: {end} bytes, expected {needs}", offset=end, chunk=index, needs=needs)


def _check_crc(view: memoryview, at: int, computed: int, what: str, index: int | None = None, start: int = 0) -> None:
    (stored,) = _CRC.unpack_from(view, at)
    if stored != computed:
        message = f"CRC-32 of the {what} is {computed:#010x}, stored {stored:#010x}"
        raise ChecksumMismatch(message, offset=start + at, chunk=index)
