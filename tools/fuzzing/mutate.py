"""The inputs: legal files of random choices, and mutations of files, of bytes and of parts, after which lengths, the
chunk list, scene ids and CRCs are made right.

Everything is drawn from the given random.Random, so an input is named by its run and its number.
"""

from __future__ import annotations

import copy
import itertools
import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vectors.blocks import PLANE, varint

from pd4dgs_codec.entropy.varint import VARINT_MAX, ByteReader
from pd4dgs_codec.errors import DecodeError, EncodeError
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.container import read_chunk, read_preamble, write_chunk, write_preamble
from pd4dgs_codec.format.deformation import unpack_parameters
from pd4dgs_codec.format.header import scene_id_of
from pd4dgs_codec.format.registry import LAYER_KINDS
from pd4dgs_codec.scene import Widths

from .legal import Seed, legal

SECTIONS = 2  # key of the layer parameters
_POWERS = (7, 8, 12, 14, 15, 16, 20, 21, 22, 23, 24, 26, 28, 31, 32)
#: Around every limit of the format and every width of an integer.
INTEGERS = (0, 1, 2, 3, 4, 5, 10, 30, 68, 70, *(v for p in _POWERS for v in ((1 << p) - 1, 1 << p, (1 << p) + 1)))
REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0**-149, 2.0**-126, 2.0**-20, 2.0**20, 2.0**127, -(2.0**127))
LONGEST_BURST = 64
LEGAL_SHARE = 0.2  #: of the inputs
SEALED_SHARE = 0.6  #: of the others


@dataclass(frozen=True)
class Case:
    """One input. sealed: whether lengths, ids and CRCs were made right after the mutation. recipe: what was done.
    origins: the files that it was made from. meaning: the hashes that a legal file must have; None for any other."""

    data: bytes
    sealed: bool
    recipe: str
    origins: tuple[bytes, ...] = ()
    meaning: list[dict[str, Any]] | None = None


# -- bytes -------------------------------------------------------------------------------------------------------------


def _place(rng: random.Random, data: bytearray) -> int:
    """An offset; half of them near the beginning, where parameters lie."""
    near = len(data) if rng.random() < 0.5 else min(len(data), 40)
    return rng.randrange(near) if near else 0


def flip(rng: random.Random, data: bytearray, other: bytes) -> None:
    """One to eight single bits."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if data:
            data[_place(rng, data)] ^= 1 << rng.randrange(8)


def burst(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A run of other bytes: random, all 0 or all 255."""
    at = _place(rng, data)
    size = min(rng.randint(1, LONGEST_BURST), len(data) - at)
    data[at : at + size] = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size))


