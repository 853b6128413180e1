"""`prepare` turns a recording into a folder with pictures, times, a COLMAP model and a report, stage by stage.

Work is done in `FOLDER.partial`, which becomes FOLDER at the end. After an interruption the same call resumes from it;
a failure removes it. The chosen frames are spread over the recording's time, sharp, and each different from the one
before.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, astuple, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import (
    PICTURES,
    check_downscale,
    files_of,
    image_info,
    last_numbers,
    read_image,
    shrink_image,
)
from pd4dgs_codec.data.videos import open_video
from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.io import check_path, finite, lock, write_bytes
from pd4dgs_codec.prepare import FEWEST_FRAMES, poses
from pd4dgs_codec.prepare.poses import Advance, Features
from pd4dgs_codec.signals import held
from pd4dgs_codec.threads import available

#: (number of items or None, their name, the stage) -> an Advance for that stage.
Progress = Callable[[int | None, str, str], AbstractContextManager[Advance]]

#: Largest width at which sharpness and change are measured, pixels.
LOOK_WIDTH = 640
#: A frame is blurred if its sharpness is below BLURRED times the median of AROUND frames on either side.
BLURRED, AROUND = 0.4, 15
#: A frame repeats an earlier one if their mean difference is below this, 8-bit levels. Video coding causes less.
SAME = 0.3
#: Most frames of a recording, an hour at 60 per second.
MOST_FRAMES = 216_000
STATE, REPORT = "prepare.json", "report.json"
#: Thresholds of advice: share of frames, pixels of a picture 1000 wide, points a picture, degrees, share of features.
MANY_BLURRED, MANY_LOST, LARGE_ERROR, FEW_POINTS, SMALL_ANGLE, MUCH_MOVES = 0.2, 0.05, 2.0, 50, 4.0, 0.4
#: Points whose angles are measured, and pictures in report.png.
POINTS, SHOWN = 2000, 6


@dataclass(frozen=True)
class Options:
    """Options of `prepare`.

    frames: most frames to choose, 0 for all. fps: of a folder of frames. downscale: side of the blocks over which
    pictures are averaged, pixels. camera: COLMAP's model. threads: -1 for all cores.
    """

    frames: int
    fps: float
    downscale: int
    camera: str
    threads: int


def prepare(
    source: Path,
    output: Path,
    options: Options,
    progress: Progress,
    overwrite: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Writes the folder `output` and returns its report. tell: called with a time estimate before the poses.
    Raises DataError, and leaves nothing behind, if no poses are found."""
    poses.colmap()  # raises now if it is not installed
    check_folder(output, overwrite)
    recording = open_recording(source, options.fps)
    work = output.with_name(f"{output.name}.partial")
    with _begun(work, recording, options):
        try:
            looks, choice, times = _frames(work, recording, options, progress)
            cores = options.threads if options.threads > 0 else available()
            width, height = (side // options.downscale for side in recording.size)
            seconds = poses.estimate(len(times), (width, height), cores)
            tell(f"the poses of {len(times)} frames take up to {max(1, round(seconds / 60))} min on {cores} cores")
            findings = _poses(work, times, options, progress)
            result = _finish(work, findings, looks, choice, times, recording.path)
        except (DataError, OSError):
            shutil.rmtree(work, ignore_errors=True)
            raise
        except (RuntimeError, ValueError) as error:  # of pycolmap and SQLite, on a full disk for example
            shutil.rmtree(work, ignore_errors=True)
            raise DataError(f"{recording.path}: COLMAP failed: {one_line(str(error), 160)}") from None
        check_folder(output, overwrite)  # it may have appeared meanwhile
        with held():
            if output.exists():
                os.chmod(work, stat.S_IMODE(output.stat().st_mode))
                shutil.rmtree(output)
            os.replace(work, output)
        return result


def check_folder(output: Path, overwrite: bool) -> None:
    """Raises DataError for an output that cannot be written, or exists and was not made by `prepare`."""
    check_path(output)
    if output.name in ("", ".."):
        raise DataError(f"{output}: has no name of its own, expected the name of an output folder")
    if output.is_symlink():
        raise DataError(f"{output}: found a link, expected a folder or nothing")
    if output.exists() and not (overwrite and (output / REPORT).is_file() and (output / "sparse").is_dir()):
        how = "expected an output of pd4dgs-prepare" if overwrite else "--overwrite replaces an earlier output"
        raise DataError(f"{output}: exists already; {how}")
    if not output.resolve().parent.is_dir():
        raise DataError(f"{output}: there is no folder {output.parent} to write into")
    if not os.access(output.resolve().parent, os.W_OK):
        raise DataError(f"{output}: no permission to write here")


@contextmanager
def _begun(work: Path, recording: Recording, options: Options) -> Iterator[None]:
    """Keeps the work of an earlier run with the same recording and options, else begins anew. Raises DataError if
    another process is at work in the folder."""
    stats = [path.stat() for path in {recording.path, *recording.files}]  # a folder's own time is that of its names
    asked = {"source": str(recording.path.resolve()), "size": sum(each.st_size for each in stats)}
    asked |= {"changed": max(each.st_mtime_ns for each in stats)}
    asked |= {name: value for name, value in asdict(options).items() if name != "threads"}
    state = work / STATE
    if work.exists() and not state.is_file():
        raise DataError(f"{work}: exists already, expected nothing here or the partial output of an earlier run")
    work.mkdir(exist_ok=True)
    with state.open("a+b") as stream:
        try:
            lock(stream)
        except OSError:
            raise DataError(f"{work}: another process is at work here, expected another output or its end") from None
        stream.seek(0)
        try:
            same = json.loads(stream.read()) == asked
        except (ValueError, RecursionError):  # empty, if it is new
            same = False
        if not same:
            for path in set(work.iterdir()) - {state}:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            stream.truncate(0)
            stream.write(json.dumps(asked).encode())
            stream.flush()
        if os.name == "nt":
            stream.close()  # else the folder could not be renamed
        yield


def _frames(
    work: Path, recording: Recording, options: Options, progress: Progress
) -> tuple[list[Look], Choice, dict[str, float]]:
    """Writes the chosen frames to images/ once. Returns (measurements of all frames, choice, seconds by file name)."""
    done, images = work / "frames.json", work / "images"
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):  # absent or damaged: made anew
        stored = json.loads(done.read_bytes())
        looks = [Look(i, t, sharp, float("inf") if i == 0 else change) for i, t, sharp, change in stored["looks"]]
        times = {name: float(time) for name, time in dict(stored["times"]).items()}
        if times and times.keys() <= set(os.listdir(images)):
            return looks, Choice(*map(tuple, stored["choice"])), times
    with progress(None, "frames", "measuring") as advance:
        looks = look(recording, advance)
    choice = choose(looks, options.frames)
    if len(choice.chosen) < FEWEST_FRAMES:
        found = f"{len(choice.blurred)} blurred and {len(choice.repeated)} repeated of {len(looks)} frames"
        raise DataError(f"{recording.path}: {found} leave {len(choice.chosen)}, expected at least {FEWEST_FRAMES}")
    shutil.rmtree(images, ignore_errors=True)
    images.mkdir()
    with progress(len(choice.chosen), "frames", "writing") as advance:
        times = write_frames(recording, choice.chosen, images, options.downscale, advance)
    content = {"looks": [astuple(each) for each in looks], "choice": astuple(choice), "times": times}
    write_bytes(done, json.dumps(finite(content)).encode(), overwrite=True)
    return looks, choice, times


