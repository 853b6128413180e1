"""The viewer's side of a `.pd4` file on a web server: slices as they arrive, upgrades later, interruptions survived."""

from __future__ import annotations

import time
from collections.abc import Iterator

from pd4dgs_codec.errors import BadSignature, DecodeError, UnsupportedVersion
from pd4dgs_codec.format.decoder import open_stream
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.transfer import (
    HEADER_GUESS,
    LONGEST_HEADER,
    MOST_BYTES,
    Changed,
    Transfer,
    check_end,
    prefix_end,
    slice_ends,
)


class SceneClient:
    """Scenes of one URL, as early as they can be decoded. Use it in a `with` block, or close it.

    The first request is one open-ended GET, read as it arrives. After an interruption, and for slices requested later,
    Range with If-Range fetches the missing bytes only. If the file has changed, decoding restarts with its layer 0. A
    damaged slice is fetched once more and never yielded. transfer: bytes and counts, see Transfer. arrived_at:
    time.monotonic() of the latest bytes; when a scene is yielded, of the last byte of its slice.
    """

    def __init__(self, url: str, *, stall: float = 10.0, attempts: int = 5):
        self.transfer = Transfer(url, stall=stall, attempts=attempts)
        self.arrived_at = time.monotonic()
        self._repaired_at = -1
        self._begin()

    def __enter__(self) -> SceneClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; `scenes` may be called again and opens another."""
        self.transfer.close()

    def scenes(self, max_layer: int | None = None, max_bytes: int | None = None) -> Iterator[Scene]:
        """The newest scene as slices arrive, with all slices so far: those of layers up to max_layer that end within
        the first max_bytes of the file; without max_bytes nothing behind byte MOST_BYTES is fetched.

        A further call continues after the last slice yielded. Raises DeliveryError if the file is not available,
        DecodeError if it is invalid or its first slice ends behind MOST_BYTES; scenes yielded before stay valid.
        """
        limits = max_layer, MOST_BYTES if max_bytes is None else max_bytes
        while True:
            while ready := self._ready(*limits):  # until empty: a fault behind a slice is raised by the next feed
                yield from ready
            have = len(self.transfer.data)
            end, reach = (HEADER_GUESS if have < HEADER_GUESS else LONGEST_HEADER), None
            if self._slices:
                if max_bytes is None:
                    check_end(self._slices[0][1])
                reach = prefix_end(self._slices, *limits)
                if have >= reach:
                    break
                end = next(end for _, end in self._slices if end > have)
            try:
                block = self.transfer.read(end, reach=reach)
            except Changed:
                self._begin()
                continue
            if not block:
                self._stream.finish()  # raises Truncated: the file ends within this slice
            self.arrived_at = time.monotonic()
        self.close()

    def _begin(self) -> None:
        self._stream, self._fed = open_stream(), 0
        self._slices: list[tuple[int, int]] = []

    def _ready(self, max_layer: int | None, max_bytes: int) -> list[Scene]:
        """Feeds new bytes to the decoder. After a fault the transfer goes back to the end of the last valid slice."""
        try:
            return self._feed(max_layer, max_bytes)
        except (BadSignature, UnsupportedVersion):
            raise  # not a transmission error
        except DecodeError:
            good = self._stream.consumed
            if self._repaired_at == good:
                raise
            self._repaired_at = self._fed = good
            self.transfer.rewind(good)
            self._stream.rewind()
            return []

    def _feed(self, max_layer: int | None, max_bytes: int) -> list[Scene]:
        data, end = self.transfer.data, len(self.transfer.data)
        if not self._slices:
            self._slices = slice_ends(data)
        if self._slices:  # the first bytes of a small file may hold more than is asked for
            end = min(end, prefix_end(self._slices, max_layer, max_bytes))
        block, self._fed = bytes(data[self._fed : end]), max(self._fed, end)
        return self._stream.feed(block)
