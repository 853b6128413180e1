"""A small scene as a checkpoint and as a `.pd4`, and a small dataset."""

from pathlib import Path

import pytest
from tiny import checkpoint_of, trained_like_scene, write_views

from pd4dgs_codec.scene import Scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return trained_like_scene()


@pytest.fixture(scope="session")
def model_pt(tmp_path_factory, scene) -> Path:
    return checkpoint_of(scene, tmp_path_factory.mktemp("model") / "model.pt")


@pytest.fixture(scope="session")
def scene_pd4(tmp_path_factory, scene) -> Path:
    from pd4dgs_codec.format.encoder import encode

    path = tmp_path_factory.mktemp("file") / "scene.pd4"
    path.write_bytes(encode(scene, effort=1))
    return path


@pytest.fixture(scope="session")
def shared_dataset(tmp_path_factory) -> Path:
    return write_views(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture
def dataset(tmp_path) -> Path:
    """A dataset that a test may damage."""
    return write_views(tmp_path / "set")
