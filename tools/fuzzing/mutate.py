"""Mutations of `.pd4` files: of bytes as they lie, and of parts, with lengths, ids and checksums repaired afterwards.

Everything is drawn from the given random.Random, so an input is named by its seed and index.
"""

from __future__ import annotations

import copy
import itertools
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fuzzing.files import Chunk, Parts, Seed, put_together, take_apart, take_stages
from pd4dgs_codec.entropy.varint import put_varint
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.container import (
    CHUNK_HEAD_SIZE,
    FLAG_MORE,
    SIGNATURE,
    read_chunk,
    read_preamble,
    slice_flags,
)
from pd4dgs_codec.format.header import STEPS, VOXEL_SIZE
from pd4dgs_codec.format.kinds import BY_CHUNK_TYPE
from pd4dgs_codec.format.layer_meta import Section

_POWERS = (7, 8, 12, 14, 15, 16, 20, 21, 22, 23, 24, 26, 28, 31, 32)
#: Around every limit of the format and every width of an integer.
INTEGERS = (0, 1, 2, 3, 4, 5, 10, 30, 68, 70, *(v for p in _POWERS for v in ((1 << p) - 1, 1 << p, (1 << p) + 1)))
REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0**-149, 2.0**-126, 2.0**-20, 2.0**20, 2.0**127, -(2.0**127))
OVERFLOWING = 2.0**127  #: a step of which two are not finite
LONGEST_BURST = 64
REPAIRED_SHARE = 0.6  #: of the inputs


@dataclass(frozen=True)
class Case:
    """One input. repaired: whether checksums were made right after the mutation; recipe: what was done."""

    data: bytes
    repaired: bool
    recipe: str


# -- bytes -------------------------------------------------------------------------------------------------------------

Change = Callable[[random.Random, bytearray, bytes], None]


def _place(rng: random.Random, data: bytearray) -> int:
    """An offset. In a section, half of them are near the beginning, where parameters lie."""
    near = len(data) if data[:4] == SIGNATURE[:4] or rng.random() < 0.5 else min(len(data), 40)
    return rng.randrange(near) if near else 0


def flip(rng: random.Random, data: bytearray, other: bytes) -> None:
    """One to eight single bits."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if data:
            data[_place(rng, data)] ^= 1 << rng.randrange(8)


def burst(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A run of other bytes: random, all 0 or all 255."""
    at, size = _place(rng, data), rng.randint(1, LONGEST_BURST)
    size = min(size, len(data) - at)
    data[at : at + size] = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size))


def swap(rng: random.Random, data: bytearray, other: bytes) -> None:
    """Two runs of equal length change places."""
    a, b, size = _place(rng, data), _place(rng, data), rng.choice((1, 1, 2, 4, 16))
    a, b = min(a, b), max(a, b)
    size = min(size, b - a, len(data) - b)
    data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]


