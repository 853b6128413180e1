"""Captures cut into segments against the same captures trained whole. Writes the table of docs/long-captures.md.

    python tools/long_captures.py [--only NAME ...] [--steps 600] [--out out] [--docs docs] [--render]

Both have as many steps in all. Segments are trained and packed through pd4dgs-batch, the later ones twice: from the
anchors of the first one, and on their own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pages.page import ROOT, Page, Row, make, options, paragraph, say, unpadded
from pages.scenes import SHARED

from pd4dgs_codec.bench.report import markdown

SEGMENTS = 3
HOLDOUT = 8
EYES = 3  #: cameras that look at a seam, three frames apart
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: (frame, whose camera) -> uint8 picture [H, W, 3] of the scene itself, where that can be had.
Truth = Callable[[int, int], np.ndarray]
#: Name -> (downscale, what it is).
CAPTURES = {
    "shelf-hand": (4, "86 frames from a hand-held camera"),
    "synthetic-60s": (1, "180 frames over 60 s; small parts move to and fro six times, the camera five"),
}
#: How a capture is trained -> what its segments begin with.
WAYS = {"whole": None, "segments, shared scaffold": "first", "segments, each on its own": "own"}


# -- captures ----------------------------------------------------------------------------------------------------------


def capture(name: str, folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]], np.ndarray, Truth | None]:
    """(what holds for all frames, frames in their order, initial points) of a capture as a transforms.json has them,
    and the scene itself."""
    from pd4dgs_codec.data.files import read_ply

    if name == "synthetic-60s":
        return _synthetic(folder)
    source = SHARED / name
    content = json.loads((source / "transforms.json").read_text())
    near_far, frames = content.pop("near_far_per_frame"), content.pop("frames")
    for frame, depth in zip(frames, near_far, strict=True):
        frame |= {"file_path": str(source / frame["file_path"]), "depth": depth}
    (points,) = source.glob("*.ply")
    return content, frames, read_ply(points)[0], None


def _synthetic(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]], np.ndarray, Truth]:
    from PIL import Image

    from pd4dgs_codec.data import synthetic
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.data.synthetic import SceneBuilder

    bodies, frames, count = SceneBuilder("local", 0).bodies(), [], 180
    folder.mkdir(parents=True, exist_ok=True)

    times = [i / (count - 1) for i in range(count)]
    viewmats = [synthetic._train_viewmat(2 * t % 1) for t in times]

    def truth(frame: int, eye: int) -> np.ndarray:
        phase = 1 - abs(1 - 12 * times[frame] % 2)  # to and fro, six times
        return synthetic._render(bodies, viewmats[eye], phase)

    for i, (t, viewmat) in enumerate(zip(times, viewmats, strict=True)):
        path = folder / f"{i:03d}.png"
        if not path.exists():
            Image.fromarray(truth(i, i)).save(path)
        pose = np.linalg.inv(viewmat) @ OPENGL
        frames.append({"file_path": str(path), "time": 60 * t, "transform_matrix": pose.tolist()})
    lens, points = synthetic.LENS, load("synthetic:local").points
    assert points is not None
    about = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
    return about, frames, points, truth


def write(folder: Path, about: dict[str, Any], frames: list[dict[str, Any]], points: np.ndarray) -> None:
    """A dataset of these frames; each knows whether it is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("train", "test"):
        own = [frame for frame in frames if frame["held_out"] == (kind == "test")]
        content = about | {"frames": own}
        if "depth" in own[0]:
            content["near_far_per_frame"] = [frame["depth"] for frame in own]
        (folder / f"transforms_{kind}.json").write_text(json.dumps(content))
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"] + ["end_header", ""]
    (folder / "points.ply").write_bytes("\n".join(head).encode() + points.astype("<f4").tobytes())


# -- trainings ---------------------------------------------------------------------------------------------------------


def batch(op: str, lines: list[dict[str, Any]], folder: Path) -> None:
    """Runs an operation through pd4dgs-batch; what is finished stays."""
    manifest = folder / f"{op}.jsonl"
    manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
    command = [sys.executable, "-m", "pd4dgs_codec", "batch", manifest, "--op", op, "-o", folder / op]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if subprocess.run([*map(str, command), "--workers", "2"], env=environment).returncode:
        sys.exit(f"pd4dgs-batch --op {op} failed")


def measure(name: str, steps: int, out: Path) -> Row:
    """The rows of a capture."""
    from pd4dgs_codec.model import checkpoint

    downscale, _ = CAPTURES[name]
    home = out / "long-captures" / name
    about, frames, points, truth = capture(name, home / "images")
    for i, frame in enumerate(frames):
        frame["held_out"] = i % HOLDOUT == HOLDOUT // 2
    cuts = [round(i * len(frames) / SEGMENTS) for i in range(SEGMENTS + 1)]
    parts = [frames[a:b] for a, b in zip(cuts, cuts[1:], strict=False)]
    share = steps // SEGMENTS

    def line(label: str, content: list[dict[str, Any]], start: np.ndarray, count: int) -> dict[str, Any]:
        write(home / label, about, content, start)
        own = {"preset": "tiny", "iterations": count, "downscale": downscale}
        return {"source": str(home / label), "output": f"{label}.pt", "options": own}

    say(f"{name}: the whole, and the first segment")
    first = [line("whole", frames, points, share * SEGMENTS), line("own-0", parts[0], points, share)]
    batch("train", first, home)
    scaffold = checkpoint.load(home / "train" / "own-0.pt")[0]
    anchors = (scaffold.anchor_q.double() * scaffold.info.voxel_size).numpy().astype(np.float32)
    say(f"{name}: the other segments")
    rest = [line(f"own-{i}", parts[i], points, share) for i in range(1, SEGMENTS)]
    rest += [line(f"first-{i}", parts[i], anchors, share) for i in range(1, SEGMENTS)]
    batch("train", rest, home)
    labels = [job["output"].removesuffix(".pt") for job in [*first, *rest]]
    batch("encode", [{"source": str(home / "train" / f"{label}.pt")} for label in labels], home)
    return {"frames": len(frames), "steps": steps, "rows": [_row(way, home, downscale, cuts, truth) for way in WAYS]}


