"""Measures docs/precision.md: the reports `pd4dgs-bench codec`, `render` and `train` of each scene, with their plots,
and what other coders make of the same data.

    python tools/precision.py [--only NAME ...] [--out out] [--docs docs] [--render]

Models are read from --out (NAME/model.pt), the cameras of real scenes from the folder in PD4DGS_SHARED (default
../shared/data beside the repository); scenes not there are named and left out. The page is written after each scene;
with --only it keeps what it says of the others. The other coders come with the extra "bench"; torchac is GPL-3 and
compiled at its first import, so it takes part only where it was installed by hand.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pages.page import Page, Row, keep, make, options, say, unpadded
from pages.scenes import SCENES, SMALL, Scene, present

from pd4dgs_codec.threads import configure

FULL = ("--step-scales", "1,2,4", "--efforts", "1,5", "--cold", "1")
#: Without the efforts that take minutes.
SHORT = ("--step-scales", "1,4", "--efforts", "1", "--cold", "1")
CODEC = ("--modes", "ans,lzma", "--repeats", "3", "--views", "4")
#: Runs of each of the other coders.
PEER_RUNS = 3
#: Scenes whose symbols, anchors and splats other coders get too.
PEERS = ("shelf-hand", "bouncing-balls", "synthetic-static")
#: Kernels with other constants are compiled, which takes its time, and drawn for the first scene alone.
WAYS = "oracle float64,textbook float32,kernels,gsplat"
WAYS_ALL = f"{WAYS},tile 16x16,tile 8x16,alpha >= 1/64,T > 1e-3,T > 1e-2"
#: Models whose training is drawn together.
TRAINED = {"shelf-hand": ("shelf-hand", "shelf-hand-paper")}


def measure(scene: Scene, out: Path, docs: Path) -> Row:
    """The row of one scene, whose model is there."""
    from pages import peers

    from pd4dgs_codec.bench import timing

    model, first = out / scene.name / "model.pt", scene.name == SMALL[0]
    data = ["--data", scene.source, "--downscale", str(scene.downscale)]
    runs = [str(p) for n in TRAINED.get(scene.name, (scene.name,)) if (p := out / n / "model.pt").exists()]
    commands = {
        "codec": ["codec", str(model), *data, *CODEC, *(FULL if first else SHORT)],
        "render": ["render", str(model), *data, "--views", "1", "--only", WAYS_ALL if first else WAYS],
        "train": ["train", "--from", *runs],
    }
    row: Row = {}
    for report, command in commands.items():
        start = time.monotonic()
        row[report] = run(command, docs / "img" / f"precision-{scene.name}-{report}.png")
        if report == "codec" and scene.name in PEERS:
            say(f"{scene.name}: other coders on the same data")
            row[report] |= beside(model, scene, row[report]["points"])
            row[report]["machine"]["versions"] |= timing.machine(*peers.PACKAGES)["versions"]
        keep(out / "precision", f"{scene.name}-{report}", row[report])
        say(f"{scene.name}: {report} in {time.monotonic() - start:.0f} s")
    return figures(row)


def run(command: list[str], image: Path) -> dict[str, Any]:
    """What a report's JSON holds but for the names of its inputs. Raises Pd4Error if it failed."""
    from pd4dgs_codec.cli import bench
    from pd4dgs_codec.errors import Pd4Error

    image.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.json"
        if bench.main([*command, "--json", str(path), "--plot", str(image), "--overwrite"]) != 0:
            raise Pd4Error(f"pd4dgs-bench {command[0]} failed, see above")
        result: dict[str, Any] = json.loads(path.read_text())
    return {key: value for key, value in result.items() if key not in ("input", "source")}


