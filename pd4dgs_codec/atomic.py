"""Files that appear whole or not at all.

A writer gets a path in a temporary folder beside its target. Once it is done the file is flushed to the disk and takes
the name of the target in one step; on any failure the folder goes. A killed process may leave its folder behind.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from pd4dgs_codec.errors import DataError

PREFIX = ".pd4dgs-"


def check_output(path: str | Path, overwrite: bool) -> None:
    """Raises DataError, before any work, for an output that exists or a folder that cannot take it."""
    target = Path(path)
    if target.is_dir():
        raise DataError(f"{path}: is a folder, expected the name of an output file")
    if target.exists():
        if not overwrite and not is_device(target):
            raise DataError(f"{path}: exists already; --overwrite replaces it")
    elif not target.parent.is_dir():
        raise DataError(f"{path}: there is no folder {target.parent} to write into")
    if not os.access(target if is_device(target) else target.resolve().parent, os.W_OK):
        raise DataError(f"{path}: no permission to write here")


def write_bytes(path: str | Path, data: bytes | memoryview, overwrite: bool) -> None:
    """Writes all of `data` or leaves what was there."""
    with whole_file(path, overwrite) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def whole_file(path: str | Path, overwrite: bool) -> Iterator[Path]:
    """A temporary path to write to; on success it becomes `path`, on any failure it goes.

    A symbolic link stays one, and a device or a pipe is written to directly. Raises DataError as check_output does,
    OSError naming `path` if the system refuses.
    """
    check_output(path, overwrite)
    if is_device(Path(path)):  # /dev/null or a pipe: replacing it by a file would destroy it
        yield Path(path)
        return
    target = Path(os.path.realpath(path))
    with _temporary_folder(target.parent, path) as folder:
        yield folder / target.name
        check_output(path, overwrite)  # it may have appeared meanwhile
        _move(folder / target.name, target)


@contextlib.contextmanager
def whole_files(pattern: str, names: Sequence[str], overwrite: bool) -> Iterator[list[Path]]:
    """Temporary paths for outputs that appear together once all are written; their folder is made if missing.

    Errors of the system name `pattern`, in whose folder all of `names` lie.
    """
    parent = Path(pattern).parent
    for name in names:
        if Path(name).exists() and not overwrite:
            raise DataError(f"{name}: exists already; --overwrite replaces it")
    existing = next(p for p in (parent, *parent.parents) if p.exists())
    if not existing.is_dir():
        raise DataError(f"{existing}: is a file, expected a folder to write into")
    with _temporary_folder(existing, pattern) as folder:
        temporaries = [folder / Path(name).name for name in names]
        yield temporaries
        parent.mkdir(parents=True, exist_ok=True)
        for temporary, name in zip(temporaries, names, strict=True):
            _move(temporary, Path(name))


def remove_leftovers(path: str | Path) -> None:
    """Removes what writing `path` left beside it when its process was killed. Nothing may be writing it now."""
    target = Path(os.path.realpath(path))
    for folder in target.parent.glob(f"{PREFIX}*"):
        if (folder / target.name).is_file():
            shutil.rmtree(folder, ignore_errors=True)


def is_device(path: Path) -> bool:
    """Whether something is there that is neither a file nor a folder."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


@contextlib.contextmanager
def _temporary_folder(parent: Path, path: str | Path) -> Iterator[Path]:
    """A folder on the same disk as the output, so that the rename is one step. Errors name the output, not a folder."""
    folder = None
    try:
        folder = tempfile.mkdtemp(dir=parent, prefix=PREFIX)
        yield Path(folder)
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from None
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _move(temporary: Path, target: Path) -> None:
    with temporary.open("r+b") as stream:
        os.fsync(stream.fileno())  # else the rename may outlive the bytes when the power fails
    os.replace(temporary, target)
