"""Reading inputs and writing outputs: `-` for the standard streams, anything else by `atomic`."""

from __future__ import annotations

import io
import sys
from pathlib import Path

from pd4dgs_codec.cli.common import UsageError

STDIO = "-"


def read_bytes(path: str) -> bytes:
    """All bytes of a file, or of stdin for `-`. Raises OSError naming the path, UsageError if stdin is a terminal."""
    if path != STDIO:
        return Path(path).read_bytes()
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("nothing is piped to stdin; name a file")
    return sys.stdin.buffer.read()


class Stdin(io.BytesIO):
    """What was read from stdin, for a reader of files that names its input in messages."""

    def __str__(self) -> str:
        return "stdin"


def named_input(path: str) -> str | bytes:
    """What to hand to a reader that takes a path or bytes: the path itself, or all of stdin for `-`."""
    return read_bytes(path) if path == STDIO else path


def is_pd4(data: bytes) -> bool:
    """Whether the bytes begin as a `.pd4` file does; four bytes decide, so that a damaged one still counts."""
    from pd4dgs_codec.bitstream.container import SIGNATURE

    return data.startswith(SIGNATURE[:4])


def check_output(path: str, overwrite: bool) -> None:
    """Refuses, before any work, an output that exists or a folder that cannot take it."""
    if path != STDIO:
        from pd4dgs_codec import atomic  # where nothing is written, nothing waits for it

        atomic.check_output(path, overwrite)


def write_bytes(path: str, data: bytes, overwrite: bool) -> None:
    """Writes all of `data`, to a file whole or not at all."""
    if path != STDIO:
        from pd4dgs_codec import atomic

        atomic.write_bytes(path, data, overwrite)
        return
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()
