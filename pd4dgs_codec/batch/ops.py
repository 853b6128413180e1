"""The operations of a batch: which command runs on a source, and what it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pd4dgs_codec.errors import DataError


@dataclass(frozen=True)
class Op:
    """A command for one source.

    suffix: of the output; "" is a folder. finds: what `scan` takes for sources. stdout: the output is the JSON object
    that the command prints. inputs: options whose values are sources too; they count by what they hold.
    """

    suffix: str
    finds: tuple[str, ...]
    stdout: bool = False
    inputs: tuple[str, ...] = ()


VIDEOS = ("*.mp4", "*.mov", "*.mkv", "*.webm", "*.avi")
DATASETS = ("camera/", "transforms*.json", "poses_bounds.npy", "sparse/0/")

OPS = {
    "prepare": Op("", VIDEOS),
    "train": Op(".pt", DATASETS),
    "encode": Op(".pd4", ("*.pt",), inputs=("data",)),
    "eval": Op(".json", ("*.pd4",), stdout=True, inputs=("data",)),
    "package": Op("", ("*.pd4",)),
}

#: What the batch itself gives to every command, or what has no meaning for a scene among many.
RESERVED = {"output", "overwrite", "threads", "json", "help", "version", "verbose", "resume", "log"}


def arguments(verb: str, source: str, output: str, options: dict[str, Any]) -> list[str]:
    """The command line of an operation on a source. Raises DataError for options that no command line can say."""
    argv = [source]
    options = dict(options)
    if verb == "eval":
        if not isinstance(options.get("data"), str):
            raise DataError("eval needs the option data: the dataset to compare with")
        argv.append(options.pop("data"))
    else:
        argv += ["--output", output]
    for name, value in options.items():
        if name in RESERVED or not name.replace("-", "").isalnum() or name.startswith("-"):
            raise DataError(f"option {name!r} is not one that a line can set")
        for item in value if isinstance(value, list) else [value]:
            if item is True:
                argv.append(f"--{name}")
            elif isinstance(item, (str, int, float)) and item is not False:
                argv.append(f"--{name}={item}")
            elif item is not False:
                raise DataError(f"option {name} is {item!r}, expected a text, a number, true, or a list of them")
    return argv


#: Runs a command, (verb, argv) -> (exit code, its stdout, its stderr).
Command = Callable[[str, list[str]], tuple[int, str, str]]
