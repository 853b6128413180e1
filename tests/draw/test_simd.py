"""Vectors in kernels: their operations, the same bits for any width of the CPU's, and what is compiled and cached."""

import platform

import pytest

from pd4dgs_codec.draw import simd
from pd4dgs_codec.draw.simd import WIDE

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
def test_bits_do_not_depend_on_the_width_of_vectors(python):
    """One cache serves both CPUs, as a folder that two machines share does."""
    found = []
    for features in ({}, {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma"}, {}):
        found.append(python(PICTURE, **features).split())
    assert [int(width) for width, _ in found] == [WIDE, simd.LANES, WIDE]
    assert len({digest for _, digest in found}) == 1
