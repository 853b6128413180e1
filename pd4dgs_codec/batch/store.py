"""Where sources come from and outputs go: paths and the URIs that fsspec knows (s3, gs, https, memory, ...).

An output is the files it consists of and a record, `OUTPUT.done.json`, that is written after them. Each file appears
whole or not at all: on a disk by a rename, in object stores because they work that way. Only the record says that an
output is finished.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import posixpath
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, TypeVar

import fsspec
from fsspec.implementations.local import LocalFileSystem

from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.io import whole_file

RECORD = ".done.json"
PROBE = ".pd4dgs-batch"
#: Seconds between tries where a store fails: what took an hour is not thrown away for one refused request.
PAUSES = (0.2, 1.0, 4.0)
#: Fields of a file's entry in a store that change when the file does, the first one that there is.
STAMPS = ("ETag", "etag", "md5Hash", "generation", "LastModified", "Last-Modified", "mtime")
#: What answers the same however often it is asked.
FINAL = (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError, NotADirectoryError, DataError)

T = TypeVar("T")


def absolute(place: str) -> str:
    """A path as workers in other folders find it; a URI as it is. Raises DataError for a scheme that nothing knows."""
    system, path = _system(place)
    return str(path) if isinstance(system, LocalFileSystem) else place


def _system(place: str) -> tuple[Any, str]:
    """(file system, path in it). Raises DataError for a scheme that no installed package knows."""
    try:
        system, path = fsspec.core.url_to_fs(place)
    except (ImportError, ValueError) as error:
        raise DataError(f"{place}: {one_line(str(error))}") from None
    return system, path


def patiently(call: Callable[[], T], place: str) -> T:
    """What `call` returns, tried again where the store fails. Raises OSError naming `place`, FINAL ones at once."""
    for pause in (*PAUSES, None):
        try:
            return call()
        except FINAL as error:
            if isinstance(error, DataError):
                raise
            raise type(error)(error.errno, error.strerror or one_line(str(error)), place) from None
        except Exception as error:  # each store has exceptions of its own
            if pause is None:
                raise OSError(errno.EIO, f"{type(error).__name__}: {one_line(str(error))}", place) from None
            time.sleep(pause)
    raise AssertionError("unreachable")


@contextlib.contextmanager
def opened(place: str) -> Iterator[IO[bytes]]:
    """A file to read. Raises OSError naming it."""
    system, path = _system(place)
    stream = patiently(lambda: system.open(path, "rb"), place)
    with stream:
        yield stream


def names(folder: str) -> list[str]:
    """Relative paths of all files below a folder, without those whose parts begin with a dot. Raises OSError."""
    system, path = _system(folder)
    found = patiently(lambda: system.find(path), folder)
    if not found:
        raise FileNotFoundError(errno.ENOENT, "found no files, expected a folder with sources", folder)
    below = [posixpath.relpath(name, path) for name in found]
    return sorted(name for name in below if not any(part.startswith(".") for part in name.split("/")))


def stamp(place: str) -> str | None:
    """What changes when a file does, without reading it; None where the store does not tell, and for folders."""
    system, path = _system(place)
    entry = patiently(lambda: system.info(path), place)
    if entry.get("type") != "file":
        return None
    known = [f"{name} {entry[name]}" for name in STAMPS if entry.get(name)]
    return f"{entry.get('size')} bytes, {known[0]}" if known else None


def fetch(place: str, folder: Path) -> Path:
    """A source as a path: itself if it is on this machine, else its copy in `folder`. Raises OSError."""
    system, path = _system(place)
    if isinstance(system, LocalFileSystem):
        if not Path(path).exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), place)
        return Path(path)
    target = folder / posixpath.basename(path.rstrip("/"))
    entry = patiently(lambda: system.info(path), place)
    if entry["type"] == "file":  # get() would ask again what it is
        patiently(lambda: system.get_file(path, str(target)), place)
    else:
        patiently(lambda: system.get(path, str(target), recursive=True), place)
    return target


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes, or of the names and bytes of all files of a folder."""
    if path.is_file():
        whole = hashlib.sha256()
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                whole.update(block)
        return whole.hexdigest()
    whole = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        whole.update(f"{file.relative_to(path).as_posix()}\0{digest(file)}\n".encode())
    return whole.hexdigest()


