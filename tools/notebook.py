"""Makes the tutorial's notebook from its page: `python tools/notebook.py docs/tutorial.md out/tutorial.ipynb`.

The page is the one source. Blocks of `bash` become cells of shell lines, blocks of `python` cells of code, and all
else, blocks of `sh` included (for a shell of one's own), text. The tests run the cells in this order.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def cells(page: str) -> list[tuple[str, str]]:
    """(kind, source) of each cell, kind "markdown" or "code"; shell lines begin with `!`, as IPython has it."""
    found, at = [], 0
    for match in BLOCK.finditer(page):
        found.append(("markdown", page[at : match.start()]))
        source = match[2]
        if match[1] == "bash":
            source = re.sub(r"^(?=[^#\s])", "!", source, flags=re.MULTILINE)
        found.append(("code", source))
        at = match.end()
    found.append(("markdown", page[at:]))
    return [(kind, source.strip("\n")) for kind, source in found if source.strip()]


def notebook(page: str) -> dict[str, Any]:
    """In version 4.5 of nbformat."""
    made = []
    for number, (kind, source) in enumerate(cells(page)):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source}
        made.append(cell | ({"execution_count": None, "outputs": []} if kind == "code" else {}))
    about = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": made}


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps(notebook(source.read_text(encoding="utf-8")), indent=1) + "\n", encoding="utf-8")
