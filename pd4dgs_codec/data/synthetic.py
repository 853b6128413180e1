"""`synthetic:static|global|local|fast[?seed=n]`: dynamic scenes ray-cast on reading, with exact covisibility masks.

One camera moves to and fro along an arc (60 training frames); two fixed cameras that it never meets give the test
views. The four scenes share their objects; only the motion differs. What is made depends on the source string alone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import DTypeLike

from pd4dgs_codec.data.cameras import Lens, world_to_camera
from pd4dgs_codec.data.files import check_downscale, shrink_image, shrink_mask
from pd4dgs_codec.data.raycast import NO_BODY, Body, Eye, material, normal, place, shade
from pd4dgs_codec.data.scenes import MOTIONS, SceneBuilder
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError

PREFIX = "synthetic:"
LENS = Lens(160, 120, 150.0, 150.0, 81.5, 58.75)  #: off centre on purpose: readers must honour cx, cy
SUPERSAMPLING = 2
TRAIN_FRAMES = 60
TEST_INSTANTS = range(2, TRAIN_FRAMES, 4)
FPS = 12.0
#: The camera goes back and forth over its arc so many times, as a hand does: were it to pass each place once, place
#: and instant would be one, and a static scene whose look depends on the view would explain every motion.
SWEEPS = 2.5
SKY = np.array([0.71, 0.80, 0.90])
TARGET = np.array([0.0, 0.1, 0.5])
BOX = np.array([[-2.7, -2.7, -0.1], [2.7, 2.5, 2.6]], np.float32)
NEAR, FAR = 0.5, 12.0
POINTS = 5000
COVISIBLE_SHARE = 0.05  #: a test pixel counts if this share of the training frames saw its surface point


def parse(source: str) -> tuple[str, int]:
    """Name and seed of a `synthetic:` source."""
    match = re.fullmatch(r"([a-z]*)(?:\?seed=(\d{1,9}))?", source.removeprefix(PREFIX))
    if match is None or match[1] not in MOTIONS:
        names = "|".join(MOTIONS)
        raise DataError(f"{source}: unknown synthetic scene, expected {PREFIX}{names}[?seed=n]")
    return match[1], int(match[2] or 0)


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


def _grid(scale: int, dtype: DTypeLike = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """x [scale * W] and y [scale * H] at depth 1 of the pixel centres of an image `scale` times as fine."""
    x = ((np.arange(LENS.width * scale) + 0.5) / scale - LENS.cx) / LENS.fx
    return x.astype(dtype), (((np.arange(LENS.height * scale) + 0.5) / scale - LENS.cy) / LENS.fy).astype(dtype)


def _render(bodies: list[Body], viewmat: np.ndarray, t: float) -> np.ndarray:
    """uint8 [H, W, 3]: the mean of SUPERSAMPLING² rays per pixel."""
    placed = place(bodies, t)
    eye = Eye(placed, viewmat)
    xs, ys = _grid(SUPERSAMPLING, np.float32)
    depth, index = eye.first_hits(xs, ys)
    color = np.tile(SKY.astype(np.float32)[:, None, None], (1, *depth.shape))
    for i in range(len(placed)):
        row, col = np.nonzero(index == i)
        if len(row):
            color[:, row, col] = shade(placed, i, eye.world(xs[col], ys[row], depth[row, col]), t)
    s = SUPERSAMPLING
    mean = color.reshape(3, LENS.height, s, LENS.width, s).mean(axis=(2, 4))
    return np.asarray(mean.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class _Surface:
    """What the pixel centres of a view see: body index [n], material point [3, n], for the sky the direction [3, n]."""

    body: np.ndarray
    point: np.ndarray


def _surface(bodies: list[Body], viewmat: np.ndarray, t: float) -> _Surface:
    placed = place(bodies, t)
    eye = Eye(placed, viewmat)
    xs, ys = _grid(1)
    depth, index = (a.ravel() for a in eye.first_hits(xs, ys))
    x, y = (a.ravel() for a in np.meshgrid(xs, ys))
    point = viewmat[:3, :3].T @ np.stack([x, y, np.ones_like(x)])
    for i, body in enumerate(placed):
        mine = index == i
        point[:, mine] = material(body, eye.world(x[mine], y[mine], depth[mine]))
    return _Surface(index, point)


def _seen(eye: Eye, body: np.ndarray, point: np.ndarray) -> np.ndarray:
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
    u, v = LENS.fx * x + LENS.cx, LENS.fy * y + LENS.cy
    seen = np.asarray(facing & (z > 0) & (u >= 0) & (u <= LENS.width) & (v >= 0) & (v <= LENS.height))
    some = np.flatnonzero(seen)
    depth = np.where(body[some] == NO_BODY, np.inf, z[some])
    seen[some] = ~eye.hidden(x[some], y[some], depth, body[some])
    return seen


def _covisible(bodies: list[Body], eyes: list[Eye], viewmat: np.ndarray, t: float, needed: int) -> np.ndarray:
    """bool [H, W]: what a pixel's centre sees was seen by at least `needed` of the training cameras `eyes`."""
    surface = _surface(bodies, viewmat, t)
    count = np.zeros(len(surface.body), np.int32)
    # Strided order: most points are settled after a few distant frames and drop out.
    order = [i for start in range(8) for i in range(start, len(eyes), 8)]
    for i in order:
        open_ = np.flatnonzero(count < needed)
        if not len(open_):
            break
        count[open_] += _seen(eyes[i], surface.body[open_], surface.point[:, open_])
    return (count >= needed).reshape(LENS.height, LENS.width)


