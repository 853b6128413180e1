"""Videos: decoding by the ffmpeg of imageio-ffmpeg, a cache of decoded frames, and datasets of synchronised videos.

The cache stores each frame losslessly and on its own: differences between neighbours in a row, compressed by zstd. Its
folder is PD4DGS_CACHE, by default ~/.cache/pd4dgs-frames. It holds up to PD4DGS_CACHE_GIB (default 20) and removes the
least recently used videos first.
"""

import errno
import hashlib
import json
import logging
import math
import os
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from pd4dgs_codec.data.files import check_downscale, check_pixels, check_regular, shrink_image
from pd4dgs_codec.data.view import Dataset, LaterView, Origin, UnreadView, View, geometry, rectify, without_first_camera
from pd4dgs_codec.errors import DamageWarning, DataError, one_line
from pd4dgs_codec.io import PREFIX, lock, temporary_folder

#: ffmpeg's readers of videos that are one file; others open further files, such as a playlist's, or draw pictures.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg,asf,flv"
ONE_FILE = ("-protocol_whitelist", "file", "-format_whitelist", CONTAINERS)
#: Largest width or height, and frames per second: beyond them the header is wrong.
MAX_SIDE, MAX_FPS = 16_384, 10_000.0
#: A damaged video is refused if it lacks more than this share of the frames that its header promises, and one.
SHORT = 0.01
LAST_BYTES = 4096  #: of ffmpeg's errors that are read
FOLDER, SIZE, DEFAULT_GIB = "PD4DGS_CACHE", "PD4DGS_CACHE_GIB", 20.0
#: Version of the layout of cache files: frames, the index as JSON, and the length of the index in LENGTH bytes.
VERSION, LENGTH = 2, 8
ZSTD_LEVEL = 1  #: higher levels gain little on pictures
#: A file of frames in its temporary folder, and the seconds after its last change in which nothing removes it.
UNFINISHED, JUST_NOW = "frames", 60.0
#: Cache files that this process reads from; they are not removed.
_IN_USE: set[Path] = set()


# -- decoding ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Video:
    """An open video.

    size: (width, height) as displayed, after the rotation in its header. fps: frames per second. pictures: iterates
    once over uint8 [height, width, 3], or [height, width] in grey.
    """

    path: Path
    size: tuple[int, int]
    fps: float
    pictures: Iterator[np.ndarray]


def open_video(path: Path, *, grey: bool = False, output: Sequence[str] = ()) -> Video:
    """Opens a video without decoding a frame. output: further options of ffmpeg, such as a filter.

    Raises DataError if it cannot be opened. Iterating over its pictures raises DataError if they cannot be decoded, or
    if far fewer come than the header promises. Other damage causes a DamageWarning.
    """
    if not path.exists():
        raise DataError(f"{path}: found no file, expected a video")
    check_regular(path)
    from imageio_ffmpeg import read_frames  # of the extra `train`

    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # else it warns of rotated and scaled videos
    reader = read_frames(file_url(path), input_params=list(ONE_FILE), output_params=list(output))
    try:
        with closing(reader):
            meta: dict[str, Any] = next(reader, {})
        (width, height), fps, seconds = meta["size"], float(meta["fps"]), float(meta["duration"])
    except Exception as error:  # of any type, with all that ffmpeg prints; the last line names the cause
        said = str(error).strip().rpartition("\n")[2]
        expected = f"expected a whole video in a container among {CONTAINERS.replace(',', ', ')}"
        raise DataError(f"{path}: cannot be decoded: {one_line(said, 120)}; {expected}") from None
    if not (1 <= min(width, height) <= max(width, height) <= MAX_SIDE and 0 < fps < MAX_FPS):
        found = f"{width}x{height} at {fps:g} frames per second"
        raise DataError(f"{path}: {found}, expected at most {MAX_SIDE} a side and {MAX_FPS:g}")
    check_pixels(width * height, [path], str(path))
    shape = (height, width) if grey else (height, width, 3)
    return Video(path, (width, height), fps, _pictures(path, shape, output, seconds * fps))


def _pictures(path: Path, shape: tuple[int, ...], output: Sequence[str], promised: float) -> Iterator[np.ndarray]:
    """Decodes the pictures. promised: about how many frames the header promises; 0 if unknown."""
    pixels, size, count = "gray" if len(shape) == 2 else "rgb24", math.prod(shape), 0
    arguments = [*ONE_FILE, "-i", file_url(path), "-pix_fmt", pixels, *output, "-f", "rawvideo", "-"]
    with ffmpeg(arguments, stdout=subprocess.PIPE) as run:
        assert run.process.stdout is not None
        while len(data := run.process.stdout.read(size)) == size:
            yield np.frombuffer(data, np.uint8).reshape(shape)
            count += 1
        code, said = run.end()
    found = f"{count} of {promised:.0f} frames, ffmpeg says {said or code}"
    if code or data or (said and count < promised * (1 - SHORT) - 1):
        raise DataError(f"{path}: is damaged: found {found}; expected a whole video")
    if said:
        warnings.warn(DamageWarning(f"{path}: is damaged: found {found}"), stacklevel=2)


