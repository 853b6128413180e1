"""Writes the table of docs/stability.md: what `pd4dgs-bench stability` prints. About a minute on one core.

    python tools/stability.py [--docs docs]

The exit code is 1, and the page stays, if any row fails.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from pathlib import Path

from pages.page import commit, filled, stamp, unpadded


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    page = parser.parse_args(argv).docs / "stability.md"

    from pd4dgs_codec.cli import bench

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = bench.main(["stability", "-j", "1"])
    if code == 0:
        said = stamp("python tools/stability.py", [{"name": "all", "commit": commit()}], whole=False)
        block = f"{said}\n\n{unpadded(out.getvalue().strip())}"
        page.write_text(filled(page.read_text(), "stability", "stability.py", block, page))
    return code


if __name__ == "__main__":
    sys.exit(main())
