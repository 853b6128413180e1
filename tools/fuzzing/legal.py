"""Legal `.pd4` files: the small valid vectors, and files of random choices that no encoder need make.

A random file is made from its symbols: the writer of the vectors says which hashes a decoder must arrive at. It has the
tables of tensors of a valid vector, in half of the files with other sizes, which may make no scene. Every other choice
that the format leaves is drawn, near its limits more often than not: priors and their parameters, step classes,
predictors, slices, voxels, steps, what may be ignored.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from vectors import ROOT, blocks, lzma2, refdec
from vectors.blocks import File, Grid, Layer, Prior, make_layer

from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.info import hashes

VECTORS = ROOT / "spec" / "vectors"
LARGEST_SEED = 6000  #: bytes of a vector: larger ones decode slowly
LARGEST_GRIDS = 2000  #: plane samples of a vector whose tables random files have
M, K, V = 1 << 23, 1 << 24, 1 << 20  #: largest symbol of a value, of a channel, and voxel index
LEAST, LARGEST = 2.0**-126, (2.0 - 2.0**-23) * 2.0**127


@dataclass(frozen=True)
class Case:
    """An input, or a legal file to mutate. recipe: what was done, or a name. base: what is given as its base. scene:
    whether it is sure to make a scene. meaning: the hashes that a random legal file must have. sealed: whether lengths,
    ids and CRCs are right. origins: the files that it was made from."""

    recipe: str
    data: bytes
    base: bytes | None = None
    scene: bool = False
    meaning: list[dict[str, Any]] | None = None
    sealed: bool = True
    origins: tuple[bytes, ...] = ()


@cache
def valid_vectors() -> list[Case]:
    """The small ones."""
    found = list[Case]()
    for row in json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))["vectors"]:
        if row["file"].startswith(("valid/", "uncommon/")) and row["size"] <= LARGEST_SEED:
            data, base = (name and (VECTORS / name).read_bytes() for name in (row["file"], row.get("base")))
            found.append(Case(Path(row["file"]).stem, data, base, "scene" not in row))
    return found


def seeds(paths: Sequence[Path] = (), built: int = 60) -> list[Case]:
    """`built` random files, the files at `paths` (or in them, if folders) that decode, and small vectors."""
    found = [numbered(i) for i in range(built)]
    for file in (file for path in paths for file in (sorted(path.rglob("*.pd4")) if path.is_dir() else [path])):
        data = file.read_bytes()
        with suppress(DecodeError):
            hashes(data)
            found.append(Case(file.stem, data))
    return found + valid_vectors()


# -- numbers and priors ------------------------------------------------------------------------------------------------


def symbols(rng: random.Random, *shape: int, most: int = M) -> np.ndarray:
    """int32 of `shape` in -most..most: alike, small, of any size, few that are large, or at the ends."""
    numbers, form = np.random.default_rng(rng.randrange(1 << 32)), rng.randrange(7)
    if form == 0:
        return np.full(shape, rng.choice((0, 1, -1, most, -most, rng.randint(-most, most))), np.int32)
    if form == 1:
        return numbers.choice([-most, most, 0], shape).astype(np.int32)
    if form == 2:
        return numbers.integers(-most, most, shape, endpoint=True).astype(np.int32)
    k = np.rint(numbers.normal(rng.choice((0, 0, 300)), rng.choice((0.4, 1.5, 40, 9000)), shape))
    if form == 3:
        k[numbers.random(shape) < 0.1] = rng.choice((most, -most, 1000))
    return k.clip(-most, most).astype(np.int32)


def near(rng: random.Random, low: int, high: int) -> int:
    """An integer in low..high, often at an end."""
    return rng.choice((low, high, rng.randint(low, high), rng.randint(low, min(high, low + 40))))


def step(rng: random.Random, values: Sequence[np.ndarray], most: int = 1) -> float:
    """A step that keeps these symbols finite, and all up to `most`."""
    largest = max([most, *(int(abs(v.astype(np.int64)).max(initial=0)) for v in values)])
    limit = min(LARGEST, (2.0**128 - 2.0**103) * (1 - 2.0**-40) / largest)
    single = np.float32([limit, rng.random() * 2.0 ** rng.randrange(-40, 20) + LEAST])
    single[0] = single[0] if float(single[0]) <= limit else np.nextafter(single[0], np.float32(0))
    return rng.choice((LEAST, 2.0**-7, *map(float, single)))


def choice(
    rng: random.Random, known: list[Prior], most: int, alike: float, piece: str, number: int, k: list[int]
) -> Prior:
    """The prior of a channel of symbols k. most: entries of the list; alike: how often it is one that the list has."""
    left = most - sum(prior.n for prior in known)
    if known and (rng.random() < alike or left < 2):
        return rng.choice(known)
    return prior(rng, min(k), max(k), min(left, 1 << 14))


def prior(rng: random.Random, low: int, high: int, most: int) -> Prior:
    """Any prior of at most so many entries, at least 1; symbols outside its window become exceptions."""
    if most < 2 or rng.random() < 0.15:
        return Prior(rng.choice((low, high, K, -K)))
    span = high - low + 1
    n = rng.choice((2, 3, 7, min(span, 300), min(span, 90) + rng.randrange(2)))
    if rng.random() < 0.01:
        n = rng.choice((span, 1 << 14))
    n = min(most, max(2, n))
    least = rng.choice((low, low, low, low - rng.randrange(3), high, K, -K))
    mixed = (*_normal(rng, n), near(rng, 1, 255)) if rng.random() < 0.5 else None
    return Prior(max(-K, min(least, K - n + 1)), n, *_normal(rng, n), mixed)


def _normal(rng: random.Random, n: int) -> tuple[int, int]:
    """si, g."""
    g = rng.choice((0, rng.randint(-128 * n, 128 * n), rng.randint(-(1 << 31), 1 << 31), 1 << 31, -(1 << 31)))
    return rng.choice((-640, 1280, rng.randint(-640, 1280), 64 * n.bit_length() - 128)), g


# -- tables ------------------------------------------------------------------------------------------------------------


#: Kind of a file, its tensors of rows, by layer its parameters 4 to 7, and whether they make a scene.
Tables = tuple[list[int], list[list[Any]], dict[int, dict[int, Any]], bool]


@cache
def all_tables() -> list[Tables]:
    """Those of the small vectors without large grids, and of which no base has a part."""
    found = list[Tables]()
    for seed in valid_vectors():
        file = blocks.read_file(seed.data)
        layers = {c.type: {k: v for k, v in c.layer.meta.items() if 3 < k < 8} for c in file.chunks[::-1] if c.layer}
        samples = sum(np.prod(s) for x in layers.values() for grid in grids_of(x) for s in grid.shapes())
        if 15 not in file.header and samples <= LARGEST_GRIDS:
            found.append((file.header[3], file.header[4], layers, seed.scene))
    return found


def grids_of(meta: dict[int, Any]) -> list[Grid]:
    """Those of parameters."""
    return [Grid(channels, tuple(sides), id=i) for i, channels, sides, _ in meta.get(4, [0])[1:]]


def vary(rng: random.Random, kind: list[int], rows: list[list[Any]], layers: dict[int, dict[int, Any]]) -> None:
    """Gives tensors other sizes, still legal, in place."""
    if rng.random() < 0.5:
        parameters = [near(rng, 0, 65535) for _ in range(rng.choice((0, 0, 1, 2, 15)))]
        kind[:] = [rng.choice((0, 1, 2, 65535)), *parameters]
    for row in rows if rng.random() < 0.5 else ():
        row[1] = rng.choices((1, 3, 16), (6, 6, 1))[0]
    for meta in layers.values():
        for grid in meta.get(4, [0])[1:]:
            if rng.random() < 0.4:
                sides = [rng.choices((1, 2, 3, 5, 40), (8, 8, 8, 4, 1))[0] for _ in range(rng.randint(1, 4))]
                grid[1:3] = rng.choices((1, 2, 3, 5, 9, 17, 33), (6, 6, 6, 3, 1, 1, 1))[0], sides
        for chain in meta.get(5, [0])[1:]:
            if rng.random() < 0.4:
                chain[1:] = rng.choices((1, 2, 4, 30), (9, 9, 9, 1), k=rng.choices((2, 3, 5, 17), (9, 5, 2, 0.5))[0])
        for row in meta.get(7, ()):
            row[1] = rng.choice((row[1], row[1], 1, 2))
        if rng.random() < 0.1:
            meta[6] = rng.choice(([0], [1], [0, 7], [1, 7], [5]))


# -- slices and files --------------------------------------------------------------------------------------------------


class Maker:
    """Makes the slices of a file. base: whether others add to its layer 0."""

    def __init__(self, rng: random.Random, base: bool = False):
        self.rng, (self.kind, rows, self.layers, self.scene) = rng, copy.deepcopy(rng.choice(all_tables()))
        if rng.random() < 0.5:
            self.scene = False
            vary(rng, self.kind, rows, self.layers)
        self.base, self.adds, self.base_rows = base, False, 0  # rows of the base that it adds to
        self.mode = blocks.LZMA if rng.random() < 0.1 else blocks.ANS
        self.table = [[i, c, 1.0, rng.randrange(3)] for i, c, _, _ in rows]
        width = sum(c for _, c, _, _ in self.table)
        self.centres = symbols(rng, width).tolist() if rng.random() < 0.4 else None
        self.layer_table = list[Any]()  # of the layer
        self.taken = set[tuple[int, ...]]()
        self.codes = self.classes = np.zeros(0, np.int64)  # of the layers so far
        self.of_base = self.codes, self.classes  # of layer 0
        self.symbols = 0  # of the slices so far and of the base

    def over(self) -> Maker:
        """The maker of a file that adds to the layer 0 of what this one has made."""
        made = copy.copy(self)
        made.table, made.base, made.adds = copy.deepcopy(self.table), False, True
        made.codes, made.classes = self.of_base
        made.symbols = len(made.codes) * (4 + (made.centres is not None) + sum(c for _, c, _, _ in made.table))
        made.base_rows, made.mode = len(made.codes), blocks.LZMA if self.rng.random() < 0.1 else blocks.ANS
        return made

    def cells(self, count: int) -> list[list[int]]:
        """At most so many voxels that are free, of a slice."""
        rng = self.rng
        form, at = rng.randrange(5), [rng.choice((0, 0, -9, V - 8, 8 - V, rng.randint(-V, V))) for _ in range(3)]
        draw: Callable[[], list[int]] = [
            lambda: [rng.choice((-V, 1 - V, -1, 0, 1, V - 1, V)) for _ in range(3)],
            lambda: [rng.randint(-V, V) for _ in range(3)],
            lambda: [a + rng.randrange(2) for a in at],
            lambda: [at[0] + rng.randrange(60), at[1], at[2]],
            lambda: [a + rng.randrange(8) for a in at],
        ][form]
        found = {tuple(min(v, V) for v in draw()) for _ in range(count)} - self.taken
        for axis in range(3):  # a slice reaches over 2^21 voxels
            if {-V, V} <= {cell[axis] for cell in found}:
                found = {cell for cell in found if cell[axis] < V}
        self.taken |= found
        return blocks.ordered(sorted(found))

    def rows(self, classes: list[int], table: Sequence[Sequence[Any]], centres: Sequence[int]) -> list[np.ndarray]:
        """int32 [C, n] of each of these tensors, in rows of these step classes."""
        made, few = list[np.ndarray](), self.rng.choice((M, M, 3, 50))
        for _, width, _, predictor in table:
            k = symbols(self.rng, width, len(classes), most=few)
            own, centres = centres[:width] or [0] * width, centres[width:]
            for channel, centre in zip(k, own, strict=True):
                while True:
                    with suppress(refdec.Fault):  # of symbols that lead to values out of their range
                        refdec.row_values(channel.tolist(), classes, centre, predictor)
                        break
                    channel[:] = channel / 2  # 0 in the end
            made.append(k)
        return made

    def grids(self, meta: dict[int, Any]) -> list[Grid]:
        """With samples of any size; those of the first grid of tracks ascend."""
        made = list[Grid]()
        for grid in grids_of(meta):
            samples = [symbols(self.rng, *shape, most=self.rng.choice((M, 3))) for shape in grid.shapes()]
            if meta.get(6) == [1] and grid.id == 0:
                rising = [np.arange(k.size).reshape(k.shape) ** self.rng.choice((1, 2)) for k in samples]
                samples = [(k if k.max() <= M else np.sqrt(k)).astype(np.int32) for k in rising]
            predictors = tuple(self.rng.randrange(2) for _ in samples)
            made.append(replace(grid, predictors=predictors, fill=lambda place, shape, samples=samples: samples[place]))  # type: ignore[misc]
        return made

    def chain(self, widths: Sequence[int]) -> list[np.ndarray]:
        """Weight, bias, weight, .. from the input side."""
        arrays = blocks.constant_chain(widths, 0)
        return [symbols(self.rng, *k.shape, most=self.rng.choice((M, M, 9))) for k in arrays]

    def slice(self, number: int, first: bool, known: list[Prior]) -> Layer:
        """One slice, which refers to the priors of those before."""
        rng, meta = self.rng, self.layers[number] if first and (number or not self.adds) else {}
        if first:
            own = () if self.base and number == 0 else meta.get(7, ())
            self.layer_table = [[i, c, q if q == 1 else step(rng, (), M), rng.randrange(3)] for i, c, q, _ in own]
        cells = self.cells(rng.choices((0, 1, 2, 3, 5, 12, 40, 150), (4, 4, 4, 4, 4, 4, 1, 0.2))[0])
        lowest, high = rng.choice((3, 3, 200, 255)), rng.choice((0, 2, 255))
        graded = self.centres is not None
        classes, earlier = [near(rng, 0, 6) * graded for _ in cells], self.classes.tolist() if first else []
        rises = [near(rng, 0, min(high, 255 - int(code)) if number else 1) for code in self.codes] if first else []
        rises = [rise if code or number == 0 or rise > 2 else 0 for rise, code in zip(rises, self.codes, strict=False)]
        rows = self.rows(classes, self.table, self.centres or [])
        layer_rows = self.rows(earlier + classes, self.layer_table, [])
        grids, chains = self.grids(meta), {i: self.chain(own) for i, *own in meta.get(5, [0])[1:]}
        planes, weights = [plane for grid in grids for plane in grid.planes()], sum(chains.values(), [])
        self.symbols += len(rises) + (4 + graded) * len(cells)
        self.symbols += sum(map(np.size, (*rows, *layer_rows, *planes, *weights)))
        fill = [near(rng, 0, 255) for _ in range(rng.choice((3, 4)))] if rng.random() < 0.2 else None
        layer = make_layer(
            number, cells, rises=rises, codes=[near(rng, lowest, 255) for _ in cells], rows=np.concatenate(rows),
            widths=[c for _, c, _, _ in self.table], classes=classes if graded else None, earlier=earlier, fill=fill,
            layer_rows={row[0]: k for row, k in zip(self.layer_table, layer_rows, strict=True)}, grids=grids,
            chains=chains, steps=(step(rng, planes), step(rng, weights)), base=self.base_rows if first else 0,
            choose=partial(choice, rng, known, self.symbols + (1 << 18), rng.random()), known=known, first=first,
        )  # fmt: skip
        extra = {6: meta.get(6), 7: self.layer_table if first else None}
        own = {key: value for key, value in layer.meta.items() if key < 6}
        return replace(layer, meta=own | {key: value for key, value in extra.items() if value})

    def header(self, layers: Sequence[Layer]) -> dict[int, Any]:
        """The fields of a file of these slices, without those that are its base's."""
        rng = self.rng
        for i, row in enumerate(self.table):  # centres and the rows before add to symbols; others may add rows
            most = M if self.centres is not None or row[3] or self.base else 1
            row[2] = step(rng, [x.rows[i] for x in layers], most)
        header: dict[int, Any] = {2: self.mode, 3: self.kind, 4: self.table, 5: self.centres}
        header[6] = step(rng, [x.cells for x in layers], V if self.base else 1)
        if rng.random() < 0.3:
            box = sorted(rng.choice((-LARGEST, -1.0, -0.0, 2.0**-149, LARGEST)) for _ in range(2))
            header |= {7: [box[0]] * 3 + [box[1]] * 3, 8: [-LARGEST, LARGEST], 9: [0.0, 1.0, 2.0**-149]}
            header |= {10: [-0.0, LARGEST], 11: [LARGEST, -0.0, -LARGEST], 12: rng.choice((0.0, -0.0, LARGEST))}
        if rng.random() < 0.3:
            sides = {3: near(rng, 1, 65535), 4: near(rng, 1, 65535)}
            header[13] = {1: [rng.choice((0.0, -LARGEST))] * 12, 2: [LEAST, LARGEST, -1.0, 0.0], **sides}
        return {key: value for key, value in header.items() if not self.adds or key not in range(3, 7)}


