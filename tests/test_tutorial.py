"""The tutorial is run as its notebook, and the demo, with a smaller scene, fewer pictures and steps."""

import re
import runpy
import shlex
import sys
from importlib.metadata import entry_points
from pathlib import Path

from notebook import cells, notebook
from PIL import Image
from tiny import TINY

from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.quality import packing

ROOT = Path(__file__).resolve().parents[1]
DEMO = (ROOT / "tools" / "demo.sh").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SMALLER = {"synthetic:local": "'synthetic:local?size=64x48&frames=8'", "--max-seconds 150": "--iterations 4"}


def run_command(line: str, smaller: dict[str, str]) -> None:
    """A line of a shell with texts replaced, by the command's own entry point: starting Python anew takes seconds."""
    for usual, small in smaller.items():
        line = line.replace(usual, small)
    name, *argv = shlex.split(line)
    (script,) = entry_points(group="console_scripts", name=name)
    assert script.load()(argv) == 0, line


def test_the_tutorial_runs_from_the_first_cell_to_the_last(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)
    code = [source for kind, source in cells(PAGE) if kind == "code"]
    assert all(usual in "".join(code) for usual in SMALLER)
    shown: list[str] = []
    names: dict[str, object] = {}
    for source in code:
        if source.startswith("!"):
            for line in source.split("\n"):
                run_command(line[1:], SMALLER)
        else:
            exec(compile(source, "docs/tutorial.md", "exec"), names)
        shown.append("".join(capfd.readouterr()))  # a notebook shows both streams
    assert re.search(r"^0 .*\n", shown[0], re.MULTILINE), "training lists its levels"
    made = ("model.pt", "scene.pd4", "orbit.gif", "scene.html", "site/index.html", "site/scene.pd4")
    assert all((tmp_path / name).stat().st_size for name in made) and list((tmp_path / "first").glob("*.png"))
    assert "anchors" in shown[-1]


def test_the_notebook_has_all_of_the_page():
    made = notebook(PAGE)
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    assert {cell["cell_type"] for cell in made["cells"]} == {"code", "markdown"}
    text = "".join(cell["source"] for cell in made["cells"])
    plain = re.sub(r"^```(bash|python)\n(.*?)^```\n", r"\2", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert re.sub(r"[!\s]", "", text) == re.sub(r"[!\s]", "", plain)
    assert any("pd4dgs-prepare" in cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")


def test_the_demo_measures_and_draws_every_level(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setattr(packing, "OWN_PICTURES", 2)
    lines = [line for line in DEMO.splitlines() if line.startswith("pd4dgs-")]
    for line in lines:
        run_command(line, {"$scene": "synthetic:dancer?size=32x32&frames=4", "--max-seconds 120": "--iterations 10"})
    assert "bytes so far" in capfd.readouterr().out
    ((script, *argv),) = (shlex.split(line)[1:] for line in DEMO.splitlines() if line.startswith("python "))
    monkeypatch.setattr(sys, "argv", [script, *argv])
    runpy.run_path(str(ROOT / "tools" / "demo" / script), run_name="__main__")  # as deep as out/demo
    assert len(lines) == 4 and all((tmp_path / name).stat().st_size for name in ("scene.pd4", "levels.png"))
    assert Image.open(tmp_path / "arriving.gif").n_frames > 10
    for path in re.findall(r"out/demo/(\S+\.\w+)", DEMO):  # the last lines name what is there
        assert (tmp_path / path).exists()
