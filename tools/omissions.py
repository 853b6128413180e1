"""What the encoder leaves out without changing a picture: bytes per scene, and the proof. Writes docs/omissions.md.

    python tools/omissions.py NAME=CHECKPOINT ... [--pictures 1000] [--write docs/omissions.md]

Each checkpoint is packed twice, with all that it holds and with what is left out, both are unpacked, and pictures of
both at random times, levels and cameras are compared bit for bit. Exit code 1 if any differs.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from pd4dgs_codec.render.threads import configure

configure(1)  # with more, the first picture of a process may differ from itself drawn again by 3e-8

import numpy as np  # noqa: E402

from pd4dgs_codec.codec.decoder import decode  # noqa: E402
from pd4dgs_codec.codec.encoder import encode_with_report  # noqa: E402
from pd4dgs_codec.model import checkpoint  # noqa: E402
from pd4dgs_codec.model.convert import from_scene, to_scene  # noqa: E402
from pd4dgs_codec.model.picture import render_image  # noqa: E402
from pd4dgs_codec.scene import Camera, Scene  # noqa: E402

SIDE = 64  #: of the pictures, pixels

HEAD = """\
# What no picture needs

`pd4dgs-encode` leaves out, always, what no renderer can read: plane cells that no anchor and no Gaussian shown ever
meets at any time, offsets of Gaussians that no view shows, channels and weights that nothing reads or that are always
multiplied by zero. How this is proven is in [design.md](design.md#left-out). Below, each checkpoint packed without
(`--omit nothing`) and with it (`--omit lossless`), and the number of pictures, at random times, levels and cameras
around the scene, that are the same bit for bit: `python tools/omissions.py NAME=out/NAME/model.pt ...`, after
`python tools/results.py`.

| scene | everything, bytes | left out, bytes | share | pictures the same |
|-------|-------------------|-----------------|-------|-------------------|
"""


@dataclass(frozen=True)
class Result:
    """One scene. left_out: rows of the encoder's report."""

    name: str
    everything: int
    rest: int
    left_out: list[dict]
    same: int
    pictures: int


def measure(name: str, path: str, pictures: int, effort: int) -> Result:
    """Packs the checkpoint both ways and compares `pictures` pictures."""
    scene = to_scene(checkpoint.load(path)[0])
    whole, _ = encode_with_report(scene, omit="nothing", layers=2, effort=effort)
    rest, report = encode_with_report(scene, omit="lossless", layers=2, effort=effort)
    same = compare(decode(whole), decode(rest), pictures)
    rows = [row for row in report.left_out if row["lossless"]]
    return Result(name, len(whole), len(rest), rows, same, pictures)


def compare(a: Scene, b: Scene, pictures: int) -> int:
    """How many of `pictures` random pictures of both scenes are the same bit for bit, at every level in turn."""
    rng = np.random.default_rng(0)
    models = from_scene(a), from_scene(b)
    same = 0
    for i in range(pictures):
        camera = random_camera(a, rng)
        t = float(rng.random())
        one, other = (render_image(model, i % 3, t, camera) for model in models)
        same += int(np.array_equal(one, other))
    return same


def random_camera(scene: Scene, rng: np.random.Generator) -> Camera:
    """A camera that looks at a random anchor from a random side, from 0.1 to 2 box sizes away."""
    target = scene.anchor[rng.integers(len(scene.anchor))]
    distance = float(np.linalg.norm(scene.info.box[1] - scene.info.box[0])) * 10 ** rng.uniform(-1, 0.3)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ target
    viewmat[2, 3] += distance
    focal = SIDE * rng.uniform(0.5, 2)
    K = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], np.float32)
    return Camera(viewmat, K, SIDE, SIDE)


def page(results: list[Result]) -> str:
    """The Markdown page."""
    lines = [HEAD.rstrip("\n")]
    for r in results:
        saved = r.everything - r.rest
        lines.append(
            f"| {r.name} | {r.everything:,} | {saved:,} | {saved / r.everything:.1%} | {r.same:,} of {r.pictures:,} |"
        )
    lines += ["", "What went, with the order-0 entropy of its symbols (files shrink by somewhat more or less):", ""]
    lines += ["| scene | what | why | bytes |", "|-------|------|-----|-------|"]
    lines += [f"| {r.name} | {row['what']} | {row['why']} | {row['bytes']:,} |" for r in results for row in r.left_out]
    return "\n".join([*lines, ""])


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Measure and prove what is left out without changing a picture.")
    parser.add_argument("scenes", nargs="+", metavar="NAME=CHECKPOINT")
    parser.add_argument("--pictures", type=int, default=1000, metavar="N", help="to compare (default: 1000)")
    parser.add_argument("--effort", type=int, default=5, metavar="1-9", help="of the encoder (default: 5)")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the page here (default: print it)")
    args = parser.parse_args(argv)
    pairs = [scene.partition("=") for scene in args.scenes]
    if wrong := [scene for scene, pair in zip(args.scenes, pairs, strict=True) if not all(pair)]:
        parser.error(f"found {wrong[0]!r}, expected NAME=CHECKPOINT")
    results = [measure(name, path, args.pictures, args.effort) for name, _, path in pairs]
    text = page(results)
    if args.write:
        args.write.write_text(text, encoding="utf-8")
    else:
        print(text)
    return 0 if all(r.same == r.pictures for r in results) else 1


if __name__ == "__main__":
    sys.exit(main())
