"""The inputs: legal files of random choices, and mutations of files, of bytes and of parts, after which lengths, the
chunk list, scene ids and CRCs are made right.

Everything is drawn from the given random.Random, so an input is named by its run and its number.
"""

from __future__ import annotations

import copy
import itertools
import random
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from vectors.blocks import Chunk, File, read_file, varint

from .legal import Case, legal

VARINT_MAX = (1 << 35) - 1
_POWERS = (7, 8, 9, 12, 14, 15, 16, 20, 21, 22, 23, 24, 26, 28, 31, 32)
#: Around every limit of the format and every width of an integer.
INTEGERS = (0, 1, 2, 3, 4, 5, 10, 17, 64, 65, *(v for p in _POWERS for v in ((1 << p) - 1, 1 << p, (1 << p) + 1)))
REALS = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0**-149, 2.0**-126, 2.0**-20, 2.0**20, 2.0**127, -(2.0**127))
LONGEST_BURST = 64
LEGAL_SHARE = 0.2  #: of the inputs
SEALED_SHARE = 0.6  #: of the others


# -- bytes -------------------------------------------------------------------------------------------------------------


#: Single bits; a run of random bytes, 0 or 255; a run of another file; bytes more; bytes less; a little-endian integer
#: near a limit; a variable-length integer, such as a token, a count or a parameter.
CHANGES = ("flip", "flip", "burst", "splice", "splice", "insert", "delete", "integer", "varint", "varint")


