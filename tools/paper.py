"""The tables of the PD-4DGS paper from our own trainings, each beside the published figures.

    python tools/paper.py comparison                         # or sampling, components, levels, latency, rates, rho
    python tools/paper.py all
    python tools/paper.py components --scenes fast local --seeds 5 --iterations 3000
    python tools/paper.py levels --scenes recordings/kitchen@2

Trains what is missing below --out (a stopped run goes on where it was, a finished one is kept by its settings), packs,
measures on held-out views, and writes docs/paper/NAME.md, its figures and its picture. The method is the paper's: no
anchor is pruned by its harm, and learning rates fall all along and do not cool down. With --render pages are made from
their figures.

A scene is global, local, fast, static (the synthetic ones), shelf-hand or bouncing-balls (in the folder PD4DGS_SHARED
names, default ../shared/data beside the repository), or any SOURCE that pd4dgs-train takes, with @K behind it to train
on images 1/K as wide and high.
"""

from __future__ import annotations

import argparse
import functools
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pages.scenes import SCENES, SHARED, Scene

from pd4dgs_codec.threads import configure

#: Iterations and seeds at most of the synthetic scenes, in the preset tiny.
SYNTHETIC = ("tiny", 400, 3)
#: name: scene, preset, iterations, seeds at most. Equal iterations for all variants of a scene.
BUDGETS: dict[str, tuple[Scene, str, int, int]] = {
    **{name: (SCENES[f"synthetic-{name}"], *SYNTHETIC) for name in ("static", "global", "local", "fast")},
    "shelf-hand": (SCENES["shelf-hand"], "small", 1_500, 3),
    "bouncing-balls": (SCENES["bouncing-balls"], "small", 1_500, 3),
}
#: The same of a scene given by its source.
OTHERS = ("small", 2_000, 1)
#: Learning rates that no cooldown ends fall to so much less than ours.
FALL = 8


def main(argv: list[str] | None = None) -> int:
    configure()
    from pages.paper.tables import TABLES

    from pd4dgs_codec.cli.options import positive_int
    from pd4dgs_codec.cli.progress import TrainingProgress
    from pd4dgs_codec.errors import Pd4Error

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=(*TABLES, "all"))
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="instead of the table's own")
    parser.add_argument("--seeds", type=positive_int, metavar="N", help="seeds 0 to N-1 (default: the table's own)")
    parser.add_argument("--iterations", type=positive_int, metavar="N", help="of each run (default: the table's own)")
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--render", action="store_true", help="make the pages from their figures, train nothing")
    args = parser.parse_args(argv)
    tables = list(TABLES.values()) if args.table == "all" else [TABLES[args.table]]
    try:
        for table in tables:
            if args.render:
                table.page.write(args.docs, table.page.read(args.docs))
            else:
                make(table, args, TrainingProgress)
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        print(f"paper: error: {str(error) or 'interrupted; the same command goes on'}", file=sys.stderr)
        return 1
    return 0


def make(table: Any, args: argparse.Namespace, progress: Any) -> None:
    """Runs what the table lacks and writes its three files."""
    from pages.paper.runs import Run, held_to, measure
    from pages.paper.tables import figures

    from pd4dgs_codec.data.dataset import load

    results: list[dict[str, Any]] = []
    for one in [scene(name, table.budget, args.iterations) for name in args.scenes or table.scenes]:
        if one.config.source.startswith(str(SHARED)) and not Path(one.config.source).is_dir():
            print(f"{table.name}: {one.name} is not in {SHARED}, left out")
            continue
        dataset = functools.cache(
            lambda config=one.config: load(config.source, downscale=config.downscale, holdout=config.holdout)
        )
        for seed in range(args.seeds or min(table.seeds, one.seeds)):
            found: dict[Any, Any] = {}
            for variant in table.variants:
                run = Run(one, variant, seed)
                label = f"{table.name}: {one.name}, {variant.name}, seed {seed}"
                print(label, flush=True)
                say = functools.partial(_say, label)
                result = measure(run, dataset, args.out, say=say, progress=progress())
                if variant in table.sized:
                    limit = found[table.reference.name]["levels"][0]["cumulative_bytes"]
                    result = held_to(result, run, limit, dataset, args.out, say=say)
                found[variant.name] = result
            results += found.values()
    if results:
        table.page.write(args.docs, [figures(result, table.name) for result in results])
        table.plot(results, args.docs / "paper" / f"{table.name}.png")


def _say(label: str, text: str) -> None:
    print(f"{label}: {text}", flush=True)


def scene(name: str, synthetic: tuple[str, int] | None, iterations: int | None) -> Any:
    """A scene by its name, or by SOURCE[@K]. synthetic: preset and iterations of a synthetic scene, iterations: of any
    scene, instead of its own."""
    from pages.paper import runs

    from pd4dgs_codec.errors import DataError
    from pd4dgs_codec.train.config import LearningRates, TrainConfig

    source, at, downscale = name.partition("@")
    if at and not (downscale.isdecimal() and int(downscale)):
        raise DataError(f"{name}: found {downscale!r} behind @, expected an integer >= 1")
    given = Scene(Path(source).name.replace(":", "-"), source, int(downscale or 1))
    known, preset, steps, seeds = BUDGETS.get(name, (given, *OTHERS))
    if synthetic and known.source.startswith("synthetic:"):
        preset, steps = synthetic
    rates = {name: (start, end / FALL) for name, (start, end) in asdict(LearningRates()).items()}
    config = TrainConfig(
        preset=preset,
        source=known.source,
        downscale=known.downscale,
        iterations=iterations or steps,
        rate_scale=runs.RATE_SCALE,
        prune=0.0,  # the paper's method does none of these
        rates=LearningRates(**rates),
        cooldown=0.0,
        plane_rate=0.0,
        step_scale=1.0,
        grading=0.0,
        whitening=False,
    )
    return runs.Scene(name if name in BUDGETS else given.name, config, seeds)


if __name__ == "__main__":
    sys.exit(main())
