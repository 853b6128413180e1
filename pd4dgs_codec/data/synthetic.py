"""`synthetic:static|global|local|fast[?seed=n&size=WxH&frames=N]`: ray-cast dynamic scenes, exact covisibility masks.

One camera moves to and fro along an arc (60 training frames); two fixed cameras off that arc give the test views. The
four scenes share their objects and differ in motion. Another size keeps the vertical field of view; more frames repeat
the same motion more densely. The content depends on the source string alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from pd4dgs_codec.data.cameras import Lens, world_to_camera
from pd4dgs_codec.data.dataset import SYNTHETIC
from pd4dgs_codec.data.files import check_downscale, shrink_image, shrink_mask, split_options
from pd4dgs_codec.data.raycast import NO_BODY, Body, Eye, Paint, Pose, material, normal, place, shade
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError

LENS = Lens(160, 120, 150.0, 150.0, 81.5, 58.75)  #: off centre on purpose: readers must honour cx, cy
SUPERSAMPLING = 2
SECONDS = 59 / 12
#: Test views of each fixed camera, if there are enough frames.
TEST_INSTANTS = 15
#: Allowed values of the options.
SIZES, FRAMES = range(8, 8193), range(3, 10_001)
EXAMPLES = {"seed": "seed=1", "size": "size=960x540", "frames": "frames=300"}
#: The camera sweeps its arc so many times. If it passed each place once, place and time would be the same, and a static
#: scene with a view-dependent look would explain every motion.
SWEEPS = 2.5
SKY = (0.71, 0.80, 0.90)
TARGET = np.array([0.0, 0.1, 0.5])
BOX = np.array([[-2.7, -2.7, -0.1], [2.7, 2.5, 2.6]], np.float32)
NEAR, FAR = 0.5, 12.0
POINTS = 5000
COVISIBLE_SHARE = 0.05  #: of the training frames that must see a test pixel's surface point


@dataclass(frozen=True)
class Motion:
    """The motion of a scene over t = 0..1. Amplitudes in radians or shares, rates in turns (cycles) over that time."""

    sway: float = 0.0  #: turning of the platform with all that stands on it
    heave: float = 0.0  #: its rise, scene units
    swing: float = 0.0  #: the arm on the column
    swing_rate: float = 2.0
    pulse: float = 0.0  #: stretching of the ball
    tint: float = 0.0  #: colour change of the plank
    spin: float = 0.0  #: turns of the crate
    hops: float = 0.0  #: bounces of the two balls
    orbit: float = 0.0  #: turns of the runner around the platform


Size = Sequence[float]  #: of three axes
#: Rotation [3, 3], shift [3] and stretch per axis [3] of a body at an instant, on top of its place.
Local = tuple[np.ndarray, np.ndarray, np.ndarray]

MOTIONS = {
    "static": Motion(),
    "global": Motion(sway=0.7, heave=0.08),
    "local": Motion(sway=0.3, swing=0.6, pulse=0.16, tint=0.55),
    "fast": Motion(swing=1.0, swing_rate=6.0, spin=2.5, hops=6.0, orbit=1.5),
}


def _turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    r = np.eye(3)
    r[i, i], r[i, j], r[j, i], r[j, j] = c, -s, s, c
    return r


class SceneBuilder:
    """Builds the bodies of one scene."""

    def __init__(self, name: str, seed: int):
        self.motion, self.rng = MOTIONS[name], np.random.default_rng(seed)
        self.hue = self.rng.uniform()

    def paint(
        self, size: Size, hue: float, wave: float, axes: tuple[int, int] = (0, 2), strength: float = 0.45
    ) -> Paint:
        """Two shades of a hue in checks along two axes, `wave` radians per unit."""
        rng = self.rng
        angle = 2 * np.pi * (hue + self.hue + np.array([0, 1 / 3, 2 / 3]))
        base = 0.56 + 0.34 * np.cos(angle)
        waves, (a, b) = np.zeros((2, 4)), axes
        waves[:, a], waves[0, b], waves[1, b], waves[:, 3] = wave, wave, -wave, rng.uniform(0, 6, 2)
        direction = rng.normal(size=(4, 3))
        direction *= rng.uniform(9, 26, (4, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
        detail = np.concatenate([direction, rng.uniform(0, 6, (4, 1))], axis=1)
        high = np.clip(base + 0.25, 0, 1)
        return Paint(base * (1 - strength), high, waves, detail, np.asarray(size, float))

    def group(self, t: float) -> Pose:
        """Rotation and position of the platform."""
        m = self.motion
        angle = m.sway * np.sin(2 * np.pi * 0.75 * t)
        return _turn(2, angle), np.array([0, 0, m.heave * np.sin(np.pi * t) ** 2])

    def fixed(self, shape: str, size: Size, at: Size, *look: Any, casts: bool = False, **more: Any) -> Body:
        """A body that never moves. look, more: of its paint. casts: False for floor and wall."""
        pose = np.diag(np.asarray(size, float)), np.asarray(at, float)
        return Body(shape, lambda t: pose, self.paint(size, *look, **more), casts)

    def riding(
        self, shape: str, size: Size, at: Size, *look: Any, local: Callable[[float], Local] | None = None, **more: Any
    ) -> Body:
        """A body on the platform; `local` is its motion there."""
        half = np.asarray(size, float)
        yaw = _turn(2, self.rng.uniform(-0.4, 0.4))
        place = np.asarray(at, float) + np.array([*self.rng.uniform(-0.05, 0.05, 2), 0])

        def pose(t: float) -> Pose:
            R, p = self.group(t)
            turn, shift, stretch = local(t) if local else (np.eye(3), np.zeros(3), np.ones(3))
            return R @ turn @ yaw @ np.diag(half * stretch), R @ (place + shift) + p

        return Body(shape, pose, self.paint(size, *look, **more))

    def arm(self) -> list[Body]:
        """A rod that swings about the top of the column, with a bob at its end."""
        m, pivot, reach = self.motion, np.array([0.15, 0.35, 1.17]), 0.36
        rest = self.rng.uniform(0.4, 0.9)

        def part(size: Size, along: float) -> Callable[[float], Pose]:
            def pose(t: float) -> Pose:
                R, p = self.group(t)
                turn = R @ _turn(1, rest + m.swing * np.sin(2 * np.pi * m.swing_rate * t))
                return turn @ np.diag(size), R @ pivot + p + turn @ np.array([along, -0.2, 0])

            return pose

        rod, bob = (reach, 0.05, 0.05), (0.15, 0.15, 0.15)
        return [
            Body("box", part(rod, 0.6 * reach), self.paint(rod, 0.1, 9.0)),
            Body("sphere", part(bob, 1.7 * reach), self.paint(bob, 0.75, 14.0)),
        ]

    def bodies(self) -> list[Body]:
        """All bodies, the still ones first."""
        m = self.motion
        one, still = np.ones(3), np.eye(3)

        def hop(t: float, phase: float, height: float) -> np.ndarray:
            bounce = height * abs(np.sin(np.pi * (m.hops * t + phase))) if m.hops else 0.0
            return np.array([0, 0, bounce])

        def ball(t: float) -> Local:
            s = m.pulse * np.sin(2 * np.pi * 3 * t)
            return still, hop(t, 0.0, 0.55) + [0, 0, 0.3 * s], np.array([1 - 0.5 * s, 1 - 0.5 * s, 1 + s])

        def small(t: float) -> Local:
            return still, hop(t, 0.4, 0.8), one

        def crate(t: float) -> Local:
            return _turn(2, 2 * np.pi * m.spin * t), np.zeros(3), one

        def runner(t: float) -> Local:
            angle = 2 * np.pi * m.orbit * t
            return still, 1.5 * np.array([np.cos(angle) - 1, np.sin(angle), 0]), one

        def tint(t: float) -> np.ndarray:
            s = m.tint * np.sin(np.pi * 2 * t) ** 2
            return np.array([1 - s, 1 - 0.4 * s, 1 + 0.6 * s])

        plank = self.riding("box", (0.1, 0.38, 0.24), (-0.62, 0.42, 0.34), 0.55, 11.0, axes=(1, 2))
        return [
            self.fixed("box", (2.6, 2.4, 0.05), (0, -0.1, -0.05), 0.08, 5.5, axes=(0, 1), strength=0.3),
            self.fixed("box", (2.6, 0.05, 1.2), (0, 2.3, 1.2), 0.6, 3.5, strength=0.18),
            self.fixed("box", (0.22, 0.22, 0.75), (1.9, 1.5, 0.75), 0.3, 8.0, casts=True),
            self.fixed("sphere", (0.42, 0.42, 0.42), (-1.8, 1.2, 0.42), 0.9, 7.0, casts=True),
            self.riding("cylinder", (1.15, 1.15, 0.05), (0, 0, 0.05), 0.15, 6.0, axes=(0, 1)),
            self.riding("cylinder", (0.12, 0.12, 0.55), (0.15, 0.42, 0.65), 0.45, 10.0),
            replace(plank, paint=replace(plank.paint, tint=tint if m.tint else None)),
            self.riding("box", (0.26, 0.26, 0.26), (-0.42, -0.3, 0.36), 0.0, 9.0, local=crate),
            self.riding("sphere", (0.3, 0.3, 0.3), (0.5, -0.3, 0.4), 0.33, 9.0, local=ball),
            self.riding("sphere", (0.16, 0.16, 0.16), (-0.42, -0.3, 0.78), 0.7, 12.0, local=small),
            self.riding("sphere", (0.14, 0.14, 0.14), (1.5, 0, 0.14), 0.2, 14.0, local=runner),
            *self.arm(),
        ]


# -- a dataset of a scene ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Take:
    """A parsed source. size: (width, height) of the pictures; frames: of the moving camera."""

    name: str
    seed: int = 0
    size: tuple[int, int] = (LENS.width, LENS.height)
    frames: int = 60

    @property
    def lens(self) -> Lens:
        """`LENS` for pictures of this size."""
        (width, height), scale = self.size, self.size[1] / LENS.height
        return Lens(width, height, LENS.fx * scale, LENS.fy * scale, LENS.cx * width / LENS.width, LENS.cy * scale)


def parse(source: str) -> Take:
    """Parses a `synthetic:` source. Raises DataError."""
    name, options = split_options(source.removeprefix(SYNTHETIC), source, _value, EXAMPLES)
    if name not in MOTIONS:
        expected = f"{SYNTHETIC}{'|'.join(MOTIONS)}[?seed=n&size=WxH&frames=N]"
        raise DataError(f"{source}: unknown synthetic scene, expected {expected}")
    return Take(name, **options)


def _value(key: str, text: str) -> Any:
    """The value of an option. Raises ValueError for an invalid one."""
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


def train_viewmat(t: float) -> np.ndarray:
    """The moving camera."""
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
    color = np.tile(np.asarray(SKY, np.float32)[:, None, None], (1, *depth.shape))
    for i in range(len(placed)):
        row, col = np.nonzero(index == i)
        if len(row):
            color[:, row, col] = shade(placed, i, eye.world(xs[col], ys[row], depth[row, col]), t)
    s = SUPERSAMPLING
    mean = color.reshape(3, lens.height, s, lens.width, s).mean(axis=(2, 4))
    return np.asarray(mean.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


def _surface(bodies: list[Body], viewmat: np.ndarray, t: float, lens: Lens = LENS) -> tuple[np.ndarray, np.ndarray]:
    """Of the surface behind each pixel centre: body index [n], and material point [3, n], for the sky its direction."""
    eye, (xs, ys) = Eye(place(bodies, t), viewmat), _grid(lens)
    depth, index = (a.ravel() for a in eye.first_hits(xs, ys))
    x, y = (a.ravel() for a in np.meshgrid(xs, ys))
    point = viewmat[:3, :3].T @ np.stack([x, y, np.ones_like(x)])
    for i, body in enumerate(eye.placed):
        mine = index == i
        point[:, mine] = material(body, eye.world(x[mine], y[mine], depth[mine]))
    return index, point


def _seen(eye: Eye, body: np.ndarray, point: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    """bool [n]: at the time of `eye` the points (see _surface) are in its picture, face it and are not hidden."""
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
    """bool [H, W]: COVISIBLE_SHARE of the training cameras `eyes` saw the surface point of a pixel's centre."""
    (body, point), needed = _surface(bodies, viewmat, t, lens), max(1, int(np.ceil(COVISIBLE_SHARE * len(eyes))))
    count = np.zeros(len(body), np.int32)
    # Strided order: most points are settled after a few distant frames and drop out.
    order = [i for start in range(8) for i in range(start, len(eyes), 8)]
    for i in order:
        open_ = np.flatnonzero(count < needed)
        if not len(open_):
            break
        count[open_] += _seen(eyes[i], body[open_], point[:, open_], lens)
    return (count >= needed).reshape(lens.height, lens.width)


