"""Models that can say their Gaussians at a time, as a dataset: pictures of them from cameras around them.

The source is `teacher:PATH[?key=value&...]`. PATH is a folder of PLY or SPZ files, one per frame, in the order of the
last number in their names, or one such file; a `.4dgs` file; a checkpoint of gsplat (`.pt`, `.ckpt`), which stands
still; or `module:function`, called with t in 0..1: it returns means, quats (wxyz), scales, opacities and either colors
or sh, as a mapping or as attributes, numpy arrays or tensors.

Keys: cameras=SOURCE looks from the training cameras of a dataset at their times; else views=N cameras (200) of
size=WxH (400x400) stand around the Gaussians, or where a `cameras.json` beside them says. fps=F (30) tells how long a
folder of frames takes, background=black|white|R,G,B what is behind them, up=X,Y,Z (0,-1,0) where up is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import split_options
from pd4dgs_codec.data.posed import depth_range, held_out, points_box
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.models import Teacher, read_model
from pd4dgs_codec.interchange.scaffold_gs import read_cameras
from pd4dgs_codec.interchange.splats import SH_C0, looking, picture, sphere, spread
from pd4dgs_codec.quality.frames import shrunk
from pd4dgs_codec.scene import Camera

PREFIX = "teacher:"
#: Fainter Gaussians are no anchors, and do not count for where the scene is.
SOLID = 0.1
POINTS = 100_000  #: of which the initial anchors are drawn, at most
FIELD_OF_VIEW = math.radians(50)
#: Cameras stand so far from the middle, in radii of the sphere around 90 of 100 Gaussians, and no lower than this sine
#: below it.
DISTANCE, LOWEST = 2.6, -0.35
MIDDLE = 0.5  #: the instant whose Gaussians the anchors start at
BOX_TIMES = 5  #: instants at which it is looked how far the Gaussians reach
PATH_TIMES = 17  #: instants of their paths, at most
#: Rows of two instants are the same Gaussians if the median distance from one to the other is below this share of the
#: median distance between rows drawn at random.
SAME = 0.25
#: Of the times of cameras that have none: any stretch of them is spread over the whole time.
GOLDEN = (5**0.5 - 1) / 2
EXAMPLES = {
    "cameras": "cameras=FOLDER", "views": "views=200", "size": "size=400x400", "fps": "fps=30", "up": "up=0,-1,0",
    "background": "background=white or background=0.5,0.5,0.5",
}  # fmt: skip
NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Options:
    """See the module."""

    cameras: str | None = None
    views: int = 200
    size: tuple[int, int] = (400, 400)
    fps: float = 30.0
    background: Triple = (0.0, 0.0, 0.0)
    up: Triple = (0.0, -1.0, 0.0)


def load_source(source: str, *, downscale: int = 1, holdout: int = 8) -> Dataset:
    """`data.dataset.load` for every source, teachers included. Raises DataError."""
    if not source.startswith(PREFIX):
        return load(source, downscale=downscale, holdout=holdout)
    place, options = _parsed(source)
    teacher = read_model(place, options.fps)
    if options.cameras:
        return _like(source, teacher, load(options.cameras, downscale=downscale, holdout=holdout))
    return _around(source, Path(place), teacher, options, downscale, holdout)


def _like(source: str, teacher: Teacher, data: Dataset) -> Dataset:
    """The dataset with the teacher's pictures in the place of its training pictures; held-out ones stay true."""
    solid = _solid(source, teacher, MIDDLE)
    shots = [(view.camera, view.time) for view in data.train]
    train = _pictures(teacher, shots, data.background, data.near)
    return replace(data, name=source, train=tuple(train), **_points(teacher, solid))


def _around(source: str, place: Path, teacher: Teacher, options: Options, downscale: int, holdout: int) -> Dataset:
    """Cameras around the teacher, every holdout-th of them held out."""
    solid = _solid(source, teacher, MIDDLE)
    cameras, up = _cameras(place, teacher.splats(teacher.nearest(MIDDLE)).means[solid], options, downscale)
    still = teacher.times is not None and len(teacher.times) == 1
    shots = [(camera, 0.0 if still else i * GOLDEN % 1.0) for i, camera in enumerate(cameras)]
    times = teacher.times or tuple(np.linspace(0, 1, BOX_TIMES))
    some = spread(times, BOX_TIMES)
    everywhere = np.concatenate([teacher.splats(t).means[_solid(source, teacher, t)] for t in some])
    box = points_box(everywhere)
    near, far = depth_range([c.viewmat.astype(np.float64) for c in cameras], box, everywhere)
    views = _pictures(teacher, shots, options.background, near)
    train, test = held_out(views, holdout)
    return Dataset(
        name=source, train=tuple(train), test=tuple(test),
        box=box, near=near, far=far, background=options.background,
        time_range=(0.0, teacher.seconds), up=up, unit=0.0, masked=False,
        **_points(teacher, solid),
    )  # fmt: skip