def _poses(work: Path, times: dict[str, float], options: Options, progress: Progress) -> Findings:
    """Estimates the poses and writes the model without moving features to sparse/0. Raises DataError for a camera that
    stands still, or too few poses."""
    names, images, database = sorted(times), work / "images", work / "colmap.db"
    with progress(len(names), "frames", "features") as advance:
        poses.extract(database, images, names, options.camera, options.threads, advance)
    listed = poses.pairs(len(names))
    with progress(len(listed), "pairs", "matching") as advance:
        poses.match(database, names, listed, options.threads, advance)
    travel, width = poses.travel(database), image_info(images / names[0])[0]
    if 0 <= travel < poses.STILL * width / 1000:  # without any pair of frames, the model below says more
        found = f"static points move by at most {travel:.1f} pixels between frames"
        raise DataError(f"the camera stands still: {found}; expected a camera that moves around the scene")
    with progress(None, "frames", "poses") as advance:
        model = poses.reconstruct(database, images, work / "models", options.threads, advance)
    posed = 0 if model is None else model.num_reg_images()
    least = max(FEWEST_FRAMES, math.ceil(poses.LEAST_SHARE * len(names)))
    if model is None or posed < least:
        raise DataError(
            f"found camera poses for {posed} of {len(names)} frames, expected at least {least}; "
            "record static, textured objects with a camera that moves slowly and sideways"
        )
    features = poses.moving_features(database, model)
    named = [image for image in model.images.values() if image.name in features]
    moving = {image.name: features[image.name].moving(image.camera.width) for image in named}
    poses.leave_out(model, moving)
    poses.upright(model)
    poses.write(model, work / "sparse" / "0")
    return Findings(model, features, moving)


