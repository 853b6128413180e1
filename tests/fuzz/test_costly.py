"""The search for dear files: what it builds is legal or refused, and it keeps what costs most."""

import random
from pathlib import Path

import pytest
from fuzzing import check, mutate
from fuzzing.costly import Found, build, changed, measured
from vectors.recipes import PRIORS, Coded, LayerRecipe, Recipe

from pd4dgs_codec import decode
from pd4dgs_codec.errors import Pd4Error

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("staged", [False, True])
def test_a_recipe_is_a_legal_file(prior, staged):
    coded = Coded(prior, window=300, own=True, staged=staged, classes=3)
    moving = LayerRecipe(20, 3, coded, 4, ((4, 5, 6, 7, 8),), 2, coded, (16,))
    scene = decode(build(Recipe((LayerRecipe(50, 2, coded, 37), moving))))
    assert scene.layers == (0, 1) and scene.rows == (50, 70) and len(scene.global_deformation.planes) == 1


def test_changes_reach_legal_files_of_many_costs():
    rng, recipe, found = random.Random(1), Recipe(), []  # a seed whose files are cheap
    for _ in range(30):
        recipe = changed(rng, recipe)
        try:
            data = build(recipe)
        except (Pd4Error, ValueError):
            recipe = Recipe()
            continue
        if len(data) < 4000:
            found.append(len(data))
    assert len(set(found)) > 10


def test_costs_are_shares_of_what_a_file_of_that_length_may_cost():
    small, large = (measured(Recipe((LayerRecipe(anchors),)), of_memory=True) for anchors in (1, 2000))
    assert small is not None and large is not None and small < large
    assert 0 < small.share < large.share < 1 and large.memory > small.memory
    assert isinstance(small, Found) and small.row()["bytes"] == len(small.data)


DEAR = sorted((ROOT / "spec" / "vectors" / "dear").glob("*.pd4"))


@pytest.mark.parametrize(
    "path", [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (not p.stem.endswith("-0"))) for p in DEAR]
)
def test_the_dearest_files_that_were_found_stay_within_their_bounds(path):
    data = path.read_bytes()
    assert len(data) < 2000 and check.declared(data)[0] > 2_900_000  # symbols
    check.examine(mutate.Case(data, True, "dear"), frozenset(), random.Random(1))  # within MAX_SECONDS, as all inputs
    assert check.check_memory(data) < 1


def test_there_are_dear_files():
    assert len(DEAR) == 10


def test_what_breaks_a_limit_is_dropped():
    assert measured(Recipe((LayerRecipe(), LayerRecipe(scales=((256, 4096, 4096, 1, 1),)))), of_memory=False) is None
