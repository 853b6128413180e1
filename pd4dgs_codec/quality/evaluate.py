"""Evaluates quality and bytes of the levels of a file on a dataset's held-out views."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.quality.image import (
    Metric,
    mean_image_baseline,
    mean_scores,
    moving_regions,
    mpsnr,
    mssim,
    ssim,
    to_uint8,
)
from pd4dgs_codec.quality.levels import Level
from pd4dgs_codec.quality.perceptual import VGG, Distance, Perceptual
from pd4dgs_codec.scene import Camera

#: Pictures of one camera over t = 0..1 that the temporal distances compare.
TEMPORAL_FRAMES = 30
#: dycheck: mpsnr and mssim. 3dgs adds psnr, ssim and, if it is available, lpips_vgg, all without masks.
PROTOCOLS = ("dycheck", "3dgs")


def evaluate(
    levels: Sequence[Level],
    dataset: Dataset,
    *,
    protocol: str = PROTOCOLS[0],
    perceptual: Perceptual | None = None,
    step: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Returns the result of `pd4dgs-eval --json`; metrics are means over the views.

    Without held-out views the training views are used and "split" is "train". mpsnr is in dB, infinite for equal
    pictures. protocol: of PROTOCOLS. perceptual: distances to add, see `_row`; the result describes them under
    "perceptual". step is called after each picture of each level.
    """
    views, split = (dataset.test, "test") if dataset.test else (dataset.train, "train")
    moving = moving_regions(views)
    distances = perceptual.distances if perceptual else {}
    masked = {name: distance for name, distance in distances.items() if name != VGG}
    metrics: dict[str, Metric] = {"mpsnr": mpsnr, "mssim": mssim, **{f"m{name}": d for name, d in masked.items()}}
    if protocol == "3dgs":
        metrics |= {"psnr": _unmasked(mpsnr), "ssim": _unmasked(ssim)}
        metrics |= {name: _unmasked(distances[name]) for name in {VGG} & distances.keys()}
    result: dict[str, Any] = {
        "source": dataset.name,
        "protocol": protocol,
        "split": split,
        "views": len(views),
        "width": views[0].width,
        "height": views[0].height,
        "masked": dataset.masked and split == "test",
        "baseline_mean_image_psnr": mean_image_baseline(dataset.train, views),
        "moving_share": float(np.mean([region.mean() for region in moving.values()])) if moving else None,
        "levels": [_row(level, views, metrics, masked, moving, step) for level in levels],
    }
    if perceptual:
        result["perceptual"] = {
            "distances": {name: {"title": d.title, "source": d.source} for name, d in distances.items()},
            "absent": perceptual.absent,
            **({"temporal_frames": TEMPORAL_FRAMES, "temporal_camera": views[0].name} if masked else {}),
        }
    return result


def metric_columns(result: dict[str, Any]) -> list[tuple[str, str, int]]:
    """Returns (heading, key of a level's row, decimals) for each metric of an evaluation."""
    titles = {name: d["title"] for name, d in result.get("perceptual", {"distances": {}})["distances"].items()}
    vgg = titles.pop(VGG, None)
    m = "m" if result["protocol"] == "dycheck" else ""
    return [
        (f"{m}PSNR dB", f"{m}psnr", 2),
        *([("moving dB", "moving_mpsnr", 2)] if result["moving_share"] else []),
        (f"{m}SSIM", f"{m}ssim", 4),
        *([(vgg, VGG, 4)] if vgg else []),
        *((f"m{title}", f"m{name}", 4) for name, title in titles.items()),
        *((f"t-{title}", f"t_{name}", 5) for name, title in titles.items()),
    ]


def _row(
    level: Level,
    views: tuple[View, ...],
    metrics: Mapping[str, Metric],
    distances: Mapping[str, Distance],
    moving: Mapping[View, np.ndarray],
    step: Callable[[], None],
) -> dict[str, Any]:
    """Returns the row of one level. render_ms: median milliseconds per picture, the networks included.

    metrics: key -> metric, of which the row has the mean over the views. distances: name -> distance; adds t_<name>,
    the mean distance between successive pictures of the first view's camera at TEMPORAL_FRAMES equidistant times from
    0 to 1. moving: masks of views, see `moving_regions`; adds moving_mpsnr, the views' mean mPSNR within the masks.
    """
    milliseconds, where_moving = [], []

    def draw(view: View) -> np.ndarray:
        image, took = level.timed_picture(view.camera, view.time)
        milliseconds.append(took)
        if view in moving:
            where_moving.append(mpsnr(image, view.image, moving[view]))
        return image

    level.picture(views[0].camera, views[0].time)  # warms up, so that render_ms counts no compilation
    return {
        "level": level.level,
        **mean_scores(draw, views, metrics, step),
        **({"moving_mpsnr": float(np.mean(where_moving))} if moving else {}),
        **_temporal(level, views[0].camera, distances, step),
        "cumulative_bytes": level.cumulative_bytes,
        "anchors": level.anchors,
        "decode_seconds": level.decode_seconds,
        "render_ms": statistics.median(milliseconds),
    }


def _unmasked(metric: Callable[[np.ndarray, np.ndarray], float]) -> Metric:
    return lambda picture, truth, mask: metric(picture, truth)


def _temporal(
    level: Level, camera: Camera, distances: Mapping[str, Distance], step: Callable[[], None]
) -> dict[str, float]:
    if not distances:
        return {}
    frames = []
    for t in np.linspace(0.0, 1.0, TEMPORAL_FRAMES):
        frames.append(to_uint8(level.picture(camera, float(t))))
        step()
    return {f"t_{name}": distance.temporal(frames) for name, distance in distances.items()}
