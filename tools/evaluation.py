"""Measures trained files with every metric that is installed; writes the table of docs/evaluation.md.

    python tools/evaluation.py [--only NAME ...] [--out out] [--docs docs] [--render]

Takes the files that tools/results.py left in --out/NAME/scene.pd4, and its scenes. With --only the other rows stay.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from pages.page import Page, Row, keep, make, options, say
from pages.scenes import SCENES, present

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.threads import configure

#: Figures that change from run to run; docs/results.md has them.
TIMES = {"decode_seconds", "render_ms"}


def render(rows: Sequence[Row]) -> str:
    """Scenes and levels by metrics; a metric that no file was measured with has no column."""
    from pd4dgs_codec.quality.evaluate import metric_columns

    columns = list(dict.fromkeys(column for row in rows for column in metric_columns(row)))
    lines = []
    for row in rows:
        for level in row["levels"]:
            values = ((level.get(key), digits) for _, key, digits in columns)
            numbers = ("-" if value is None else f"{value:.{digits}f}" for value, digits in values)
            lines.append((row["name"], str(level["level"]), f"{level['cumulative_bytes']:,}", *numbers))
    return markdown(("scene", "level", "bytes so far", *(title for title, _, _ in columns)), lines)


PAGE = Page("evaluation", "evaluation.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = options(__doc__, list(SCENES)).parse_args(argv)
    configure()

    from pd4dgs_codec.io import finite
    from pd4dgs_codec.quality.evaluate import evaluate_file
    from pd4dgs_codec.quality.perceptual import load_perceptual

    todo = [scene.name for scene in present(args)]
    perceptual = load_perceptual() if todo else None
    for name, why in (perceptual.absent if perceptual else {}).items():
        say(f"no {name}: {why}")

    def measure(name: str) -> Row:
        say(f"{name}: measuring")
        result = evaluate_file(args.out / name / "scene.pd4", SCENES[name].load(), perceptual=perceptual)
        keep(args.out / "evaluation", name, result)
        del result["perceptual"]["absent"]  # of this machine, with paths of its own
        levels = [{key: level[key] for key in level if key not in TIMES} for level in result["levels"]]
        found: Row = finite({"perceptual": result["perceptual"], "levels": levels})
        return found

    return make(PAGE, list(SCENES), todo, args, measure)


if __name__ == "__main__":
    sys.exit(main())