def file_url(path: Path) -> str:
    """The file as a URL for ffmpeg, which takes the letters before a colon in a plain name for a protocol."""
    return f"file:{path}"


@dataclass(frozen=True)
class Ffmpeg:
    """A running ffmpeg, and the file to which it writes its errors."""

    process: subprocess.Popen[Any]
    errors: IO[bytes]

    def end(self) -> tuple[int, str]:
        """Waits for its end. Returns (exit code, the last error that it wrote, or an empty string)."""
        code = self.process.wait()
        self.errors.seek(max(0, self.errors.seek(0, os.SEEK_END) - LAST_BYTES))
        lines = self.errors.read().decode("utf-8", "replace").strip().splitlines()
        return code, one_line(lines[-1], 160) if lines else ""


@contextmanager
def ffmpeg(arguments: Sequence[str], **pipes: Any) -> Iterator[Ffmpeg]:
    """Runs ffmpeg, which does not see the terminal's Ctrl-C, and kills it at the end of the block."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *arguments]
    given: dict[str, Any] = {"stdin": subprocess.DEVNULL, "start_new_session": True} | pipes
    with tempfile.TemporaryFile() as errors, subprocess.Popen(command, stderr=errors, **given) as process:
        try:
            yield Ffmpeg(process, errors)
        finally:
            process.kill()


# -- the cache ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StoredFrames:
    """The frames of a video in the cache. offsets: n + 1 offsets in the file, bytes. shape: of each frame."""

    path: Path
    offsets: Sequence[int]
    shape: tuple[int, ...]
    fps: float

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def read(self, index: int) -> np.ndarray:
        """Reads a frame, uint8 [H, W, 3]. Raises DataError if its file is missing or broken."""
        import zstandard

        start, stop = self.offsets[index : index + 2]
        try:
            with self.path.open("rb") as stream:
                stream.seek(start)
                data = zstandard.ZstdDecompressor().decompress(stream.read(stop - start), int(np.prod(self.shape)))
            steps = np.frombuffer(data, np.uint8).reshape(self.shape)
        except (OSError, ValueError, zstandard.ZstdError):
            self.path.unlink(missing_ok=True)
            raise DataError(f"{self.path}: a cached frame is missing or broken; start again to decode anew") from None
        return np.add.accumulate(steps, axis=1, dtype=np.uint8)


def stored_frames(path: Path, how: str, treat: Callable[[np.ndarray], np.ndarray]) -> StoredFrames:
    """The frames of a video after `treat`, decoded now unless the cache has them.

    how: identifies `treat` in the cache. Raises DataError for a video that cannot be decoded or holds no frame, and if
    the cache has no room.
    """
    place = os.environ.get(FOLDER) or os.path.expanduser("~/.cache/pd4dgs-frames")
    if place.startswith("~/"):
        raise DataError(f"{path}: found no home folder to keep its frames in, expected one in {FOLDER}")
    folder = Path(place).absolute()
    try:
        check_regular(path)
        stat = path.stat()
    except OSError:
        raise DataError(f"{path}: found no file, expected a video") from None
    key = json.dumps([VERSION, str(path.resolve()), stat.st_size, stat.st_mtime_ns, how])
    target = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.frames"
    found = _stored(target) or _store(open_video(path, output=["-fps_mode", "passthrough"]), target, treat)
    _IN_USE.add(target)
    return found


def _stored(target: Path) -> StoredFrames | None:
    try:
        with target.open("rb") as stream:
            end = stream.seek(-LENGTH, os.SEEK_END)
            stream.seek(end - int.from_bytes(stream.read(LENGTH), "little"))
            start, index = stream.tell(), json.loads(stream.read()[:-LENGTH])
        if index["offsets"][-1] != start:
            return None
        os.utime(target)  # now the most recently used
        return StoredFrames(target, index["offsets"], tuple(index["shape"]), index["fps"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):  # a cut or damaged file
        return None


def _store(video: Video, target: Path, treat: Callable[[np.ndarray], np.ndarray]) -> StoredFrames:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(target.parent) as folder:
            file = folder / UNFINISHED
            frames = _compress(video, file, target.parent, treat)
            os.replace(file, target)
    except OSError as error:
        what = "the disk is full" if error.errno == errno.ENOSPC else error.strerror or str(error)
        raise DataError(f"{target.parent}: cannot keep the frames of {video.path.name}: {what}") from None
    return replace(frames, path=target)


def _compress(video: Video, file: Path, cache: Path, treat: Callable[[np.ndarray], np.ndarray]) -> StoredFrames:
    """Writes a cache file, and makes room for it."""
    import zstandard

    compress, limit = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress, _limit()
    offsets, shape = [0], list[int]()
    with file.open("wb") as stream:
        lock(stream)
        others = _make_room(cache, file, math.inf)
        for picture in video.pictures:
            frame = np.ascontiguousarray(treat(picture))
            shape, steps = list(frame.shape), frame.copy()
            steps[:, 1:] -= frame[:, :-1]
            offsets.append(offsets[-1] + stream.write(compress(steps)))
            if others + offsets[-1] > limit:
                others = _make_room(cache, file, limit - offsets[-1])
            if others + offsets[-1] > limit:
                found = f"its first {len(offsets) - 1} frames take {limit / 2**30:g} GiB"
                raise DataError(f"{video.path}: {found}; expected a larger {SIZE} or a larger --downscale")
        if not shape:
            raise DataError(f"{video.path}: holds no frame, expected one at least")
        index = json.dumps({"offsets": offsets, "shape": shape, "fps": video.fps}).encode()
        stream.write(index + (len(index)).to_bytes(LENGTH, "little"))
    return StoredFrames(file, offsets, tuple(shape), video.fps)


def _limit() -> float:
    text = os.environ.get(SIZE) or str(DEFAULT_GIB)
    try:
        gib = float(text)
    except ValueError:
        gib = -1.0
    if not 0 < gib < 1e9:
        raise DataError(f"{SIZE} is {text!r}, expected GiB > 0")
    return gib * 2**30


def _make_room(cache: Path, own: Path, limit: float) -> int:
    """Removes what killed processes left, and the least recently used files until the rest takes `limit` bytes or is in
    use. Returns its bytes, without the file `own` that is being written."""
    total, stored = 0, []
    for file in (*cache.glob("*.frames"), *cache.glob(f"{PREFIX}*/{UNFINISHED}")):
        with suppress(FileNotFoundError):  # another process has removed it meanwhile
            stat = file.stat()
            if file == own or (file.name == UNFINISHED and _removed_stale(file, stat.st_mtime)):
                continue
            total += stat.st_size
            if file.name != UNFINISHED and file not in _IN_USE:
                stored.append((stat.st_mtime, stat.st_size, file))
    for _, size, file in sorted(stored):
        if total > limit:
            total -= size
            file.unlink(missing_ok=True)
    return total


def _removed_stale(file: Path, changed: float) -> bool:
    """Removes an unfinished file with its folder, unless another process may be writing it."""
    if time.time() - changed < JUST_NOW:  # a new one is locked in a moment
        return False
    try:
        with file.open("rb+") as stream:
            lock(stream)
    except OSError:
        return False
    shutil.rmtree(file.parent, ignore_errors=True)
    return not file.exists()


# -- datasets ----------------------------------------------------------------------------------------------------------


def synchronised_dataset(
    folder: Path,
    cameras: Sequence[UnreadView],
    points: np.ndarray | None,
    source: str,
    downscale: int,
    holdout: int,
    depth: tuple[float, float] | None = None,
) -> Dataset:
    """The dataset of fixed cameras, each with its video as `image`.

    source: of the points. The first camera is held out, unless holdout is 0. depth: near and far, if known.
    """
    cameras, shape = geometry(cameras, points, depth)
    views: list[View] = []
    count, fps = 0, 0.0
    for i, camera in enumerate(cameras):
        frames, mask = _frames_of(camera, downscale)
        if i and (len(frames) != count or frames.fps != fps):
            first = cameras[0].image.name
            found = f"{len(frames)} frames at {frames.fps:g} per second and {first} {count} at {fps:g}"
            raise DataError(f"{camera.image}: has {found}, expected synchronised videos")
        count, fps = len(frames), frames.fps
        fixed: dict[str, Any] = {"viewmat": camera.viewmat.astype(np.float32), "mask": mask, "camera_id": i}
        fixed |= {"K": camera.lens.matrix(downscale), "height": frames.shape[0], "width": frames.shape[1]}
        for k in range(count):
            time, name = k / max(count - 1, 1), f"{camera.image.stem}_{k:04d}"
            read = partial(lambda frames, k, mask: (frames.read(k), mask), frames, k, mask)
            views.append(LaterView(read, time=time, name=name, **fixed))
    train, test = without_first_camera(folder, views, holdout)
    return Dataset(
        name=folder.resolve().name,
        train=tuple(train),
        test=tuple(test),
        background=(0.0, 0.0, 0.0),
        time_range=(0.0, (count - 1) / fps if count > 1 else 1.0),
        origin=Origin(f"the videos, {fps:g} a second", points=source, posed=f"{len(cameras)} videos with a pose"),
        **shape,
    )


def _frames_of(camera: UnreadView, downscale: int) -> tuple[StoredFrames, np.ndarray | None]:
    """The frames of a camera's video, undistorted and downscaled, and the mask of their seen pixels."""
    lens, mask = camera.lens, None
    check_downscale((lens.width, lens.height), downscale, str(camera.image))
    if not lens.is_pinhole:
        mask = rectify(np.zeros((lens.height, lens.width, 1), np.uint8), lens, downscale)[1]

    def ideal(picture: np.ndarray) -> np.ndarray:
        return shrink_image(picture, downscale) if lens.is_pinhole else rectify(picture, lens, downscale)[0]

    return stored_frames(camera.image, f"{downscale} {'' if lens.is_pinhole else lens}", ideal), mask
