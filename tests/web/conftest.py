"""A small scene of three layers, and a server of the folder it lies in."""

from pathlib import Path

import pytest
from strategies import make_scene

from pd4dgs_codec import encode
from pd4dgs_codec.web.server import Server


@pytest.fixture(scope="session")
def scene_bytes() -> bytes:
    return encode(make_scene(7, anchors=250, kind="gaussian", extent=20), layers=2, effort=1)


@pytest.fixture
def folder(tmp_path, scene_bytes) -> Path:
    """Holds scene.pd4 and bytes.bin (1,000 bytes, each its own position modulo 251)."""
    root = tmp_path / "www"
    root.mkdir()
    (root / "scene.pd4").write_bytes(scene_bytes)
    (root / "bytes.bin").write_bytes(bytes(i % 251 for i in range(1000)))
    return root


@pytest.fixture
def server(folder):
    with Server(folder) as served, served.running():
        yield served
