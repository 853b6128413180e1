"""Pictures of a scene in each viewer that plays it, at one time and through the scene's own camera, at most 60 kB each:
player.jpg, spark.jpg, playcanvas.jpg, supersplat.jpg, headset.jpg.

    (cd player && npm install --no-package-lock)    # once: three.js, Spark, PlayCanvas, SuperSplat's viewer
    python benchmarks/viewers.py scene.pd4 -o docs/img
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import browser
import numpy as np
from common import ROOT, command, save_jpeg
from refining_gif import widened

from pd4dgs_codec import decode
from pd4dgs_codec.io import whole_files
from pd4dgs_codec.quality.frames import look_at_point, own_frames
from pd4dgs_codec.scene import Camera, Scene
from pd4dgs_codec.web.server import Server

#: Pixels across a picture, and bytes of a JPEG at most.
WIDTH, LIMIT = 480, 60_000
#: Of player/test-browser/headset.js. The horizon is level, so that what a camera saw that looked down is low.
HEADSET = """Object.assign(headset.size, { width: 312, height: 264 });
  Object.assign(headset.pose, { turn: 0, place: [0, 0, 0] });
  Object.assign(headset.eyes, { left: [-0.03, -0.7, 0.6, -0.7, 0.4], right: [0.03, -0.6, 0.7, -0.7, 0.4] });"""


def draw(data: bytes, folder: Path) -> None:
    """Writes the pictures of the file `data` at the middle of its time. Raises DataError without a browser or a
    package, and Pd4Error for a file that is not valid or has no camera."""
    from PIL import Image

    browser.check_packages(*browser.VIEWERS)
    scene = decode(data)
    camera = widened(own_frames(scene.info, 1)[0].camera, WIDTH)
    at = sum(scene.info.time_range) / 2
    with tempfile.TemporaryDirectory() as name, Server(ROOT) as code, Server(name) as files:
        (Path(name) / "scene.pd4").write_bytes(data)
        command("export", Path(name) / "scene.pd4", "-o", Path(name) / "still.ply", "--to", "ply")
        with browser.launched() as opened, code.running(), files.running():
            page = opened.new_page(viewport={"width": camera.width, "height": camera.height})
            page.set_default_timeout(browser.TIMEOUT_MS)
            pictures = dict(taken(page, f"{code.url}player/", files.url, scene, camera, at))
    with whole_files([f"{folder / name}.jpg" for name in pictures], overwrite=True) as paths:
        for picture, path in zip(pictures.values(), paths, strict=True):
            save_jpeg(Image.fromarray(picture), path, LIMIT)


def taken(page: Any, at: str, files: str, scene: Scene, camera: Camera, time: float) -> Iterator[Any]:
    """(name, uint8 [H, W, 3]) of each viewer. at: address of player/. files: that of scene.pd4 and still.ply."""
    source, size = f"{files}scene.pd4", (camera.width, camera.height)
    element = f"{at}index.html?{urlencode({'src': source, 'time': time, 'autoplay': 0})}"
    page.goto(element)
    browser.wait_for_level(page, scene.level)
    page.evaluate(f"{browser.ELEMENT}.player.settled()")
    page.locator("[part=status]", has_text=f"level {scene.level}").wait_for()
    yield "player", browser.screenshot(page)
    state = {"level": scene.level, "seconds": time, "width": camera.width, "height": camera.height}
    state |= {"viewmat": camera.viewmat.ravel().tolist(), "K": camera.K.ravel().tolist()}
    look = supersplat(scene, camera) | {"still": f"{files}still.ply"}
    for name in browser.VIEWERS:
        page.goto(f"{at}test-browser/harness.html?{name}")
        page.wait_for_function("!!window.harness")
        browser.call(page, "harness.open", source, *size, look)
        browser.call(page, "harness.show" if name == "supersplat" else "harness.shoot", state)
        if name == "supersplat":
            page.mouse.move(9, 9)  # the controls appear, and stay while the pointer is over them
            page.locator(".sse-controlsWrap").hover()
        yield name, browser.screenshot(page)
    page.add_init_script((browser.PLAYER / "test-browser" / "headset.js").read_text() + HEADSET)
    page.goto(element)
    browser.wait_for_level(page, scene.level)
    yield "headset", browser.eyes_of_headset(page, 2 * 312, 264)


def supersplat(scene: Scene, camera: Camera) -> dict[str, Any]:
    """The options of its viewer, where y points up: the scene is turned about x."""
    angle = -math.atan2(scene.info.up[2], scene.info.up[1])
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    places = {"position": -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3], "target": look_at_point(scene.info)}
    look = {name: (turn @ place).tolist() for name, place in places.items()} | {"background": scene.info.background}
    fov = math.degrees(2 * math.atan(camera.width / 2 / camera.K[0, 0]))
    return look | {"angles": (math.degrees(angle), 0, 0), "fov": fov, "ui": True}


def main() -> None:
    """The pictures of the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .pd4 file with a camera of its own")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the pictures")
    args = parser.parse_args()
    draw(args.file.read_bytes(), args.output)


if __name__ == "__main__":
    main()