def _initial_points(
    bodies: list[Body], viewmats: list[np.ndarray], lens: Lens, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points as structure from motion finds them at time 0: visible surface points with noise, 2 % of them stray."""
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
    viewmats = [train_viewmat(t) for t in times]
    eyes = [Eye(place(bodies, t), v) for t, v in zip(times, viewmats, strict=True)]

    def view(viewmat: np.ndarray, camera: int, i: int) -> View:
        image, matrices = _render(bodies, viewmat, times[i], lens), (viewmat.astype(np.float32), lens.matrix())
        mask = _covisible(bodies, eyes, viewmat, times[i], lens) if camera else None
        return View(*matrices, *take.size, times[i], image, mask, f"{camera}_{i:05d}", camera)

    train = tuple(view(v, 0, i) for i, v in enumerate(viewmats))
    instants = range(2, take.frames, max(1, take.frames // TEST_INSTANTS))
    test = tuple(view(v, camera, i) for camera, v in enumerate(fixed_viewmats(), start=1) for i in instants)
    points, colors = _initial_points(bodies, viewmats, lens, np.random.default_rng([take.seed, 1]))
    fields = SKY, (0.0, SECONDS), (0.0, 0.0, 1.0), 0.0, True
    return Dataset(f"synthetic-{take.name}", train, test, points, colors, BOX, NEAR, FAR, *fields)


def _shrink(view: View, k: int, lens: Lens = LENS) -> View:
    image, mask = shrink_image(view.image, k), None if view.mask is None else shrink_mask(view.mask, k)
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
