"""Legal `.pd4` files: the small valid vectors, and files of random choices that no encoder need make.

A random file is made from its symbols: the writer of the vectors says which hashes a decoder must arrive at. Every
choice that the format leaves is drawn, near its limits more often than not: tables of tensors, priors and their
parameters, step classes, predictors, slices, voxels, steps, what may be ignored. Half of the files are scenes, some of
which are bent: their tensors decode and may make no scene.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from vectors import lzma2
from vectors.blocks import (
    ANS,
    LZMA,
    File,
    Grid,
    Layer,
    Prior,
    adding,
    ancillary,
    make_file,
    make_layer,
    morton_order,
    ordered,
    pack,
    row_values,
)

from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.info import hashes

from . import ROOT

VECTORS = ROOT / "spec" / "vectors"
LARGEST_SEED = 6000  #: bytes of a vector: larger ones decode slowly
M, K, V = 1 << 23, 1 << 24, 1 << 20  #: largest symbol of a value, of a channel, and voxel index
GROUP = 5  #: layer rows of splats whose step is 1
LEAST, LARGEST = 2.0**-126, (2.0 - 2.0**-23) * 2.0**127


@dataclass(frozen=True)
class Seed:
    """A legal file to mutate, and its base."""

    name: str
    data: bytes
    base: bytes | None = None


def seeds(paths: Sequence[Path] = (), built: int = 60) -> list[Seed]:
    """The files at `paths` (or in them, if folders; those that do not decode are left out), small vectors, and `built`
    random files."""
    files = [file for path in paths for file in (sorted(path.rglob("*.pd4")) if path.is_dir() else [path])]
    found = [Seed(file.stem, file.read_bytes()) for file in files]
    for row in json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))["vectors"]:
        if row["file"].startswith(("valid/", "uncommon/")) and row["size"] <= LARGEST_SEED:
            data, base = (name and (VECTORS / name).read_bytes() for name in (row["file"], row.get("base")))
            found.append(Seed(Path(row["file"]).stem, data, base))
    made = [(file.data(), base and base.data()) for file, base in map(numbered, range(built))]
    return [*(Seed(f"legal-{i}", *own) for i, own in enumerate(made)), *(seed for seed in found if decodes(seed))]


def decodes(seed: Seed) -> bool:
    """Whether the package decodes a file."""
    try:
        hashes(seed.data, base=seed.base)
    except DecodeError:
        return False
    return True


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


def some_ids(rng: random.Random, count: int) -> list[int]:
    """Ascending."""
    return sorted(rng.sample(range(256), count) if rng.random() < 0.5 else range(count))


def step(rng: random.Random, values: Sequence[np.ndarray], most: int = 1) -> float:
    """A step that keeps these symbols finite, and all up to `most`."""
    largest = max([most, *(int(abs(v.astype(np.int64)).max(initial=0)) for v in values)])
    limit = min(LARGEST, (2.0**128 - 2.0**103) * (1 - 2.0**-40) / largest)
    single = np.float32([limit, rng.random() * 2.0 ** rng.randrange(-40, 20) + LEAST])
    single[0] = single[0] if float(single[0]) <= limit else np.nextafter(single[0], np.float32(0))
    return rng.choice((LEAST, 2.0**-7, *map(float, single)))


class Chooser:
    """Chooses priors for the channels of a slice, also of those that the list has. most: entries of the list."""

    def __init__(self, rng: random.Random, known: list[Prior], most: int):
        self._rng, self._known, self._most = rng, known, most
        self._alike = rng.random()  # how often a channel has a prior of the list

    def __call__(self, piece: str, number: int, k: list[int]) -> Prior:
        """A choice of `blocks.Choice`."""
        own, rng = self._known, self._rng
        left = self._most - sum(prior.n for prior in own)
        if own and (rng.random() < self._alike or left < 2):
            return rng.choice(own)
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


@dataclass
class Tables:
    """Of a layer: channels and sides of grids, inputs and outputs of chains, channels of layer rows, all by id."""

    grids: dict[int, tuple[int, tuple[int, ...]]] = field(default_factory=dict)
    chains: dict[int, tuple[int, int]] = field(default_factory=dict)
    rows: dict[int, int] = field(default_factory=dict)
    kind: list[int] | None = None


class Anything:
    """Tables of no known kind. widths: channels of the rows by id. read: of planes of the layers so far."""

    def __init__(self, rng: random.Random):
        self.rng = rng
        self.kind, self.read = self.any_kind(), 0
        self.widths = self.some(rng.choices((1, 2, 3, 7, 32), (3, 6, 3, 3, 0.2))[0], ((1, 3, 16), (6, 6, 1)))
        if rng.random() < 0.02:
            self.widths = {0: 256, 9: 256}

    def some(self, count: int, sizes: tuple[Sequence[int], Sequence[float]]) -> dict[int, int]:
        """So many sizes by id."""
        return {i: self.rng.choices(*sizes)[0] for i in some_ids(self.rng, count)}

    def any_kind(self) -> list[int]:
        """Of a scene or a deformation."""
        rng = self.rng
        return [rng.choice((0, 1, 2, 65535)), *(near(rng, 0, 65535) for _ in range(rng.choice((0, 0, 1, 2, 15))))]

    def sides(self, axes: int) -> tuple[int, ...]:
        """Of a grid."""
        return tuple(self.rng.choices((1, 2, 3, 5, 40), (8, 8, 8, 4, 1))[0] for _ in range(axes))

    def layer(self, number: int) -> Tables:
        """Of a layer, some of all forms."""
        rng, made = self.rng, Tables()
        channels, ends = ((1, 2, 3, 5, 9, 17, 33), (6, 6, 6, 3, 1, 1, 1)), ((1, 2, 5, 30), (3, 3, 3, 1))
        if rng.random() < 0.6:
            own = self.some(rng.choices((1, 2, 16), (9, 3, 0.1))[0], channels)
            made.grids = {i: (c, self.sides(rng.randint(1, 4))) for i, c in own.items()}
        if rng.random() < 0.6:
            own = self.some(rng.choices((1, 2, 5, 64), (3, 3, 3, 0.1))[0], ends)
            made.chains = {i: (wide, rng.choices(*ends)[0]) for i, wide in own.items()}
        if rng.random() < 0.3:
            made.rows = self.some(rng.choices((1, 2, 5, 32), (6, 6, 2, 0.1))[0], ((1, 2, 5, 16), (6, 6, 3, 1)))
        made.kind = self.any_kind() if rng.random() < 0.5 else None
        return made


class Scaffold(Anything):
    """A scaffold with HexPlanes."""

    def __init__(self, rng: random.Random):
        super().__init__(rng)
        self.d, self.g = rng.choices(((1, 1), (2, 3), (7, 2), (32, 10), (64, 16)), (9, 9, 6, 2, 1))[0]
        self.kind, self.widths = [0, self.g, rng.randrange(8)], {0: self.d, 1: 6, 2: 3 * self.g}
        self.channels = rng.choices((1, 2, 3, 5, 9, 17), (6, 6, 6, 3, 1, 1))[0]  # of all planes

    def layer(self, number: int) -> Tables:
        """Of a layer."""
        rng = self.rng
        if number == 0:
            inputs = [self.d + 3 * (self.kind[2] >> i & 1) for i in range(3)]
            return Tables(chains={i: (inputs[i], k * self.g) for i, k in enumerate((1, 7, 3))})
        if rng.random() < 0.4:
            return Tables()
        ids = some_ids(rng, rng.choices((1, 2, 8), (9, 3, 0.3))[0])
        self.read += self.channels * len(ids)
        between, heads = rng.choice((1, 2, 5)), {1: 3, 2: self.d, 3: 6, 4: 3 * self.g}
        chains = {i: (between, heads[i]) for i in sorted(rng.sample(sorted(heads), rng.randint(1, 4)))}
        kind = rng.choice(([0], [0, near(rng, 0, 65535)]))
        return Tables({i: (self.channels, self.sides(4)) for i in ids}, {0: (self.read, between)} | chains, {}, kind)


class Splats(Anything):
    """Splats with tracks, in groups or not."""

    def __init__(self, rng: random.Random):
        super().__init__(rng)
        self.kind, self.widths = [1], dict(enumerate((3, 3, 1, 3, 3)))
        self.widths |= rng.choice(({}, {5: 9}, {5: 24}, {5: 45, 6: 3}, {6: 3}))

    def layer(self, number: int) -> Tables:
        """Of a layer."""
        rng = self.rng
        if number == 0 or rng.random() < 0.4:
            return Tables()
        side = rng.choice((2, 3, 7, 40))
        heads = {h: near(rng, 1, 9) for h in sorted(rng.sample(range(5), rng.randint(1, 3)))}
        grids = {1 + h: (m * (3, 4, 3, 1, 3)[h], (side,)) for h, m in heads.items()}
        grids = {0: (1, (side,))} | grids
        if rng.random() < 0.5:
            return Tables(grids, {}, heads, [1])
        count = rng.choice((1, 2, 5, 40))
        grids |= {6: (3, (count,))} | {7 + h: (4 * m, (count,)) for h, m in heads.items() if rng.random() < 0.6}
        return Tables(grids, {}, heads | {GROUP: 1}, [1])


def bend(rng: random.Random, tables: Tables) -> None:
    """One thing of a layer's tables becomes another, still legal."""
    own: dict[int, Any] = rng.choice((tables.grids, tables.chains, tables.rows))
    i, act = rng.choice([*own, 0]), rng.randrange(5)
    if act == 0:
        tables.kind = rng.choice((None, [0], [1], [0, 7], [1, 7], [5]))
    elif act == 1:
        own.pop(i, None)
    elif act == 2 and i in own:
        own[rng.choice((5, 255))] = own.pop(i)
    elif own is tables.grids:
        c, sides = own.get(i, (1, (2,) * rng.randint(1, 4)))
        own[i] = (c + rng.randrange(2), sides[rng.randrange(2) :] or (3,))
    elif own is tables.chains:
        own[i] = tuple(v + rng.choice((0, 0, 1, 3)) for v in own.get(i, (1, 3)))
    else:
        own[i] = own.get(i, 0) + 1


