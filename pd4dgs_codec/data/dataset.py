"""`load`: a dataset from its source, by the reader that knows its layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pd4dgs_codec.data.colmap import find_model, read_colmap
from pd4dgs_codec.data.iphone import read_iphone
from pd4dgs_codec.data.neu3d import POSES, read_neu3d
from pd4dgs_codec.data.panoptic import META, read_panoptic
from pd4dgs_codec.data.record3d import is_record3d, read_record3d
from pd4dgs_codec.data.synchronised import find_videos, read_synchronised
from pd4dgs_codec.data.synthetic import PREFIX, read_synthetic
from pd4dgs_codec.data.transforms import read_transforms
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError


def load(source: str | Path, *, downscale: int = 1, holdout: int = 8) -> Dataset:
    """Read a dataset.

    source: `synthetic:NAME[?seed=n&size=WxH&frames=N]`, a folder in the iPhone/Nerfies layout, a folder with
        transforms*.json, one with poses_bounds.npy and videos, one of Panoptic Studio or Record3D, or one with a model
        of COLMAP and pictures or videos.
    downscale: images are averaged over downscale x downscale blocks (the remainder is cropped), intrinsics follow.
    holdout: without split files, frames with i % holdout == holdout // 2 are the test frames; 0 = none.
    Views whose masks hold no valid pixel are left out, see `Dataset.left_out`.
    Raises DataError, one line, for anything missing or broken.
    """
    return _without_blind_views(_read(source, downscale, holdout), source)


def _without_blind_views(dataset: Dataset, source: str | Path) -> Dataset:
    """Nothing can be learnt from a view without a valid pixel, and any picture would match it without error."""

    def sees(view: View) -> bool:
        return view.mask is None or bool(view.mask.any())

    train, test = (tuple(filter(sees, views)) for views in (dataset.train, dataset.test))
    left_out = tuple(view.name for view in (*dataset.train, *dataset.test) if not sees(view))
    if not train:
        count = len(dataset.train)
        raise DataError(f"{source}: the masks of all {count} training views hold no valid pixel, expected one at least")
    return replace(dataset, train=train, test=test, left_out=left_out) if left_out else dataset


def _read(source: str | Path, downscale: int, holdout: int) -> Dataset:
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise DataError(f"{source}: downscale is {downscale}, expected an integer >= 1")
    if isinstance(holdout, bool) or not isinstance(holdout, int) or holdout < 0 or holdout == 1:
        raise DataError(f"{source}: holdout {holdout} leaves no training frame, expected 0 (none) or an integer >= 2")
    if str(source).startswith(PREFIX):
        return read_synthetic(str(source), downscale)
    folder = Path(source)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise DataError(f"{folder}: found {found}, expected a dataset folder or {PREFIX}NAME")
    if (folder / "camera").is_dir():
        return read_iphone(folder, downscale)
    if any(folder.glob("transforms*.json")):
        return read_transforms(folder, downscale, holdout)
    if (folder / POSES).is_file():
        return read_neu3d(folder, downscale, holdout)
    if (folder / META).is_file():
        return read_panoptic(folder, downscale, holdout)
    if is_record3d(folder):
        return read_record3d(folder, downscale, holdout)
    if (model := find_model(folder)) is not None:
        if videos := find_videos(folder):
            return read_synchronised(folder, videos, *model, downscale, holdout)
        return read_colmap(folder, *model, downscale, holdout)
    found = "other files" if any(folder.iterdir()) else "an empty folder"
    raise DataError(
        f"{folder}: found {found}, expected camera/ (iPhone, Nerfies), transforms*.json (Blender), {POSES} (Neu3D), "
        f"{META} (Panoptic Studio), metadata with rgbd/ (Record3D) or sparse/0 (COLMAP)"
    )
