"""The configurations in docs/player-and-delivery.md, run by a real nginx and a real Caddy where there are any."""

import os
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from faulty import ask
from strategies import assert_same_scene, make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.web.client import SceneClient

PAGE = Path(__file__).parents[2] / "docs/player-and-delivery.md"
PROGRAMS = {name: shutil.which(name) or shutil.which(name, path="/usr/sbin") for name in ("nginx", "caddy")}


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _configuration(language: str, changes: dict[str, str]) -> str:
    """The code block of this language in the page, with an address and a folder of this test."""
    (block,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for given, here in changes.items():
        assert given in block
        block = block.replace(given, here)
    return block


def _nginx(program: str, number: int, folder: Path, tmp_path: Path) -> list[str]:
    changes = {"listen 80": f"listen 127.0.0.1:{number}", "/srv/scenes": str(folder)}
    block = _configuration("nginx", changes)
    shutil.copy(Path(program).resolve().parents[2] / "etc/nginx/mime.types", tmp_path / "mime.types")
    (tmp_path / "tmp").mkdir()
    temporary = "".join(
        f"{kind}_temp_path {tmp_path}/tmp/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (tmp_path / "nginx.conf").write_text(
        f"daemon off; master_process off; pid {tmp_path}/pid; error_log stderr;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{temporary}{block}}}\n"
    )
    return [program, "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf"), "-e", "stderr"]


def _caddy(program: str, number: int, folder: Path, tmp_path: Path) -> list[str]:
    block = _configuration("caddy", {":80": f"http://127.0.0.1:{number}", "/srv/scenes": str(folder)})
    (tmp_path / "Caddyfile").write_text(f"{{\n  admin off\n}}\n{block}")
    return [program, "run", "--config", str(tmp_path / "Caddyfile"), "--adapter", "caddyfile"]


@pytest.fixture(params=["nginx", "caddy"])
def server(request, folder, tmp_path):
    """The address of one that runs."""
    program = PROGRAMS[request.param]
    if program is None:
        pytest.skip(f"no {request.param} on this machine")
    number = _free_port()
    command = {"nginx": _nginx, "caddy": _caddy}[request.param](program, number, folder, tmp_path)
    environment = {**os.environ, "XDG_DATA_HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        for _ in range(200):
            try:
                socket.create_connection(("127.0.0.1", number), timeout=1).close()
                break
            except OSError:
                assert process.poll() is None, process.communicate()[1]
                time.sleep(0.05)
        yield SimpleNamespace(server_address=("127.0.0.1", number))
    finally:
        process.terminate()
        process.communicate(timeout=10)


def test_a_page_of_another_site_may_fetch_and_resume(server, folder, scene_bytes):
    (folder / "scene.mpd").write_text("<MPD/>")
    assert ask(server, "/scene.mpd").headers["Content-Type"] == "application/dash+xml"
    whole = ask(server, "/scene.pd4")
    assert whole.body == scene_bytes and whole.headers["Content-Type"] == "model/vnd.pd4dgs"
    assert whole.headers["Access-Control-Allow-Origin"] == "*"
    assert whole.headers["Cache-Control"] == "no-cache"
    (folder / "scene-0123456789abcdef.pd4").write_bytes(scene_bytes)
    assert "immutable" in ask(server, "/scene-0123456789abcdef.pd4", "HEAD").headers["Cache-Control"]
    part = ask(server, "/scene.pd4", Range="bytes=5-9", If_Range=whole.headers["ETag"])
    assert part.status == 206 and part.body == scene_bytes[5:10]
    assert "Content-Range" in part.headers["Access-Control-Expose-Headers"]
    site = "http://example.org"
    preflight = ask(server, "/scene.pd4", "OPTIONS", Access_Control_Request_Method="GET", Origin=site)
    assert preflight.status == 204 and "If-Range" in preflight.headers["Access-Control-Allow-Headers"]


def test_the_client_streams_upgrades_and_sees_a_change(server, folder, scene_bytes):
    url = "http://{}:{}/scene.pd4".format(*server.server_address)
    with SceneClient(url) as client:
        (base,) = client.scenes(max_layer=0)
        assert_same_scene(base, decode(scene_bytes, max_layer=0))
        assert_same_scene(list(client.scenes())[-1], decode(scene_bytes))
        assert client.transfer.changes == 0
    with SceneClient(url) as client:
        list(client.scenes(max_layer=0))
        other = make_scene(8, anchors=120, kind="gaussian", extent=20)
        (folder / "new").write_bytes(encode(other, layers=2, effort=1))  # of another length
        (folder / "new").replace(folder / "scene.pd4")
        assert [scene.layers for scene in client.scenes()] == [(0,), (0, 1), (0, 1, 2)]
        assert client.transfer.changes == 1