def _finish(
    work: Path, findings: Findings, looks: list[Look], choice: Choice, times: dict[str, float], source: Path
) -> dict[str, Any]:
    """Writes times.txt and the report, and removes intermediate files."""
    named = {image.name for image in findings.model.images.values() if image.has_pose}
    (work / "times.txt").write_text("".join(f"{name} {times[name]:.6f}\n" for name in sorted(named)))
    result = numbers(findings, looks, choice, times)
    result["source"] = source.name
    result["advice"] = advice(result)
    draw(findings, looks, choice, times, work / "images", work / "report.png")
    write_bytes(work / REPORT, json.dumps(finite(result), indent=1).encode(), overwrite=True)
    for name in sorted(set(times) - named):
        (work / "images" / name).unlink()
    shutil.rmtree(work / "models", ignore_errors=True)
    for name in ("colmap.db", "frames.json", STATE):
        (work / name).unlink(missing_ok=True)
    return result


# -- frames ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """Measurements of a frame.

    index: in the recording. time: seconds. sharpness: variance of the Laplacian, squared 8-bit levels. change: mean
    difference from the last frame that does not repeat another, 8-bit levels, infinite for the first.
    """

    index: int
    time: float
    sharpness: float
    change: float


@dataclass(frozen=True)
class Choice:
    """Ascending indices of the frames that are chosen, left out as blurred, and left out as repeated."""

    chosen: tuple[int, ...]
    blurred: tuple[int, ...]
    repeated: tuple[int, ...]


class VideoFile:
    """A video at its mean frame rate: frame k has time k / fps. Where a phone's rate varies, ffmpeg repeats or drops
    frames."""

    def __init__(self, path: Path):
        video = open_video(path)
        self.path, self.files, self.size, self.fps = path, [path], video.size, video.fps

    def looks(self) -> Iterator[np.ndarray]:
        """Yields every frame, small and grey, uint8 [h, w]."""
        width = min(self.size[0], LOOK_WIDTH)
        scale = f"scale={width}:{max(1, round(self.size[1] * width / self.size[0]))}:flags=area"
        return open_video(self.path, grey=True, output=self._filters(f",{scale}")).pictures

    def pictures(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Yields uint8 [H, W, 3] of these frames. indices: ascending."""
        wanted = set(indices)
        for k, picture in enumerate(open_video(self.path, output=self._filters()).pictures):
            if k in wanted:
                yield picture
            if k >= indices[-1]:
                return

    def time(self, index: int) -> float:
        """The time of a frame, seconds."""
        return index / self.fps

    def _filters(self, more: str = "") -> list[str]:
        """Options that select the frames nearest in time: ffmpeg's cfr may be more than a frame late."""
        return ["-vf", f"fps={self.fps:.6f}{more}", "-fps_mode", "passthrough"]


