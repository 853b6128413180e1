"""Scores of a renderer over a dataset's views: per-view metrics, averaged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from pd4dgs_codec.quality.image import TrueView, mpsnr

#: (picture, true image, mask) -> score
Metric = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


V = TypeVar("V", bound=TrueView)


def mean_scores(
    draw: Callable[[V], np.ndarray],
    views: Sequence[V],
    metrics: Mapping[str, Metric],
    step: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Each metric's mean over `views` of its score of draw(view), [H, W, 3] in 0..1. step: called after each view."""
    scores: dict[str, list[float]] = {name: [] for name in metrics}
    for view in views:
        picture = draw(view)
        for name, metric in metrics.items():
            scores[name].append(metric(picture, view.image, view.mask))
        step()
    return {name: float(np.mean(values)) for name, values in scores.items()}


def level_psnr(
    draw: Callable[[int, V], np.ndarray],
    levels: Iterable[int],
    views: Sequence[V],
    step: Callable[[], None] = lambda: None,
) -> dict[int, float]:
    """Per level the mean over `views` of the mPSNR of draw(level, view), dB; infinite where nothing differs."""
    return {level: mean_scores(partial(draw, level), views, {"mpsnr": mpsnr}, step)["mpsnr"] for level in levels}
