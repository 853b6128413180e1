"""The search for dear files: what it builds is legal or refused, and it keeps what costs most."""

import random

import pytest
from fuzzing import check, mutate
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


def dearest_in_seconds():
    """Near the dearest that was found: 1,677 bytes that declare 4.3 million plane samples, by the median."""
    one, three = (2, 2048, 64, 1, 16), (2, 64, 64, 4096, 64)
    wide = LayerRecipe(1, 1 << 19, Coded("exceptions", 4, classes=6), 1, (one,), 3, Coded(own=True), (1024, 1, 64))
    second = LayerRecipe(
        1, 4, Coded(window=4), 1, (one, (2, 16, 256, 4096, 2)), 3, Coded(own=True, classes=6), (1024, 1, 64), 16, True
    )
    local = LayerRecipe(
        2, 1 << 19, Coded("gauss", 1), 1, ((2, 800, *one[2:]), three), 3, Coded(window=4, own=True), (1,), 16, True
    )
    return build(Recipe((wide, second, local), 2, 4))


def test_the_dearest_file_that_was_found_stays_within_its_bounds():
    data = dearest_in_seconds()
    assert len(data) < 2000 and check.declared(data)[0] > 4_000_000
    check.examine(mutate.Case(data, True, "dear"), frozenset(), random.Random(1))  # within MAX_SECONDS, as all inputs
    assert check.check_memory(data) < 1


def test_what_breaks_a_limit_is_dropped():
    assert measured(Recipe((LayerRecipe(), LayerRecipe(scales=((256, 4096, 4096, 1, 1),)))), of_memory=False) is None
