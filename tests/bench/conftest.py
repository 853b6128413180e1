"""A small scene with a camera as scene, bytes and checkpoint."""

from pathlib import Path

import pytest
from tiny import checkpoint_of, filmed_scene

from pd4dgs_codec import encode
from pd4dgs_codec.scene import Scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return filmed_scene()


@pytest.fixture(scope="session")
def data(scene) -> bytes:
    return encode(scene, layers=2, effort=1)


@pytest.fixture(scope="session")
def model_pt(scene, tmp_path_factory) -> Path:
    return checkpoint_of(scene, tmp_path_factory.mktemp("model") / "model.pt")
