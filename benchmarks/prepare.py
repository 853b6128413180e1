"""What `pd4dgs-prepare` makes of recordings whose poses are known, as a Markdown table.

Processor seconds are those of the command with all that it starts. Poses are compared with the true ones after the
similarity that fits best, times with those of the same pictures in the recording. Of what fails its line is printed.

    python benchmarks/prepare.py                          # all recordings
    python benchmarks/prepare.py walk --package CHECKOUT  # one, by the package of another checkout
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, SHARED
from PIL import Image
from rooms import picture, pose, texture

from pd4dgs_codec.data.dataset import load

COUNT, SIZE, FOCAL = 80, (854, 480), 700.0
#: The walls' pattern repeats after so many pixels, twice what a picture shows: matching takes repeats for one place.
PATTERN = 2048
#: A blurred picture is the mean of so many, over this share of the time between two.
SAMPLES, SHUTTER = 5, 0.5
COMMAND = "import sys; from pd4dgs_codec.cli.prepare import main; sys.exit(main())"


@dataclass(frozen=True, eq=False)
class Truth:
    """Of a recording's frames: seconds [n], world to camera [n, 4, 4], and the pictures, uint8 [height, width, 3]."""

    path: Path
    times: np.ndarray
    poses: np.ndarray
    pictures: Sequence[np.ndarray]

    def frame(self, image: np.ndarray) -> int:
        """Which frame a picture is."""
        small = image[::8, ::8].astype(np.float32)
        return int(np.argmin([np.abs(each[::8, ::8] - small).mean() for each in self.pictures]))


