"""Pictures from prefixes of slices: held-out dB against bytes, with whole layers and random order beside it.

    python tools/slices.py [--only NAME ...] [--size 50000] [--out out] [--docs docs] [--render]

Each checkpoint that tools/results.py left in --out/NAME/model.pt is packed in one slice per layer, in slices of
--size bytes ordered by what the training views show, and in slices of anchors in random order. Every prefix is
decoded and scored on the held-out views. A scene of PREFIXED is trained first, with --prefixes. Writes
docs/slices.md, its plot and a film strip per scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
from pages.page import Page, Row, make, options, paragraph, say
from pages.scenes import SCENES, present
from pages.trainings import ensure_trained

from pd4dgs_codec.bench.report import drawing, markdown
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.threads import configure

#: Scenes trained for their first slices, and the share of steps that see these alone.
PREFIXED, SHARE = {f"{name}-prefixes": name for name in ("shelf-hand", "bouncing-balls")}, 0.3
NAMES = ("shelf-hand", "shelf-hand-prefixes", "bouncing-balls", "bouncing-balls-prefixes")
NAMES += ("synthetic-local", "synthetic-global")
VIEWS = 16  #: training views that order the anchors
STEP, LEAST = 0.5, 20.0  #: dB between the qualities whose times are compared, and the lowest of them
RATE = 2e6  #: bits per second
STRIP = 6  #: pictures of a film strip
COLUMNS = 3  #: panels of the plot beside each other

Points = list[tuple[int, float]]  #: (bytes, dB) after each slice


def measure(path: Path, dataset: Dataset, size: int, strip: Path) -> Row:
    """Points of the three files, and what slices cost."""
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.format.options import EncodeOptions
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene
    from pd4dgs_codec.quality.packing import Views, pack

    scene = to_scene(checkpoint.load(path)[0])
    views = Views.of(dataset, dataset.name, VIEWS)
    say("  one slice per layer")
    one = pack(scene, views=views)
    say("  slices")
    fitting = Views(views.source, views.fitting)
    packed = pack(one.scene, EncodeOptions(slices=size), views=fitting)
    rng = np.random.default_rng(0)
    shuffled = encode(one.scene, slices=size, utility=lambda decoded: rng.random(len(decoded.anchor_q)))
    files = {"layers": one.data, "slices": packed.data, "random": shuffled}
    row: Row = {name: points(data, dataset) for name, data in files.items()}
    row["seconds"] = {name: decode_seconds(data) for name, data in files.items() if name != "random"}
    row["size"] = size
    draw_strip(packed.data, dataset, strip)
    return row


def prefixes(data: bytes) -> list[tuple[int, Scene]]:
    """(bytes, scene) of every prefix of slices."""
    from pd4dgs_codec.format.info import info
    from pd4dgs_codec.format.stream import every_prefix

    ends = [part["end"] for layer in info(data)["layers"] for part in layer["slices"]]
    return list(zip(ends, every_prefix(data), strict=True))


def points(data: bytes, dataset: Dataset) -> Points:
    """What each prefix takes and shows."""
    from pd4dgs_codec.quality.measure import true_psnr

    views = dataset.test or dataset.train
    return [(end, true_psnr(scene, views, levels=[scene.level])[scene.level]) for end, scene in prefixes(data)]


def decode_seconds(data: bytes) -> float:
    """Median of five."""
    from pd4dgs_codec.format.decoder import decode

    took = []
    for _ in range(5):
        start = time.perf_counter()
        decode(data)
        took.append(time.perf_counter() - start)
    return median(took)


def bytes_to(reached: Points, db: float) -> int | None:
    """The bytes after which a picture has so many dB, None if it never has."""
    return next((size for size, found in reached if found >= db), None)


def time_ratio(sliced: Points, layers: Points) -> float:
    """Median over qualities of the time to each, sliced, relative to that of one slice per layer. Bytes stand for time,
    as on a link of constant rate."""
    highest = max(db for _, db in layers)
    ratios = []
    for db in np.arange(LEAST, highest, STEP):
        fast, slow = bytes_to(sliced, db), bytes_to(layers, db)
        if fast is not None and slow is not None:
            ratios.append(fast / slow)
    return median(ratios)


def draw_strip(data: bytes, dataset: Dataset, path: Path) -> None:
    """STRIP prefixes of one held-out view side by side, the truth last."""
    from PIL import Image

    from pd4dgs_codec.model.convert import from_scene
    from pd4dgs_codec.model.picture import render_image
    from pd4dgs_codec.quality.image import to_uint8
    from pd4dgs_codec.quality.movie import Panel, side_by_side

    views = dataset.test or dataset.train
    view, found = views[len(views) // 2], prefixes(data)
    chosen = sorted({round(i) for i in np.linspace(0, len(found) - 1, STRIP)})
    panels = []
    for end, scene in (found[i] for i in chosen):
        picture = render_image(from_scene(scene), scene.level, view.time, view.camera)
        panels.append(Panel(to_uint8(picture), f"{end / 1000:.0f} kB"))
    Image.fromarray(side_by_side([*panels, Panel(view.image, "truth")])).save(path, quality=88)


def plot(rows: Sequence[Row], path: Path) -> None:
    """dB against bytes of all three files, one panel per scene, legible in black and white."""
    styles = {
        "slices": ("-o", "slices, by utility"),
        "random": (":x", "slices, random"),
        "layers": ("--s", "layers"),
    }
    with drawing(path, [row["name"] for row in rows], "held-out mPSNR, dB", (4.6, 3.4), across=COLUMNS) as axes:
        for axis, row in zip(axes, rows, strict=True):
            for name, (style, label) in styles.items():
                sizes, db = zip(*row[name], strict=True)
                where = "steps-post" if name == "layers" else "default"
                axis.plot(np.array(sizes) / 1000, db, style, color="black", ms=4, lw=1, drawstyle=where, label=label)
            axis.set_xlabel("kB")
        axes[0].legend()


def render(rows: Sequence[Row]) -> str:
    """The page."""
    first, cost, each = [], [], []
    for row in rows:
        layers, seconds = row["layers"], row["seconds"]
        sliced, name = row["slices"], row["name"]
        size, db = sliced[0]
        worst = max((a - b for (_, a), (_, b) in pairwise(sliced)), default=0.0)
        first.append(
            (
                name,
                f"{size:,}",
                f"{8 * size / RATE:.2f}",
                f"{db:.2f}",
                f"{row['random'][0][1]:.2f}",
                f"{layers[0][1]:.2f} in {layers[0][0]:,}",
                f"{max(worst, 0.0):.3f}",
                f"{time_ratio(sliced, layers):.2f}",
            )
        )
        more, slower = sliced[-1][0] / layers[-1][0] - 1, seconds["slices"] / seconds["layers"] - 1
        took = f"{seconds['slices']:.2f}"
        cost.append((name, f"{len(sliced)}", f"{sliced[-1][0]:,}", f"{more:+.2%}", took, f"{slower:+.0%}"))
        steps = ", ".join(f"{size / 1000:.0f} kB {db:.2f}" for size, db in sliced)
        each.append(f"**{name}**, dB after each slice: {steps}.")
    heads = ("scene", "first slice", "s at 2 Mbps", "dB", "random", "layer 0", "largest fall, dB", "time ratio")
    lines = [
        *paragraph(
            f"Slices of {rows[0]['size']:,} bytes. `pd4dgs-encode --slices` orders the anchors of each layer by what "
            f"{VIEWS} training views show; dB are mPSNR on the views held out. *random*: the first slice with anchors "
            f"in random order. *{', '.join(PREFIXED)}*: trained with `--prefixes {SHARE}`. *layer 0*: the first "
            "picture of a file with one slice per layer. *time ratio*: the "
            f"median, over qualities {STEP} dB apart from {LEAST:g} dB up, of the time to that quality on a link of "
            f"constant rate, relative to that file."
        ),
        "",
        markdown(heads, first),
        "",
        "![dB against bytes](img/slices.png)",
        "",
        "What it costs, in bytes and in seconds to decode the whole file:",
        "",
        markdown(("scene", "slices", "bytes", "more", "s", "more"), cost),
        "",
        *["\n".join(paragraph(text)) + "\n" for text in each],
        *[f"![prefixes of {row['name']}](img/slices-{row['name']}.jpg)\n" for row in rows],
    ]
    return "\n".join(lines).strip()


PAGE = Page("slices", "slices.py", render, "A picture from every prefix of slices")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, NAMES)
    parser.add_argument("--size", type=int, default=50_000, metavar="BYTES", help="of a slice (default: 50,000)")
    args = parser.parse_args(argv)
    configure(1)
    images = args.docs / "img"
    images.mkdir(parents=True, exist_ok=True)
    kept = [name for name in NAMES if name in PREFIXED or (args.out / name / "model.pt").is_file()]
    there = {scene.name for scene in present(argparse.Namespace(only=None, render=args.render))}
    todo = [n for n in kept if PREFIXED.get(n, n) in there and (not args.only or n in args.only)]

    def measured(name: str) -> Row:
        say(f"{name}:")
        path, scene = args.out / name / "model.pt", SCENES[PREFIXED.get(name, name)]
        dataset = scene.load()
        if name in PREFIXED:
            ensure_trained(scene.config(prefixes=SHARE), dataset, path, say=say)
        return measure(path, dataset, args.size, images / f"slices-{name}.jpg")

    return make(PAGE, NAMES, todo, args, measured, lambda rows: plot(rows, images / "slices.png"))


if __name__ == "__main__":
    sys.exit(main())
