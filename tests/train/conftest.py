"""The disc's dataset, and the preset `tiny` so small that a step costs milliseconds."""

import pytest
from tiny import TINY, disc

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.model.config import PRESETS


@pytest.fixture
def dataset() -> Dataset:
    return disc()


@pytest.fixture(autouse=True)
def _few_anchors(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
