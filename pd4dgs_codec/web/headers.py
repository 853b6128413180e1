"""HTTP headers of partial and cached content (RFC 9110, RFC 9111)."""

import posixpath
import re

#: Positions of more digits belong to no file, and int() takes quadratic time for them.
_DIGITS = r"[0-9]{1,18}"
_RANGE = re.compile(rf"bytes=(?:({_DIGITS})-({_DIGITS})?|-({_DIGITS}))", re.IGNORECASE)
_CONTENT_RANGE = re.compile(rf"bytes ({_DIGITS})-({_DIGITS})/({_DIGITS}|\*)", re.IGNORECASE)
#: A file whose name carries the digest of its content never changes.
_ADDRESSED = re.compile(r"-[0-9a-f]{16}\.\w+$")
#: Caches keep immutable files for a year, and revalidate all others on every use.
IMMUTABLE, CHANGES = "public, max-age=31536000, immutable", "no-cache"
#: Media type by suffix; packaging/ describes the type of scenes.
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".m3u8": "application/vnd.apple.mpegurl",
    ".mjs": "text/javascript; charset=utf-8",
    ".mp4": "video/mp4",
    ".mpd": "application/dash+xml",
    ".pd4": "model/vnd.pd4dgs",
    ".png": "image/png",
    ".wasm": "application/wasm",
}


def media_type(name: str) -> str:
    """The Content-Type of a file."""
    return MEDIA_TYPES.get(posixpath.splitext(name)[1].lower(), "application/octet-stream")


class Unsatisfiable(Exception):
    """The requested range holds no byte of the file: status 416."""


def requested_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Returns (start, end), end exclusive, that a Range header requests of `size` bytes; None for the whole file.

    A list of ranges and an invalid header are ignored, as RFC 9110 (14.2) permits. Raises Unsatisfiable.
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last, suffix = (None if text is None else int(text) for text in match.groups())
    if first is None:
        assert suffix is not None
        start, end = max(0, size - suffix), size
    elif last is not None and last < first:
        return None
    else:
        start, end = first, size if last is None else min(last + 1, size)
    if start >= end:
        raise Unsatisfiable
    return start, end


def content_range(header: str | None) -> tuple[int, int, int | None] | None:
    """Returns (start, end, file length) of a Content-Range header, end exclusive, length None for `*`; None for no or
    an invalid header."""
    match = _CONTENT_RANGE.fullmatch(header.strip()) if header else None
    if match is None:
        return None
    first, last, size = int(match[1]), int(match[2]), None if match[3] == "*" else int(match[3])
    return (first, last + 1, size) if first <= last and (size is None or last < size) else None


def strong_etag(header: str | None) -> str | None:
    """Returns the entity tag if it is strong, which promises equal bytes, else None."""
    return header if header and header.startswith('"') and header.endswith('"') and len(header) > 2 else None


def lists_etag(header: str, etag: str) -> bool:
    """Whether an If-None-Match header names the tag (weak comparison)."""
    return header.strip() == "*" or etag in re.findall(r'(?:W/)?("[^"]*")', header)


def cache_control(name: str) -> str:
    """The Cache-Control header for a file of this name."""
    return IMMUTABLE if _ADDRESSED.search(name) else CHANGES
