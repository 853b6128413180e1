"""Reads sources and writes outputs at paths and at URIs that fsspec knows (s3, gs, https, memory, ...).

An output has files and a record, `OUTPUT.done.json`, which is written last and marks the output as finished.
Each file appears whole or not at all: on a disk by a rename, in object stores by their own design.
"""

import errno
import hashlib
import json
import os
import posixpath
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from pd4dgs_codec.data.dataset import READERS
from pd4dgs_codec.errors import DataError, one_line, required
from pd4dgs_codec.io import URI, check_source, is_device, write_bytes
from pd4dgs_codec.web.headers import media_type

RECORD = ".done.json"
PROBE = ".pd4dgs-batch"
#: Fields of a file's entry in a store that change with the file; the first one present is used.
STAMPS = ("ETag", "etag", "md5Hash", "generation", "LastModified", "Last-Modified", "mtime")
#: Keyword by which the file systems of stores take the media type of a file.
TYPED = {"s3": "ContentType", "gs": "content_type"}
#: Matches all but the empty string and local URIs with a relative path, whose host fsspec would read as a folder.
_ABSOLUTE = re.compile(r"(?!(?:file|local):(?://)?(?!/)).", re.DOTALL)
#: Errors that a retry would meet again.
FINAL = (FileNotFoundError, FileExistsError, PermissionError, IsADirectoryError, NotADirectoryError)


def absolute(place: str) -> str:
    """Makes a path absolute, for workers in other folders. URIs stay, and their store is not contacted. Raises
    DataError for an unknown scheme."""
    required("fsspec", "cluster", "batches")
    from fsspec import available_protocols
    from fsspec.core import split_protocol

    if place.startswith("/") or os.path.lexists(place):  # also a name with colons
        return os.path.abspath(place)
    first, chained, _ = place.partition("::")
    scheme = split_protocol(first)[0] or (first if chained else "file")
    if scheme in ("file", "local"):
        return _system(place)[1]
    if scheme not in available_protocols():
        raise DataError(f"{place}: found the scheme {scheme}, expected one that fsspec supports")
    return place


def _system(place: str) -> tuple[Any, str, bool]:
    """Returns (file system, path in it, whether it is this machine's)."""
    required("fsspec", "cluster", "batches")
    from fsspec.core import url_to_fs
    from fsspec.implementations.local import LocalFileSystem

    try:
        if not _ABSOLUTE.match(place) or (URI.match(place) and not re.match("(?:file|local):|.*://", place)):
            raise ValueError("expected a path, or a URI like file:///FOLDER or s3://BUCKET/FOLDER")
        if place.startswith("/"):  # url_to_fs would split a name with colons
            return LocalFileSystem(), LocalFileSystem._strip_protocol(place), True
        system, path = url_to_fs(place)
    except Exception as error:  # each store has its own
        raise DataError(f"{place}: {one_line(str(error))}") from None
    return system, str(path), isinstance(system, LocalFileSystem)


@contextmanager
def _naming(place: str) -> Iterator[None]:
    """Turns the exceptions of a store into OSErrors that name the place."""
    try:
        yield
    except FINAL as error:
        raise type(error)(error.errno, error.strerror or one_line(str(error)), place) from None
    except Exception as error:  # each store has its own
        raise OSError(errno.EIO, f"{type(error).__name__}: {one_line(str(error))}", place) from None


@contextmanager
def opened(place: str) -> Iterator[IO[bytes]]:
    """Opens a file to read. Raises OSError, and DataError for a device."""
    system, path, local = _system(place)
    if local and Path(path).exists():
        check_source(path)
    with _naming(place):
        stream = system.open(path, "rb")
    with stream:
        yield stream


def names(folder: str) -> list[str]:
    """Lists the relative paths of all files below a folder without a part that begins with a dot. Raises OSError."""
    system, path, _ = _system(folder)
    with _naming(folder):
        found = system.find(path)
    if not found:
        raise FileNotFoundError(errno.ENOENT, "found no files, expected a folder with sources", folder)
    below = [posixpath.relpath(name, path) for name in found]
    return sorted(name for name in below if not any(part.startswith(".") for part in name.split("/")))


