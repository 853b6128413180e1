"""Sequences of pictures: a dataset's views or the file's own camera over time, side by side, as PNG, GIF or MP4."""

from __future__ import annotations

import contextlib
import itertools
import struct
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pd4dgs_codec.data.view import View, downscaled_matrix
from pd4dgs_codec.errors import DataError, RenderError
from pd4dgs_codec.quality.image import to_uint8
from pd4dgs_codec.scene import Camera, SceneInfo

if TYPE_CHECKING:
    from pd4dgs_codec.quality.levels import Level

#: The most pixels of a picture by a file's own camera: a .pd4 of a few bytes may declare 65,535 x 65,535.
MAX_PIXELS = 1 << 25
GAP = 4
CRF = 10  #: x264's quality in MP4: visually almost lossless
PAPER, INK = (255, 255, 255), (30, 30, 30)


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture to render. time: 0..1. truth: uint8 [H, W, 3], the dataset's image of this view, or None."""

    camera: Camera
    time: float
    truth: np.ndarray | None = None


def dataset_frames(views: Sequence[View], most: int | None = None) -> list[Frame]:
    """Returns the cameras, times and images of a dataset's views; with `most`, of at most so many, evenly spread."""
    count = min(most or len(views), len(views))
    chosen = (views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count))
    return [Frame(view.camera, view.time, view.image) for view in chosen]


def own_frames(info: SceneInfo, count: int, orbit: float = 0.0, downscale: int = 1) -> list[Frame]:
    """Returns `count` frames over the whole time from the file's camera, which orbits its look-at point by `orbit`
    degrees. Raises RenderError if the file has no camera, or its pictures exceed MAX_PIXELS."""
    if info.camera is None:
        raise RenderError("found no camera in the file, expected one, or --data SOURCE with cameras")
    camera = shrunk(info.camera, downscale)
    if camera.width * camera.height > MAX_PIXELS:
        size = f"{camera.width}x{camera.height}"
        raise RenderError(
            f"pictures of the file's camera are {size}, expected at most {MAX_PIXELS:,} pixels; "
            "use --downscale, or other cameras with --data"
        )
    times = np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(1)
    centre = look_at_point(info)
    # a full sine over the sequence: it starts and ends at the given camera pose, so that a looped video has no jump
    angles = np.radians(orbit / 2) * np.sin(2 * np.pi * times)
    return [
        Frame(turned(camera, centre, info.up, a) if a else camera, float(t)) for a, t in zip(angles, times, strict=True)
    ]


def shrunk(camera: Camera, downscale: int) -> Camera:
    """Returns the camera of an image 1/downscale as wide and high, the remainder cropped; pixel centres at +0.5."""
    if downscale == 1:
        return camera
    width, height = max(1, camera.width // downscale), max(1, camera.height // downscale)
    return replace(camera, K=downscaled_matrix(camera.K, downscale), width=width, height=height)


def look_at_point(info: SceneInfo) -> np.ndarray:
    """Returns the point of the camera's optical axis nearest to the middle of the scene's box, float64 [3], world."""
    assert info.camera is not None
    viewmat = info.camera.viewmat.astype(np.float64)
    eye, axis = -viewmat[:3, :3].T @ viewmat[:3, 3], viewmat[2, :3]
    depth = float(axis @ (info.box.astype(np.float64).mean(axis=0) - eye))
    return np.asarray(eye + max(depth, float(info.near), 1e-6) * axis)


def turned(camera: Camera, centre: np.ndarray, up: Sequence[float], angle: float) -> Camera:
    """Returns the camera rotated by `angle` radians around the axis `up` through `centre`."""
    axis = np.asarray(up, np.float64)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)  # Rodrigues
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation, centre - rotation @ centre
    viewmat = camera.viewmat.astype(np.float64) @ np.linalg.inv(world)
    return replace(camera, viewmat=viewmat.astype(np.float32))


# -- side by side, and written -----------------------------------------------------------------------------------------


class Panel(NamedTuple):
    """A picture, uint8 [h, w, 3], its caption and the milliseconds to draw it."""

    picture: np.ndarray
    caption: str
    milliseconds: float = 0.0


def level_panels(levels: Sequence[Level], frame: Frame) -> list[Panel]:
    """Draws the frame at each level."""
    panels = []
    for level in levels:
        image, milliseconds = level.timed_picture(frame.camera, frame.time)
        panels.append(Panel(to_uint8(image), level_caption(level.level, level.cumulative_bytes), milliseconds))
    return panels


