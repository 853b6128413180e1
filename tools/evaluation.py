"""Measures trained files with every metric that is installed; writes the table of docs/evaluation.md.
Its figures in full go to docs/evaluation.json.

    python tools/evaluation.py [--only NAME ...] [--out out] [--docs docs]

Takes the files that tools/results.py left in --out/NAME/scene.pd4, and its scenes. With --only the other rows stay.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from results import SCENES, say

from pd4dgs_codec.render.threads import configure

#: The table stands between these lines.
MARKERS = ("<!-- evaluation: written by tools/evaluation.py -->", "<!-- end of evaluation -->")
#: Figures that change from run to run; docs/results.md has them.
TIMES = {"decode_seconds", "render_ms"}


def main(argv: list[str] | None = None) -> int:
    names = [row[0] for row in SCENES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, default=names)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args(argv)
    configure()

    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.errors import Pd4Error
    from pd4dgs_codec.jsonable import finite
    from pd4dgs_codec.metrics import load_perceptual
    from pd4dgs_codec.view.evaluate import evaluate_file

    page, store = args.docs / "evaluation.md", args.docs / "evaluation.json"
    perceptual = load_perceptual()
    for name, why in perceptual.absent.items():
        say(f"no {name}: {why}")
    try:
        around_table(page)
        results: dict[str, Any] = json.loads(store.read_text()) if store.is_file() else {}
        for name, source, downscale, *_ in SCENES:
            if name in args.only:
                say(f"{name}: measuring")
                file = args.out / name / "scene.pd4"
                result = evaluate_file(file, load(source, downscale=downscale), perceptual=perceptual)
                levels = [{key: row[key] for key in row if key not in TIMES} for row in result["levels"]]
                del result["perceptual"]["absent"]  # of this machine, with paths of its own
                results[name] = finite(result | {"levels": levels})
    except (Pd4Error, OSError, ValueError) as error:
        print(f"evaluation: error: {error}", file=sys.stderr)
        return 1
    results = {name: results[name] for name in names if name in results}
    store.write_text(json.dumps(results, indent=1) + "\n")
    before, after = around_table(page)
    page.write_text(f"{before}\n\n{table(results)}\n\n{after}")
    return 0


def around_table(page: Path) -> tuple[str, str]:
    """The page up to the table's first marker and from its second one; DataError without them."""
    from pd4dgs_codec.errors import DataError

    text = page.read_text()
    if not all(text.count(marker) == 1 for marker in MARKERS):
        raise DataError(f"{page}: expected each of the table's markers once: {' '.join(MARKERS)}")
    start, end = text.index(MARKERS[0]) + len(MARKERS[0]), text.index(MARKERS[1])
    return text[:start], text[end:]


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: scenes and levels by metrics; a metric that no file was measured with has no column."""
    from pd4dgs_codec.bench.markdown import markdown
    from pd4dgs_codec.view.evaluate import metric_columns

    columns = list(dict.fromkeys(column for result in results.values() for column in metric_columns(result)))
    rows = []
    for name, result in results.items():
        for row in result["levels"]:
            values = ((row.get(key), digits) for _, key, digits in columns)
            numbers = ("-" if value is None else f"{value:.{digits}f}" for value, digits in values)
            rows.append((name, str(row["level"]), f"{row['cumulative_bytes']:,}", *numbers))
    return markdown(("scene", "level", "bytes so far", *(title for title, _, _ in columns)), rows)


if __name__ == "__main__":
    raise SystemExit(main())
