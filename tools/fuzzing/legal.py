"""Legal `.pd4` files: the small valid vectors, and files of random choices that no encoder need make.

A random file is made from its symbols: the writer of the vectors says which hashes a decoder must arrive at. Every
choice that the format leaves is drawn, near its limits more often than not: priors and their parameters, step classes,
predictors, slices, voxels, steps, what may be ignored.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from vectors import blocks, lzma2
from vectors.blocks import (
    LZMA,
    PLANE,
    POSITIONS,
    SYMBOLS,
    WEIGHTS,
    File,
    Known,
    Layer,
    Scale,
    Slices,
    ancillary,
    coded,
    make_file,
    make_layer,
    ordered,
    positions,
    varint,
)

from pd4dgs_codec.entropy.priors import Const, Gauss, Mixture, Normal, Prior, Window
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.morton import morton_order
from pd4dgs_codec.scene import SCAFFOLD_NETWORKS, Widths, plane_shapes

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


def _near(rng: random.Random, low: int, high: int) -> int:
    """An integer in low..high, often at an end."""
    return rng.choice((low, high, rng.randint(low, high), rng.randint(low, min(high, low + 40))))


def _single(value: float) -> float:
    """The largest binary32 value that is not above."""
    nearest = np.float32(value)
    return float(nearest if float(nearest) <= value else np.nextafter(nearest, np.float32(0)))


def _step(rng: random.Random, *values: np.ndarray, most: int = 1) -> float:
    """A step that keeps these symbols finite, and all up to `most`."""
    largest = max([most, *(int(abs(v.astype(np.int64)).max(initial=0)) for v in values)])
    limit = _single(min(LARGEST, TO_INFINITY * (1 - 2.0**-40) / largest))
    return rng.choice((LEAST, limit, 2.0**-7, _single(rng.random() * 2.0 ** rng.randrange(-40, 20) + LEAST)))


# -- priors ------------------------------------------------------------------------------------------------------------


@dataclass
class Section:
    """Chooses priors for a section of coded channels, also of those that the slices before defined."""

    rng: random.Random
    known: Known = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)

    def coded(self, channels: Iterable[np.ndarray]) -> bytes:
        """The section."""
        own = [np.asarray(k).ravel() for k in channels]
        self.left = sum(map(len, own)) + (1 << 10 if self.known else 1 << 18)
        alike = self.rng.random()  # how often a channel has a prior of its own
        return coded(own, {c: self._prior(k, alike) for c, k in enumerate(own) if k.size}, self.known)

    def _prior(self, k: np.ndarray, alike: float) -> Prior:
        if self.priors and (self.rng.random() < alike or self.left < 2):
            return self.rng.choice(self.priors)
        made = prior(self.rng, k, min(self.left, 1 << 14))
        self.left -= made.window.n
        self.priors.append(made)
        return made


def prior(rng: random.Random, k: np.ndarray, most: int) -> Prior:
    """Any prior of at most so many entries, at least 1; symbols outside its window become exceptions."""
    low, high = int(k.min()), int(k.max())
    if most < 2 or rng.random() < 0.15:
        return Const(Window(rng.choice((low, high, K, -K)), 1))
    span = high - low + 1
    n = rng.choice((2, 3, 7, min(span, 300), min(span, 90) + rng.randrange(2)))
    if rng.random() < 0.01:
        n = rng.choice((span, 1 << 14))
    n = min(most, max(2, n))
    least = rng.choice((low, low, low, low - rng.randrange(3), high, K, -K))
    window = Window(max(-K, min(least, K - n + 1)), n)
    if rng.random() < 0.5:
        return Gauss(window, _normal(rng, n))
    return Mixture(window, _normal(rng, n), _normal(rng, n), _near(rng, 1, 255))


def _normal(rng: random.Random, n: int) -> Normal:
    offset = rng.choice((0, rng.randint(-128 * n, 128 * n), rng.randint(-(1 << 31), 1 << 31), 1 << 31, -(1 << 31)))
    return Normal(offset + 128 * (n - 1), rng.choice((-640, 1280, rng.randint(-640, 1280), 64 * n.bit_length() - 128)))


# -- slices ------------------------------------------------------------------------------------------------------------


class Choices:
    """What holds for a whole file: widths, centres, the planes' channels, the scales, voxels and codes so far."""

    def __init__(self, rng: random.Random):
        self.rng = rng
        feature, slots = rng.choices(((1, 1), (2, 3), (7, 2), (32, 10), (64, 16)), (9, 9, 6, 2, 1))[0]
        viewing = tuple(name for name in SCAFFOLD_NETWORKS if rng.random() < 0.6)
        self.widths = Widths(feature, slots, viewing=viewing)
        self.mode = LZMA if rng.random() < 0.1 else blocks.ANS
        self.graded = rng.random() < 0.4
        self.centres = symbols(rng, self.widths.channels).tolist() if self.graded else None
        self.channels = rng.choices((1, 2, 3, 5, 9, 17), (6, 6, 6, 3, 1, 1))[0]  # of all planes
        self.scales = list[Scale]()  # of the layers so far
        self.taken = set[tuple[int, int, int]]()
        self.codes = np.zeros(0, np.int64)

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
        self.taken |= found  # type: ignore[arg-type]
        return ordered(sorted(found))

    def attributes(self, classes: np.ndarray) -> np.ndarray:
        """int32 [channels, n] of rows of these step classes."""
        k = np.stack([symbols(self.rng, len(classes)) for _ in range(self.widths.channels)])
        if self.rng.random() < 0.3:
            k = symbols(self.rng, self.widths.channels, len(classes), most=self.rng.choice((3, 50)))
        if self.centres is not None:
            reach = k.astype(np.int64) << classes
            k[abs(reach + np.array(self.centres)[:, None]) > M] = 0
        return k


