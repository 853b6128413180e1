"""Parts of a remote `.pd4` file, and no byte more than a round trip is worth."""

from __future__ import annotations

from pd4dgs_codec.errors import Truncated
from pd4dgs_codec.format.container import PREAMBLE_SIZE, read_preamble
from pd4dgs_codec.format.info import info
from pd4dgs_codec.format.limits import MAX_HEADER
from pd4dgs_codec.web.transfer import Changed, Transfer

#: Headers of today have some 300 bytes; a longer one costs a second request.
HEADER_GUESS = 512
LONGEST_HEADER = PREAMBLE_SIZE + MAX_HEADER


def header_size(data: bytes | bytearray) -> int | None:
    """Bytes of preamble and header, or None if `data`, the first bytes of a file, does not hold them all."""
    try:
        return read_preamble(data).size
    except Truncated:
        return None


def slice_ends(data: bytes | bytearray) -> list[tuple[int, int]]:
    """(layer, end in the file) of each slice, from a file's first bytes; empty if its header is not whole yet."""
    size = header_size(data)
    layers = [] if size is None else info(bytes(data[:size]))["layers"]
    return [(row["layer"], part["end"]) for row in layers for part in row["slices"]]


def within(
    slices: list[tuple[int, int]], max_layer: int | None = None, max_bytes: int | None = None
) -> list[tuple[int, int]]:
    """Those of the slices (layer, end) that are of a layer <= max_layer and end within max_bytes."""
    return [
        (layer, end)
        for layer, end in slices
        if (max_layer is None or layer <= max_layer) and (max_bytes is None or end <= max_bytes)
    ]


def fetch_header(transfer: Transfer) -> bytes:
    """Preamble and header alone; fewer bytes where the remote file ends within them. Raises as Transfer.read does."""
    while True:
        try:
            for end in (HEADER_GUESS, LONGEST_HEADER):
                _fill(transfer, end, end)
                size = header_size(transfer.data)
                if size is not None:
                    return bytes(transfer.data[:size])
            return bytes(transfer.data)
        except Changed:
            continue


def fetch(transfer: Transfer, max_layer: int | None = None, max_bytes: int | None = None) -> bytes:
    """The file, or its prefix of layers <= max_layer, or of slices within max_bytes; fewer bytes where the remote file
    ends early.

    The prefix takes two requests of exactly those bytes, the whole file one. Of bytes after the last chunk one is
    fetched, so that the decoder sees them. Raises as Transfer.read does, and DecodeError for a bad header.
    """
    while True:
        try:
            if max_layer is None and max_bytes is None:
                return _fetch_whole(transfer)
            header = fetch_header(transfer)
            wanted = within(slice_ends(header), max_layer, max_bytes)
            end = wanted[-1][1] if wanted else len(header)
            _fill(transfer, end, end)
            return bytes(transfer.data[:end])
        except Changed:
            continue


def _fetch_whole(transfer: Transfer) -> bytes:
    size = None
    while size is None and transfer.read(LONGEST_HEADER):
        size = header_size(transfer.data)
    if size is not None:
        _fill(transfer, info(bytes(transfer.data[:size]))["bytes"] + 1, None)
    return bytes(transfer.data)


def _fill(transfer: Transfer, end: int, reach: int | None) -> None:
    while transfer.read(end, reach=reach):
        pass
