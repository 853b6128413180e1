"""The main job, to watch: train a dynamic scene, pack it, unpack every prefix, render each level, measure.

bash tools/demo.sh                       # the synthetic scene, CPU, under five minutes
bash tools/demo.sh --source FOLDER --preset small --max-seconds 600 --downscale 2
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pd4dgs_codec.threads import configure


def say(line: str) -> None:
    """Prints a stage as it begins."""
    print(line, flush=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="synthetic:local", help="dataset folder or synthetic:NAME (%(default)s)")
    parser.add_argument("--preset", default="tiny", choices=("tiny", "small", "paper"))
    parser.add_argument("--max-seconds", type=float, default=150.0, help="training time (%(default)s)")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, default=Path("out"), help="folder for all results (%(default)s)")
    args = parser.parse_args(argv)
    configure()

    from pages.main_job import Job, run_job
    from pages.tables import coding_table, figures, quality_table, time_plot

    from pd4dgs_codec.cli.progress import TrainingProgress
    from pd4dgs_codec.errors import Pd4Error
    from pd4dgs_codec.train.config import TrainConfig

    try:
        config = TrainConfig(
            preset=args.preset,
            source=args.source,
            downscale=args.downscale,
            seed=args.seed,
            max_seconds=args.max_seconds,
        )
        result = run_job(Job("demo", config), args.out, say=say, progress=TrainingProgress())
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        print(f"demo: error: {str(error) or 'interrupted'}", file=sys.stderr)
        return 1
    folder = args.out / "demo"
    shown = [{"name": "demo", **figures(result)}]
    time_plot(shown, folder / "quality-over-time.png")
    if result["phases_not_reached"]:
        print(f"\nthe time limit came before: {', '.join(result['phases_not_reached'])}")
    print(f"\n{quality_table(shown)}\n\n{coding_table(shown)}\n")
    for what, names in (
        ("model", "model.pt"),
        ("bitstream", "scene.pd4"),
        ("pictures", "levels.png levels.gif quality-over-time.png"),
        ("all figures", "results.json"),
    ):
        print(f"{what:12} " + ", ".join(str(folder / name) for name in names.split()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