def _row(way: str, home: Path, downscale: int, cuts: Sequence[int], truth: Truth | None) -> Row:
    """Bytes, dB on held-out frames, and steps of the pictures in time: across seams and elsewhere."""
    from pd4dgs_codec import decode
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.draw.player import Player
    from pd4dgs_codec.format.info import info
    from pd4dgs_codec.quality.image import to_uint8

    kind = WAYS[way]
    labels = [f"{kind if i else 'own'}-{i}" for i in range(SEGMENTS)] if kind else ["whole"]
    players, psnr, sizes, base = [], [], [], []
    for label in labels:
        data = (home / "encode" / f"{label}.pd4").read_bytes()
        player, dataset = Player(decode(data)), load(str(home / label), downscale=downscale)
        players.append((player, dataset))
        layers = info(data)["layers"]
        sizes.append(len(data))
        base.append(layers[0]["end"])
        for view in dataset.test:
            drawn = to_uint8(player.picture(view.camera, view.time))
            psnr.append(_psnr(drawn, view.image))
    whole = load(str(home / "whole"), downscale=downscale)
    views = sorted([*whole.train, *whole.test], key=lambda view: view.time)

    def eyes(frame: int) -> list[int]:
        """Frames around this one, whose cameras both sides of a seam have seen."""
        return [frame + 3 * (i - EYES // 2) for i in range(EYES)]

    def shown(frame: int, eye: int) -> np.ndarray:
        """What is shown of a frame: segments have times of their own, 0..1 over their frames."""
        which = next(i for i in range(SEGMENTS) if frame < cuts[i + 1]) if kind else 0
        begin, end = (cuts[which], cuts[which + 1]) if kind else (0, cuts[-1])
        return to_uint8(players[which][0].picture(views[eye].camera, (frame - begin) / (end - begin - 1)))

    def change(picture: Truth, frame: int, eye: int) -> np.ndarray:
        return picture(frame, eye).astype(np.float64) - picture(frame - 1, eye)

    row: Row = {"way": way, "psnr": float(np.mean(psnr)), "bytes": sum(sizes), "layer_0": sum(base)}
    step, error, scene = {}, {}, {}
    for place, at in (("seam", cuts[1:-1]), ("inside", [(a + b) // 2 for a, b in zip(cuts, cuts[1:], strict=False)])):
        pairs = [(frame, eye) for frame in at for eye in eyes(frame)]
        drawn = [change(shown, *pair) for pair in pairs]
        step[place] = _decibels(drawn)
        if truth:
            true = [change(truth, *pair) for pair in pairs]
            scene[place] = _decibels(true)
            error[place] = _decibels([a - b for a, b in zip(drawn, true, strict=True)])
    return row | {"step": step} | ({"error": error, "scene": scene} if truth else {})


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return _decibels([a.astype(np.float64) - b])


def _decibels(differences: Sequence[np.ndarray]) -> float:
    """PSNR of the mean square of differences of 8-bit pictures."""
    error = float(np.mean([np.square(difference).mean() for difference in differences])) / 255**2
    return float(-10 * np.log10(max(error, 1e-10)))


# -- the page ----------------------------------------------------------------------------------------------------------


def render(rows: Sequence[Row]) -> str:
    """A line per capture and way."""
    cells = [
        [
            f"{row['name']} ({row['steps']} steps)" if way["way"] == "whole" else "",
            way["way"],
            f"{way['psnr']:.2f}",
            f"{way['bytes']:,}",
            f"{way['layer_0']:,}",
            f"{way['step']['seam']:.1f}",
            f"{way['step']['inside']:.1f}",
            *(f"{way['error'][place]:.1f}" if "error" in way else "" for place in ("seam", "inside")),
        ]
        for row in rows
        for way in row["rows"]
    ]
    head = ("capture", "trained", "dB", "bytes", "of these layers 0", "at seams dB", "inside dB")
    head += ("error at seams dB", "error inside dB")
    scenes = "; ".join(
        f"{row['name']}: {scene['seam']:.1f} at seams, {scene['inside']:.1f} inside"
        for row in rows
        if (scene := row["rows"][0].get("scene"))
    )
    captures = "; ".join(f"{row['name']}: {CAPTURES[row['name']][1]}" for row in rows)
    text = paragraph(
        f"{captures}. Preset tiny, {SEGMENTS} segments of equal length. *dB*: PSNR on held-out frames, every eighth. "
        "*at seams*: PSNR between the pictures of successive frames on both sides of a seam, from "
        f"{EYES} cameras of frames around it; *inside*: the same in the middle of a segment. What is lower than the "
        f"scene itself is seen as a jump ({scenes}). *error*: PSNR of the change from frame to frame against that of "
        "the scene itself, where that can be had."
    )
    return "\n".join([unpadded(markdown(head, cells)), "", *text])


PAGE = Page("long-captures", "long_captures.py", render)


def main() -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, tuple(CAPTURES))
    parser.add_argument("--steps", type=int, default=600, metavar="N", help="of the whole, and of all segments (600)")
    args = parser.parse_args()
    out = args.out.resolve()
    todo = args.only or list(CAPTURES)
    return make(PAGE, tuple(CAPTURES), todo, args, lambda name: measure(name, args.steps, out))


if __name__ == "__main__":
    sys.exit(main())
