"""A search for legal files that cost a decoder most for their bytes, in processor time or in memory.

It changes the recipes that cost most so far and keeps what costs more: a hill climb from several places, seeded. What
no decoder takes, because a choice breaks a limit, is dropped. The dearest files that it found are `spec/vectors/dear`.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from vectors.recipes import PRIORS, Coded, LayerRecipe, Recipe, file_of

from fuzzing.check import memory_bound, peak_memory
from pd4dgs_codec import decode
from pd4dgs_codec.errors import DecodeError, Pd4Error
from pd4dgs_codec.scene import PLANES, Widths

LARGEST = 1 << 18  #: bytes of a file that is kept: what is dear by the byte shows in small ones
MOST_SYMBOLS = (1 << 22) + 64 * LARGEST  #: fewer than clause 6.5 allows, so that many files are tried
MOST_SLICES = 64  #: of a layer, so that many files are tried: what a slice costs besides shows in a few
#: What a file may cost, in seconds of a processor of 2023 and in bytes of memory: once, and for each of its bytes. The
#: symbols of clause 6.5 at 48 bytes and some 0.1 microseconds each.
SECONDS, MEMORY = (0.4, 25e-6), (48 << 22, 48 << 8)


@dataclass(order=True)
class Found:
    """What a recipe costs: `share` is that of the seconds or of the memory that a file of its length may cost. bound:
    the most memory that decoding it may take (clause 15), 0 where none was measured."""

    share: float
    seconds: float = field(compare=False)
    memory: int = field(compare=False)
    bound: int = field(compare=False)
    data: bytes = field(compare=False, repr=False)
    recipe: Recipe = field(compare=False)

    def row(self) -> dict[str, Any]:
        """What a table shows."""
        return {
            "share": round(self.share, 3),
            "bytes": len(self.data),
            "seconds": round(self.seconds, 3),
            "memory": self.memory,
            "bound": self.bound,
            "recipe": asdict(self.recipe),
        }


def build(recipe: Recipe) -> bytes:
    """The file's bytes. Raises Pd4Error or ValueError where the parts of a recipe exclude each other, or are many."""
    widths = Widths(recipe.feature, recipe.slots, recipe.graded)
    if sum(_symbols(layer, widths) for layer in recipe.layers) > MOST_SYMBOLS:
        raise ValueError("more symbols than a file of LARGEST bytes may declare")
    return file_of(recipe).data()


def _symbols(layer: LayerRecipe, widths: Widths) -> int:
    planes = sum(s[0] * s[1 + a] * s[1 + b] for s in layer.scales for _, a, b in PLANES)
    return planes + layer.anchors * widths.channels


# -- changes -----------------------------------------------------------------------------------------------------------


