"""Choice of frames from a recording: spread over its time, sharp, and each different from the one before."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.files import check_downscale, image_info, last_numbers, read_image, shrink_image
from pd4dgs_codec.data.videos import open_video
from pd4dgs_codec.errors import DataError

#: Called after each item.
Advance = Callable[[], None]
#: (number of items or None, their name, the stage) -> an Advance for that stage.
Progress = Callable[[int | None, str, str], AbstractContextManager[Advance]]

#: Largest width at which sharpness and change are measured, pixels.
LOOK_WIDTH = 640
#: A frame is blurred if its sharpness is below BLURRED times the median of AROUND frames on either side.
BLURRED, AROUND = 0.4, 15
#: A frame repeats the one before if their mean difference is below this, 8-bit levels. Video coding causes less.
SAME = 0.3
#: Most frames of a recording, an hour at 60 per second; and the fewest for a pose estimate.
MOST_FRAMES, FEWEST_FRAMES = 216_000, 8
PICTURES = {".png", ".jpg", ".jpeg"}


@dataclass(frozen=True)
class Look:
    """Measurements of a frame.

    index: in the recording. time: seconds. sharpness: variance of the Laplacian, squared 8-bit levels. change: mean
    difference from the frame before, 8-bit levels, infinite for the first.
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
        self.path, self.size, self.fps = path, video.size, video.fps

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
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in PICTURES]
        if not files:
            raise DataError(f"{path}: found no picture, expected frames as {', '.join(sorted(PICTURES))}")
        numbered = dict(zip(last_numbers(files) or range(len(files)), files, strict=True))
        if len(numbered) < len(files):
            raise DataError(f"{path}: two pictures have the same number, expected one per frame")
        self.numbers = sorted(numbered)
        self.path, self.files, self.fps = path, [numbered[number] for number in self.numbers], fps
        self.size = image_info(self.files[0])[:2]

    def looks(self) -> Iterator[np.ndarray]:
        k = max(1, -(-self.size[0] // LOOK_WIDTH))
        for file in self.files:
            yield read_image(file, self.size, downscale=k).mean(axis=2).astype(np.uint8)

    def pictures(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Yields uint8 [H, W, 3] of these frames."""
        for k in indices:
            yield read_image(self.files[k], self.size)

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
    before: np.ndarray | None = None
    for index, small in enumerate(recording.looks()):
        if index >= MOST_FRAMES:
            raise DataError(f"{recording.path}: more than {MOST_FRAMES:,} frames, expected a shorter recording")
        picture = small.astype(np.float32)
        change = float("inf") if before is None else float(np.abs(picture - before).mean())
        looks.append(Look(index, recording.time(index), sharpness(picture), change))
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
