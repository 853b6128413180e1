"""Projection, sorting, binning and the vector type, each alone."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.draw import binning, kernels, rasteriser, simd
from pd4dgs_codec.scene import Camera


@numba.njit
def _apply(a, b, c, out):
    x, y, z = simd.load(a, 0), simd.load(b, 0), simd.load(c, 0)
    results = (
        x + y, x - y, x * y, x / y, simd.fma(x, y, z), simd.fnma(x, y, z), simd.sqrt(y), simd.exp2(x),
        simd.select_gt(x, z, x, y), simd.splat(a[3]), simd.totals(x, y, z, x, y, z, x + y, y + z),
    )  # fmt: skip
    for n in range(len(results)):
        simd.store(out, n * 8, results[n])
    return simd.mask_gt(x, z), simd.total(x)


def test_vector_operations():
    rng = np.random.default_rng(0)
    a, b, c = (rng.uniform(lo, hi, 8).astype(np.float32) for lo, hi in ((-9, 3), (0.5, 2), (-4, 4)))
    out = np.zeros(11 * 8, np.float32)
    mask, total = _apply(a, b, c, out)
    x, y, z = (v.astype(np.float64) for v in (a, b, c))
    expected = [
        x + y, x - y, x * y, x / y, x * y + z, z - x * y, np.sqrt(y), 2.0**x, np.where(x > z, x, y), np.full(8, x[3]),
        [v.sum() for v in (x, y, z, x, y, z, x + y, y + z)],
    ]  # fmt: skip
    np.testing.assert_allclose(out.reshape(11, 8), expected, rtol=4e-7, atol=2e-6)
    assert mask == sum(1 << i for i in range(8) if x[i] > z[i])
    assert total == pytest.approx(x.sum(), rel=1e-6)


@numba.njit
def _exp2_all(values, out):
    for i in range(0, values.size, 8):
        simd.store(out, i, simd.exp2(simd.load(values, i)))


def test_exp2_accuracy_over_the_range_in_use():
    values = np.linspace(-9, 0, 80_000).astype(np.float32)
    out = np.empty_like(values)
    _exp2_all(values, out)
    assert np.abs(out / np.exp2(values.astype(np.float64)) - 1).max() < 3e-7


@numba.njit
def _bits(mask):
    count = 0
    last = -1
    while mask:
        last = simd.trailing_zeros(mask)
        mask &= mask - np.uint64(1)
        count += 1
    return count, last


def test_bit_loop():
    assert _bits(np.uint64(0b1011)) == (3, 3)
    assert _bits(np.uint64(1) << np.uint64(63)) == (1, 63)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.booleans(), st.floats(0, 2.0**127, width=32)), max_size=60),
    st.sampled_from([1.0, 0.0, 1e-30]),
)
def test_sort_is_a_stable_sort_of_the_visible(rows, factor):
    visible = np.array([r[0] for r in rows], np.bool_)
    depths = np.array([r[1] * factor for r in rows], np.float32)
    order = binning.sort(visible, depths)
    expected = np.flatnonzero(visible)
    assert order.tolist() == expected[np.argsort(depths[visible], kind="stable")].tolist()


@pytest.mark.parametrize("chunks", [1, 3, 8])
def test_bins_list_each_tile_front_to_back(chunks):
    rng = np.random.default_rng(1)
    columns, rows, n = 5, 4, 200
    rects = np.zeros((n, 4), np.int32)
    rects[:, [0, 2]] = rng.integers(0, 4, (n, 2))
    rects[:, [1, 3]] = np.minimum(rects[:, [0, 2]] + rng.integers(0, 4, (n, 2)), [columns, rows])
    order = rng.permutation(n)[:150].astype(np.int64)
    rects[np.setdiff1d(np.arange(n), order)] = 0
    counts, starts = np.empty((chunks, columns * rows), np.int64), np.empty(columns * rows + 1, np.int64)
    first = np.empty(n + 1, np.int64)
    binning.count_tiles(order, rects, columns, counts)
    binning.offsets(rects, counts, starts, first)
    items, slot_of = np.full(starts[-1], -1, np.int32), np.full(starts[-1], -1, np.int32)
    binning.fill_tiles(order, rects, columns, counts, first, items, slot_of)
    for tile in range(columns * rows):
        x, y = tile % columns, tile // columns
        r = rects[order]
        hit = (r[:, 0] <= x) & (x < r[:, 1]) & (r[:, 2] <= y) & (y < r[:, 3])
        assert items[starts[tile] : starts[tile + 1]].tolist() == order[hit].tolist()
    assert sorted(slot_of.tolist()) == list(range(starts[-1]))
    owner = np.searchsorted(first, slot_of, side="right") - 1
    assert (owner == items).all() and first[-1] == starts[-1]


def _random_view(width, height, n=300):
    """A view, prepared for compositing, of n Gaussians drawn at random."""
    rng = np.random.default_rng(21)
    z = rng.uniform(2, 6, n)
    means = np.stack([*(rng.uniform(-0.5, 0.5, (2, n)) / 1.2 * z), z], 1)
    scales, opacities = 0.05 * np.exp(0.6 * rng.normal(size=(n, 3))), rng.uniform(0.05, 0.95, n)
    arrays = (a.astype(np.float32) for a in (means, rng.normal(size=(n, 4)), scales, opacities))
    K = np.array([[1.2 * width, 0, width / 2], [0, 1.32 * width, height / 2], [0, 0, 1]])
    camera = Camera(np.eye(4), K, width, height)
    return rasteriser.project(rasteriser.Geometry(*arrays), [camera], rasteriser.Settings()).views[0]


@pytest.mark.parametrize("size", [(100, 70), (32, 16), (31, 17)])
def test_every_pixel_above_the_alpha_limit_is_in_a_tile_and_block(size):
    width, height = size
    view = _random_view(width, height)
    ys, xs = np.mgrid[:height, :width] + 0.5
    columns = -(-width // kernels.TILE_WIDTH)
    covered = np.zeros((300, height, width), bool)
    for tile in range(view.starts.size - 1):
        left, top = tile % columns * kernels.TILE_WIDTH, tile // columns * kernels.TILE_HEIGHT
        for i in view.items[view.starts[tile] : view.starts[tile + 1]]:
            bits = int(kernels._coverage(view.geom.reshape(-1), int(i) * 8, left, top))
            for block in (b for b in range(64) if bits >> b & 1):
                x, y = left + block // 16 * 8, top + block % 16
                covered[i, y : y + kernels._ROWS, x : x + 8] = True
    drawn = 0
    for i in np.unique(view.items):
        mx, my, k, sa, sb, q, _, _ = view.geom[i]
        alpha = np.exp2(q - (sa * (xs - mx - k * (ys - my))) ** 2 - (sb * (ys - my)) ** 2)
        assert covered[i][alpha >= 1 / 255].all()
        drawn += (alpha >= 1 / 255).sum()
    assert 0.25 * covered.sum() < drawn < covered.sum()  # tight: most lanes of the blocks are used
