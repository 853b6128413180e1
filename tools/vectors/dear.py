"""Vectors that cost a decoder most for their bytes, as an hour of `tools/fuzz.py --cost` found them. They conform."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .blocks import Vector, good
from .recipes import Coded, LayerRecipe, Recipe, file_of

#: {what is dear: recipes, without what has its default, the dearest first}
RECIPES = Path(__file__).with_suffix(".json")


def cases() -> Iterator[Vector]:
    """All vectors under dear/."""
    for what, recipes in json.loads(RECIPES.read_text(encoding="utf-8")).items():
        for i, fields in enumerate(recipes):
            sentence = f"Dear in {what}: a few hundred bytes that declare millions of symbols."
            yield good(f"dear/{what}-{i}", sentence, "6.5 15", file_of(_recipe(fields)))


def _recipe(fields: dict[str, Any]) -> Recipe:
    layers = []
    for layer in fields["layers"]:
        coded = {key: Coded(**layer[key]) for key in ("attributes", "planes") if key in layer}
        sizes = {
            key: tuple(tuple(row) if key == "scales" else row for row in layer[key])
            for key in ("scales", "widths")
            if key in layer
        }
        layers.append(LayerRecipe(**{**layer, **coded, **sizes}))
    return Recipe(**{**fields, "layers": tuple(layers)})