@dataclass(frozen=True)
class Walk:
    """A video of a room in which a square moves. upright: the phone is held so, and the file says it in its header.
    even: the frames come at equal times. blurred: a shaking hand and a slow shutter. tripod: the camera stands."""

    name: str
    upright: bool = False
    even: bool = True
    blurred: bool = False
    tripod: bool = False

    def view(self, step: float) -> np.ndarray:
        """float64 [4, 4] world to camera; step 0..1."""
        angle = 0.03 * np.sin(18 * np.pi * step) * self.blurred
        shake = np.eye(4)
        shake[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return np.asarray(shake @ pose(0.5 if self.tripod else step))

    def frame(self, step: float, textures: list[np.ndarray]) -> np.ndarray:
        """uint8 [height, width, 3]."""
        moments = step + (SHUTTER / COUNT * np.linspace(-0.5, 0.5, SAMPLES) if self.blurred else np.zeros(1))
        size = SIZE[::-1] if self.upright else SIZE
        taken = [picture(self.view(t), textures, -0.9 + 1.8 * t, size, FOCAL).astype(np.float32) for t in moments]
        return np.asarray(np.mean(taken, axis=0) + 0.5).astype(np.uint8)

    def write(self, folder: Path) -> Truth:
        """Makes the video: 30 frames a second, or between 15 and 60."""
        gaps = np.ones(COUNT) if self.even else np.random.default_rng(0).uniform(0.5, 2, COUNT)
        times = np.round(np.cumsum(gaps / 30) - gaps[0] / 30, 3)  # as the list below says
        steps, textures = times / times[-1], [texture(seed, PATTERN) for seed in range(4)]
        pictures = [self.frame(step, textures) for step in steps]
        for k, each in enumerate(pictures):
            Image.fromarray(np.rot90(each) if self.upright else each).save(folder / f"{k:03d}.png", compress_level=1)
        shown = "file {:03d}.png\noption framerate 1000\nduration {:.3f}".format
        lines = map(shown, range(COUNT), [*np.diff(times), 1 / 30])
        (folder / "list.txt").write_text("\n".join(["ffconcat version 1.0", *lines]))
        coding = "-fps_mode vfr -c:v libx264 -crf 18 -pix_fmt yuv420p -video_track_timescale 90000".split()
        ffmpeg("-safe", 0, "-i", folder / "list.txt", *coding, folder / "coded.mp4")
        ffmpeg("-display_rotation", -90 * self.upright, "-i", folder / "coded.mp4", "-c", "copy", folder / "video.mp4")
        return Truth(folder / "video.mp4", times, np.stack([self.view(step) for step in steps]), pictures)


@dataclass(frozen=True)
class Capture:
    """The first frames of a real capture, and the poses that come with it."""

    name: str

    def write(self, folder: Path) -> Truth:
        """Copies the pictures."""
        views = load(SHARED / self.name, holdout=0).train[:COUNT]
        (folder / self.name).mkdir()
        for k, view in enumerate(views):
            Image.fromarray(view.image).save(folder / self.name / f"{k:03d}.png")
        poses, times = np.stack([view.viewmat for view in views]), np.arange(len(views)) / 30
        return Truth(folder / self.name, times, poses, [view.image for view in views])


RECORDINGS: tuple[Walk | Capture, ...] = (
    Walk("walk"),
    Walk("upright", upright=True, even=False),
    Walk("blurred", blurred=True),
    Capture("shelf-hand"),
    Walk("tripod", tripod=True),
)


def ffmpeg(*arguments: object) -> None:
    """Runs that of imageio-ffmpeg."""
    from imageio_ffmpeg import get_ffmpeg_exe

    subprocess.run([get_ffmpeg_exe(), "-y", "-v", "error", *map(str, arguments)], check=True)


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """(largest angle in degrees, RMS distance in percent of the path's extent) of poses float64 [n, 4, 4]."""
    u, _, vt = np.linalg.svd(np.einsum("nki,nkj->ij", true[:, :3, :3], found[:, :3, :3]))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    cosines = (np.einsum("nij,kj,nik->n", found[:, :3, :3], turn, true[:, :3, :3]) - 1) / 2
    centers = (-np.einsum("nji,nj->ni", views[:, :3, :3], views[:, :3, 3]) for views in (found, true))
    p, q = (each - each.mean(axis=0) for each in centers)
    p = p @ turn.T
    gaps = p * ((p * q).sum() / (p * p).sum()) - q
    extent = np.linalg.norm(q[:, None] - q, axis=2).max()
    angle, distance = np.arccos(cosines.clip(-1, 1).min()), np.sqrt((gaps**2).sum(axis=1).mean())
    return float(np.degrees(angle)), float(100 * distance / extent)


def measured(recording: Walk | Capture, package: Path, frames: int) -> str:
    """A row of the table. frames: the most that are used."""
    with tempfile.TemporaryDirectory() as folder:
        truth, output = recording.write(Path(folder)), Path(folder) / "out"
        command = [sys.executable, "-c", COMMAND, truth.path, "-o", output, "--frames", frames, "-j", 2]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        environment = os.environ | {"PYTHONPATH": str(package.resolve())}
        # elsewhere, since Python looks for packages where it starts first
        done = subprocess.run(list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        if done.returncode:
            return f"| {recording.name} | {seconds:.0f} | {done.stderr.strip().splitlines()[-1]} |"
        report, views = json.loads((output / "report.json").read_text()), load(output, holdout=0).train
        which = [truth.frame(view.image) for view in views]
        angle, distance = errors(np.stack([view.viewmat for view in views]).astype(np.float64), truth.poses[which])
        times = [row["seconds"] for row in report["pictures"] if row["pose"]]
        late = 1000 * np.abs(truth.times[which] - times).max()
        counts = report["frames"]
        posed = f"{counts['registered']} of {counts['chosen']} | {report['reprojection_error']:.2f}"
        return f"| {recording.name} | {seconds:.0f} | {posed} | {angle:.2f}° | {distance:.2f} % | {late:.0f} ms |"


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="recordings (default: all)")
    parser.add_argument(
        "--package", type=Path, default=ROOT, help="checkout of the package to measure (default: this one)"
    )
    parser.add_argument("--frames", type=int, default=COUNT, help=f"most frames to use (default: {COUNT})")
    options = parser.parse_args()
    head = "recording", "CPU s", "poses", "error, pixels", "largest turn", "distance", "time"
    print(f"| {' | '.join(head)} |\n" + "|-" * len(head) + "|")
    for recording in RECORDINGS:
        if not options.names or recording.name in options.names:
            print(measured(recording, options.package, options.frames), flush=True)


if __name__ == "__main__":
    main()