def _written(rng: random.Random) -> Slices:
    """Writes the slices of a layer under priors as chance has it."""
    anchors = (Section(rng).coded for _ in range(3))
    return Slices(*anchors, grades=lambda channels: Section(rng).coded(channels))


def _lzma(rng: random.Random, layer: Layer) -> Layer:
    """The only slice of a layer, with its positions and section SYMBOLS."""
    found: dict[int, bytes | None] = {}
    if layer.codes.size:
        found[POSITIONS] = positions(layer.cells, Section(rng).coded)
    if any(channel.size for channel in layer.channels):
        stream = rng.choice((lzma2.stored, lzma2.packed))
        base = rng.choice((0, 0, None, K, -K, 1000))
        how = {"base": base, "width": rng.choice((None, 2)), "planar": rng.random() < 0.5, "stream": stream}
        found[SYMBOLS] = blocks.lzma_symbols(layer.channels, **how)  # type: ignore[arg-type]
    return layer.with_sections(found)


# -- layers ------------------------------------------------------------------------------------------------------------


def _slice(choices: Choices, number: int, first: bool) -> Layer:
    rng = choices.rng
    cells = choices.cells(rng.choices((0, 1, 2, 3, 5, 12, 40, 150), (4, 4, 4, 4, 4, 4, 1, 0.2))[0])
    lowest = rng.choice((3, 3, 200, 255))
    classes = [_near(rng, 0, 6) for _ in cells]
    fields: dict[str, Any] = {
        "attributes": choices.attributes(np.array(classes, np.int64)),
        "codes": [_near(rng, lowest, 255) for _ in cells],
        "classes": classes if choices.graded else None,
        "widths": choices.widths,
        "mode": None,
    }
    if not first:
        return make_layer(number, cells, networks={}, **fields)
    high = rng.choice((0, 2, 255))
    rises = [_near(rng, 0, min(high, 255 - int(code))) for code in choices.codes]
    scales = _scales(rng, choices.channels) if number and rng.random() < 0.6 else []
    choices.scales += scales
    read = choices.channels * len(choices.scales)
    networks = _networks(rng, number, choices.widths, read) if scales or not number else None
    layer = make_layer(number, cells, before=len(rises), rises=rises, scales=scales, networks=networks, **fields)
    if layer.weights:
        layer.meta[3] = [_step(rng, *own) for own in ((layer.planes, layer.weights) if number else (layer.weights,))]
    if scales and rng.random() < 0.5:
        layer.meta[6] = _near(rng, 0, 65535)
    return layer if choices.mode == LZMA else layer.with_sections(_tensors(rng, layer))


def _tensors(rng: random.Random, layer: Layer) -> dict[int, bytes | None]:
    """The sections of planes and weights."""
    found: dict[int, bytes | None] = {WEIGHTS: Section(rng).coded(layer.weights)} if layer.weights else {}
    if not layer.flat:
        return found
    payloads = [Section(rng).coded(stage) for stage in blocks.plane_stages(layer.residuals)]
    return found | {PLANE: varint(*map(len, payloads[:-1])) + b"".join(payloads)}


def _scales(rng: random.Random, channels: int) -> list[Scale]:
    made = list[Scale]()
    for _ in range(rng.choices((1, 2, 8), (9, 3, 0.3))[0]):
        sides = [rng.choices((1, 2, 3, 5, 40), (8, 8, 8, 4, 1))[0] for _ in range(4)]
        shapes = plane_shapes(channels, sides).items()
        samples = {name: symbols(rng, *shape, most=rng.choice((M, 3))) for name, shape in shapes}
        predictors = tuple(rng.randrange(2) for _ in samples)
        made.append(Scale(channels, tuple(sides), predictors, lambda n, shape, samples=samples: samples[n]))  # type: ignore
    return made


