"""What the parts of a piece of work take, each without the parts within it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any


class Stopwatch:
    """Seconds per part, without what the parts called from within it took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[float] = []  #: per part being timed, the seconds that parts within it took
        self._wrapped: list[tuple[Any, str, Any]] = []

    def wrap(self, owner: Any, name: str, part: str) -> None:
        """Times every call of owner.name (a function, method or static method) as `part`."""
        found = vars(owner).get(name)
        timed = self.timed(getattr(owner, name), part)
        setattr(owner, name, staticmethod(timed) if isinstance(found, staticmethod) else timed)
        self._wrapped.append((owner, name, found))

    def unwrap(self) -> None:
        """Gives back what `wrap` replaced."""
        for owner, name, found in reversed(self._wrapped):
            delattr(owner, name) if found is None else setattr(owner, name, found)
        self._wrapped.clear()

    def timed(self, function: Callable, part: str) -> Callable:
        """`function`, timed as `part`."""

        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            self._open.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.process_time() - start
                self.seconds[part] += spent - self._open.pop()
                if self._open:
                    self._open[-1] += spent

        return call

    def take(self) -> dict[str, float]:
        """The seconds since the last call of it."""
        taken, self.seconds = dict(self.seconds), defaultdict(float)
        return taken
