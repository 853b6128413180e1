"""Preamble and chunks: the flags of slices, and what the writer refuses; tests/fuzz compares their bytes."""

import pytest

from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format import container
from pd4dgs_codec.format.container import read_chunk, slice_flags, write_chunk, write_preamble
from pd4dgs_codec.format.registry import MAX_HEADER


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
