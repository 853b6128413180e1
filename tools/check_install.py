"""Installs a built package in a fresh environment outside the checkout, and uses it as a stranger would.

python -m build
python tools/check_install.py dist/*.whl           # decodes, inspects, packages, runs the README's Python
python tools/check_install.py dist/*.whl train     # with the extra: trains, encodes and renders too

The environment has the Python that runs this file. It is made in a temporary folder, which goes away afterwards.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VECTOR = "valid/layers-0-1-2.pd4"
INSTALLED = "import pd4dgs_codec; print(pd4dgs_codec.__file__)"


class Environment:
    """A virtual environment in `folder` and an empty folder beside it, in which its commands run."""

    def __init__(self, folder: Path) -> None:
        self.work, self.bin = folder / "work", folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
        self.work.mkdir()
        subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)

    def run(self, program: str, *arguments: object) -> str:
        """The standard output of a program of the environment. Raises CalledProcessError."""
        print("$", program, *(str(argument).partition("\n")[0] for argument in arguments), flush=True)
        environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        command = [str(self.bin / program), *map(str, arguments)]
        return subprocess.run(
            command, cwd=self.work, env=environment, check=True, text=True, encoding="utf-8", stdout=subprocess.PIPE
        ).stdout


def readme_python() -> str:
    """The README's first block of Python."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found[1]


def expected_layers() -> object:
    """The hashes of VECTOR by the manifest."""
    manifest = json.loads((ROOT / "spec" / "vectors" / "manifest.json").read_text(encoding="utf-8"))
    return next(entry["layers"] for entry in manifest["vectors"] if entry["file"] == VECTOR)


def check_decoding(env: Environment) -> None:
    """What the package does without an extra."""
    shutil.copy(ROOT / "spec" / "vectors" / VECTOR, env.work / "scene.pd4")
    assert "site-packages" in env.run("python", "-c", INSTALLED), "the package was not imported from the environment"
    assert json.loads(env.run("pd4dgs-info", "scene.pd4", "--hashes", "--json"))["hashes"] == expected_layers()
    env.run("pd4dgs-decode", "scene.pd4", "-o", "scene.npz")
    env.run("pd4dgs-info", "--sample", "--check")
    env.run("pd4dgs-package", "scene.pd4", "-o", "site", "--no-video")
    print(env.run("python", "-c", readme_python()), end="")


def check_training(env: Environment) -> None:
    """What the extra `train` adds."""
    source = "synthetic:local?size=64x48&frames=8"
    env.run("pd4dgs-train", source, "-o", "model.pt", "--preset", "tiny", "--iterations", 30)
    env.run("pd4dgs-encode", "model.pt", "-o", "own.pd4", "--slices", "50k")
    env.run("pd4dgs-info", "own.pd4", "--check")
    env.run("pd4dgs-render", "own.pd4", "--orbit", 3, "-o", "own.gif")
    env.run("pd4dgs-eval", "own.pd4", source)


def main(built: str, *extras: str) -> None:
    """Checks one wheel or source archive with `extras`."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-install-") as folder:
        env = Environment(Path(folder))
        wanted = str(Path(built).resolve()) + (f"[{','.join(extras)}]" if extras else "")
        env.run("python", "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wanted)
        check_decoding(env)
        if "train" in extras:
            check_training(env)
    print(f"ok: {Path(built).name} {' '.join(extras)} on Python {sys.version.split()[0]}, {sys.platform}")


if __name__ == "__main__":
    main(*sys.argv[1:])
