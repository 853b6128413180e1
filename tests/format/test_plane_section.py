"""The planes section: both forms give back the residuals; classes pay where samples are large in some places."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pd4dgs_codec.entropy.channels import encode_channels
from pd4dgs_codec.entropy.priors import K_MAX
from pd4dgs_codec.format import planes as module
from pd4dgs_codec.format.planes import PLAIN, STAGED, read_planes, write_planes


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


def written_in_stages(planes, class_count=None):
    """The section in form 1, even where form 0 is shorter; class_count, if any, instead of the best."""
    choose = module.cheapest_class_count if class_count is None else lambda _: class_count
    with patch.object(module, "cheapest_class_count", choose):
        return module._write_staged(planes, 1)


@pytest.mark.parametrize("channels", [4, 7])
def test_classes_pay_where_cells_are_busy(channels):
    planes = [busy((channels, 40, 50)), busy((channels, 30, 45), 1)]
    data, rate = write_planes(planes, "best", 5)
    plain = encode_channels([channel.ravel() for plane in planes for channel in plane])
    assert data[0] == STAGED and data[1] > 1
    assert len(data) < 0.95 * len(plain.payload)
    assert rate == plain.rate_bits
    assert_same_planes(read_planes(data, [plane.shape for plane in planes]), planes)


@pytest.mark.parametrize("option", [("gauss", 5), ("best", 1)])
def test_the_rate_model_and_the_least_effort_stay_plain(option):
    planes = [busy((4, 40, 50))]
    data, _ = write_planes(planes, *option)
    assert data[0] == PLAIN
    assert_same_planes(read_planes(data, [(4, 40, 50)]), planes)


def test_planes_that_are_alike_everywhere_stay_plain():
    planes = [np.random.default_rng(0).integers(-9, 10, (4, 20, 20)).astype(np.int32)]
    assert write_planes(planes, "best", 3)[0][0] == PLAIN


@given(
    st.integers(1, 9),
    st.lists(st.tuples(st.integers(1, 8), st.integers(1, 8)), min_size=1, max_size=6),
    st.integers(1, 8),
    st.integers(0, 1000),
)
@settings(max_examples=40)
def test_any_shapes_and_class_counts_come_back(channels, sides, class_count, seed):
    planes = [busy((channels, h, w), seed + i) for i, (h, w) in enumerate(sides)]
    shapes = [plane.shape for plane in planes]
    assert_same_planes(read_planes(written_in_stages(planes, class_count), shapes), planes)
    assert_same_planes(read_planes(write_planes(planes, "best", 1)[0], shapes), planes)


@given(st.integers(0, 1000), st.sampled_from((1, 2, 5)))
@settings(max_examples=8)
def test_the_largest_residuals_come_back(seed, channels):
    rng = np.random.default_rng(seed)
    planes = [rng.choice([-K_MAX, -1, 0, K_MAX], (channels, 9, 9)).astype(np.int32)]
    assert_same_planes(read_planes(written_in_stages(planes, 4), [planes[0].shape]), planes)
