"""Folders of segments: one scene over a long time, cut into files that share what stands still.

The index, `segments.json`, lists the files in the order of time. Each segment may have a base, a file of the folder
whose layer 0 it continues. A reader needs the index, one base and one segment at a time, so its memory and the bytes
of a seek do not grow with the length of the scene.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import DataError

INDEX, VERSION = "segments.json", 1
#: Limits: bytes of an index, its segments and bases, characters of a file's name, bytes of a file.
MOST_BYTES, MOST_SEGMENTS, MOST_BASES, LONGEST, LARGEST = 1 << 25, 1 << 16, 1 << 12, 120, 1 << 40
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class File:
    """A file of the folder. sha256: of all its bytes, hexadecimal."""

    file: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Segment(File):
    """A part of the scene. time_range: seconds. base: its number in the index, None for a whole file."""

    time_range: tuple[float, float]
    base: int | None = None


@dataclass(frozen=True)
class Index:
    """The files of a scene. segments: in the order of time; each begins where the one before ends, or within it, and
    not before the one before that has ended. made: what their maker needs to go on after an interruption."""

    bases: tuple[File, ...]
    segments: tuple[Segment, ...]
    made: dict[str, Any] = field(default_factory=dict)

    @property
    def time_range(self) -> tuple[float, float]:
        """Seconds from the first segment's start to the last one's end."""
        return self.segments[0].time_range[0], self.segments[-1].time_range[1]

    @property
    def files(self) -> tuple[File, ...]:
        """Bases and segments."""
        return (*self.bases, *self.segments)

    def at(self, seconds: float) -> int:
        """Returns the number of the segment that shows this time, of two that do the one of larger weight."""
        return max(self.shown(seconds), key=lambda found: found[1])[0]

    def shown(self, seconds: float) -> list[tuple[int, float]]:
        """Returns the numbers of the segments that show this time, at most two, and their weights, which sum to 1: the
        last one that begins by then, and the one before, unless it has ended. While both last, pictures are blended
        linearly in time."""
        later = max(bisect_right(self.segments, seconds, key=lambda s: s.time_range[0]) - 1, 0)
        start, end = self.segments[later].time_range[0], self.segments[max(later - 1, 0)].time_range[1]
        if not (later and seconds < end):
            return [(later, 1.0)]
        weight = (seconds - start) / (end - start)
        return [(later - 1, 1 - weight), (later, weight)]

    def json(self) -> dict[str, Any]:
        """The content of the index file."""
        content: dict[str, Any] = {"segments_version": VERSION, "bases": [vars(base) for base in self.bases]}
        rows = [vars(segment) | {"time_range": list(segment.time_range)} for segment in self.segments]
        return content | {"segments": rows} | ({"made": self.made} if self.made else {})

    def packed(self) -> bytes:
        """The bytes of the index file, a line for each of its files."""
        text = json.dumps(self.json(), separators=(",", ":"))
        return (re.sub(r'([\[,])(\{"file")', r"\1\n\2", text) + "\n").encode()


def file_of(name: str, data: bytes) -> File:
    """Describes the file `name` of these bytes."""
    return File(name, len(data), hashlib.sha256(data).hexdigest())


def check(file: File, data: bytes, where: str) -> None:
    """Raises DataError unless `data`, read at `where`, is the file that an index describes."""
    if file != replace(file, bytes=len(data), sha256=hashlib.sha256(data).hexdigest()):
        found = "other bytes" if len(data) == file.bytes else f"{len(data):,} bytes"
        raise DataError(f"{where}: has {found}, expected the {file.bytes:,} bytes that {INDEX} names")


def parse(data: bytes, where: str) -> Index:
    """Reads an index, which is not trusted. where: its name for messages. Raises DataError."""
    if len(data) > MOST_BYTES:
        raise DataError(f"{where}: has {len(data):,} bytes, expected at most {MOST_BYTES:,}")
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: cannot be read as JSON: {error}") from None
    version = content.get("segments_version") if isinstance(content, dict) else None
    if version != VERSION or isinstance(version, bool):
        raise DataError(f"{where}: has segments_version {str(version)[:20]}, expected {VERSION}")
    made = content.get("made", {})
    if not isinstance(made, dict):
        raise DataError(f"{where}: made is a {type(made).__name__}, expected an object")
    bases = tuple(File(**_file(row, what)) for row, what in _rows(content, "bases", MOST_BASES, where))
    segments = list[Segment]()
    for row, what in _rows(content, "segments", MOST_SEGMENTS, where):
        base, known = row.get("base"), _file(row, what)
        if base is not None and not (type(base) is int and 0 <= base < len(bases)):
            raise DataError(f"{what}: base {str(base)[:20]}, expected null or 0 to {len(bases) - 1}")
        segments.append(Segment(**known, time_range=_range(row, what), base=base))
        (start, end), before = segments[-1].time_range, segments[-2].time_range if len(segments) > 1 else None
        if before and not (before[0] < start <= before[1] < end):
            raise DataError(f"{what}: time range {start:g} to {end:g} s after {before[0]:g} to {before[1]:g} s, "
                            "expected one that begins by its end and ends later")  # fmt: skip
        if len(segments) > 2 and start < (ended := segments[-3].time_range[1]):
            raise DataError(f"{what}: begins at {start:g} s, expected {ended:g} s or later, where the second before it "
                            "ends")  # fmt: skip
    names = [file.file for file in (*bases, *segments)]
    if len(set(names)) < len(names):
        raise DataError(f"{where}: names a file twice, expected different ones")
    return Index(bases, tuple(segments), made)


def _rows(content: dict[str, Any], key: str, most: int, where: str) -> Iterable[tuple[dict[str, Any], str]]:
    """Yields the objects of a list with their names for messages."""
    rows = content.get(key)
    if not isinstance(rows, list) or len(rows) > most:
        found = f"{len(rows):,} of them" if isinstance(rows, list) else type(rows).__name__
        raise DataError(f"{where}: {key}: found {found}, expected a list of at most {most:,}")
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            raise DataError(f"{where}: {key} {i}: found {type(row).__name__}, expected an object")
        yield row, f"{where}: {key} {i}"


def _file(row: dict[str, Any], what: str) -> dict[str, Any]:
    name, size, digest = (row.get(key) for key in ("file", "bytes", "sha256"))
    if not (isinstance(name, str) and len(name) <= LONGEST and NAME.fullmatch(name)):
        raise DataError(f"{what}: file {str(name)[:60]!r}, expected a name of letters, digits and ._-")
    if not (type(size) is int and 0 < size <= LARGEST):
        raise DataError(f"{what}: bytes {str(size)[:20]}, expected 1 to {LARGEST:,}")
    if not (isinstance(digest, str) and DIGEST.fullmatch(digest)):
        raise DataError(f"{what}: sha256 {str(digest)[:70]!r}, expected 64 hexadecimal digits")
    return {"file": name, "bytes": size, "sha256": digest}


def _range(row: dict[str, Any], what: str) -> tuple[float, float]:
    found = row.get("time_range")
    numbers = [v for v in found if type(v) in (int, float) and abs(v) < 1e9] if isinstance(found, list) else []
    if not (isinstance(found, list) and len(found) == len(numbers) == 2 and numbers[0] < numbers[1]):
        raise DataError(f"{what}: time_range {str(found)[:60]}, expected two numbers of seconds that ascend")
    return float(numbers[0]), float(numbers[1])


def is_folder(path: str | Path) -> bool:
    """Whether a path is a folder of segments, or its index."""
    return os.path.isfile(os.path.join(path, INDEX)) or os.path.basename(path) == INDEX and os.path.isfile(path)


def read_index(path: str | Path) -> tuple[Path, Index]:
    """Reads (folder, index) of a folder of segments, or of its index. Raises DataError, also for an empty index."""
    from pd4dgs_codec.io import read_source

    place = Path(path) if Path(path).name == INDEX else Path(path) / INDEX
    index = parse(read_source(place), str(place))
    if not index.segments:
        raise DataError(f"{place}: lists no segments, expected one at least")
    return place.parent, index


def read_file(folder: Path, file: File) -> bytes:
    """Reads a file of a folder. Raises DataError if it is missing, or is another one."""
    from pd4dgs_codec.io import read_source

    data = read_source(folder / file.file)
    check(file, data, str(folder / file.file))
    return data


def base_beside(path: str | Path) -> bytes | None:
    """Returns the base of a file, as the index of its folder has it; None without one. Raises DataError."""
    place = Path(path)
    if not is_folder(place.parent):
        return None
    folder, index = read_index(place.parent)
    bases = [segment.base for segment in index.segments if segment.file == place.name and segment.base is not None]
    return read_file(folder, index.bases[bases[0]]) if bases else None
