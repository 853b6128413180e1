"""Manifests: a JSON object per line, `{"source": ..., "output": ..., "options": {...}}`.

A line that is broken is named and the others go on, so reading gives faults beside lines. Lines are read anew for each
pass instead of being kept: a million of them is a gigabyte.
"""

from __future__ import annotations

import hashlib
import json
import posixpath
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pd4dgs_codec.batch import store
from pd4dgs_codec.batch.ops import DATASETS, OPS, Op
from pd4dgs_codec.errors import DataError

KEYS = ("source", "output", "options")
#: Sources that are no files: their text says all.
SPECIFICATIONS = ("synthetic:",)


@dataclass(frozen=True)
class Line:
    """A line that can be tried. number: from 1 on. output: a path below the batch's root."""

    number: int
    source: str
    output: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """A line that cannot. message: what was found and what was expected."""

    number: int
    message: str


#: What options of a line a command takes: raises DataError for others.
Check = Callable[[dict[str, Any]], None]


class Manifest:
    """The lines of a manifest for an operation. Reading it raises OSError or DataError where there is none."""

    def __init__(self, place: str, op: Op, check: Check):
        self.place, self.op, self.check = place, op, check
        seen: dict[bytes, int] = {}  # by hash: names of a million outputs would be long
        self.faults: list[Fault] = []
        refused: set[int] = set()
        count = 0
        for item in self._parsed():
            if isinstance(item, Line):
                first = seen.setdefault(hashlib.sha256(item.output.encode()).digest()[:16], item.number)
                if first == item.number:
                    count += 1
                    continue
                item = Fault(item.number, f"output {item.output!r} is that of line {first}; expected one of its own")
            self.faults.append(item)
            refused.add(item.number)
        self._refused, self.count = refused, count  #: count: of lines that can be tried
        if not (count or self.faults):
            raise DataError(f"{place}: holds no lines, expected a JSON object for each scene")

    def lines(self) -> Iterator[Line]:
        """The lines that can be tried, in their order."""
        for item in self._parsed():
            if isinstance(item, Line) and item.number not in self._refused:
                yield item

    def _parsed(self) -> Iterator[Line | Fault]:
        with store.opened(self.place) as stream:
            for number, raw in enumerate(stream, 1):
                if raw.strip():
                    try:
                        yield self._line(number, raw)
                    except DataError as error:
                        yield Fault(number, str(error))

    def _line(self, number: int, raw: bytes) -> Line:
        try:
            content = json.loads(raw.decode("utf-8-sig").rstrip())
        except json.JSONDecodeError as error:
            raise DataError(f"not JSON: {error.msg}, at its character {error.pos + 1}") from None
        except (ValueError, RecursionError) as error:
            raise DataError(f"not JSON: {error}") from None
        if not isinstance(content, dict) or not set(content) <= set(KEYS):
            found = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
            raise DataError(f"found {found}; expected an object of {', '.join(KEYS)}")
        source, options = content.get("source"), content.get("options", {})
        if not isinstance(source, str) or not source:
            raise DataError(f"source is {source!r}, expected a path or a URI")
        if not isinstance(options, dict):
            raise DataError(f"options are {options!r}, expected an object")
        output = content.get("output", default_output(source, self.op))
        if not isinstance(output, str) or not is_plain(output) or output.endswith(store.RECORD):
            raise DataError(f"output is {output!r}, expected a path below -o, which does not end in {store.RECORD}")
        self.check(options)
        places = {name: absolute(options[name]) for name in self.op.inputs if name in options}
        return Line(number, absolute(source), output, options | places)


def absolute(place: str) -> str:
    """A source as workers in other folders find it."""
    return place if place.startswith(SPECIFICATIONS) else store.absolute(place)


def is_plain(name: str) -> bool:
    """Whether it is a relative path of ordinary parts."""
    parts = name.split("/")
    return name.isprintable() and "\\" not in name and not {"", ".", ".."} & set(parts)


def default_output(source: str, op: Op) -> str:
    """Its last part with the operation's suffix: kitchen.pt -> kitchen.pd4."""
    name = posixpath.basename(source.partition("?")[0].rstrip("/")).rpartition(":")[2]
    return (posixpath.splitext(name)[0] or name) + op.suffix


def scan(folder: str, verb: str | None) -> Iterator[dict[str, str]]:
    """The lines of a manifest of what is in a folder, of a path or a URI: sources with their outputs.

    verb: one of OPS; None for what the folder holds, if that is of one kind. Raises DataError if it holds nothing
    for it, or several kinds.
    """
    names = store.names(folder)
    found = {name: _sources(names, op) for name, op in OPS.items()}
    kinds = [verb] if verb else [name for name in ("prepare", "train", "encode", "package") if found[name]]
    if len(kinds) > 1:
        raise DataError(f"{folder}: holds sources for {' and '.join(kinds)}; expected --op with one of them")
    if not kinds or not found[kinds[0]]:
        wanted = ", ".join(OPS[verb].finds if verb else ("*.pt", "*.pd4", *DATASETS))
        raise DataError(f"{folder}: holds no sources, expected {wanted}")
    op = OPS[kinds[0]]
    for name in found[kinds[0]]:
        yield {
            "source": posixpath.join(folder, name),
            "output": posixpath.join(posixpath.dirname(name), default_output(name, op)),
        }


def _sources(names: list[str], op: Op) -> list[str]:
    if op.finds != DATASETS:
        return sorted(name for name in names if Path(name).suffix.lower() in {Path(f).suffix for f in op.finds})
    folders = set()
    for name in names:
        parts = name.split("/")
        folders |= {"/".join(parts[:i]) for i, part in enumerate(parts[:-1]) if part == "camera"}
        folders |= {"/".join(parts[:i]) for i in range(len(parts) - 2) if parts[i : i + 2] == ["sparse", "0"]}
        if Path(name).match("transforms*.json") or parts[-1] == "poses_bounds.npy":
            folders.add("/".join(parts[:-1]))
    return sorted(folders - {""})
