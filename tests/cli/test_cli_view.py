"""`pd4dgs-view`: a page, the player and the scene from one address, until a signal comes."""

import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from typing import IO

import pytest
import segmented

import pd4dgs_codec
from pd4dgs_codec import decode, show
from pd4dgs_codec.web.page import page as whole_page

#: How a browser asks to go on as a web socket.
SOCKET = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AA=="}


def run(*argv: object, stdin: IO[bytes] | None = None) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pd4dgs_codec", "view", "--no-browser", *map(str, argv)]
    return subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_the_page_and_the_scene_come_from_one_address(scene_pd4):
    process = run(scene_pd4)
    page = process.stdout.readline().strip()
    assert page.startswith("http://127.0.0.1:") and page.endswith("/index.html?src=scene.pd4")
    base = page.rsplit("/", 1)[0]
    assert fetch(f"{base}/scene.pd4") == scene_pd4.read_bytes()
    assert fetch(f"{base}/index.html").decode() == whole_page()
    for header in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}, {**SOCKET, "Origin": "null"}):
        with pytest.raises(urllib.error.HTTPError, match="421"):
            urllib.request.urlopen(urllib.request.Request(f"{base}/scene.pd4", headers=header), timeout=60)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


def test_a_folder_is_listed_and_its_scenes_are_switched(scene_pd4, tmp_path):
    names = ["a b&c.pd4", "second.pd4"]
    for name in names:
        (tmp_path / name).write_bytes(scene_pd4.read_bytes())
    (tmp_path / "notes.txt").write_text("no scene")
    process = run(tmp_path)
    page = process.stdout.readline().strip()
    text, base = fetch(page).decode(), page.rpartition("/")[0]
    links = re.findall(r'<a target="scene" href="([^"]+)"', text)
    assert links == ["index.html?src=a%20b%26c.pd4", "index.html?src=second.pd4"] and f'src="{links[0]}"' in text
    for link in links:
        assert fetch(f"{base}/{link.partition('=')[2]}") == scene_pd4.read_bytes()
    assert "a b&amp;c.pd4" in text and "notes" not in text
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


def test_segments_are_shown_as_one_scene(cli, tmp_path):
    process = run(segmented.folder())
    page = process.stdout.readline().strip()
    assert page.endswith("/index.html?src=segments.json")
    base = page.rsplit("/", 1)[0]
    for path in segmented.folder().iterdir():
        assert fetch(f"{base}/{path.name}") == path.read_bytes()
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    one = cli("view", segmented.folder(), "-o", tmp_path / "a.html")
    assert one.code == 2 and "see pd4dgs-package" in one.err


def test_the_sample_is_shown_and_described_without_a_file(cli, scene_pd4, tmp_path, monkeypatch):
    monkeypatch.setattr(pd4dgs_codec, "sample", lambda: scene_pd4)
    told = cli("info", "--sample", "--json")
    assert told.code == 0 and told.json["bytes"] == scene_pd4.stat().st_size and told.json["input"] == str(scene_pd4)
    assert cli("view", "--sample", "-o", tmp_path / "sample.html").code == 0
    assert (tmp_path / "sample.html").read_text() == whole_page(scene_pd4.read_bytes())


def fetch(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=60) as answer:
        data: bytes = answer.read()
        return data


def test_a_checkpoint_may_come_through_stdin(model_pt):
    with open(model_pt, "rb") as stdin:
        process = run("-", stdin=stdin)
        page = process.stdout.readline().strip()
        assert decode(fetch(page.replace("index.html?src=", ""))).layers[0] == 0
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=60)[1] == "stdin: encoding the checkpoint\n" and process.returncode == 0


def test_one_html_file_instead_of_a_server(cli, scene_pd4, tmp_path):
    output = tmp_path / "scene.html"
    assert cli("view", scene_pd4, "-o", output).code == 0
    assert output.read_text() == show(scene_pd4).page
