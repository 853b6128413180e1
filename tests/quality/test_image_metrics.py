"""mPSNR and mSSIM against values by hand and a slow direct implementation."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pd4dgs_codec.data.view import View
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.quality.image import (
    mean_image_baseline,
    mean_scores,
    moving_regions,
    mpsnr,
    mssim,
    ssim,
    to_uint8,
)


def random_pair(h=15, w=17, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (h, w, 3)).astype(np.uint8)
    b = np.clip(a.astype(int) + rng.integers(-60, 61, a.shape), 0, 255).astype(np.uint8)
    return a, b


def slow_pass(z, m, f, axis):
    """One masked 1-D pass of one channel, window by window."""
    if axis == 0:
        out, mask = slow_pass(z.T, m.T, f, 1)
        return out.T, mask.T
    h, w = z.shape
    out, mask = np.zeros((h, w - 10)), np.zeros((h, w - 10))
    for y in range(h):
        for x in range(w - 10):
            window, count = m[y, x : x + 11], m[y, x : x + 11].sum()
            if count:
                out[y, x] = sum(z[y, x + i] * window[i] * f[i] for i in range(11)) * 11 / count
                mask[y, x] = 1
    return out, mask


def slow_mssim(a, b, m):
    f = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    f /= f.sum()

    def blur(z):
        return slow_pass(*slow_pass(z, m, f, 1), f, 0)[0]

    maps = []
    for c in range(3):
        x, y = a[..., c] / 255, b[..., c] / 255
        mx, my = blur(x), blur(y)
        vx, vy = np.maximum(blur(x * x) - mx**2, 0), np.maximum(blur(y * y) - my**2, 0)
        cov = blur(x * y) - mx * my
        limit = np.sqrt(vx * vy)
        cov = np.clip(cov, -limit, limit)
        top = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
        maps.append(top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    return np.mean(maps)


VALID = {
    "all": np.ones((15, 17), bool),
    "half": np.broadcast_to(np.arange(17) < 4, (15, 17)),
    "scattered": np.random.default_rng(1).uniform(size=(15, 17)) < 0.05,
    "none": np.zeros((15, 17), bool),
}


@pytest.mark.parametrize("kind", VALID)
def test_mssim_is_the_direct_one(kind):
    (a, b), m = random_pair(), VALID[kind]
    assert mssim(a, b, m) == pytest.approx(slow_mssim(a, b, m.astype(float)), abs=1e-12)
    if kind == "none":
        assert mssim(a, b, m) == 1.0
    if kind == "all":
        assert mssim(a, b) == mssim(a, b, m)


def test_without_a_mask_they_are_scikit_image_s():
    metrics = pytest.importorskip("skimage.metrics")
    a, b = random_pair(40, 50)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": 2}
    _, ssim = metrics.structural_similarity(a / 255, b / 255, data_range=1.0, full=True, **options)
    assert mssim(a, b) == pytest.approx(ssim[5:-5, 5:-5].mean(), abs=1e-9)
    assert mpsnr(a, b) == pytest.approx(metrics.peak_signal_noise_ratio(a, b), abs=1e-9)


def test_mpsnr_by_hand():
    a, b = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 3), np.uint8)
    b[0, 0] = 51  # error .2 in one of four pixels
    assert mpsnr(a, b) == pytest.approx(-10 * np.log10(0.04 / 4))
    assert mpsnr(a, b, np.array([[1, 1], [0, 0]], bool)) == pytest.approx(-10 * np.log10(0.04 / 2))
    assert mpsnr(a, b, np.array([[0, 1], [1, 1]], bool)) == float("inf")
    b[0, 0] = 51, 0, 0
    assert mpsnr(a, b) == pytest.approx(-10 * np.log10(0.04 / 12))


def test_mask_hides_errors_anywhere():
    a, b = random_pair()
    m = np.random.default_rng(2).uniform(size=a.shape[:2]) < 0.5
    c = b.copy()
    c[~m] = 0
    assert mpsnr(a, b, m) == mpsnr(a, c, m)
    a2 = a.copy()
    a2[~m] = 255
    assert mssim(a, b, m) == mssim(a2, c, m)


def test_eight_bits_first():
    target = np.full((12, 12, 3), 100, np.uint8)
    assert mpsnr(np.full((12, 12, 3), 100.4 / 255, np.float32), target) == float("inf")
    assert to_uint8(np.array([-1.0, 0.0, 0.5, 1.0, 7.0, np.inf])).tolist() == [0, 0, 128, 255, 255, 255]


def test_baseline_by_hand():
    def view(level, mask=None):
        return SimpleNamespace(image=np.full((4, 4, 3), level, np.uint8), mask=mask)

    train = [view(0), view(102)]  # mean 51
    expected = np.mean([-10 * np.log10(0.2**2), -10 * np.log10(0.4**2)])
    assert mean_image_baseline(train, [view(102), view(153)]) == pytest.approx(expected)
    half = view(102)
    half.image[:2], half.mask = 255, np.arange(16).reshape(4, 4) >= 8
    assert mean_image_baseline(train, [half]) == pytest.approx(-10 * np.log10(0.2**2))
    assert mean_image_baseline(train, [SimpleNamespace(image=np.zeros((5, 4, 3), np.uint8))]) is None


@pytest.mark.parametrize(
    ("args", "text"),
    [
        ((np.zeros((12, 12, 3)), np.zeros((12, 13, 3))), "expected the same"),
        ((np.zeros((12, 12)), np.zeros((12, 12))), "expected the same"),
        ((np.zeros((12, 12, 3)), np.zeros((12, 12, 3)), np.ones((11, 12), bool)), "mask has shape"),
        ((np.full((12, 12, 3), np.nan), np.zeros((12, 12, 3))), "holds NaN"),
        ((np.zeros((12, 12, 3), int), np.zeros((12, 12, 3), int)), "dtype int64"),
    ],
)
def test_bad_images(args, text):
    for metric in (mpsnr, mssim):
        with pytest.raises(DataError, match=text):
            metric(*args)


def test_too_small_and_empty():
    with pytest.raises(DataError, match="at least 11x11"):
        mssim(np.zeros((10, 20, 3)), np.zeros((10, 20, 3)))
    with pytest.raises(DataError, match="0 test views"):
        mean_image_baseline([SimpleNamespace(image=np.zeros((4, 4, 3)))], [])


# -- means over views and levels ---------------------------------------------------------------------------------------

RNG = np.random.default_rng(0)
MASK = RNG.random((6, 8)) < 0.5
VIEWS = [SimpleNamespace(image=RNG.integers(0, 256, (6, 8, 3), np.uint8), mask=mask) for mask in (None, MASK, None)]


def wrong_by(amount: int, view) -> np.ndarray:
    return np.where(view.image > 127, view.image - amount, view.image + amount).astype(np.uint8)


def test_each_view_is_drawn_once_whatever_the_number_of_metrics():
    drawn, steps = [], []

    def draw(view):
        drawn.append(view)
        return wrong_by(2, view)

    def valid(picture, target, mask):
        return float(mask.sum()) if mask is not None else 48.0

    found = mean_scores(draw, VIEWS, {"mpsnr": mpsnr, "valid": valid}, lambda: steps.append(len(drawn)))
    assert all(a is b for a, b in zip(drawn, VIEWS, strict=True)) and steps == [1, 2, 3]
    assert found == {"mpsnr": pytest.approx(20 * np.log10(255 / 2)), "valid": pytest.approx((96 + MASK.sum()) / 3)}


@pytest.mark.parametrize("amount", [1, 3])
def test_the_mean_psnr_honours_masks(amount):
    def draw(view):
        picture = wrong_by(amount, view)
        if view.mask is not None:
            picture[~view.mask] = 0  # not looked at
        return picture

    assert mean_scores(draw, VIEWS, {"mpsnr": mpsnr}) == {"mpsnr": pytest.approx(20 * np.log10(255 / amount))}


def reference_ssim(a, b):
    """What utils/loss_utils.py of 3D Gaussian Splatting computes, in float64."""
    x, y = (torch.from_numpy(z / 255.0).permute(2, 0, 1)[None] for z in (a, b))
    taps = torch.exp(-((torch.arange(11) - 5.0).double() ** 2) / (2 * 1.5**2))
    window = (torch.outer(taps, taps) / taps.sum() ** 2).expand(3, 1, 11, 11)

    def blur(z):
        return torch.nn.functional.conv2d(z, window, padding=5, groups=3)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean().item()


@pytest.mark.parametrize("size", [(15, 17), (7, 40)])
def test_ssim_is_that_of_3dgs(size):
    a, b = random_pair(*size)
    assert ssim(a, b) == pytest.approx(reference_ssim(a, b), abs=1e-12) and ssim(a, a) == pytest.approx(1)


def still(time, image, mask=None, x=0.0):
    """A view of a camera at x."""
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3] = x
    return View(viewmat, np.eye(3, dtype=np.float32), 4, 3, time, image, mask, "", 1)


def test_what_moves_where_a_camera_stands_still():
    """A change of 17 in one channel counts, one of 16 does not, nor what is not valid at that time."""
    first, later = np.full((3, 4, 3), 100, np.uint8), np.full((3, 4, 3), 116, np.uint8)
    later[1, 2, 0], later[0, 1], later[2, 3, 2] = 117, 0, 83
    mask = np.ones((3, 4), bool)
    mask[0, 1] = False
    views = [still(0.0, first), still(1.0, later, mask), still(0.0, first, x=1.0), still(0.5, later, x=2.0)]
    views += [still(0.5, later, x=2.0)]  # a pose at one time, twice
    regions = moving_regions(views)
    assert list(regions) == views[:2]
    for view in views[:2]:
        np.testing.assert_array_equal(np.argwhere(regions[view]), [(1, 2), (2, 3)])
    mask[1, 2] = False
    gone = moving_regions([still(0.0, first), still(1.0, later, mask)])
    assert [int(region.sum()) for region in gone.values()] == [1, 1]
    assert moving_regions([still(0.0, first), still(1.0, first)]) == {}
