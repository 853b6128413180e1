"""The tools that make and test the vectors lie in tools/, which is no package: put it on the path, as they do."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
