"""What HTTP says about parts of files (RFC 9110): validators, the Range request, the Content-Range answer."""

from __future__ import annotations

import re
from email.utils import parsedate_to_datetime
from typing import NamedTuple

#: Of digits in a byte position; longer ones belong to no file and int() takes quadratic time.
_DIGITS = r"[0-9]{1,18}"
_RANGE = re.compile(rf"bytes=(?:({_DIGITS})-({_DIGITS})?|-({_DIGITS}))", re.IGNORECASE)
_CONTENT_RANGE = re.compile(rf"bytes (?:({_DIGITS})-({_DIGITS})|\*)/({_DIGITS}|\*)", re.IGNORECASE)


class Unsatisfiable(Exception):
    """The range asked for holds no byte of the file: 416."""


def requested_range(header: str | None, size: int) -> tuple[int, int] | None:
    """(start, end), end exclusive, of one requested range of a file of `size` bytes; None for the whole file.

    Several ranges and anything that is no byte range count as none, as RFC 9110 (14.2) lets a server do.
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last, suffix = (None if text is None else int(text) for text in match.groups())
    if first is None:
        assert suffix is not None
        start, end = max(0, size - suffix), size
    else:
        if last is not None and last < first:
            return None
        start, end = first, size if last is None else min(last + 1, size)
    if start >= end:
        raise Unsatisfiable
    return start, end


class ContentRange(NamedTuple):
    """start, end: of the part sent, end exclusive, None in a 416. total: length of the file, None if not told."""

    start: int | None
    end: int | None
    total: int | None


def content_range(header: str | None) -> ContentRange | None:
    """The parsed header, or None if it is missing or makes no sense."""
    match = _CONTENT_RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last, total = match.groups()
    start, end = (None, None) if first is None else (int(first), int(last) + 1)
    size = None if total == "*" else int(total)
    if start is not None and end is not None and (start >= end or (size is not None and end > size)):
        return None
    return ContentRange(start, end, size)


def strong_etag(header: str | None) -> str | None:
    """The entity tag if it is one that promises equal bytes."""
    return header if header and header.startswith('"') and header.endswith('"') and len(header) > 2 else None


def lists_etag(header: str, etag: str) -> bool:
    """Whether an If-None-Match header names the tag (weak comparison)."""
    tags = re.findall(r'(?:W/)?("[^"]*")', header)
    return header.strip() == "*" or etag in tags


def http_time(header: str | None) -> float | None:
    """Seconds since 1970 of an HTTP date, or None if it is missing or makes no sense."""
    try:
        return parsedate_to_datetime(header).timestamp() if header else None
    except (TypeError, ValueError, OverflowError):
        return None
