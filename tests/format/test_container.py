"""Preamble and chunks: exact bytes, the flags of slices, and what the writer refuses."""

import struct
import zlib

import pytest

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import container
from pd4dgs_codec.format.container import (
    CHUNK_OVERHEAD,
    FLAG_ANCILLARY,
    read_chunk,
    slice_flags,
    write_chunk,
    write_preamble,
)
from pd4dgs_codec.format.registry import MAX_HEADER


def test_exact_bytes():
    front = bytes.fromhex("89504434 0d0a1a0a 0500 0000 03000000")
    assert write_preamble(b"abc") == front + struct.pack("<I", zlib.crc32(front + b"abc")) + b"abc"
    body = bytes.fromhex("0500 0100 02000000 0102030405060708") + b"hi"
    chunk = write_chunk(5, FLAG_ANCILLARY, bytes(range(1, 9)), b"hi")
    assert chunk == body + struct.pack("<I", zlib.crc32(body)) and len(chunk) == CHUNK_OVERHEAD + 2
    assert read_chunk(chunk, 0).ancillary


def test_the_flags_of_slices():
    flags = [slice_flags(number, 1024) for number in (0, 1, 1022, 1023)]
    chunks = [read_chunk(write_chunk(0, f, bytes(8), b""), 0) for f in flags]
    assert [(c.slice, c.more, c.ancillary) for c in chunks] == [(n, n < 1023, False) for n in (0, 1, 1022, 1023)]
    assert slice_flags(0, 1) == 0


@pytest.mark.parametrize("args", [(-1, 0, bytes(8)), (1 << 16, 0, bytes(8)), (0, 4, bytes(8)), (0, 0, bytes(7))])
def test_the_writer_refuses(args):
    with pytest.raises(EncodeError):
        write_chunk(*args, b"")
    with pytest.raises(EncodeError):
        write_preamble(bytes(MAX_HEADER + 1))


def test_the_writer_refuses_a_payload_over_the_limit(monkeypatch):
    monkeypatch.setattr(container, "MAX_PAYLOAD", 10)
    assert len(write_chunk(1, 0, bytes(8), bytes(10))) == 30
    with pytest.raises(EncodeError, match="payload of 11 bytes, limit 10"):
        write_chunk(1, 0, bytes(8), bytes(11))
