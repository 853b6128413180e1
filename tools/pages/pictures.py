"""Pictures of a packed scene: truth and every level side by side, as stills and as an animation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.quality.frames import dataset_frames
from pd4dgs_codec.quality.levels import Level, load_levels
from pd4dgs_codec.quality.movie import Panel, level_panels, side_by_side, write_gif


def draw_levels(data: bytes, dataset: Dataset, still: Path, movie: Path, *, stills: int = 3, frames: int = 40) -> None:
    """Writes `still` (`stills` held-out views, one under the other) and the GIF `movie` (about `frames` frames)."""
    from PIL import Image

    levels = load_levels(data)
    views = dataset.test or dataset.train
    picked = views[:: max(1, len(views) // stills)][:stills]
    Image.fromarray(np.concatenate(list(_panels(levels, picked)))).save(still)
    path = dataset.train[:: max(1, len(dataset.train) // frames)]
    write_gif(_panels(levels, path), movie, fps=12)


def _panels(levels: Sequence[Level], views: Sequence[View]) -> Iterator[np.ndarray]:
    for view, frame in zip(views, dataset_frames(views), strict=True):
        yield side_by_side([Panel(view.image, "truth"), *level_panels(levels, frame)])
