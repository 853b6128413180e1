"""A viewer without a window: a picture of every level as its layer arrives. As a program it is the cold process.

    python -m pd4dgs_codec.bench.viewer URL WIDTH HEIGHT

draws with the file's own camera and prints one JSON line per picture, the moment it is there.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np

from pd4dgs_codec import threads
from pd4dgs_codec.draw.warm import warm_up
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.scene import Camera, SceneInfo
from pd4dgs_codec.web.client import SceneClient


@dataclass(frozen=True)
class Shown:
    """One picture. seconds: since the request. after_last_byte: seconds since its layer's last byte."""

    level: int
    seconds: float
    after_last_byte: float


def pictures(url: str, size: tuple[int, int], ready: Callable[[], object] = lambda: None) -> Iterator[Shown]:
    """Draws each level at normalised time 0 as soon as it is decoded. size: width, height in pixels. ready: called
    before the first is drawn. Raises what SceneClient.scenes raises, and DataError for a file without a camera."""
    start = time.monotonic()
    with SceneClient(url) as client:
        for scene in client.scenes():
            last_byte = client.arrived_at
            camera = own_camera(scene.info, size)
            ready()
            from pd4dgs_codec.quality.levels import level_of

            level_of(scene).picture(camera, 0.0)
            now = time.monotonic()
            yield Shown(scene.level, now - start, now - last_byte)


def own_camera(info: SceneInfo, size: tuple[int, int]) -> Camera:
    """The file's camera with a picture of another size, filled without bars: the longer side's view is cut."""
    if info.camera is None:
        raise DataError("the file holds no camera to draw its first picture with")
    width, height = size
    before = np.array([info.camera.width, info.camera.height])
    zoom = float(np.max(np.array(size) / before))
    K = info.camera.K.astype(np.float64)
    K[:2, :2] *= zoom
    K[:2, 2] = (K[:2, 2] - before / 2) * zoom + np.array(size) / 2
    return replace(info.camera, K=K.astype(np.float32), width=width, height=height)


def main(url: str, width: str, height: str) -> None:
    """Imports and kernels load in a thread while the bytes arrive."""
    threads.configure()
    threads.load_numba()
    warming = threading.Thread(target=warm_up)
    warming.start()
    for shown in pictures(url, (int(width), int(height)), ready=warming.join):
        print(json.dumps(asdict(shown)), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