class Root:
    """The place below which a batch writes."""

    def __init__(self, place: str):
        self.place = place.rstrip("/")
        self.system, self.path = _system(self.place)
        self.local = isinstance(self.system, LocalFileSystem)

    def check(self) -> None:
        """Raises DataError, before any work, for a place that takes no output."""
        try:
            self._put(PROBE, b"")
        except OSError as error:
            raise DataError(f"{self.place}: takes no output: {error.strerror}") from None
        with contextlib.suppress(Exception):  # a store where nothing may be deleted keeps an empty object
            self.system.rm_file(self._at(PROBE))

    def record(self, output: str, overwrite: bool) -> dict[str, Any] | None:
        """What is said of a finished output; None if it is not finished. Raises DataError for what is no record, unless
        that may be overwritten."""
        try:
            raw = patiently(lambda: self.system.cat_file(self._at(output + RECORD)), self._named(output + RECORD))
        except FileNotFoundError:
            return None
        try:
            content = json.loads(raw)
        except ValueError:
            content = None
        if isinstance(content, dict) and isinstance(content.get("files"), dict):
            return content
        if overwrite:
            return None
        raise DataError(f"{self._named(output + RECORD)}: is not a record of a batch; --overwrite replaces it")

    def holds(self, output: str, files: dict[str, Any]) -> bool:
        """Whether all files of an output are there, of the sizes in its record."""
        return all(self._size(output, name) == entry["bytes"] for name, entry in files.items())

    def publish(self, output: str, files: dict[str, Path], record: dict[str, Any], replace: bool) -> dict[str, Any]:
        """Writes an output, and after its files (name -> where they are; "" is the output itself) the record, to which
        their sizes and digests are added. Returns the whole record.

        replace: what is there of other content may go. Raises DataError if there is any else, OSError if the store
        fails.
        """
        entries = {name: {"bytes": path.stat().st_size, "sha256": digest(path)} for name, path in files.items()}
        whole = record | {"files": entries}
        for name, path in files.items():
            place = posixpath.join(output, name) if name else output
            size = self._size(output, name)
            if size is not None and not replace and not self._same(place, size, entries[name]):
                raise DataError(f"{self._named(place)}: exists already, with no record of it; --overwrite replaces it")
            self._put(place, path)
        self._put(output + RECORD, (json.dumps(whole, indent=1, sort_keys=True) + "\n").encode())
        return whole

    def _same(self, place: str, size: int, entry: dict[str, Any]) -> bool:
        """Whether a killed run left it that had written the file and not the record yet."""
        if size != entry["bytes"]:
            return False
        content = patiently(lambda: self.system.cat_file(self._at(place)), self._named(place))
        return hashlib.sha256(content).hexdigest() == str(entry["sha256"])

    def _size(self, output: str, name: str) -> int | None:
        place = posixpath.join(output, name) if name else output
        try:
            return int(patiently(lambda: self.system.info(self._at(place)), self._named(place))["size"])
        except FileNotFoundError:
            return None

    def _put(self, name: str, content: Path | bytes) -> None:
        where = self._at(name)

        def to_disk() -> None:
            Path(where).parent.mkdir(parents=True, exist_ok=True)
            with whole_file(where, overwrite=True) as temporary:
                if isinstance(content, bytes):
                    temporary.write_bytes(content)
                else:
                    shutil.copyfile(content, temporary)

        def to_store() -> None:
            if isinstance(content, bytes):
                self.system.pipe_file(where, content)
            else:
                self.system.put_file(str(content), where)

        patiently(to_disk if self.local else to_store, self._named(name))

    def _at(self, name: str) -> str:
        return posixpath.join(self.path, name)

    def _named(self, name: str) -> str:
        return f"{self.place}/{name}"
