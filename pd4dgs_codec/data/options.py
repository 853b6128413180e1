"""Options behind the name of a source: `name?key=value&key=value`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pd4dgs_codec.errors import DataError


def split_options(
    text: str, source: str, value: Callable[[str, str], Any], examples: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    """The name in `text` and the values of its options, each of `examples` once at most.

    value: of a key and its text, or ValueError. Raises DataError naming `source`, with the example of a key whose value
    is none.
    """
    name, _, query = text.partition("?")
    values: dict[str, Any] = {}
    for part in query.split("&") if "?" in text else []:
        key, _, given = part.partition("=")
        if key not in examples or key in values:
            raise DataError(
                f"{source}: found {part!r}, expected each of {', '.join(examples)} once at most, as key=value"
            )
        try:
            values[key] = value(key, given)
        except ValueError:
            raise DataError(f"{source}: {key} is {given!r}; expected for example {examples[key]}") from None
    return name, values
