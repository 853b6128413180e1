"""`pd4dgs-view`: a page, the player and the scene from one address, until a signal comes."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import IO

import pytest
from strategies import make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.cli import view
from pd4dgs_codec.model.checkpoint import save
from pd4dgs_codec.model.convert import from_scene

ROOT = Path(__file__).parents[2]
IMPORTS = re.compile(r'(?:from|import|new URL\()\s*"(\./[^"]+)"')


@pytest.fixture(scope="module")
def scene_pd4(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("view") / "scene.pd4"
    path.write_bytes(encode(make_scene(0), effort=1))
    return path


def run(*argv: object, stdin: IO[bytes] | None = None) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pd4dgs_codec", "view", "--no-browser", *map(str, argv)]
    return subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_the_page_all_its_modules_and_the_scene_come_from_one_address(scene_pd4):
    process = run(scene_pd4)
    assert process.stdout is not None
    page = process.stdout.readline().strip()
    assert page.startswith("http://127.0.0.1:") and page.endswith("/index.html?src=scene.pd4")
    base, pending, seen = page.rsplit("/", 1)[0], ["element.js"], set[str]()
    assert "pd4-player" in fetch(f"{base}/index.html").decode()
    assert fetch(f"{base}/scene.pd4") == scene_pd4.read_bytes()
    while pending:  # what a module asks for is there, too
        name = pending.pop()
        seen.add(name)
        text = fetch(f"{base}/{name}").decode()
        found = [str((Path("/") / name).parent / target) for target in IMPORTS.findall(text)]
        found += [str((Path("/") / name).parent / t) for t in re.findall(r'from "(\.\./[^"]+)"', text)]
        names = {str(Path(f).resolve().relative_to("/")) for f in found}
        pending += [n for n in names - seen if n.endswith(".js")]
    assert {"decode/positions.js", "render/player.js", "render/sort-worker.js"} <= seen
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


def fetch(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=60) as answer:
        data: bytes = answer.read()
        return data


@pytest.mark.parametrize(("content", "says"), [(b"no scene", "checkpoint"), (None, "No such file")])
def test_what_is_no_scene_is_one_line_and_no_page(tmp_path, content, says):
    path = tmp_path / "scene.pd4"
    if content is not None:
        path.write_bytes(content)
    out, err = run(path).communicate(timeout=300)
    assert out == "" and says in err and len(err.splitlines()) == 1


def test_a_checkpoint_may_come_through_stdin(tmp_path):
    save(tmp_path / "model.pt", from_scene(make_scene(0)), {})
    with open(tmp_path / "model.pt", "rb") as stdin:
        process = run("-", stdin=stdin)
        assert process.stdout is not None
        page = process.stdout.readline().strip()
        assert decode(fetch(page.replace("index.html?src=", ""))).layers[0] == 0
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


def test_a_damaged_file_is_said_here_and_not_in_the_page(scene_pd4, tmp_path):
    data = bytearray(scene_pd4.read_bytes())
    data[-30] ^= 1
    (tmp_path / "scene.pd4").write_bytes(data)
    process = run(tmp_path / "scene.pd4")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1 and out == "" and "CRC" in err and len(err.splitlines()) == 1


def test_the_wheel_gets_every_package_and_what_the_page_needs():
    listed = set(re.findall(r'^    "(pd4dgs_codec[\w.]*)",$', (ROOT / "pyproject.toml").read_text(), flags=re.M))
    rooms = {str(p.parent.relative_to(ROOT)).replace("/", ".") for p in (ROOT / "pd4dgs_codec").rglob("__init__.py")}
    player = {".".join(["pd4dgs_codec", "player", *Path(part).with_suffix("").parts]) for part in ("decode", "render")}
    assert listed == rooms | player | {"pd4dgs_codec.player"}
    assert all((ROOT / "player" / part).exists() for part in view.PLAYER_PARTS)
