"""Reading inputs and writing outputs: `-` for the standard streams, outputs whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pd4dgs_codec.cli.common import UsageError
from pd4dgs_codec.errors import DataError

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
    from pd4dgs_codec.bitstream.container import SIGNATURE

    return data.startswith(SIGNATURE[:4])


def check_output(path: str, overwrite: bool) -> None:
    """Refuses, before any work, an output that exists or a folder that cannot take it."""
    if path == STDIO:
        return
    target = Path(path)
    if target.is_dir():
        raise DataError(f"{path}: is a folder, expected the name of an output file")
    if target.exists():
        if not overwrite and not _is_device(target):
            raise DataError(f"{path}: exists already; --overwrite replaces it")
    elif not target.parent.is_dir():
        raise DataError(f"{path}: there is no folder {target.parent} to write into")
    if not os.access(target if _is_device(target) else target.resolve().parent, os.W_OK):
        raise DataError(f"{path}: no permission to write here")


def write_bytes(path: str, data: bytes, overwrite: bool) -> None:
    """Writes all of `data` or leaves nothing: a temporary file beside the target, then a rename."""
    if path == STDIO:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
        return
    with whole_file(path, overwrite) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def whole_file(path: str, overwrite: bool) -> Iterator[Path]:
    """A temporary path to write to; on success it becomes `path`, on any failure it goes."""
    check_output(path, overwrite)
    if _is_device(Path(path)):  # /dev/null or a pipe: replacing it by a file would destroy it
        yield Path(path)
        return
    target = Path(os.path.realpath(path))  # a symbolic link stays one
    folder = _temporary_folder(target.parent, path)
    try:
        temporary = Path(folder) / target.name
        yield temporary
        check_output(path, overwrite)  # it may have appeared meanwhile
        os.replace(temporary, target)
    except OSError as error:
        raise _named(error, path) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def whole_files(pattern: str, names: list[str], overwrite: bool) -> Iterator[list[Path]]:
    """Temporary paths for outputs that appear together once all are written; their folder is made if missing."""
    parent = Path(pattern).parent
    for name in names:
        if Path(name).exists() and not overwrite:
            raise DataError(f"{name}: exists already; --overwrite replaces it")
    existing = next(p for p in (parent, *parent.parents) if p.exists())
    if not existing.is_dir():
        raise DataError(f"{existing}: is a file, expected a folder to write into")
    folder = _temporary_folder(existing, str(parent))
    try:
        temporaries = [Path(folder) / Path(name).name for name in names]
        yield temporaries
        parent.mkdir(parents=True, exist_ok=True)
        for temporary, name in zip(temporaries, names, strict=True):
            os.replace(temporary, name)
    except OSError as error:
        raise _named(error, pattern) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _temporary_folder(parent: Path, path: str) -> str:
    """A folder on the same disk as the output, so that the final rename is one step."""
    try:
        return tempfile.mkdtemp(dir=parent, prefix=".pd4dgs-")
    except OSError as error:
        raise _named(error, path) from None


def _is_device(path: Path) -> bool:
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _named(error: OSError, path: str) -> OSError:
    """The same error naming the output that the caller asked for, not a temporary file."""
    return OSError(error.errno or errno.EIO, error.strerror or str(error), path)
