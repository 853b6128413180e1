"""Legal `.pd4` files: the small valid vectors, and files of random choices that no encoder need make."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from vectors.blocks import (
    ATTRIBUTES,
    PLANE,
    Block,
    File,
    Layer,
    Scale,
    Slices,
    coded,
    gauss,
    graded_part,
    later,
    make_file,
    make_layer,
    ordered,
    plain_planes,
    staged_planes,
)

from pd4dgs_codec.entropy.priors import Const, Hist, Mixture, Normal, Prior, Window
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.scene import SCAFFOLD_NETWORKS, Widths

VECTORS = Path(__file__).resolve().parents[2] / "spec" / "vectors"
LARGEST_SEED = 6000  #: bytes of a vector: larger ones decode slowly


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
    random_files = [Seed(f"legal-{i}", legal(random.Random(i)).data()) for i in range(built)]
    return [*random_files, *(Seed(file.stem, file.read_bytes()) for file in found if decodes(file.read_bytes()))]


def decodes(data: bytes) -> bool:
    """Whether the package decodes a file."""
    try:
        hashes(data)
    except DecodeError:
        return False
    return True


def legal(rng: random.Random) -> File:
    """A file of random layers, slices, widths, forms and priors."""
    viewing = tuple(name for name in SCAFFOLD_NETWORKS if rng.random() < 0.5)
    widths = Widths(rng.choice((1, 2, 7, 32)), rng.choice((1, 2, 10)), viewing=viewing)
    graded, layers, before = rng.random() < 0.4, list[Layer](), 0
    for number in sorted({0, *rng.sample((1, 2), rng.randrange(3))}):
        own = list(_layer(rng, number, before, widths, graded))
        layers += own
        before += sum(len(x.cells) for x in own)
    return make_file(*layers)


def _layer(rng: random.Random, number: int, before: int, widths: Widths, graded: bool) -> list[Layer]:
    """The slices of a layer, in a region of space of their own each."""
    written, made = Slices(), list[Layer]()
    for index in range(rng.choice((1, 1, 2, 3))):
        count = rng.choice((0, 1, 2, 5, 12))
        cells = {tuple(rng.randrange(-20, 20) for _ in range(2)) for _ in range(count)}
        z = 100 * number + 7 * index
        fields: dict[str, Any] = {
            "attributes": _symbols(rng, (widths.channels, len(cells)), (0, 1, 4) if index else (0, 1, 4, 300)),
            "codes": [rng.randrange(3, 250) for _ in cells],
            "classes": [rng.randrange(7) for _ in cells] if graded else None,
            "widths": widths,
        }
        if index:
            layer = later(number, [(*c, z) for c in cells], **fields)
        else:
            rises = [rng.randrange(3) for _ in range(before)]
            scales = _scales(rng) if number and rng.random() < 0.8 else []
            layer = make_layer(
                number, ordered([(*c, z) for c in cells]), before=before, rises=rises, scales=scales, **fields
            )
            if layer.flat and rng.random() < 0.8:
                layer = layer.with_sections({PLANE: _planes(rng, layer)})
        form = rng.randrange(3)
        counts = [rng.randint(1, 8) for _ in range(5 + graded)]
        terms = {
            c: [(rng.randrange(c), rng.randrange(-900, 900))] for c in range(1, widths.predicted) if rng.random() < 0.3
        }
        block = Block(terms, {i: (rng.randrange(4), 1, -1) for i in range(widths.slots)}, counts)
        layer = written.add(layer, block if form == 1 else None, go_on=form == 2 and written.of is not None)
        if form == 0 and len(cells) and not index and not graded:  # other priors than the usual ones
            section = coded(layer.attributes, {c: _prior(rng, k) for c, k in enumerate(layer.attributes)})
            written.plain.clear()
            layer = layer.with_sections({ATTRIBUTES: b"\0" + graded_part(layer.classes) + section})
            return [layer]
        made.append(layer)
    return made


def _symbols(rng: random.Random, shape: tuple[int, ...], spreads: tuple[int, ...] = (0, 1, 4, 300)) -> np.ndarray:
    spread = rng.choice(spreads)
    numbers = np.random.default_rng(rng.randrange(1 << 30))
    return np.rint(numbers.normal(0, spread / 3, shape)).astype(np.int32)


def _scales(rng: random.Random) -> list[Scale]:
    channels = rng.choice((1, 2, 3, 5))
    sides = [tuple(rng.choice((1, 2, 3, 9)) for _ in range(4)) for _ in range(rng.choice((1, 1, 2)))]
    predictors = tuple(rng.randrange(6) for _ in range(6))
    return [Scale(channels, s, predictors, lambda name, shape: _symbols(rng, shape)) for s in sides]  # type: ignore[arg-type]


def _planes(rng: random.Random, layer: Layer) -> bytes:
    if rng.random() < 0.5:
        return plain_planes(layer.flat, {c: _prior(rng, k) for c, k in enumerate(layer.flat)})
    stages = max(1, (len(layer.residuals[0]) - 1).bit_length())
    return staged_planes(layer.residuals, [rng.randint(1, 8) for _ in range(stages - 1)])


def _prior(rng: random.Random, k: np.ndarray) -> Prior:
    """Any prior; symbols outside its window become exceptions."""
    low, n, shift = int(k.min()) + rng.randrange(-2, 3), rng.randrange(2, 40), rng.choice((0, 0, 1, 5))
    window, normal = Window(low, n, shift), Normal(rng.randrange(-2000, 2000), rng.randrange(-640, 1281))
    classes = np.array([rng.randrange(6) for _ in range(n - 1)] + [5])
    return rng.choice((
        Const(Window(low, 1)),
        gauss(low, n, si=rng.randrange(-640, 1281), floor=rng.choice((1, 16)), shift=shift),
        Mixture(window, normal, Normal(0, 100), rng.randrange(1, 256), rng.choice((1, 16))),
        Hist(window, rng.choice((8, 16, 32, 64)), 5, rng.random() < 0.5, 30, 0, classes),
    ))  # fmt: skip
