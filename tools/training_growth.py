"""How a training step and its memory grow with pixels and with anchors. Writes its part of docs/training.md.

    python tools/training_growth.py [--only NAME ...] [--steps 7] [--docs docs] [--render]

Each line is a process of its own: a new model of so many anchors on the scene at a size, one thread, the levels in
turn. Figures are medians of processor time, so that other jobs on the machine count little. Takes some ten minutes.
"""

from __future__ import annotations

import json
import resource
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from pages.child import printed
from pages.page import Page, Row, make, options, say
from pages.scenes import SCENES, present

from pd4dgs_codec.bench.report import markdown

#: Per scene (how many times smaller its pictures are, anchors): first pixels grow, then anchors.
CASES: dict[str, tuple[tuple[int, int], ...]] = {
    "shelf-hand": ((4, 14_000), (2, 14_000), (1, 14_000), (2, 50_000), (2, 150_000)),
    "bouncing-balls": ((4, 14_000), (2, 14_000), (1, 14_000), (4, 50_000), (4, 150_000)),
    "synthetic-large": ((1, 14_000),),
}
SHARE = 0.55  #: of its run, where a step is taken to stand


def one(name: str, downscale: int, anchors: int, steps: int) -> Row:
    """What this process takes: milliseconds of a step at each level, and MiB in memory at most."""
    from pd4dgs_codec.model.config import PRESETS
    from pd4dgs_codec.threads import configure
    from pd4dgs_codec.train.loop import Trainer

    configure(1)
    scene = replace(SCENES[name], downscale=downscale, seconds=None)
    dataset = scene.load()
    size = replace(PRESETS[scene.preset], initial_anchors=anchors, max_anchors=anchors)
    learner = Trainer(scene.config(), dataset, size=size).learner
    levels = range(learner.model.level + 1)

    def step(level: int) -> float:
        learner.iteration = round(SHARE * scene.iterations)
        start = time.process_time()
        learner.step((level,))
        return 1e3 * (time.process_time() - start)

    for level in levels:  # compiles the kernels and fills the caches
        step(level)
    turns = [[step(level) for level in levels] for _ in range(steps)]
    return {
        "width": dataset.train[0].width,
        "height": dataset.train[0].height,
        "views": len(dataset.train),
        "anchors": len(learner.model.anchor_q),
        "ms": [statistics.median(times) for times in zip(*turns, strict=True)],
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def measure(name: str, steps: int) -> Row:
    """All cases of one scene."""
    found = []
    for downscale, anchors in CASES[name]:
        found.append(printed(name, [__file__, "--one", name, str(downscale), str(anchors), str(steps)]))
        say(f"{name}: {found[-1]}")
    return {"cases": found}


def render(rows: Sequence[Row]) -> str:
    """One table."""
    table = []
    for row in rows:
        for case in row["cases"]:
            levels = " / ".join(f"{ms:.0f}" for ms in case["ms"])
            size = f"{case['width']}×{case['height']}"
            counts = f"{case['anchors']:,}", str(case["views"])
            table.append((row["name"], size, *counts, levels, f"{case['memory']:,.0f}"))
    heads = ("scene", "pixels", "anchors", "views", "step at level 0 / 1 / 2, processor ms", "memory at most, MiB")
    return markdown(heads, table)


PAGE = Page("training", "training_growth.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["--one"]:
        name, *numbers = given[1:]
        print(json.dumps(one(name, *map(int, numbers))))
        return 0
    parser = options(__doc__, tuple(CASES))
    parser.add_argument("--steps", type=int, default=7, help="timed at each level (default: 7)")
    args = parser.parse_args(given)
    todo = [scene.name for scene in present(args, tuple(CASES))]
    return make(PAGE, tuple(CASES), todo, args, lambda name: measure(name, args.steps))


if __name__ == "__main__":
    sys.exit(main())