def splice(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A part of another file: its tail from some place on, or a run of it over one of ours."""
    if not other:
        return
    at, start = _place(rng, data), rng.randrange(len(other))
    if rng.random() < 0.5:
        data[at:] = other[at if rng.random() < 0.5 else start :]
    else:
        run = other[start : start + rng.randint(1, LONGEST_BURST)]
        data[at : at + len(run)] = run


def insert(rng: random.Random, data: bytearray, other: bytes) -> None:
    """Random bytes, or our own once more."""
    at, size = _place(rng, data), rng.randint(1, LONGEST_BURST)
    data[at:at] = rng.randbytes(size) if rng.random() < 0.5 else bytes(data[at : at + size])


def delete(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A run is gone."""
    at = _place(rng, data)
    del data[at : at + rng.choice((1, 1, 2, 4, LONGEST_BURST))]


def truncate(rng: random.Random, data: bytearray, other: bytes) -> None:
    """The end is gone."""
    del data[_place(rng, data) :]


def set_integer(rng: random.Random, data: bytearray, other: bytes) -> None:
    """A little-endian u8, u16 or u32 becomes a number near a limit."""
    at, size = _place(rng, data), rng.choice((1, 2, 4))
    value = rng.choice(INTEGERS) % (1 << 8 * size)
    data[at : at + size] = (value if rng.random() < 0.8 else (1 << 8 * size) - value - 1).to_bytes(size, "little")


def set_varint(rng: random.Random, data: bytearray, other: bytes) -> None:
    """The variable-length integer at some place becomes another one."""
    at = _place(rng, data)
    end = at
    while end < len(data) and data[end] & 0x80:
        end += 1
    coded = bytearray()
    put_varint(coded, min(rng.choice(INTEGERS) << rng.randrange(2), (1 << 35) - 1))
    data[at : end + 1] = coded


CHANGES: tuple[Change, ...] = (
    flip, flip, burst, swap, splice, insert, delete, truncate, set_integer, set_varint, set_varint
)  # fmt: skip


def change_bytes(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """`data` after one to three changes, whose names are added to `names`."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        change = rng.choice(CHANGES)
        change(rng, changed, other)
        names.append(change.__name__)
    return bytes(changed)


# -- values of canonical msgpack ---------------------------------------------------------------------------------------


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
    """In place, one number or text in `tree` becomes another, or a random list or map gains or loses an entry."""
    containers = _containers(tree)
    places = [(c, key) for c in containers for key in (list(c) if isinstance(c, dict) else range(len(c)))]
    if places and rng.random() < 0.85:
        leaves = [(c, key) for c, key in places if not isinstance(c[key], (list, dict))]
        container, key = rng.choice(leaves or places)
        container[key] = _other_value(rng, container[key])
        return
    container = rng.choice(containers)
    if len(container) and rng.random() < 0.5:
        del container[rng.choice(list(container) if isinstance(container, dict) else range(len(container)))]
    elif isinstance(container, dict):
        container[rng.choice((0, 6, 13, 63, 64, 1000, (1 << 32) - 1))] = rng.choice((0, 1.0, "later", [[[[0]]]]))
    else:
        again = copy.deepcopy(rng.choice(container)) if container else rng.choice(INTEGERS)
        container.insert(rng.randint(0, len(container)), again)


# -- parts -------------------------------------------------------------------------------------------------------------


def _layer(rng: random.Random, parts: Parts) -> Chunk | None:
    layers = [chunk for chunk in parts.chunks if chunk.sections is not None]
    return rng.choice(layers) if layers else None


def section_bytes(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Bytes of one section; the lengths follow."""
    chunk = _layer(rng, parts)
    if chunk is None or not chunk.sections:
        return
    number = rng.choice(list(chunk.sections))
    chunk.sections[number] = change_bytes(rng, chunk.sections[number], chunk.sections[number], names)
    names.append(f"in section {number}")


def stage_bytes(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Bytes of one stage of a section in stages, or of the block before them; the stages' lengths follow."""
    places = [(chunk, number) for chunk in parts.chunks for number in chunk.sections or ()]
    found = [(c, number, staged) for c, number in places if (staged := take_stages(c, number)) is not None]
    if not found:
        return section_bytes(rng, parts, other, names)
    chunk, number, staged = rng.choice(found)
    at = rng.randrange(-1, len(staged.stages))
    if at < 0:
        staged.block = staged.block[:1] + change_bytes(rng, staged.block[1:], staged.block, names)
    else:
        staged.stages[at] = change_bytes(rng, staged.stages[at], rng.choice(staged.stages), names)
    assert chunk.sections is not None
    chunk.sections[number] = staged.packed()
    names.append(f"in section {number}, {f'stage {at}' if at >= 0 else 'the block'}")


def section_swap(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A section comes from another layer or file, or is dropped, random, or of zeros."""
    chunk, donor = _layer(rng, parts), _layer(rng, other if rng.random() < 0.6 else parts)
    if chunk is None or chunk.sections is None or donor is None:
        return
    number = rng.choice([*chunk.sections, rng.randrange(len(Section))])
    given = (donor.sections or {}).get(number, b"")
    size = rng.randint(1, 200)
    chunk.sections[number] = rng.choice((given, given, b"", rng.randbytes(size), bytes(size), b"\x10" * size))
    names.append(f"section {number} from elsewhere")


def parameters(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A value in a layer's parameters."""
    chunk = _layer(rng, parts)
    if chunk is not None and chunk.meta is not None:
        change_value(rng, chunk.meta)
        names.append("a layer parameter")


def header_value(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """A value in the header; the chunk list is written anew."""
    change_value(rng, parts.header)
    names.append("a header value")


def overflow(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Values that are not finite, which no payload shows, and a layer parameter: of two faults one is to be named."""
    key, value = rng.choice(((STEPS, [OVERFLOWING] * 3), (VOXEL_SIZE, OVERFLOWING)))
    parts.header[key] = value
    names.append("values that overflow")
    parameters(rng, parts, other, names)


def payload_bytes(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Bytes of a whole payload, its parameters included."""
    chunk = rng.choice(parts.chunks)
    chunk.payload = change_bytes(rng, chunk.packed(), rng.choice(other.chunks).packed(), names)
    chunk.meta = chunk.sections = None
    names.append("in a payload")


def chunks(rng: random.Random, parts: Parts, other: Parts, names: list[str]) -> None:
    """Chunks are dropped, doubled, swapped, of another type, flagged, or come from another file."""
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
        parts.chunks[i].flags ^= rng.choice((1, FLAG_MORE, slice_flags(1, 1), slice_flags(512, 1)))
    else:
        parts.chunks[i] = copy.deepcopy(rng.choice(other.chunks))
    names.append("chunks")
    if act != 4 and rng.random() < 0.7:  # else hardly a changed order of slices gets past the flags
        for kind, run in itertools.groupby(parts.chunks, key=lambda chunk: chunk.type):
            own = list(run)
            for number, chunk in enumerate(own if kind in BY_CHUNK_TYPE else ()):
                chunk.flags = slice_flags(number, len(own))
        names.append("renumbered")


PART_CHANGES = (section_bytes, stage_bytes, section_swap, parameters, header_value, overflow, payload_bytes, chunks)
PART_WEIGHTS = (30, 15, 10, 20, 8, 3, 12, 5)


def change_parts(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """A file whose parts were changed, with lengths, chunk list, scene ids and checksums right again."""
    parts, donor = take_apart(data), take_apart(other)
    try:
        for change in rng.choices(PART_CHANGES, PART_WEIGHTS, k=rng.choice((1, 1, 1, 2))):
            change(rng, parts, donor, names)
        return put_together(parts)
    except EncodeError:  # a value that has no canonical form, such as one nested too deep
        return data


def change_header_bytes(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """The header's bytes changed as they lie, ids and checksums right again: msgpack in forms that nobody writes."""
    (size,) = struct.unpack_from("<I", data, 12)
    header = change_bytes(rng, data[20 : 20 + size], other[20:200], names)[:4096]
    names.append("in the header")
    return put_together(take_apart(data), header)


def change_frame(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """A field of a chunk's frame changed, with the checksum right again: type, flags, length or scene id that lie."""
    frames, offset = [], read_preamble(data).size
    while offset < len(data):
        end = read_chunk(data, offset).end
        frames.append((offset, end))
        offset = end
    offset, end = rng.choice(frames)
    head = bytearray(data[offset : offset + CHUNK_HEAD_SIZE])
    at = rng.randrange(len(head))
    head[at] ^= 1 << rng.randrange(8)
    names.append(f"byte {at} of a frame")
    body = bytes(head) + data[offset + CHUNK_HEAD_SIZE : end - 4]
    return data[:offset] + body + struct.pack("<I", zlib.crc32(body)) + data[end:]


def make_case(seeds: Sequence[Seed], seed: int, index: int) -> Case:
    """Input number `index` of the run `seed` over these files."""
    rng = random.Random(seed << 40 | index)
    chosen, donor = rng.choices(seeds, [s.weight for s in seeds], k=2)
    names: list[str] = []
    act = rng.random()
    if act < 0.04:
        data = change_header_bytes(rng, chosen.data, donor.data, names)
    elif act < 0.06:
        data = change_frame(rng, chosen.data, donor.data, names)
    elif act < REPAIRED_SHARE:
        data = change_parts(rng, chosen.data, donor.data, names)
    else:
        data = change_bytes(rng, chosen.data, donor.data, names)
        return Case(data, False, f"{chosen.name}: {', '.join(names)}")
    return Case(data, True, f"{chosen.name}, repaired: {', '.join(names)}")
