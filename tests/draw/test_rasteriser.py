"""Drawing numpy arrays: the picture of `rasterization`, the stages alone, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.draw import compositing, rasteriser
from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.model.picture import rasterization
from pd4dgs_codec.scene import Camera

CAMERA = Camera(np.eye(4, dtype=np.float32), np.array([[60, 0, 25], [0, 66, 20], [0, 0, 1]], np.float32), 50, 40)


def gaussians(n=300, seed=5, scale=0.1):
    """means, quats, scales, opacities and colors, float32, of n Gaussians in front of CAMERA."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 6, n)
    means = np.stack([*(rng.uniform(-0.5, 0.5, (2, n)) / 1.2 * z), z], 1)
    scales = scale * np.exp(0.6 * rng.normal(size=(n, 3)))
    rest = rng.uniform(0.05, 0.95, n), rng.uniform(size=(n, 3))
    return [a.astype(np.float32) for a in (means, rng.normal(size=(n, 4)), scales, *rest)]


@pytest.mark.parametrize("near_plane", [0.01, 3.0])
def test_the_picture_is_that_of_rasterization(near_plane):
    arrays, background = gaussians(), (0.1, 0.4, 0.9)
    image, alpha = rasteriser.draw(*arrays, CAMERA, background, near_plane=near_plane)
    assert image.dtype == alpha.dtype == np.float32 and image.shape == (40, 50, 3) and alpha.shape == (40, 50)
    expected = rasterization(*map(torch.from_numpy, arrays), CAMERA, background, near_plane=near_plane)
    np.testing.assert_array_equal(image, expected[0].numpy())
    np.testing.assert_array_equal(alpha, expected[1].numpy())
    assert image.std() > 0.05 and 0.1 < alpha.mean() < 0.99


def test_other_float_types_and_orders_of_memory_give_the_same_picture():
    arrays = gaussians()
    expected, _ = rasteriser.draw(*arrays, CAMERA)
    for change in (np.asfortranarray, lambda a: a.astype(np.float64), lambda a: np.repeat(a, 2, axis=0)[::2]):
        np.testing.assert_array_equal(rasteriser.draw(*map(change, arrays), CAMERA)[0], expected)


def test_nothing_to_draw_is_the_background():
    for arrays in (gaussians(0), [-gaussians()[0], *gaussians()[1:]]):
        image, alpha = rasteriser.draw(*arrays, CAMERA, (0.25, 0.5, 0.75))
        assert (image == np.float32([0.25, 0.5, 0.75])).all() and not alpha.any()


def test_gaussians_that_are_not_finite_are_skipped():
    arrays = gaussians()
    expected, _ = rasteriser.draw(*(a[4:] for a in arrays), CAMERA)
    for n, (array, value) in enumerate(zip(arrays[:4], (np.nan, np.inf, np.nan, np.inf), strict=True)):
        array[n] = value
    np.testing.assert_array_equal(rasteriser.draw(*arrays, CAMERA)[0], expected)


WRONG = {
    "means": lambda a: a[:, :2],
    "quats": lambda a: a[:-1],
    "scales": lambda a: a.astype(np.int32),
    "opacities": lambda a: a[:, None],
    "colors": lambda a: a.tolist(),
}


