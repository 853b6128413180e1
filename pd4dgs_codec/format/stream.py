"""Incremental decoding: bytes as they arrive -> upgraded scenes."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

from pd4dgs_codec.errors import DecodeError, Truncated
from pd4dgs_codec.format.decoder import LayerReader
from pd4dgs_codec.scene import Scene


class Stream:
    """Feed it a file in pieces of any size. The scenes do not depend on where the pieces are cut."""

    def __init__(self) -> None:
        self._reader = LayerReader()
        self._buffer = bytearray()
        self._error: DecodeError | None = None
        self.slices = 0  #: completed so far

    @property
    def complete(self) -> bool:
        """Whether everything that the header lists has arrived."""
        return self._reader.complete

    def feed(self, data: bytes) -> list[Scene]:
        """The newest scene of each layer that `data` completes a slice of, each holding all slices up to there.

        A small file may have a thousand slices, and a scene takes memory and time for all of its rows. So slices that
        arrive together make one scene; `every_prefix` has them all.

        A fault raises its DecodeError now, or at the next call if this one completes a slice before it, and at every
        later call. Scenes returned before stay valid.
        """
        if self._error is not None:
            raise self._error
        self._buffer += data
        newest: dict[int, LayerReader] = {}
        try:
            while self._reader.next_slice(self._buffer):
                self.slices += 1
                newest[self._reader.latest.kind.layer] = copy(self._reader)
        except Truncated:
            pass
        except DecodeError as error:
            self._error = error
            if not newest:
                raise
        return [reader.scene() for reader in newest.values()]

    def finish(self) -> None:
        """Say that no bytes follow: raises the pending fault, or Truncated if a chunk is missing."""
        if self._error is not None:
            raise self._error
        self._reader.next_slice(self._buffer)


def every_prefix(data: bytes) -> Iterator[Scene]:
    """The scene after each slice of a whole file. Raises DecodeError."""
    reader = LayerReader()
    while reader.next_slice(data):
        yield reader.scene()


def open_stream() -> Stream:
    """An empty stream, ready to be fed."""
    return Stream()