def side_by_side(panels: Sequence[Panel]) -> np.ndarray:
    """Joins panels of one height, left to right on white, each under its caption; returns uint8 [h, w, 3]."""
    from PIL import Image, ImageDraw, ImageFont

    height = panels[0].picture.shape[0]
    size = int(np.clip(height / 14, 10, 28))
    font = ImageFont.load_default(size)
    band = size + 6
    width = sum(panel.picture.shape[1] for panel in panels) + GAP * (len(panels) - 1)
    sheet = Image.new("RGB", (width, height + band), PAPER)
    draw = ImageDraw.Draw(sheet)
    left = 0
    for panel in panels:
        width = panel.picture.shape[1]
        text = _fitting(panel.caption, width - 4, lambda line: draw.textlength(line, font=font))
        draw.text((left + 3, 1), text, fill=INK, font=font)
        sheet.paste(Image.fromarray(panel.picture), (left, band))
        left += width + GAP
    return np.asarray(sheet)


def stacked(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Joins pictures top to bottom, the narrower ones filled up with white; returns uint8 [h, w, 3]."""
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows])


def _fitting(text: str, width: int, length: Callable[[str], float]) -> str:
    """Cuts the end of `text` until it fits `width`, by whole words if possible."""
    while length(text) > width and text:
        text = text.rsplit(" ", 1)[0] if " " in text else text[:-1]
    return text


def level_caption(level: int, cumulative_bytes: int | None) -> str:
    """Returns a caption such as "level 1, 312 kB"."""
    if cumulative_bytes is None:
        return f"level {level}"
    size = f"{cumulative_bytes / 1e6:.2f} MB" if cumulative_bytes >= 1e6 else f"{cumulative_bytes / 1e3:.0f} kB"
    return f"level {level}, {size}"


def write_pictures(frames: Iterator[np.ndarray], paths: list[Path]) -> None:
    """Writes one uint8 [H, W, 3] frame per path."""
    from PIL import Image

    for frame, path in zip(frames, paths, strict=True):
        Image.fromarray(frame).save(path)


def write_gif(frames: Iterator[np.ndarray], path: Path, fps: float) -> None:
    """Writes a looping GIF; all frames share the palette of the first, so that still parts do not flicker. Raises
    DataError if a picture would stay for longer than a GIF can say."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    palette = images[0].quantize(256, method=Image.Quantize.MEDIANCUT)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for image in images]
    starts = [10 * round(100 * i / fps) for i in range(len(images) + 1)]  # GIF counts hundredths of a second
    durations = [stop - start for start, stop in itertools.pairwise(starts)]
    options = {"duration": durations, "loop": 0, "optimize": False}
    try:
        indexed[0].save(path, format="GIF", save_all=True, append_images=indexed[1:], **options)
    except (OverflowError, struct.error):  # of Pillow by version; it joins equal pictures
        what = f"a static image lasts too long for a .gif at {fps:g} frames per second; expected a higher rate"
        raise DataError(what) from None


def write_mp4(frames: Iterator[np.ndarray], path: Path, fps: float, *, fragment: int | None = None) -> None:
    """Writes one frame or more as H.264 in 4:2:0, which every browser plays; an odd row or column is cropped.

    fragment: for streaming, frames per fragment, each of which starts with a key frame; None for a plain file. Raises
    RenderError without ffmpeg, DataError if ffmpeg cannot write the whole file.
    """
    check_mp4()
    movflags = "+frag_keyframe+empty_moov+default_base_moof"
    options = ["-g", str(fragment), "-sc_threshold", "0", "-bf", "0", "-movflags", movflags] if fragment else []
    first = next(frames)
    height, width = (size // 2 * 2 for size in first.shape[:2])
    if min(height, width) < 2:
        raise RenderError(f"the camera has {first.shape[1]}x{first.shape[0]} pixels, expected at least 2x2 for a video")
    rate = str(Fraction(fps).limit_denominator())
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate]
    coding = ["-an", "-c:v", "libx264", "-crf", str(CRF), "-pix_fmt", "yuv420p", "-y"]
    from pd4dgs_codec.data.videos import ffmpeg, file_url  # with the readers of datasets, which pictures do not need

    with ffmpeg([*source, "-i", "-", *coding, *options, "-f", "mp4", file_url(path)], stdin=subprocess.PIPE) as run:
        assert run.process.stdin is not None
        with contextlib.suppress(BrokenPipeError), run.process.stdin as pipe:  # ffmpeg ended, and reports why
            for frame in itertools.chain([first], frames):
                pipe.write(np.ascontiguousarray(frame[:height, :width]).data)
        code, said = run.end()
        if code or said:
            raise DataError(f"{path.name}: ffmpeg cannot write it: {said or f'exit code {code}'}")


def check_mp4() -> None:
    """Raises RenderError if MP4 cannot be written here; called before frames are rendered."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise RenderError(
            "writing .mp4 needs imageio-ffmpeg with its ffmpeg program; install it or write .gif or .png"
        ) from None
