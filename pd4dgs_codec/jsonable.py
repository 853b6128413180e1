"""Values as JSON can hold them; the commands, the trainer's log and the reports share it."""

from __future__ import annotations

import math
from typing import Any


def finite(value: Any) -> Any:
    """`value` with infinities and NaN as None, tuples as lists: JSON has none of them."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
