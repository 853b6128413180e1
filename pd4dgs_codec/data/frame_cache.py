"""Frames of a video, decoded once: kept on the disk without loss, one readable without the others.

Each frame is differences between neighbours in a row, compressed by zstd. The cache lies in the folder that
PD4DGS_CACHE names, else in ~/.cache/pd4dgs-frames, and stays within PD4DGS_CACHE_GIB (default 20): what was not used
for longest leaves first.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.videos import Video, open_video
from pd4dgs_codec.data.view import View
from pd4dgs_codec.errors import DataError

FOLDER, SIZE = "PD4DGS_CACHE", "PD4DGS_CACHE_GIB"
DEFAULT_GIB = 20.0
#: Of files in the cache: changes with their layout.
VERSION = 1
#: zstd's level: higher ones gain little on pictures.
LEVEL = 1
#: Files that this process reads from: they stay.
_IN_USE: set[Path] = set()


@dataclass(frozen=True, eq=False)
class StoredFrames:
    """The frames of a video in the cache. offsets: int64 [n + 1], bytes in the file; shape: of each frame."""

    path: Path
    offsets: np.ndarray
    shape: tuple[int, int, int]
    fps: float

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def read(self, index: int) -> np.ndarray:
        """uint8 [H, W, 3] of one frame. Raises DataError if the cache was emptied meanwhile."""
        import zstandard

        start, stop = int(self.offsets[index]), int(self.offsets[index + 1])
        try:
            with self.path.open("rb") as stream:
                stream.seek(start)
                data = zstandard.ZstdDecompressor().decompress(stream.read(stop - start), int(np.prod(self.shape)))
            steps = np.frombuffer(data, np.uint8).reshape(self.shape)
        except (OSError, ValueError, zstandard.ZstdError):
            raise DataError(
                f"{self.path}: a frame of the cache is gone or broken; begin again, it is made anew"
            ) from None
        return np.add.accumulate(steps, axis=1, dtype=np.uint8)


class StoredView(View):
    """A view whose picture is read from the cache each time that it is asked for."""

    def __init__(self, frames: StoredFrames, index: int, **fields: Any) -> None:
        """fields: those of a View but `image`, `width` and `height`."""
        height, width, _ = frames.shape
        for name, value in {**fields, "width": width, "height": height, "_frames": frames, "_index": index}.items():
            object.__setattr__(self, name, value)

    @property
    def image(self) -> np.ndarray:
        """uint8 [H, W, 3]."""
        frames: StoredFrames = self._frames  # type: ignore[attr-defined]
        return frames.read(self._index)  # type: ignore[attr-defined]


def stored_frames(path: Path, how: str, treat: Callable[[np.ndarray], np.ndarray]) -> StoredFrames:
    """The frames of a video after `treat`, decoded now if the cache does not have them.

    how: what `treat` does, in words that differ where it differs. Raises DataError for a video that cannot be decoded,
    that holds no frame, or that the cache has no room for.
    """
    folder = Path(os.environ.get(FOLDER) or Path.home() / ".cache" / "pd4dgs-frames")
    try:
        stat = path.stat()
    except OSError:
        raise DataError(f"{path}: found no file, expected a video") from None
    key = json.dumps([VERSION, str(path.resolve()), stat.st_size, stat.st_mtime_ns, how])
    target = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.frames"
    table = target.with_suffix(".npz")
    found = _stored(target, table) or _store(open_video(path, output=["-fps_mode", "passthrough"]), target, treat)
    _IN_USE.add(target)
    return found


def _stored(target: Path, table: Path) -> StoredFrames | None:
    try:
        with np.load(table, allow_pickle=False) as held:
            offsets, shape, fps = held["offsets"], tuple(map(int, held["shape"])), float(held["fps"])
        if target.stat().st_size != offsets[-1] or len(shape) != 3:
            return None
        os.utime(target)  # so that it leaves last
    except (OSError, ValueError, KeyError, EOFError):
        return None
    return StoredFrames(target, offsets, shape, fps)


def _store(video: Video, target: Path, treat: Callable[[np.ndarray], np.ndarray]) -> StoredFrames:
    import zstandard

    limit = _limit()
    compress = zstandard.ZstdCompressor(level=LEVEL).compress
    offsets, shape = [0], (0, 0, 0)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        others = sum(file.stat().st_size for file in target.parent.glob("*.frames"))
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".pd4dgs-") as folder:
            frames, index = Path(folder) / "frames", Path(folder) / "index.npz"
            with frames.open("wb") as stream:
                for picture in video.pictures:
                    frame = np.ascontiguousarray(treat(picture))
                    shape = frame.shape
                    steps = frame.copy()
                    steps[:, 1:] -= frame[:, :-1]
                    data = compress(steps)
                    stream.write(data)
                    offsets.append(offsets[-1] + len(data))
                    if others + offsets[-1] > limit:
                        others = _make_room(target.parent, limit - offsets[-1])
                    if others + offsets[-1] > limit:
                        raise DataError(
                            f"{video.path}: its first {len(offsets) - 1} frames take {limit / 2**30:g} GiB; expected "
                            f"a larger {SIZE} or a larger --downscale"
                        )
            if len(offsets) == 1:
                raise DataError(f"{video.path}: holds no frame, expected one at least")
            table = np.array(offsets, np.int64)
            np.savez(index, offsets=table, shape=shape, fps=video.fps)
            os.replace(index, target.with_suffix(".npz"))
            os.replace(frames, target)
    except OSError as error:
        full = error.errno == errno.ENOSPC
        what = "the disk is full" if full else error.strerror or str(error)
        raise DataError(f"{target.parent}: cannot keep the frames of {video.path.name}: {what}") from None
    finally:
        video.pictures.close()
    return StoredFrames(target, table, shape, video.fps)


def _limit() -> float:
    text = os.environ.get(SIZE) or str(DEFAULT_GIB)
    try:
        gib = float(text)
    except ValueError:
        gib = -1.0
    if not 0 < gib < 1e9:
        raise DataError(f"{SIZE} is {text!r}, expected GiB > 0")
    return gib * 2**30


def _make_room(folder: Path, most: float) -> int:
    """Removes what was not used for longest until the rest takes `most` bytes or is in use; bytes of the rest."""
    files = sorted(folder.glob("*.frames"), key=lambda file: file.stat().st_mtime)
    total = sum(file.stat().st_size for file in files)
    for file in files:
        if total > most and file not in _IN_USE:
            total -= file.stat().st_size
            file.unlink()
            file.with_suffix(".npz").unlink(missing_ok=True)
    return total