def stamp(place: str, *, dataset: bool = False) -> str:
    """Returns a text that changes with a file, or any file of a folder, without reading them: of a dataset's folder in
    all its folders, of another one in itself. Raises OSError, and DataError for a pipe or a device, and for a folder on
    this machine that is no dataset, before it looks at all its files."""
    system, path, local = _system(place)
    if local and is_device(Path(path)):
        raise DataError(f"{place}: is a pipe or a device, expected a file or a folder")
    if dataset and local and Path(path).is_dir() and not any(each.recognises(Path(path)) for each in READERS):
        raise DataError(f"{place}: found a folder that holds no dataset, expected one that pd4dgs-train reads")
    with _naming(place):
        entry = system.info(path)
        found = {"": entry} if entry["type"] == "file" else system.find(path, None if dataset else 1, detail=True)
    rows = []
    for name, entry in sorted(found.items()):
        known = next((f"{key} {entry[key]}" for key in STAMPS if entry.get(key)), "")
        rows.append(f"{name.removeprefix(path)} {entry.get('size')} bytes {known}".strip())
    return rows[0] if "" in found else hashlib.sha256(os.fsencode("\n".join(rows))).hexdigest()


def fetch(place: str, folder: Path) -> Path:
    """Returns the path of a source on this machine, or else of a copy that it makes in `folder`. Raises OSError."""
    system, path, local = _system(place)
    if local:
        if not Path(path).exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), place)
        return Path(path)
    target = folder / posixpath.basename(path.rstrip("/"))
    with _naming(place):
        if system.info(path)["type"] == "file":  # get() would ask again for its type
            system.get_file(path, str(target))
        else:
            system.get(path, str(target), recursive=True)
    return target


class Root:
    """The place below which a batch writes."""

    def __init__(self, place: str):
        self.place = place.rstrip("/")
        self.system, self.path, self.local = _system(place)
        schemes = self.system.protocol
        self.schemes = (schemes,) if isinstance(schemes, str) else schemes

    def check(self) -> None:
        """Raises DataError, before any work, if nothing can be written to the place."""
        try:
            self._put(PROBE, b"")
        except OSError as error:
            raise DataError(f"{self.place}: cannot write: {error.strerror}") from None
        with suppress(Exception):  # a store that forbids deletion keeps an empty object
            self.system.rm_file(self._at(PROBE))

    def record(self, output: str, overwrite: bool) -> dict[str, Any] | None:
        """Reads the record of a finished output, else None. Raises DataError for any other file unless `overwrite`."""
        raw = self._ask("cat_file", output + RECORD)
        if raw is None:
            return None
        try:
            content = json.loads(raw)
        except ValueError:
            content = None
        files = content.get("files") if isinstance(content, dict) else None
        if isinstance(files, dict) and all(isinstance(f, dict) and type(f.get("bytes")) is int for f in files.values()):
            return dict(content)
        if overwrite:
            return None
        raise DataError(f"{self.place}/{output}{RECORD}: is not a batch record; --overwrite replaces it")

    def holds(self, output: str, record: dict[str, Any]) -> bool:
        """Whether all files of a record exist with their recorded sizes."""
        found = {name: self._ask("info", _file(output, name)) for name in record["files"]}
        return all(found[name] and found[name]["size"] == file["bytes"] for name, file in record["files"].items())

    def publish(self, output: str, files: dict[str, Path], record: dict[str, Any], replace: bool) -> int:
        """Writes the files of an output (name -> local path; "" is the output itself), then its record with their
        sizes, digests and media types. Returns the bytes of the files.

        replace: whether to replace files with other content; if False, such a file raises DataError. Raises OSError if
        the store fails.
        """
        entries: dict[str, dict[str, Any]] = {}
        for name, path in files.items():
            place = _file(output, name)
            content = path.read_bytes()
            # a killed run may have left this very file, without its record
            if not replace and self._ask("cat_file", place) not in (None, content):
                raise DataError(f"{self.place}/{place}: exists already without a record; --overwrite replaces it")
            self._put(place, content)
            digest = hashlib.sha256(content).hexdigest()
            entries[name] = {"bytes": len(content), "sha256": digest, "type": media_type(place)}
        self._put(output + RECORD, (json.dumps(record | {"files": entries}, indent=1, sort_keys=True) + "\n").encode())
        return sum(entry["bytes"] for entry in entries.values())

    def _ask(self, question: str, name: str) -> Any:
        """Calls a method of the file system on a file. Returns None if the file does not exist."""
        with suppress(FileNotFoundError), _naming(f"{self.place}/{name}"):
            return getattr(self.system, question)(self._at(name))
        return None

    def _put(self, name: str, content: bytes) -> None:
        where = self._at(name)
        with _naming(f"{self.place}/{name}"):
            if self.local:
                Path(where).parent.mkdir(parents=True, exist_ok=True)
                write_bytes(where, content, overwrite=True)
            else:
                typed = [named for scheme, named in TYPED.items() if scheme in self.schemes]
                self.system.pipe_file(where, content, **dict.fromkeys(typed, media_type(name)))

    def _at(self, name: str) -> str:
        return posixpath.join(self.path, name)


def _file(output: str, name: str) -> str:
    return f"{output}/{name}" if name else output
