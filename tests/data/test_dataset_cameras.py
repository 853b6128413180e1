"""The lens model and the robust geometry."""

import tracemalloc

import numpy as np
import pytest

from pd4dgs_codec.data import view
from pd4dgs_codec.data.files import shrink_image, shrink_mask
from pd4dgs_codec.data.view import (
    Lens,
    UnreadView,
    cameras_box,
    distort,
    normalised_times,
    points_box,
    rectify,
    seconds_range,
)
from pd4dgs_codec.errors import DataError


def test_matches_opencv_formula():
    """One point, by hand: k1 = .1, p1 = .01, p2 = .02 at (1, 2), r² = 5."""
    lens = Lens(10, 10, 1, 1, 0, 0, 0.0, (0.1, 0.0, 0.0), (0.01, 0.02))
    xd, yd, *_ = distort(np.array(1.0), np.array(2.0), lens)
    np.testing.assert_allclose([xd, yd], [1.5 + 0.04 + 0.02 * 7, 3.0 + 0.08 + 0.01 * 13])


@pytest.mark.parametrize(
    "lens, limit",
    [
        (Lens(96, 64, 40.0, 40.0, 48.0, 32.0, 0.0, (-0.5, 0.0, 0.0)), np.sqrt(2 / 3)),
        (Lens(96, 64, 12.0, 12.0, 48.0, 32.0, fisheye=(-0.2, 0.0, 0.0, 0.0)), np.tan(np.sqrt(1 / 0.6))),
    ],
    ids=["radial", "fisheye"],
)
def test_folded_pixels_are_masked(lens, limit):
    """Beyond the limit the lens folds the image: the stored picture would be shown a second time."""
    _, seen = rectify(np.full((64, 96, 3), 200, np.uint8), lens)
    x, y = np.meshgrid((np.arange(96) + 0.5 - 48) / lens.fx, (np.arange(64) + 0.5 - 32) / lens.fy)
    np.testing.assert_array_equal(seen, np.hypot(x, y) < limit)


def test_skew_moves_along_x():
    """The sample for a pixel lies skew * y to the right in the stored image."""
    lens = Lens(40, 20, 10.0, 10.0, 20.0, 10.0, skew=5.0)
    ramp = np.repeat(np.tile(6 * np.arange(40, dtype=np.uint8), (20, 1))[..., None], 3, axis=2)
    image, seen = rectify(ramp, lens)
    assert image[14, 15, 0] == 6 * 15 + round(6 * 5.0 * 0.45) and seen[14, 15]
    assert not seen[19, 39] and seen[0, 39]


@pytest.mark.parametrize("k", [1, 3, 7])
def test_pictures_are_resampled_in_bands_and_reduced(monkeypatch, k):
    lens, picture = Lens(97, 61, 80.0, 80.0, 48.0, 30.0, radial=(0.2, 0.0, 0.0)), np.random.default_rng(0)
    picture = picture.integers(0, 256, (61, 97, 3), dtype=np.uint8)
    whole, seen = rectify(picture, lens)
    monkeypatch.setattr(view, "BAND_PIXELS", 500)
    view._warp.cache_clear()
    image, mask = rectify(picture, lens, k)
    np.testing.assert_array_equal(image, shrink_image(whole, k))
    np.testing.assert_array_equal(mask, shrink_mask(seen, k))


def test_resampling_takes_few_bytes_a_pixel():
    """A blank picture of 16 megapixels has 2 kB, and took 160 bytes a pixel."""
    lens, picture = (
        Lens(1024, 1024, 1e3, 1e3, 512.0, 512.0, radial=(0.1, 0.0, 0.0)),
        np.zeros((1024, 1024, 3), np.uint8),
    )
    tracemalloc.start()
    rectify(picture, lens, 64)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * picture[..., 0].size + 40e6


def test_box_ignores_strays():
    points = np.random.default_rng(1).uniform(-1, 1, (5000, 3)).astype(np.float32)
    points[:5] = 1000
    box = points_box(points)
    assert np.abs(np.abs(box) - 1.19).max() < 0.03


def test_box_finds_the_common_point():
    frames = []
    for a in np.linspace(0, 2, 7):
        R = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, [0, 0, 8] - R @ [1, 2, 3]
        frames.append(UnreadView("", 0, 0.0, viewmat, Lens(4, 4, 4, 4, 2, 2), None))
    np.testing.assert_allclose(cameras_box(frames), [[1 - 2.6, 2 - 2.6, 3 - 2.6], [3.6, 4.6, 5.6]], atol=1e-5)


@pytest.mark.parametrize(
    ("span", "expected"),
    [
        ((0.0, 2.5), (0.0, 2.5)),
        ((100.0, 105.0), (100.0, 105.0)),
        ((-5.0, 0.0), (-5.0, 0.0)),
        ((1.7e9, 1.7e9 + 4), (0.0, 4.0)),  # binary32 steps by 128 there
        ((3.0, 3.0), (0.0, 1.0)),
        ((0.0, 5e-324), (0.0, 1.0)),
        ((-3e38, 3e38), (-3e38, 3e38)),
    ],
)
def test_seconds_range_survives_binary32(span, expected):
    assert seconds_range(*span) == expected


def test_times_beyond_binary32_are_refused():
    with pytest.raises(DataError, match=r"x: times from -1e\+300 to 5, expected at most 3.4e\+38"):
        normalised_times([5.0, -1e300], "x")
