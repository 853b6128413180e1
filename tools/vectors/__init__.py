"""Conformance vectors: what is in each file, and how its bytes are written. `tools/make_vectors.py` writes them out."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "spec"))  # the reference decoder: one file that can be carried alone, in no package

import refdec as refdec  # noqa: E402
