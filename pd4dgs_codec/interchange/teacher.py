"""Renders other programs' Gaussians over time into a dataset: the source `teacher:PATH[?key=value&...]`.

PATH is a folder of PLY, SPZ, SOG or .splat files, one per frame, in the order of the last number in their names, or
one such file; a `.4dgs` or `.splatv` file; a PLY file of SpacetimeGaussians (lite); a checkpoint of gsplat or 4DGS; a
run of 3D Gaussian splatting, 4DGaussians, Deformable-3DGS or SC-GS or one of its `point_cloud/iteration_N`, or of 4DGS;
or `module:function`, called with t in 0..1. The function returns means, quats (wxyz), scales, opacities and either
colors or sh, as a mapping or as attributes, numpy arrays or tensors.

Keys: cameras=SOURCE uses the training cameras of a dataset and their times. Otherwise views=N cameras (200) of
size=WxH pixels (400x400) surround the Gaussians; a `cameras.json` beside them gives at most N cameras instead. fps=F
(30): frame rate of a folder; background=black|white|R,G,B (a run's, else black); up=X,Y,Z (0,-1,0): up direction.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import re
import struct
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.dataset import color, load
from pd4dgs_codec.data.files import FREE_BYTES, INFLATES, files_of, last_numbers, read_file, split_options
from pd4dgs_codec.data.view import Dataset, View, depth_range, held_out, normalised_times, points_box, seconds_range
from pd4dgs_codec.errors import DamageWarning, DataError, one_line, required
from pd4dgs_codec.interchange import polynomials
from pd4dgs_codec.interchange.runs import (
    PLY,
    Config,
    iteration,
    read_cameras,
    read_deformed,
    run_of,
)
from pd4dgs_codec.interchange.splats import (
    EXTRA,
    SH_SPAN,
    checked,
    evenly,
    looking,
    picture,
    read_splats,
    sphere,
    torch_content,
)
from pd4dgs_codec.kinds.splats import SH_C0, Splats
from pd4dgs_codec.quality.frames import shrunk
from pd4dgs_codec.scene import Camera

PREFIX = "teacher:"
FRAME_SUFFIXES = (".ply", ".spz", ".sog", ".splat")
FOURDGS = b"\x894DGS"  #: a .4dgs file begins with it
#: Keys of a function's result, which has colors instead of sh if there are no harmonics.
PARTS = ("means", "quats", "scales", "opacities", "sh")
#: Gaussians of lower opacity give no initial anchors and do not count towards the extent of the scene.
SOLID = 0.1
POINTS = 100_000  #: most points that the initial anchors are drawn from
FIELD_OF_VIEW = math.radians(50)
#: Distance of the cameras from the middle, in radii of the sphere around 90 % of the Gaussians, and the lowest sine of
#: their elevation.
DISTANCE, LOWEST = 2.6, -0.35
MIDDLE = 0.5  #: the time of the initial anchors
BOX_TIMES = 5  #: number of times whose Gaussians the box encloses
#: Consecutive cameras without times are this share of the duration apart, so that few cameras cover all of it.
GOLDEN = (5**0.5 - 1) / 2
EXAMPLES = {
    "cameras": "cameras=FOLDER", "views": "views=200, 2 to 100000", "size": "size=400x400, each 8 to 8192",
    "fps": "fps=30", "up": "up=0,-1,0", "background": "background=white or background=0.5,0.5,0.5",
}  # fmt: skip
#: Header of a stream in a .4dgs file: four bytes, channels, elements, bytes that follow.
STREAM = struct.Struct("<4xBIQ")
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Options:
    """The options of a source, see the module."""

    cameras: str | None = None
    views: int = 200
    size: tuple[int, int] = (400, 400)
    fps: float = 30.0
    background: Triple | None = None
    up: Triple = (0.0, -1.0, 0.0)


def load_source(
    source: str, *, downscale: int = 1, holdout: int = 8, background: Triple | None = None, fps: float | None = None
) -> Dataset:
    """Loads a `teacher:` source, or any other as `data.dataset.load` does. Raises DataError."""
    if not source.startswith(PREFIX):
        return load(source, downscale=downscale, holdout=holdout, background=background, fps=fps)
    place, values = split_options(source.removeprefix(PREFIX), source, _value, EXAMPLES)
    if not place:
        raise DataError(f"{source}: names no teacher; expected {PREFIX}FOLDER, {PREFIX}FILE or {PREFIX}module:function")
    options = Options(**({"fps": fps} if fps else {}) | values)
    if background is not None:
        options = replace(options, background=background)
    teacher = read_model(place, options.fps)
    if not options.cameras:
        return _around(source, Path(place), teacher, options, downscale, holdout)
    data = load(options.cameras, downscale=downscale, holdout=holdout, background=options.background, fps=fps)
    if data.place:
        raise DataError(f"{options.cameras}: the cameras are too far from 0 ({data.place}), expected a model near 0")
    poses = [(view.camera, view.time) for view in data.train]  # the held-out pictures stay
    train = tuple(_pictures(teacher, poses, data.background, data.near))
    points, origin = _points(teacher, _solid(source, teacher, MIDDLE)), replace(data.origin, points="the teacher")
    return replace(data, name=source, train=train, points=points, flat_points=0, origin=origin)


def _around(source: str, place: Path, teacher: Teacher, options: Options, downscale: int, holdout: int) -> Dataset:
    """Returns the teacher's pictures by `cameras_of` as a dataset, every holdout-th picture held out."""
    solid = _solid(source, teacher, MIDDLE)
    cameras, up = cameras_of(place, teacher.splats(teacher.nearest(MIDDLE)).means[solid], options, downscale)
    still = teacher.times is not None and len(teacher.times) == 1
    poses = [(camera, 0.0 if still else t) for camera, t in zip(cameras, spread(len(cameras)), strict=True)]
    times = teacher.times or tuple(np.linspace(0, 1, BOX_TIMES))
    some = evenly(times, BOX_TIMES)
    everywhere = np.concatenate([teacher.splats(t).means[_solid(source, teacher, t)] for t in some])
    box = points_box(everywhere).astype(np.float32)
    near, far = depth_range([c.viewmat.astype(np.float64) for c in cameras], box, everywhere)
    background = options.background or teacher.background
    views = _pictures(teacher, poses, background, near)
    train, test = held_out(views, holdout)
    return Dataset(
        name=source, train=tuple(train), test=tuple(test),
        box=box, near=near, far=far, background=background,
        time_range=seconds_range(*normalised_times((0.0, teacher.seconds), source)[1:]), up=up, masked=False,
        points=_points(teacher, solid),
    )  # fmt: skip


