"""Incremental decoding: bytes as they arrive -> one upgraded scene per completed slice."""

from __future__ import annotations

from pd4dgs_codec.codec.decoder import LayerReader
from pd4dgs_codec.errors import DecodeError, Truncated
from pd4dgs_codec.scene import Scene


class Stream:
    """Feed it a file in pieces of any size. The scenes do not depend on where the pieces are cut."""

    def __init__(self) -> None:
        self._reader = LayerReader()
        self._buffer = bytearray()
        self._error: DecodeError | None = None

    @property
    def complete(self) -> bool:
        """Whether everything that the header lists has arrived."""
        return self._reader.complete

    def feed(self, data: bytes) -> list[Scene]:
        """One scene per slice that `data` completes, each holding all slices so far; a layer is one slice or more.

        A fault raises its DecodeError now, or at the next call if this one completes a slice before it, and at every
        later call. Scenes returned before stay valid.
        """
        if self._error is not None:
            raise self._error
        self._buffer += data
        scenes: list[Scene] = []
        try:
            while self._reader.next_slice(self._buffer):
                scenes.append(self._reader.scene())
        except Truncated:
            pass
        except DecodeError as error:
            self._error = error
            if not scenes:
                raise
        return scenes

    def finish(self) -> None:
        """Say that no bytes follow: raises the pending fault, or Truncated if a chunk is missing."""
        if self._error is not None:
            raise self._error
        self._reader.next_slice(self._buffer)


def open_stream() -> Stream:
    """An empty stream, ready to be fed."""
    return Stream()