def _solid(source: str, teacher: Teacher, t: float) -> np.ndarray:
    """Rows of the Gaussians at an instant that are not faint."""
    rows = np.flatnonzero(teacher.splats(teacher.nearest(t)).opacities >= SOLID)
    if not len(rows):
        raise DataError(f"{source}: no Gaussian is as opaque as {SOLID:g} at {t:g}, expected one at least")
    return rows


def _points(teacher: Teacher, solid: np.ndarray) -> dict[str, Any]:
    """The fields of a Dataset on its points: POINTS of these rows at most, with their paths where rows stay the same
    Gaussians."""
    rows = solid if len(solid) <= POINTS else solid[np.random.default_rng(0).permutation(len(solid))[:POINTS]]
    splats = teacher.splats(teacher.nearest(MIDDLE))
    colors = np.clip(splats.sh[rows, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1)
    points = {"points": splats.means[rows], "point_colors": np.rint(colors * 255).astype(np.uint8)}
    return points | _paths(teacher, rows, len(splats.means))


def _paths(teacher: Teacher, rows: np.ndarray, count: int) -> dict[str, Any]:
    """Where these rows of `count` are over the time; nothing if they do not stay the same Gaussians."""
    times = spread(teacher.times or tuple(np.linspace(0, 1, PATH_TIMES)), PATH_TIMES)
    others, places = np.random.default_rng(0).permutation(len(rows)), list[np.ndarray]()
    for t in times:
        means = teacher.splats(t).means
        if len(means) != count:
            return {}
        places.append(means[rows])
        if len(places) > 1:
            near, far = (np.median(np.linalg.norm(places[-1][k] - places[-2], axis=1)) for k in (slice(None), others))
            if not near <= SAME * far:
                return {}
    return {"paths": np.stack(places), "path_times": times} if len(times) > 1 else {}


def _pictures(teacher: Teacher, shots: Sequence[tuple[Camera, float]], background: Triple, near: float) -> list[View]:
    """The teacher seen by each camera at its time, or at the instant known next to it; each instant is read once."""
    views: dict[int, View] = {}
    for i in sorted(range(len(shots)), key=lambda i: shots[i][1]):
        camera, t = shots[i][0], teacher.nearest(shots[i][1])
        image = np.rint(picture(teacher.splats(t), camera, background, near) * 255).astype(np.uint8)
        views[i] = View(camera.viewmat, camera.K, camera.width, camera.height, t, image, None, f"{i:05d}", i)
    return [views[i] for i in range(len(shots))]


def _parsed(source: str) -> tuple[str, Options]:
    """The place and the options of `teacher:place?key=value&...`."""
    place, values = split_options(source.removeprefix(PREFIX), source, _value, EXAMPLES)
    if not place:
        raise DataError(f"{source}: names no teacher; expected {PREFIX}FOLDER, {PREFIX}FILE or {PREFIX}module:function")
    return place, Options(**values)


def _value(key: str, text: str) -> Any:
    """The value of a key; ValueError for what is none."""
    if key == "cameras" and text:
        return text
    if key == "views" and 2 <= int(text) <= 100_000:
        return int(text)
    if key == "fps" and 0 < float(text) < math.inf:
        return float(text)
    if key == "background" and text in NAMED:
        return NAMED[text]
    numbers = tuple(map(float, re.split("[x,]", text)))
    if key == "background" and len(numbers) == 3 and all(0 <= v <= 1 for v in numbers):
        return numbers
    if key == "up" and len(numbers) == 3 and 0 < math.hypot(*numbers) < math.inf:
        return numbers
    if key == "size" and len(numbers) == 2 and all(v == int(v) and 8 <= v <= 8192 for v in numbers):
        return tuple(map(int, numbers))
    raise ValueError(text)


def _cameras(place: Path, points: np.ndarray, options: Options, downscale: int) -> tuple[list[Camera], Triple]:
    """Cameras of a cameras.json beside the Gaussians, else around them, and the direction up."""
    beside = next((p / "cameras.json" for p in (place, place.parent) if (p / "cameras.json").is_file()), None)
    if beside is not None:
        cameras, up = read_cameras(beside)
        some = spread(cameras, options.views)
        return [shrunk(c, downscale * math.ceil(max(c.width, c.height) / max(options.size))) for c in some], up
    middle = np.median(points, axis=0).astype(np.float64)
    radius = max(float(np.percentile(np.linalg.norm(points - middle, axis=1), 90)), 1e-6)
    axis = np.asarray(options.up) / max(float(np.linalg.norm(options.up)), 1e-12)
    places = sphere(2 * options.views)
    places = places[places @ axis >= LOWEST]
    places = places[np.linspace(0, len(places) - 1, options.views).round().astype(int)]
    width, height = options.size
    focal = 0.5 * max(width, height) / math.tan(FIELD_OF_VIEW / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    like = shrunk(Camera(np.eye(4, dtype=np.float32), K, width, height), downscale)
    return [looking(middle + DISTANCE * radius * d, -d, axis, like) for d in places], options.up
