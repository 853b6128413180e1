"""The package's exceptions. Public functions let no exception of another library through.

Every message says what was found, what was expected, and where.
"""

from importlib import import_module
from typing import Any

LONGEST = 400  #: most characters of a message; a longer one loses its middle


def printable(text: str, kept: str = "\n") -> str:
    """Returns untrusted text in a form that is safe for terminals, pages and logs.

    kept: characters that stay. Other non-printable ones, such as cursor movements, changes of writing direction and
    lone surrogates, become \\x1b and the like.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in kept else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str, longest: int = LONGEST) -> str:
    """Returns `printable` text on one line of at most `longest` characters."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= longest else f"{line[: longest * 2 // 3]} … {line[-longest // 3 + 3 :]}"


class Pd4Error(Exception):
    """Base of every error this package raises on purpose. Commands print its one line and exit with code 1."""

    def __init__(self, message: str):
        super().__init__(one_line(message))


class DamageWarning(UserWarning):
    """An input file is damaged and was read in part."""


class DataError(Pd4Error):
    """A dataset, image, camera, checkpoint or output path is missing, invalid or not supported."""


class TrainError(Pd4Error):
    """Training cannot start or go on."""


class RenderError(Pd4Error):
    """The rasteriser was given input it must refuse, or an option it does not support."""


class NotFinite(RenderError):
    """Colours or the background hold NaN or infinity. In training this means that a step diverged."""


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
        places = {"chunk": self.chunk, "offset": self.offset}
        where = [f"{name} {number}" for name, number in places.items() if number is not None]
        return self.message + (f" ({', '.join(where)})" if where else "")


class Truncated(DecodeError):
    """The bytes end too early. A stream waits for more; with `allow_partial` the longest valid prefix is returned.

    needs: bytes from the start of the file that the failed read requires, 0 if unknown.
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


class BaseMissing(DecodeError):
    """The file holds only what it adds to its base, the layer 0 of another file, and no base was given."""


class BaseMismatch(DecodeError):
    """The base that was given is not the one that the file names."""


class LimitExceeded(DecodeError):
    """A declared count or size is over the format's limits; nothing was allocated for it."""


def required(name: str, extra: str, what: str) -> Any:
    """Returns the module `name` of the extra `extra`. Raises DataError if it is not installed.
    what: who needs it, a plural noun for the message."""
    try:
        return import_module(name)
    except ImportError:
        how = f"pip install 'pd4dgs-codec[{extra}]'"
        raise DataError(f"{what} need the package {name}, which is not installed: {how}") from None
