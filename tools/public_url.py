"""Writes the repository's public address into what is published from it, since the repository itself names none.

python tools/public_url.py https://example.org/owner/pd4dgs-codec

pyproject.toml gets project URLs, player/package.json its `repository` (which npm holds against the attestation),
CITATION.cff its `repository-code`, and the README's links become absolute, so that package pages have no dead ones.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def write(root: Path, url: str) -> None:
    """Changes the four files below `root`."""
    project = root / "pyproject.toml"
    urls = {"Homepage": url, "Issues": f"{url}/issues", "Changelog": f"{url}/blob/HEAD/CHANGELOG.md"}
    table = "".join(f'{name} = "{value}"\n' for name, value in urls.items())
    text = project.read_text(encoding="utf-8").replace(
        "[project.scripts]", f"[project.urls]\n{table}\n[project.scripts]"
    )
    project.write_text(text, encoding="utf-8")

    package = root / "player" / "package.json"
    values = json.loads(package.read_text(encoding="utf-8"))
    values |= {"repository": {"type": "git", "url": f"git+{url}.git", "directory": "player"}, "homepage": url}
    package.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")

    with open(root / "CITATION.cff", "a", encoding="utf-8") as citation:
        citation.write(f"repository-code: {url}\n")

    for readme, folder in ((root / "README.md", ""), (root / "player" / "README.md", "player/")):
        readme.write_text(absolute(readme.read_text(encoding="utf-8"), url, folder), encoding="utf-8")


def absolute(text: str, url: str, folder: str = "") -> str:
    """Markdown in which links and pictures that are relative to `folder` begin with `url`."""
    text = re.sub(r"(!\[[^\]]*\]\()(?!https?:|#)([^)]+)", rf"\1{url}/raw/HEAD/{folder}\2", text)
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!https?:|#)([^)]+)", rf"\1{url}/blob/HEAD/{folder}\2", text)


if __name__ == "__main__":
    write(ROOT, sys.argv[1].rstrip("/"))
