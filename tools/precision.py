"""Measures docs/precision.md: the reports `pd4dgs-bench codec`, `render` and `train` of each scene, with their plots.

    python tools/precision.py [--only NAME ...] [--out out] [--docs docs]

Models are read from --out (NAME/model.pt), the cameras of real scenes from the folder in PD4DGS_SHARED (default
../shared/data beside the repository); scenes not there are named and left out. The page is written after each scene;
with --only it keeps what it says of the others.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pd4dgs_codec.cli import bench
from pd4dgs_codec.render.threads import configure

SHARED = Path(os.environ.get("PD4DGS_SHARED", Path(__file__).resolve().parents[2] / "shared" / "data"))
FULL = ("--step-scales", "1,2,4", "--efforts", "1,5", "--cold", "1")
#: Without the efforts that take minutes, and, but for bouncing-balls and the static scene, without other coders.
SHORT = ("--step-scales", "1,4", "--efforts", "1", "--cold", "1")
#: name, cameras, downscale, codec options, models whose training is drawn together
SCENES: tuple[tuple[str, Path | str, int, tuple[str, ...], tuple[str, ...]], ...] = (
    ("shelf-hand", SHARED / "shelf-hand", 2, FULL, ("shelf-hand", "shelf-hand-paper")),
    ("bouncing-balls", SHARED / "bouncing-balls", 4, SHORT, ("bouncing-balls",)),
    ("synthetic-static", "synthetic:static", 1, SHORT, ("synthetic-static",)),
    ("synthetic-global", "synthetic:global", 1, (*SHORT, "--no-peers"), ("synthetic-global",)),
    ("synthetic-local", "synthetic:local", 1, (*SHORT, "--no-peers"), ("synthetic-local",)),
    ("synthetic-fast", "synthetic:fast", 1, (*SHORT, "--no-peers"), ("synthetic-fast",)),
)
CODEC = ("--modes", "ans,lzma", "--repeats", "3", "--views", "4")
#: Kernels with other constants are compiled, which takes its time, and drawn for the first scene alone.
WAYS = "oracle float64,textbook float32,kernels,gsplat"
RENDER = ("--views", "1", "--only", WAYS)
RENDER_ALL = ("--views", "1", "--only", f"{WAYS},tile 16x16,tile 8x16,alpha >= 1/64,T > 1e-3,T > 1e-2")

INTRODUCTION = """\
# Error against run time

Made by `python tools/precision.py` from trained models; a single report: `pd4dgs-bench codec`, `render` or `train`.
Times are medians with quartiles of repeated warm work; long work is repeated less, or not at all. Cold times are whole
fresh processes, imports and reading included, with the largest memory that they held. Rings and the grey steps in the
plots mark the Pareto front: nothing is better in one way without being worse in the other.

**Codec.** Each step scale multiplies all quantisation steps of the model. Pictures are compared with the checkpoint's
own at the highest level, unrounded for PSNR. A finished run's tensors lie on its steps, so that at scale 1 the values
come back exactly, and the pictures differ by the codes of the masks alone. Anchors are integers and exact at any
scale. A coarser file may leave out a deformation that vanishes; it is held against the checkpoint's highest level all
the same. Encoding is timed without verification. All scenes but shelf-hand are packed at effort 1 alone, and of the
synthetic ones only the static one has the other coders beside it.

**Other coders** get the same data in the same run, decode what they wrote, and are compared with it. They come with
`pip install -c constraints.txt '.[train,bench]'`, torchac by hand: it is GPL-3 and compiled at its first import.

- *symbols*: masks, attributes, residuals of planes, and weights, as this codec codes them; positions aside. LZMA has
  the layout that suits it best, zstd the narrowest integers channel by channel. constriction's QuantizedGaussian and
  torchac (whose tables have 16 bits) code under a Gaussian per channel, with 16 bytes each for its moments and range.
- *positions*: anchors of each layer; Draco with its kd-tree at level 10, in an order of its own.
- *splats*: the Gaussians that one camera meets at one instant, with the colours that it sees, in formats that hold
  static splats. The file beside them holds all instants and all views, so that their bytes answer another question:
  what one frame costs where there is no model. SPZ (version 4) is written by gaussforge, from PLY and back to PLY,
  which its times include; coordinates are scaled by a power of two to use its fixed point. PyPI's `spz` has no wheel,
  and its source wants a Rust build. fourdgs uses its default profile without its own verification.

**Rasteriser.** Each way to draw gets the same Gaussians; the error is against a float64 oracle. Tiles change no pixel.
Thresholds looser than the format's buy time with error.

**Trainer.** Held-out error along the runs that made the models, on six views.
"""


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[row[0] for row in SCENES])
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args(argv)
    configure()
    (args.docs / "img").mkdir(parents=True, exist_ok=True)
    page, figures = args.docs / "precision.md", args.docs / "precision.json"
    sections = _sections(page.read_text()) if args.only and page.exists() else {}
    results = json.loads(figures.read_text()) if args.only and figures.exists() else {}
    measured = 0
    for name, cameras, downscale, options, trained in SCENES:
        if args.only and name not in args.only:
            continue
        model = args.out / name / "model.pt"
        missing = [p for p in (model, cameras) if isinstance(p, Path) and not p.exists()]
        if missing:
            print(f"{name}: {missing[0]} is not there, left out")
            continue
        data = ["--data", str(cameras), "--downscale", str(downscale)]
        runs = [str(p) for p in (args.out / n / "model.pt" for n in trained) if p.exists()]
        reports = {
            "codec": ["codec", str(model), *data, *CODEC, *options],
            "render": ["render", str(model), *data, *(RENDER_ALL if name == SCENES[0][0] else RENDER)],
            "train": ["train", "--from", *runs],
        }
        lines = []
        for report, command in reports.items():
            start = time.monotonic()
            image = args.docs / "img" / f"precision-{name}-{report}.png"
            result, table = run(command, image)
            if result is None:
                print(f"precision: error: {name}: {report} failed, see above", file=sys.stderr)
                return 1
            results.setdefault(name, {})[report] = result
            lines += [f"### {name}: {report}\n", f"![{report} of {name}](img/{image.name})\n", table]
            print(f"{name}: {report} in {time.monotonic() - start:.0f} s", flush=True)
        sections[name] = "\n".join(lines).rstrip("\n") + "\n"
        measured += 1
        ordered = [row[0] for row in SCENES if row[0] in sections]
        page.write_text("\n".join([INTRODUCTION, *(f"## {name}\n\n{sections[name]}" for name in ordered)]))
        figures.write_text(json.dumps({name: results[name] for name in ordered}, indent=1) + "\n")
    if not measured:
        print(f"precision: error: none of the models is there; expected {args.out}/NAME/model.pt", file=sys.stderr)
        return 1
    return 0


def _sections(page: str) -> dict[str, str]:
    """What the page says of each scene, by name."""
    parts = [part.partition("\n") for part in page.split("\n## ")[1:]]
    return {name: text.strip("\n") + "\n" for name, _, text in parts}


def run(command: list[str], image: Path) -> tuple[dict[str, Any] | None, str]:
    """(what a report's JSON holds but for the names of its inputs, its Markdown); None if it failed."""
    out = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(out):
        path = Path(folder) / "report.json"
        if bench.main([*command, "--json", str(path), "--plot", str(image), "--overwrite"]) != 0:
            return None, ""
        result = json.loads(path.read_text())
    return {key: value for key, value in result.items() if key not in ("input", "source")}, out.getvalue()


if __name__ == "__main__":
    sys.exit(main())
