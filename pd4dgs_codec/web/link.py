"""A slow link, simulated: bytes may go on once a link of the given rate would have carried them."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

#: Of link time per block: short against the milliseconds to be measured, long against what waking a thread costs.
QUANTUM_SECONDS = 0.005
MIN_BLOCK, MAX_BLOCK = 64, 1 << 18
#: A thread that wakes late catches up by as much; what a stalled reader leaves unused beyond it is lost, as on a link.
CATCH_UP_SECONDS = 0.05


class Link:
    """One link that all transfers share in turn, block by block.

    rate: bits per second of payload (protocol headers cross for free), or None for no limit.
    """

    def __init__(self, rate: float | None = None):
        self.rate = rate
        #: Bytes to hand over at a time.
        self.block = MAX_BLOCK if rate is None else int(min(max(rate * QUANTUM_SECONDS / 8, MIN_BLOCK), MAX_BLOCK))
        self._lock = threading.Lock()
        self._transfers = 0
        self._free_at = 0.0  # when the last block granted will have crossed

    @contextlib.contextmanager
    def transfer(self) -> Iterator[None]:
        """Around one response: after a rest the link starts with nothing saved up."""
        with self._lock:
            if not self._transfers:
                self._free_at = max(self._free_at, time.monotonic())
            self._transfers += 1
        try:
            yield
        finally:
            with self._lock:
                self._transfers -= 1

    def send(self, body: bytes, write: Callable[[bytes], object]) -> None:
        """Hands `body` to `write` block by block, each once it has crossed."""
        with self.transfer():
            for start in range(0, len(body), self.block):
                block = body[start : start + self.block]
                self.cross(len(block))
                write(block)

    def cross(self, size: int) -> None:
        """Returns when `size` more bytes have crossed. Deadlines are absolute, so that late wakings do not add up."""
        if self.rate is None:
            return
        with self._lock:
            start = max(self._free_at, time.monotonic() - CATCH_UP_SECONDS)
            self._free_at = done_at = start + 8 * size / self.rate
        wait = done_at - time.monotonic()
        if wait > 0:
            time.sleep(wait)
