"""The picture's loss: the kernels against plain torch, both against the definition."""

import numpy as np
import pytest
import torch

from pd4dgs_codec import threads
from pd4dgs_codec.train.ssim import image_loss, image_loss_reference, pixel_weights, within_reach


def pair(height, width, dtype=torch.float32, masked=False, seed=0):
    """(render that wants a gradient, training image, weights)."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    noise = torch.randn(height, width, 3, generator=generator, dtype=dtype)
    mask = torch.rand(height, width, generator=generator) > 0.4
    mask[0, 0] = True
    weights = pixel_weights((mask if masked else torch.ones(height, width)).to(dtype))
    return (target + 0.2 * noise).requires_grad_(), target, weights


def terms_and_gradient(terms, image, weights=(0.8, 0.2)):
    total = sum(w * term for w, term in zip(weights, terms, strict=True))
    return *(term.detach() for term in terms), torch.autograd.grad(total, image)[0]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(37, 41), (1, 1), (3, 100), (24, 16)])
def test_kernel_equals_reference(size, masked):
    """float32 kernels, the one form that training has, and the reference in float64."""
    image, target, per_pixel = pair(*size, masked=masked)
    wide = image.detach().double().requires_grad_()
    for weights in ((0.8, 0.2), (0.0, 1.0)):
        fast = terms_and_gradient(image_loss(image, target, per_pixel), image, weights)
        exact = image_loss_reference(wide, target.double(), per_pixel.double())
        slow = terms_and_gradient(exact, wide, weights)
        assert fast[0].dtype == fast[2].dtype == torch.float32
        for found, expected in zip(fast, slow, strict=True):
            assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()


def test_gradcheck():
    image, target, weights = pair(4, 5, torch.float64, masked=True)
    weights = weights.double()
    torch.autograd.gradcheck(lambda x: image_loss_reference(x, target, weights), (image,), eps=1e-6)


def test_the_reference_is_ssim_by_definition():
    """SSIM of one pixel at a time, each window written out with its zero padding."""
    image, target, weights = pair(9, 13, torch.float64, masked=True)
    x, y = (np.pad(a.detach().numpy(), ((5, 5), (5, 5), (0, 0))) for a in (image, target))
    taps = np.exp(-(np.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    l1, dissimilarity, count = 0.0, 0.0, 0
    for j, i in zip(*np.nonzero(weights.numpy()), strict=True):
        for c in range(3):
            a, b = x[j : j + 11, i : i + 11, c], y[j : j + 11, i : i + 11, c]
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb = (window * a * a).sum() - ma**2, (window * b * b).sum() - mb**2
            cov = (window * a * b).sum() - ma * mb
            ssim = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
            l1, dissimilarity, count = l1 + abs(a[5, 5] - b[5, 5]), dissimilarity + 1 - ssim, count + 1
    found = [float(term.detach()) for term in image_loss_reference(image, target, weights)]
    assert found == pytest.approx([l1 / count, dissimilarity / count], rel=1e-6)


def test_masked_pixels_out_of_reach_do_not_matter():
    image, target, _ = pair(16, 40)
    mask = torch.ones(16, 40)
    mask[:, 20:] = 0
    weights = pixel_weights(mask)
    before = terms_and_gradient(image_loss(image, target, weights), image)
    changed = image.detach().clone()
    changed[:, 25:] += 1
    changed.requires_grad_()
    after = terms_and_gradient(image_loss(changed, target, weights), changed)
    torch.testing.assert_close(after[:2], before[:2], rtol=0, atol=1e-6)
    assert after[2][:, 25:].eq(0).all() and not torch.equal(after[2][:, 20:25], torch.zeros(16, 5, 3))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("differing", [(slice(30, 41), slice(20, 23)), (slice(0, 3), slice(90, 100)), None])
def test_nothing_within_reach_is_cropped(differing, masked):
    """Cropped to what a difference reaches, value and gradient are those of the whole pictures."""
    image, target, weights = pair(70, 100, masked=masked)
    differs = torch.zeros(70, 100, dtype=torch.bool)
    if differing:
        differs[differing] = True
    with torch.no_grad():
        image[~differs] = target[~differs] = torch.tensor([0.2, 1.0, 0.0])
    part = within_reach(differs.any(1)), within_reach(differs.any(0))
    assert image[part].numel() < image.numel() / 2
    whole = terms_and_gradient(image_loss(image, target, weights), image)
    cropped = terms_and_gradient(image_loss(image, target[part], weights[part], part), image)
    for found, expected, tolerance in zip(cropped, whole, (1e-7, 1e-7, 1e-8), strict=True):
        assert (found - expected).abs().max() <= tolerance
    assert bool(cropped[0] > 0) == bool(differing)


@pytest.mark.skipif(threads.available() < 2, reason="needs two CPUs")
def test_threads_change_nothing(kernel_threads):
    image, target, weights = pair(33, 50, masked=True)
    runs = []
    for count in (1, 2):
        kernel_threads(count)
        runs.append(terms_and_gradient(image_loss(image, target, weights), image))
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_empty_masks_nan_and_equal_images():
    image, target, weights = pair(12, 14)
    nothing = terms_and_gradient(image_loss(image, target, pixel_weights(torch.zeros(12, 14))), image)
    assert all(term.eq(0).all() for term in nothing)
    with torch.no_grad():
        image[3, 4, 1] = torch.nan
    broken = terms_and_gradient(image_loss(image, target, weights), image)
    assert broken[0].isnan() and broken[1].isnan() and broken[2][3, 4, 1].isnan()
    l1, dissimilarity = image_loss(target, target, weights)
    assert float(l1) == 0 and abs(float(dissimilarity)) < 1e-6, "equal images cost nothing"