# -- slices and files --------------------------------------------------------------------------------------------------


class Maker:
    """Makes the slices of a file. scene: whether they are sure to make one. base: whether others add to its layer 0."""

    def __init__(self, rng: random.Random, base: bool = False):
        self.rng, self.plan = rng, rng.choice((Anything, Anything, Scaffold, Splats))(rng)
        self.base, self.adds, self.base_rows = base, False, 0  # rows of the base that it adds to
        bent = type(self.plan) is not Anything and rng.random() < 0.4
        self.scene, self.bent = type(self.plan) is not Anything and not bent, bent
        self.mode = LZMA if rng.random() < 0.1 else ANS
        if bent and rng.random() < 0.3:
            self.plan.kind[-1] += rng.choice((1, 2, 60))
        elif bent and rng.random() < 0.4:
            self.plan.widths[rng.choice((1, 2, 7))] = rng.choice((1, 6, 9))
        self.table = [[i, c, 1.0, rng.randrange(3)] for i, c in sorted(self.plan.widths.items())]
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
        made.plan, made.table, made.base, made.adds = copy.copy(self.plan), copy.deepcopy(self.table), False, True
        made.codes, made.classes = self.of_base
        made.symbols = len(made.codes) * (4 + (made.centres is not None) + sum(c for _, c, _, _ in made.table))
        made.base_rows, made.plan.read, made.mode = len(made.codes), 0, LZMA if self.rng.random() < 0.1 else ANS
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
        return ordered(sorted(found))

    def rows(self, classes: list[int], table: Sequence[Sequence[Any]], centres: Sequence[int]) -> list[np.ndarray]:
        """int32 [C, n] of each of these tensors, in rows of these step classes."""
        made, few = list[np.ndarray](), self.rng.choice((M, M, 3, 50))
        for _, width, _, predictor in table:
            k = symbols(self.rng, width, len(classes), most=few)
            own, centres = centres[:width] or [0] * width, centres[width:]
            row_values(k, classes, own, predictor, mend=True)
            made.append(k)
        return made

    def grids(self, tables: Tables) -> list[Grid]:
        """With samples of any size; those of the first grid of tracks ascend."""
        made = list[Grid]()
        for i, (channels, sides) in tables.grids.items():
            grid = Grid(channels, sides, id=i)
            samples = [symbols(self.rng, *shape, most=self.rng.choice((M, 3))) for shape in grid.shapes()]
            if isinstance(self.plan, Splats) and i == 0:
                samples = [k * 0 + np.arange(k.size).reshape(k.shape) ** self.rng.choice((1, 2)) for k in samples]
            predictors = tuple(self.rng.randrange(2) for _ in samples)
            made.append(replace(grid, predictors=predictors, fill=lambda place, shape, samples=samples: samples[place]))  # type: ignore[misc]
        return made

    def chain(self, wide: int, last: int) -> list[np.ndarray]:
        """Weight, bias, weight, .. of up to 16 linear layers."""
        rng, made = self.rng, list[np.ndarray]()
        for out in [*(rng.choice((1, 2, 4)) for _ in range(rng.choices((0, 1, 2, 15), (9, 5, 2, 0.5))[0])), last]:
            most = rng.choice((M, M, 9))
            made += [symbols(rng, out, wide, most=most), symbols(rng, out, most=most)]
            wide = out
        return made

    def slice(self, number: int, first: bool, known: list[Prior]) -> Layer:
        """One slice, which refers to the priors of those before."""
        rng, tables = self.rng, Tables() if not first or (self.adds and number == 0) else self.plan.layer(number)
        if self.bent and tables != Tables() and rng.random() < 0.5:
            bend(rng, tables)
        tables.rows = {} if self.base and number == 0 else tables.rows
        if first:
            whole = {GROUP} if isinstance(self.plan, Splats) else set()
            steps = {i: 1.0 if i in whole else step(rng, (), M) for i in sorted(tables.rows)}
            self.layer_table = [[i, tables.rows[i], own, rng.randrange(3)] for i, own in steps.items()]
        cells = self.cells(rng.choices((0, 1, 2, 3, 5, 12, 40, 150), (4, 4, 4, 4, 4, 4, 1, 0.2))[0])
        lowest, high = rng.choice((3, 3, 200, 255)), rng.choice((0, 2, 255))
        graded = self.centres is not None
        classes, earlier = [near(rng, 0, 6) * graded for _ in cells], self.classes.tolist() if first else []
        rises = [near(rng, 0, min(high, 255 - int(code)) if number else 1) for code in self.codes] if first else []
        rises = [rise if code or number == 0 or rise > 2 else 0 for rise, code in zip(rises, self.codes, strict=False)]
        rows, layer_rows = (
            self.rows(classes, self.table, self.centres or []),
            self.rows(earlier + classes, self.layer_table, []),
        )
        grids = self.grids(replace(tables, grids=dict(sorted(tables.grids.items()))))
        chains = {i: self.chain(*ends) for i, ends in sorted(tables.chains.items())}
        planes, weights = [plane for grid in grids for plane in grid.planes()], sum(chains.values(), [])
        self.symbols += len(rises) + (4 + graded) * len(cells)
        self.symbols += sum(map(np.size, (*rows, *layer_rows, *planes, *weights)))
        layer = make_layer(
            number,
            cells,
            rises=rises,
            codes=[near(rng, lowest, 255) for _ in cells],
            rows=np.concatenate(rows),
            widths=[c for _, c, _, _ in self.table],
            classes=classes if graded else None,
            earlier=earlier,
            layer_rows={row[0]: k for row, k in zip(self.layer_table, layer_rows, strict=True)},
            grids=grids,
            chains=chains,
            fill=[near(rng, 0, 255) for _ in range(3)] if rng.random() < 0.2 else None,
            steps=(step(rng, planes), step(rng, weights)),
            choose=Chooser(rng, known, self.symbols + (1 << 18)),
            base=self.base_rows if first else 0,
            known=known,
            first=first,
        )
        meta = {key: value for key, value in layer.meta.items() if key < 6}
        extra = {6: tables.kind, 7: self.layer_table if first else None}
        return replace(layer, meta=meta | {key: value for key, value in extra.items() if value})

    def header(self, layers: Sequence[Layer]) -> dict[int, Any]:
        """The fields of a file of these slices."""
        rng = self.rng
        for i, row in enumerate(self.table):  # centres and the rows before add to symbols; others may add rows
            most = M if self.centres is not None or row[3] or self.base else 1
            row[2] = step(rng, [x.rows[i] for x in layers], most)
        header: dict[int, Any] = {2: self.mode, 3: self.plan.kind, 4: self.table, 5: self.centres}
        header[6] = step(rng, [x.cells for x in layers], V if self.base else 1)
        if rng.random() < 0.3:
            box = sorted(rng.choice((-LARGEST, -1.0, -0.0, 2.0**-149, LARGEST)) for _ in range(2))
            header |= {7: [box[0]] * 3 + [box[1]] * 3, 8: [-LARGEST, LARGEST], 9: [0.0, 1.0, 2.0**-149]}
            header |= {10: [-0.0, LARGEST], 11: [LARGEST, -0.0, -LARGEST], 12: rng.choice((0.0, -0.0, LARGEST))}
        if rng.random() < 0.3:
            sides = {3: near(rng, 1, 65535), 4: near(rng, 1, 65535)}
            header[13] = {1: [rng.choice((0.0, -LARGEST))] * 12, 2: [LEAST, LARGEST, -1.0, 0.0], **sides}
        return header


