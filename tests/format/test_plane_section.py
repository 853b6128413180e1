"""The planes section gives back the residuals; classes pay where samples are large in some places."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.format.planes import read_planes, write_planes


def busy(shape: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    """Residuals [C, H, W] that are large in some blocks of 5 by 5 cells, in all channels."""
    rng = np.random.default_rng(seed)
    _, h, w = shape
    loudness = np.kron(np.exp(rng.normal(size=(h // 5 + 1, w // 5 + 1)) * 2), np.ones((5, 5)))[:h, :w]
    return np.rint(rng.normal(size=shape) * loudness).astype(np.int32)


def assert_same_planes(found, expected):
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == np.int32
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("channels", [4, 7])
def test_classes_pay_where_cells_are_busy(channels):
    planes = [busy((channels, 40, 50)), busy((channels, 30, 45), 1)]
    data, rate = write_planes(planes, "best", 5)
    plain = encode_channels([channel.ravel() for plane in planes for channel in plane])
    assert len(data) < 0.95 * len(plain.payload)
    assert rate == pytest.approx(plain.rate_bits)
    assert_same_planes(read_planes(data, [plane.shape for plane in planes]), planes)


def test_classes_cost_little_where_cells_are_alike():
    planes = [np.random.default_rng(0).integers(-9, 10, (4, 20, 20)).astype(np.int32)]
    plain = encode_channels([channel.ravel() for channel in planes[0]])
    assert len(write_planes(planes, "best", 3)[0]) < 1.05 * len(plain.payload)


@given(
    st.integers(1, 9),
    st.lists(st.tuples(st.integers(1, 8), st.integers(1, 8)), min_size=1, max_size=6),
    st.sampled_from((("best", 1), ("best", 3), ("gauss", 3))),
    st.integers(0, 1000),
)
@settings(max_examples=40)
def test_any_shapes_come_back(channels, sides, options, seed):
    planes = [busy((channels, h, w), seed + i) for i, (h, w) in enumerate(sides)]
    shapes = [plane.shape for plane in planes]
    assert_same_planes(read_planes(write_planes(planes, *options)[0], shapes), planes)


@given(st.integers(0, 1000), st.sampled_from((1, 2, 5)))
@settings(max_examples=8)
def test_the_largest_residuals_come_back(seed, channels):
    rng = np.random.default_rng(seed)
    planes = [rng.choice([-K_MAX, -1, 0, K_MAX], (channels, 9, 9)).astype(np.int32)]
    assert_same_planes(read_planes(write_planes(planes, "best", 1)[0], [planes[0].shape]), planes)