@pytest.mark.parametrize("name", WRONG)
def test_arrays_that_are_refused(name):
    arrays = dict(zip(WRONG, gaussians(), strict=True))
    with pytest.raises(RenderError, match=f"{name}.*expected") as caught:
        rasteriser.draw(**arrays | {name: WRONG[name](arrays[name])}, camera=CAMERA)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change, options, word",
    [
        *[({"width": side}, {}, "width.*expected an integer from 1 to 65535") for side in (0, -1, 8.0, True, 70_000)],
        ({"height": 8.5}, {}, "height"),
        ({"viewmat": np.zeros((4, 4))}, {}, "last row"),
        ({"viewmat": np.diag([0.0, 1.0, 1.0, 1.0])}, {}, "flattens the scene"),
        ({"viewmat": np.diag([np.nan, 1.0, 1.0, 1.0])}, {}, "not finite"),
        ({"viewmat": np.eye(3)}, {}, "viewmat has shape"),
        ({"K": np.eye(4)}, {}, "K has shape"),
        ({"K": np.diag([9.0, 9.0, 2.0])}, {}, "expected"),
        ({"K": np.array([[9, 0.1, 4], [0, 9, 4], [0, 0, 1]])}, {}, "skew"),
        ({"K": np.diag([0.0, 9.0, 1.0])}, {}, "positive"),
        ({"K": np.diag([9.0, -5.0, 1.0])}, {}, "positive"),
        ({"K": np.full((3, 3), np.inf)}, {}, "not finite"),
        ({}, {"background": (0.0,)}, "background"),
        *[({}, {"near_plane": near}, "near_plane") for near in (-1.0, float("nan"), 1e11)],
    ],
)
def test_cameras_and_options_that_are_refused(change, options, word):
    with pytest.raises(RenderError, match=word):
        rasteriser.draw(*gaussians(), replace(CAMERA, **change), **options)


def test_colours_that_are_not_finite_are_refused():
    arrays = gaussians()
    arrays[4][7, 1] = np.nan
    with pytest.raises(NotFinite, match="colors"):
        rasteriser.draw(*arrays, CAMERA)
    with pytest.raises(NotFinite, match="background"):
        rasteriser.draw(*gaussians(), CAMERA, (0.0, np.inf, 0.0))


# -- stages ------------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.booleans(), st.floats(0, 2.0**127, width=32)), max_size=60),
    st.sampled_from([1.0, 0.0, 1e-30]),
)
def test_depth_order_is_a_stable_sort_of_the_visible(rows, factor):
    visible = np.array([r[0] for r in rows], np.bool_)
    depths = np.array([r[1] * factor for r in rows], np.float32)
    order = rasteriser.depth_order(visible, depths)
    expected = np.flatnonzero(visible)
    assert order.tolist() == expected[np.argsort(depths[visible], kind="stable")].tolist()


@pytest.mark.parametrize("size", [(100, 70), (32, 16), (31, 17)])
def test_every_pixel_above_the_alpha_limit_is_in_a_tile_and_block(size):
    width, height = size
    K = np.array([[1.2 * width, 0, width / 2], [0, 1.32 * width, height / 2], [0, 0, 1]])
    geometry = rasteriser.Geometry(*gaussians(scale=0.05)[:4])
    view = rasteriser.project(geometry, Camera(np.eye(4), K, width, height), 0.01)
    ys, xs = np.mgrid[:height, :width] + 0.5
    columns = -(-width // compositing.TILE_WIDTH)
    covered = np.zeros((300, height, width), bool)
    for tile in range(view.starts.size - 1):
        left, top = tile % columns * compositing.TILE_WIDTH, tile // columns * compositing.TILE_HEIGHT
        for i in view.items[view.starts[tile] : view.starts[tile + 1]]:
            bits = int(compositing._coverage(view.geom.reshape(-1), int(i) * 8, left, top))
            for block in (b for b in range(64) if bits >> b & 1):
                x, y = left + block // 16 * 8, top + block % 16
                covered[i, y : y + compositing._ROWS, x : x + 8] = True
    drawn = 0
    for i in np.unique(view.items):
        mx, my, k, sa, sb, q, _, _ = view.geom[i]
        alpha = np.exp2(q - (sa * (xs - mx - k * (ys - my))) ** 2 - (sb * (ys - my)) ** 2)
        assert covered[i][alpha >= 1 / 255].all()
        drawn += (alpha >= 1 / 255).sum()
    assert 0.25 * covered.sum() < drawn < covered.sum()  # tight: most lanes of the blocks are used
