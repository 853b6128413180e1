"""The player's tests wait while it reads an earlier draft of the format than the package writes."""

import re
from pathlib import Path

import pytest

from pd4dgs_codec.bitstream.container import MAJOR

CONTAINER = Path(__file__).parents[2] / "player" / "decode" / "container.js"


@pytest.fixture(autouse=True, scope="session")
def _same_draft():
    reads = int(re.search(r"^const MAJOR = (\d+);", CONTAINER.read_text(encoding="utf-8"), flags=re.M)[1])
    if reads != MAJOR:
        pytest.skip(f"the player reads draft {reads} of the format, the package writes draft {MAJOR}")