class FrameFolder:
    """A folder of pictures of one size, in the order of the last number in their names, at `fps` numbers per second."""

    def __init__(self, path: Path, fps: float):
        files = files_of(path, PICTURES)
        if not files:
            raise DataError(f"{path}: found no picture, expected frames as {', '.join(PICTURES)}")
        numbered = dict(zip(last_numbers(files) or range(len(files)), files, strict=True))
        if len(numbered) < len(files):
            raise DataError(f"{path}: two pictures have the same number, expected one per frame")
        self.numbers = sorted(numbered)
        self.path, self.files, self.fps = path, [numbered[number] for number in self.numbers], fps
        self.size = image_info(self.files[0], upright=True)[:2]

    def looks(self) -> Iterator[np.ndarray]:
        k = max(1, -(-self.size[0] // LOOK_WIDTH))
        for file in self.files:
            yield read_image(file, self.size, downscale=k, upright=True).mean(axis=2).astype(np.uint8)

    def pictures(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Yields uint8 [H, W, 3] of these frames."""
        for k in indices:
            yield read_image(self.files[k], self.size, upright=True)

    def time(self, index: int) -> float:
        """The time of a frame after the first one, seconds."""
        return (self.numbers[index] - self.numbers[0]) / self.fps


Recording = VideoFile | FrameFolder


def open_recording(path: Path, fps: float) -> Recording:
    """Opens a video, or a folder of frames at `fps` per second. Raises DataError for anything else."""
    if path.is_dir():
        return FrameFolder(path, fps)
    if not path.exists():
        raise DataError(f"{path}: found nothing, expected a video or a folder of frames")
    return VideoFile(path)


def look(recording: Recording, advance: Advance) -> list[Look]:
    """Measures every frame. Raises DataError for too few or too many."""
    looks: list[Look] = []
    before: np.ndarray | None = None  # small steps, as in slow motion, add up to a change
    for index, small in enumerate(recording.looks()):
        if index >= MOST_FRAMES:
            raise DataError(f"{recording.path}: more than {MOST_FRAMES:,} frames, expected a shorter recording")
        picture = small.astype(np.float32)
        change = float("inf") if before is None else float(np.abs(picture - before).mean())
        looks.append(Look(index, recording.time(index), sharpness(picture), change))
        if change >= SAME:
            before = picture
        advance()
    if len(looks) < FEWEST_FRAMES:
        raise DataError(f"{recording.path}: {len(looks)} frames, expected at least {FEWEST_FRAMES}")
    return looks


def sharpness(picture: np.ndarray) -> float:
    """Variance of the Laplacian of float32 [h, w] (Pech-Pacheco et al., ICPR 2000)."""
    if min(picture.shape) < 3:
        return 0.0
    middle = picture[1:-1, 1:-1]
    around = picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:]
    return float((around - 4 * middle).var())


def choose(looks: Sequence[Look], count: int) -> Choice:
    """Chooses the sharpest usable frame of each of `count` equal stretches; all usable frames for count 0."""
    sharp = np.array([frame.sharpness for frame in looks])
    usual = np.array([np.median(sharp[max(0, i - AROUND) : i + AROUND + 1]) for i in range(len(sharp))])
    is_blurred = sharp < BLURRED * usual
    is_repeated = np.array([frame.change < SAME for frame in looks])
    usable = np.flatnonzero(~is_blurred & ~is_repeated)
    stretches = np.array_split(np.arange(len(looks)), count) if 0 < count < len(usable) else usable[:, None]
    left = [stretch[np.isin(stretch, usable)] for stretch in stretches]
    chosen = [int(stretch[np.argmax(sharp[stretch])]) for stretch in left if len(stretch)]
    repeated = is_repeated & ~is_blurred
    return Choice(tuple(chosen), *(tuple(map(int, np.flatnonzero(which))) for which in (is_blurred, repeated)))


def write_frames(
    recording: Recording, indices: Sequence[int], folder: Path, downscale: int, advance: Advance
) -> dict[str, float]:
    """Writes these frames as PNG, averaged over blocks of downscale x downscale. Returns seconds by file name."""
    from PIL import Image

    check_downscale(recording.size, downscale, str(recording.path))
    times: dict[str, float] = {}
    for index, picture in zip(indices, recording.pictures(indices), strict=False):
        name = f"frame_{index:06d}.png"
        Image.fromarray(shrink_image(picture, downscale)).save(folder / name, compress_level=1)
        times[name] = recording.time(index)
        advance()
    if len(times) < len(indices):
        raise DataError(
            f"{recording.path}: {len(times)} of {len(indices)} chosen frames could be read again, expected all"
        )
    return times


# -- report ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Findings:
    """model: a pycolmap.Reconstruction. features, moving: by name of each picture with a pose, the match counts of its
    features, and bool [n]: whether a feature moves."""

    model: Any
    features: Mapping[str, Features]
    moving: Mapping[str, np.ndarray]

    @cached_property
    def errors(self) -> dict[int, float]:
        """Mean reprojection error of each picture's points, pixels, by the picture's number."""
        errors = {}
        for image in self.model.images.values():
            seen = [point for point in image.points2D if point.has_point3D()] if image.has_pose else []
            if not seen:
                continue
            world = np.array([self.model.point3D(point.point3D_id).xyz for point in seen])
            camera, pose = self.model.camera(image.camera_id), image.cam_from_world().matrix()
            projected = camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
            gaps = projected - np.array([point.xy for point in seen])
            errors[image.image_id] = float(np.nanmean(np.hypot(gaps[:, 0], gaps[:, 1])))
        return errors


def numbers(findings: Findings, looks: Sequence[Look], choice: Choice, times: Mapping[str, float]) -> dict[str, Any]:
    """The report for report.json. Errors are in pixels of the written pictures."""
    model = findings.model
    registered = {image.name: image for image in model.images.values() if image.has_pose}
    camera = next(iter(model.cameras.values()))
    moving = {name: int(each.sum()) for name, each in findings.moving.items()}
    rows = []
    for name in sorted(times):
        row: dict[str, Any] = {"name": name, "seconds": times[name], "pose": name in registered}
        if image := registered.get(name):
            row |= {"points": image.num_points3D, "reprojection_error": findings.errors.get(image.image_id)}
            row["moving_features"] = moving.get(name, 0)
        rows.append(row)
    counts = {"seen": looks, "blurred": choice.blurred, "repeated": choice.repeated, "chosen": choice.chosen}
    parameters = dict(zip(camera.params_info.split(", "), camera.params.tolist(), strict=True))
    size = {"model": camera.model.name, "width": camera.width, "height": camera.height}
    return {
        "frames": {name: len(frames) for name, frames in counts.items()} | {"registered": len(registered)},
        "seconds": looks[-1].time - looks[0].time,
        "camera": size | {"parameters": parameters},
        "points": model.num_points3D(),
        "reprojection_error": float(model.compute_mean_reprojection_error()),
        "points_per_picture": float(np.median([image.num_points3D for image in registered.values()])),
        "angle_degrees": _angle(model),
        "moving_share": sum(moving.values()) / max(sum(map(len, findings.moving.values())), 1),
        "pictures": rows,
    }


def _angle(model: Any) -> float:
    """Median over points of the widest angle between two of the rays that see them, degrees."""
    centers = {key: model.image(key).projection_center() for key in model.reg_image_ids()}
    angles = []
    points = list(model.points3D.values())
    for point in points[:: max(1, len(points) // POINTS)]:
        rays = np.array([centers[each.image_id] for each in point.track.elements]) - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min()))))
    return float(np.median(angles)) if angles else 0.0


def advice(report: Mapping[str, Any]) -> list[str]:
    """Hints for a better recording, a line each."""
    lines, frames, error = [], report["frames"], report["reprojection_error"]
    points, angle, moving = (report[key] for key in ("points_per_picture", "angle_degrees", "moving_share"))
    if frames["blurred"] > MANY_BLURRED * frames["seen"]:
        lines.append(f"{frames['blurred']} of {frames['seen']} frames are blurred: move slower or use more light")
    lost = [row["seconds"] for row in report["pictures"] if not row["pose"]]
    if len(lost) > MANY_LOST * frames["chosen"]:
        found = f"{len(lost)} of {frames['chosen']} frames have no pose, between {lost[0]:.1f} and {lost[-1]:.1f} s"
        lines.append(f"{found}: turn and move slower there")
    if error * 1000 > LARGE_ERROR * report["camera"]["width"]:
        lines.append(f"reprojection error {error:.2f} pixels: lock zoom and focus, and switch stabilisation off")
    if points < FEW_POINTS:
        lines.append(f"{points:.0f} points per picture: record textured static objects around the moving ones")
    if angle < SMALL_ANGLE:
        lines.append(
            f"triangulation angle {angle:.1f} degrees: walk around the scene; turning on the spot shows no depth"
        )
    if moving > MUCH_MOVES:
        lines.append(f"{100 * moving:.0f} % of the features move: stand back, so that more of the picture is static")
    return lines


def draw(
    findings: Findings, looks: Sequence[Look], choice: Choice, times: Mapping[str, float], images: Path, path: Path
) -> None:
    """Draws report.png: the camera's path from above, errors, sharpness, and pictures with static features in green and
    moving ones in red."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    model, errors = findings.model, findings.errors
    posed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    seconds = [times[image.name] for image in posed]
    figure = pyplot.figure(figsize=(13, 11))
    top = figure.add_subplot(3, 3, 1)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    centers = np.array([image.projection_center() for image in posed])
    low, high = np.percentile(np.concatenate([points, centers]), [1, 99], axis=0)
    top.plot(points[:, 0], points[:, 2], ",", color="grey")
    top.plot(centers[:, 0], centers[:, 2], ".-", color="tab:blue", markersize=3)
    span, middle = 0.6 * max((high - low)[[0, 2]]), (low + high) / 2
    x, z = ((middle[axis] - span, middle[axis] + span) for axis in (0, 2))
    top.set(xlim=x, ylim=z, aspect="equal", title="camera path and points, from above")
    left = figure.add_subplot(3, 3, 2)
    left.plot(seconds, [errors.get(image.image_id, np.nan) for image in posed], ".-")
    left.set(title="reprojection error, pixels", xlabel="seconds")
    right = figure.add_subplot(3, 3, 3)
    for which, style in ((range(len(looks)), "-"), (choice.chosen, "g."), (choice.blurred, "rx")):
        right.semilogy([looks[i].time for i in which], [looks[i].sharpness for i in which], style)
    right.set(title="sharpness; green: chosen, red: blurred", xlabel="seconds")
    for k, at in enumerate(np.linspace(0, len(posed) - 1, SHOWN).round().astype(int)):
        name = posed[at].name
        axis = figure.add_subplot(3, 3, 4 + k)
        with Image.open(images / name) as picture:
            axis.imshow(picture)
        if name in findings.features:
            features, moves = findings.features[name], findings.moving[name]
            axis.plot(*features.keypoints[~moves & features.known].T, ",", color="lime")
            axis.plot(*features.keypoints[moves].T, ".", color="red", markersize=3)
        axis.set_title(f"{seconds[at]:.2f} s", fontsize=8)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)
