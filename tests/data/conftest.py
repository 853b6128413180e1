import json
import os
from pathlib import Path

import pytest
from dataset_pictures import gradient, pose
from PIL import Image

SHARED = Path(os.environ.get("PD4DGS_SHARED", Path(__file__).resolve().parents[2] / ".." / "shared" / "data"))


@pytest.fixture
def shared():
    """Path of a shared dataset; skips if it is not there."""

    def find(name: str) -> Path:
        path = SHARED / name
        if not path.is_dir():
            pytest.skip(f"{name} is not in {SHARED} (set PD4DGS_SHARED)")
        return path

    return find


@pytest.fixture
def blender(tmp_path):
    """Writes a small Blender folder; keyword arguments replace keys of the file or of frame 0."""

    def make(n: int = 9, size=(12, 8), frame0: dict | None = None, name="transforms.json", **top) -> Path:
        frames = []
        for i in range(n):
            Image.fromarray(gradient(*size, i)).save(tmp_path / f"r_{i:03d}.png")
            frames.append({"file_path": f"r_{i:03d}", "time": i / 10, "transform_matrix": pose(0.2 * i)})
        if n:
            frames[0].update(frame0 or {})
        (tmp_path / name).write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames, **top}))
        return tmp_path

    return make
