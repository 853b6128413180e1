"""Parts of tools/fuzz.py."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "spec"))  # the reference decoder: one file that can be carried alone, in no package
