"""The nginx configuration that `pd4dgs-serve --help` gives, run by a real nginx where there is one."""

from __future__ import annotations

import http.client
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest
from strategies import assert_same_scene

from pd4dgs_codec import decode
from pd4dgs_codec.cli.serve import DETAILS
from pd4dgs_codec.delivery.client import Budget, SceneClient

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")

pytestmark = pytest.mark.skipif(NGINX is None, reason="no nginx on this machine")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def port(folder, tmp_path):
    number = _free_port()
    block = DETAILS[DETAILS.index("  server {") : DETAILS.index("Caddy")]
    for given, here in (("listen 80", f"listen 127.0.0.1:{number}"), ("/srv/scenes", str(folder))):
        assert given in block
        block = block.replace(given, here)
    shutil.copy(Path(str(NGINX)).resolve().parents[2] / "etc/nginx/mime.types", tmp_path / "mime.types")
    (tmp_path / "tmp").mkdir()
    temporary = "".join(
        f"{kind}_temp_path {tmp_path}/tmp/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (tmp_path / "nginx.conf").write_text(
        f"daemon off; master_process off; pid {tmp_path}/pid; error_log stderr;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{temporary}{block}}}\n"
    )
    command = [str(NGINX), "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf"), "-e", "stderr"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        for _ in range(200):
            try:
                socket.create_connection(("127.0.0.1", number), timeout=1).close()
                break
            except OSError:
                assert process.poll() is None, process.communicate()[1]
                time.sleep(0.02)
        yield number
    finally:
        process.terminate()
        process.communicate(timeout=10)


def ask(port: int, method: str = "GET", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request(method, "/scene.pd4", headers={k.replace("_", "-"): v for k, v in headers.items()})
    return connection.getresponse()


def test_a_page_of_another_site_may_fetch_and_resume(port, scene_bytes):
    whole = ask(port)
    assert whole.read() == scene_bytes and whole.headers["Content-Type"] == "application/octet-stream"
    assert whole.headers["Access-Control-Allow-Origin"] == "*"
    part = ask(port, Range="bytes=5-9", If_Range=whole.headers["ETag"])
    assert part.status == 206 and part.read() == scene_bytes[5:10]
    assert "Content-Range" in part.headers["Access-Control-Expose-Headers"]
    preflight = ask(port, "OPTIONS", Access_Control_Request_Method="GET", Origin="http://example.org")
    assert preflight.status == 204 and "If-Range" in preflight.headers["Access-Control-Allow-Headers"]


def test_the_client_streams_upgrades_and_sees_a_change(port, folder, scene_bytes, other_bytes):
    with SceneClient(f"http://127.0.0.1:{port}/scene.pd4") as client:
        (base,) = client.scenes(Budget(max_layer=0))
        assert_same_scene(base, decode(scene_bytes, max_layer=0))
        assert_same_scene(list(client.scenes())[-1], decode(scene_bytes))
        assert client.transfer.changes == 0
    with SceneClient(f"http://127.0.0.1:{port}/scene.pd4") as client:
        list(client.scenes(Budget(max_layer=0)))
        (folder / "new").write_bytes(other_bytes)
        (folder / "new").replace(folder / "scene.pd4")
        assert [scene.layers for scene in client.scenes()] == [(0,), (0, 1), (0, 1, 2)]
        assert client.transfer.changes == 1
