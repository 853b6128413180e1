"""Reads the table of vectors, and builds the files in it that take more than an expression.

A line of `table.txt` has columns with two spaces or more between them:

    name  patches  options  # sentence

A group heading `[folder base | clauses error]` stands before the lines that share these. `base` is a file. Each patch,
separated by ` ; `, edits one thing of it; lengths, CRCs, digest and scene ids are then computed once:

    header.4.1 = 0.0     a field of the header by its keys and places (None takes it out)
    header += 40cc7f     one entry more in the map of the header, as bytes
    header := bytes      the header, as bytes
    layer1.5.0 = 0.5     a field of the parameters of chunk 1; += and := as for the header
    codes1.masks = bytes the codes of chunk 1 for what `blocks.Layer.pieces` names
    stream1 = bytes      the stream of chunk 1
    payload1 = bytes     the payload of chunk 1
    chunk1.flags = 4     a field of `blocks.Chunk`
    chunks = [...]       the chunks, `c` in the expression
    file.major = 9       a field of `blocks.File`
    cut = (1, 16)        the file ends 16 bytes behind the start of chunk 1; an integer: after so many bytes
    xor = (1, 16, 8)     a byte of the finished file is changed, 16 bytes behind the start of chunk 1
    := make_file(...)    another file

Values are Python expressions over the names of blocks.py and of this file. `it` is the value before, `base` the file,
n(i) the length of the payload of chunk i. Options: `!Error` and clauses in place of those of the group, `@2` the
chunk at fault (`@end` behind all chunks) where it does not follow from the first patch, `~Error` the error of a scene
whose tensors decode, `^valid/name` the vector that is its base. `for a: x | b: y` writes the line once for each name
and value, in the places of {i} and {x}. `let name = value` defines a name for later lines. Without a sentence the name
and the patch are the description.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import re
from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import blocks
from .blocks import LZMA, File, Grid, Layer, Prior, constant, line, make_file, make_layer, pack, pattern

TABLE = Path(__file__).with_name("table.txt")
M, K, ROWS = 1 << 23, 1 << 24, 40
WIDE = (32, 6, 30)  #: channels of the tensors of rows, where a vector needs many
LEAST, LARGEST = 2.0**-126, (2.0 - 2.0**-23) * 2.0**127
FRAME = {"type": 0, "flags": 2, "length": 4, "scene_id": 8}  # offsets in a chunk
PREAMBLE = {"signature": 0, "major": 8, "declared": 12, "crc": 16}


# -- the table ---------------------------------------------------------------------------------------------------------


def vectors(without: Container[str] = ()) -> Iterator[tuple[dict[str, Any], bytes]]:
    """The entry in the manifest and the bytes of all vectors but those of some names, in the order of the table."""
    names: dict[str, Any] = {**vars(blocks), **globals()}
    rows: dict[str | None, dict[str, Any]] = {}
    group: Any = None
    for text in _lines():
        try:
            if text.startswith("let "):
                name, _, value = text.removeprefix("let ").partition(" = ")
                names[name] = eval(value, names)
            elif text.startswith("["):
                folder, base, clauses, error = re.fullmatch(r"\[(\S+) (.+?) \| ([\d. ]*\d)(?: (\w+))?\]", text).groups()  # type: ignore[union-attr]
                group = folder, eval(base, names), clauses, error
            elif text.split("  ")[0] not in without:
                row, data = _vector(text, *group, names)
                if rows.get(row.get("base"), row)["ans_only"] != "same":
                    row["ans_only"] = "UnsupportedFeature"
                rows[row["file"]] = row
                yield row, data
        except Exception as fault:
            raise ValueError(f"{TABLE.name}: {text}: {type(fault).__name__}: {fault}") from fault


def _lines() -> Iterator[str]:
    """One line for each vector: continuations are joined, and lines with `for` are written out."""
    text = re.sub(r"\n +(?=[#!@~^]|for [\w-]+: |\d[\d. ]*(?:  |\n))", "  ", TABLE.read_text(encoding="utf-8"))
    text = re.sub(r"\n +", " ", text)
    for row in text.splitlines():
        head, found, values = row.partition("  for ")
        for value in values.split(" | ") if found else [""]:
            name, _, patch = value.partition(": ")
            if row and not row.startswith("#"):
                yield head.replace("{i}", name).replace("{x}", patch)


def _vector(text: str, folder: str, base: File, clauses: str, error: str | None, names: dict[str, Any]) -> Any:
    text, _, what = text.partition("  # ")
    name, patches, *options = re.split(r" {2,}", text.strip())
    marks = {option[0]: option[1:] for option in options if option[0] in "!~^@"}
    (clauses,) = [option for option in options if option[0] not in marks] or [clauses]
    error, target = marks.get("!", error), marks.get("@")
    file, place = base, None
    for patch in patches.split(" ; "):
        file, found = _patched(file, patch, {**names, "base": base})
        place = place or found
    chunk, at = place or (None, None)
    if target not in (None, "end"):
        chunk, at = int(target), None
    data = file.data()
    if at is not None:
        at += file.start(chunk)
    count = None if error is None or target == "end" else chunk or 0
    layers, slices = file.hashes(count), [x.number for x in file.slices()]
    row: dict[str, Any] = {
        "file": f"{folder}/{name}.pd4",
        "what": what or f"{name.replace('-', ' ').capitalize()}: {patches}",
        "clauses": clauses.split(),
        "size": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "error": error,
        "clause": error and clauses.split()[0],
        "chunk": chunk if error else None,
        "offset": at if error else None,
        "scene": marks.get("~"),
        "base": marks["^"] + ".pd4" if "^" in marks else None,
        "ans_only": "UnsupportedFeature" if file.fields().get(2) == LZMA else "same",
        "slices": slices[: len(file.slices(count))] if len(slices) > len(set(slices)) else None,
    }
    row = {key: value for key, value in row.items() if value is not None}
    return row | ({"prefix": layers[-1]["layer"] if layers else None} if error else {}) | {"layers": layers}, data


def _patched(file: File, patch: str, names: dict[str, Any]) -> tuple[File, Any]:
    """The file, and (chunk, offset in it or None) where the patch is found out."""
    left, op, right = re.fullmatch(r"([\w.]*) ?(:=|\+=|=) (.+)", patch).groups()  # type: ignore[union-attr]
    (target, index), *keys = re.fullmatch(r"([a-z]*)(\d*)", left.split(".")[0]).groups(), *left.split(".")[1:]  # type: ignore[union-attr]
    names = names | {"n": lambda i: len(file.chunks[i].payload), "c": list(getattr(file, "chunks", ()))}
    value = lambda it=None: eval(right, names | {"it": it})  # noqa: E731

    if target == "":
        return value(file), None
    if target in ("cut", "xor"):
        found = value()
        chunk, offset, *mask = found if isinstance(found, tuple) else (None, found)
        if target == "cut":
            return replace(file, end=(chunk, offset)), (chunk, offset)
        crc = 16 + (0 if chunk is None else len(file.chunks[chunk].payload))
        return replace(file, flips=(*file.flips, (chunk, offset, *mask))), (chunk, crc)
    if target == "file":
        at = file.start(len(file.chunks)) if keys[0] == "tail" else PREAMBLE.get(keys[0])
        return replace(file, **{keys[0]: value(getattr(file, keys[0]))}), (None, at)
    if target == "chunks":
        return replace(file, chunks=tuple(value())), None
    if target == "header":
        if op == "=":
            fields = _set(file.fields(), [int(k) for k in keys], value)
            return file.with_header({int(keys[0]): fields.get(int(keys[0]))}), (None, None)
        return replace(file, packed=_bytes(op, right, file.header_bytes(), value)), (None, None)
    number = int(index)
    if target in ("chunk", "payload"):
        name, chunk = [*keys, target][0], file.chunks[number]
        at = 16 + len(chunk.payload) if name == "crc" else FRAME.get(name)
        return file.with_chunk(number, **{name: value(getattr(chunk, name))}), (number, at)
    layer, packed = file.layer(number), None
    if target == "codes":
        layer = replace(layer, pieces={**layer.pieces, keys[0]: value(layer.pieces.get(keys[0]))})
    elif target == "stream":
        layer = replace(layer, stream=value(layer.stream))
    elif op == "=":
        packed = pack(_set(layer.parameters(), [int(k) for k in keys], value))
    else:
        packed = _bytes(op, right, pack(layer.parameters()), value)
    return file.with_chunk(number, payload=layer.payload(packed)), (number, None)


def _set(fields: dict[int, Any], keys: list[int], value: Any) -> dict[int, Any]:
    """A copy with another value at a path of keys and places; None takes it out."""
    fields = inner = copy.deepcopy(fields)
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value(inner.get(keys[-1]) if isinstance(inner, dict) else inner[keys[-1]])
    if inner[keys[-1]] is None:
        del inner[keys[-1]]
    return dict(sorted(fields.items()))


def _bytes(op: str, right: str, packed: bytes, value: Any) -> bytes:
    """A packed map of at most 14 entries with one more behind them, or other bytes."""
    if op == ":=":
        return bytes(value(packed))
    entry = right if re.fullmatch("[0-9a-f]+", right) else value()
    return bytes([packed[0] + 1]) + packed[1:] + bytes.fromhex(entry)


# -- files that lines of the table share -------------------------------------------------------------------------------


def deformed(*grids: Grid, number: int = 1, **fields: Any) -> File:
    """One anchor in layer 0, and a deformation in layer 1."""
    return make_file(make_layer(), make_layer(number, (), before=1, grids=grids, **fields))


def entries_at_limit(over: int = 0) -> File:
    """A first slice whose windows have 2^18 entries and one for each of its symbols, or `over` more."""

    def file(last: int) -> File:
        own = [Prior(-(n >> 1), n, 200 + c) for c, n in enumerate([1 << 14] * 16 + [last])]
        priors = {"rows": {c: own[c if c < 17 else 0] for c in range(68)}}
        return make_file(make_layer(0, line(ROWS), widths=WIDE, rows=pattern(68, ROWS), priors=priors))

    return file(2 + entries_left(file(2).layer(0)) + over)


def entries_left(layer: Layer, later: int = 0) -> int:
    """How many entries windows may have beside those of layer 0, with so many rows in later slices."""
    known = list[Prior]()
    layer.written(known)
    symbols = (68 + 4) * (len(layer.cells) + later) + sum(map(np.size, layer.chains))
    return (1 << 18) + symbols - sum(prior.n for prior in known)


def large_products() -> File:
    """Plane xy of 521 by 4096 cells, N in all. In channel 0 the sum of all magnitudes is M − 1, and 256·N·E + 1 is a
    multiple of M: the quotient of E is its integer less 1 / M, which binary64 cannot tell from the integer. Magnitudes
    of E + 1 make up more than an eighth of the cells around them, so they are of the last class, and E is not."""
    height, width, total, e = 521, 4096, 549756251549, 16669554
    product = 256 * height * width * e
    assert product % total == total - 1 and int(product / total) == product // total + 1
    residuals = np.zeros((3, height, width), np.int64)
    residuals[0, 0, 0] = -M  # from here every other magnitude leads up, and the next one down, in a column
    left = total - 1 - M
    for (i, j), (same, k) in zip(*[iter(itertools.product(range(3, 520, 3), range(20, 4081, 20)))] * 2, strict=False):
        size = e if i == 252 and j == 20 * 51 else e + 1
        if i == same and left >= 2 * size:
            residuals[0, i, [j, k]] = size, -size
            left -= 2 * size
    for i in (1, 2):  # the rest, where nothing follows in its column
        residuals[0, height - i, width - 1] = min(left, e)
        left -= min(left, e)
    assert left == 0
    residuals[2] = (blocks.classes_of_plane(residuals[:2]) == 7).reshape(height, width)
    samples = residuals.swapaxes(1, 2).copy()
    samples[:, 0] = samples[:, 0].cumsum(axis=1)
    samples = samples.cumsum(axis=1).astype(np.int32)
    grid = Grid(3, (height, width), fill=lambda number, shape: samples)
    layer = make_layer(1, (), grids=[grid], priors={"grids": {0: Prior(0)}})
    assert np.array_equal(layer.residuals[0].swapaxes(1, 2), residuals)
    return make_file(make_layer(cells=()), layer)


def symbols_at_limit(over: int = 0, count: int = 0, graded: bool = False) -> File:
    """As many symbols as clause 6.5 allows a file, or `over` more, with `count` anchors in either layer."""
    classes = [1] * count if graded else None
    plane = Grid(1, (2048, 1920, 1, 1), fill=constant(0))

    def layer(first: int, second: int, hidden: int) -> Layer:
        chains = {0: (1, first, second), 1: (second, hidden, 3)}
        cells = line(count, z=5)
        return make_layer(1, cells, before=count, grids=[plane], chains=chains, classes=classes)

    below = make_layer(cells=line(count), classes=classes)
    size = len(below.payload()) + len(layer(300, 300, 1).payload())  # the same while no width takes more bytes
    spent = 2 * (15 + graded) * count + count + sum(map(np.size, below.chains))
    spent += 2048 * 1920 + 2 * (2048 + 1920) + 1
    weights = (1 << 22) + 256 * size + over - spent
    for first, hidden in itertools.product(range(256, 400), range(1, 100)):
        # weights = (1 + 1) first + (first + 1) second + (second + 1) hidden + (hidden + 1) 3
        second, rest = divmod(weights - 3 - 2 * first - 4 * hidden, first + 1 + hidden)
        if rest == 0 and second >= 256:
            return make_file(below, layer(first, second, hidden))
    raise AssertionError("no widths reach the limit")


def rows_at_limit(over: int = 0) -> File:
    """As many anchors as clause 6.5 allows a payload of 600 bytes, or `over` more."""
    layer = make_layer(0, line((1 << 13) + 2 * 600 + over), choose=lambda piece, number, k: Prior(k[0]))
    size = len(pack(layer.parameters())) + 600 - len(layer.payload())
    return make_file(layer).with_chunk(0, payload=layer.padded(size))


def over_base(over: int = 0) -> File:
    """As many symbols as clause 6.5 allows a file whose base has the rows of `rows_at_limit`, or `over` more."""
    base, size = rows_at_limit(), 1500
    _, _, n, bytes_of_base = base.reference()
    first = make_layer(0, (), before=n, chains={})
    left = (1 << 22) + 256 * (bytes_of_base + len(first.payload()) + size) + over - (4 + 11 + 2) * n
    width, rest = divmod(left, n)
    grids = [Grid(1, (min(4096, rest - at),), fill=constant(0), id=at >> 12) for at in range(0, rest, 4096)]
    own = {i: np.zeros((min(256, width - 256 * i), n), np.int32) for i in range(-(-width // 256))}
    layer = make_layer(1, (), before=n, base=n, layer_rows=own, grids=grids, chains={})
    payload = layer.padded(len(pack(layer.parameters())) + size - len(layer.payload()))
    return blocks.adding(base, first, layer).with_chunk(1, payload=payload)
