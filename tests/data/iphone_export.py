"""Writes a dataset in the iPhone layout: what the tests of its reader read back and break."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data import Dataset, View
from pd4dgs_codec.data.files import shrink_image, shrink_mask

MAX_TIME_ID = 99_999  #: names have five digits
FACTORS = (1, 2)  #: resolutions written; extra.json names the first as the dataset's own


@dataclass(frozen=True, eq=False)
class _Entry:
    view: View
    name: str
    camera_id: int
    time_id: int


def _time_ids(times: Iterable[float]) -> list[int]:
    """Integers that reproduce the normalised times: round(t * n) for the least n that does so to 1e-6, else the most.

    With the most, times move by at most 5e-6.
    """
    t = np.asarray(list(times), np.float64)
    distinct = np.unique(t)
    if len(distinct) == 1:
        return [0] * len(t)
    n = MAX_TIME_ID
    for n in range(len(distinct) - 1, MAX_TIME_ID + 1):
        if np.abs(np.rint(distinct * n) / n - distinct).max() <= 1e-6:
            break
    return np.rint(t * n).astype(int).tolist()


def _entries(dataset: Dataset) -> tuple[list[_Entry], list[_Entry]]:
    """Name the frames camera_time; a view whose name is taken moves to the next free camera number."""
    views = [*dataset.train, *dataset.test]
    taken: set[tuple[int, int]] = set()
    entries = []
    for view, time_id in zip(views, _time_ids(v.time for v in views), strict=True):
        camera_id = view.camera_id
        while (camera_id, time_id) in taken:
            camera_id += 1
        taken.add((camera_id, time_id))
        entries.append(_Entry(view, f"{camera_id}_{time_id:05d}", camera_id, time_id))
    return entries[: len(dataset.train)], entries[len(dataset.train) :]


def _camera(view: View) -> dict[str, Any]:
    viewmat, K = view.viewmat.astype(np.float64), view.K.astype(np.float64)
    return {
        "orientation": viewmat[:3, :3].tolist(),
        "position": (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist(),
        "focal_length": K[0, 0],
        "pixel_aspect_ratio": K[1, 1] / K[0, 0],
        "principal_point": [K[0, 2], K[1, 2]],
        "image_size": [view.width, view.height],
        "skew": 0.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
    }


def _write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def _write_image(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def _write_pixels(folder: Path, entries: list[_Entry], with_masks: bool) -> None:
    for entry in entries:
        view = entry.view
        mask = np.ones((view.height, view.width), bool) if view.mask is None else view.mask
        for k in FACTORS:
            _write_image(folder / "rgb" / f"{k}x" / f"{entry.name}.png", shrink_image(view.image, k))
            if with_masks:
                path = folder / "covisible" / f"{k}x" / "val" / f"{entry.name}.png"
                _write_image(path, shrink_mask(mask, k).astype(np.uint8) * 255)


def _fps(dataset: Dataset, last: int) -> float:
    seconds = dataset.time_range[1] - dataset.time_range[0]
    return last / seconds if last and seconds > 0 else 30.0


def _write_tables(folder: Path, dataset: Dataset, train: list[_Entry], test: list[_Entry]) -> None:
    entries = [*train, *test]
    ids = {key: [e.name for e in part] for key, part in (("train_ids", train), ("val_ids", test))}
    counts = {"count": len(entries), "num_exemplars": len(train)}
    _write_json(folder / "dataset.json", {**counts, "ids": [e.name for e in entries], **ids})
    rows = {e.name: {"warp_id": e.time_id, "appearance_id": e.time_id, "camera_id": e.camera_id} for e in entries}
    _write_json(folder / "metadata.json", rows)
    for split, part in (("train", train), ("val", test)):
        lists = {
            "frame_names": [e.name for e in part],
            "camera_ids": [e.camera_id for e in part],
            "time_ids": [e.time_id for e in part],
        }
        _write_json(folder / "splits" / f"{split}.json", lists)
    _write_json(folder / "scene.json", {"center": [0.0] * 3, "scale": 1.0, "near": dataset.near, "far": dataset.far})
    extra = {
        "factor": FACTORS[0],
        "fps": _fps(dataset, max(e.time_id for e in entries)),
        "bbox": dataset.box.tolist(),
        "lookat": dataset.box.mean(axis=0).tolist(),
        "up": list(dataset.up),
        "background": list(dataset.background),  # not in the original layout; readers that do not know it ignore it
    }
    _write_json(folder / "extra.json", extra)


def export_iphone(dataset: Dataset, folder: Path) -> None:
    """Writes `dataset` to the new `folder`.

    Full-size images are rgb/1x with factor 1; rgb/2x holds their 2x2 means for code that expects it. Reading the folder
    gives the same cameras, times, images, test masks, points, box, near and far. Colours of the points, masks of
    training views and a start of the time range other than 0 have no place in the layout and are lost.
    """
    train, test = _entries(dataset)
    for entry in [*train, *test]:
        _write_json(folder / "camera" / f"{entry.name}.json", _camera(entry.view))
    _write_pixels(folder, train, False)
    _write_pixels(folder, test, dataset.masked or any(v.mask is not None for v in dataset.test))
    _write_tables(folder, dataset, train, test)
    if dataset.points is not None:
        np.save(folder / "points.npy", dataset.points)
