"""Lays out the player as npm publishes it: `python tools/npm_package.py FOLDER`.

That is player/ without its tests, with the licence, and with the workers' code inside one module: a bundler moves
modules and would leave the workers behind.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pd4dgs_codec.web.page import WORKERS, bundle  # noqa: E402

PLAYER = ROOT / "player"
LEFT_OUT = ("test", "testing", "test-browser", "node_modules", "types")


def workers_module() -> str:
    """render/workers.js with the code of the workers."""
    code = {name.removesuffix("-worker.js"): bundle(PLAYER, f"render/{name}") for name in WORKERS}
    return f"""// @ts-nocheck
// Made by tools/npm_package.py from the workers of this folder: each as one script.
const code = {json.dumps(code, indent=1)};
const url = (name) => new URL(URL.createObjectURL(new Blob([code[name]], {{ type: "text/javascript" }})));
/** @type {{{{loader: URL, sort: URL, evaluate: URL}}}} */
export const WORKERS = {{ loader: url("loader"), sort: url("sort"), evaluate: url("evaluate") }};
"""


def main(folder: str) -> None:
    """Writes the package's source into a folder that does not exist yet."""
    target = shutil.copytree(PLAYER, folder, ignore=shutil.ignore_patterns(*LEFT_OUT))
    shutil.copy(ROOT / "LICENSE", folder)
    (Path(target) / "render" / "workers.js").write_text(workers_module(), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
