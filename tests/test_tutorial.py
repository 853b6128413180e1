"""The tutorial is run as its notebook, with a smaller scene and fewer steps."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

from notebook import cells, notebook  # noqa: E402

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SMALLER = {"synthetic:local": "'synthetic:local?size=64x48&frames=8'", "--max-seconds 150": "--iterations 4"}


def run_shell(line: str, folder: Path) -> str:
    """A line of the notebook, with the commands of this environment first."""
    for usual, small in SMALLER.items():
        line = line.replace(usual, small)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    done = subprocess.run(
        line, shell=True, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True, timeout=1800
    )
    assert done.returncode == 0, f"{line}\n{done.stderr}"
    return done.stdout + done.stderr  # a notebook shows both


def test_the_tutorial_runs_from_the_first_cell_to_the_last(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = [source for kind, source in cells(PAGE) if kind == "code"]
    assert all(usual in "".join(code) for usual in SMALLER)
    shown: list[str] = []
    names: dict[str, object] = {}
    for source in code:
        if source.startswith("!"):
            shown += [run_shell(line[1:], tmp_path) for line in source.split("\n")]
        else:
            exec(compile(source, "docs/tutorial.md", "exec"), names)
    assert re.search(r"^0 .*\n", shown[0], re.MULTILINE), "training lists its levels"
    made = ("model.pt", "scene.pd4", "orbit.gif", "scene.html", "site/index.html", "site/scene.pd4")
    assert all((tmp_path / name).stat().st_size for name in made) and list((tmp_path / "first").glob("*.png"))
    assert "anchors" in capsys.readouterr().out


def test_the_notebook_has_all_of_the_page():
    made = notebook(PAGE)
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    assert {cell["cell_type"] for cell in made["cells"]} == {"code", "markdown"}
    text = "".join(cell["source"] for cell in made["cells"])
    plain = re.sub(r"^```(bash|python)\n(.*?)^```\n", r"\2", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert re.sub(r"[!\s]", "", text) == re.sub(r"[!\s]", "", plain)
    assert any("pd4dgs-prepare" in cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")
