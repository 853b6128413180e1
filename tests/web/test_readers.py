"""Packages as other people's readers see them: pymp4, and mp4box.js, dash.js and hls.js in Node.

The latter are looked for in the folder that PD4DGS_NODE_MODULES names, after
`npm install mp4box@2.4.1 dashjs@5.2.1 hls.js@1.7.4 jsdom@29.1.1` there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from test_package import fake_video

from pd4dgs_codec.web import mp4
from pd4dgs_codec.web.package import package
from pd4dgs_codec.web.server import Server

SCRIPT = Path(__file__).with_name("readers.mjs")
MODULES = Path(os.environ.get("PD4DGS_NODE_MODULES", "node_modules")).absolute()
NODE = shutil.which("node")


def test_pymp4_finds_the_layers(scene_bytes):
    parser, construct = pytest.importorskip("pymp4.parser"), pytest.importorskip("construct")
    boxes = construct.GreedyRange(parser.Box).parse(package(scene_bytes)["scene.mp4"])
    assert [box.type for box in boxes] == [b"ftyp", b"moov", *[b"moof", b"mdat"] * 3]
    assert b"".join(box.data for box in boxes if box.type == b"mdat") == scene_bytes
    tracks = [box for box in boxes[1].children if box.type == b"trak"]
    (media,) = (box for box in tracks[0].children if box.type == b"mdia")
    assert [box.handler_type for box in media.children if box.type == b"hdlr"] == [b"meta"] and len(tracks) == 3


@pytest.mark.skipif(NODE is None, reason="no node on this machine")
@pytest.mark.skipif(not (MODULES / "dashjs").is_dir(), reason=f"no dashjs in {MODULES} (PD4DGS_NODE_MODULES)")
@pytest.mark.parametrize("video", [False, True], ids=["layers only", "with video"])
def test_javascript_players_parse_the_manifests_and_the_payload_comes_back(tmp_path, scene_bytes, video):
    files = package(scene_bytes, (lambda scene: fake_video()) if video else None)
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with Server(tmp_path) as server, server.running():
        command = [str(NODE), str(SCRIPT), str(MODULES), server.url]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    digest = hashlib.sha256(scene_bytes).hexdigest()
    for reader in ("mp4box", "dash"):  # the latter: what dash.js says where the layers are, fetched from there
        assert found[reader]["tracks"] == [1, 2, 3] and found[reader]["sha256"] == digest
    layers = {layer["id"]: layer["dependencyId"] for layer in found["dash"]["layers"]}
    assert layers == {"L0": None, "L1": "L0", "L2": "L0 L1"} and found["dash"]["sets"] == 3 + video
    assert found["hls"]["sessionData"]["org.pd4dgs.layers"]["URI"] == "index.json"
    if video:
        _, pieces = mp4.fragments(files["fallback.mp4"])
        assert found["hls"]["fragments"] == [list(piece[:2]) for piece in pieces]
        assert found["hls"]["levels"] == [server.url_of("fallback.m3u8")]
