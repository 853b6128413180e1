"""Trains a dynamic scene, packs it, and measures and draws what every prefix of the file shows.

bash tools/demo.sh                       # a synthetic scene on the CPU, in less than five minutes
bash tools/demo.sh --source FOLDER --preset small --max-seconds 600 --downscale 2
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from common import Scene, command, number, say, seconds_at, table  # noqa: E402
from quality import curve, packed_levels, time_plot  # noqa: E402

from pd4dgs_codec.errors import Pd4Error  # noqa: E402


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--source", default="synthetic:fast?path=jump&frames=200", help="dataset folder or synthetic:NAME (%(default)s)"
    )
    parser.add_argument("--preset", default="tiny", choices=("tiny", "small", "paper"))
    parser.add_argument("--max-seconds", type=float, default=150.0, help="training time (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, default=Path("out"), help="folder for all results (%(default)s)")
    args = parser.parse_args(argv)
    try:
        scene = Scene("demo", args.source, "the demo's", args.downscale, args.preset)
        run(scene, args.seed, args.max_seconds, args.out / "demo")
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        print(f"demo: error: {str(error) or 'interrupted'}", file=sys.stderr)
        return 1
    return 0


def run(scene: Scene, seed: int, seconds: float, folder: Path) -> None:
    """Writes all results into `folder` and prints a table of the levels."""
    folder.mkdir(parents=True, exist_ok=True)
    model, file = folder / "model.pt", folder / "scene.pd4"
    settings = ("--preset", scene.preset, "--seed", seed, "--max-seconds", seconds)
    training = command("train", *scene.reading, *settings, "-o", model, "--log", folder / "train.jsonl", "-f")
    say("packing; rendering the held-out views at each level")
    found = packed_levels(scene, model, file)
    say("drawing")
    sides = ("--side-by-side", "-f")
    command("render", file, "-o", folder / "levels.png", *scene.data, "--frames", 1, *sides)
    command("render", file, "-o", folder / "levels.gif", *scene.data, "--split", "train", "--frames", 40, *sides)
    points = curve(model)
    time_plot([("demo", points)], folder / "quality-over-time.png")
    result = {"training": training, "levels": found, "curve": points}
    (folder / "results.json").write_text(json.dumps(result, indent=1) + "\n")
    if training["phases_not_reached"]:
        print(f"the time limit came before: {', '.join(training['phases_not_reached'])}")
    head = ("level", "bytes so far", "s at 2 Mbps", "mPSNR dB", "mSSIM", "anchors", "decode s", "render ms")
    cells = [
        (row["level"], number(row["bytes"], 0), seconds_at(row["bytes"]), number(row["mpsnr"]), number(row["mssim"], 4))
        + (number(row["anchors"], 0), number(row["decode_seconds"]), number(row["render_ms"], 0))
        for row in found
    ]
    print(f"\n{table(head, cells)}\n")
    for what, names in (
        ("model", "model.pt"),
        ("bitstream", "scene.pd4"),
        ("pictures", "levels.png levels.gif quality-over-time.png"),
        ("all figures", "results.json"),
    ):
        print(f"{what:12} " + ", ".join(str(folder / name) for name in names.split()))


if __name__ == "__main__":
    sys.exit(main())
