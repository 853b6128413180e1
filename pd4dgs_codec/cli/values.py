"""Types of options: a text becomes a value, or one line on what was found and what was expected."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def _checked(kind: Callable[[str], T], accept: Callable[[T], bool], expected: str) -> Callable[[str], T]:
    """The type of options whose value `kind` reads and `accept` takes."""

    def read(text: str) -> T:
        with contextlib.suppress(ValueError):
            if accept(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")

    return read


positive_int = _checked(int, lambda value: value >= 1, "an integer >= 1")
count = _checked(int, lambda value: value >= 0, "an integer >= 0")
effort = _checked(int, lambda value: 1 <= value <= 9, "an integer from 1 to 9")
port = _checked(int, lambda value: 0 <= value < 65536, "0 to 65535")
#: What torch's generators take, as they do the next one.
seed = _checked(int, lambda value: 0 <= value <= 2**63 - 2, "an integer from 0 to 2^63 - 2")
positive_float = _checked(float, lambda value: 0 < value < math.inf, "a number > 0")
non_negative_float = _checked(float, lambda value: 0 <= value < math.inf, "a number >= 0")
share = _checked(float, lambda value: 0 <= value <= 1, "a number from 0 to 1")
finite_float = _checked(float, math.isfinite, "a number")


def listed(kind: Callable[[str], T]) -> Callable[[str], tuple[T, ...]]:
    """The type of comma-separated values of a kind, each once, in the order given."""
    return lambda text: tuple(dict.fromkeys(kind(part) for part in text.split(",")))


def one_of(*names: str) -> Callable[[str], str]:
    """The type of a name, for lists of them; a single one has argparse's choices."""
    return _checked(str, lambda text: text in names, f"one of {', '.join(names)}")


def rate(text: str) -> float:
    """A link rate in bits per second with k, M or G for 1e3, 1e6, 1e9: "2M" -> 2e6."""
    return _scaled(text, {"k": 1e3, "M": 1e6, "G": 1e9}, "a rate in bits per second such as 2M or 500k")


def rates(text: str) -> dict[str, float]:
    """Comma-separated link rates: "2M,10M" -> {"2M": 2e6, "10M": 1e7}."""
    return {name: rate(name) for name in text.split(",")}


def duration(text: str) -> float:
    """Seconds: "50ms", "1.5s" or "1.5"."""
    return _scaled(text, {"ms": 1e-3, "s": 1.0}, "a time such as 50ms or 1.5s", low=0.0)


def size(text: str) -> int:
    """Bytes with k, M for 1e3, 1e6: "50k" -> 50000."""
    return int(_scaled(text, {"k": 1e3, "M": 1e6}, "a size in bytes such as 50k", low=1.0))


def layer_sizes(text: str) -> dict[int, int]:
    """Bytes by layer with k, M for 1e3, 1e6: "L0=425k,L1=80000" -> {0: 425000, 1: 80000}."""
    layers, expected = {"L0": 0, "L1": 1, "L2": 2}, "sizes in bytes such as L0=425k,L1=120000"
    sizes: dict[int, int] = {}
    for part in text.split(","):
        name, _, size = part.partition("=")
        if name not in layers or layers[name] in sizes:
            raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}, each layer once")
        sizes[layers[name]] = int(_scaled(size, {"k": 1e3, "M": 1e6}, expected, low=1.0))
    return sizes


def picture_size(text: str) -> tuple[int, int]:
    """Width and height in pixels: "480x360"."""
    with contextlib.suppress(ValueError):
        width, height = map(int, text.split("x"))
        if 1 <= min(width, height) and max(width, height) <= 65535:
            return width, height
    raise argparse.ArgumentTypeError(f"found {text!r}, expected a size in pixels such as 480x360")


def _scaled(text: str, units: dict[str, float], expected: str, low: float = math.ulp(0.0)) -> float:
    """A finite number >= low times its unit."""
    unit = next((unit for unit in units if text.endswith(unit)), "")
    with contextlib.suppress(ValueError):
        value = float(text.removesuffix(unit)) * units.get(unit, 1.0)
        if low <= value < math.inf:
            return value
    raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")
