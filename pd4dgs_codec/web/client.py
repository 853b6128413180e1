"""The viewer's side of a `.pd4` file on a web server: slices as they arrive, upgrades later, interruptions survived.

Slices build on each other, so the next one is always the next in the file; `next_end` decides after every slice whether
to fetch it:

1. no slice of a layer above `max_layer`, and none that ends beyond `bytes`;
2. the first slice always, as long as `seconds` last: without it there is no picture;
3. a further slice only if its missing bytes would arrive within `seconds` at the rate of the last second.

Bytes of an unfinished slice stay when the time is over, and a later call continues from there.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from pd4dgs_codec.errors import BadSignature, DecodeError, UnsupportedVersion
from pd4dgs_codec.format.decoder import open_stream
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.transfer import (
    HEADER_GUESS,
    LONGEST_HEADER,
    MOST_BYTES,
    Changed,
    OutOfTime,
    Transfer,
    check_end,
    prefix_end,
    slice_ends,
)

RATE_SECONDS = 1.0


@dataclass(frozen=True)
class Budget:
    """Limits of a download: highest layer, bytes counted from the first of the file, seconds counted from the call.

    Without bytes nothing behind byte MOST_BYTES is fetched, and it is a fault if the first slice ends there.
    """

    max_layer: int | None = None
    bytes: int | None = None
    seconds: float = math.inf

    def end(self, slices: list[tuple[int, int]]) -> int:
        """End of the last slice that it allows, 0 if there is none."""
        return prefix_end(slices, self.max_layer, MOST_BYTES if self.bytes is None else self.bytes)


def next_end(
    slices: list[tuple[int, int]], have: int, budget: Budget, seconds_left: float, rate: float | None
) -> int | None:
    """End offset of the next slice to fetch; None to stop.

    slices: (layer, end offset) in file order. have: bytes here. rate: recent bytes per second; None if unknown.
    """
    limit = budget.end(slices)
    end = next((end for _, end in slices if have < end <= limit), None)
    if end is None or seconds_left <= 0:
        return None
    first = end == slices[0][1]
    in_time = rate is None or seconds_left == math.inf or end - have <= rate * seconds_left
    return end if first or in_time else None


def recent_rate(arrivals: deque[tuple[float, int]]) -> float | None:
    """Bytes per second over the last RATE_SECONDS of (time, bytes here), before which entries are dropped; None before
    any bytes arrived."""
    while len(arrivals) > 2 and arrivals[-1][0] - arrivals[1][0] >= RATE_SECONDS:
        arrivals.popleft()
    (start, before), (end, after) = arrivals[0], arrivals[-1]
    return (after - before) / max(end - start, 1e-6) if after > before else None


class SceneClient:
    """Scenes of one URL, as early as they can be decoded. Use it in a `with` block, or close it.

    The first request is one open-ended GET, read as it arrives. After an interruption, and for slices requested later,
    Range with If-Range fetches the missing bytes only. If the file has changed, decoding restarts with its layer 0. A
    damaged slice is fetched once more and never yielded. transfer: bytes and counts, see Transfer.
    """

    def __init__(self, url: str, *, stall: float = 10.0, attempts: int = 5):
        self.transfer = Transfer(url, stall=stall, attempts=attempts)
        self._repaired_at = -1
        self._begin()

    def __enter__(self) -> SceneClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def arrived_at(self) -> float:
        """time.monotonic() of the latest bytes; when a scene is yielded, of the last byte of its slice."""
        return self._arrivals[-1][0]

    def close(self) -> None:
        """Closes the connection; `scenes` may be called again and opens another."""
        self.transfer.close()

    def scenes(self, budget: Budget = Budget()) -> Iterator[Scene]:
        """The newest scene as slices arrive, with all slices so far, until the budget is spent.

        A further call continues after the last slice yielded. Raises DeliveryError if the file is not available,
        DecodeError if it is invalid; scenes yielded before stay valid.
        """
        until = time.monotonic() + budget.seconds
        self._arrivals = self._now()
        while True:
            while ready := self._ready(budget):  # until empty: a fault behind a slice is raised by the next feed
                yield from ready
            left = until - time.monotonic()
            end: int | None = HEADER_GUESS if len(self.transfer.data) < HEADER_GUESS else LONGEST_HEADER
            reach = None
            if self._slices:
                if budget.bytes is None:
                    check_end(self._slices[0][1])
                end = next_end(self._slices, len(self.transfer.data), budget, left, recent_rate(self._arrivals))
                reach = budget.end(self._slices)
            if end is None:
                break
            try:
                block = self.transfer.read(end, reach=reach, seconds=left)
            except Changed:
                self._begin()
                continue
            except OutOfTime:
                break
            if not block:
                self._stream.finish()  # raises Truncated: the file ends within this slice
            self._arrivals += self._now()
        self.close()

    def _begin(self) -> None:
        self._stream, self._fed = open_stream(), 0
        self._slices: list[tuple[int, int]] = []
        self._arrivals = self._now()

    def _now(self) -> deque[tuple[float, int]]:
        return deque([(time.monotonic(), len(self.transfer.data))])

    def _ready(self, budget: Budget) -> list[Scene]:
        """Feeds new bytes to the decoder. After a fault the transfer goes back to the end of the last valid slice."""
        try:
            return self._feed(budget)
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

    def _feed(self, budget: Budget) -> list[Scene]:
        data, end = self.transfer.data, len(self.transfer.data)
        if not self._slices:
            self._slices = slice_ends(data)
        if self._slices:  # the first bytes of a small file may hold more than the budget allows
            end = min(end, budget.end(self._slices))
        block, self._fed = bytes(data[self._fed : end]), max(self._fed, end)
        return self._stream.feed(block)