def change_bytes(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """`data` after one to three changes, whose names are added to `names`."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        change, size = rng.choice(CHANGES), rng.randint(1, LONGEST_BURST)
        near = len(changed) if rng.random() < 0.5 else min(len(changed), 40)  # parameters lie near the beginning
        at = rng.randrange(near) if near else 0
        if change == "flip" and changed:
            for place in [at, *(rng.randrange(len(changed)) for _ in range(rng.choice((0, 0, 0, 1, 2, 7))))]:
                changed[place] ^= 1 << rng.randrange(8)
        elif change == "burst":
            size = min(size, len(changed) - at)
            changed[at : at + size] = rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size))
        elif change == "splice" and other:
            start = rng.randrange(len(other))
            run = other[start : start + rng.choice((LONGEST_BURST, len(other)))]
            changed[at : at + len(run)] = run
        elif change == "insert":
            changed[at:at] = rng.randbytes(size) if rng.random() < 0.5 else bytes(changed[at : at + size])
        elif change == "delete":
            del changed[at : at + rng.choice((1, 1, 2, 4, size, len(changed)))]
        elif change == "integer":
            wide = rng.choice((1, 2, 4))
            value = rng.choice(INTEGERS) * rng.choice((1, 1, 1, -1)) % (1 << 8 * wide)
            changed[at : at + wide] = value.to_bytes(wide, "little")
        elif change == "varint":
            end = at
            while end < len(changed) and changed[end] & 0x80:
                end += 1
            changed[at : end + 1] = varint(min(rng.choice(INTEGERS) << rng.randrange(2), VARINT_MAX))
        names.append(change)
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
        return rng.choice((rng.choice(REALS), True, "text", b"bytes", [], {}, [0] * 20))
    if isinstance(value, float):
        return rng.choice((*REALS, -value))
    near = (value + 1, value - 1, 2 * value, -value, value ^ 1 << rng.randrange(12)) if isinstance(value, int) else ()
    return rng.choice((rng.choice(INTEGERS), *near))


def change_value(rng: random.Random, tree: Any) -> None:
    """In place, one leaf of `tree` becomes another, or a random list or map gains or loses an entry."""
    containers = _containers(tree)
    places = [(c, key) for c in containers for key in (list(c) if isinstance(c, dict) else range(len(c)))]
    leaves = [(c, key) for c, key in places if not isinstance(c[key], (list, dict))]
    container, key = rng.choice(leaves or places) if places else (tree, None)
    if places and rng.random() < 0.75:
        container[key] = _other_value(rng, container[key])
        return
    container = rng.choice(containers)
    if len(container) and rng.random() < 0.5:
        del container[rng.choice(list(container) if isinstance(container, dict) else range(len(container)))]
    elif isinstance(container, dict):
        container[rng.choice((0, 3, 5, 6, 13, 63, 64, 1000, (1 << 32) - 1))] = rng.choice((0, 1.0, "x", [0], [[[[0]]]]))
        for name in sorted(container):
            container[name] = container.pop(name)
    else:
        again = copy.deepcopy(rng.choice(container)) if container else rng.choice(INTEGERS)
        container.insert(rng.randint(0, len(container)), again)


# -- parts -------------------------------------------------------------------------------------------------------------


#: What `change_part` changes, and how often: bytes of codes or stream; codes, a stream or parameters from elsewhere; a
#: value in the parameters; one in the header, half of the time in its kind or rows; bytes of a payload; chunks; and in
#: `change_parts` bytes of the header.
PARTS = {"coded": 40, "swap": 8, "parameter": 22, "header": 14, "payload": 10, "chunks": 6, "header bytes": 8}


def change_part(rng: random.Random, part: str, file: File, other: File, names: list[str]) -> None:
    """Changes something in place."""
    names.append(part)
    own, donors = ([c.layer for c in x.chunks if c.layer] for x in (file, rng.choice((file, other))))
    if part == "chunks":
        _change_chunks(rng, file.chunks, other.chunks)  # type: ignore[arg-type]
    elif part == "payload":
        chunk = rng.choice(file.chunks)
        chunk.payload = change_bytes(rng, chunk.payload, rng.choice(other.chunks).payload, names)
        chunk.layer = None
    elif part == "header" or not own:
        tables = [file.header[key] for key in (3, 4, 5) if isinstance(file.header.get(key), list)]
        change_value(rng, rng.choice(tables) if tables and rng.random() < 0.5 else file.header)
    elif part == "parameter":
        change_value(rng, rng.choice(own).meta)
    elif part != "header bytes":
        layer, donor, size = rng.choice(own), rng.choice(donors or own), rng.randint(1, 200)
        name = rng.choice(("pieces", "stream", "meta") if part == "swap" else ("pieces", "pieces", "pieces", "stream"))
        value, before = (b"".join(x.pieces.values()) if name == "pieces" else getattr(x, name) for x in (donor, layer))
        if part == "coded":
            value = change_bytes(rng, before, value, names)
        elif name != "meta" and rng.random() < 0.5:
            value = rng.choice((b"", rng.randbytes(size), bytes(size), b"\x10" * size))
        setattr(layer, name, {"codes": value} if name == "pieces" else copy.deepcopy(value))
        names.append(f"of {name}")


def _change_chunks(rng: random.Random, chunks: list[Chunk], others: Sequence[Chunk]) -> None:
    """Chunks are dropped, doubled, swapped, of another type, flagged, or from another file; then numbered, or not."""
    act, (i, j) = rng.randrange(6), (rng.randrange(len(chunks)) for _ in range(2))
    if act == 0 and len(chunks) > 1:
        del chunks[i]
    elif act == 1:
        chunks.insert(i, copy.deepcopy(rng.choice((chunks[j], *others))))
    elif act == 2:
        chunks[i], chunks[j] = chunks[j], chunks[i]
    elif act == 3:
        chunks[i].type = rng.choice((0, 1, 2, 3, 99, 65535))
    elif act == 4:
        chunks[i].flags ^= 1 << rng.choice((0, 1, 2, 6, 15))
    if act != 4 and rng.random() < 0.7:  # else a changed order of slices hardly gets past the flags
        for kind, own in ((kind, list(run)) for kind, run in itertools.groupby(chunks, key=lambda chunk: chunk.type)):
            for number, chunk in enumerate(own if kind < 3 else ()):
                chunk.flags = number << 6 | 2 * (number + 1 < len(own))


def change_parts(rng: random.Random, data: bytes, other: bytes, names: list[str]) -> bytes:
    """A file whose parts were changed, with lengths, chunk list, scene ids and CRCs right again."""
    file, donor, packed = replace(read_file(data), minor=0), read_file(other), None
    try:
        for part in rng.choices([*PARTS], [*PARTS.values()], k=rng.choice((1, 1, 1, 2))):
            if part == "header bytes":  # msgpack in forms that nobody writes
                header = data[20 : 20 + int.from_bytes(data[12:16], "little")]
                packed = change_bytes(rng, header, other[20:200], names)[:4096]
            change_part(rng, part, file, donor, names)
        for chunk in file.chunks:
            chunk.payload = chunk.layer.payload() if chunk.layer else chunk.payload
        return replace(file, header={14: None, **file.header}, packed=packed).data()
    except (ValueError, TypeError, OverflowError, struct.error):  # a value that has no form
        return data


def make_case(seeds: Sequence[Case], run: int, index: int) -> Case:
    """Input number `index` of a run over these files."""
    rng = random.Random(run << 40 | index)
    if rng.random() < LEGAL_SHARE:
        return legal(rng)
    chosen, donor = rng.choice(seeds), rng.choice(seeds)
    names: list[str] = []
    act = rng.random()
    change, sealed = (change_parts, True) if act < SEALED_SHARE else (change_bytes, False)
    data = change(rng, chosen.data, donor.data, names)
    base = chosen.base
    if base is not None and rng.random() < 0.3:
        under = [seed for seed in (donor, *seeds) if seed.base is not None]
        names.append("its base")
        base = rng.choice((None, chosen.data, rng.choice(under).base, change(rng, base, donor.data, names)))
        data = rng.choice((data, chosen.data))
    recipe = f"{chosen.recipe}{', sealed' if sealed else ''}: {', '.join(names)}"
    return Case(recipe, data, base, sealed=sealed, origins=(chosen.data, donor.data))