def legal(rng: random.Random, name: str = "a legal file") -> Case:
    """A file of random layers, slices, tables and priors, which may have a base."""
    maker, base = Maker(rng, rng.random() < 0.25), None
    file = made(rng, maker)
    if maker.base:
        base, file = file.data(), made(rng, maker.over(), file)
    return Case(name, file.data(), base, maker.scene, file.hashes())


def made(rng: random.Random, maker: Maker, base: File | None = None) -> File:
    """A file of a maker, whose base is another one."""
    layers = list[Layer]()
    for number in sorted(maker.layers):
        known = list[Prior]()
        count = 1 if maker.mode == blocks.LZMA else rng.choice((1, 1, 2, 3, rng.choice((5, 12))))
        own = [maker.slice(number, not index, known) for index in range(count)]
        order = blocks.morton_order(np.concatenate([x.cells for x in own]))
        codes = np.concatenate([x.codes for x in own])[order]
        classes = np.concatenate([x.codes * 0 if x.classes is None else x.classes for x in own])[order]
        raised = maker.codes + own[0].rises if number else maker.codes * (1 - own[0].rises)
        maker.codes, maker.classes = np.concatenate([raised, codes]), np.concatenate([maker.classes, classes])
        if number == 0:
            maker.of_base = maker.codes, maker.classes
        layers += own
    if maker.mode == blocks.LZMA:
        how = {"base": rng.choice((0, 0, None, K, -K, 1000)), "stream": rng.choice((lzma2.stored, lzma2.packed))}
        layers = [layer.packed(**how, width=rng.choice((None, 2))) for layer in layers]  # type: ignore[arg-type]
    header = maker.header(layers)
    file = blocks.make_file(*layers, header=header) if base is None else blocks.adding(base, *layers, header=header)
    if rng.random() < 0.2 and not maker.base:  # it ends after any slice
        whole = file.fields()[14]
        file = replace(file, chunks=file.chunks[: rng.randint(1, len(file.chunks))]).with_header({14: whole})
    return _with_what_is_ignored(rng, file)


