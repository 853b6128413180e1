"""Atomic writing of output files, checks of paths, and values that JSON can hold.

A writer gets a path in a temporary folder beside its target. Then the file is flushed to disk, gets the mode of the
file that it replaces, and is renamed to the target in one step. The folder is removed after any failure or signal; only
SIGKILL may leave it behind.
"""

import contextlib
import errno
import math
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # on Windows, where an open file cannot be removed
    fcntl = None  # type: ignore[assignment]

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.signals import held

PREFIX = ".pd4dgs-"
#: Matches the start of a URI, which as a path would make a folder `s3:`. Does not match a drive letter, nor a file name
#: with a colon such as `12:30.pd4`.
URI = re.compile(r"(?i)[a-z][a-z0-9+.-]+:(?:/|$)|(?:s3|gs|https?|file):")
#: Temporary folders of this process that exist.
_FOLDERS: set[Path] = set()


def check_path(path: str | Path) -> None:
    """Raises DataError if a path looks like a URI."""
    if URI.match(str(path)):
        raise DataError(f"{path}: looks like a URI, expected a path (./{path} is one)")


def check_output(path: str | Path, overwrite: bool) -> None:
    """Raises DataError if the output is a URI or a folder, exists without `overwrite`, or cannot be written to."""
    check_path(path)
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
    """Writes all of `data`, or leaves the old file as it is."""
    with whole_file(path, overwrite) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def whole_file(path: str | Path, overwrite: bool) -> Iterator[Path]:
    """Yields a temporary path to write to. It becomes `path` on success and is removed after any failure.

    The target of a symbolic link is replaced, not the link; a device or a pipe is written to directly. Raises DataError
    as check_output does, and OSError naming `path` if the system refuses.
    """
    check_output(path, overwrite)
    if is_device(Path(path)):  # renaming a file to /dev/null or a pipe would destroy it
        with _naming(path):
            yield Path(path)
        return
    target = Path(os.path.realpath(path))
    with _naming(path), temporary_folder(target.parent) as folder:  # on the same disk, so that the rename is one step
        yield folder / target.name
        _flush(folder / target.name)
        check_output(path, overwrite)  # it may have appeared meanwhile
        _move(folder / target.name, target)


def check_new(names: Iterable[str], overwrite: bool) -> None:
    """Raises DataError if an output is a URI, or exists without `overwrite`."""
    for name in names:
        check_path(name)
        if Path(name).exists() and not overwrite:
            raise DataError(f"{name}: exists already; --overwrite replaces it")


@contextlib.contextmanager
def whole_files(names: Sequence[str], overwrite: bool, told: str | None = None) -> Iterator[list[Path]]:
    """Yields temporary paths for outputs in one folder, which appear together once all are written. Creates the folder
    if missing. Raises DataError as check_new does; an OSError names `told` or the first."""
    check_new(names, overwrite)
    parent = Path(names[0]).parent
    with _naming(told or names[0]), temporary_folder(_existing(parent)) as folder:
        temporaries = [folder / Path(name).name for name in names]
        yield temporaries
        for temporary in temporaries:
            _flush(temporary)
        with held():  # all or none of them
            check_new(names, overwrite)  # they may have appeared meanwhile
            parent.mkdir(parents=True, exist_ok=True)
            for temporary, name in zip(temporaries, names, strict=True):
                _move(temporary, Path(name))


def write_files(folder: str | Path, files: Iterable[tuple[str, bytes]], overwrite: bool) -> dict[str, int]:
    """Writes files (name, content) into one folder, all or none, and holds one at a time. Returns their sizes by name.
    Raises as whole_files does."""
    place, sizes = Path(folder), dict[str, int]()
    with _naming(str(place)), temporary_folder(_existing(place)) as made:
        for name, content in files:
            sizes[name] = (made / name).write_bytes(content)
        with whole_files([str(place / name) for name in sizes], overwrite) as temporaries:
            for temporary in temporaries:
                (made / temporary.name).rename(temporary)
    return sizes


def _existing(folder: Path) -> Path:
    """The folder itself, or the nearest around it that exists. Raises DataError for a file."""
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    if not existing.is_dir():
        raise DataError(f"{existing}: is a file, expected a folder to write into")
    return existing


def check_source(path: str | Path) -> None:
    """Raises DataError for a URI or a device, whose bytes may never end, and OSError if nothing is there."""
    if not os.path.exists(path):
        check_path(path)
    mode = os.stat(path).st_mode
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
        raise DataError(f"{path}: is a device, expected a file")


def read_source(path: str | Path) -> bytes:
    """All bytes of a file, or of a pipe until its writer closes it. Raises DataError for all else."""
    with reading(path):
        check_source(path)
        if os.path.isdir(path):
            raise DataError(f"{path}: is a folder, expected a file")
        return Path(path).read_bytes()


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Within the block, errors of the system and invalid names become a DataError that names `path`."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a NUL or half a surrogate in the name
        raise DataError(f"{path}: cannot be read: {getattr(error, 'strerror', error)}") from None


def remove_leftovers(path: str | Path) -> None:
    """Removes the temporary folders of processes that were killed while writing `path`."""
    target = Path(os.path.realpath(path))
    for folder in target.parent.glob(f"{PREFIX}*"):
        if (folder / target.name).is_file() and not _is_used(folder):
            shutil.rmtree(folder, ignore_errors=True)


def lock(stream: IO[bytes]) -> None:
    """Locks an open file until it is closed. Raises OSError if another process has locked it."""
    if fcntl is not None:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_used(folder: Path) -> bool:
    """Whether the process that made a temporary folder may still run."""
    number = folder.name.removeprefix(PREFIX).partition("-")[0]
    if not number.isdigit():
        return False
    if os.name == "posix":  # on Windows this would end the process
        try:
            os.kill(int(number), 0)
        except (ProcessLookupError, OverflowError):
            return False
        except OSError:  # of another user
            pass
    return True


def is_device(path: Path) -> bool:
    """Whether `path` exists and is neither a file nor a folder."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def finite(value: Any) -> Any:
    """Returns `value` as JSON can hold it: infinities and NaN become None, tuples become lists."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Makes an OSError name the output instead of its temporary path or no path."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from None


@contextlib.contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yields a new folder in `parent`, or in the system's default place; failures and signals remove it too."""
    folder = None
    try:
        with held():
            folder = Path(tempfile.mkdtemp(dir=parent, prefix=f"{PREFIX}{os.getpid()}-"))
            _FOLDERS.add(folder)
        yield folder
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
            _FOLDERS.discard(folder)


def remove_temporaries() -> None:
    """Removes temporary folders of this process whose removal a signal interrupted."""
    while _FOLDERS:
        shutil.rmtree(_FOLDERS.pop(), ignore_errors=True)


def _flush(temporary: Path) -> None:
    with temporary.open("r+b") as stream:
        os.fsync(stream.fileno())  # otherwise a power failure may keep the rename and lose the bytes


def _move(temporary: Path, target: Path) -> None:
    with contextlib.suppress(FileNotFoundError):  # a new file keeps the default mode
        before = target.stat()
        with contextlib.suppress(PermissionError, AttributeError):  # only root may change owners; no chown on Windows
            os.chown(temporary, before.st_uid, before.st_gid)
        os.chmod(temporary, stat.S_IMODE(before.st_mode))
    os.replace(temporary, target)
