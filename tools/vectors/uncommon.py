"""Vectors that conform although no encoder of today writes them: a decoder must read them all the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.limits import MAX_CHUNKS, MAX_HEADER, MAX_PARAMETERS

from .blocks import (
    CAMERA,
    ERROR_BOUNDS,
    Chunk,
    File,
    Scale,
    Vector,
    ancillary,
    good,
    make_file,
    make_layer,
    varint,
)
from .valid import rows_at_limit, three_layers

FIRST_PRIVATE = 1 << 15
#: A value of every form that canonical msgpack has, nested as deep as a value in the header may be.
EVERY_FORM: list = [
    [0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**64 - 1],
    [-1, -32, -33, -128, -129, -32768, -32769, -(2**31), -(2**31) - 1, -(2**63)],
    [True, False, 0.5, -0.0, 2.0**-149],
    ["", "é" * 15, "x" * 31, "x" * 32, "x" * 255, "x" * 256, b"", b"\xff" * 255, b"\0" * 256],
    [[], {}, {0: 1, 2**32 - 1: 2}, [0] * 15, [0] * 16, {i: i for i in range(15)}, {i: i for i in range(16)}],
]


def cases() -> Iterator[Vector]:
    """All vectors under uncommon/."""
    for name, sentence, clauses, file in _cases():
        yield good("uncommon/" + name, sentence, clauses, file)


def _between(*chunks: Chunk) -> File:
    """Three layers with these chunks behind layer 0."""
    file = three_layers()
    return replace(file, chunks=(file.chunks[0], *chunks, *file.chunks[1:]))


def _cases() -> Iterator[tuple[str, str, str, File]]:
    plain, layers = make_file(make_layer()), three_layers()
    yield "version-minor-1", "Minor version 1.", "3.1", replace(plain, minor=1)
    yield "version-minor-65535", "The largest minor version.", "3.1", replace(plain, minor=65535)
    empty, some = ancillary(4), ancillary(FIRST_PRIVATE, b"private")
    yield "ancillary-empty", "An empty ancillary chunk of a type kept for the text.", "3.4 17.1", _between(empty)
    yield "ancillary-private", "An ancillary chunk of a private type.", "3.4 17.1", _between(some)
    about = canonical.pack({1: "Kitchen", 3: "CC BY 4.0"})
    frame = b"\x28\xb5\x2f\xfd\x20" + bytes([len(about)]) + (8 * len(about) + 1).to_bytes(3, "little") + about
    for name, payload, what in (
        ("", frame, "A title and a licence, in a zstandard frame of one raw block."),
        ("-cut", frame[:-1], "Metadata that cannot be read: no fault of the file."),
        ("-bomb", frame[:4] + b"\xe0" + bytes([255] * 8), "Metadata that states 2^64 − 1 bytes: no fault of the file."),
    ):
        yield f"metadata{name}", what, "3.5 3.4", _between(ancillary(3, payload))
    last = ancillary(65535, bytes(range(256)))
    yield (
        "ancillary-last",
        "An ancillary chunk of the largest type behind all layers.",
        "3.4",
        replace(layers, chunks=(*layers.chunks, last)),
    )
    yield "ancillary-same-type", "Two ancillary chunks of one type.", "3.4 5.2", _between(some, some)
    yield (
        "ancillary-types-descend",
        "Ancillary types in no order between layers.",
        "3.4 5.2",
        _between(last, some, empty),
    )
    looks = ancillary(4, layers.chunks[1].payload)
    yield "ancillary-like-a-layer", "An ancillary chunk with the payload of layer 1 in it.", "3.4", _between(looks)
    yield (
        "ancillary-only",
        "Layer 0 and ancillary chunks.",
        "3.4",
        replace(plain, chunks=(*plain.chunks, some, empty, last)),
    )
    most = tuple(ancillary(3 + i) for i in range(MAX_CHUNKS - 3))
    yield "chunks-1024", "1024 chunks.", "5.2 14", _between(*most)

    yield (
        "header-unknown-keys",
        "Keys from 64 on with a value of every form.",
        "4 17.2",
        plain.with_header({64: EVERY_FORM, 255: 1, 256: 1, 65536: [], 2**32 - 1: {}}),
    )
    full = plain.with_header({64: b"\0" * 300})
    rest = MAX_HEADER - len(full.header_bytes())
    yield "header-longest", "A header of 2^14 bytes.", "3.1 14", plain.with_header({64: b"\0" * (300 + rest)})
    camera = {12: {**CAMERA, 64: "lens", 1000: [1.0]}}
    yield "camera-unknown-keys", "Keys from 64 on in the camera.", "4 5.3", plain.with_header(camera)
    bounds = {13: {**ERROR_BOUNDS, 64: "a class to come", 1000: 1}}
    digest = {14: layers.fields()[14]}
    fewer = replace(layers, chunks=layers.chunks[:2]).with_header(digest)
    yield "layer-2-left-out", "Layer 2 was left out later: the digest is that of all three.", "3.3 5.5", fewer
    yield "bounds-unknown-keys", "Keys from 64 on in the error bounds.", "4 5.4", plain.with_header(bounds)
    layer = layers.layer(1)
    extended = layer.payload(lambda m: {**m, 64: [1, 2], 70000: {5: "x"}})
    yield "layer-unknown-keys", "Keys from 64 on in the layer parameters.", "4 6.2", layers.with_payload(1, extended)
    longest = layers.with_payload(1, layer.padded(MAX_PARAMETERS))
    yield "layer-parameters-longest", "Layer parameters of 4096 bytes.", "6.1 14", longest
    yield "rows-at-limit", "As many anchors as the payload may declare.", "6.5 14", rows_at_limit()
    noted = layer.payload(lambda m: {**m, 2: {**m[2], 64: 7, 65: "no length", 2**32 - 1: -1}})
    yield (
        "layer-unknown-sections",
        "Keys from 64 on in the section map stand for no bytes.",
        "6.2",
        layers.with_payload(1, noted),
    )

    tail = layers.chunks[0], layers.chunks[2]
    skipped = make_layer(2, (), before=3, scales=[Scale()])
    two = replace(layers, chunks=(tail[0], some, replace(tail[1], payload=skipped.payload(), layer=skipped)))
    yield "layers-0-2-around-ancillary", "An ancillary chunk where layer 1 could stand.", "3.4 5.2", two
    own = make_layer(0, [[0, 0, 0]], codes=[77])
    again = own.with_sections({4: b"".join(b"\0" + varint(4) for _ in range(6))})
    networks = {n: tuple((w * 0 + 2, b * 0 + 2) for w, b in pairs) for n, pairs in own.meant.networks.items()}
    again = replace(again, meant=replace(again.meant, networks=networks))
    yield "prior-defined-twice", "Channels that define equal priors again.", "8.1 16", make_file(again)