@cache
def numbered(index: int) -> Case:
    """A random file of its own for each number."""
    return legal(random.Random(index), f"legal-{index}")


def _with_what_is_ignored(rng: random.Random, file: File) -> File:
    """Ancillary chunks, keys from 64 on, a minor version."""
    extra = [0, -1, 2**64 - 1, -(2**63), True, 0.5, "é", b"\xff" * 40, [], {}, {64: [{}]}]
    if rng.random() < 0.3:
        file = file.with_header({rng.choice((64, 255, 65536, 2**32 - 1)): rng.choice(extra) for _ in range(3)})
    if rng.random() < 0.3:
        file = replace(file, minor=near(rng, 0, 65535))
    if rng.random() < 0.3:
        at = rng.randrange(len(file.chunks))
        layer = file.layer(at)
        packed = blocks.pack({**layer.parameters(), rng.choice((64, 70000)): rng.choice(extra)})
        file = file.with_chunk(at, payload=layer.payload(packed))
    chunks = list(file.chunks)
    while rng.random() < 0.3:
        kind, size = rng.choice((3, 4, 1 << 15, 65535, rng.randint(3, 65535))), rng.choice((0, 1, 30, 500))
        chunks.insert(rng.randint(1, len(chunks)), blocks.ancillary(kind, rng.randbytes(size)))
    return replace(file, chunks=tuple(chunks))
