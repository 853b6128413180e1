"""`synthetic:static|global|local|fast[?seed=n&size=WxH&frames=N]`: dynamic scenes ray-cast on reading, with exact
covisibility masks.

One camera moves to and fro along an arc (60 training frames); two fixed cameras that it never meets give the test
views. The four scenes share their objects; only the motion differs. Another size shows as much from top to bottom, and
more frames show the same motion more often. What is made depends on the source string alone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from pd4dgs_codec.data.cameras import Lens, world_to_camera
from pd4dgs_codec.data.files import check_downscale, shrink_image, shrink_mask
from pd4dgs_codec.data.options import split_options
from pd4dgs_codec.data.raycast import NO_BODY, Body, Eye, material, normal, place, shade
from pd4dgs_codec.data.scenes import MOTIONS, SceneBuilder
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError

PREFIX = "synthetic:"
LENS = Lens(160, 120, 150.0, 150.0, 81.5, 58.75)  #: off centre on purpose: readers must honour cx, cy
SUPERSAMPLING = 2
SECONDS = 59 / 12
#: Instants at which each fixed camera looks, if there are frames enough.
TEST_INSTANTS = 15
#: What a source may ask for.
SIZES, FRAMES = range(8, 8193), range(3, 10_001)
EXAMPLES = {"seed": "seed=1", "size": "size=960x540", "frames": "frames=300"}
#: The camera goes back and forth over its arc so many times, as a hand does: were it to pass each place once, place
#: and instant would be one, and a static scene whose look depends on the view would explain every motion.
SWEEPS = 2.5
SKY = np.array([0.71, 0.80, 0.90])
TARGET = np.array([0.0, 0.1, 0.5])
BOX = np.array([[-2.7, -2.7, -0.1], [2.7, 2.5, 2.6]], np.float32)
NEAR, FAR = 0.5, 12.0
POINTS = 5000
COVISIBLE_SHARE = 0.05  #: a test pixel counts if this share of the training frames saw its surface point


@dataclass(frozen=True)
class Take:
    """What is made of a scene. size: (width, height) of its pictures; frames: of the moving camera."""

    name: str
    seed: int = 0
    size: tuple[int, int] = (LENS.width, LENS.height)
    frames: int = 60

    @property
    def lens(self) -> Lens:
        """`LENS`, for pictures of this size."""
        (width, height), scale = self.size, self.size[1] / LENS.height
        return Lens(width, height, LENS.fx * scale, LENS.fy * scale, LENS.cx * width / LENS.width, LENS.cy * scale)

    @property
    def test_instants(self) -> range:
        """The frames in whose instants the fixed cameras look."""
        return range(2, self.frames, max(1, self.frames // TEST_INSTANTS))


def parse(source: str) -> Take:
    """What a `synthetic:` source asks for. Raises DataError."""
    name, options = split_options(source.removeprefix(PREFIX), source, _value, EXAMPLES)
    if name not in MOTIONS:
        expected = f"{PREFIX}{'|'.join(MOTIONS)}[?seed=n&size=WxH&frames=N]"
        raise DataError(f"{source}: unknown synthetic scene, expected {expected}")
    return Take(name, **options)


def _value(key: str, text: str) -> Any:
    """The value of an option; ValueError for what is none."""
    if not re.fullmatch(r"\d{1,9}(x\d{1,9})?", text):
        raise ValueError(text)
    numbers = tuple(map(int, text.split("x")))
    if key == "size" and len(numbers) == 2 and all(v in SIZES for v in numbers):
        return numbers
    if key == "seed" and len(numbers) == 1 or key == "frames" and len(numbers) == 1 and numbers[0] in FRAMES:
        return numbers[0]
    raise ValueError(text)


def _look(azimuth: float, radius: float, height: float) -> np.ndarray:
    """float64 [4, 4] viewmat of a camera at the azimuth (0 = in front of the wall) that looks at TARGET."""
    center = TARGET + np.array([radius * np.sin(azimuth), -radius * np.cos(azimuth), height])
    z = (TARGET - center) / np.linalg.norm(TARGET - center)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    return world_to_camera(np.stack([x, np.cross(z, x), z]), center)


def _train_viewmat(t: float) -> np.ndarray:
    azimuth = 40 * np.sin(2 * np.pi * SWEEPS * t - np.pi / 2)
    return _look(np.radians(azimuth), 3.9 + 0.15 * np.cos(7 * t), 1.15 + 0.2 * np.sin(9 * t))


def fixed_viewmats() -> tuple[np.ndarray, np.ndarray]:
    """The two fixed cameras, inside the arc in azimuth but off it in height and distance."""
    return _look(np.radians(-19), 3.5, 0.75), _look(np.radians(23), 3.75, 1.75)


def _grid(lens: Lens, scale: int = 1, dtype: DTypeLike = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """x [scale * W] and y [scale * H] at depth 1 of the pixel centres of an image `scale` times as fine."""
    x = ((np.arange(lens.width * scale) + 0.5) / scale - lens.cx) / lens.fx
    return x.astype(dtype), (((np.arange(lens.height * scale) + 0.5) / scale - lens.cy) / lens.fy).astype(dtype)


def _render(bodies: list[Body], viewmat: np.ndarray, t: float, lens: Lens = LENS) -> np.ndarray:
    """uint8 [H, W, 3]: the mean of SUPERSAMPLING² rays per pixel."""
    placed = place(bodies, t)
    eye = Eye(placed, viewmat)
    xs, ys = _grid(lens, SUPERSAMPLING, np.float32)
    depth, index = eye.first_hits(xs, ys)
    color = np.tile(SKY.astype(np.float32)[:, None, None], (1, *depth.shape))
    for i in range(len(placed)):
        row, col = np.nonzero(index == i)
        if len(row):
            color[:, row, col] = shade(placed, i, eye.world(xs[col], ys[row], depth[row, col]), t)
    s = SUPERSAMPLING
    mean = color.reshape(3, lens.height, s, lens.width, s).mean(axis=(2, 4))
    return np.asarray(mean.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class _Surface:
    """What the pixel centres of a view see: body index [n], material point [3, n], for the sky the direction [3, n]."""

    body: np.ndarray
    point: np.ndarray


def _surface(bodies: list[Body], viewmat: np.ndarray, t: float, lens: Lens = LENS) -> _Surface:
    placed = place(bodies, t)
    eye = Eye(placed, viewmat)
    xs, ys = _grid(lens)
    depth, index = (a.ravel() for a in eye.first_hits(xs, ys))
    x, y = (a.ravel() for a in np.meshgrid(xs, ys))
    point = viewmat[:3, :3].T @ np.stack([x, y, np.ones_like(x)])
    for i, body in enumerate(placed):
        mine = index == i
        point[:, mine] = material(body, eye.world(x[mine], y[mine], depth[mine]))
    return _Surface(index, point)


def _seen(eye: Eye, body: np.ndarray, point: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    """bool [n]: the points (see _Surface), at the instant of `eye`, are in its picture, face it and are not hidden."""
    rotation = eye.viewmat[:3, :3]
    camera, facing = rotation @ point, np.ones(len(body), bool)
    for i, placed in enumerate(eye.placed):
        mine = np.flatnonzero(body == i)
        if len(mine):
            camera[:, mine] = rotation @ (placed.A @ point[:, mine] + (placed.c - eye.center)[:, None])
            origin = placed.inverse @ (eye.center - placed.c)
            n = normal(placed.body.shape, point[:, mine])
            facing[mine] = (n * (origin[:, None] - point[:, mine])).sum(axis=0) > 0
    z = camera[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = camera[0] / z, camera[1] / z
    u, v = lens.fx * x + lens.cx, lens.fy * y + lens.cy
    seen = np.asarray(facing & (z > 0) & (u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height))
    some = np.flatnonzero(seen)
    depth = np.where(body[some] == NO_BODY, np.inf, z[some])
    seen[some] = ~eye.hidden(x[some], y[some], depth, body[some])
    return seen


def _covisible(bodies: list[Body], eyes: list[Eye], viewmat: np.ndarray, t: float, lens: Lens) -> np.ndarray:
    """bool [H, W]: what a pixel's centre sees was seen by COVISIBLE_SHARE of the training cameras `eyes`."""
    surface, needed = _surface(bodies, viewmat, t, lens), max(1, int(np.ceil(COVISIBLE_SHARE * len(eyes))))
    count = np.zeros(len(surface.body), np.int32)
    # Strided order: most points are settled after a few distant frames and drop out.
    order = [i for start in range(8) for i in range(start, len(eyes), 8)]
    for i in order:
        open_ = np.flatnonzero(count < needed)
        if not len(open_):
            break
        count[open_] += _seen(eyes[i], surface.body[open_], surface.point[:, open_], lens)
    return (count >= needed).reshape(lens.height, lens.width)


