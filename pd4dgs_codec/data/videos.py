"""Pictures of a video, decoded one after another by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DataError, one_line

#: Of width and height, and of the rate: beyond, a header lies.
MOST_SIDE, MOST_FPS = 16_384, 10_000.0


@dataclass(frozen=True)
class Video:
    """A video that opened. size: (width, height) as it is seen, turned as its maker says; fps: frames per second."""

    path: Path
    size: tuple[int, int]
    fps: float
    pictures: Generator[
        np.ndarray, None, None
    ]  #: uint8 [height, width, 3], or [height, width] in grey; to be gone through once


def open_video(path: Path, *, grey: bool = False, output: Sequence[str] = ()) -> Video:
    """The video, its first frame not decoded yet. output: further options of ffmpeg, such as a filter.

    Raises DataError of one line for what cannot be opened, and so do the pictures for what cannot be decoded.
    """
    if not path.is_file():
        raise DataError(f"{path}: found {'no file' if not path.exists() else 'no regular file'}, expected a video")
    try:
        from imageio_ffmpeg import read_frames
    except ImportError:
        raise DataError(f"{path}: videos need imageio-ffmpeg (pip install 'pd4dgs-codec[train]')") from None
    pixels: dict[str, Any] = {"pix_fmt": "gray", "bits_per_pixel": 8} if grey else {}
    reader = read_frames(str(path), output_params=list(output), **pixels)
    with _failures(path):
        meta = next(reader)
        (width, height), fps = meta["size"], float(meta["fps"])
    if not (1 <= min(width, height) <= max(width, height) <= MOST_SIDE and 0 < fps < MOST_FPS):
        reader.close()
        found = f"{width}x{height} at {fps:g} frames per second"
        raise DataError(f"{path}: {found}, expected at most {MOST_SIDE} a side and {MOST_FPS:g}")
    shape = (height, width) if grey else (height, width, 3)
    return Video(path, (width, height), fps, _pictures(reader, path, shape))


def video_size(path: Path) -> tuple[int, int]:
    """(width, height) of a video as it is seen."""
    video = open_video(path)
    video.pictures.close()
    return video.size


def _pictures(reader: Any, path: Path, shape: tuple[int, ...]) -> Generator[np.ndarray, None, None]:
    try:
        while True:
            with _failures(path):
                data = next(reader, None)
                if data is None:
                    return
                picture = np.frombuffer(data, np.uint8).reshape(shape)
            yield picture
    finally:
        reader.close()


class _failures:  # noqa: N801 - used as a statement
    """Turns what imageio-ffmpeg raises into a DataError that names the video."""

    def __init__(self, path: Path):
        self.path = path

    def __enter__(self) -> None:
        """Nothing to begin."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (OSError, RuntimeError, StopIteration, ValueError, KeyError)):
            # imageio-ffmpeg appends all that ffmpeg printed, whose last line says what is wrong
            said = str(error).strip().rpartition("\n")[2]
            raise DataError(f"{self.path}: cannot be decoded: {one_line(said, 120)}") from None
