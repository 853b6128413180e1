"""Memory of training from long videos: `python tools/streaming.py FRAMES WIDTHxHEIGHT`.

Writes a video of moving test patterns, reads it as a data set of two synchronised cameras through the cache of frames,
and goes through all training views as the steps do. Prints seconds, bytes of the cache, and the process's own memory
(VmRSS) at a tenth of the way and at its highest. Everything lies in a temporary folder and goes at the end.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from imageio_ffmpeg import get_ffmpeg_exe

from pd4dgs_codec.data import videos
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.train.state import TrainingViews

FPS = 30


def memory(field: str) -> float:
    """MiB of this process."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) / 1024


def main(frames: int, size: str) -> None:
    width, height = map(int, size.split("x"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ[videos.FOLDER] = str(folder / "cache")
        os.environ[videos.SIZE] = "2.5"
        for camera in range(2):  # the first is held out and is short work: its frames are all the same
            source = f"testsrc2=size={size}:rate={FPS}" if camera else f"color=gray:size={size}:rate={FPS}"
            command = [get_ffmpeg_exe(), "-v", "error", "-f", "lavfi", "-i", source, "-frames:v", str(frames)]
            command += ["-vf", f"scale={width}:{height}"]  # testsrc2 makes odd sides even
            command += ["-c:v", "libx264", "-preset", "ultrafast", "-pix_fmt", "yuv444p"]
            subprocess.run([*command, str(folder / f"cam{camera}.mp4")], check=True)
        row = [0, 1, 0, 0, height, 1, 0, 0, 0, width, 0, 0, -1, 0, width]
        np.save(folder / "poses_bounds.npy", np.array([[*row, 1.0, 9.0]] * 2))
        begun, before = time.monotonic(), memory("VmRSS")
        data = load(folder)
        read = time.monotonic()
        shots, marks = TrainingViews(data.train, torch.device("cpu")), []
        order = np.random.default_rng(0).permutation(len(shots))
        for k, index in enumerate(order):
            assert shots[int(index)].target.image.shape == (height, width, 3)
            if k in (len(order) // 10, len(order) - 1):
                marks.append(memory("VmRSS"))
        stored = sum(file.stat().st_size for file in (folder / "cache").glob("*.frames"))
        print(
            f"{frames} frames of {size}: {frames * width * height * 3 / 2**30:.2f} GiB of pictures, cache "
            f"{stored / 2**30:.2f} GiB; read in {read - begun:.0f} s, gone through in {time.monotonic() - read:.0f} s; "
            f"MiB before {before:.0f}, at a tenth {marks[0]:.0f}, at the end {marks[1]:.0f}, "
            f"highest {memory('VmHWM'):.0f}"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
