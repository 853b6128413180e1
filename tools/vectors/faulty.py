"""Vectors that break one rule each."""

from __future__ import annotations

import hashlib
import itertools
import math
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pd4dgs_codec.attributes.quantise import MAX_SYMBOL
from pd4dgs_codec.bitstream import canonical
from pd4dgs_codec.bitstream.limits import (
    MAX_ANCHORS,
    MAX_CHUNKS,
    MAX_HEADER,
    MAX_NETWORK_LAYERS,
    MAX_NETWORK_WIDTH,
    MAX_PARAMETERS,
    MAX_PAYLOAD,
    MAX_PLANE_CHANNELS,
    MAX_PLANE_SCALES,
    MAX_PLANE_SIDE,
    MAX_VOXEL,
)
from pd4dgs_codec.entropy.ans import MAX_COUNT, ans_encode
from pd4dgs_codec.entropy.positions import encode_positions
from pd4dgs_codec.entropy.priors import (
    FIRST_REUSE,
    K_MAX,
    MAX_SHIFT,
    MAX_WINDOW,
    MU8_MAX,
    SCALED,
    Hist,
    Prior,
    Window,
    top_limit,
    write_prior,
)
from pd4dgs_codec.entropy.tables import TOTAL
from pd4dgs_codec.entropy.varint import VARINT_MAX

from . import lzma2
from .blocks import (
    ANS,
    ATTRIBUTE,
    CAMERA,
    ERROR_BOUNDS,
    FLOAT32,
    FLOATS,
    HEADER,
    LZMA,
    MASKS,
    ONE_CLASS,
    PLANE,
    POSITIONS,
    SMALL,
    SYMBOLS,
    WEIGHTS,
    File,
    Layer,
    Scale,
    Vector,
    ancillary,
    attribute_stages,
    bad,
    coded,
    constant_networks,
    gauss,
    lzma_floats,
    lzma_symbols,
    make_file,
    make_layer,
    pattern,
    plain_attributes,
    plain_planes,
    predicted_attributes,
    prediction_block,
    staged,
    staged_planes,
    varint,
    words,
    zigzag,
)
from .valid import LARGEST, LEAST_NORMAL, line, ordered, rows_at_limit, symbols_at_limit, tables_at_limit, three_layers

MALFORMED, LIMIT, FEATURE = "Malformed", "LimitExceeded", "UnsupportedFeature"
SIGNATURE, VERSION, HEADER_LENGTH, HEADER_CRC, HEADER_START = 0, 8, 12, 16, 20  # offsets in the preamble
TYPE, FLAGS, LENGTH, SCENE_ID, PAYLOAD = 0, 2, 4, 8, 16  # offsets in a chunk
SUBNORMAL = 2.0**-127


def cases() -> Iterator[Vector]:
    """All vectors under faulty/."""
    parts = (
        _preamble,
        _chunks,
        _cuts,
        _msgpack,
        _header,
        _chunk_list,
        _camera,
        _error_bounds,
        _layout,
        _parameters,
        _scales,
        _networks,
    )
    for part in (*parts, _sections, _sizes, _varints, _priors, _histograms, _streams, _exceptions, _prediction):
        yield from part()
    for part in (_staged_planes, _lzma, _floats, _positions, _ranges):
        yield from part()


def _plain() -> File:
    return make_file(make_layer())


# -- clause 3 ----------------------------------------------------------------------------------------------------------


def _preamble() -> Iterator[Vector]:
    plain = _plain()
    text_mode = bytes.fromhex("895044340A1A0A") + b"\0"
    for name, signature, what in (
        ("first-byte", b"\x88PD4\r\n\x1a\n", "The first byte is wrong."),
        ("last-byte", b"\x89PD4\r\n\x1a\r", "The last byte is wrong."),
        ("text-mode", text_mode, "Line ends were converted."),
        ("png", b"\x89PNG\r\n\x1a\n", "A PNG."),
        ("zeros", bytes(8), "Zeros."),
    ):
        yield bad(f"signature-{name}", what, "3.1", "BadSignature", replace(plain, signature=signature), at=SIGNATURE)
    for major in (0, 2, 65535):
        what = f"Major version {major}."
        yield bad(f"version-major-{major}", what, "3.1", "UnsupportedVersion", replace(plain, major=major), at=VERSION)
    for name, size in (("over-limit", MAX_HEADER + 1), ("largest", 2**32 - 1)):
        what = f"The header's length says {size}."
        yield bad(f"header-length-{name}", what, "3.1 14", LIMIT, replace(plain, declared=size), at=HEADER_LENGTH)
    filled = plain.with_header({64: b"\0" * (MAX_HEADER - 200)})
    over = plain.with_header({64: b"\0" * (MAX_HEADER - 199 + MAX_HEADER - len(filled.header_bytes()))})
    yield bad("header-4097-bytes", "A header of 4097 bytes.", "3.1 14", LIMIT, over, at=HEADER_LENGTH)
    short = replace(plain, declared=len(plain.header_bytes()) - 1)
    yield bad(
        "header-length-short", "The header's length is a byte short.", "3.1", "ChecksumMismatch", short, at=HEADER_CRC
    )
    beyond = replace(plain, declared=MAX_HEADER)
    size = len(plain.data())
    yield bad(
        "header-length-beyond-file",
        "The file ends inside the header declared.",
        "3.1 15",
        "Truncated",
        beyond,
        size=size,
    )
    for bit in (0, 31):
        what = f"Bit {bit} of the header's CRC-32 is flipped."
        yield bad(f"crc-header-bit-{bit}", what, "3.1", "ChecksumMismatch", replace(plain, crc=1 << bit), at=HEADER_CRC)