def beside(model: Path, scene: Scene, points: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The rows of all coders on the model's symbols, anchors and splats, and the symbols' sum of R(a) in bits."""
    from pages import peers

    from pd4dgs_codec.bench.pictures import frames
    from pd4dgs_codec.format.decoder import decode_layers
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene
    from pd4dgs_codec.quality.levels import load_levels

    # nearest to what pd4dgs-encode writes: the step scale nearest to 1, mode ans, the highest effort
    usual = min(points, key=lambda p: (abs(math.log(p["step_scale"])), p["mode"] != "ans", -p["effort"]))
    data = encode(to_scene(checkpoint.load(model)[0]), effort=1, verify=False)
    layers, level = decode_layers(data)[1], load_levels(data)[-1]
    symbols = peers.symbols_of(layers)
    pictures = frames(level.model.info, scene.source, 4, scene.downscale)
    rows = peers.coder_rows(symbols, PEER_RUNS) + peers.position_rows(layers, PEER_RUNS)
    rows += peers.splat_rows(level, pictures[len(pictures) // 2], usual["bytes"], PEER_RUNS)
    return {"peers": peers.as_json(rows), "peers_rate_bits": symbols.rate_bits}


def figures(row: Row) -> Row:
    """What the page shows: of each point the highest level's pictures, and the values once per step scale. Times and
    deviations are lists of their fields."""
    from pd4dgs_codec.bench.timing import machine_line

    codec, render, seen = row["codec"], row["render"], set()
    points = []
    for point in codec["points"]:
        values = [] if point["step_scale"] in seen else _listed(point["values"])
        seen.add(point["step_scale"])
        kept = {key: value for key, value in point.items() if key not in ("error", "fronts")}
        kept |= {name: _listed(point[name]) for name in ("encode", "decode", "encode_cold", "decode_cold")}
        points.append(kept | {"values": values, "pictures": _listed(point["pictures"][-1:])})
    coders = {"peers": _listed(codec["peers"])} if "peers" in codec else {}
    machines = [{"machine": machine_line(report["machine"])} for report in (codec, render)]
    drawn = [{key: value for key, value in point.items() if key != "front"} for point in render["points"]]
    runs = [
        run | {"curve": [{name: p[name] for name in ("seconds", "psnr")} for p in run["curve"]]}
        for run in row["train"]["runs"]
    ]
    return row | {
        "codec": codec | machines[0] | coders | {"points": points, "masks": _listed(codec["masks"])},
        "render": render | machines[1] | {"points": _listed(drawn)},
        "train": {"runs": runs},
    }


def _listed(value: Any) -> Any:
    """Dataclasses that became dicts as lists of their fields, in any depth."""
    if isinstance(value, dict):
        return [_listed(item) for item in value.values()]
    return [_listed(item) for item in value] if isinstance(value, list) else value


# -- the page ----------------------------------------------------------------------------------------------------------


def render(rows: Sequence[Row]) -> str:
    """Three sections per scene."""
    lines = []
    for row in rows:
        lines += [f"## {row['name']}", ""]
        for report, text in (("codec", _codec), ("render", _render), ("train", _train)):
            image = f"![{report} of {row['name']}](img/precision-{row['name']}-{report}.png)"
            lines += [f"### {row['name']}: {report}", "", image, "", unpadded(text(row[report])), ""]
    return "\n".join(lines).rstrip("\n")


def _timing(value: list[Any] | None) -> Any:
    from pd4dgs_codec.bench.timing import Timing

    return value and Timing(*value)


def _cold(value: list[Any] | None) -> Any:
    from pd4dgs_codec.bench.timing import Cold

    return value and Cold(_timing(value[0]), value[1])


def _codec(report: dict[str, Any]) -> str:
    from pages import peers

    from pd4dgs_codec.bench.codec import Deviation, PictureDeviation, Point, points_table, values_table

    points = []
    for p in report["points"]:
        times = {name: _timing(p[name]) for name in ("encode", "decode")}
        times |= {name: _cold(p[name]) for name in ("encode_cold", "decode_cold")}
        pictures = [PictureDeviation(n, e, math.inf if psnr is None else psnr, x) for n, e, psnr, x in p["pictures"]]
        deviations = {"values": tuple(Deviation(*v) for v in p["values"]), "pictures": tuple(pictures)}
        points.append(Point(**p | times | deviations))
    parts = [points_table(points), values_table(points, Deviation(*report["masks"]))]
    if "peers" in report:
        coders = [peers.Row(w, c, n, _timing(e), _timing(d), *rest) for w, c, n, e, d, *rest in report["peers"]]
        parts.append(peers.table(coders, report["peers_rate_bits"]))
    return "\n\n".join([*parts, report["machine"]])


def _render(report: dict[str, Any]) -> str:
    from pd4dgs_codec.bench.render import RenderPoint, table

    points = [RenderPoint(name, _timing(milliseconds), *rest) for name, milliseconds, *rest in report["points"]]
    sizes = (f"{v['width']}x{v['height']}, {v['gaussians']:,} Gaussians" for v in report["pictures"])
    return "\n\n".join([table(points), f"Pictures: {'; '.join(sizes)}.", report["machine"]])


def _train(report: dict[str, Any]) -> str:
    from pd4dgs_codec.bench.train import of_curve, table

    return table([of_curve(run["name"], run["curve"], run["anchors"]) for run in report["runs"]])


PAGE = Page("precision", "precision.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = options(__doc__, SMALL).parse_args(argv)
    configure()
    scenes = present(args, SMALL)
    for scene in scenes:
        if not (args.out / scene.name / "model.pt").exists():
            say(f"{scene.name}: {args.out / scene.name / 'model.pt'} is not there, left out")
    todo = [scene.name for scene in scenes if (args.out / scene.name / "model.pt").exists()]
    return make(PAGE, SMALL, todo, args, lambda name: measure(SCENES[name], args.out, args.docs))


if __name__ == "__main__":
    sys.exit(main())