def changed(rng: random.Random, recipe: Recipe) -> Recipe:
    """With one to three choices made otherwise."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        layers = list(recipe.layers)
        if len(layers) < 3 and rng.random() < 0.1:
            layers.append(replace(rng.choice(layers)))
        elif len(layers) > 1 and rng.random() < 0.05:
            layers.pop()
        else:
            at = rng.randrange(len(layers))
            layers[at] = _changed_layer(rng, layers[at])
        recipe = replace(recipe, layers=tuple(layers))
        if rng.random() < 0.15:
            recipe = _changed_widths(rng, recipe)
    return recipe


def _changed_widths(rng: random.Random, recipe: Recipe) -> Recipe:
    what = rng.choice(("feature", "slots", "graded"))
    choices: dict[str, Callable[[], Any]] = {
        "feature": lambda: rng.choice((1, 2, 32, 64)),
        "slots": lambda: rng.choice((1, 4, 10, 16)),
        "graded": lambda: not recipe.graded,
    }
    return replace(recipe, **{what: choices[what]()})


def _changed_layer(rng: random.Random, layer: LayerRecipe) -> LayerRecipe:
    what = rng.choice(
        (
            "anchors",
            "spread",
            "attributes",
            "terms",
            "scales",
            "scales",
            "predictor",
            "planes",
            "widths",
            "slices",
            "redefined",
        )  # fmt: skip
    )
    if what in ("attributes", "planes"):
        return replace(layer, **{what: _changed_coded(rng, getattr(layer, what))})
    if what == "scales":
        return replace(layer, scales=_changed_scales(rng, layer.scales))
    choices: dict[str, Callable[[], Any]] = {
        "anchors": lambda: _scaled(rng, layer.anchors, 1 << 16),
        "spread": lambda: _scaled(rng, layer.spread, 1 << 19),
        "terms": lambda: rng.choice((0, 1, 8, 37)),
        "predictor": lambda: rng.randrange(6),
        "widths": lambda: tuple(rng.choice((1, 16, 64, 1024)) for _ in range(rng.randrange(4))),
        "slices": lambda: _scaled(rng, layer.slices, MOST_SLICES),
        "redefined": lambda: not layer.redefined,
    }
    return replace(layer, **{what: choices[what]()})


def _changed_coded(rng: random.Random, coded: Coded) -> Coded:
    what = rng.choice(("prior", "window", "own", "staged", "classes"))
    choices: dict[str, Callable[[], Any]] = {
        "prior": lambda: rng.choice(PRIORS),
        "window": lambda: _scaled(rng, coded.window, 1 << 14),
        "own": lambda: not coded.own,
        "staged": lambda: not coded.staged,
        "classes": lambda: rng.randint(1, 8),
    }
    return replace(coded, **{what: choices[what]()})


def _changed_scales(rng: random.Random, scales: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
    if not scales or (len(scales) < 8 and rng.random() < 0.2):
        channels = scales[0][0] if scales else rng.choice((1, 2, 8, 32))
        return (*scales, (channels, *(rng.choice((1, 2, 16, 64, 256, 4096)) for _ in range(4))))
    rows = [list(scale) for scale in scales]
    if rng.random() < 0.3:
        channels = _scaled(rng, rows[0][0], 256)
        return tuple((channels, *row[1:]) for row in rows)
    row = rng.choice(rows)
    at = rng.randint(1, 4)
    row[at] = _scaled(rng, row[at], 4096)
    return tuple(tuple(row) for row in rows)


def _scaled(rng: random.Random, value: int, most: int) -> int:
    """Near `value`, half or twice it, or anything up to `most`."""
    near = (value + 1, max(1, value - 1), max(1, value // 2), 2 * value, 1 << rng.randrange(most.bit_length()))
    return min(rng.choice(near), most)


# -- the search --------------------------------------------------------------------------------------------------------


def measured(recipe: Recipe, of_memory: bool) -> Found | None:
    """What the file of a recipe costs; None if there is none within the limits."""
    try:
        data = build(recipe)
    except (Pd4Error, ValueError, IndexError, KeyError, MemoryError):
        return None
    if len(data) > LARGEST:
        return None
    try:
        start = time.process_time()
        decode(data)
        seconds = time.process_time() - start
    except DecodeError:
        return None
    memory, bound = (peak_memory(data), memory_bound(data)) if of_memory else (0, 0)
    (once, per_byte), cost = (MEMORY, memory) if of_memory else (SECONDS, seconds)
    return Found(cost / (once + per_byte * len(data)), seconds, memory, bound, data, recipe)


def search(
    seed: int, seconds: float, of_memory: bool, keep: int = 10, report: Callable[[str], None] = print
) -> list[Found]:
    """The `keep` files that cost most, found in so many seconds. seconds of wall time; a run of another length finds
    others."""
    rng, end = random.Random(seed), time.monotonic() + seconds
    best: list[Found] = []
    tried = legal = 0
    while time.monotonic() < end:
        parent = rng.choice(best).recipe if best and rng.random() < 0.9 else Recipe()
        recipe = changed(rng, parent)
        tried += 1
        if any(recipe == found.recipe for found in best):
            continue
        found = measured(recipe, of_memory)
        if found is None:
            continue
        legal += 1
        if len(best) < keep or found > best[-1]:
            best = sorted([*best, found], reverse=True)[:keep]
            if found is best[0]:
                report(f"{tried} tried, {legal} legal: {found.row()}")
    return best