def _chunks() -> Iterator[Vector]:
    file = three_layers()
    for c in (0, 1, 2):
        crc_at = PAYLOAD + len(file.chunks[c].payload)
        what = f"A bit of the CRC-32 of layer {c} is flipped."
        yield bad(f"crc-layer-{c}", what, "3.2", "ChecksumMismatch", file.with_chunk(c, crc=1 << 9), chunk=c, at=crc_at)
    payload = bytearray(file.chunks[1].payload)
    payload[len(payload) // 2] ^= 0x10
    layer = file.chunks[1].layer
    right, wrong = file.chunks[1].frame(bytes(8)), replace(file.chunks[1], payload=bytes(payload)).frame(bytes(8))
    crc = struct.unpack("<I", right[-4:])[0] ^ struct.unpack("<I", wrong[-4:])[0]
    flipped = file.with_chunk(1, payload=bytes(payload), layer=layer, crc=crc)
    at = PAYLOAD + len(payload)
    yield bad("payload-bit-flip", "A bit of a payload is flipped.", "3.2", "ChecksumMismatch", flipped, chunk=1, at=at)
    size = len(file.chunks[1].payload)
    for name, length, error in (
        ("over-limit", MAX_PAYLOAD + 1, LIMIT),
        ("largest", 2**32 - 1, LIMIT),
        ("above-list", size + 1, MALFORMED),
        ("below-list", size - 1, MALFORMED),
    ):
        what = f"The length in a chunk's frame is {length}, in the list {size}."
        yield bad(f"chunk-length-{name}", what, "3.2", error, file.with_chunk(1, length=length), chunk=1, at=LENGTH)
    for bit in (1, 15):
        what = f"Reserved flag bit {bit}."
        yield bad(
            f"chunk-flag-{bit}", what, "2.3 3.2", MALFORMED, file.with_chunk(1, flags=1 << bit), chunk=1, at=FLAGS
        )
    other = file.with_chunk(1, listed=(2, size), type=1)
    other = replace(other, chunks=other.chunks[:2])
    yield bad(
        "chunk-type-not-listed", "The frame says layer 1, the list layer 2.", "3.2", MALFORMED, other, chunk=1, at=TYPE
    )

    alien = replace(file, chunks=(file.chunks[0],)).with_chunk(0, scene_id=b"12345678")
    yield bad("scene-id-layer-0", "The scene id is another one.", "3.3", MALFORMED, alien, chunk=0, at=SCENE_ID)
    same = file
    for c in range(3):
        same = same.with_chunk(c, scene_id=b"12345678")
    yield bad("scene-id-all", "All chunks agree on a wrong scene id.", "3.3", MALFORMED, same, chunk=0, at=SCENE_ID)
    own_payload = hashlib.sha256(file.chunks[0].payload).digest()[:8]
    alone = replace(file, chunks=tuple(replace(c, scene_id=own_payload) for c in file.chunks))
    what = "A scene id of the payload of layer 0 without the header."
    yield bad("scene-id-without-header", what, "3.3", MALFORMED, alone, chunk=0, at=SCENE_ID)
    for name, fields, what in (
        ("steps", {4: [0.5, 0.5, 0.5]}, "The header of another scene, with other steps."),
        ("ignored-key", {64: 1}, "A key that is ignored was put into the header."),
        ("camera", {12: CAMERA}, "A default camera was put into the header."),
        ("error-bounds", {13: dict.fromkeys(range(8), 0.0)}, "The header of another scene, with other error bounds."),
    ):
        other = file.with_header(fields)
        spliced = replace(other, chunks=tuple(replace(c, scene_id=file.scene_id) for c in file.chunks))
        yield bad(f"splice-header-{name}", what, "3.3", MALFORMED, spliced, chunk=0, at=SCENE_ID)
    donor = make_file(make_layer()).scene_id
    spliced = file.with_chunk(2, scene_id=donor)
    yield bad("splice-layer-2", "Layer 2 is from another scene.", "3.3", MALFORMED, spliced, chunk=2, at=SCENE_ID)
    extra = replace(file, chunks=(file.chunks[0], ancillary(9, b"x", scene_id=donor), *file.chunks[1:]))
    yield bad(
        "splice-ancillary", "An ancillary chunk is from another scene.", "3.3", MALFORMED, extra, chunk=1, at=SCENE_ID
    )

    flagged = file.with_chunk(1, flags=1)
    yield bad("layer-flagged-ancillary", "A layer is flagged ancillary.", "3.4", MALFORMED, flagged, chunk=1)
    yield bad(
        "layer-0-flagged-ancillary",
        "Layer 0 is flagged ancillary.",
        "3.4",
        MALFORMED,
        file.with_chunk(0, flags=1),
        chunk=0,
    )
    for name, c in (("between-layers", 2), ("last", 3)):
        chunks = list(file.chunks)
        chunks.insert(c, replace(ancillary(3 * (c - 1), b"needed"), flags=0))
        what = f"A critical chunk of unknown type is chunk {c}."
        yield bad(
            f"critical-unknown-{name}", what, "3.4", FEATURE, replace(file, chunks=tuple(chunks)), chunk=c, at=TYPE
        )
    broken = replace(file, chunks=(*file.chunks[:2], ancillary(9, b"x", crc=1), file.chunks[2]))
    yield bad(
        "crc-ancillary", "The CRC-32 of an ancillary chunk.", "3.4", "ChecksumMismatch", broken, chunk=2, at=PAYLOAD + 1
    )
    reserved = replace(file, chunks=(*file.chunks, replace(ancillary(9), flags=3)))
    yield bad(
        "ancillary-flag-1", "A reserved flag of an ancillary chunk.", "3.4", MALFORMED, reserved, chunk=3, at=FLAGS
    )

    end = file.start(3)
    for name, tail in (("byte", b"\0"), ("chunk", ancillary(9).frame(bytes(8)))):
        what = f"A {name} follows the last chunk."
        yield bad(f"trailing-{name}", what, "3.2", MALFORMED, replace(file, tail=tail), at=end, whole=True)


def _cuts() -> Iterator[Vector]:
    """12.3: the file ends at each structure's border and inside each structure."""
    file = three_layers()
    header = HEADER_START + len(file.header_bytes())
    for size in (0, 5, 8, 12, 16, 19, 20, header - 1):
        what = f"The file ends after {size} bytes, before the end of the header."
        yield bad(f"cut-at-{size:03}", what, "12.3 15", "Truncated", file, size=size)
    for c in range(3):
        start, size = file.start(c), len(file.chunks[c].payload)
        for name, cut in (
            ("start", 0),
            ("type", 1),
            ("length", 6),
            ("scene-id", 15),
            ("payload", PAYLOAD),
            ("payload-middle", PAYLOAD + size // 2),
            ("crc", PAYLOAD + size),
            ("last-byte", PAYLOAD + size + 3),
        ):
            what = f"The file ends in the chunk of layer {c}, at its {name.replace('-', ' ')}."
            yield bad(f"cut-layer-{c}-{name}", what, "12.3 15", "Truncated", file, chunk=c, size=start + cut)
    missing = replace(file, chunks=(*file.chunks, ancillary(9)))
    yield bad(
        "cut-ancillary",
        "An ancillary chunk of the list is not there.",
        "12.3",
        "Truncated",
        missing,
        chunk=3,
        size=file.start(3) + 3,
    )


# -- clause 4 ----------------------------------------------------------------------------------------------------------

NOT_CANONICAL = {
    "uint8": ("cc7f", "127 as uint 8."),
    "uint16": ("cd00ff", "255 as uint 16."),
    "uint32": ("ce0000ffff", "65535 as uint 32."),
    "uint64": ("cf00000000ffffffff", "2^32 − 1 as uint 64."),
    "int8": ("d0e0", "−32 as int 8."),
    "int16": ("d1ff80", "−128 as int 16."),
    "int32": ("d2ffff8000", "−32768 as int 32."),
    "int64": ("d3ffffffff80000000", "−2^31 as int 64."),
    "int8-positive": ("d001", "1 as int 8."),
    "int64-positive": ("d30000000100000000", "2^32 as int 64."),
    "nil": ("c0", "nil."),
    "never-used": ("c1", "The byte that msgpack never uses."),
    "float64": ("cb3fe0000000000000", "0.5 as float 64."),
    "infinity": ("ca7f800000", "Infinity."),
    "negative-infinity": ("caff800000", "Negative infinity."),
    "nan": ("ca7fc00000", "NaN."),
    "fixext": ("d40000", "An ext of one byte."),
    "ext8": ("c7000a", "An empty ext."),
    "timestamp": ("d6ff00000000", "A timestamp."),
    "str8": ("d90178", "A string of one byte as str 8."),
    "str16": ("da00017a", "A string of one byte as str 16."),
    "str32": ("db0000000178", "A string of one byte as str 32."),
    "str-utf8": ("a1ff", "A string that is not UTF-8."),
    "str-surrogate": ("a3eda080", "A string with a surrogate."),
    "str-overlong": ("a2c080", "A string with an overlong form."),
    "bin16": ("c5000178", "One byte as bin 16."),
    "bin32": ("c60000000178", "One byte as bin 32."),
    "array16": ("dc000101", "A list of one as array 16."),
    "array32": ("dd0000000101", "A list of one as array 32."),
    "map16": ("de00010001", "A map of one as map 16."),
    "map32": ("df000000010001", "A map of one as map 32."),
    "keys-descend": ("8201010001", "Keys 1, 0."),
    "keys-twice": ("8201010102", "A key twice."),
    "key-text": ("81a17801", "A string as a key."),
    "key-boolean": ("81c301", "A boolean as a key."),
    "key-negative": ("81ff01", "A negative key."),
    "key-real": ("81ca0000000001", "A real as a key."),
    "key-bytes": ("81c4017801", "Bytes as a key."),
    "key-over-limit": ("81cf000000010000000001", "Key 2^32."),
    "key-not-shortest": ("81cc0101", "Key 1 as uint 8."),
    "nesting": ("91919190", "Five levels of lists and maps."),
    "nesting-map": ("810081008100810081" + "0000", "More levels of maps."),
    "list-longer-than-data": ("93", "A list of three without items."),
    "list-of-4-billion": ("ddffffffff", "A list that declares 2^32 − 1 items."),
    "map-of-4-billion": ("dfffffffff", "A map that declares 2^32 − 1 entries."),
    "str-of-4-billion": ("dbffffffff", "A string that declares 2^32 − 1 bytes."),
    "bin-of-4-billion": ("c6ffffffff", "Bytes that declare a length of 2^32 − 1."),
    "nesting-deep": ("91" * 3000 + "90", "Three thousand lists in one another."),
    "nothing": ("", "A key without a value."),
}


def _with_entry(packed: bytes, key: str, value: str) -> bytes:
    """A packed map of at most 14 entries with one more behind them."""
    return bytes([packed[0] + 1]) + packed[1:] + bytes.fromhex(key + value)


def _msgpack() -> Iterator[Vector]:
    plain = _plain()
    packed = plain.header_bytes()
    for name, (value, what) in NOT_CANONICAL.items():
        header = _with_entry(packed, "40", value)
        yield bad(f"msgpack-{name}", f"In an ignored key: {what}", "4", MALFORMED, replace(plain, packed=header))
    entries = {
        "key-twice": (_with_entry(packed, "0d", canonical.pack(HEADER[13]).hex()), "A key of the header twice."),
        "keys-descend": (_with_entry(_with_entry(packed, "41", "00"), "40", "00"), "Keys of the header out of order."),
        "key-not-shortest": (_with_entry(packed, "cc40", "00"), "A key of the header as uint 8."),
        "map16": (b"\xde\0" + bytes([packed[0] & 15]) + packed[1:], "The header as map 16."),
        "map32": (b"\xdf\0\0\0" + bytes([packed[0] & 15]) + packed[1:], "The header as map 32."),
        "list": (canonical.pack(list(HEADER.values())), "The header is a list."),
        "integer": (b"\0", "The header is an integer."),
        "empty": (b"", "The header is empty."),
        "empty-map": (b"\x80", "The header is a map of nothing."),
        "trailing-byte": (packed + b"\0", "A byte follows the header's map."),
        "cut": (packed[:-1], "The header's map lacks its last byte."),
        "entry-missing": (bytes([packed[0] + 1]) + packed[1:], "The header's map lacks its last entry."),
        "entry-uncounted": (bytes([packed[0] - 1]) + packed[1:], "The header's map has an entry more than it says."),
    }
    unit = canonical.pack(11) + canonical.pack(HEADER[11])
    for name, value, what in (
        ("unit-nan", "ca7fc00000", "The unit is NaN."),
        ("unit-infinity", "ca7f800000", "The unit is infinite."),
        ("unit-float64", "cb3ff8000000000000", "The unit is a float 64."),
        ("unit-nil", "c0", "The unit is nil."),
    ):
        entries[name] = (packed.replace(unit, canonical.pack(11) + bytes.fromhex(value)), what)
    for name, (header, what) in entries.items():
        yield bad(f"header-{name}", what, "4 5.1", MALFORMED, replace(plain, packed=header))
    layer = make_layer()
    for name in ("uint8", "nil", "float64", "keys-twice", "key-text", "nesting"):
        value, what = NOT_CANONICAL[name]
        payload = layer.payload(pack=lambda m, value=value: _with_entry(canonical.pack(m), "40", value))
        what = f"In an ignored key of the layer parameters: {what}"
        yield bad(f"layer-msgpack-{name}", what, "4 6.2", MALFORMED, plain.with_payload(0, payload), chunk=0)
    for name, change, what in (
        ("key-twice", lambda p: _with_entry(p, "05", p[p.index(b"\x05\x93") + 1 :].hex()), "A key twice."),
        ("trailing-byte", lambda p: p + b"\0", "A byte follows the map."),
        ("cut", lambda p: p[:-1], "The last byte is not there."),
        ("map16", lambda p: b"\xde\0" + bytes([p[0] & 15]) + p[1:], "The map as map 16."),
        ("list", lambda p: b"\x90", "A list instead of a map."),
    ):
        payload = layer.payload(pack=lambda m, change=change: change(canonical.pack(m)))
        what = f"Layer parameters: {what}"
        yield bad(f"layer-{name}", what, "4 6.2", MALFORMED, plain.with_payload(0, payload), chunk=0)


# -- clause 5 ----------------------------------------------------------------------------------------------------------


def _header() -> Iterator[Vector]:
    plain = _plain()
    for key in (*range(2, 12), 13):
        what = f"Key {key} is missing."
        yield bad(f"header-key-{key:02}-missing", what, "4 5.1", MALFORMED, plain.with_header({key: None}))
    without = canonical.pack({k: v for k, v in plain.fields().items() if k != 1})
    yield bad("header-key-01-missing", "Key 1 is missing.", "4 5.1", MALFORMED, replace(plain, packed=without))
    for key in (0, 14, 63):
        what = f"Unknown key {key}."
        yield bad(f"header-key-{key:02}-unknown", what, "4 17.2", FEATURE, plain.with_header({key: 1}))
    values: list[tuple[str, int, object, str]] = [
        ("mode-unknown", 2, 2, FEATURE),
        ("mode-largest", 2, 2**64 - 1, FEATURE),
        ("mode-real", 2, 0.0, MALFORMED),
        ("mode-boolean", 2, False, MALFORMED),
        ("mode-negative", 2, -1, FEATURE),
        ("mode-list", 2, [0], MALFORMED),
        ("deformation-unknown", 3, 2, FEATURE),
        ("deformation-text", 3, "coded", MALFORMED),
        ("deformation-negative", 3, -5, FEATURE),
        ("steps-two", 4, [1.0] * 2, MALFORMED),
        ("steps-four", 4, [1.0] * 4, MALFORMED),
        ("steps-integer", 4, [1, 1.0, 1.0], MALFORMED),
        ("steps-boolean", 4, [1.0, True, 1.0], MALFORMED),
        ("steps-real", 4, 1.0, MALFORMED),
        ("step-zero", 4, [1.0, 0.0, 1.0], MALFORMED),
        ("step-negative", 4, [-1.0, 1.0, 1.0], MALFORMED),
        ("step-subnormal", 4, [1.0, 1.0, SUBNORMAL], MALFORMED),
        ("voxel-size-zero", 5, 0.0, MALFORMED),
        ("voxel-size-negative", 5, -LEAST_NORMAL, MALFORMED),
        ("voxel-size-subnormal", 5, LEAST_NORMAL - 2.0**-149, MALFORMED),
        ("voxel-size-integer", 5, 1, MALFORMED),
        ("voxel-size-list", 5, [1.0], MALFORMED),
        ("box-five", 6, [0.0] * 5, MALFORMED),
        ("box-seven", 6, [0.0] * 7, MALFORMED),
        ("box-upside-down", 6, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], MALFORMED),
        ("time-descends", 7, [1.0, 0.0], MALFORMED),
        ("time-three", 7, [0.0, 1.0, 2.0], MALFORMED),
        ("background-above", 8, [0.0, 1.0 + 2.0**-23, 0.0], MALFORMED),
        ("background-below", 8, [0.0, 0.0, -(2.0**-149)], MALFORMED),
        ("background-four", 8, [0.0] * 4, MALFORMED),
        ("near-negative", 9, [-1.0, 1.0], MALFORMED),
        ("near-is-far", 9, [1.0, 1.0], MALFORMED),
        ("near-beyond-far", 9, [2.0, 1.0], MALFORMED),
        ("near-alone", 9, [1.0], MALFORMED),
        ("up-two", 10, [0.0, 1.0], MALFORMED),
        ("up-integers", 10, [0, 1, 0], MALFORMED),
        ("unit-negative", 11, -1.0, MALFORMED),
        ("unit-integer", 11, 1, MALFORMED),
        ("unit-boolean", 11, True, MALFORMED),
    ]
    for name, key, value, error in values:
        what = f"Header key {key} is {value!r}."
        yield bad(f"header-{name}", what, "5.1", error, plain.with_header({key: value}))


def _chunk_list() -> Iterator[Vector]:
    file, plain = three_layers(), _plain()
    size = len(plain.chunks[0].payload)
    first, second, third = file.chunks
    lists: list[tuple[str, object, str, str]] = [
        ("empty", [], MALFORMED, "No chunk is listed."),
        ("integer", 1, MALFORMED, "The list is an integer."),
        ("map", {}, MALFORMED, "The list is a map."),
        ("65", [[0, size], *[[9, 0]] * MAX_CHUNKS], LIMIT, "65 chunks."),
        ("pair-of-one", [[0]], MALFORMED, "A chunk without a length."),
        ("pair-of-three", [[0, size, 0]], MALFORMED, "A chunk with an offset."),
        ("pair-integer", [0], MALFORMED, "A chunk that is an integer."),
        ("type-over-limit", [[0, size], [65536, 0]], LIMIT, "Type 65536."),
        ("type-negative", [[0, size], [-1, 0]], MALFORMED, "Type −1."),
        ("type-real", [[0.0, size]], MALFORMED, "A type that is a real."),
        ("length-over-limit", [[0, MAX_PAYLOAD + 1]], LIMIT, "A payload of 2^31 bytes."),
        ("length-negative", [[0, -1]], MALFORMED, "A payload of −1 bytes."),
        ("length-boolean", [[0, True]], MALFORMED, "A length that is a boolean."),
        ("without-layer-0", [[1, size]], MALFORMED, "Layer 1 alone."),
        ("ancillary-first", [[9, 0], [0, size]], MALFORMED, "An ancillary chunk before layer 0."),
        ("layer-0-twice", [[0, size], [0, size]], MALFORMED, "Layer 0 twice."),
    ]
    for name, value, error, what in lists:
        yield bad(f"chunk-list-{name}", what, "5.2", error, replace(plain, header={**HEADER, 1: value}))
    for name, chunks, what in (
        ("descends", (first, third, second), "Layer 2 before layer 1."),
        ("layer-1-twice", (first, second, second), "Layer 1 twice."),
        ("layer-0-second", (second, first), "Layer 0 behind layer 1."),
    ):
        yield bad(f"chunk-list-{name}", what, "5.2", MALFORMED, replace(file, chunks=chunks))
    more = replace(plain, header={**HEADER, 1: [[0, size], [1, 77]]})
    end = len(more.data())
    yield bad(
        "chunk-list-more-than-file",
        "A chunk is listed that is not there.",
        "3.2 5.2",
        "Truncated",
        more,
        chunk=1,
        size=end,
    )
    huge = replace(
        plain, header={**HEADER, 1: [[0, size], [1, MAX_PAYLOAD]]}, tail=b"\1\0\0\0\xff\xff\xff\x7f" + bytes(12)
    )
    end = len(huge.data())
    yield bad(
        "chunk-of-2-gib",
        "A chunk of 2^31 − 1 bytes, of which few are there.",
        "3.2",
        "Truncated",
        huge,
        chunk=1,
        size=end,
    )


def _camera() -> Iterator[Vector]:
    plain = _plain()
    for key in range(1, 5):
        camera = {k: v for k, v in CAMERA.items() if k != key}
        what = f"The camera lacks key {key}."
        yield bad(f"camera-key-{key}-missing", what, "5.3", MALFORMED, plain.with_header({12: camera}))
    values: list[tuple[str, int, object, str]] = [
        ("matrix-16", 1, [1.0] * 16, MALFORMED),
        ("matrix-integers", 1, [1] * 12, MALFORMED),
        ("intrinsics-three", 2, [500.0, 320.0, 240.0], MALFORMED),
        ("fx-zero", 2, [0.0, 500.0, 320.0, 240.0], MALFORMED),
        ("fy-negative", 2, [500.0, -500.0, 320.0, 240.0], MALFORMED),
        ("fy-zero", 2, [500.0, 0.0, 320.0, 240.0], MALFORMED),
        ("width-zero", 3, 0, MALFORMED),
        ("width-over-limit", 3, 65536, LIMIT),
        ("width-real", 3, 640.0, MALFORMED),
        ("height-negative", 4, -1, MALFORMED),
        ("height-over-limit", 4, 2**64 - 1, LIMIT),
        ("key-unknown", 5, 1, FEATURE),
        ("key-63-unknown", 63, 1, FEATURE),
    ]
    for name, key, value, error in values:
        what = f"Camera key {key} is {value!r}."
        yield bad(f"camera-{name}", what, "5.3", error, plain.with_header({12: {**CAMERA, key: value}}))
    yield bad("camera-list", "The camera is a list.", "5.3", MALFORMED, plain.with_header({12: [1.0]}))


def _error_bounds() -> Iterator[Vector]:
    plain, file = _plain(), three_layers()
    for key in range(8):
        bounds = {k: v for k, v in ERROR_BOUNDS.items() if k != key}
        layer = None if key < 4 else 1 if key < 6 else 2
        what = f"No error bound of class {key}" + (f", which layer {layer} has." if layer else ".")
        yield bad(f"bound-{key}-missing", what, "5.4", MALFORMED, file.with_header({13: bounds}), chunk=layer)
    values: list[tuple[str, int, object, str]] = [
        ("negative", 0, -(2.0**-149), MALFORMED),
        ("integer", 3, 0, MALFORMED),
        ("boolean", 2, True, MALFORMED),
        ("list", 1, [0.5], MALFORMED),
        ("unused-negative", 7, -1.0, MALFORMED),
        ("unused-integer", 4, 1, MALFORMED),
        ("class-8-unknown", 8, 0.5, FEATURE),
        ("class-63-unknown", 63, 0.5, FEATURE),
    ]
    for name, key, value, error in values:
        what = f"The error bound of class {key} is {value!r}."
        changed = plain.with_header({13: dict(sorted({**ERROR_BOUNDS, key: value}.items()))})
        yield bad(f"bound-{name}", what, "5.4", error, changed)
    listed = plain.with_header({13: list(ERROR_BOUNDS.values())})
    yield bad("bounds-list", "The error bounds are a list.", "5.4", MALFORMED, listed)
    yield bad("bounds-real", "The error bounds are a real.", "5.4", MALFORMED, plain.with_header({13: 0.5}))


# -- clause 6 ----------------------------------------------------------------------------------------------------------


def _in_layer(
    layer: int, name: str, what: str, clauses: str, error: str, payload: bytes, file: File | None = None
) -> Vector:
    """A vector whose fault lies in the payload of one layer of `file`."""
    return bad(name, what, clauses, error, (file or three_layers()).with_payload(layer, payload), chunk=layer)


def _layout() -> Iterator[Vector]:
    plain = _plain()
    payload = plain.chunks[0].payload
    size = struct.unpack_from("<I", payload)[0]
    for name, bytes_, what in (
        ("empty", b"", "An empty payload."),
        ("three-bytes", payload[:3], "A payload of three bytes."),
        ("parameters-empty", bytes(4), "Parameters of no bytes."),
        (
            "parameters-beyond",
            struct.pack("<I", len(payload) - 3) + payload[4:],
            "Parameters a byte longer than the payload.",
        ),
        (
            "parameters-short",
            struct.pack("<I", size - 1) + payload[4:],
            "The length of the parameters is a byte short.",
        ),
        ("byte-left", payload + b"\0", "A byte behind the sections."),
        ("byte-missing", payload[:-1], "The last section lacks a byte."),
        ("sections-cut", payload[: 4 + size], "No byte of any section."),
    ):
        yield _in_layer(0, f"payload-{name}", what, "6.1", MALFORMED, bytes_, plain)
    for name, bytes_, what in (
        ("largest", struct.pack("<I", 2**32 - 1) + payload[4:], "Parameters of 2^32 − 1 bytes."),
        ("over-limit", make_layer().padded(MAX_PARAMETERS + 1), "Parameters of 4097 bytes."),
    ):
        yield _in_layer(0, f"payload-parameters-{name}", what, "6.1 14", LIMIT, bytes_, plain)


def _parameters() -> Iterator[Vector]:
    plain = _plain()
    layer, deformed, bare = make_layer(), three_layers().layer(1), make_layer(1, line(2, z=5), before=3)

    def sections(**lengths: int) -> dict:
        return {int(key[1:]): value for key, value in lengths.items()}

    def without(key: int):
        return lambda m: {k: v for k, v in m.items() if k != key}

    def put(key: int, value: object):
        return lambda m: {**m, key: value}

    def length(section: int, value: object):
        return lambda m: {**m, 2: {**m[2], section: value}}

    zero: list[tuple[str, object, str, str]] = [
        ("rows-missing", without(1), MALFORMED, "Key 1 is missing."),
        ("rows-negative", put(1, -1), MALFORMED, "−1 rows."),
        ("rows-real", put(1, 1.0), MALFORMED, "A real number of rows."),
        ("rows-over-limit", put(1, MAX_ANCHORS + 1), LIMIT, "2^24 + 1 rows."),
        ("rows-largest", put(1, 2**64 - 1), LIMIT, "2^64 − 1 rows."),
        ("sections-missing", without(2), MALFORMED, "Key 2 is missing."),
        ("sections-list", put(2, [1]), MALFORMED, "The sections are a list."),
        ("section-length-zero", length(PLANE, 0), MALFORMED, "A section of no bytes."),
        ("section-length-negative", length(PLANE, -1), MALFORMED, "A section of −1 bytes."),
        ("section-length-over-limit", length(MASKS, MAX_PAYLOAD + 1), LIMIT, "A section of 2^31 bytes."),
        ("section-length-largest", length(MASKS, MAX_PAYLOAD), MALFORMED, "A section longer than the payload."),
        ("section-length-text", length(MASKS, "3"), MALFORMED, "A length that is a string."),
        ("section-unknown", length(7, 1), FEATURE, "Section 7."),
        ("section-63-unknown", length(63, 1), FEATURE, "Section 63."),
        ("steps-missing", without(3), MALFORMED, "Layer 0 without steps."),
        ("steps-two", put(3, [1.0, 1.0]), MALFORMED, "Layer 0 with two steps."),
        ("steps-none", put(3, []), MALFORMED, "Layer 0 with an empty list of steps."),
        ("step-zero", put(3, [0.0]), MALFORMED, "A step of 0."),
        ("step-subnormal", put(3, [SUBNORMAL]), MALFORMED, "A subnormal step."),
        ("step-integer", put(3, [1]), MALFORMED, "A step that is an integer."),
        ("scales-in-layer-0", put(4, [[1] * 5 + [0] * 6]), MALFORMED, "Planes in layer 0."),
        ("networks-missing", without(5), MALFORMED, "Layer 0 without networks."),
        ("key-unknown", put(6, 1), FEATURE, "Unknown key 6."),
        ("key-0-unknown", put(0, 1), FEATURE, "Unknown key 0."),
        ("key-63-unknown", put(63, []), FEATURE, "Unknown key 63."),
    ]
    for name, change, error, what in zero:
        yield _in_layer(0, f"layer-0-{name}", what, "6.2", error, layer.payload(change), plain)  # type: ignore[arg-type]
    bare_0 = replace(layer, meta={1: 1}).with_sections({WEIGHTS: None}).payload()
    yield _in_layer(0, "layer-0-bare", "Layer 0 without steps, networks and weights.", "6.2", MALFORMED, bare_0, plain)
    one: list[tuple[str, Layer, object, str, str]] = [
        ("rows-over-limit", deformed, put(1, MAX_ANCHORS - 2), LIMIT, "More than 2^24 anchors with those of layer 0."),
        ("steps-missing", deformed, without(3), MALFORMED, "A deformation without steps."),
        ("steps-one", deformed, put(3, [1.0]), MALFORMED, "A deformation with one step."),
        ("steps-three", deformed, put(3, [1.0] * 3), MALFORMED, "A deformation with three steps."),
        ("scales-missing", deformed, without(4), MALFORMED, "A deformation without planes."),
        ("networks-missing", deformed, without(5), MALFORMED, "Planes without networks."),
        ("steps-alone", bare, put(3, [1.0, 1.0]), MALFORMED, "Steps without a deformation."),
        ("scales-alone", bare, put(4, [[1] * 5 + [0] * 6]), MALFORMED, "Planes without steps and networks."),
        ("networks-empty", bare, put(5, []), MALFORMED, "An empty list of networks."),
    ]
    for name, which, change, error, what in one:
        yield _in_layer(1, f"layer-1-{name}", what, "6.2", error, which.payload(change))  # type: ignore[arg-type]


def _scales() -> Iterator[Vector]:
    layer, plain = three_layers().layer(1), [2, 3, 2, 4, 2] + [0] * 6
    values: list[tuple[str, object, str, str]] = [
        ("empty", [], MALFORMED, "No scale."),
        ("integer", 1, MALFORMED, "The scales are an integer."),
        ("nine", [plain] * (MAX_PLANE_SCALES + 1), LIMIT, "Nine scales."),
        ("entry-short", [plain[:-1]], MALFORMED, "A scale of ten numbers."),
        ("entry-long", [[*plain, 0]], MALFORMED, "A scale of twelve numbers."),
        ("channels-zero", [[0, *plain[1:]]], MALFORMED, "No channels."),
        ("channels-over-limit", [[MAX_PLANE_CHANNELS + 1, *plain[1:]]], LIMIT, "257 channels."),
        ("side-zero", [[*plain[:3], 0, *plain[4:]]], MALFORMED, "A side of 0."),
        ("side-over-limit", [[*plain[:4], MAX_PLANE_SIDE + 1, *plain[5:]]], LIMIT, "A side of 4097."),
        ("side-real", [[2, 3.0, *plain[2:]]], MALFORMED, "A side that is a real."),
        ("predictor-unknown", [[*plain[:-1], 6]], FEATURE, "Predictor 6."),
        ("predictor-largest", [[*plain[:-1], 2**64 - 1]], FEATURE, "Predictor 2^64 − 1."),
        ("predictor-negative", [[*plain[:-1], -1]], FEATURE, "Predictor −1."),
        ("predictor-boolean", [[*plain[:-1], False]], MALFORMED, "A predictor that is a boolean."),
    ]
    for name, value, error, what in values:
        yield _in_layer(1, f"scales-{name}", what, "6.3", error, layer.payload(lambda m, value=value: {**m, 4: value}))
    differ = make_file(make_layer(), make_layer(1, (), before=1, scales=[Scale(2), Scale(1)]))
    yield bad("scales-channels-differ", "Scales of two and one channels.", "6.3", MALFORMED, differ, chunk=1)


def _networks() -> Iterator[Vector]:
    plain, file = _plain(), three_layers()
    good = [[0, 10], [1, 70], [2, 30]]
    zero: list[tuple[str, object, str, str]] = [
        ("empty", [], MALFORMED, "No network."),
        ("map", {}, MALFORMED, "The networks are a map."),
        ("entry-empty", [[], *good[1:]], MALFORMED, "An entry without an id."),
        ("entry-integer", [0, *good[1:]], MALFORMED, "An entry that is an integer."),
        ("without-layers", [[0], *good[1:]], MALFORMED, "A network without linear layers."),
        ("id-unknown", [*good[:2], [3, 30]], FEATURE, "Network 3 in layer 0."),
        ("id-negative", [[-1, 10], *good[1:]], FEATURE, "Network −1."),
        ("id-largest", [*good[:2], [2**64 - 1, 30]], FEATURE, "Network 2^64 − 1."),
        ("id-real", [[0.0, 10], *good[1:]], MALFORMED, "An id that is a real."),
        ("four", [*good, [3, 1]], FEATURE, "Network 3 beside the others."),
        ("descend", good[::-1], MALFORMED, "Networks in descending order."),
        ("twice", [good[0], good[0], good[2]], MALFORMED, "A network twice."),
        ("two", good[:2], MALFORMED, "Layer 0 without its color network."),
        ("outputs", [[0, 11], *good[1:]], MALFORMED, "Eleven opacities."),
        ("width-zero", [[0, 0, 10], *good[1:]], MALFORMED, "A hidden layer of no outputs."),
        ("width-over-limit", [[0, MAX_NETWORK_WIDTH + 1, 10], *good[1:]], LIMIT, "A hidden layer of 4097 outputs."),
        ("17-layers", [[0, *[1] * MAX_NETWORK_LAYERS, 10], *good[1:]], LIMIT, "17 linear layers."),
    ]
    for name, value, error, what in zero:
        payload = make_layer().payload(lambda m, value=value: {**m, 5: value})
        yield _in_layer(0, f"networks-{name}", what, "6.3", error, payload, plain)
    one: list[tuple[str, object, str, str]] = [
        ("without-trunk", [[1, 3]], MALFORMED, "A head without a trunk."),
        ("trunk-alone", [[0, 3]], MALFORMED, "A trunk without a head."),
        ("of-layer-2", [[0, 3], [5, 3]], FEATURE, "Network 5 in layer 1."),
        ("head-outputs", [[0, 3], [4, 3]], MALFORMED, "A scaling head of three outputs."),
    ]
    for name, value, error, what in one:
        payload = file.layer(1).payload(lambda m, value=value: {**m, 5: value})
        yield _in_layer(1, f"networks-{name}", what, "6.3", error, payload)


def _sections() -> Iterator[Vector]:
    file, names = three_layers(), ("positions", "masks", "attributes", "planes", "weights")
    layer = file.layer(1)
    for section, name in enumerate(names):
        what = f"Section {name} is missing."
        yield _in_layer(
            1, f"section-{name}-missing", what, "6.4", MALFORMED, layer.with_sections({section: None}).payload()
        )
    empty = make_layer(1, (), before=0)
    base = make_file(make_layer(cells=()), empty)
    one = [[2]]
    fill = {POSITIONS: bytes(15), MASKS: coded(one), PLANE: plain_planes(one), WEIGHTS: coded(one)}
    fill[ATTRIBUTE] = plain_attributes(np.zeros((68, 0), np.int32))
    for section, name in enumerate(names):
        what = f"Section {name} has nothing to code."
        payload = empty.with_sections({section: fill[section]}).payload()
        yield _in_layer(1, f"section-{name}-without-symbols", what, "6.4", MALFORMED, payload, base)
    symbols = lzma_symbols(layer.channels)
    payload = layer.with_sections({SYMBOLS: symbols}).payload()
    yield _in_layer(1, "section-symbols-in-mode-ans", "Section 5 in mode ans.", "6.4", MALFORMED, payload)
    floats = lzma_floats([t.astype(np.float32) for t in layer.meant.tensors()])
    payload = layer.with_sections({FLOATS: floats}).payload()
    yield _in_layer(1, "section-floats-not-declared", "Section 6 where deformation is 0.", "6.4", MALFORMED, payload)
    lzma = make_file(make_layer(mode=LZMA), header={2: LZMA})
    for section in (MASKS, ATTRIBUTE, WEIGHTS):
        payload = lzma.layer(0).with_sections({section: make_layer().sections[section]}).payload()
        what = f"Section {section} in mode lzma."
        yield _in_layer(0, f"section-{names[section]}-in-mode-lzma", what, "6.4", MALFORMED, payload, lzma)
    without = lzma.layer(0).with_sections({SYMBOLS: None}).payload()
    yield _in_layer(0, "section-symbols-missing", "Mode lzma without section 5.", "6.4", MALFORMED, without, lzma)
    raw = make_layer(1, (), before=1, scales=[Scale()], raw=True)
    floating = make_file(make_layer(), raw, header={3: FLOAT32})
    payload = raw.with_sections({FLOATS: None}).payload()
    yield _in_layer(
        1, "section-floats-missing", "Deformation 1 without section 6.", "6.4", MALFORMED, payload, floating
    )
    coded_too = make_layer(1, (), before=1, scales=[Scale()])
    for section, name in ((PLANE, "planes"), (WEIGHTS, "weights")):
        payload = raw.with_sections({section: coded_too.sections[section]}).payload()
        what = f"Section {name} beside float32 values."
        yield _in_layer(1, f"section-{name}-beside-floats", what, "6.4", MALFORMED, payload, floating)
    scaffold = make_layer().with_sections({FLOATS: lzma_floats([np.zeros(1, np.float32)])})
    payload = scaffold.payload()
    yield _in_layer(0, "section-floats-in-layer-0", "Float32 values in layer 0.", "6.4", MALFORMED, payload, floating)
    predicted = raw.payload(lambda m: {**m, 4: [[*m[4][0][:-1], 1]]})
    yield _in_layer(
        1, "scales-predictor-of-floats", "A predictor on float32 planes.", "6.3", MALFORMED, predicted, floating
    )


def _sizes() -> Iterator[Vector]:
    over = symbols_at_limit(over=1)
    yield bad("symbols-over-limit", "One symbol more than the payload may declare.", "6.5", LIMIT, over, chunk=1)
    crowd = rows_at_limit(over=1)
    yield bad("rows-over-limit", "One anchor more than the payload may declare.", "6.5 14", LIMIT, crowd, chunk=0)
    layer, file = make_layer(), _plain()
    for name, rows in (("rows", 1 << 20), ("most-rows", MAX_ANCHORS)):
        payload = layer.payload(lambda m, rows=rows: {**m, 1: rows})
        what = f"{rows} anchors, constant in every channel, in a few bytes."
        yield _in_layer(0, f"bomb-{name}", what, "6.5", LIMIT, payload, file)
    deformed = three_layers().layer(1)
    for name, scale, what in (
        ("cells", [64, 1024, 1024, 1, 1], "2^26 plane cells in a few bytes."),
        ("cells-over-limit", [256, 4096, 4096, 4096, 4096], "More than 2^28 plane cells."),
    ):
        payload = deformed.payload(lambda m, scale=scale: {**m, 4: [[*scale, *[0] * 6]]})
        yield _in_layer(1, f"bomb-{name}", what, "6.5", LIMIT, payload)
    wide = [[0, *[4096] * 15, 10], [1, 70], [2, 30]]
    payload = layer.payload(lambda m: {**m, 5: wide})
    yield _in_layer(0, "bomb-weights", "Over 2^27 constant weights in a few bytes.", "6.5", LIMIT, payload, file)
    scales = [[1, 4096, 4096, 1, 1, *[0] * 6]] * 8
    payload = deformed.payload(lambda m: {**m, 4: scales})
    yield _in_layer(1, "bomb-scales", "Eight scales of constant planes.", "6.5", LIMIT, payload)


# -- clauses 7 and 8 ---------------------------------------------------------------------------------------------------

CODES = [5, 9, 7]


def _masked(name: str, what: str, clauses: str, error: str, section: bytes) -> Vector:
    """Three anchors of layer 0 whose MASKS section, one channel of three codes, is this one."""
    layer = make_layer(0, line(3), codes=CODES)
    payload = layer.with_sections({MASKS: section}).payload()
    return _in_layer(0, name, what, clauses, error, payload, make_file(layer))


def _attributed(name: str, what: str, clauses: str, error: str, section: bytes) -> Vector:
    """Three anchors of layer 0 whose ATTRIBUTES section is this one."""
    layer = make_layer(0, line(3))
    payload = layer.with_sections({ATTRIBUTE: section}).payload()
    return _in_layer(0, name, what, clauses, error, payload, make_file(layer))


def _varints() -> Iterator[Vector]:
    for name, section, error, what in (
        ("overlong", b"\x80\x00\x9a\x01", MALFORMED, "0 in two bytes."),
        ("overlong-parameter", b"\x00\x9a\x81\x00", MALFORMED, "154 in three bytes."),
        ("six-bytes", b"\x00\x80\x80\x80\x80\x80\x01", MALFORMED, "A varint of six bytes."),
        ("cut", b"\x00\x9a", MALFORMED, "The section ends inside a varint."),
        ("over-limit", b"\x00" + varint(2 * K_MAX + 1), LIMIT, "A constant of −2^24."),
        ("largest", b"\x00" + varint((1 << 35) - 1), LIMIT, "A varint of 35 bits."),
    ):
        yield _masked(f"varint-{name}", what, "7.1", error, section)


def _new(family: int, *parameters: bytes) -> bytes:
    """The token and parameters of a new prior."""
    return varint(2 * family) + b"".join(parameters)


def _below(kmin: int) -> bytes:
    """CODES as exceptions of a window that begins at kmin."""
    return varint(len(CODES) - 1) + b"".join(varint(0) + varint(2 * (kmin - 1 - code) + 1) for code in CODES)


def _steep_plane(mode: int = ANS) -> Layer:
    """Layer 1 with a plane whose samples are within 2^23, while its second residual is K + 1."""
    samples = np.array([-MAX_SYMBOL, MAX_SYMBOL], np.int32)
    scale = Scale(1, (2, 1, 1, 1), (1, 0, 0, 0, 0, 0), lambda name, shape: np.resize(samples * (name == "xy"), shape))
    return make_layer(1, (), before=1, scales=[scale], mode=mode)


def _steep(name: str, what: str, clauses: str, prior: Prior) -> Vector:
    """The residuals of `_steep_plane` under this prior."""
    layer = _steep_plane()
    residuals = [[-MAX_SYMBOL, 2 * MAX_SYMBOL], [0] * 2, [0] * 2, [0], [0], [0]]
    written = layer.with_sections({PLANE: plain_planes(residuals, {0: prior})})
    return bad(name, what, clauses, MALFORMED, make_file(make_layer(), written), chunk=1)


def _priors() -> Iterator[Vector]:
    window = zigzag(3) + varint(8)  # ten entries from 3
    normal = zigzag(0) + varint(2 * 700)
    stream = coded([CODES], {0: gauss(3, 10, si=60)})[-4:]
    top, reserved = MAX_WINDOW - 2, varint(2 * 700 + 1)
    # All three symbols as exceptions below the window, so that nothing but its end is wrong.
    last, entry = K_MAX, K_MAX - 4095
    past = varint(2 * 1 + 1) + zigzag(last) + varint(0) + normal + _below(last)
    past_scaled = varint(2 * SCALED + 1) + b"\x0c\1" + zigzag(entry) + varint(0) + normal + _below(entry)
    for name, section, error, what in (
        ("token-over-limit", varint(2 * (FIRST_REUSE + MAX_COUNT) + 1), LIMIT, "A token over its limit."),
        ("family-5", _new(5, window), FEATURE, "Prior family 5."),
        ("family-7", _new(7, window), FEATURE, "Prior family 7."),
        ("scaled-family-4", _new(SCALED, b"\1\4", window), FEATURE, "A scaled prior of family 4."),
        ("scaled-family-0", _new(SCALED, b"\1\0", zigzag(5)), MALFORMED, "A scaled constant."),
        ("scaled-shift-0", _new(SCALED, b"\0\1", window, normal, stream), MALFORMED, "A scaled prior of shift 0."),
        (
            "scaled-shift-13",
            _new(SCALED, bytes([MAX_SHIFT + 1, 1]), window, normal),
            LIMIT,
            "A scaled prior of shift 13.",
        ),
        ("reuse-before-first", varint(2 * FIRST_REUSE), MALFORMED, "A reference to a prior where there is none."),
        ("constant-over-limit", _new(0, zigzag(K_MAX + 1)), LIMIT, "A constant of 2^24."),
        ("window-over-limit", _new(1, zigzag(-K_MAX - 1), varint(8), normal, stream), LIMIT, "A window from −2^24."),
        (
            "window-too-wide",
            _new(1, zigzag(3), varint(top + 1), normal, stream),
            LIMIT,
            "A window of 2^14 + 1 entries.",
        ),
        ("window-past-k", past, MALFORMED, "A window that ends at 2^24."),
        ("window-past-k-scaled", past_scaled, MALFORMED, "A scaled window whose last entry begins at 2^24."),
        (
            "mean-over-limit",
            _new(1, window, zigzag(MU8_MAX + 1), varint(1400), stream),
            LIMIT,
            "A mean over its limit.",
        ),
        (
            "mean-under-limit",
            _new(1, window, varint(2 * MU8_MAX + 1), varint(1400), stream),
            LIMIT,
            "A mean under its limit.",
        ),
        (
            "width-over-limit",
            _new(1, window, zigzag(0), varint(3842), stream),
            LIMIT,
            "A standard deviation over 2^20.",
        ),
        ("mixture-weight-0", _new(2, window, normal, normal, b"\0", stream), MALFORMED, "A mixture of weight 0."),
        (
            "mixture-reserved-bit",
            _new(2, window, normal, zigzag(0), reserved, b"\x80", stream),
            MALFORMED,
            "The second normal's floor bit.",
        ),
        ("mixture-cut", _new(2, window, normal, normal), MALFORMED, "A mixture without a weight."),
        ("parameters-cut", _new(1, window, zigzag(0)), MALFORMED, "A Gaussian without a width."),
    ):
        yield _masked(f"prior-{name}", what, "8.1 8.2", error, section)
    section = coded([[2] * 3] * 68)
    far = section[:5] + varint(2 * (FIRST_REUSE + 1)) + section[6:]
    yield _attributed("prior-reuse-too-far", "A reference to a prior before the first.", "8.1", MALFORMED, b"\0" + far)
    one = b"\0" + coded([[2] * 3] * 67)
    yield _attributed("channel-missing", "67 channels of attributes.", "8.1", MALFORMED, one)
    yield _attributed("channel-too-many", "69 channels of attributes.", "8.1", MALFORMED, b"\0" + coded([[2] * 3] * 69))
    over = tables_at_limit(more=True)
    yield bad("prior-tables-over-limit", "Tables of 2^21 + 1 entries in a section.", "8.2 14", LIMIT, over, chunk=1)
    wide = gauss(K_MAX - 2 * 4095, 2, shift=12)
    yield _steep("symbol-over-k", "A scaled symbol of K + 1.", "8.4", wide)


def _histograms() -> Iterator[Vector]:
    def masked(name: str, what: str, error: str, prior: Hist, block: bytes | None = None, classes=None) -> Vector:
        out = bytearray(varint(2 * prior.id))
        write_prior(out, prior)
        stream = ans_encode(
            [prior.class_symbols if classes is None else classes, np.array(CODES) - prior.window.kmin],
            [prior.class_cum, replace(prior, classes=np.array([5] * prior.window.n)).cum],
        )
        return _masked(f"histogram-{name}", what, "8.2", error, (bytes(out) if block is None else block) + stream)

    window, n = zigzag(3) + varint(8), 10
    plain = Hist(Window(3, n), 8, 5, False, 30, 8, np.array([5] * n))
    signed = Hist(Window(3, n), 8, 5, True, 30, 0, np.array([5] * n))
    head = varint(2 * plain.id) + window
    for bit in range(3, 8):
        what = f"Bit {bit} of the mode, which is reserved."
        yield masked(f"mode-bit-{bit}", what, MALFORMED, signed, head + bytes([4 | 1 << bit]) + varint(5) + b"\x1e")
    yield masked("top-0", "No classes.", MALFORMED, plain, head + b"\0" + varint(0) + b"\x1e" + varint(0))
    for i, d in enumerate((8, 64)):
        what = f"More classes than a step of {d} allows."
        block = head + bytes([3 * i]) + varint(top_limit(d) + 1) + b"\x1e" + varint(8)
        yield masked(f"top-over-limit-{d}", what, LIMIT, plain, block)
    yield masked(
        "width-over-limit", "A class width of 64.", LIMIT, plain, head + b"\0" + varint(5) + b"\x40" + varint(8)
    )
    yield masked(
        "mean-over-limit", "A class mean of 16·top + 1.", LIMIT, plain, head + b"\0" + varint(5) + b"\x1e" + varint(81)
    )
    yield masked("all-zero", "Every class is 0.", MALFORMED, plain, classes=np.zeros(n, int))
    yield masked(
        "below-zero", "Differences that lead below 0.", MALFORMED, signed, classes=np.array([6, 3, 7, *[5] * 7])
    )
    yield masked(
        "above-top", "Differences that lead above the top.", MALFORMED, signed, classes=np.array([10, 6, 4, *[5] * 7])
    )
    yield masked("all-zero-differences", "Differences of 0 alone.", MALFORMED, signed, classes=np.full(n, 5))


def _streams() -> Iterator[Vector]:
    section = coded([CODES], {0: gauss(3, 10, si=60)})
    block, stream = section[:-4], section[-4:]
    constant = b"\0\x9a\1"
    other = words(struct.unpack("<I", stream)[0] ^ 1 << 20)
    for name, section, what in (
        ("odd-length", block + stream + b"\0", "A stream of five bytes."),
        ("short", block + stream[:3], "A stream of three bytes."),
        ("zero-word-first", block + words(0) + stream, "A zero word before the stream."),
        ("other-word", block + other, "A stream that ends in another state."),
        ("one-for-constants", constant + words(1), "A word where every channel is constant."),
        ("zero-for-constants", constant + words(0), "A zero word where every channel is constant."),
        ("byte-for-constants", constant + b"\1", "A byte where every channel is constant."),
    ):
        yield _masked(f"stream-{name}", what, "7.7", MALFORMED, section)
    long = plain_attributes(pattern(68, 3), {0: SMALL})
    for name, tail, what in (("word-left", 7, "A word"), ("zero-word-left", 0, "A zero word")):
        yield _attributed(f"stream-{name}", f"{what} behind the stream.", "7.7", MALFORMED, long + words(tail))
    yield _attributed("stream-word-missing", "A stream without its last word.", "7.7", MALFORMED, long[:-4])
    swapped = long[:-8] + long[-4:] + long[-8:-4]
    yield _attributed("stream-words-swapped", "The last two words are swapped.", "7.7", MALFORMED, swapped)


def _exceptions() -> Iterator[Vector]:
    def listed(*numbers: int) -> bytes:
        return varint(1) + zigzag(9) + b"".join(map(varint, numbers))

    yield _steep("exceptions-above-k", "An exception of K + 1.", "8.3", SMALL)
    for name, section, error, what in (
        ("beyond-channel", listed(0, 3, 0), MALFORMED, "An exception at place 3 of three symbols."),
        ("second-beyond-channel", listed(1, 1, 0, 1, 0), MALFORMED, "A second exception at place 3 of three symbols."),
        ("more-than-symbols", listed(3, *[0, 0] * 4), MALFORMED, "Four exceptions among three symbols."),
        ("number-largest", listed(VARINT_MAX, 0, 0), MALFORMED, "2^35 exceptions, the most a varint can say."),
        ("place-largest", listed(0, VARINT_MAX, 0), MALFORMED, "An exception at place 2^35 − 1 of three symbols."),
        ("counts-that-lie", listed(MAX_COUNT - 1, 0, 0), MALFORMED, "2^26 exceptions in four bytes."),
        ("cut", listed(1, 0, 0, 0), MALFORMED, "The section ends inside an exception."),
        ("code-over-limit", listed(0, 0, 4 * K_MAX + 3), LIMIT, "A code over 4·K + 2."),
        ("below-k", listed(0, 0, 2 * (K_MAX + 9) + 1), MALFORMED, "An exception of −K − 1."),
    ):
        yield _masked(f"exceptions-{name}", what, "8.3", error, section)


def _prediction() -> Iterator[Vector]:
    k = np.full((68, 3), 3, np.int32)

    def block(terms=None, splits=None, counts=None) -> bytes:
        return b"\1" + prediction_block(terms or {}, splits or {}, counts or {})

    def whole(terms) -> bytes:
        """With stages as without terms."""
        return block(terms) + predicted_attributes(k, {}, {})[len(block()) :]

    def said(change) -> bytes:
        """Other lengths of the stages."""
        return predicted_attributes(k, {}, both, lengths=change)

    def classed(count: int) -> bytes:
        return b"\1" + prediction_block({}, {}, {}, (1, 1, count, 1, 1))

    both = {0: (3, 3, 3)}
    stages = [coded(stage) for stage in attribute_stages(k, {}, ONE_CLASS)]
    stages[1] = varint(2 * FIRST_REUSE) * 6
    reused = block() + b"".join([*(varint(len(stage)) for stage in stages[:-1]), *stages])
    for name, section, error, what in (
        ("form-2", b"\2" + coded(k), FEATURE, "Form 2 of the attributes."),
        ("form-255", b"\xff" + coded(k), FEATURE, "Form 255 of the attributes."),
        ("form-alone", b"\1", MALFORMED, "The section ends after its form."),
        ("block-cut", block()[:30], MALFORMED, "The section ends inside the prediction block."),
        ("terms-over-limit", block({2: [(0, 1)] * 3}), LIMIT, "Three terms for channel 2."),
        ("term-of-itself", whole({2: [(2, 1)]}), MALFORMED, "Channel 2 is predicted from itself."),
        ("term-of-later-channel", whole({2: [(1, 1), (30, 1)]}), MALFORMED, "Channel 2 is predicted from channel 32."),
        ("term-gap-over-limit", block({37: [(39, 1)]}), LIMIT, "A gap of 39 channels."),
        ("weight-over-limit", whole({1: [(0, (1 << 15) + 1)]}), LIMIT, "A weight of 2^15 + 1."),
        ("weight-under-limit", whole({1: [(0, -(1 << 15) - 1)]}), LIMIT, "A weight of −2^15 − 1."),
        ("term-missing", block(counts={37: 1})[:-15], MALFORMED, "The section ends before a term."),
        ("split-unknown", block(splits={9: (4, 0, 0)}), LIMIT, "Split 4."),
        ("split-x-over-limit", block(splits={4: (1, K_MAX + 1, 0)}), LIMIT, "A centre of x of K + 1."),
        ("split-y-under-limit", block(splits={4: (2, 0, -K_MAX - 1)}), LIMIT, "A centre of y of −K − 1."),
        ("classes-0", classed(0), MALFORMED, "No class in stage 3."),
        ("classes-9", classed(9), LIMIT, "Nine classes in stage 3."),
        ("classes-cut", classed(1)[:-13], MALFORMED, "The section ends after two class counts."),
        ("stage-over-rest", said(lambda sizes: [999, *sizes[1:]]), LIMIT, "A stage longer than the section."),
        (
            "stages-over-rest",
            said(lambda sizes: [*sizes[:-1], sizes[-1] + 40]),
            MALFORMED,
            "Stages longer than what is left.",
        ),
        ("stage-0-short", said(lambda sizes: [sizes[0] - 1, *sizes[1:]]), MALFORMED, "Stage 0 is a byte short."),
        ("stage-6-short", said(lambda sizes: [*sizes[:-1], sizes[-1] - 1]), MALFORMED, "Stage 6 is a byte short."),
        ("prior-of-earlier-stage", reused, MALFORMED, "Stage 1 refers to a prior of stage 0."),
        ("stage-left", predicted_attributes(k, {}, {}, tail=words(1)), MALFORMED, "A word behind the last stage."),
        ("result-over-k", _over_k(), MALFORMED, "A predicted symbol of K + 1."),
    ):
        yield _attributed(f"predicted-{name}", what, "8.5 8.6 8.7", error, section)


def _over_k() -> bytes:
    """Form 1 with every residual just over K / 2, and channel 3 predicted as channel 0."""
    e = np.full((68, 3), (K_MAX >> 1) + 1)
    stages = staged(attribute_stages(e, {}, ONE_CLASS))
    return b"\1" + prediction_block({3: [(0, 1 << 10)]}, {}, {}) + stages


def _staged_planes() -> Iterator[Vector]:
    layer = make_layer(1, (), before=1, scales=[Scale(5)])
    file, planes = make_file(make_layer(), layer), list(layer.meant.planes[0].values())
    plain = layer.sections[PLANE]

    def of_the_rest(more: int) -> bytes:
        """Stage 0 as long as what is left of the section where its length begins, or longer."""
        said = 0
        for _ in range(3):  # the length's own bytes count
            section = staged_planes(planes, (3, 2), lambda sizes, said=said: [said + more, sizes[1]])  # type: ignore[misc]
            said = len(section) - len(b"\1\3\2")
        return section

    for name, section, error, what in (
        ("form-2", b"\2" + plain[1:], FEATURE, "Form 2 of the planes."),
        ("form-alone", b"\1", MALFORMED, "The section ends after its form."),
        (
            "classes-0",
            staged_planes(planes, (1, 1)).replace(b"\1\1\1", b"\1\1\0", 1),
            MALFORMED,
            "No class in stage 2.",
        ),
        ("classes-9", staged_planes(planes, (9, 1)), LIMIT, "Nine classes in stage 1."),
        (
            "stage-over-rest",
            staged_planes(planes, (3, 2), lambda sizes: [9999, sizes[1]]),
            LIMIT,
            "A stage longer than the section.",
        ),
        (
            "stages-over-rest",
            staged_planes(planes, (3, 2), lambda sizes: [sizes[0] + 60, sizes[1] + 60]),
            MALFORMED,
            "Stages longer than what is left.",
        ),
        (
            "stage-0-short",
            staged_planes(planes, (3, 2), lambda sizes: [sizes[0] - 1, sizes[1]]),
            MALFORMED,
            "Stage 0 is a byte short.",
        ),
        ("stage-of-rest", of_the_rest(0), MALFORMED, "A stage as long as all that its length and the rest take."),
        ("stage-over-rest-by-1", of_the_rest(1), LIMIT, "A stage of a byte more than its length and the rest take."),
        ("stage-left", staged_planes(planes, (3, 2), tail=words(7)), MALFORMED, "A word behind the last stage."),
    ):
        payload = layer.with_sections({PLANE: section}).payload()
        yield _in_layer(1, f"planes-{name}", what, "8.8 8.9", error, payload, file)
    same = make_layer(1, (), before=1, scales=[Scale(3, (1, 1, 1, 1), fill=lambda name, shape: np.full(shape, 4))])
    first, again = coded([[4]] * 12), varint(2 * FIRST_REUSE)
    section = b"\1\1" + varint(len(first)) + first + again * 6
    payload = same.with_sections({PLANE: section}).payload()
    what = "A stage refers to a prior of the stage before."
    yield _in_layer(
        1, "planes-prior-of-earlier-stage", what, "8 8.1 8.8", MALFORMED, payload, make_file(make_layer(), same)
    )


# -- clause 9 ----------------------------------------------------------------------------------------------------------


def _lzma() -> Iterator[Vector]:
    layer = make_layer(0, line(2), mode=LZMA, attributes=pattern(68, 2))
    file, channels = make_file(layer, header={2: LZMA}), layer.channels

    def of(name: str, what: str, error: str, section: bytes) -> Vector:
        payload = layer.with_sections({SYMBOLS: section}).payload()
        return _in_layer(0, f"lzma-{name}", what, "9.1", error, payload, file)

    right = lzma_symbols(channels, width=0, stream=lzma2.packed)
    head = right[2 : 2 + sum(c.size > 0 for c in channels)]
    stored, packed = lzma2.stored, lzma2.packed

    def how(stream) -> bytes:
        return lzma_symbols(channels, width=0, stream=stream)

    def first(value: int) -> bytes:
        return right[:2] + varint(value) + right[3:]

    yield of("note-over-limit", "The first byte is 225.", LIMIT, b"\xe1" + right[1:])
    yield of("flags-reserved", "A reserved bit of the second byte.", MALFORMED, right[:1] + b"\2" + right[2:])
    yield of("flags-high-bit", "The highest bit of the second byte.", MALFORMED, right[:1] + b"\x80" + right[2:])
    yield of("head-alone", "The section ends after its two bytes.", MALFORMED, right[:2])
    yield of("head-cut", "The section ends among the channels' bases.", MALFORMED, right[:20])
    yield of("eight-bytes", "A channel of integers of 8 bytes.", MALFORMED, first(3))
    yield of("base-over-limit", "A base of −K − 1.", LIMIT, first(4 * (2 * K_MAX + 1)))
    steep = make_file(make_layer(mode=LZMA), _steep_plane(LZMA), header={2: LZMA})
    yield bad("lzma-symbol-over-k", "A symbol of K + 1.", "9.1", MALFORMED, steep, chunk=1)
    yield of("nothing-packed", "No stream.", MALFORMED, right[:2] + head)
    yield of("end-alone", "A stream of an end marker.", MALFORMED, right[:2] + head + b"\0")
    yield of("byte-short", "The stream unpacks to a byte less.", MALFORMED, how(lambda d: packed(d[:-1])))
    yield of("byte-long", "The stream unpacks to a byte more.", MALFORMED, how(lambda d: packed(d + b"\0")))
    yield of("stored-short", "Stored chunks of a byte less.", MALFORMED, how(lambda d: stored(d[:-1])))
    yield of(
        "bomb",
        "A stream that unpacks to 2^21 bytes.",
        MALFORMED,
        how(lambda d: packed(d + bytes(lzma2.PACKED_MAX - len(d)))),
    )
    bomb = packed(bytes(lzma2.PACKED_MAX))[:-1]
    yield of(
        "bomb-chunks",
        "A stream that unpacks to more than 2^24 bytes.",
        MALFORMED,
        how(lambda d: packed(d)[:-1] + bomb * 8 + b"\0"),
    )
    yield of("end-missing", "No end marker.", MALFORMED, right[:-1])
    yield of("bytes-after-end", "A byte behind the end marker.", MALFORMED, right + b"\0")
    yield of("cut", "The stream ends in its chunk.", MALFORMED, right[:-9])
    yield of("control-byte", "A reserved control byte.", MALFORMED, how(lambda d: b"\3" + packed(d)[1:]))
    yield of(
        "dictionary-not-reset",
        "The first chunk does not reset the dictionary.",
        MALFORMED,
        how(lambda d: b"\2" + stored(d)[1:]),
    )
    yield of("properties", "lc + lp over 4.", MALFORMED, how(lambda d: packed(d)[:5] + bytes([4 + 9]) + packed(d)[6:]))
    body = how(packed)
    damaged = bytearray(body)
    damaged[-20] ^= 0x40
    yield of("range-coder", "A compressed chunk that does not end where it says.", MALFORMED, bytes(damaged))
    plain = lzma_symbols(channels, width=2, stream=packed)
    yield of("width-lies", "Widths of two bytes over numbers of four.", MALFORMED, _other_widths(plain, len(head)))


def _other_widths(section: bytes, channels: int) -> bytes:
    return section[:2] + bytes(b - 1 for b in section[2 : 2 + channels]) + section[2 + channels :]


def _floats() -> Iterator[Vector]:
    layer = make_layer(1, (), before=1, scales=[Scale()], raw=True)
    file, arrays = make_file(make_layer(), layer, header={3: FLOAT32}), list(layer.meant.tensors())

    def of(name: str, what: str, error: str, section: bytes) -> Vector:
        payload = layer.with_sections({FLOATS: section}).payload()
        return _in_layer(1, f"float32-{name}", what, "9.2", error, payload, file)

    for name, value in (("nan", math.nan), ("infinity", math.inf), ("negative-infinity", -math.inf)):
        for where, at in (("plane", 0), ("weight", -1)):
            changed = [a.copy() for a in arrays]
            changed[at].reshape(-1)[-1] = value
            yield of(f"{name}-in-{where}", f"A {where} holds {value}.", MALFORMED, lzma_floats(changed))
    yield of("value-missing", "A value less.", MALFORMED, lzma_floats([*arrays[:-1], arrays[-1][:-1]]))
    yield of("value-more", "A value more.", MALFORMED, lzma_floats([*arrays, np.zeros(1, np.float32)]))
    right = lzma_floats(arrays)
    yield of("note-over-limit", "The first byte is 225.", LIMIT, b"\xe1" + right[1:])
    yield of("flags-reserved", "A reserved bit of the second byte.", MALFORMED, right[:1] + b"\2" + right[2:])
    yield of("end-missing", "No end marker.", MALFORMED, right[:-1])
    yield of("one-byte", "The section ends after one byte.", MALFORMED, right[:1])


# -- clause 10 ---------------------------------------------------------------------------------------------------------


def _positions() -> Iterator[Vector]:
    half = np.array([0, TOTAL // 2, TOTAL])

    def header(low: tuple[int, int, int], depths: tuple[int, int, int]) -> bytes:
        return struct.pack("<3i3B", *low, *depths)

    def bits(*values: int) -> bytes:
        """A stream of first bits, each as likely as not."""
        return ans_encode([np.array([v]) for v in values], [half] * len(values))

    def of(name: str, what: str, error: str, rows: int, section: bytes) -> Vector:
        layer = make_layer(0, line(rows))
        payload = layer.with_sections({POSITIONS: section}).payload()
        return _in_layer(0, f"positions-{name}", what, "10.1 10.2 14", error, payload, make_file(layer))

    origin, none, one = (0, 0, 0), (0, 0, 0), (1, 0, 0)
    yield of("cut", "The section ends inside the depths.", MALFORMED, 1, header(origin, none)[:14])
    yield of("depth-over-limit", "A depth of 22.", LIMIT, 1, header(origin, (0, 22, 0)))
    yield of("depth-255", "A depth of 255.", LIMIT, 1, header(origin, (0, 0, 255)))
    yield of("more-than-box", "Two anchors in a box of one voxel.", MALFORMED, 2, header(origin, none))
    yield of("many-in-small-box", "Nine anchors in a box of eight voxels.", MALFORMED, 9, header(origin, (1, 1, 1)))
    yield of("stream-of-nothing", "A word where nothing is coded.", MALFORMED, 1, header(origin, none) + words(1))
    yield of("stream-odd", "A byte where nothing is coded.", MALFORMED, 1, header(origin, none) + b"\1")
    yield of("minimum-not-0", "No anchor has the smallest coordinate.", MALFORMED, 1, header(origin, one) + bits(0))
    yield of(
        "depth-too-large",
        "No anchor has a coordinate of as many bits as the depth.",
        MALFORMED,
        1,
        header(origin, one) + bits(1),
    )
    yield of("fewer-than-declared", "One voxel for two anchors.", MALFORMED, 2, header(origin, one) + bits(0, 1))
    four = encode_positions(np.array(line(4), np.int32))
    yield of("more-than-declared", "Four voxels for three anchors.", MALFORMED, 3, four)
    sphere = [c for c in itertools.product(range(9), repeat=3) if abs(sum((v - 4) ** 2 for v in c) - 14) < 3]
    right = make_layer(0, ordered(sphere))
    section = right.sections[POSITIONS]
    file = make_file(right)
    for name, changed, what in (
        ("stream-word-left", section + words(5), "A word behind the stream."),
        ("stream-word-missing", section[:-4], "A stream without its last word."),
        ("stream-cut", section[:15], "No stream at all."),
        ("stream-zero-first", section[:15] + words(0) + section[15:], "A stream that begins with a zero word."),
        ("stream-damaged", section[:20] + bytes([section[20] ^ 8]) + section[21:], "A bit of the stream is flipped."),
    ):
        payload = right.with_sections({POSITIONS: changed}).payload()
        yield _in_layer(0, f"positions-{name}", what, "7.7 10.2", MALFORMED, payload, file)
    for axis, (name, low) in enumerate((("above", MAX_VOXEL + 1), ("below", -MAX_VOXEL - 1), ("far-above", 2**31 - 1))):
        corner = [0, 0, 0]
        corner[axis] = low
        what = f"A voxel index of {low}."
        yield of(f"index-{name}", what, MALFORMED, 1, header(tuple(corner), none))  # type: ignore[arg-type]
    edge = encode_positions(np.array([[MAX_VOXEL, 0, 0], [MAX_VOXEL + 1, 0, 0]], np.int32))
    yield of("index-over-limit", "The second of two voxels lies at 2^20 + 1.", MALFORMED, 2, edge)
    wraps = encode_positions(np.array([[2**31 - 2, 0, 0], [2**31 - 1, 0, 0]], np.int32))
    past = struct.pack("<i", 2**31 - 1) + wraps[4:]
    yield of("index-over-i32", "The second of two voxels lies at 2^31.", MALFORMED, 2, past)


# -- clauses 11 and 12 -------------------------------------------------------------------------------------------------


def _ranges() -> Iterator[Vector]:
    for name, code in (("0", 0), ("1", 1), ("2", 2), ("negative", -3), ("256", 256)):
        layer = make_layer(0, line(3), codes=[77, code, 77])
        what = f"A mask code of {code}."
        yield bad(f"mask-code-{name}", what, "11.1", MALFORMED, make_file(layer), chunk=0)
    base = make_layer(0, line(2), codes=[3, 200])
    for name, rises, what in (
        ("negative", [0, -1], "A mask that falls."),
        ("over-255", [256, 0], "A rise of 256."),
        ("sum-over-255", [0, 56], "A code of 200 and a rise of 56."),
    ):
        file = make_file(base, make_layer(1, (), before=2, rises=rises))
        yield bad(f"mask-rise-{name}", what, "11.1", MALFORMED, file, chunk=1)
    twice = make_file(base, make_layer(1, (), before=2, rises=[100, 50]), make_layer(2, (), before=2, rises=[153, 0]))
    yield bad("mask-sum-over-255-in-layer-2", "Rises of two layers that sum to 256.", "11.1", MALFORMED, twice, chunk=2)

    for sign in (1, -1):
        k = np.full((68, 2), 1, np.int32)
        k[5, 1] = sign * (MAX_SYMBOL + 1)
        name = "above" if sign > 0 else "below"
        what = f"An attribute's symbol of {sign * (MAX_SYMBOL + 1)}."
        yield bad(
            f"attribute-{name}", what, "11.2", MALFORMED, make_file(make_layer(0, line(2), attributes=k)), chunk=0
        )
    networks = constant_networks(0, {0: (10,), 1: (70,), 2: (30,)}, 35)
    networks["color"][0][1][:] = MAX_SYMBOL + 1
    yield bad(
        "weight-above", "A bias of 2^23 + 1.", "11.2 11.4", MALFORMED, make_file(make_layer(networks=networks)), chunk=0
    )

    def plane(predictor: int, *values: int) -> File:
        scale = Scale(
            1, (2, 1, 1, 1), (predictor,) + (0,) * 5, lambda name, shape: np.resize(values, shape).astype(np.int32)
        )
        return make_file(make_layer(), make_layer(1, (), before=1, scales=[scale]))

    yield bad("plane-above", "A sample of 2^23 + 1.", "11.2 11.3", MALFORMED, plane(0, MAX_SYMBOL + 1, 0), chunk=1)
    for predictor, name in ((1, "left"), (3, "median"), (4, "gradient"), (5, "average")):
        what = f"A sample that predictor {predictor} restores to −2^23 − 1."
        yield bad(f"plane-{name}-below", what, "11.2 11.3", MALFORMED, plane(predictor, -9, -MAX_SYMBOL - 1), chunk=1)

    half = 2.0**127
    for key, value, what in ((4, [half] * 3, "attributes"), (5, half, "positions")):
        file = make_file(make_layer(0, line(3)), header={key: value})
        yield bad(f"overflow-{what}", f"A step that makes {what} infinite.", "11.5", MALFORMED, file, chunk=0)
    yield bad(
        "overflow-weights",
        "A step that makes weights infinite.",
        "11.5",
        MALFORMED,
        make_file(make_layer(steps=[LARGEST])),
        chunk=0,
    )
    file = make_file(make_layer(), make_layer(1, (), before=1, scales=[Scale()], steps=[LARGEST, 1.0]))
    yield bad("overflow-planes", "A step that makes planes infinite.", "11.5", MALFORMED, file, chunk=1)

    same = make_file(make_layer(0, line(3)), make_layer(1, [[2, 0, 0]], before=3))
    yield bad("voxel-twice", "A voxel of layer 0 again in layer 1.", "12.1", MALFORMED, same, chunk=1)
    far = make_file(make_layer(0, line(1)), make_layer(1, [[5, 0, 0]], before=1), make_layer(2, [[0, 0, 0]], before=2))
    yield bad("voxel-twice-in-layer-2", "A voxel of layer 0 again in layer 2.", "12.1", MALFORMED, far, chunk=2)
