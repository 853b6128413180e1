import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
from common import OFFICIAL, SHARED
from folders import gradient, pose, save

from pd4dgs_codec.data import videos
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError


def _found(folder: Path, variable: str) -> Callable[[str], Path]:
    """Path of a dataset in the folder; skips if it is not there."""

    def find(name: str) -> Path:
        if not (folder / name).is_dir():
            pytest.skip(f"{name} is not in {folder} (set {variable})")
        return folder / name

    return find


@pytest.fixture
def shared():
    """Path of a shared dataset."""
    return _found(SHARED, "PD4DGS_SHARED")


@pytest.fixture
def official():
    """Path of a scene that papers report on."""
    return _found(OFFICIAL, "PD4DGS_OFFICIAL")


@pytest.fixture(scope="session")
def scene(once) -> Dataset:
    """A small synthetic scene, which one worker draws for all."""

    def make(folder: Path) -> None:
        (folder / "scene").write_bytes(pickle.dumps(load("synthetic:local?frames=13&size=40x30")))

    return pickle.loads((once("small-scene", make) / "scene").read_bytes())


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """The cache of video frames."""
    monkeypatch.setenv(videos.FOLDER, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def blender(tmp_path):
    """Writes a small Blender folder; keyword arguments replace keys of the file or of frame 0."""

    def make(n: int = 9, size=(12, 8), frame0: dict | None = None, name="transforms.json", **top) -> Path:
        frames = []
        for i in range(n):
            save(tmp_path / f"r_{i:03d}.png", gradient(*size, i))
            frames.append({"file_path": f"r_{i:03d}", "time": i / 10, "transform_matrix": pose(0.2 * i)})
        if n:
            frames[0].update(frame0 or {})
        save(tmp_path / name, {"camera_angle_x": 0.8, "frames": frames, **top})
        return tmp_path

    return make


@pytest.fixture
def refused() -> Callable[..., None]:
    """Checks that a source is refused in one line that holds `text` and names the source."""

    def check(source: str | Path, text: str, **options) -> None:
        with pytest.raises(DataError) as caught:
            load(source, **options)
        message = str(caught.value)
        assert text in message and str(source) in message and message.isprintable() and len(message) < 500, message

    return check
