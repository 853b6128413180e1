"""Scores over views and levels are means of the per-view scores, masks included."""

from types import SimpleNamespace

import numpy as np
import pytest

from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.quality.level_psnr import level_psnr, mean_scores

RNG = np.random.default_rng(0)
MASK = RNG.random((6, 8)) < 0.5
VIEWS = [
    SimpleNamespace(image=RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8), mask=mask) for mask in (None, MASK, None)
]


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


def test_psnr_per_level_keeps_the_levels_and_honours_masks():
    def draw(level, view):
        picture = wrong_by(1 + level, view)
        if view.mask is not None:
            picture[~view.mask] = 0  # not looked at
        return picture

    assert level_psnr(draw, (0, 2), VIEWS) == pytest.approx({0: 20 * np.log10(255), 2: 20 * np.log10(255 / 3)})
