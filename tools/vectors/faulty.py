"""Vectors that break one rule each."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.limits import (
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
)
from pd4dgs_codec.format.quantise import MAX_SYMBOL
from pd4dgs_codec.scene import Widths

from . import faulty_coding
from .blocks import (
    ATTRIBUTE,
    CAMERA,
    ERROR_BOUNDS,
    FEATURE,
    FLOAT32,
    FLOATS,
    HEADER,
    LIMIT,
    LZMA,
    MALFORMED,
    MASKS,
    PLANE,
    POSITIONS,
    SYMBOLS,
    WEIGHTS,
    File,
    Layer,
    Scale,
    Vector,
    ancillary,
    bad,
    coded,
    in_layer,
    lzma_floats,
    lzma_symbols,
    make_file,
    make_layer,
    plain_attributes,
    plain_planes,
    plane_channels,
)
from .valid import LEAST_NORMAL, line, rows_at_limit, symbols_at_limit, three_layers

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
    for part in (*parts, _sections, _sizes):
        yield from part()
    yield from faulty_coding.cases()


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
    short = replace(plain, signature=b"GIF89a")
    yield bad("signature-short", "A short file of another kind.", "3.1", "BadSignature", short, at=SIGNATURE, size=6)
    for major in (0, 1, 3, 65535):
        what = f"Major version {major}."
        yield bad(f"version-major-{major}", what, "3.1", "UnsupportedVersion", replace(plain, major=major), at=VERSION)
    for name, size in (("over-limit", MAX_HEADER + 1), ("largest", 2**32 - 1)):
        what = f"The header's length says {size}."
        yield bad(f"header-length-{name}", what, "3.1 14", LIMIT, replace(plain, declared=size), at=HEADER_LENGTH)
    filled = plain.with_header({64: b"\0" * (MAX_HEADER - 200)})
    over = plain.with_header({64: b"\0" * (MAX_HEADER - 199 + MAX_HEADER - len(filled.header_bytes()))})
    yield bad("header-over-limit", "A header of 2^14 + 1 bytes.", "3.1 14", LIMIT, over, at=HEADER_LENGTH)
    short = replace(plain, declared=len(plain.header_bytes()) - 1)
    yield bad(
        "header-length-short", "The header's length is a byte short.", "3.1", "ChecksumMismatch", short, at=HEADER_CRC
    )
    beyond = replace(plain, declared=1 << 12)
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
    for bit in (2, 5):
        what = f"Reserved flag bit {bit}."
        yield bad(
            f"chunk-flag-{bit}", what, "3.2 2.3", MALFORMED, file.with_chunk(1, flags=1 << bit), chunk=1, at=FLAGS
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
    whole = hashlib.sha256(file.header_bytes()).digest()[:8]
    alone = replace(file, chunks=tuple(replace(c, scene_id=whole) for c in file.chunks))
    what = "A scene id of the header with its chunk list."
    yield bad("scene-id-with-chunk-list", what, "3.3", MALFORMED, alone, chunk=0, at=SCENE_ID)
    for name, value in (("short", bytes(15)), ("long", bytes(17)), ("text", "x" * 16)):
        what = f"A digest of {len(value)} bytes." if name != "text" else "A digest that is a string."
        yield bad(f"digest-{name}", what, "5.5", MALFORMED, file.with_header({14: value}))
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
    again = make_file(*(file.layer(i) for i in range(2)))
    spliced = file.with_chunk(1, scene_id=again.scene_id)
    what = "Layer 1 is from another encode, which had no layer 2."
    yield bad("splice-encode", what, "3.3 5.5", MALFORMED, spliced, chunk=1, at=SCENE_ID)
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
    what, at = "The CRC-32 of an ancillary chunk.", PAYLOAD + 1
    yield bad("crc-ancillary", what, "3.2 3.4", "ChecksumMismatch", broken, chunk=2, at=at)
    reserved = replace(file, chunks=(*file.chunks, replace(ancillary(9), flags=3)))
    yield bad(
        "ancillary-flag-1", "A reserved flag of an ancillary chunk.", "3.2 3.4", MALFORMED, reserved, chunk=3, at=FLAGS
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
        yield bad(f"cut-at-{size:03}", what, "3.1 12.3 15", "Truncated", file, size=size)
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
            yield bad(f"cut-layer-{c}-{name}", what, "3.2 12.3 15", "Truncated", file, chunk=c, size=start + cut)
    missing = replace(file, chunks=(*file.chunks, ancillary(9)))
    yield bad(
        "cut-ancillary",
        "An ancillary chunk of the list is not there.",
        "3.2 12.3",
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
        "key-twice": (
            _with_entry(packed, "0f", canonical.pack(plain.fields()[15]).hex()),
            "A key of the header twice.",
        ),
        "keys-descend": (
            _with_entry(plain.with_header({11: None}).header_bytes(), "0b", canonical.pack(HEADER[11]).hex()),
            "Keys of the header out of order.",
        ),
        "key-not-shortest": (_with_entry(packed, "cc40", "00"), "A key of the header as uint 8."),
        "map16": (b"\xde\0" + bytes([packed[0] & 15]) + packed[1:], "The header as map 16."),
        "map32": (b"\xdf\0\0\0" + bytes([packed[0] & 15]) + packed[1:], "The header as map 32."),
        "list": (canonical.pack(list(HEADER.values())), "The header is a list."),
        "integer": (b"\0", "The header is an integer."),
        "empty": (b"", "The header is empty."),
        "empty-map": (b"\x80", "The header is a map of nothing."),
        "trailing-byte": (packed + b"\0", "A byte follows the header's map."),
        "cut": (_with_entry(packed, "40", "c403aabb"), "The header's map lacks its last byte."),
        "entry-missing": (bytes([packed[0] + 1]) + packed[1:], "The header's map lacks its last entry."),
        "entry-uncounted": (packed + bytes.fromhex("4000"), "The header's map has an entry more than it says."),
    }
    up, unit = (canonical.pack(HEADER[key]) for key in (10, 11))
    for name, entry, value, what in (
        ("up-nan", up, "93ca00000000ca7fc00000ca00000000", "A coordinate of up is NaN."),
        ("unit-infinity", unit, "ca7f800000", "The unit is infinite."),
        ("unit-float64", unit, "cb3ff8000000000000", "The unit is a float 64."),
        ("unit-nil", unit, "c0", "The unit is nil."),
    ):
        entries[name] = (packed.replace(entry, bytes.fromhex(value)), what)
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
        ("list", lambda p: canonical.pack([*canonical.unpack(p).values()]), "A list instead of a map."),
    ):
        payload = layer.payload(pack=lambda m, change=change: change(canonical.pack(m)))
        what = f"Layer parameters: {what}"
        yield bad(f"layer-{name}", what, "4 6.2", MALFORMED, plain.with_payload(0, payload), chunk=0)


# -- clause 5 ----------------------------------------------------------------------------------------------------------


def _header() -> Iterator[Vector]:
    plain = _plain()
    for key in (*range(2, 12), 13, 14):
        what = f"Key {key} is missing."
        yield bad(f"header-key-{key:02}-missing", what, "4 5.1", MALFORMED, plain.with_header({key: None}))
    without = canonical.pack({k: v for k, v in plain.fields().items() if k != 1})
    yield bad("header-key-01-missing", "Key 1 is missing.", "4 5.1", MALFORMED, replace(plain, packed=without))
    for key in (0, 18, 63):
        what = f"Unknown key {key}."
        yield bad(f"header-key-{key:02}-unknown", what, "4 17.2", FEATURE, plain.with_header({key: 1}))
    graded = make_file(make_layer(classes=[3]))
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
        ("slots-zero", 15, [32, 0], MALFORMED),
        ("slots-real", 15, [32, 10.0], MALFORMED),
        ("widths-one", 15, [32], MALFORMED),
        ("widths-integer", 15, 32, MALFORMED),
        ("centres-67", 16, [0] * 67, MALFORMED),
        ("centres-69", 16, [0] * 69, MALFORMED),
        ("centres-reals", 16, [0.0] * 68, MALFORMED),
        ("centre-over-limit", 16, [*[0] * 67, MAX_SYMBOL + 1], LIMIT),
        ("centre-under-limit", 16, [-MAX_SYMBOL - 1, *[0] * 67], MALFORMED),
    ]
    for name, key, value, error in values:
        what = f"Header key {key} is {value!r}."
        given = graded if key == 16 else plain
        yield bad(f"header-{name}", what, "5.1", error, given.with_header({key: value}))
    for name, widths, error in (
        ("feature-width-zero", Widths(0, 10), MALFORMED),
        ("feature-width-over-limit", Widths(65, 10), LIMIT),
        ("slots-over-limit", Widths(32, 17), LIMIT),
    ):
        what = f"Widths {widths.feature} and {widths.slots}, and a layer that has them."
        yield bad(f"header-{name}", what, "5.1", error, make_file(make_layer(widths=widths)))


def _chunk_list() -> Iterator[Vector]:
    plain = _plain()
    size = len(plain.chunks[0].payload)
    lists: list[tuple[str, object, str, str]] = [
        ("empty", [], MALFORMED, "No chunk is listed."),
        ("integer", 1, MALFORMED, "The list is an integer."),
        ("real", 1.0, MALFORMED, "The list is a real."),
        ("1025", [[0, size], *[[9, 0]] * MAX_CHUNKS], LIMIT, "1025 chunks."),
        ("pair-of-one", [[0]], MALFORMED, "A chunk without a length."),
        ("pair-of-three", [[0, size, 0]], MALFORMED, "A chunk with an offset."),
        ("pair-integer", [0], MALFORMED, "A chunk that is an integer."),
        ("type-over-limit", [[0, size], [65536, 0]], LIMIT, "Type 65536."),
        ("type-negative", [[0, size], [-1, 0]], MALFORMED, "Type −1."),
        ("type-real", [[0.0, size]], MALFORMED, "A type that is a real."),
        ("length-over-limit", [[0, MAX_PAYLOAD + 1]], LIMIT, "A payload of 2^31 bytes."),
        ("length-negative", [[0, size], [9, -1]], MALFORMED, "A payload of −1 bytes."),
    ]
    for name, value, error, what in lists:
        yield bad(f"chunk-list-{name}", what, "5.2", error, replace(plain, header={**HEADER, 1: value}))
    boolean = replace(plain, chunks=(*plain.chunks, ancillary(9)), header={**HEADER, 1: [[0, size], [9, False]]})
    yield bad("chunk-list-length-boolean", "A length that is a boolean.", "5.2", MALFORMED, boolean)
    base, one = make_layer(), make_layer(1, line(1, z=5))
    second = make_layer(1, line(1, z=6), before=2)
    for name, layers, what in (
        ("without-layer-0", (one,), "Layer 1 alone."),
        ("layer-0-second", (one, make_layer(before=1)), "Layer 0 behind layer 1."),
        ("descends", (base, make_layer(2, line(1, z=5), before=1), second), "Layer 2 before layer 1."),
    ):
        yield bad(f"chunk-list-{name}", what, "5.2", MALFORMED, make_file(*layers))
    early = replace(plain, chunks=(ancillary(9), *plain.chunks))
    yield bad("chunk-list-ancillary-first", "An ancillary chunk before layer 0.", "5.2", MALFORMED, early)
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
    yield bad("camera-list", "The camera is a list.", "5.3", MALFORMED, plain.with_header({12: list(CAMERA.values())}))


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
    """A vector whose fault lies in the payload of one layer of `file`, three layers unless another is given."""
    return in_layer(layer, name, what, clauses, error, payload, file or three_layers())


def _layout() -> Iterator[Vector]:
    plain = _plain()
    payload = plain.chunks[0].payload
    size = struct.unpack_from("<I", payload)[0]
    for name, bytes_, what in (
        ("empty", b"", "An empty payload."),
        ("three-bytes", payload[:3], "A payload of three bytes."),
        ("byte-left", payload + b"\0", "A byte behind the sections."),
        ("byte-missing", payload[:-1], "The last section lacks a byte."),
        ("sections-cut", payload[: 4 + size], "No byte of any section."),
    ):
        yield _in_layer(0, f"payload-{name}", what, "6.1", MALFORMED, bytes_, plain)
    for name, bytes_, what in (
        ("parameters-empty", bytes(4), "Parameters of no bytes."),
        (
            "parameters-short",
            struct.pack("<I", size - 1) + payload[4:],
            "The length of the parameters is a byte short.",
        ),
    ):
        yield _in_layer(0, f"payload-{name}", what, "4 6.1", MALFORMED, bytes_, plain)
    bare = make_file(make_layer(cells=()), make_layer(1, ()))
    own = bare.chunks[1].payload
    beyond, what = struct.pack("<I", len(own) - 3) + own[4:], "Parameters a byte longer than the payload."
    yield _in_layer(1, "payload-parameters-beyond", what, "6.1", MALFORMED, beyond, bare)
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
        ("section-length-text", length(MASKS, "3"), MALFORMED, "A length that is a string."),
        ("section-unknown", length(8, 1), FEATURE, "Section 8."),
        ("section-63-unknown", length(63, 1), FEATURE, "Section 63."),
        ("steps-missing", without(3), MALFORMED, "Layer 0 without steps."),
        ("steps-two", put(3, [1.0, 1.0]), MALFORMED, "Layer 0 with two steps."),
        ("steps-none", put(3, []), MALFORMED, "Layer 0 with an empty list of steps."),
        ("step-zero", put(3, [0.0]), MALFORMED, "A step of 0."),
        ("step-subnormal", put(3, [SUBNORMAL]), MALFORMED, "A subnormal step."),
        ("step-integer", put(3, [1]), MALFORMED, "A step that is an integer."),
        ("scales-in-layer-0", put(4, [[1] * 5 + [0] * 6]), MALFORMED, "Planes in layer 0."),
        ("key-unknown", put(7, 1), FEATURE, "Unknown key 7."),
        ("key-0-unknown", put(0, 1), FEATURE, "Unknown key 0."),
        ("key-63-unknown", put(63, []), FEATURE, "Unknown key 63."),
    ]
    for name, change, error, what in zero:
        yield _in_layer(0, f"layer-0-{name}", what, "6.2", error, layer.payload(change), plain)  # type: ignore[arg-type]
    payload, what = layer.payload(length(MASKS, MAX_PAYLOAD)), "A section longer than the payload."
    yield _in_layer(0, "layer-0-section-length-largest", what, "6.1 6.2", MALFORMED, payload, plain)
    for name, meta, what in (
        ("bare", {1: 1}, "Layer 0 without steps, networks and weights."),
        ("networks-missing", {1: 1, 3: layer.meta[3]}, "Layer 0 with steps, but without networks and weights."),
    ):
        payload = replace(layer, meta=meta).with_sections({WEIGHTS: None}).payload()
        yield _in_layer(0, f"layer-0-{name}", what, "6.2", MALFORMED, payload, plain)
    unweighted = deformed.with_sections({PLANE: None, WEIGHTS: None})
    one: list[tuple[str, Layer, object, str, str]] = [
        ("rows-over-limit", deformed, put(1, MAX_ANCHORS - 2), LIMIT, "More than 2^24 anchors with those of layer 0."),
        ("steps-missing", deformed, without(3), MALFORMED, "A deformation without steps."),
        ("steps-one", deformed, put(3, [1.0]), MALFORMED, "A deformation with one step."),
        ("steps-three", deformed, put(3, [1.0] * 3), MALFORMED, "A deformation with three steps."),
        ("scales-missing", deformed, without(4), MALFORMED, "A deformation without planes."),
        ("networks-missing", unweighted, without(5), MALFORMED, "Steps and planes without networks."),
        ("steps-alone", bare, put(3, [1.0, 1.0]), MALFORMED, "Steps without a deformation."),
        ("scales-alone", bare, put(4, [[1] * 5 + [0] * 6]), MALFORMED, "Planes without steps and networks."),
    ]
    for name, which, change, error, what in one:
        yield _in_layer(1, f"layer-1-{name}", what, "6.2", error, which.payload(change))  # type: ignore[arg-type]
    payload = unweighted.payload(put(5, []))
    yield _in_layer(1, "layer-1-networks-empty", "An empty list of networks.", "6.3 6.2", MALFORMED, payload)


def _scales() -> Iterator[Vector]:
    layer, plain = three_layers().layer(1), [2, 3, 2, 4, 2] + [0] * 6
    values: list[tuple[str, object, str, str]] = [
        ("integer", 1, MALFORMED, "The scales are an integer."),
        ("nine", [plain] * (MAX_PLANE_SCALES + 1), LIMIT, "Nine scales."),
        ("entry-long", [[*plain, 0]], MALFORMED, "A scale of twelve numbers."),
        ("channels-over-limit", [[MAX_PLANE_CHANNELS + 1, *plain[1:]]], LIMIT, "257 channels."),
        ("side-over-limit", [[*plain[:4], MAX_PLANE_SIDE + 1, *plain[5:]]], LIMIT, "A side of 4097."),
        ("side-real", [[2, 3.0, *plain[2:]]], MALFORMED, "A side that is a real."),
        ("predictor-unknown", [[*plain[:-1], 6]], FEATURE, "Predictor 6."),
        ("predictor-largest", [[*plain[:-1], 2**64 - 1]], FEATURE, "Predictor 2^64 − 1."),
        ("predictor-negative", [[*plain[:-1], -1]], FEATURE, "Predictor −1."),
        ("predictor-boolean", [[*plain[:-1], False]], MALFORMED, "A predictor that is a boolean."),
    ]
    for name, value, error, what in values:
        yield _in_layer(1, f"scales-{name}", what, "6.3", error, layer.payload(lambda m, value=value: {**m, 4: value}))
    base, networks = make_layer(), {0: (3,), 1: (3,)}
    none = make_layer(1, (), before=1, networks=networks, steps=[0.5, 0.5])
    five = make_layer(1, (), before=1, scales=[Scale()])
    planes = list(five.meant.planes[0].values())[:5]
    fewer = five.with_sections({PLANE: plain_planes(c for plane in planes for c in plane_channels(plane))})
    for name, layer, change, what in (
        ("empty", none, lambda m: {**m, 4: []}, "No scale."),
        ("entry-short", fewer, lambda m: {**m, 4: [m[4][0][:-1]]}, "A scale of ten numbers and five planes."),
        ("channels-zero", make_layer(1, (), before=1, scales=[Scale(0)]), lambda m: m, "No channels."),
        ("side-zero", make_layer(1, (), before=1, scales=[Scale(2, (3, 2, 0, 2))]), lambda m: m, "A side of 0."),
        (
            "channels-differ",
            make_layer(1, (), before=1, scales=[Scale(2), Scale(1)]),
            lambda m: m,
            "Scales of two and one channels.",
        ),
    ):
        ordered_keys = layer.payload(lambda m, change=change: dict(sorted(change(m).items())))
        yield _in_layer(1, f"scales-{name}", what, "6.3", MALFORMED, ordered_keys, make_file(base, layer))


def _networks() -> Iterator[Vector]:
    plain, file = _plain(), three_layers()
    good = [[0, 10], [1, 70], [2, 30]]
    zero: list[tuple[str, object, str, str]] = [
        ("integer", 1, MALFORMED, "The networks are an integer."),
        ("entry-empty", [[], *good[1:]], MALFORMED, "An entry without an id."),
        ("entry-integer", [1, *good[1:]], MALFORMED, "An entry that is an integer."),
        ("id-unknown", [*good[:2], [3, 30]], FEATURE, "Network 3 in layer 0."),
        ("id-negative", [[-1, 10], *good[1:]], FEATURE, "Network −1."),
        ("id-largest", [*good[:2], [2**64 - 1, 30]], FEATURE, "Network 2^64 − 1."),
        ("id-real", [[0.0, 10], *good[1:]], MALFORMED, "An id that is a real."),
        ("four", [*good, [3, 1]], FEATURE, "Network 3 beside the others."),
        ("descend", good[::-1], MALFORMED, "Networks in descending order."),
        ("twice", [good[0], *good], MALFORMED, "A network twice."),
        ("outputs", [[0, 11], *good[1:]], MALFORMED, "Eleven opacities."),
        ("width-over-limit", [[0, MAX_NETWORK_WIDTH + 1, 10], *good[1:]], LIMIT, "A hidden layer of 4097 outputs."),
        ("17-layers", [[0, *[1] * MAX_NETWORK_LAYERS, 10], *good[1:]], LIMIT, "17 linear layers."),
    ]
    for name, value, error, what in zero:
        payload = make_layer().payload(lambda m, value=value: {**m, 5: value})
        yield _in_layer(0, f"networks-{name}", what, "6.3", error, payload, plain)
    scaffold = make_layer()
    whole: list[tuple[str, int, Layer, str]] = [
        ("empty", 0, replace(scaffold, meta={**scaffold.meta, 5: []}).with_sections({WEIGHTS: None}), "No network."),
        ("two", 0, make_layer(networks={0: (10,), 1: (70,)}), "Layer 0 without its color network."),
        ("width-zero", 0, make_layer(networks={0: (0, 10), 1: (70,), 2: (30,)}), "A hidden layer of no outputs."),
        (
            "trunk-alone",
            1,
            make_layer(1, (), before=1, scales=[Scale()], networks={0: (3,)}),
            "A trunk without a head.",
        ),
    ]
    for name, number, layer, what in whole:
        others = (layer,) if number == 0 else (make_layer(), layer)
        yield bad(f"networks-{name}", what, "6.3", MALFORMED, make_file(*others), chunk=number)
    one: list[tuple[str, object, str, str]] = [
        ("without-trunk", [[1, 3], [2, 32]], MALFORMED, "Heads without a trunk."),
        ("without-layers", [[0], [1, 3]], MALFORMED, "A trunk without linear layers."),
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
    over, what = symbols_at_limit(over=1, rows=2), "One symbol more, those of own and of earlier rows counted."
    yield bad("symbols-of-rows-over-limit", what, "6.5", LIMIT, over, chunk=1)
    over, what = symbols_at_limit(over=1, rows=2, graded=True), "One symbol more, step classes counted."
    yield bad("symbols-of-step-classes-over-limit", what, "6.5", LIMIT, over, chunk=1)
    crowd = rows_at_limit(over=1)
    yield bad("rows-over-limit", "One anchor more than the payload may declare.", "6.5 14", LIMIT, crowd, chunk=0)
    halves = make_file(make_layer(0, line(6000)), make_layer(1, line(6000, z=5), before=6000))
    what = "6000 anchors in either of two layers, together more than their payloads may declare."
    yield bad("rows-of-layers-over-limit", what, "6.5", LIMIT, halves, chunk=1)
    layer, file = make_layer(), _plain()
    for name, rows in (("rows", 1 << 15), ("most-rows", 58_000)):  # the other bounds let both pass
        payload = layer.payload(lambda m, rows=rows: {**m, 1: rows})
        what = f"{rows} anchors, constant in every channel, in a few bytes."
        yield _in_layer(0, f"bomb-{name}", what, "6.5", LIMIT, payload, file)
    deformed = three_layers().layer(1)
    for name, scale, what in (
        ("cells", [64, 1024, 1024, 1, 1], "2^26 plane cells in a few bytes."),
        ("most-cells", [256, 4096, 4096, 4096, 4096], "25 times 10^9 plane cells in a few bytes."),
    ):
        payload = deformed.payload(lambda m, scale=scale: {**m, 4: [[*scale, *[0] * 6]]})
        yield _in_layer(1, f"bomb-{name}", what, "6.5", LIMIT, payload)
    payload = deformed.payload(lambda m: {**m, 4: [[16, 4096, 4096, 1, 1, *[0] * 6]]})
    yield _in_layer(1, "samples-over-limit", "More than 2^28 plane samples.", "6.5 14", LIMIT, payload)
    wide = [[0, *[4096] * 15, 10], [1, 70], [2, 30]]
    payload = layer.payload(lambda m: {**m, 5: wide})
    yield _in_layer(0, "bomb-weights", "Over 2^27 constant weights in a few bytes.", "6.5", LIMIT, payload, file)
    scales = [[1, 4096, 4096, 1, 1, *[0] * 6]] * 8
    payload = deformed.payload(lambda m: {**m, 4: scales})
    yield _in_layer(1, "bomb-scales", "Eight scales of constant planes.", "6.5", LIMIT, payload)
