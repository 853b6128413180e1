"""Writes a dataset in the iPhone layout: what the tests of its reader read back and break."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pd4dgs_codec.data.files import shrink_image, shrink_mask
from pd4dgs_codec.data.view import Dataset, View

FACTORS = (1, 2)  #: resolutions written; extra.json names the first as the dataset's own


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
    path.write_text(json.dumps(value))


def _write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def export_iphone(dataset: Dataset, folder: Path) -> None:
    """Writes `dataset` to the new `folder`; its views' names are those of the files, their times the warp ids.

    Masks of training views, colours of points and a start of the time range other than 0 have no place in the layout.
    """
    views = [*dataset.train, *dataset.test]
    for view in views:
        _write_json(folder / "camera" / f"{view.name}.json", _camera(view))
        for k in FACTORS:
            _write_image(folder / "rgb" / f"{k}x" / f"{view.name}.png", shrink_image(view.image, k))
    if dataset.masked:
        for view in dataset.test:
            for k in FACTORS:
                path = folder / "covisible" / f"{k}x" / "val" / f"{view.name}.png"
                _write_image(path, shrink_mask(view.mask, k).astype(np.uint8) * 255)
    for split, part in (("train", dataset.train), ("val", dataset.test)):
        _write_json(folder / "splits" / f"{split}.json", {"frame_names": [view.name for view in part]})
    _write_json(folder / "dataset.json", {"ids": [view.name for view in views]})
    rows = {view.name: {"warp_id": view.time, "camera_id": view.camera_id} for view in views}
    _write_json(folder / "metadata.json", rows)
    _write_json(folder / "scene.json", {"center": [0.0] * 3, "scale": 1.0, "near": dataset.near, "far": dataset.far})
    extra = {
        "factor": FACTORS[0],
        "fps": 1 / (dataset.time_range[1] - dataset.time_range[0]),
        "bbox": dataset.box.tolist(),
        "up": list(dataset.up),
        "background": list(dataset.background),  # not in the original layout; readers that do not know it ignore it
    }
    _write_json(folder / "extra.json", extra)
    if dataset.points is not None:
        np.save(folder / "points.npy", dataset.points)
