"""What costs milliseconds to train, pack and draw: a preset, pictures, scenes before a camera, checkpoints, a trap."""

import json
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from strategies import make_scene

from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
from pd4dgs_codec.scene import Camera, Deformation, Network, Scene, SceneInfo, Steps, Widths, plane_shapes

#: The preset `tiny` with few anchors and cells; 8 channels, like all presets, for the compiled kernels.
TINY = ModelConfig(*[DeformationConfig(((4, 4),), 8, 8)] * 2, hidden=8, initial_anchors=300, max_anchors=600)
WIDTH, HEIGHT = 32, 24
#: Held-out quality that `checkpoint_of` tells of.
CURVE = [
    {"iteration": 1, "seconds": 2.0, "psnr": [10.0, 20.0]},
    {"iteration": 2, "seconds": 4.0, "psnr": [12.0, 40.0]},
]


def camera_ahead(distance: float = 3.0, focal: float = 30.0, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """A camera that looks at the origin along z from `distance` away."""
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = distance
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return Camera(viewmat, K, width, height)


def camera_around(rng: np.random.Generator) -> Camera:
    """48 x 36 pixels, from anywhere 8 away from the origin."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    camera = camera_ahead(8.0, 40.0, 48, 36)
    camera.viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    return camera


# -- datasets ----------------------------------------------------------------------------------------------------------


def view(t: float, camera_id: int = 0) -> View:
    """A bright disc that moves to the right over a grey ground; the camera sways a little."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image[(x - 8 - 16 * t) ** 2 + (y - 12) ** 2 < 16] = (230, 60, 40)
    camera = camera_ahead()
    camera.viewmat[0, 3] = 0.1 * math.sin(6 * t)
    return View(camera.viewmat, camera.K, WIDTH, HEIGHT, t, image, None, f"{t:.2f}", camera_id)


def disc(held_out: tuple[float, ...] = (0.5,)) -> Dataset:
    """Six training views of the disc and those held out."""
    return Dataset(
        name="disc", train=tuple(view(t) for t in np.linspace(0, 1, 6)), test=tuple(view(t) for t in held_out),
        points=None, box=np.array([[-1.5, -1.2, -1], [1.5, 1.2, 1]], np.float32), near=0.1,
        far=10.0, background=(0.0, 0.0, 0.0), time_range=(0.0, 1.0), up=(0.0, -1.0, 0.0), masked=False,
    )  # fmt: skip


def write_views(folder: Path) -> Path:
    """A Blender-style folder of six noisy pictures from cameras on a short line, looking at the origin."""
    from PIL import Image

    rng = np.random.default_rng(3)
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(6):
        picture = rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
        Image.fromarray(picture).save(folder / f"{i:03d}.png")
        pose = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
        frames.append({"file_path": f"{i:03d}.png", "time": i / 5, "transform_matrix": pose})
    content = {"fl_x": 30.0, "fl_y": 30.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1))
    return folder


# -- scenes ------------------------------------------------------------------------------------------------------------


def filmed_scene() -> Scene:
    """40 anchors in front of a camera, three layers, all values multiples of their steps."""
    made = make_scene(8, anchors=40)
    return replace(made, info=replace(made.info, camera=camera_ahead(2.0)))


def trained_like_scene() -> Scene:
    """60 anchors (40, 50 and 60 by level) before the camera of `write_views`, with values between their steps."""
    rng = np.random.default_rng(5)
    n, rows = 60, (40, 50, 60)
    cells = np.unique(rng.integers(-20, 20, (200, 3)), axis=0)
    box = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    voxel, near = (float(np.float32(v)) for v in (0.05, 0.1))
    return Scene(
        info=SceneInfo(voxel, box, (0.0, 2.0), (1.0, 1.0, 1.0), near, 10.0, (0.0, -1.0, 0.0), 0.0, camera_ahead()),
        steps=Steps().scaled(1.0),
        layers=(0, 1, 2),
        rows=rows,
        anchor_q=rng.permutation(cells)[:n].astype(np.int32),
        feature=rng.normal(0, 0.5, (n, 32)).astype(np.float32),
        scaling_log=rng.normal(-2.5, 0.3, (n, 6)).astype(np.float32),
        offset=rng.normal(0, 0.5, (n, 10, 3)).astype(np.float32),
        mask=tuple(np.full(r, 200, np.uint8) for r in rows),
        networks={name: random_network(rng, 35, 16, width) for name, width in Widths().networks.items()},
        global_deformation=random_deformation(rng, Widths().heads, key=40_000),
        local_deformation=random_deformation(rng, Widths().heads, below=4),
    )


def sighted(scene: Scene, *viewing: str) -> Scene:
    """The scene without the weights for the view direction in networks other than `viewing`."""
    networks = {
        name: network if name in viewing else ((network[0][0][:, : scene.widths.feature], network[0][1]), *network[1:])
        for name, network in scene.networks.items()
    }
    return replace(scene, networks=networks)


def random_network(rng: np.random.Generator, *widths: int, scale: float = 0.3) -> Network:
    pairs = zip(widths, widths[1:], strict=False)
    return tuple(
        (rng.normal(0, scale, (b, a)).astype(np.float32), rng.normal(0, scale, b).astype(np.float32)) for a, b in pairs
    )


def random_deformation(
    rng: np.random.Generator,
    heads: dict[str, int],
    resolutions: Sequence[tuple[int, ...]] = ((3, 4, 5, 6),) * 2,
    *,
    channels: int = 2,
    spread: float = 0.3,
    trunk: tuple[int, ...] = (8, 8),
    key: int | None = None,
    below: int = 0,
) -> Deformation:
    """Planes of values around 1, and heads that move little. below: features of the planes of the layer below."""
    planes = tuple(
        {name: rng.normal(1, spread, s).astype(np.float32) for name, s in plane_shapes(channels, sides).items()}
        for sides in resolutions
    )
    networks = {"trunk": random_network(rng, below + channels * len(resolutions), *trunk)}
    networks |= {name: random_network(rng, trunk[-1], width, scale=0.05) for name, width in heads.items()}
    return Deformation(planes, networks, key)


def checkpoint_of(scene: Scene, path: Path) -> Path:
    """Writes a checkpoint of the preset tiny that was evaluated twice."""
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.model import from_scene

    checkpoint.save(path, from_scene(scene), {"curve": json.dumps(CURVE), "config": json.dumps({"preset": "tiny"})})
    return path


class Trap:
    """Pickles as a call that creates a folder."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.target),)