def _initial_points(
    bodies: list[Body], viewmats: list[np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """What structure from motion would give of the first instant: visible surface points, noisy, 2 % of them stray."""
    placed = place(bodies, 0.0)
    per_view = -(-POINTS // len(viewmats)) * 5 // 4  # some rays meet only the sky
    points, colors = [], []
    for viewmat in viewmats:
        eye = Eye(placed, viewmat)
        xs, ys = _grid(1)
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


def _view(bodies: list[Body], viewmat: np.ndarray, camera: int, instant: int, mask: np.ndarray | None) -> View:
    t = instant / (TRAIN_FRAMES - 1)
    image = _render(bodies, viewmat, t)
    name = f"{camera}_{instant:05d}"
    return View(viewmat.astype(np.float32), LENS.matrix(), LENS.width, LENS.height, t, image, mask, name, camera)


@lru_cache(maxsize=4)
def _dataset(name: str, seed: int) -> Dataset:
    bodies = SceneBuilder(name, seed).bodies()
    times = [i / (TRAIN_FRAMES - 1) for i in range(TRAIN_FRAMES)]
    viewmats = [_train_viewmat(t) for t in times]
    eyes = [Eye(place(bodies, t), v) for t, v in zip(times, viewmats, strict=True)]
    needed = max(1, int(np.ceil(COVISIBLE_SHARE * TRAIN_FRAMES)))
    train = tuple(_view(bodies, v, 0, i, None) for i, v in enumerate(viewmats))
    test = tuple(
        _view(bodies, v, camera, i, _covisible(bodies, eyes, v, times[i], needed))
        for camera, v in enumerate(fixed_viewmats(), start=1)
        for i in TEST_INSTANTS
    )
    points, colors = _initial_points(bodies, viewmats, np.random.default_rng([seed, 1]))
    sky = (float(SKY[0]), float(SKY[1]), float(SKY[2]))
    end = (TRAIN_FRAMES - 1) / FPS
    return Dataset(
        f"synthetic-{name}", train, test, points, colors, BOX, NEAR, FAR, sky, (0.0, end), (0.0, 0.0, 1.0), 0.0, True
    )


def _shrink(view: View, k: int) -> View:
    image = shrink_image(view.image, k)
    mask = None if view.mask is None else shrink_mask(view.mask, k)
    return replace(view, K=LENS.matrix(k), width=image.shape[1], height=image.shape[0], image=image, mask=mask)


def read_synthetic(source: str, downscale: int = 1) -> Dataset:
    """The scene named by `source`; rendered once per process and kept in memory."""
    name, seed = parse(source)
    check_downscale((LENS.width, LENS.height), downscale, source)
    full = _dataset(name, seed)
    if downscale == 1:
        return full
    train, test = (tuple(_shrink(v, downscale) for v in views) for views in (full.train, full.test))
    return replace(full, train=train, test=test)
