"""Preamble and chunks: exact bytes, and every bit flip and every cut of a small file is caught."""

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pd4dgs_codec.errors import (
    BadSignature,
    ChecksumMismatch,
    DecodeError,
    EncodeError,
    LimitExceeded,
    Malformed,
    Truncated,
    UnsupportedVersion,
)
from pd4dgs_codec.format import container
from pd4dgs_codec.format.canonical import pack, unpack
from pd4dgs_codec.format.container import (
    CHUNK_OVERHEAD,
    FLAG_ANCILLARY,
    MAJOR,
    SIGNATURE,
    read_chunk,
    read_preamble,
    slice_flags,
    write_chunk,
    write_preamble,
)
from pd4dgs_codec.format.registry import MAX_HEADER, MAX_PAYLOAD

PAYLOADS = [b"layer zero", b"", b"layer two, a little longer"]
FLAGS = [0, FLAG_ANCILLARY, 0]


def small_file() -> bytes:
    header = pack({1: [[i, len(p)] for i, p in enumerate(PAYLOADS)]})
    chunks = [write_chunk(i, f, b"scene id", p) for i, (f, p) in enumerate(zip(FLAGS, PAYLOADS, strict=True))]
    return write_preamble(header) + b"".join(chunks)


def read_file(data: bytes) -> list[bytes]:
    preamble = read_preamble(data)
    offset, scene_id, payloads = preamble.size, None, []
    for index, (kind, length) in enumerate(unpack(preamble.header, offset=20)[1]):
        chunk = read_chunk(data, offset, type=kind, length=length, scene_id=scene_id, index=index)
        scene_id, offset = chunk.scene_id, chunk.end
        payloads.append(chunk.payload)
    if offset != len(data):
        raise Malformed("trailing bytes")
    return payloads


def test_round_trip():
    assert read_file(small_file()) == PAYLOADS


def test_exact_bytes():
    front = bytes.fromhex("89504434 0d0a1a0a 0300 0000 03000000")
    assert write_preamble(b"abc") == front + struct.pack("<I", zlib.crc32(front + b"abc")) + b"abc"
    body = bytes.fromhex("0500 0100 02000000 0102030405060708") + b"hi"
    chunk = write_chunk(5, FLAG_ANCILLARY, bytes(range(1, 9)), b"hi")
    assert chunk == body + struct.pack("<I", zlib.crc32(body)) and len(chunk) == CHUNK_OVERHEAD + 2
    assert read_chunk(chunk, 0).ancillary


def test_every_single_bit_flip_is_caught():
    good = small_file()
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << (bit % 8)
        with pytest.raises(DecodeError):
            read_file(bytes(bad))


def test_every_cut_is_truncated():
    good = small_file()
    for size in range(len(good)):
        with pytest.raises(Truncated) as caught:
            read_file(good[:size])
        assert caught.value.offset == size


def refit(data: bytes) -> bytes:
    """The chunk with its CRC made to fit, to reach what lies behind it."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def test_each_fault_has_its_error():
    good, chunk = write_preamble(b"{}"), write_chunk(2, 0, bytes(8), b"payload")
    with pytest.raises(BadSignature):
        read_preamble(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(BadSignature):
        read_preamble(b"GIF")
    with pytest.raises(UnsupportedVersion):
        read_preamble(SIGNATURE + b"\1\0" + good[10:])
    with pytest.raises(LimitExceeded):
        read_preamble(good[:12] + struct.pack("<I", MAX_HEADER + 1) + good[16:])
    with pytest.raises(ChecksumMismatch):
        read_preamble(good[:-1] + b"?")
    with pytest.raises(LimitExceeded):
        read_chunk(chunk[:4] + struct.pack("<I", MAX_PAYLOAD + 1) + chunk[8:], 0)
    with pytest.raises(Malformed, match="reserved"):
        read_chunk(refit(chunk[:2] + b"\4\0" + chunk[4:]), 0)
    with pytest.raises(Malformed, match="flags 0x0041, reserved"):
        read_chunk(refit(chunk[:2] + b"\x41\0" + chunk[4:]), 0)
    with pytest.raises(Malformed, match="type"):
        read_chunk(chunk, 0, type=3)
    with pytest.raises(Malformed, match="length"):
        read_chunk(chunk, 0, length=8)
    with pytest.raises(Malformed, match="belongs to scene"):
        read_chunk(chunk, 0, scene_id=b"another!", index=4)
    with pytest.raises(ChecksumMismatch):
        read_chunk(chunk[:-5] + b"?" + chunk[-4:], 0)


def test_the_flags_of_slices():
    flags = [slice_flags(number, 1024) for number in (0, 1, 1022, 1023)]
    chunks = [read_chunk(write_chunk(0, f, bytes(8), b""), 0) for f in flags]
    assert [(c.slice, c.more, c.ancillary) for c in chunks] == [(n, n < 1023, False) for n in (0, 1, 1022, 1023)]
    assert slice_flags(0, 1) == 0


def test_a_later_minor_version_is_read():
    front = SIGNATURE + struct.pack("<HHI", MAJOR, 9, 0)
    assert read_preamble(front + struct.pack("<I", zlib.crc32(front))).minor == 9


@pytest.mark.parametrize("args", [(-1, 0, bytes(8)), (1 << 16, 0, bytes(8)), (0, 4, bytes(8)), (0, 0, bytes(7))])
def test_the_writer_refuses(args):
    with pytest.raises(EncodeError):
        write_chunk(*args, b"")
    with pytest.raises(EncodeError):
        write_preamble(bytes(MAX_HEADER + 1))


@given(st.binary(max_size=80), st.integers(0, 40))
def test_junk_gives_our_errors_only(data, offset):
    for start in (b"", SIGNATURE, SIGNATURE + struct.pack("<H", MAJOR)):
        with pytest.raises(DecodeError):
            read_preamble(start + data)
    with pytest.raises(DecodeError):
        read_chunk(data, offset)


def test_the_writer_refuses_a_payload_over_the_limit(monkeypatch):
    monkeypatch.setattr(container, "MAX_PAYLOAD", 10)
    assert len(write_chunk(1, 0, bytes(8), bytes(10))) == 30
    with pytest.raises(EncodeError, match="payload of 11 bytes, limit 10"):
        write_chunk(1, 0, bytes(8), bytes(11))