def _solid(source: str, teacher: Teacher, t: float) -> np.ndarray:
    """Returns the rows of the Gaussians at time t whose opacity is at least SOLID."""
    rows = np.flatnonzero(teacher.splats(teacher.nearest(t)).opacities >= SOLID)
    if not len(rows):
        raise DataError(f"{source}: no Gaussian is as opaque as {SOLID:g} at {t:g}, expected one at least")
    return rows


def _points(teacher: Teacher, solid: np.ndarray) -> np.ndarray:
    """Returns the means float32 [M, 3] of at most POINTS of the rows `solid` at time MIDDLE."""
    rows = solid if len(solid) <= POINTS else solid[np.random.default_rng(0).permutation(len(solid))[:POINTS]]
    return teacher.splats(teacher.nearest(MIDDLE)).taken(rows).means


def _pictures(teacher: Teacher, poses: Sequence[tuple[Camera, float]], background: Triple, near: float) -> list[View]:
    """Draws the teacher for each pose at the known time nearest to the pose's, in order of time: each is read once."""
    views: dict[int, View] = {}
    for i in sorted(range(len(poses)), key=lambda i: poses[i][1]):
        camera, t = poses[i][0], teacher.nearest(poses[i][1])
        image = np.rint(picture(teacher.splats(t), camera, background, near) * 255).astype(np.uint8)
        views[i] = View(camera.viewmat, camera.K, camera.width, camera.height, t, image, None, f"{i:05d}", i)
    return [views[i] for i in range(len(poses))]


