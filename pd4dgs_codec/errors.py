"""The one exception tree. No library's exception leaves the package's public functions.

Every message says what was found, what was expected, and where.
"""

from importlib import import_module
from typing import Any

LONGEST = 400  #: characters of a message; beyond, its middle is left out


def printable(text: str, kept: str = "\n") -> str:
    """What somebody else may have written, fit for terminals, pages and logs. Characters that are not printable, such
    as those that move the cursor, turn the direction of writing or are halves of pairs, become \\x1b and the like.

    kept: those that stay.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str, longest: int = LONGEST) -> str:
    """`printable` in one line, of at most so many characters."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest * 2 // 3]} … {line[-longest // 3 + 3 :]}"


class Pd4Error(Exception):
    """Base of every error this package raises on purpose: one line, which the commands print, exit 1."""

    def __init__(self, message: str):
        super().__init__(one_line(message))


class DamageWarning(UserWarning):
    """Somebody's file is damaged and could be read in part."""


class DataError(Pd4Error):
    """A dataset, an image, a camera or a checkpoint is missing, broken or not ours."""


class TrainError(Pd4Error):
    """Training cannot start or go on."""


class RenderError(Pd4Error):
    """The rasteriser was given input it must refuse, or an option it does not support."""


class NotFinite(RenderError):
    """Colours or backgrounds to draw hold NaN or infinity: a step that diverged, where other refusals are mistakes."""


class DeliveryError(Pd4Error):
    """A file cannot be fetched over the network, served or packaged."""


class EncodeError(Pd4Error):
    """A scene cannot be written as a `.pd4` file (NaN, infinity, a count over a limit, a failed verification)."""


class DecodeError(Pd4Error):
    """Bytes that are not a valid `.pd4` file.

    offset: byte offset in the file where the fault was found, or None if unknown.
    chunk: index of the chunk in file order, or None outside chunks.
    """

    def __init__(self, message: str, *, offset: int | None = None, chunk: int | None = None):
        super().__init__(message)
        self.message: str = self.args[0]
        self.offset = offset
        self.chunk = chunk

    def __str__(self) -> str:
        where = []
        if self.chunk is not None:
            where.append(f"chunk {self.chunk}")
        if self.offset is not None:
            where.append(f"offset {self.offset}")
        return self.message + (f" ({', '.join(where)})" if where else "")


class Truncated(DecodeError):
    """The bytes end too early. Streaming waits on it; `allow_partial` turns it into the longest valid prefix.

    needs: so many bytes of the file the step takes that found too few, 0 if unknown.
    """

    def __init__(self, message: str, *, offset: int | None = None, chunk: int | None = None, needs: int = 0):
        super().__init__(message, offset=offset, chunk=chunk)
        self.needs = needs


class BadSignature(DecodeError):
    """The first bytes are not those of a `.pd4` file."""


class UnsupportedVersion(DecodeError):
    """The major version is not one this decoder reads."""


class UnsupportedFeature(DecodeError):
    """A critical field or chunk this decoder does not know."""


class ChecksumMismatch(DecodeError):
    """A CRC-32 differs from the one stored."""


class Malformed(DecodeError):
    """A rule of the format is broken."""


class LimitExceeded(DecodeError):
    """A declared count or size is over the format's limits; nothing was allocated for it."""


def required(name: str, extra: str, what: str) -> Any:
    """The module `name` of one of the package's extras, which `what` (a plural) need. Raises DataError if it cannot be
    imported."""
    try:
        return import_module(name)
    except ImportError:
        how = f"pip install 'pd4dgs-codec[{extra}]'"
        raise DataError(f"{what} need the package {name}, which is not installed: {how}") from None