def splice(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A run of another file over one of ours, or its tail."""
    if other:
        at, start = _place(rng, data), rng.randrange(len(other))
        run = other[start : start + rng.choice((LONGEST_BURST, len(other)))]
        data[at : at + len(run)] = run


def insert(rng: random.Random, data: bytearray, other: bytes) -> None:
    """Random bytes, or our own once more."""
    at, size = _place(rng, data), rng.randint(1, LONGEST_BURST)
    data[at:at] = rng.randbytes(size) if rng.random() < 0.5 else bytes(data[at : at + size])


def delete(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A run is gone, or all to the end."""
    at = _place(rng, data)
    del data[at : at + rng.choice((1, 1, 2, 4, LONGEST_BURST, len(data)))]


def set_integer(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A little-endian u8, u16 or u32 becomes a number near a limit."""
    at, size = _place(rng, data), rng.choice((1, 2, 4))
    value = rng.choice(INTEGERS) % (1 << 8 * size)
    data[at : at + size] = (value if rng.random() < 0.8 else (1 << 8 * size) - value - 1).to_bytes(size, "little")


def set_varint(rng: random.Random, data: bytearray, other: bytes) -> None:
    """The variable-length integer (a token, a count, a parameter) at some place becomes another one."""
    at = end = _place(rng, data)
    while end < len(data) and data[end] & 0x80:
        end += 1
    data[at : end + 1] = varint(min(rng.choice(INTEGERS) << rng.randrange(2), VARINT_MAX))


CHANGES = (flip, flip, burst, splice, splice, insert, delete, set_integer, set_varint, set_varint)


def change_bytes(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """`data` after one to three changes, whose names are added to `names`."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        change = rng.choice(CHANGES)
        change(rng, changed, other)
        names.append(change.__name__)
    return bytes(changed)


# -- fields ------------------------------------------------------------------------------------------------------------


def _containers(value: Any) -> list[Any]:
    """Every list and map in `value`, itself included."""
    if not isinstance(value, (list, dict)):
        return []
    inside = value.values() if isinstance(value, dict) else value
    return [value, *(c for item in inside for c in _containers(item))]


def _other_value(rng: random.Random, value: Any) -> Any:
    if rng.random() < 0.08:
        return rng.choice((rng.choice(INTEGERS), rng.choice(REALS), True, "text", b"bytes", [], {}, [0] * 20))
    if isinstance(value, float):
        return rng.choice(REALS) if rng.random() < 0.7 else -value
    if isinstance(value, int):
        near = (value + 1, value - 1, 2 * value, -value, value ^ 1 << rng.randrange(12))
        return rng.choice((rng.choice(INTEGERS), *near))
    return rng.choice(INTEGERS)


def change_value(rng: random.Random, tree: dict[int, Any]) -> None:
    """In place, one leaf of `tree` becomes another, or a random list or map gains or loses an entry."""
    containers = _containers(tree)
    places = [(c, key) for c in containers for key in (list(c) if isinstance(c, dict) else range(len(c)))]
    leaves = [(c, key) for c, key in places if not isinstance(c[key], (list, dict))]
    container, key = rng.choice(leaves or places) if places else (tree, None)
    if places and rng.random() < 0.85:
        container[key] = _other_value(rng, container[key])
        return
    container = rng.choice(containers)
    if len(container) and rng.random() < 0.5:
        del container[rng.choice(list(container) if isinstance(container, dict) else range(len(container)))]
    elif isinstance(container, dict):
        container[rng.choice((0, 3, 6, 13, 63, 64, 1000, (1 << 32) - 1))] = rng.choice((0, 1.0, "later", [[[[0]]]]))
    else:
        again = copy.deepcopy(rng.choice(container)) if container else rng.choice(INTEGERS)
        container.insert(rng.randint(0, len(container)), again)


# -- parts -------------------------------------------------------------------------------------------------------------


@dataclass
class Chunk:
    """A chunk. meta, sections: parameters (the section map only with keys that stand for no bytes) and sections of a
    layer, None for other chunks."""

    type: int
    flags: int
    payload: bytes
    meta: dict[int, Any] | None = None
    sections: dict[int, bytes] | None = None

    def packed(self) -> bytes:
        """The payload, written anew if it was taken apart."""
        if self.meta is None or self.sections is None:
            return self.payload
        lengths = {number: len(data) for number, data in sorted(self.sections.items()) if data}
        others = self.meta.get(SECTIONS)
        meta = canonical.pack({**self.meta, SECTIONS: {**(others if isinstance(others, dict) else {}), **lengths}})
        return b"".join([struct.pack("<I", len(meta)), meta, *(self.sections[number] for number in lengths)])


@dataclass
class Parts:
    """A file taken apart."""

    header: dict[int, Any]
    chunks: list[Chunk]


def take_apart(data: bytes) -> Parts:
    """The parts of a valid file, each a copy."""
    preamble = read_preamble(data)
    header, chunks, offset = canonical.unpack(preamble.header), list[Chunk](), preamble.size
    while offset < len(data):
        chunk = read_chunk(data, offset)
        part = Chunk(chunk.type, chunk.flags, chunk.payload)
        if chunk.type < 3:
            (length,) = struct.unpack_from("<I", chunk.payload)
            part.meta, at, part.sections = canonical.unpack(chunk.payload[4 : 4 + length]), 4 + length, {}
            for number in sorted(n for n in part.meta[SECTIONS] if n < 64):
                size = part.meta[SECTIONS].pop(number)
                part.sections[number], at = chunk.payload[at : at + size], at + size
        chunks.append(part)
        offset = chunk.end
    return Parts(header, chunks)


def put_together(parts: Parts, header: bytes | None = None) -> bytes:
    """The file of `parts`, or with other bytes for a header, which may be none. EncodeError if a value has no canonical
    form."""
    payloads = [chunk.packed() for chunk in parts.chunks]
    if header is None:
        rows = [[chunk.type, len(payload)] for chunk, payload in zip(parts.chunks, payloads, strict=True)]
        header = canonical.pack({**parts.header, 1: rows})
    try:
        scene_id = scene_id_of(header)
    except (DecodeError, LookupError, TypeError):  # no header, or no chunk
        scene_id = bytes(8)
    framed = [write_chunk(c.type, c.flags, scene_id, p) for c, p in zip(parts.chunks, payloads, strict=True)]
    return b"".join([write_preamble(header), *framed])


def stages_of(section: bytes, number: int, header: dict[int, Any], meta: dict[int, Any]) -> list[bytes]:
    """The stages of a section, which is one itself unless it holds planes."""
    if number != PLANE:
        return [section]
    reader = ByteReader(section)
    fields, widths = canonical.Fields(meta, "layer", set(meta)), Widths(*header[15][:2])
    shape, _ = unpack_parameters(fields, LAYER_KINDS[1], widths, (), False, "layer")
    count = max(1, (shape.scales[0].channels - 1).bit_length())
    lengths = (reader.varint(VARINT_MAX, "a length") for _ in range(count - 1))
    bounds = list(itertools.accumulate(lengths, initial=0))
    rest = bytes(reader.rest())
    return [rest[start:end] for start, end in itertools.pairwise([*bounds, len(rest)])]


def _layer(rng: random.Random, parts: Parts) -> Chunk | None:
    layers = [chunk for chunk in parts.chunks if chunk.sections]
    return rng.choice(layers) if layers else None


def section_bytes(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Bytes of a section or of one of its stages; lengths follow."""
    chunk = _layer(rng, parts)
    if chunk is None or chunk.sections is None or chunk.meta is None:
        return
    number = rng.choice(list(chunk.sections))
    section = chunk.sections[number]
    try:
        stages = stages_of(section, number, parts.header, chunk.meta)
    except (DecodeError, LookupError, TypeError, ValueError):  # changed before
        stages = [section]
    at = rng.randrange(len(stages))
    names.append(f"section {number}, stage {at}")
    stages[at] = change_bytes(rng, stages[at], rng.choice(stages), names)
    chunk.sections[number] = varint(*(len(s) for s in stages[:-1])) + b"".join(stages)


def section_swap(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A section comes from another layer or file, or is dropped, random, or of zeros."""
    chunk, donor = _layer(rng, parts), _layer(rng, other if rng.random() < 0.6 else parts)
    if chunk is None or chunk.sections is None or donor is None:
        return
    number, size = rng.choice([*chunk.sections, rng.randrange(8)]), rng.randint(1, 200)
    given = (donor.sections or {}).get(number, b"")
    chunk.sections[number] = rng.choice((given, given, b"", rng.randbytes(size), bytes(size), b"\x10" * size))
    names.append(f"section {number} from elsewhere")


def parameters(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A value in the parameters of a layer."""
    chunk = _layer(rng, parts)
    if chunk is not None and chunk.meta is not None:
        change_value(rng, chunk.meta)
        names.append("a layer parameter")


def header_value(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A value in the header; the chunk list is written anew."""
    change_value(rng, parts.header)
    names.append("a header value")


def payload_bytes(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Bytes of a whole payload, its parameters included."""
    chunk = rng.choice(parts.chunks)
    chunk.payload = change_bytes(rng, chunk.packed(), rng.choice(other.chunks).packed(), names)
    chunk.meta = chunk.sections = None
    names.append("in a payload")


def chunks(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Chunks are dropped, doubled, swapped, of another type, flagged, or from another file; then numbered, or not."""
    i, j = rng.randrange(len(parts.chunks)), rng.randrange(len(parts.chunks))
    act = rng.randrange(6)
    if act == 0 and len(parts.chunks) > 1:
        del parts.chunks[i]
    elif act == 1:
        parts.chunks.insert(i, copy.deepcopy(parts.chunks[j]))
    elif act == 2:
        parts.chunks[i], parts.chunks[j] = parts.chunks[j], parts.chunks[i]
    elif act == 3:
        parts.chunks[i].type = rng.choice((0, 1, 2, 3, 99, 65535))
    elif act == 4:
        parts.chunks[i].flags ^= 1 << rng.choice((0, 1, 2, 6, 15))
    else:
        parts.chunks[i] = copy.deepcopy(rng.choice(other.chunks))
    names.append("chunks")
    if act != 4 and rng.random() < 0.7:  # else a changed order of slices hardly gets past the flags
        for kind, run in itertools.groupby(parts.chunks, key=lambda chunk: chunk.type):
            own = list(run)
            for number, chunk in enumerate(own if kind < 3 else ()):
                chunk.flags = number << 6 | 2 * (number + 1 < len(own))
        names.append("renumbered")


PartChange = Callable[[random.Random, Parts, Parts, list[str]], None]
PART_CHANGES: dict[PartChange, int] = {
    section_bytes: 45, section_swap: 10, parameters: 20, header_value: 8, payload_bytes: 12, chunks: 5
}  # fmt: skip


def change_parts(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """A file whose parts were changed, with lengths, chunk list, scene ids and CRCs right again."""
    parts, donor = take_apart(data), take_apart(other)
    try:
        for change in rng.choices([*PART_CHANGES], [*PART_CHANGES.values()], k=rng.choice((1, 1, 1, 2))):
            change(rng, parts, donor, names)
        return put_together(parts)
    except EncodeError:  # a value that has no canonical form, such as one nested too deep
        return data


def change_header_bytes(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """The bytes of the header changed, ids and CRCs right again: msgpack in forms that nobody writes."""
    (size,) = struct.unpack_from("<I", data, 12)
    header = change_bytes(rng, data[20 : 20 + size], other[20:200], names)[:4096]
    names.append("in the header")
    return put_together(take_apart(data), header)


def make_case(seeds: Sequence[Seed], run: int, index: int) -> Case:
    """Input number `index` of a run over these files."""
    rng = random.Random(run << 40 | index)
    if rng.random() < LEGAL_SHARE:
        file = legal(rng)
        return Case(file.data(), True, "a legal file", meaning=file.hashes())
    chosen, donor = rng.choice(seeds), rng.choice(seeds)
    names: list[str] = []
    act = rng.random()
    change = change_header_bytes if act < 0.05 else change_parts if act < SEALED_SHARE else change_bytes
    data, sealed = change(rng, chosen.data, donor.data, names), act < SEALED_SHARE
    recipe = f"{chosen.name}{', sealed' if sealed else ''}: {', '.join(names)}"
    return Case(data, sealed, recipe, (chosen.data, donor.data))
