"""The fuzzer lives in tools/, which is no package: put it on the path, as its command does."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
