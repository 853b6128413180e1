"""`synthetic:NAME[?seed=n&size=WxH&frames=N&seconds=S&path=PATH]`: ray-cast dynamic scenes, named in STAGES, and
RANDOM, which draws bodies, background and camera path from its seed.

In a room one camera moves along an arc (60 training frames); two fixed cameras off that arc give the test views, with
exact covisibility masks. On white the camera jumps on the upper hemisphere, as D-NeRF's does (150 frames without
points); two fixed cameras see all instants, of the dancer 15. Another size keeps the vertical field of view; more
frames repeat the same motion more densely, and in a room more seconds go on with it. The content depends on the source
string alone.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from pd4dgs_codec.data.bodies import MOTIONS, NO_BODY, THINGS, Body, Eye, bodies, material, normal, place, shade
from pd4dgs_codec.data.dancer import DANCER, Dancer
from pd4dgs_codec.data.dataset import SYNTHETIC
from pd4dgs_codec.data.files import check_downscale, split_options
from pd4dgs_codec.data.random_bodies import RANDOM, random_scene
from pd4dgs_codec.data.view import LATER, Dataset, Lens, View, later_view, shrunk_view, world_to_camera
from pd4dgs_codec.errors import DataError

SUPERSAMPLING = 2
SECONDS = 59 / 12
#: Allowed values of the options.
SIZES, FRAMES, LENGTHS = range(8, 8193), range(3, 10_001), range(1, 3601)
FPS = 12  #: of a scene whose seconds are given, and its frames are not
EXAMPLES = {
    "seed": "seed=1",
    "size": f"size=960x540, each {SIZES[0]} to {SIZES[-1]}",
    "frames": f"frames=300, {FRAMES[0]} to {FRAMES[-1]}",
    "seconds": f"seconds=60, {LENGTHS[0]} to {LENGTHS[-1]}",
    "path": "path=pass, sweeps, orbit, jump or still",
}
STILL, STANDS, CAMERAS = "still", 0.5, 6
#: Cycles of the camera along its path; None: it is at a random place at each instant. If it passes each place once,
#: the place determines the time, and a static scene with view-dependent colours explains every motion. STILL: CAMERAS
#: that stand along a path of STANDS cycles and show every instant.
PATHS = {"pass": 0.5, "sweeps": 2.5, "orbit": 1.0, "jump": None, STILL: STANDS}
NEAR, FAR = 0.5, 12.0
POINTS = 5000
COVISIBLE_SHARE = 0.05  #: of the training frames that must see a test pixel's surface point


def _look(target: np.ndarray, azimuth: float, radius: float, height: float) -> np.ndarray:
    """float64 [4, 4] viewmat of a camera at the azimuth (0 = along y) that looks at the target."""
    center = target + np.array([radius * np.sin(azimuth), -radius * np.cos(azimuth), height])
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    return world_to_camera(np.stack([x, np.cross(z, x), z]), center)


ROOM_TARGET = np.array([0.0, 0.1, 0.5])


def room_viewmat(phase: float, s: float) -> np.ndarray:
    """The viewmat of the moving camera in the room after `phase` cycles; s 0..1 decides height and distance."""
    azimuth = 40 * np.sin(2 * np.pi * phase - np.pi / 2)
    return _look(ROOM_TARGET, np.radians(azimuth), 3.9 + 0.15 * np.cos(7 * s), 1.15 + 0.2 * np.sin(9 * s))


def white_viewmat(phase: float, s: float) -> np.ndarray:
    """The viewmat after `phase` turns around a scene on white, at D-NeRF's distance; s 0..1 is evenly spread over the
    upper hemisphere without its pole."""
    z = 0.05 + 0.9 * s
    return _look(np.zeros(3), 2 * np.pi * phase, 4 * np.sqrt(1 - z * z), 4 * z)


@dataclass(frozen=True, eq=False)
class Stage:
    """The settings that the scenes of one kind share.

    viewmat: the moving camera's, by the phase of its path and s 0..1. fixed: viewmats of the test cameras.
    instants: about how many test views each test camera has; 0: one per instant. capture: whether there are
    covisibility masks and initial points.
    """

    lens: Lens
    frames: int
    path: str
    background: tuple[float, float, float]
    box: np.ndarray
    viewmat: Callable[[float, float], np.ndarray]
    fixed: tuple[np.ndarray, np.ndarray]
    instants: int = 0
    capture: bool = False


#: The lens is off centre on purpose: readers must honour cx, cy. The test cameras are inside the arc in azimuth but off
#: it in height and distance.
ROOM = Stage(
    lens=Lens(160, 120, 150.0, 150.0, 81.5, 58.75),
    frames=60,
    path="sweeps",
    background=(0.71, 0.80, 0.90),
    box=np.array([[-2.7, -2.7, -0.1], [2.7, 2.5, 2.6]], np.float32),
    viewmat=room_viewmat,
    fixed=(_look(ROOM_TARGET, np.radians(-19), 3.5, 0.75), _look(ROOM_TARGET, np.radians(23), 3.75, 1.75)),
    instants=15,
    capture=True,
)
#: D-NeRF's field of view and its box of initial points.
WHITE = Stage(
    lens=Lens(100, 100, 138.889, 138.889, 50.0, 50.0),
    frames=150,
    path="jump",
    background=(1.0, 1.0, 1.0),
    box=np.array([[-1.3] * 3, [1.3] * 3], np.float32),
    viewmat=white_viewmat,
    fixed=(white_viewmat(0.9, 0.3), white_viewmat(0.3, 0.6)),
)
#: The first test camera is in front of the dancer.
FIGURE = replace(
    WHITE,
    lens=Lens(200, 200, 277.778, 277.778, 100.0, 100.0),
    fixed=(white_viewmat(0.03, 0.2), white_viewmat(0.3, 0.5)),
    instants=15,
)
STAGES = dict.fromkeys(MOTIONS, ROOM) | dict.fromkeys(THINGS, WHITE) | {DANCER: FIGURE}


def random_stage(seed: int, path: str | None) -> Stage:
    """The stage of RANDOM. Without a room its test cameras are beside the way of the training camera."""
    chance = random_scene(seed)
    path = path or chance.path
    if chance.room:
        return replace(ROOM, frames=100, path=path)
    turns = PATHS[path] or 1.0
    fixed = white_viewmat(0.3 * turns, 0.4), white_viewmat(0.7 * turns, 0.55)
    return replace(WHITE, frames=100, path=path, background=chance.background, fixed=fixed, instants=15)


# -- a dataset of a scene ----------------------------------------------------------------------------------------------


#: Viewmat, number of the camera, index of the instant.
Shot = tuple[np.ndarray, int, int]


@dataclass(frozen=True)
class Take:
    """A parsed source. size: (width, height) of the pictures; frames: of the moving camera; path: its name in PATHS.
    seconds: of the scene."""

    name: str
    stage: Stage = field(compare=False)  # the name decides it
    size: tuple[int, int]
    frames: int
    path: str
    seed: int = 0
    seconds: float = SECONDS

    @property
    def lens(self) -> Lens:
        """The stage's lens for pictures of this size."""
        (width, height), lens = self.size, self.stage.lens
        scale = height / lens.height
        return Lens(width, height, lens.fx * scale, lens.fy * scale, lens.cx * width / lens.width, lens.cy * scale)

    @property
    def times(self) -> list[float]:
        """The instants of the training frames."""
        return [i / (self.frames - 1) for i in range(self.frames)]

    def clock(self, time: float) -> float:
        """The time by which bodies and camera move, of a normalised time: 1 after the usual length."""
        return time * (self.seconds / SECONDS)

    def bodies(self) -> list[Body]:
        if self.name == RANDOM:
            return random_scene(self.seed).bodies
        return Dancer(self.seed).bodies() if self.name == DANCER else bodies(self.name, self.seed)

    def viewmats(self) -> list[np.ndarray]:
        """The viewmats of the training frames, of STILL one per camera."""
        turns, rng = PATHS[self.path], np.random.default_rng([self.seed, 2])
        if self.path == STILL:
            places = enumerate(rng.uniform(size=CAMERAS).tolist())
            return [self.stage.viewmat(STANDS * (k + 0.5) / CAMERAS, s) for k, s in places]
        if turns is not None:
            return [self.stage.viewmat(turns * t, t) for t in map(self.clock, self.times)]
        return [self.stage.viewmat(phase, s) for phase, s in rng.uniform(size=(self.frames, 2)).tolist()]

    def shots(self) -> tuple[list[Shot], list[Shot]]:
        """Of the training views and of the test views, camera by camera."""
        viewmats, some = self.viewmats(), self.stage.instants
        if self.path == STILL:
            train = [(viewmat, camera, i) for camera, viewmat in enumerate(viewmats) for i in range(self.frames)]
        else:
            train = [(viewmat, 0, i) for i, viewmat in enumerate(viewmats)]
        instants = range(2, self.frames, max(1, self.frames // some)) if some else range(self.frames)
        fixed = enumerate(self.stage.fixed, start=train[-1][1] + 1)
        return train, [(viewmat, camera, i) for camera, viewmat in fixed for i in instants]


def parse(source: str) -> Take:
    """Parses a `synthetic:` source. Raises DataError."""
    name, options = split_options(source.removeprefix(SYNTHETIC), source, _value, EXAMPLES)
    stage = random_stage(options.get("seed", 0), options.get("path")) if name == RANDOM else STAGES.get(name)
    if stage is None:
        expected = f"{SYNTHETIC}{'|'.join((*STAGES, RANDOM))}[?seed=n&size=WxH&frames=N&path={'|'.join(PATHS)}]"
        raise DataError(f"{source}: unknown synthetic scene, expected {expected}")
    if "seconds" in options:
        if name not in MOTIONS:
            raise DataError(f"{source}: found seconds, expected them of {SYNTHETIC}{'|'.join(MOTIONS)} alone")
        options.setdefault("frames", max(FPS * options["seconds"], FRAMES[0]))
    usual: dict[str, Any] = {"size": (stage.lens.width, stage.lens.height), "frames": stage.frames, "path": stage.path}
    return Take(name, stage, **(usual | options))


def _value(key: str, text: str) -> Any:
    """The value of an option. Raises ValueError for an invalid one."""
    if key == "path" and text in PATHS:
        return text
    if not re.fullmatch(r"\d{1,9}(x\d{1,9})?", text):
        raise ValueError(text)
    numbers = tuple(map(int, text.split("x")))
    if key == "size" and len(numbers) == 2 and all(v in SIZES for v in numbers):
        return numbers
    allowed = {"frames": FRAMES, "seconds": LENGTHS}.get(key)
    if len(numbers) == 1 and (key == "seed" or allowed and numbers[0] in allowed):
        return numbers[0]
    raise ValueError(text)


def grid(lens: Lens, scale: int = 1, dtype: DTypeLike = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """x [scale * W] and y [scale * H] at depth 1 of the pixel centres of an image `scale` times as fine."""
    x = ((np.arange(lens.width * scale) + 0.5) / scale - lens.cx) / lens.fx
    return x.astype(dtype), (((np.arange(lens.height * scale) + 0.5) / scale - lens.cy) / lens.fy).astype(dtype)


def render(bodies: list[Body], viewmat: np.ndarray, t: float, lens: Lens, background: Sequence[float]) -> np.ndarray:
    """uint8 [H, W, 3]: the mean of SUPERSAMPLING² rays per pixel."""
    placed = place(bodies, t)
    eye = Eye(placed, viewmat)
    xs, ys = grid(lens, SUPERSAMPLING, np.float32)
    depth, index = eye.first_hits(xs, ys)
    color = np.tile(np.asarray(background, np.float32)[:, None, None], (1, *depth.shape))
    for i in range(len(placed)):
        row, col = np.nonzero(index == i)
        if len(row):
            color[:, row, col] = shade(placed, i, eye.world(xs[col], ys[row], depth[row, col]), t)
    s = SUPERSAMPLING
    mean = color.reshape(3, lens.height, s, lens.width, s).mean(axis=(2, 4))
    return np.asarray(mean.transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8)


def _surface(bodies: list[Body], viewmat: np.ndarray, t: float, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """(body index [n], material point [3, n]) of the surface behind each pixel centre; for the sky, the direction."""
    eye, (xs, ys) = Eye(place(bodies, t), viewmat), grid(lens)
    depth, index = (a.ravel() for a in eye.first_hits(xs, ys))
    x, y = (a.ravel() for a in np.meshgrid(xs, ys))
    point = viewmat[:3, :3].T @ np.stack([x, y, np.ones_like(x)])
    for i, body in enumerate(eye.placed):
        mine = index == i
        point[:, mine] = material(body, eye.world(x[mine], y[mine], depth[mine]))
    return index, point


def _seen(eye: Eye, body: np.ndarray, point: np.ndarray, lens: Lens) -> np.ndarray:
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
    bodies: list[Body], viewmats: list[np.ndarray], lens: Lens, box: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Points as structure from motion finds them at time 0: visible surface points with noise, 2 % of them stray."""
    placed = place(bodies, 0.0)
    per_view = -(-POINTS // len(viewmats)) * 5 // 4  # some rays meet only the sky
    points = []
    for viewmat in viewmats:
        eye = Eye(placed, viewmat)
        xs, ys = grid(lens)
        depth, index = eye.first_hits(xs, ys)
        row, col = rng.integers(len(ys), size=per_view), rng.integers(len(xs), size=per_view)
        for i in range(len(placed)):
            mine = index[row, col] == i
            r, c = row[mine], col[mine]
            world = eye.world(xs[c], ys[r], depth[r, c])
            points.append(world.T + rng.normal(size=(len(r), 3)) * 0.004 * depth[r, c][:, None])
    chosen = rng.permutation(sum(map(len, points)))[:POINTS]
    xyz = np.concatenate(points)[chosen]
    stray = rng.uniform(size=len(xyz)) < 0.02
    xyz[stray] = rng.uniform(box[0], box[1], (int(stray.sum()), 3))
    return xyz.astype(np.float32)


@lru_cache(maxsize=4)
def _dataset(take: Take, later: bool = False) -> Dataset:  # `later`: as LATER, of views that differ by it
    stage, lens, scene = take.stage, take.lens, take.bodies()
    times = take.times
    moments = [take.clock(time) for time in times]
    shots, tested = take.shots()
    eyes = [Eye(place(scene, moments[i]), viewmat) for viewmat, _, i in shots]

    def view(viewmat: np.ndarray, camera: int, i: int, *, masked: bool = False) -> View:
        def pixels() -> tuple[np.ndarray, np.ndarray | None]:
            image = render(scene, viewmat, moments[i], lens, stage.background)
            return image, _covisible(scene, eyes, viewmat, moments[i], lens) if masked else None

        fields = {"viewmat": viewmat.astype(np.float32), "K": lens.matrix(), "width": lens.width, "height": lens.height}
        fields |= {"time": times[i], "name": f"{camera}_{i:05d}", "camera_id": camera}
        return later_view(pixels, fields)

    train = tuple(view(*shot) for shot in shots)
    test = tuple(view(*shot, masked=stage.capture) for shot in tested)
    points = None
    if stage.capture:
        points = _initial_points(scene, take.viewmats(), lens, stage.box, np.random.default_rng([take.seed, 1]))
    fields = stage.background, (0.0, float(take.seconds)), (0.0, 0.0, 1.0), stage.capture
    return Dataset(f"synthetic-{take.name}", train, test, points, stage.box, NEAR, FAR, *fields)


def read_synthetic(source: str, downscale: int = 1) -> Dataset:
    """The scene that `source` names, rendered once per process and kept in memory."""
    take = parse(source)
    check_downscale(take.size, downscale, source)
    full = _dataset(take, LATER.get())
    if downscale == 1:
        return full
    K = take.lens.matrix(downscale)
    train, test = (tuple(replace(shrunk_view(v, downscale), K=K) for v in views) for views in (full.train, full.test))
    return replace(full, train=train, test=test)
