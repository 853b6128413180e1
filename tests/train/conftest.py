"""The dataset of the disc, the preset `tiny` so small that a step costs milliseconds, and phases in short runs."""

import pytest
from tiny import TINY, disc

from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.train import phases


@pytest.fixture
def dataset() -> Dataset:
    return disc()


@pytest.fixture(autouse=True)
def _few_anchors(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)


@pytest.fixture
def short_runs_have_phases(monkeypatch):
    monkeypatch.setattr(phases, "MIN_ITERATIONS", 10)
