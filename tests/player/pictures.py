"""Pictures of the player in the browser tests' page, beside those of the package's rasteriser."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from browser import call, pixels

from pd4dgs_codec import decode
from pd4dgs_codec.draw.player import Drawer, Player, drawer
from pd4dgs_codec.kinds.splats import SplatScene
from pd4dgs_codec.quality.frames import turned
from pd4dgs_codec.scene import Camera, Gaussians, LayeredScene, Scene


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    """PSNR of pictures in 0..1."""
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12))


class Rasterised(Player):
    """The package's pictures of all anchors: clause 13.4 has no frustum, but `Player` omits anchors by their position
    before the deformation."""

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        """Without a test of the frustum."""
        return self.gaussians_of_eyes(self.active, t, camera.eye[None])


def rasterised(scene: Scene | SplatScene) -> Drawer:
    """The package's pictures of all anchors of a scene of any kind."""
    return Rasterised(scene) if isinstance(scene, Scene) else drawer(scene)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The same view in a picture of another size."""
    K = camera.K * np.array([[width / camera.width], [height / camera.height], [1]], np.float32)
    return replace(camera, width=width, height=height, K=K)


def cameras(scene: LayeredScene, turns: Sequence[tuple[float, float]]) -> Iterator[Camera]:
    """The scene's own camera, then for each (angle, nearer) that camera turned about the middle of the anchors by
    `angle`, around its vertical, and brought nearer by the share `nearer`."""
    own, middle = scene.info.camera, np.median(scene.anchor, axis=0)
    yield own
    for angle, nearer in turns:
        camera = turned(own, middle, own.viewmat[1, :3], angle)
        way = camera.viewmat[:3, :3] @ middle + camera.viewmat[:3, 3]  # from the camera to the middle, in its axes
        camera.viewmat[:3, 3] -= nearer * way
        yield camera


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture of the player and that of the rasteriser, float [H, W, 3]. camera: its number. t: normalised time."""

    level: int
    t: float
    camera: int
    player: np.ndarray
    expected: np.ndarray


def shots(
    page: Any, data: bytes, views: Sequence[tuple[Camera, Sequence[float]]], levels: Sequence[int] | None = None
) -> Iterator[Shot]:
    """Pictures of the file `data`, which the harness has open: each level at the times of cameras of one size."""
    scenes = [decode(data, max_layer=level) for level in levels or decode(data).layers]
    players = [rasterised(scene) for scene in scenes]
    low, high = scenes[0].info.time_range
    for number, (camera, times) in enumerate(views):
        for t in times:
            for scene, player in zip(scenes, players, strict=True):
                got = shoot(page, camera, scene.level, low + t * (high - low))
                yield Shot(scene.level, t, number, got, player.picture(camera, t))


def shoot(page: Any, camera: Camera, level: int, seconds: float) -> np.ndarray:
    """The player's settled picture, float [H, W, 3]."""
    state: dict[str, Any] = dict(level=level, seconds=seconds, width=camera.width, height=camera.height)
    state |= dict(viewmat=camera.viewmat.ravel().tolist(), K=camera.K.ravel().tolist())
    return pixels(call(page, "harness.shoot", state), camera.width, camera.height) / 255
