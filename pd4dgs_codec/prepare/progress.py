"""How a stage tells how far it is."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

#: Called after each item.
Advance = Callable[[], None]
#: (number of items or None, their name, the stage) -> what to call after each of them.
Progress = Callable[[int | None, str, str], AbstractContextManager[Advance]]
