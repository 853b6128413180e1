"""Small scenes, checkpoints and presets that several tests share."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from strategies import make_scene

from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS, Camera, Scene

#: A preset whose training steps take milliseconds.
SMALLEST = ModelConfig(
    DeformationConfig(4, 4, 4, (1,), 8, tuple(GLOBAL_HEADS)),
    DeformationConfig(4, 4, 4, (1,), 8, tuple(LOCAL_HEADS)),
    hidden=8,
    initial_anchors=200,
    max_anchors=300,
)
#: Held-out quality that `checkpoint_of` tells of.
CURVE = [{"seconds": 2.0, "psnr": [10.0, 20.0]}, {"seconds": 4.0, "psnr": [12.0, 40.0]}]


def filmed_scene() -> Scene:
    """40 anchors in front of a camera of 32 x 24 pixels, three layers."""
    made = make_scene(8, anchors=40)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 2.0
    K = np.array([[30, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32)
    return replace(made, info=replace(made.info, camera=Camera(viewmat, K, 32, 24)))


def checkpoint_of(scene: Scene, path: Path) -> Path:
    """Writes a checkpoint of the preset tiny that was evaluated twice."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import from_scene

    checkpoint.save(path, from_scene(scene), {"curve": json.dumps(CURVE), "config": json.dumps({"preset": "tiny"})})
    return path


def write_views(folder: Path) -> Path:
    """Four grey pictures of 24 x 16 pixels from cameras side by side, as a dataset in `folder`."""
    from PIL import Image

    frames = []
    for i in range(4):
        Image.fromarray(np.full((16, 24, 3), 40 * i, np.uint8)).save(folder / f"{i}.png")
        pose = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"{i}.png", "time": i / 3, "transform_matrix": pose})
    content = {"fl_x": 30.0, "fl_y": 30.0, "cx": 12, "cy": 8, "w": 24, "h": 16, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder
