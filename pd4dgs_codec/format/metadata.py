"""Metadata of a file (clause 3.5), in an ancillary chunk that decoders may skip.

The content is a canonical msgpack map in one zstd frame that declares its size. Only `write_metadata` and
`read_metadata` import zstandard.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pd4dgs_codec.errors import EncodeError, LimitExceeded, Malformed
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.canonical import Fields, as_integer
from pd4dgs_codec.format.registry import MAX_CHUNKS

CHUNK_TYPE = 3  #: ancillary

# Keys of the map; empty values are absent.
TITLE, SOURCE, LICENCE, COMMAND, QUALITY, STILL, SLICES = range(1, 8)
TEXTS = {"title": TITLE, "source": SOURCE, "licence": LICENCE, "command": COMMAND}

MAX_COMPRESSED = MAX_CONTENT = 1 << 18  #: bytes; a reader allocates no more than MAX_CONTENT
MAX_TEXT = 4096  #: bytes of UTF-8 in one text
MAX_STILL = 1 << 17  #: bytes of the picture's file
MAX_LEVEL = 2
#: First bytes of PNG, JPEG and WebP files.
STILL_SIGNATURES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"RIFF")
COMPRESSION_LEVEL = 19


@dataclass(frozen=True)
class Metadata:
    """title, source (of the scene), licence, command (that made the file): one line of printable text each, "" if not
    given. quality: mPSNR in dB on held-out views by level, binary32 values. still: a small picture of the scene, the
    bytes of a PNG, JPEG or WebP file, b"" for none. slices: mPSNR in dB on held-out views after each slice, in file
    order."""

    title: str = ""
    source: str = ""
    licence: str = ""
    command: str = ""
    quality: Mapping[int, float] = field(default_factory=dict)
    still: bytes = b""
    slices: tuple[float, ...] = ()


def write_metadata(metadata: Metadata) -> bytes:
    """Returns the content of the chunk, with dB rounded to binary32. Raises EncodeError for metadata over a limit."""
    import zstandard

    fields: dict[int, object] = {key: vars(metadata)[name] for name, key in TEXTS.items() if vars(metadata)[name]}
    if metadata.quality:
        fields[QUALITY] = {level: float(np.float32(db)) for level, db in metadata.quality.items()}
    if metadata.still:
        fields[STILL] = metadata.still
    if metadata.slices:
        fields[SLICES] = [float(np.float32(db)) for db in metadata.slices]
    content = canonical.pack(fields)
    try:
        _unpack(content)
    except (Malformed, LimitExceeded) as error:
        raise EncodeError(str(error)) from None
    compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_content_size=True, write_checksum=False)
    data: bytes = compressor.compress(content)
    _check_size("compressed", len(data), MAX_COMPRESSED, EncodeError)
    return data


def read_metadata(data: bytes) -> Metadata:
    """The inverse of write_metadata. Raises LimitExceeded for a size over its limit, before anything is decompressed,
    UnsupportedFeature for an unknown critical key, and Malformed for any other fault."""
    import zstandard

    _check_size("compressed", len(data), MAX_COMPRESSED, LimitExceeded)
    try:
        frame = zstandard.get_frame_parameters(data)
        if frame.content_size == zstandard.CONTENTSIZE_UNKNOWN:
            raise Malformed("metadata: the zstd frame declares no size, expected one")
        _check_size("declared", frame.content_size, MAX_CONTENT, LimitExceeded)
        content = zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise Malformed(f"metadata: not one whole zstd frame: {error}") from None
    return _unpack(content)


def _check_size(what: str, size: int, limit: int, error: type[EncodeError] | type[LimitExceeded]) -> None:
    if size > limit:
        raise error(f"metadata: {size} bytes {what}, expected at most {limit}")


def _unpack(content: bytes) -> Metadata:
    fields = Fields(canonical.unpack(content), "metadata", set(range(TITLE, SLICES + 1)))
    found: dict[str, Any] = {name: _text(fields.get(key), name) for name, key in TEXTS.items() if key in fields}
    for name, key, read in (("quality", QUALITY, _quality), ("still", STILL, _still)):
        found |= {name: read(fields.get(key))} if key in fields else {}
    if SLICES in fields:
        as_integer(len(fields.sequence(SLICES)), MAX_CHUNKS, "metadata: slices", low=1)
        found["slices"] = fields.reals(SLICES, len(fields.sequence(SLICES)))
    return Metadata(**found)


def _text(text: object, name: str) -> str:
    if not isinstance(text, str) or not text or not text.isprintable():
        raise Malformed(f"metadata: {name}, expected one line of printable text")
    as_integer(len(text.encode()), MAX_TEXT, f"metadata: bytes of the {name}")
    return text


def _quality(levels: object) -> dict[int, float]:
    if not isinstance(levels, dict) or not levels or not all(isinstance(db, float) for db in levels.values()):
        raise Malformed("metadata: quality, expected dB as float 32 by level")
    return {as_integer(level, MAX_LEVEL, "metadata: level"): db for level, db in levels.items()}


def _still(still: object) -> bytes:
    if not isinstance(still, bytes) or not still.startswith(STILL_SIGNATURES):
        raise Malformed("metadata: the still picture, expected a PNG, JPEG or WebP file")
    as_integer(len(still), MAX_STILL, "metadata: bytes of the still picture")
    return still
