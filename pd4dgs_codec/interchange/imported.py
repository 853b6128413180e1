"""Another program's model -> a `.pd4` file, with its quality against the model's own renderings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.view import depth_range, held_out, points_box, seconds_range
from pd4dgs_codec.errors import DataError, EncodeError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import Report, encode_with_report, with_metadata
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.interchange.direct import Packer, mean_psnr
from pd4dgs_codec.interchange.pack import matched
from pd4dgs_codec.interchange.sampled import Sampled, sampled
from pd4dgs_codec.interchange.splats import evenly, picture
from pd4dgs_codec.interchange.teacher import GOLDEN, SOLID, Options, Teacher, cameras_beside, cameras_of, read_model
from pd4dgs_codec.kinds.splats import Splats, SplatScene
from pd4dgs_codec.scene import Camera, SceneInfo
from pd4dgs_codec.threads import one_blas_thread

#: Cameras; of so many of them one measures the result and decides nothing. Width and height of a dome's pictures.
CAMERAS, HOLDOUT, SIZE = 72, 6, 400
FPS = 30.0  #: frames per second of a folder that does not say it
BOX_INSTANTS = 5  #: number of instants whose Gaussians the box encloses
FULL = 0.98  #: the share of a target size that is looked for
METADATA_ROOM = 150  #: bytes of metadata without texts, at most
GROWTH = 0.07  #: the change of the logarithm of bytes by dB, about
FAR = 2.0  #: dB by which a result may be below what was asked for without a note

Progress = Callable[[str, "int | None"], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class Imported:
    """A file. psnr: mean over `views` pictures in dB against the source's, by level. gaussians: in the file; left_out:
    those of the source that no view needs. instants, static, order, matched: see `Sampled`."""

    data: bytes
    report: Report
    psnr: dict[int, float]
    views: int
    gaussians: int
    left_out: int
    instants: int
    static: float
    order: str
    matched: float

    def json(self) -> dict[str, Any]:
        """The report, with what was read and measured."""
        names = ("psnr", "views", "gaussians", "instants", "static", "order", "matched")
        measured = {name: getattr(self, name) for name in names}
        return self.report.json() | measured | {"gaussians_left_out": self.left_out}


@one_blas_thread()
def import_model(
    place: str,
    *,
    psnr: float,
    most_bytes: int | None = None,
    slices: int | None = None,
    fps: float | None = None,
    seconds: float | None = None,
    background: tuple[float, float, float] | None = None,
    up: tuple[float, float, float] | None = None,
    metadata: Metadata | None = None,
    tell: Callable[[str], None],
    progress: Progress,
) -> Imported:
    """Packs the model at `place`, see `teacher.read_model`, for `psnr` dB, or with most_bytes for so many bytes.

    fps: frames per second of a folder, FPS by default. seconds: the duration instead. tell: gets lines about what was
    read. progress: (task, number of steps or None) -> a context whose value is called after each step. Raises
    DataError, EncodeError.
    """
    model = read_model(place, fps or FPS, seconds)
    if fps and not model.varies and len(model.times or ()) < 2:
        raise DataError(f"{place}: found --fps for a source without frames; --seconds sets the duration of what moves")
    with progress("reading", None if model.times is None else len(model.times)) as step:
        source = sampled(model, place, fps or FPS, step)
    instants, count = source.means.shape[:2]
    about, seconds = metadata or Metadata(), seconds or model.seconds
    static = float(source.static.mean())
    tell(f"{place}: {_about(source, seconds, static)}; seen by {seen_by(place)}")
    some = [source.frame(i, bare=False) for i in evenly(range(instants), BOX_INSTANTS)]
    info, cameras, judges = scene_info(place, model, some, seconds, background, up)
    with progress("packing", None) as step:
        packer = Packer(model, source, cameras, info, step)

        def write(scene: SplatScene) -> tuple[bytes, Report]:
            made = encode_with_report(scene, slices=slices)
            step()
            return made

        if most_bytes is None:
            data, report = write(packer.matched(psnr))
        else:
            room = most_bytes - METADATA_ROOM - sum(len(str(text)) for text in vars(about).values())
            data, report = _of_size(lambda theta: write(packer.scene(theta)), packer.guess(psnr), room)
    scene = decode(data)
    assert isinstance(scene, SplatScene)
    with progress("measuring", len(judges)) as step:
        quality = _quality(model, scene, judges, step)
    if most_bytes is None and (found := quality[scene.level]) < psnr - FAR:
        tell(f"note: has {found:.1f} dB, not {psnr:g}: these cameras and instants show more than those that decided")
    data, size = with_metadata(data, replace(about, quality=quality))
    report = replace(report, bytes=len(data), metadata_bytes=size)
    return Imported(
        data, report, quality, len(judges), len(scene.anchor_q), count - len(scene.anchor_q), instants, static,
        source.order, source.matched,
    )  # fmt: skip


def _about(source: Sampled, seconds: float, static: float) -> str:
    instants, count = source.means.shape[:2]
    degree = math.isqrt(source.rest.shape[1] + 1) - 1
    if instants == 1:
        return f"{count:,} Gaussians, harmonics of degree {degree}, static"
    times = f"{instants} instants in {seconds:.3g} s"
    return f"{count:,} Gaussians, harmonics of degree {degree}, {times}, {source.order}, {static:.0%} static"


def seen_by(place: str) -> str:
    """Names the cameras that decide and measure."""
    beside = cameras_beside(Path(place))
    return f"{CAMERAS} cameras around it" if beside is None else f"the cameras of {beside}"


def scene_info(
    place: str, model: Teacher, some: Sequence[Splats], seconds: float, background: Any, up: Any
) -> tuple[SceneInfo, list[Camera], list[tuple[Camera, float]]]:
    """Returns (info but the voxel size, cameras that decide, cameras and times that measure). some: the Gaussians at
    some instants, at one if nothing moves."""
    everywhere = np.concatenate([frame.means[frame.opacities >= SOLID] for frame in some])
    if not len(everywhere):
        everywhere = np.concatenate([frame.means for frame in some])
    options = Options(views=CAMERAS, size=(SIZE, SIZE))
    cameras, level = cameras_of(Path(place), everywhere, replace(options, up=up) if up else options)
    near, far = depth_range([c.viewmat.astype(np.float64) for c in cameras], points_box(everywhere), everywhere)
    times = seconds_range(0.0, seconds) if len(some) > 1 else (0.0, 1.0)
    box, behind = points_box(everywhere).astype(np.float32), background or model.background
    near, far = (float(np.float32(x)) for x in (near, far))
    fitting, others = held_out(cameras, HOLDOUT)
    judges = [(camera, model.nearest((i + 0.5) * GOLDEN % 1.0)) for i, camera in enumerate(others or fitting)]
    axis = np.asarray(up or level)  # the default camera looks in the usual direction, a little downwards
    ahead = np.array([0.0, 0.0, 1.0]) - 0.3 * axis / max(float(np.linalg.norm(axis)), 1e-12)
    front = max(cameras, key=lambda camera: float(camera.viewmat[2, :3] @ ahead))
    return SceneInfo(1.0, box, times, behind, near, far, up or level, 0.0, front), fitting, judges


def _of_size(write: Callable[[float], tuple[bytes, Report]], theta: float, most: int) -> tuple[bytes, Report]:
    """Returns the largest file tried that has at most `most` bytes. Raises EncodeError if there is none."""
    tried = list[tuple[bytes, Report]]()

    def build(theta: float) -> tuple[None, float]:
        tried.append(write(theta))
        return None, math.log(len(tried[-1][0]) / (most * FULL)) / GROWTH

    matched(build, theta)
    fitting = [made for made in tried if len(made[0]) <= most]
    if not fitting:
        found = min(len(data) for data, _ in tried)
        raise EncodeError(
            f"target size: the smallest file tried takes {found:,} bytes, expected {most:,}, less metadata"
        )
    return max(fitting, key=lambda made: len(made[0]))


def _quality(
    model: Teacher, scene: SplatScene, judges: list[tuple[Camera, float]], step: Callable[[], None]
) -> dict[int, float]:
    """Returns the mean PSNR in dB of each level against the source's own pictures."""
    views = []
    for camera, t in judges:
        views.append((camera, t, picture(model.splats(t), camera, scene.info.background, scene.info.near)))
        step()
    return {level: mean_psnr(scene.prefix(level), views) for level in scene.layers}
