"""What the encoder leaves out without changing a picture: bytes per scene, and the proof. Writes docs/omissions.md.

    python tools/omissions.py [--only NAME ...] [--pictures 1000] [--out out] [--docs docs] [--render]

Each checkpoint that tools/results.py left in --out/NAME/model.pt is packed twice, with all that it holds and with what
is left out; both are unpacked, and pictures of both at random times, levels and cameras are compared bit for bit. Exit
code 1 if any differs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pages.page import Page, Row, make, options, say
from pages.scenes import SMALL, present

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.scene import Camera, Scene
from pd4dgs_codec.threads import configure

SIDE = 64  #: of the pictures, pixels
EFFORT = 5  #: of the encoder


def measure(path: Path, pictures: int) -> Row:
    """Packs the checkpoint both ways and compares `pictures` pictures. left_out: rows of the encoder's report."""
    from pd4dgs_codec.format.decoder import decode
    from pd4dgs_codec.format.encoder import encode_with_report
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene

    scene = to_scene(checkpoint.load(path)[0])
    whole, _ = encode_with_report(scene, omit="nothing", layers=2, effort=EFFORT)
    rest, report = encode_with_report(scene, omit="lossless", layers=2, effort=EFFORT)
    same = compare(decode(whole), decode(rest), pictures)
    rows = [{name: row[name] for name in ("what", "why", "bytes")} for row in report.left_out if row["lossless"]]
    return {"everything": len(whole), "rest": len(rest), "same": same, "pictures": pictures, "left_out": rows}


def compare(a: Scene, b: Scene, pictures: int) -> int:
    """How many of `pictures` random pictures of both scenes are the same bit for bit, at every level in turn."""
    from pd4dgs_codec.model.convert import from_scene
    from pd4dgs_codec.quality.levels import Level

    rng = np.random.default_rng(0)
    models = from_scene(a), from_scene(b)
    same = 0
    for i in range(pictures):
        camera = random_camera(a, rng)
        t = float(rng.random())
        one, other = (Level(i % 3, model, 0).picture(camera, t) for model in models)
        same += int(np.array_equal(one, other))
    return same


def random_camera(scene: Scene, rng: np.random.Generator) -> Camera:
    """One that looks at a random anchor from a random side, from 0.1 to 2 box sizes away."""
    target = scene.anchor[rng.integers(len(scene.anchor))]
    distance = float(np.linalg.norm(scene.info.box[1] - scene.info.box[0])) * 10 ** rng.uniform(-1, 0.3)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ target
    viewmat[2, 3] += distance
    focal = SIDE * rng.uniform(0.5, 2)
    return Camera(viewmat, np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], np.float32), SIDE, SIDE)


def render(rows: Sequence[Row]) -> str:
    """What goes, whether pictures stay the same, and what it was."""
    sizes = []
    for row in rows:
        saved = row["everything"] - row["rest"]
        share, same = f"{saved / row['everything']:.1%}", f"{row['same']:,} of {row['pictures']:,}"
        sizes.append((row["name"], f"{row['everything']:,}", f"{saved:,}", share, same))
    what = [(row["name"], out["what"], out["why"], f"{out['bytes']:,}") for row in rows for out in row["left_out"]]
    return "\n\n".join(
        [
            markdown(("scene", "everything, bytes", "left out, bytes", "share", "pictures the same"), sizes),
            "What went, with the order-0 entropy of its symbols (files shrink by somewhat more or less):",
            markdown(("scene", "what", "why", "bytes"), what),
        ]
    )


PAGE = Page("omissions", "omissions.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, SMALL)
    parser.add_argument("--pictures", type=int, default=1000, metavar="N", help="to compare (default: 1000)")
    args = parser.parse_args(argv)
    configure(1)  # with more, the first picture of a process may differ from itself drawn again by 3e-8
    todo = [scene.name for scene in present(args, SMALL)]

    def measured(name: str) -> Row:
        say(f"{name}: packing it twice, comparing {args.pictures:,} pictures")
        return measure(args.out / name / "model.pt", args.pictures)

    code = make(PAGE, SMALL, todo, args, measured)
    return code or int(any(row["same"] != row["pictures"] for row in PAGE.read(args.docs)))


if __name__ == "__main__":
    sys.exit(main())
