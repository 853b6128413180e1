"""Legal `.pd4` files: the small valid vectors, and files of random choices that no encoder need make.

A random file is made from its symbols: the writer of the vectors says which hashes a decoder must arrive at. Every
choice that the format leaves is drawn, near its limits more often than not: tables of tensors, priors and their
parameters, step classes, predictors, slices, voxels, steps, what may be ignored. Half of the files are scenes, of which
some are bent so that their tensors decode and may make no scene.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
    Known,
    Layer,
    Prior,
    ancillary,
    make_file,
    make_layer,
    morton_order,
    row_values,
    ordered,
    pack,
)

from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.info import hashes

VECTORS = Path(__file__).resolve().parents[2] / "spec" / "vectors"
LARGEST_SEED = 6000  #: bytes of a vector: larger ones decode slowly
M, K, V = 1 << 23, 1 << 24, 1 << 20  #: largest symbol of a value, of a channel, and voxel index
LEAST, LARGEST = 2.0**-126, (2.0 - 2.0**-23) * 2.0**127
TO_INFINITY = 2.0**128 - 2.0**103


@dataclass(frozen=True)
class Seed:
    """A legal file to mutate."""

    name: str
    data: bytes


def seeds(paths: Sequence[Path] = (), built: int = 60) -> list[Seed]:
    """The files at `paths` (or in them, if folders; those that do not decode are left out), small vectors, and `built`
    random files."""
    found = [file for path in paths for file in (sorted(path.rglob("*.pd4")) if path.is_dir() else [path])]
    vectors = [file for folder in ("valid", "uncommon") for file in sorted((VECTORS / folder).glob("*.pd4"))]
    found += [file for file in vectors if file.stat().st_size <= LARGEST_SEED]
    random_files = [Seed(f"legal-{i}", numbered(i).data()) for i in range(built)]
    return [*random_files, *(Seed(file.stem, file.read_bytes()) for file in found if decodes(file.read_bytes()))]


def decodes(data: bytes) -> bool:
    """Whether the package decodes a file."""
    try:
        hashes(data)
    except DecodeError:
        return False
    return True


# -- numbers -----------------------------------------------------------------------------------------------------------


def symbols(rng: random.Random, *shape: int, most: int = M) -> np.ndarray:
    """int32 of `shape` in -most..most: alike, small, of any size, few that are large, or at the ends."""
    numbers, kind = np.random.default_rng(rng.randrange(1 << 32)), rng.randrange(7)
    if kind == 0:
        return np.full(shape, rng.choice((0, 1, -1, most, -most, rng.randint(-most, most))), np.int32)
    if kind == 1:
        return numbers.choice([-most, most, 0], shape).astype(np.int32)
    if kind == 2:
        return numbers.integers(-most, most, shape, endpoint=True).astype(np.int32)
    k = np.rint(numbers.normal(rng.choice((0, 0, 300)), rng.choice((0.4, 1.5, 40, 9000)), shape))
    if kind == 3:
        k[numbers.random(shape) < 0.1] = rng.choice((most, -most, 1000))
    return k.clip(-most, most).astype(np.int32)


def near(rng: random.Random, low: int, high: int) -> int:
    """An integer in low..high, often at an end."""
    return rng.choice((low, high, rng.randint(low, high), rng.randint(low, min(high, low + 40))))


def _single(value: float) -> float:
    """The largest binary32 value that is not above."""
    nearest = np.float32(value)
    return float(nearest if float(nearest) <= value else np.nextafter(nearest, np.float32(0)))


def _step(rng: random.Random, values: Sequence[np.ndarray], most: int = 1) -> float:
    """A step that keeps these symbols finite, and all up to `most`."""
    largest = max([most, *(int(abs(v.astype(np.int64)).max(initial=0)) for v in values)])
    limit = _single(min(LARGEST, TO_INFINITY * (1 - 2.0**-40) / largest))
    return rng.choice((LEAST, limit, 2.0**-7, _single(rng.random() * 2.0 ** rng.randrange(-40, 20) + LEAST)))


# -- priors ------------------------------------------------------------------------------------------------------------


class Chooser:
    """Chooses priors for the channels of a slice, also of those that the lists have. left: entries it may define."""

    def __init__(self, rng: random.Random, known: Known):
        self._rng, self._known, self.left = rng, known, 0
        self._alike = {which: rng.random() for which in range(3)}  # how often a channel has a prior of the list

    def __call__(self, which: int, piece: str, number: int, k: list[int]) -> Prior:
        """A choice of `blocks.Choice`."""
        own, rng = self._known[which], self._rng
        left = self.left - sum(not other for other in self._known if other is not own)  # each may need one entry
        if own and (rng.random() < self._alike[which] or left < 2):
            return rng.choice(own)
        made = prior(rng, min(k), max(k), min(left, 1 << 14))
        self.left -= made.n
        return made


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

Arrays = dict[int, list[np.ndarray]]  #: weight, bias, weight, .. of chains by id


class Choices:
    """What holds for a whole file: tables of rows, centres, voxels and codes so far; of a scene, its widths and what
    the trunks read. bent: its tensors may make no scene."""

    def __init__(self, rng: random.Random):
        self.rng, self.scene = rng, rng.random() < 0.5
        self.bent = self.scene and rng.random() < 0.4
        self.feature, self.slots = rng.choices(((1, 1), (2, 3), (7, 2), (32, 10), (64, 16)), (9, 9, 6, 2, 1))[0]
        self.views = rng.randrange(8)
        self.kind = [0, self.slots, self.views] if self.scene else self.any_kind()
        count = rng.choices((1, 2, 3, 7, 32), (3, 6, 3, 3, 0.2))[0]
        self.widths = [rng.choices((1, 3, 16, 256), (6, 6, 3, 0.2))[0] for _ in range(count)]
        self.widths = (
            [self.feature, 6, 3 * self.slots]
            if self.scene
            else self.widths
            if sum(self.widths) <= 512
            else [512 // count] * count
        )
        self.ids = [*range(3)] if self.scene else self.some_ids(len(self.widths))
        if self.bent and rng.random() < 0.3:
            where = rng.choice((self.kind, self.ids, self.widths))
            where[rng.choice((-1, -1 if where is self.ids else 0))] += rng.choice((1, 1, 2, 60))
        self.mode = LZMA if rng.random() < 0.1 else ANS
        self.graded = rng.random() < 0.4
        self.centres = symbols(rng, sum(self.widths)).tolist() if self.graded else None
        self.table = [[i, c, 1.0, rng.randrange(2)] for i, c in zip(self.ids, self.widths, strict=True)]
        self.layer_table = list[Any]()  # of the layer
        self.channels = rng.choices((1, 2, 3, 5, 9, 17), (6, 6, 6, 3, 1, 1))[0]  # of the planes of a scene
        self.read = 0  # plane channels of the layers so far
        self.taken = set[tuple[int, ...]]()
        self.codes = self.classes = np.zeros(0, np.int64)  # of the layers so far

    def some_ids(self, count: int) -> list[int]:
        """Ascending."""
        return sorted(self.rng.sample(range(256), count) if self.rng.random() < 0.5 else range(count))

    def some_rows(self) -> list[list[Any]]:
        """A table of rows of a layer."""
        rng = self.rng
        ids = self.some_ids(rng.choices((1, 2, 5, 32), (6, 6, 2, 0.1))[0])
        return [[i, rng.choices((1, 2, 5, 16), (6, 6, 3, 1))[0], _step(rng, (), most=M), rng.randrange(2)] for i in ids]

    def any_kind(self) -> list[int]:
        """Of a scene or a deformation."""
        rng = self.rng
        return [rng.choice((0, 0, 1, 65535)), *(near(rng, 0, 65535) for _ in range(rng.choice((0, 1, 2, 15))))]

    def cells(self, count: int) -> list[list[int]]:
        """At most so many voxels that are free, of a slice."""
        rng = self.rng
        kind, at = rng.randrange(5), [rng.choice((0, 0, -9, V - 8, 8 - V, rng.randint(-V, V))) for _ in range(3)]
        draw: Callable[[], list[int]] = [
            lambda: [rng.choice((-V, 1 - V, -1, 0, 1, V - 1, V)) for _ in range(3)],
            lambda: [rng.randint(-V, V) for _ in range(3)],
            lambda: [a + rng.randrange(2) for a in at],
            lambda: [at[0] + rng.randrange(60), at[1], at[2]],
            lambda: [a + rng.randrange(8) for a in at],
        ][kind]
        found = {tuple(min(v, V) for v in draw()) for _ in range(count)} - self.taken
        for axis in range(3):  # a slice reaches over 2^21 voxels
            if {-V, V} <= {cell[axis] for cell in found}:
                found = {cell for cell in found if cell[axis] < V}
        self.taken |= found
        return ordered(sorted(found))

    def rows(self, classes: list[int], table: Sequence[Sequence[Any]], centres: Sequence[int] | None) -> list[np.ndarray]:
        """int32 [C, n] of each of these tensors, in rows of these step classes."""
        made, few = list[np.ndarray](), self.rng.choice((M, M, 3, 50))
        for _, width, _, predictor in table:
            k = symbols(self.rng, width, len(classes), most=few)
            row_values(k, classes, ([0] * width if centres is None else centres)[:width], predictor, mend=True)
            centres = centres and centres[width:]
            made.append(k)
        return made

    def grids(self, number: int) -> list[Grid]:
        """Of a layer, none or some."""
        rng = self.rng
        if rng.random() < 0.4 or (self.scene and number == 0):
            return []
        made = list[Grid]()
        for i in self.some_ids(rng.choices((1, 2, 8, 16), (9, 3, 0.3, 0.1 * (not self.scene)))[0]):
            axes = 4 if self.scene else rng.randint(1, 4)
            sides = tuple(rng.choices((1, 2, 3, 5, 40), (8, 8, 8, 4, 1))[0] for _ in range(axes))
            channels = self.channels if self.scene else rng.choices((1, 2, 3, 5, 9, 17, 33), (6, 6, 6, 3, 1, 1, 1))[0]
            grid = Grid(channels, sides, id=i)
            samples = [symbols(rng, *shape, most=rng.choice((M, 3))) for shape in grid.shapes()]
            predictors = tuple(rng.randrange(2) for _ in samples)
            made.append(replace(grid, predictors=predictors, fill=lambda place, shape, samples=samples: samples[place]))  # type: ignore[misc]
        return made

    def chains(self, number: int, grids: Sequence[Grid]) -> Arrays:
        """Of a layer."""
        rng, d, g = self.rng, self.feature, self.slots
        self.read += sum(grid.channels for grid in grids)
        ends: dict[int, tuple[int, int]] = {}  # inputs and outputs by id
        if not self.scene:
            ids = self.some_ids(rng.choices((0, 1, 2, 5, 64), (3, 3, 3, 3, 0.1))[0])
            ends = {i: (rng.choice((1, 2, 5, 30)), rng.choice((1, 2, 5, 30))) for i in ids}
        elif number == 0:
            ends = {i: (d + 3 * (self.views >> i & 1), k * g) for i, k in enumerate((1, 7, 3))}
        elif grids:
            between, heads = rng.choice((1, 2, 5)), {1: 3, 2: d, 3: 6, 4: 3 * g}
            ends = {0: (self.read, between)} | {
                i: (between, heads[i]) for i in sorted(rng.sample(sorted(heads), rng.randint(1, 4)))
            }
        if self.bent and ends and rng.random() < 0.5:  # another id, one more or less, other ends
            i = rng.choice([*ends])
            wide, out = ends.pop(i)
            bent = {
                i: (wide + rng.choice((0, 1, 3)), out + rng.choice((0, 0, 1))),
                rng.choice((i, 3, 5, 255)): (wide, out),
            }
            ends = dict(sorted((ends | rng.choice((bent, {}))).items()))
        made: Arrays = {}
        for key, (wide, last) in ends.items():
            made[key] = []
            for out in [*(rng.choice((1, 2, 4)) for _ in range(rng.choices((0, 1, 2, 15), (9, 5, 2, 0.5))[0])), last]:
                most = rng.choice((M, M, 9))
                made[key] += [symbols(rng, out, wide, most=most), symbols(rng, out, most=most)]
                wide = out
        return made


# -- slices and files --------------------------------------------------------------------------------------------------


def _slice(choices: Choices, number: int, first: bool, known: Known) -> Layer:
    rng = choices.rng
    cells = choices.cells(rng.choices((0, 1, 2, 3, 5, 12, 40, 150), (4, 4, 4, 4, 4, 4, 1, 0.2))[0])
    lowest, high = rng.choice((3, 3, 200, 255)), rng.choice((0, 2, 255))
    classes = [near(rng, 0, 6) * choices.graded for _ in cells]
    grids = choices.grids(number) if first else []
    chains = choices.chains(number, grids) if first else {}
    kind: list[int] | None = None
    if first and (rng.random() < 0.5 if not choices.scene else number and grids):
        kind = choices.any_kind() if not choices.scene else rng.choice(([0], [0, near(rng, 0, 65535)]))
    if choices.bent and first and rng.random() < 0.2:
        grids, kind = rng.choice(
            ((grids[1:], kind), ([replace(x, id=x.id) for x in grids], choices.any_kind()), (grids, None))
        )
    earlier = choices.classes.tolist() if first else []
    rises = [near(rng, 0, min(high, 255 - int(code))) for code in choices.codes] if first else []
    choose = Chooser(rng, known)
    if first:
        choices.layer_table = choices.some_rows() if rng.random() < (0.1 * choices.bent if choices.scene else 0.3) else []
    rows = choices.rows(classes, choices.table, choices.centres)
    layer_rows = choices.rows(earlier + classes, choices.layer_table, None)
    planes = [plane for grid in grids for plane in grid.planes()]
    weights = [array for own in chains.values() for array in own]
    counted = len(rises) + (4 + choices.graded) * len(cells) + sum(map(np.size, (*rows, *layer_rows, *planes, *weights)))
    choose.left = counted + (1 << 18 if first else 1 << 10)
    layer = make_layer(
        number,
        cells,
        rises=rises,
        codes=[near(rng, lowest, 255) for _ in cells],
        rows=np.concatenate(rows),
        widths=choices.widths,
        classes=classes if choices.graded else None,
        earlier=earlier,
        layer_rows=layer_rows,
        grids=grids,
        chains=chains,
        kind=kind,
        fill=[near(rng, 0, 255) for _ in range(3)] if rng.random() < 0.2 else None,
        steps=(_step(rng, planes), _step(rng, weights)),
        priors=choose,
        known=known,
    )
    layer.meta.pop(7, None)
    layer.meta.update({7: choices.layer_table} if first and choices.layer_table else {})
    return layer


def legal(rng: random.Random) -> tuple[File, bool]:
    """(a file of random layers, slices, tables and priors, whether it is sure to make a scene). `File.hashes` says what
    it decodes to."""
    choices, layers = Choices(rng), list[Layer]()
    for number in sorted({0, *rng.sample((1, 2), rng.randrange(3))}):
        known, count = Known(), 1 if choices.mode == LZMA else rng.choice((1, 1, 2, 3, rng.choice((5, 12))))
        own = [_slice(choices, number, not index, known) for index in range(count)]
        order = morton_order(np.concatenate([x.cells for x in own]))
        codes = np.concatenate([x.codes for x in own])[order]
        choices.codes = np.concatenate([choices.codes + own[0].rises, codes])
        classes = np.concatenate([x.codes * 0 if x.classes is None else x.classes for x in own])[order]
        choices.classes = np.concatenate([choices.classes, classes])
        layers += own
    if choices.mode == LZMA:
        how = {"base": rng.choice((0, 0, None, K, -K, 1000)), "stream": rng.choice((lzma2.stored, lzma2.packed))}
        layers = [layer.packed(**how, width=rng.choice((None, 2))) for layer in layers]  # type: ignore[arg-type]
    file = make_file(*layers, header=_header(choices, layers))
    if rng.random() < 0.2:  # it ends after any slice
        whole = file.fields()[14]
        file = replace(file, chunks=file.chunks[: rng.randint(1, len(file.chunks))]).with_header({14: whole})
    return _with_what_is_ignored(rng, file), choices.scene and not choices.bent


@cache
def numbered(index: int) -> File:
    """A random file of its own for each number."""
    return legal(random.Random(index))[0]


def _header(choices: Choices, layers: Sequence[Layer]) -> dict[int, Any]:
    rng = choices.rng
    for i, row in enumerate(choices.table):  # centres and the rows before add to symbols
        row[2] = _step(rng, [x.rows[i] for x in layers], most=M if choices.graded or row[3] else 1)
    header: dict[int, Any] = {2: choices.mode, 3: choices.kind, 4: choices.table, 5: choices.centres}
    header[6] = _step(rng, [x.cells for x in layers])
    if rng.random() < 0.3:
        box = sorted(rng.choice((-LARGEST, -1.0, -0.0, 2.0**-149, LARGEST)) for _ in range(2))
        header |= {
            7: [box[0]] * 3 + [box[1]] * 3,
            8: [-LARGEST, LARGEST],
            9: [0.0, 1.0, 2.0**-149],
            10: [-0.0, LARGEST],
        }
        header |= {11: [LARGEST, -0.0, -LARGEST], 12: rng.choice((0.0, -0.0, LARGEST)), 14: rng.randbytes(16)}
    if rng.random() < 0.3:
        sides = {3: near(rng, 1, 65535), 4: near(rng, 1, 65535)}
        header[13] = {1: [rng.choice((0.0, -LARGEST))] * 12, 2: [LEAST, LARGEST, -1.0, 0.0], **sides}
    return header


def _with_what_is_ignored(rng: random.Random, file: File) -> File:
    """Ancillary chunks, keys from 64 on, a minor version."""
    extra = [0, -1, 2**64 - 1, -(2**63), True, 0.5, "é", b"\xff" * 40, [], {}, {64: [{}]}]
    if rng.random() < 0.3:
        keys = {rng.choice((64, 255, 65536, 2**32 - 1)): rng.choice(extra) for _ in range(3)}
        file = file.with_header(dict(sorted(keys.items())))
    if rng.random() < 0.3:
        file = replace(file, minor=near(rng, 0, 65535))
    chunks = list(file.chunks)
    if rng.random() < 0.3:
        at = rng.randrange(len(chunks))
        layer = chunks[at].layer
        assert layer is not None
        packed = pack({**layer.parameters(), rng.choice((64, 70000)): rng.choice(extra)})
        chunks[at] = replace(chunks[at], payload=layer.payload(packed))
    while rng.random() < 0.3:
        kind, size = rng.choice((3, 4, 1 << 15, 65535, rng.randint(3, 65535))), rng.choice((0, 1, 30, 500))
        made = ancillary(kind, rng.randbytes(size))
        chunks.insert(rng.randint(1, len(chunks)), made)
    return replace(file, chunks=tuple(chunks))
