"""The search for dear files: what it builds is legal or refused, and it keeps what costs most."""

import random

import pytest
from fuzzing.costly import PRIORS, Coded, Found, LayerRecipe, Recipe, build, changed, measured

from pd4dgs_codec import decode
from pd4dgs_codec.errors import Pd4Error


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("staged", [False, True])
def test_a_recipe_is_a_legal_file(prior, staged):
    coded = Coded(prior, window=300, own=True, staged=staged, classes=3)
    moving = LayerRecipe(20, 3, coded, 4, ((4, 5, 6, 7, 8),), 2, coded, (16,))
    scene = decode(build(Recipe((LayerRecipe(50, 2, coded, 37), moving))))
    assert scene.layers == (0, 1) and scene.rows == (50, 70) and len(scene.global_deformation.planes) == 1


def test_changes_reach_legal_files_of_many_costs():
    rng, recipe, found = random.Random(0), Recipe(), []
    for _ in range(60):
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


def test_what_breaks_a_limit_is_dropped():
    assert measured(Recipe((LayerRecipe(), LayerRecipe(scales=((256, 4096, 4096, 1, 1),)))), of_memory=False) is None
