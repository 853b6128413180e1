"""Manifests: a JSON object per line, `{"source": ..., "output": ..., "options": {...}}`, for one operation.

An operation is a command of the package that runs on each source. A broken line is reported and the others go on.
"""

from __future__ import annotations

import json
import posixpath
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from pd4dgs_codec.batch import store
from pd4dgs_codec.data.dataset import SYNTHETIC, dataset_folders
from pd4dgs_codec.errors import DataError, one_line


@dataclass(frozen=True)
class Op:
    """A command for one source.

    suffix: of the output; "" for a folder. finds: suffixes of its sources, none for dataset folders. stdout: the output
    is the JSON object that the command prints. inputs: options that name further sources.
    """

    suffix: str
    finds: tuple[str, ...] = ()
    stdout: bool = False
    inputs: tuple[str, ...] = ()


OPS = {
    "prepare": Op("", (".mp4", ".mov", ".mkv", ".webm", ".avi")),
    "train": Op(".pt"),
    "encode": Op(".pd4", (".pt",), inputs=("data",)),
    "eval": Op(".json", (".pd4",), stdout=True, inputs=("data",)),
    "package": Op("", (".pd4",)),
}
#: Options that the batch sets for every command, or that make no sense for one scene of many.
RESERVED = {"output", "overwrite", "threads", "json", "help", "version", "verbose", "resume", "log"}
KEYS = ("source", "output", "options")


@dataclass(frozen=True)
class Line:
    """A valid line. number: from 1 on. output: a path below the root of the batch."""

    number: int
    source: str
    output: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """A broken line. message: found and expected."""

    number: int
    message: str


class Manifest:
    """The valid and the broken lines of a manifest. Raises OSError or DataError if it cannot be read or is empty.

    check: raises DataError for options that the command does not take.
    """

    def __init__(self, place: str, op: Op, check: Callable[[dict[str, Any]], None]):
        self.lines: list[Line] = []
        self.faults: list[Fault] = []
        first: dict[str, int] = {}
        with store.opened(place) as stream:
            for number, raw in enumerate(stream, 1):
                if not raw.strip():
                    continue
                try:
                    line = _line(number, raw, op, check)
                    if first.setdefault(line.output, number) != number:
                        what = f"output {line.output!r} is that of line {first[line.output]}"
                        raise DataError(f"{what}; expected one of its own")
                    self.lines.append(line)
                except DataError as error:
                    self.faults.append(Fault(number, str(error)))
                except Exception as error:  # what no check foresaw is this line's alone
                    self.faults.append(Fault(number, one_line(f"{type(error).__name__}: {error}")))
        if not (self.lines or self.faults):
            raise DataError(f"{place}: holds no lines, expected a JSON object for each scene")


def _line(number: int, raw: bytes, op: Op, check: Callable[[dict[str, Any]], None]) -> Line:
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
    output = content.get("output", default_output(source, op))
    plain = isinstance(output, str) and output.isprintable() and "\\" not in output
    if not plain or {"", ".", ".."} & set(output.split("/")) or output.endswith(store.RECORD):
        raise DataError(f"output is {output!r}, expected a path below -o, which does not end in {store.RECORD}")
    check(options)
    inputs = {name: _absolute(options[name]) for name in op.inputs if name in options}
    return Line(number, _absolute(source), output, options | inputs)


def _absolute(place: Any) -> str:
    if not isinstance(place, str) or not place:
        raise DataError(f"found {place!r}, expected a path or a URI")
    return place if place.startswith(SYNTHETIC) else store.absolute(place)


def default_output(source: str, op: Op) -> str:
    """The last part of the source with the operation's suffix: kitchen.pt -> kitchen.pd4."""
    name = posixpath.basename(source.partition("?")[0].rstrip("/")).rpartition(":")[2]
    return (posixpath.splitext(name)[0] or name) + op.suffix


def arguments(verb: str, source: str, output: str, options: dict[str, Any]) -> list[str]:
    """The command line of an operation on a source. Raises DataError for options that no command line can express."""
    options = dict(options)
    if verb == "eval":
        if not isinstance(options.get("data"), str):
            raise DataError("eval needs the option data: the dataset to compare with")
        argv = [source, options.pop("data")]
    else:
        argv = [source, "--output", output]
    for name, value in options.items():
        if name in RESERVED or not name.replace("-", "").isalnum() or name.startswith("-"):
            raise DataError(f"option {name!r} is not one that a line can set")
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, (str, int, float)):
                raise DataError(f"option {name} is {item!r}, expected a text, a number, true, or a list of them")
            if item is not False:
                argv.append(f"--{name}" if item is True else f"--{name}={item}")
    return argv


def scan(folder: str, verb: str | None) -> Iterator[dict[str, str]]:
    """The lines of a manifest of the sources in a folder, a path or a URI.

    verb: one of OPS; None for the one whose sources the folder holds. Raises DataError if it holds none, or sources of
    several kinds.
    """
    names = store.names(folder)

    def sources(op: Op) -> list[str]:
        if not op.finds:
            return dataset_folders(names)
        return sorted(name for name in names if PurePosixPath(name).suffix.lower() in op.finds)

    found = {name: sources(op) for name, op in OPS.items()}
    kinds = [verb] if verb else [name for name in ("prepare", "train", "encode", "package") if found[name]]
    if len(kinds) > 1:
        raise DataError(f"{folder}: holds sources for {' and '.join(kinds)}; expected --op with one of them")
    if not kinds or not found[kinds[0]]:
        wanted = OPS[verb].finds if verb else [suffix for op in OPS.values() for suffix in op.finds]
        raise DataError(f"{folder}: holds no sources, expected {', '.join(dict.fromkeys(wanted)) or 'dataset folders'}")
    for name in found[kinds[0]]:
        output = posixpath.join(posixpath.dirname(name), default_output(name, OPS[kinds[0]]))
        yield {"source": posixpath.join(folder, name), "output": output}
