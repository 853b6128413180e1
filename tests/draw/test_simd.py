"""Vectors in kernels: their operations, the same bits for any width of the CPU's, and what is compiled and cached."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.caching import NullCache

from pd4dgs_codec.draw import simd
from pd4dgs_codec.draw.simd import PRODUCT_ROWS, PRODUCT_VECTORS, WIDE

ROOT = Path(__file__).parents[2]


@numba.njit
def _apply_narrow(a, b, c, out):
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
    mask, total = _apply_narrow(a, b, c, out)
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
def _apply(a, b, c, out):
    x, y = simd.wide_load(a, 0), simd.wide_load(b, 0)
    results = (
        simd.fma(x, y, x), simd.exp2(x), simd.wide_splat(a[3]), simd.spread(a, 2),
        simd.single(simd.wide_load(c, 0) / simd.wide_splat(3.0)),
    )  # fmt: skip
    for n in range(len(results)):
        simd.store(out, n * WIDE, results[n])
    return simd.mask_gt(x, y), simd.total(simd.folded(x))


def test_operations_on_wide_vectors():
    rng, lanes = np.random.default_rng(0), np.arange(WIDE, dtype=np.float64)
    a, b = (rng.normal(size=WIDE).astype(np.float32) for _ in range(2))
    out = np.zeros((5, WIDE), np.float32)
    mask, total = _apply(a, b, lanes, out)
    expected = [a * b + a, 2.0**a, np.full(WIDE, a[3]), a[2 + np.arange(WIDE) // 8], lanes / 3]
    np.testing.assert_allclose(out, expected, rtol=4e-7, atol=1e-6)
    assert mask == sum(1 << i for i in range(WIDE) if a[i] > b[i])
    assert total == pytest.approx(a.sum(), rel=1e-5, abs=1e-5)


@numba.njit
def _product(y, start, a, b, relu):
    simd.product(y, 0, y.shape[1], start, 0, 0, a, 0, a.shape[1], 1, b, 0, b.shape[1], a.shape[1], relu)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_product_is_that_of_numpy(dtype):
    rng, columns = np.random.default_rng(0), PRODUCT_VECTORS * WIDE
    start, a, b = (rng.normal(size=size).astype(dtype) for size in (columns, (PRODUCT_ROWS, 7), (7, columns)))
    y = np.empty((PRODUCT_ROWS, columns), dtype)
    _product(y, start, a, b, False)
    np.testing.assert_allclose(y, start + a @ b, rtol=1e-5, atol=1e-5)
    _product(y, start, a, b, True)
    np.testing.assert_allclose(y, np.maximum(start + a @ b, 0), rtol=1e-5, atol=1e-5)
    a[3, 2] = np.nan
    _product(y, start, a, b, True)
    assert np.isnan(y[3]).all() and np.isfinite(np.delete(y, 3, axis=0)).all()


PICTURE = """
import hashlib
import numpy as np
from pd4dgs_codec.draw.layers import Layers
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.draw.simd import WIDE
from pd4dgs_codec.scene import Camera

rng = np.random.default_rng(1)
shapes = (40, 13), (14, 40)
layers = tuple((rng.normal(size=s).astype(np.float32), rng.normal(size=s[0]).astype(np.float32)) for s in shapes)
values = Layers(layers)(rng.normal(size=(500, 13)).astype(np.float32))
means, scales, opacities = values[:, :3] / 9 + [0, 0, 4], np.exp(values[:, 3:6] / 9 - 3), 1 / (1 + np.exp(values[:, 6]))
camera = Camera(np.eye(4, dtype=np.float32), np.array([[90, 0, 50], [0, 90, 35], [0, 0, 1]], np.float32), 101, 71)
picture, alpha = draw(means, values[:, 7:11], scales, opacities, abs(values[:, 11:]), camera)
assert 0.05 < alpha.mean() < 0.95
print(WIDE, hashlib.sha256(values.tobytes() + picture.tobytes()).hexdigest())
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names two CPUs of this kind")
def test_bits_do_not_depend_on_the_width_of_vectors():
    """One cache serves both CPUs, as a folder that two machines share does."""
    found = []
    for features in ({}, {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma"}) * 2:
        environment = os.environ | features | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", PICTURE], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout.split())
    assert [int(width) for width, _ in found] == [WIDE, simd.LANES] * 2
    assert len({digest for _, digest in found}) == 1


def _uncached(function):
    """A kernel of it that is compiled here, whatever ran before."""
    compiled = simd.kernel()(function)
    compiled._cache = NullCache()
    return compiled


def test_a_kernel_is_not_compiled_anew_for_each_constant():
    twice = _uncached(lambda value: value + value)
    thrice_and_five_times = _uncached(lambda value: (twice(value) + value, twice(2) + 1))
    assert thrice_and_five_times(7) == (21, 5)
    assert twice.signatures == [(numba.int64,)]