def legal(rng: random.Random) -> tuple[File, File | None, bool]:
    """(a file of random layers, slices, tables and priors, its base if it has one, whether it is sure to make a scene).
    `File.hashes` says what it decodes to."""
    maker = Maker(rng, rng.random() < 0.25)
    file = made(rng, maker)
    if not maker.base:
        return file, None, maker.scene
    return made(rng, maker.over(), file), file, maker.scene


def made(rng: random.Random, maker: Maker, base: File | None = None) -> File:
    """A file of a maker, whose base is another one."""
    layers = list[Layer]()
    for number in sorted({0, *rng.sample((1, 2), rng.randrange(3))}):
        known = list[Prior]()
        count = 1 if maker.mode == LZMA else rng.choice((1, 1, 2, 3, rng.choice((5, 12))))
        own = [maker.slice(number, not index, known) for index in range(count)]
        order = morton_order(np.concatenate([x.cells for x in own]))
        codes = np.concatenate([x.codes for x in own])[order]
        classes = np.concatenate([x.codes * 0 if x.classes is None else x.classes for x in own])[order]
        raised = maker.codes + own[0].rises if number else maker.codes * (1 - own[0].rises)
        maker.codes, maker.classes = np.concatenate([raised, codes]), np.concatenate([maker.classes, classes])
        if number == 0:
            maker.of_base = maker.codes, maker.classes
        layers += own
    if maker.mode == LZMA:
        how = {"base": rng.choice((0, 0, None, K, -K, 1000)), "stream": rng.choice((lzma2.stored, lzma2.packed))}
        layers = [layer.packed(**how, width=rng.choice((None, 2))) for layer in layers]  # type: ignore[arg-type]
    header = maker.header(layers)
    if base is None:
        file = make_file(*layers, header=header)
    else:
        file = adding(base, *layers, header={key: value for key, value in header.items() if key not in range(3, 7)})
    if rng.random() < 0.2 and not maker.base:  # it ends after any slice
        whole = file.fields()[14]
        file = replace(file, chunks=file.chunks[: rng.randint(1, len(file.chunks))]).with_header({14: whole})
    return _with_what_is_ignored(rng, file)


@cache
def numbered(index: int) -> tuple[File, File | None]:
    """A random file of its own for each number, and its base."""
    return legal(random.Random(index))[:2]


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
        packed = pack({**layer.parameters(), rng.choice((64, 70000)): rng.choice(extra)})
        file = file.with_chunk(at, payload=layer.payload(packed))
    chunks = list(file.chunks)
    while rng.random() < 0.3:
        kind, size = rng.choice((3, 4, 1 << 15, 65535, rng.randint(3, 65535))), rng.choice((0, 1, 30, 500))
        chunks.insert(rng.randint(1, len(chunks)), ancillary(kind, rng.randbytes(size)))
    return replace(file, chunks=tuple(chunks))
