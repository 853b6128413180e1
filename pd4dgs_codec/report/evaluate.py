"""Quality and bytes per level of a file, on a dataset's held-out views."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pd4dgs_codec.data.dataset import Dataset, View
from pd4dgs_codec.metrics.image import mean_image_baseline, mpsnr, mssim
from pd4dgs_codec.report.levels import Level, load_levels


def evaluate_file(
    path_or_bytes: str | Path | bytes,
    dataset: Dataset,
    max_layer: int | None = None,
    *,
    device: str = "cpu",
    step: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """What `pd4dgs-eval --json` prints: metrics are means over the views of the per-view values.

    Without held-out views the training views are used and "split" says "train". mpsnr in dB, infinite where nothing
    differs. step is called after each view of each level. Raises DecodeError, DataError.
    """
    views, split = (dataset.test, "test") if dataset.test else (dataset.train, "train")
    levels = load_levels(path_or_bytes, max_layer, device)
    return {
        "source": dataset.name,
        "split": split,
        "views": len(views),
        "width": views[0].width,
        "height": views[0].height,
        "masked": dataset.masked and split == "test",
        "baseline_mean_image_psnr": _baseline(dataset, views),
        "levels": [evaluate_level(level, views, step) for level in levels],
    }


def evaluate_level(level: Level, views: tuple[View, ...], step: Callable[[], None] | None = None) -> dict[str, Any]:
    """The row of one level. render_ms: median milliseconds per picture, the networks included."""
    scores, milliseconds = [], []
    for i, view in enumerate(views):
        if i == 0:  # compilation and caches are not the renderer's speed
            level.picture(view.camera, view.time)
        start = time.perf_counter()
        image = level.picture(view.camera, view.time)
        milliseconds.append(1e3 * (time.perf_counter() - start))
        scores.append((mpsnr(image, view.image, view.mask), mssim(image, view.image, view.mask)))
        if step:
            step()
    psnr, ssim = zip(*scores, strict=True)
    return {
        "level": level.level,
        "mpsnr": sum(psnr) / len(psnr),
        "mssim": sum(ssim) / len(ssim),
        "cumulative_bytes": level.cumulative_bytes,
        "anchors": level.anchors,
        "decode_seconds": level.decode_seconds,
        "render_ms": statistics.median(milliseconds),
    }


def _baseline(dataset: Dataset, views: tuple[View, ...]) -> float | None:
    """PSNR of always showing the mean training image; None where images differ in size and there is no such image."""
    sizes = {view.image.shape for view in (*dataset.train, *views)}
    return mean_image_baseline(dataset.train, views) if len(sizes) == 1 else None