def _initial_points(
    bodies: list[Body], viewmats: list[np.ndarray], lens: Lens, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """What structure from motion would give of the first instant: visible surface points, noisy, 2 % of them stray."""
    placed = place(bodies, 0.0)
    per_view = -(-POINTS // len(viewmats)) * 5 // 4  # some rays meet only the sky
    points, colors = [], []
    for viewmat in viewmats:
        eye = Eye(placed, viewmat)
        xs, ys = _grid(lens)
        depth, index = eye.first_hits(xs, ys)
        row, col = rng.integers(len(ys), size=per_view), rng.integers(len(xs), size=per_view)
        for i in range(len(placed)):
            mine = index[row, col] == i
            r, c = row[mine], col[mine]
            world = eye.world(xs[c], ys[r], depth[r, c])
            colors.append(shade(placed, i, world, 0.0).T)
            points.append(world.T + rng.normal(size=(len(r), 3)) * 0.004 * depth[r, c][:, None])
    chosen = rng.permutation(sum(map(len, points)))[:POINTS]
    xyz, rgb = np.concatenate(points)[chosen], np.concatenate(colors)[chosen]
    stray = rng.uniform(size=len(xyz)) < 0.02
    xyz[stray] = rng.uniform(BOX[0], BOX[1], (int(stray.sum()), 3))
    return xyz.astype(np.float32), (rgb * 255 + 0.5).astype(np.uint8)


@lru_cache(maxsize=4)
def _dataset(take: Take) -> Dataset:
    bodies, lens = SceneBuilder(take.name, take.seed).bodies(), take.lens
    times = [i / (take.frames - 1) for i in range(take.frames)]
    viewmats = [_train_viewmat(t) for t in times]
    eyes = [Eye(place(bodies, t), v) for t, v in zip(times, viewmats, strict=True)]

    def view(viewmat: np.ndarray, camera: int, i: int) -> View:
        image = _render(bodies, viewmat, times[i], lens)
        mask = _covisible(bodies, eyes, viewmat, times[i], lens) if camera else None
        matrices, name = (viewmat.astype(np.float32), lens.matrix()), f"{camera}_{i:05d}"
        return View(*matrices, lens.width, lens.height, times[i], image, mask, name, camera)

    train = tuple(view(v, 0, i) for i, v in enumerate(viewmats))
    fixed = enumerate(fixed_viewmats(), start=1)
    test = tuple(view(v, camera, i) for camera, v in fixed for i in take.test_instants)
    points, colors = _initial_points(bodies, viewmats, lens, np.random.default_rng([take.seed, 1]))
    sky, up = (float(SKY[0]), float(SKY[1]), float(SKY[2])), (0.0, 0.0, 1.0)
    name, span = f"synthetic-{take.name}", (0.0, SECONDS)
    return Dataset(name, train, test, points, colors, BOX, NEAR, FAR, sky, span, up, 0.0, True)


def _shrink(view: View, k: int, lens: Lens = LENS) -> View:
    image = shrink_image(view.image, k)
    mask = None if view.mask is None else shrink_mask(view.mask, k)
    return replace(view, K=lens.matrix(k), width=image.shape[1], height=image.shape[0], image=image, mask=mask)


def read_synthetic(source: str, downscale: int = 1) -> Dataset:
    """The scene named by `source`; rendered once per process and kept in memory."""
    take = parse(source)
    check_downscale(take.size, downscale, source)
    full = _dataset(take)
    if downscale == 1:
        return full
    train, test = (tuple(_shrink(v, downscale, take.lens) for v in views) for views in (full.train, full.test))
    return replace(full, train=train, test=test)
