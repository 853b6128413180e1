"""The few pictures that a precision report takes of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from pd4dgs_codec.scene import SceneInfo
from pd4dgs_codec.view.frames import Frame, dataset_frames, own_frames

T = TypeVar("T")


def spread(items: Sequence[T], count: int) -> list[T]:
    """Up to `count` of the items, evenly spaced, each from the middle of its share."""
    count = min(count, len(items))
    return [items[(2 * i + 1) * len(items) // (2 * count)] for i in range(count)]


def frames(
    info: SceneInfo, source: str | None, count: int, downscale: int | None = None, holdout: int | None = None
) -> list[Frame]:
    """Up to `count` frames: of the held-out views of `source` (training views if none are), or, without a source, of
    the file's own camera over time. Raises DataError, RenderError."""
    if source is None:
        return own_frames(info, count, downscale=downscale or 1)
    from pd4dgs_codec.data.dataset import load

    dataset = load(source, downscale=downscale or 1, holdout=8 if holdout is None else holdout)
    return dataset_frames(spread(dataset.test or dataset.train, count))