def _value(key: str, text: str) -> Any:
    """The value of a key. Raises ValueError for an invalid one."""
    if key == "cameras" and text:
        return text
    if key == "views" and 2 <= int(text) <= 100_000:
        return int(text)
    if key == "fps" and 0 < float(text) < math.inf:
        return float(text)
    if key == "background":
        return color(text)
    numbers = tuple(map(float, re.split("[x,]", text)))
    if key == "up" and len(numbers) == 3 and 0 < math.hypot(*numbers) < math.inf:
        return numbers
    if key == "size" and len(numbers) == 2 and all(v == int(v) and 8 <= v <= 8192 for v in numbers):
        return tuple(map(int, numbers))
    raise ValueError(text)


def cameras_beside(place: Path) -> Path | None:
    """The cameras.json of a model: in its folder, or one or two folders above."""
    return next((p / "cameras.json" for p in (place, *place.parents[:2]) if (p / "cameras.json").is_file()), None)


def cameras_of(place: Path, points: np.ndarray, options: Options, downscale: int = 1) -> tuple[list[Camera], Triple]:
    """Returns (cameras of a cameras.json beside the Gaussians, else cameras around `points` [n, 3]; up direction)."""
    if (beside := cameras_beside(place)) is not None:
        cameras, up = read_cameras(beside)
        some = evenly(cameras, options.views)
        return [shrunk(c, downscale * math.ceil(max(c.width, c.height) / max(options.size))) for c in some], up
    middle = np.median(points, axis=0).astype(np.float64)
    radius = max(float(np.percentile(np.linalg.norm(points - middle, axis=1), 90)), 1e-6)
    axis = np.asarray(options.up) / max(float(np.linalg.norm(options.up)), 1e-12)
    places = sphere(2 * options.views)
    places = np.stack(evenly(list(places[places @ axis >= LOWEST]), options.views))
    width, height = options.size
    focal = 0.5 * max(width, height) / math.tan(FIELD_OF_VIEW / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    like = shrunk(Camera(np.eye(4, dtype=np.float32), K, width, height), downscale)
    return [looking(middle + DISTANCE * radius * d, -d, axis, like) for d in places], options.up


# -- models ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Teacher:
    """A model that gives Gaussians at a time.

    splats: normalised time -> Gaussians. times: the known times, None if it knows all. seconds: from the first time to
    the last. background: of its training. windows: float32 [n, 3], the centre, half width and softness in normalised
    time of the window that each Gaussian's opacity has (clause 13.7); bare: `splats` without them. None: no windows.
    varies: whether other Gaussians are given at other times.
    """

    splats: Callable[[float], Splats]
    times: tuple[float, ...] | None
    seconds: float
    background: Triple = (0.0, 0.0, 0.0)
    windows: np.ndarray | None = None
    bare: Callable[[float], Splats] | None = None
    varies: bool = False

    def nearest(self, t: float) -> float:
        """Returns the known time nearest to t."""
        return t if self.times is None else min(self.times, key=lambda known: abs(known - t))


def spread(count: int) -> list[float]:
    """Returns normalised times of `count` consecutive cameras."""
    return [i * GOLDEN % 1.0 for i in range(count)]


def read_model(place: str, fps: float, seconds: float | None = None) -> Teacher:
    """Reads the teacher at a path or `module:function`. fps: frames per second of a folder. seconds: the duration of a
    model that does not say it. Raises DataError."""
    path = Path(place)
    if path.is_dir():
        if last := polynomials.last_checkpoint(path):
            return read_model(str(last), fps, seconds)
        run = read_deformed(path)
        return Teacher(run[0], None, 1.0, run[1]) if run else _still_run(path) or _folder(path, fps)
    if path.is_file():
        raw = read_file(path)
        if raw.startswith(FOURDGS):
            return _fourdgs(path, raw)
        content = torch_content(path, raw)
        if moving := polynomials.read(path, raw, content, seconds):
            return replace(_moving(*moving), background=Config.of(path.parent).background)
        splats = read_splats(path, raw, content)
        return Teacher(lambda t: splats, (0.0,), 1.0)
    if match := re.fullmatch(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)", place):
        return Teacher(_function(*match.groups()), None, 1.0)
    raise DataError(
        f"{place}: found nothing, expected a folder of PLY, SPZ, SOG or .splat files, a run, a file, or module:function"
    )


def _still_run(folder: Path) -> Teacher | None:
    """Reads the last iteration of a run of 3D Gaussian splatting, or of SpacetimeGaussians; None for other folders."""
    place = iteration(folder)
    if place is None or place == folder and len(files_of(folder, FRAME_SUFFIXES)) > 1:
        return None
    if (place / "opacity_mlp.pt").is_file() or (place / "checkpoints.pth").is_file():
        raise DataError(f"{folder}: is a run of Scaffold-GS, which becomes a checkpoint: pd4dgs-import -o model.pt")
    return replace(read_model(str(place / PLY), 1.0), background=Config.of(run_of(place)).background)


def _moving(paths: polynomials.Paths, seconds: float) -> Teacher:
    """Returns a model of polynomials and windows. Windows that show all Gaussians at all times are left out."""
    (center, half, _), bare = paths.windows.T, partial(paths.splats, bare=True)
    if (half >= np.maximum(center, 1 - center)).all():
        return Teacher(bare, None, seconds)
    return Teacher(paths.splats, None, seconds, windows=paths.windows, bare=bare)


def _folder(folder: Path, fps: float) -> Teacher:
    """Reads a folder of one file per frame, in the order of the last number in the names."""
    every = files_of(folder, FRAME_SUFFIXES)
    paths = max((files_of(folder, [suffix]) for suffix in FRAME_SUFFIXES), key=len)
    if not paths:
        raise DataError(f"{folder}: holds no file that ends in {', '.join(FRAME_SUFFIXES)}, expected one per frame")
    if len(every) > len(paths):
        left = f"{len(every) - len(paths)} of {len(every)} files are left out"
        warnings.warn(DamageWarning(f"{folder}: {left}, expected all to end in {paths[0].suffix}"), stacklevel=2)
    numbers = last_numbers(paths) or list(range(len(paths)))
    plain = [path for path in paths if last_numbers([path]) is None]
    if 0 < len(plain) < len(paths):
        raise DataError(f"{plain[0]}: has no number, expected one in the name of each frame, or in none")
    paths, numbers = [path for _, path in sorted(zip(numbers, paths, strict=True))], sorted(numbers)
    gaps = np.diff(numbers)
    if len(gaps) and (odd := np.flatnonzero(gaps != max(gaps.min(), 1))).size:
        least, before = int(gaps.min()), numbers[int(odd[0])]
        what = f"has no frame {before + least}" if least else f"has several frames {numbers[int(gaps.argmin())]}"
        raise DataError(f"{folder}: {what}, expected one for each number from {numbers[0]} to {numbers[-1]}")
    times = tuple(i / max(len(paths) - 1, 1) for i in range(len(paths)))

    frame = lru_cache(maxsize=2)(read_splats)
    return Teacher(lambda t: frame(paths[round(t * (len(paths) - 1))]), times, max(len(paths) - 1, 1) / fps)


def _fourdgs(path: Path, data: bytes) -> Teacher:
    """Reads a .4dgs file."""
    fourdgs = required("fourdgs", EXTRA, ".4dgs files")
    most = FREE_BYTES + INFLATES * len(data)
    if _numbers(data, most) > most:
        raise DataError(f"{path}: more than {most:,} numbers in a file of {len(data):,} bytes")
    try:
        with np.errstate(all="ignore"):  # `checked` drops Gaussians that are not finite
            scene = fourdgs.read(data, recover_truncated=False)
    except (fourdgs.FourdgsError, ValueError, MemoryError, OSError) as error:
        raise DataError(f"{path}: fourdgs cannot read it: {one_line(str(error), 160)}") from None
    g, seconds = scene.gaussians, float(scene.header.duration_sec)

    def parts(rows: np.ndarray | slice) -> dict[str, np.ndarray]:
        colors = g.colors[rows]
        sh = [(colors[:, None, :3] - 0.5) / SH_C0]
        if g.sh is not None and g.sh_degree:
            flat = g.sh[rows].astype(np.float32) * (2 * SH_SPAN / 255) - SH_SPAN
            sh.append(flat.reshape(len(flat), 3, flat.shape[1] // 3).transpose(0, 2, 1))
        quats, harmonics = g.rotations[rows][:, [3, 0, 1, 2]], np.concatenate(sh, axis=1)
        return dict(zip(PARTS, (g.positions[rows], quats, g.scales[rows], colors[:, 3], harmonics), strict=True))

    def splats(t: float) -> Splats:
        with np.errstate(all="ignore"):
            state = scene.state_at(min(t, 1 - 1e-6) * seconds)  # the end itself is no longer shown
        quats = state["orientations"][:, [3, 0, 1, 2]]
        moved = {"means": state["centers"], "quats": quats, "opacities": state["opacity"]}
        return checked(f"{path} at {t:g}", **parts(state["indices"]) | moved)

    if not scene.objects and 1e-6 < seconds < 1e6:
        with np.errstate(all="ignore"):
            bell, interval = np.stack([g.mu_t, g.sigma_t], axis=1), np.stack([g.win_lo, g.win_hi], axis=1)
            paths = polynomials.read_lines(
                str(path), parts(slice(None)), g.motions * seconds, bell / seconds, interval / seconds
            )
        if paths:
            return replace(_moving(paths, seconds), splats=splats)
    return Teacher(splats, None, seconds, varies=True)


def _numbers(data: bytes, most: int) -> int:
    """Counts the numbers that a .4dgs file declares before any damage. It stops counting once `most` is exceeded.

    A few bytes can declare that a number repeats 2^26 times in each stream, and fourdgs does not limit the total.
    """
    names = ("opcode", "records", "serialization", "stream_reader", "exceptions")
    op, records, files, reader, errors = (importlib.import_module(f"fourdgs.{name}") for name in names)
    total = 0
    with contextlib.suppress(errors.FourdgsError):
        for record in files.iter_records(data, len(files.MAGIC)):
            if record.opcode == op.CHUNK:
                head, packed = records.parse_chunk(record.content)
                if head.compression and head.uncompressed_size > most:
                    return int(head.uncompressed_size)
                streams = reader.chunk_stream_bytes(head, packed)
            else:
                streams = record.content[1:] if record.opcode == op.SH_BAND_STREAM else b""
            at = 0
            while at + STREAM.size <= len(streams) and total <= most:
                channels, count, size = STREAM.unpack_from(streams, at)
                total, at = total + channels * count, at + STREAM.size + size
    return total


def _function(module: str, name: str) -> Callable[[float], Splats]:
    """Imports the user's own function; its module is searched in the working folder first."""
    with contextlib.ExitStack() as stack:
        if (here := os.getcwd()) not in sys.path:
            sys.path.insert(0, here)
            stack.callback(sys.path.remove, here)
        try:
            function = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, SyntaxError) as error:
            raise DataError(f"{module}:{name}: cannot be imported: {error}") from None
        except Exception as error:  # of the module's own code
            raise DataError(f"{module}:{name}: importing it raised {type(error).__name__}: {error}") from error

    def splats(t: float) -> Splats:
        where = f"{module}:{name} at {t:g}"
        try:
            answer = function(t)
            found = answer if isinstance(answer, Mapping) else {k: getattr(answer, k, None) for k in (*PARTS, "colors")}
        except Exception as error:
            raise DataError(f"{where}: raised {type(error).__name__}: {error}") from error

        def part(key: str) -> np.ndarray:
            value = found.get(key)
            if value is not None and hasattr(value, "detach"):
                value = value.detach().cpu().numpy()
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
                raise DataError(f"{where}: {key} is {type(value).__name__}, expected an array of numbers")
            return value.astype(np.float32)

        sh = part("sh") if found.get("sh") is not None else ((np.atleast_1d(part("colors")) - 0.5) / SH_C0)[:, None]
        return checked(where, sh=sh, **{key: part(key) for key in PARTS[:4]})

    return splats
