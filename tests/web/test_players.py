"""Packages in the DASH and HLS players that people use: dash.js, Shaka Player and hls.js, in Chromium.

They come with `cd player && npm install --no-package-lock`.
"""

import shutil
from typing import Any

import numpy as np
import pytest
from browser import PLAYER, TIMEOUT_MS

from pd4dgs_codec.errors import DataError, RenderError
from pd4dgs_codec.quality.frames import check_mp4, write_mp4
from pd4dgs_codec.web.manifests import Video
from pd4dgs_codec.web.package import package
from pd4dgs_codec.web.server import Server

FPS, SIZE = 10.0, 64
#: The script of each player in node_modules, and what plays the package on the element `video` of its page.
PLAYERS = {
    "dash.js": (
        "dashjs/dist/modern/umd/dash.all.min.js",
        "dashjs.MediaPlayer().create().initialize(v, 'scene.mpd', true)",
    ),
    "Shaka Player": (
        "shaka-player/dist/shaka-player.compiled.js",
        "const p = new shaka.Player(); await p.attach(v); await p.load('scene.mpd'); await v.play()",
    ),
    "hls.js": (
        "hls.js/dist/hls.min.js",
        "const p = new Hls(); p.loadSource('scene.m3u8'); p.attachMedia(v); await v.play()",
    ),
}


@pytest.fixture(scope="module")
def packaged(scene_bytes, missing, tmp_path_factory) -> Server:
    """A package with a video, in which the picture gets brighter."""
    folder = tmp_path_factory.mktemp("package")
    try:
        check_mp4()
    except (RenderError, DataError) as error:
        missing(error)
    pictures = (np.full((SIZE, SIZE, 3), 50 + 5 * i, np.uint8) for i in range(30))
    write_mp4(pictures, folder / "video.mp4", FPS, fragment=10)
    video = Video((folder / "video.mp4").read_bytes(), SIZE, SIZE, FPS)
    for name, content in package(scene_bytes, lambda scene, share: video).items():
        (folder / name).write_bytes(content)
    with Server(folder) as server, server.running():
        yield server


@pytest.fixture(scope="module")
def context(browser: Any) -> Any:
    opened = browser.new_context()
    opened.set_default_timeout(TIMEOUT_MS)
    return opened


@pytest.mark.parametrize("name", PLAYERS)
def test_players_without_a_decoder_play_the_video(context, packaged, name):
    """Shaka Player once ended in a TypeError, as the manifest's dependencyId named a part of another set."""
    script, play = PLAYERS[name]
    if not (PLAYER / "node_modules" / script).is_file():
        pytest.skip(f"{name} is not installed (npm install --no-package-lock in player/)")
    shutil.copy(PLAYER / "node_modules" / script, packaged.root / "player.js")
    text = f"window.played = (async () => {{ const v = document.querySelector('video'); {play}; }})()"
    body = f"<!doctype html><title>t</title><video muted></video><script src=player.js></script><script>{text}</script>"
    (packaged.root / "page.html").write_text(body)
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(packaged.url_of("page.html"))
    page.evaluate("window.played")
    page.wait_for_function("document.querySelector('video').currentTime > 1")
    assert page.evaluate("document.querySelector('video').videoWidth") == SIZE and not errors
    page.close()
