"""Reading inputs and writing outputs: `-` for the standard streams, anything else by `atomic`."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pd4dgs_codec.cli.common import UsageError

if TYPE_CHECKING:
    import argparse

    from pd4dgs_codec.data.view import Dataset
    from pd4dgs_codec.scene import Scene

STDIO = "-"


def read_bytes(path: str) -> bytes:
    """All bytes of a file, or of stdin for `-`. Raises OSError naming the path, UsageError if stdin is a terminal."""
    if path != STDIO:
        return Path(path).read_bytes()
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("nothing is piped to stdin; name a file")
    return sys.stdin.buffer.read()


def named_input(path: str) -> str | bytes:
    """What to hand to a reader that takes a path or bytes: the path itself, or all of stdin for `-`."""
    return read_bytes(path) if path == STDIO else path


def is_pd4(data: bytes) -> bool:
    """Whether the bytes begin as a `.pd4` file does; four bytes decide, so that a damaged one still counts."""
    from pd4dgs_codec.format.container import SIGNATURE

    return data.startswith(SIGNATURE[:4])


def checkpoint_scene(path: str, data: bytes) -> Scene:
    """The scene of a checkpoint whose bytes `read_bytes` gave; it is this that needs torch."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene

    model, _ = checkpoint.load(path if path != STDIO else _Stdin(data))
    return to_scene(model)


class _Stdin(io.BytesIO):
    """What was read from stdin, for a reader of files that names its input in messages."""

    def __str__(self) -> str:
        return "stdin"


def write_checkpoint(path: str, scene: Scene, overwrite: bool) -> None:
    """Writes a scene as a checkpoint, whole or not at all."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import from_scene

    model = from_scene(scene)
    check_output(path, overwrite)  # it may have appeared meanwhile
    checkpoint.save(path, model)


def read_dataset(source: str, args: argparse.Namespace) -> Dataset:
    """The dataset, read as the options of `add_reading` say."""
    from pd4dgs_codec.interchange.teacher import load_source

    return load_source(source, downscale=args.downscale, holdout=args.holdout)


def check_output(path: str, overwrite: bool) -> None:
    """Refuses, before any work, an output that exists or a folder that cannot take it."""
    if path != STDIO:
        from pd4dgs_codec import io  # where nothing is written, nothing waits for it

        io.check_output(path, overwrite)


def write_bytes(path: str, data: bytes, overwrite: bool) -> None:
    """Writes all of `data`, to a file whole or not at all."""
    if path != STDIO:
        from pd4dgs_codec import io

        io.write_bytes(path, data, overwrite)
        return
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()