def _networks(rng: random.Random, number: int, widths: Widths, read: int) -> dict[int, list[np.ndarray]]:
    """read: features of the planes that a trunk reads."""
    d, g = widths.feature, widths.slots
    outputs = {1: 3, 2: d, 3: 3 * g, 4: 6} if number else {0: g, 1: 7 * g, 2: 3 * g}
    inputs, made = [*widths.inputs.values()], dict[int, list[np.ndarray]]()
    if number:
        outputs = {0: rng.choice((1, 2, 5))} | {
            i: outputs[i] for i in sorted(rng.sample(sorted(outputs), rng.randint(1, 4)))
        }
    for key, last in outputs.items():
        wide, made[key] = read if number else inputs[key], []
        if number and key:
            wide = made[0][-1].size
        for out in [*(rng.choice((1, 2, 4)) for _ in range(rng.choices((0, 1, 2, 15), (9, 5, 2, 0.5))[0])), last]:
            most = rng.choice((M, M, 9))
            made[key] += [symbols(rng, out, wide, most=most), symbols(rng, out, most=most)]
            wide = out
    return made


# -- files -------------------------------------------------------------------------------------------------------------


def legal(rng: random.Random) -> File:
    """A file of random layers, slices, widths, forms and priors. `File.hashes` says what it decodes to."""
    choices, layers = Choices(rng), list[Layer]()
    for number in sorted({0, *rng.sample((1, 2), rng.randrange(3))}):
        write, count = partial(_lzma, rng), 1
        if choices.mode != LZMA:
            write, count = _written(rng).add, rng.choice((1, 1, 2, 3, rng.choice((5, 12))))
        own = [write(_slice(choices, number, not index)) for index in range(count)]
        order = morton_order(np.concatenate([x.cells for x in own]))
        codes = np.concatenate([x.codes for x in own])[order]
        choices.codes = np.concatenate([choices.codes + own[0].rises, codes])
        layers += own
    file = make_file(*layers, header=_header(choices, layers))
    if rng.random() < 0.2:  # it ends after any slice
        whole = file.fields()[14]
        file = replace(file, chunks=file.chunks[: rng.randint(1, len(file.chunks))]).with_header({14: whole})
    return _with_what_is_ignored(rng, file)


@cache
def numbered(index: int) -> File:
    """A random file of its own for each number."""
    return legal(random.Random(index))


def _header(choices: Choices, layers: Sequence[Layer]) -> dict[int, Any]:
    rng, (d, g) = choices.rng, (choices.widths.feature, choices.widths.slots)
    every = M if choices.graded else 1  # centres add to symbols
    rows = [
        np.concatenate([x.attributes[a:b].ravel() for x in layers])
        for a, b in ((0, d), (d, d + 6), (d + 6, d + 6 + 3 * g))
    ]
    header: dict[int, Any] = {2: choices.mode, 4: [_step(rng, k, most=every) for k in rows]}
    header[5] = _step(rng, *(x.cells for x in layers))
    if choices.centres is not None:
        header[3] = choices.centres
    if rng.random() < 0.3:
        box = sorted(rng.choice((-LARGEST, -1.0, -0.0, 2.0**-149, LARGEST)) for _ in range(2))
        header |= {6: [box[0]] * 3 + [box[1]] * 3, 7: [-LARGEST, LARGEST], 8: [0.0, 1.0, 2.0**-149], 9: [-0.0, LARGEST]}
        header |= {10: [LARGEST, -0.0, -LARGEST], 11: rng.choice((0.0, -0.0, LARGEST)), 14: rng.randbytes(16)}
        header[13] = {i: rng.choice((0.0, -0.0, LARGEST)) for i in range(8)}
    if rng.random() < 0.3:
        header[12] = {
            1: [rng.choice((0.0, -LARGEST))] * 12,
            2: [LEAST, LARGEST, -1.0, 0.0],
            3: _near(rng, 1, 65535),
            4: 1,
        }
    return header


def _with_what_is_ignored(rng: random.Random, file: File) -> File:
    """Ancillary chunks, keys from 64 on, a minor version."""
    extra = [0, -1, 2**64 - 1, -(2**63), True, 0.5, "é", b"\xff" * 40, [], {}, {64: [{}]}]
    if rng.random() < 0.3:
        keys = {rng.choice((64, 255, 65536, 2**32 - 1)): rng.choice(extra) for _ in range(3)}
        file = file.with_header(dict(sorted(keys.items())))
    if rng.random() < 0.3:
        file = replace(file, minor=_near(rng, 0, 65535))
    chunks = list(file.chunks)
    if rng.random() < 0.3:
        at = rng.randrange(len(chunks))
        layer = chunks[at].layer
        assert layer is not None
        meta, lengths = layer.parameters(), {rng.choice((64, 2**32 - 1)): rng.choice(extra[:-1])}
        packed = blocks.canonical.pack({**meta, 2: {**meta[2], **lengths}, rng.choice((64, 70000)): rng.choice(extra)})
        chunks[at] = replace(chunks[at], payload=layer.payload(packed))
    while rng.random() < 0.3:
        kind, size = rng.choice((3, 4, 1 << 15, 65535, rng.randint(3, 65535))), rng.choice((0, 1, 30, 500))
        made = ancillary(kind, rng.randbytes(size))
        chunks.insert(rng.randint(1, len(chunks)), made)
    return replace(file, chunks=tuple(chunks))
