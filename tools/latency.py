"""Measures what docs/latency.md shows: seconds to the first picture, and what the client does under faults.

    python tools/latency.py [--out out] [--docs docs] [--runs 9] [--render]

Reads what tools/results.py trained, and the scene in PD4DGS_SHARED for the quality axis. About 12 minutes on two quiet
cores; on busy ones the times are worthless. The faults are those of the tests (tests/web/fault_table.py). The exit
code is 1 if a picture under faults is not the right one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pages.page import ROOT, Page, Row, keep, make, options, say
from pages.scenes import SCENES

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.threads import configure

NAMES = ("shelf-hand", "shelf-hand-paper")
RATES = (2e6, 10e6, 50e6)
ANCHORS, SIZE, RATE = 25_000, (480, 360), 10e6
CUTS = 1000
#: Lines that can be told apart: of the faults the first ones are drawn.
MOST_FAULTS = 5


def fault_table() -> Any:
    """The module of the tests that knows the faults."""
    sys.path.insert(0, str(ROOT / "tests" / "delivery"))
    import fault_table as table

    return table


def measure(out: Path, docs: Path, runs: int) -> Row:
    """All that the page shows, from the files of NAMES in `out`."""
    from pd4dgs_codec.bench import latency
    from pd4dgs_codec.draw.warm import warm_up

    contents = {name: (out / name / "scene.pd4").read_bytes() for name in NAMES}
    warm_up()
    files = []
    for name, data in contents.items():
        say(f"{name}: {runs} runs at {len(RATES)} rates")
        dataset = SCENES[name].load() if SCENES[name].there else None
        files.append(latency.report(f"{name}/scene.pd4", data, RATES, runs, dataset=dataset))
    say(f"{NAMES[1]}: with {ANCHORS:,} anchors")
    larger = latency.with_anchors(contents[NAMES[1]], ANCHORS)
    reports = [*files, latency.report(f"{NAMES[1]}/scene.pd4", larger, (RATE,), runs, SIZE)]
    table = fault_table()
    file = table.File(contents[NAMES[0]])
    say(f"{NAMES[0]}: faults, {CUTS:,} cuts, a crowd")
    faults = [asdict(table.run(file, scenario)) for scenario in table.scenarios(file)]
    cuts, crowd = asdict(table.random_cuts(file, CUTS)), asdict(table.crowd(file.data))
    *shown, large = [asdict(report) for report in reports]
    row: Row = {"runs": runs, "files": shown, "larger": large, "faults": faults, "cuts": cuts, "crowd": crowd}
    keep(out, "latency", row)
    lines = {f["name"]: [(at, level) for of, level, at in f["shown"] if of == "old"] for f in faults[:MOST_FAULTS]}
    latency.draw(files[0], docs / "img" / "latency.png", (f"under faults, {table.RATE / 1e6:g} Mbps", lines))
    return row


# -- the page ----------------------------------------------------------------------------------------------------------


def _report(file: dict[str, Any]) -> Any:
    from pd4dgs_codec.bench.latency import FileReport, Times

    return FileReport(**file | {"times": [Times(**time) for time in file["times"]]})


def render(rows: Sequence[Row]) -> str:
    """Times of both files, beside monolithic models, under faults; times of the larger file."""
    from pd4dgs_codec.bench.latency import text

    (row,) = rows
    cuts, crowd = row["cuts"], row["crowd"]
    what = f"{cuts['cuts']:,} random cuts and resets in {cuts['transfers']:,} transfers without a limit"
    wrong = f"{len(crowd['errors'])} errors: {'; '.join(crowd['errors'][:3])}" if crowd["errors"] else "no error"
    link = f"{crowd['clients']} clients at once, {crowd['bytes']:,} bytes each over one link of {_rate(crowd['rate'])}"
    return "\n\n".join(
        [
            text([_report(file) for file in row["files"]], row["runs"]),
            _faults(row["faults"]),
            f"{what}: {cuts['wrong']} transfers with a picture that differs; {cuts['seconds']:.0f} s.",
            f"{link}: {wrong}, {crowd['seconds']:.2f} s (8S/B: {crowd['expected']:.2f} s).",
            text([_report(row["larger"])], row["runs"]).split("\n\n## Beside")[0],
        ]
    )


def _faults(rows: Sequence[dict[str, Any]]) -> str:
    table = fault_table()
    cells = []
    for row in rows:
        shown = ", ".join(
            f"{'' if name == 'old' else name + ' '}{level} at {at:.2f}" for name, level, at in row["shown"]
        )
        did = ", ".join(_count(row[f"{what}s"], what) for what in ("request", "cut", "change"))
        end = row["error"].replace("|", "\\|") or "all is here"
        cells.append((row["name"], shown or "nothing", end, did, f"{row['sent']:,}", "yes" if row["kept"] else "NO"))
    said = (
        f"At {_rate(table.RATE)}; silence counts as a cut after {table.STALL_SECONDS:g} s here (10 by default). Shown: "
        "levels as they are decoded, those of the file that took the place of the first one called new. Right: each "
        "equals, array by array, that of an uninterrupted decode, and the transfer ended as it had to."
    )
    head = ("the link or the server", "shown, at seconds since the request", "then", "did", "bytes sent", "right")
    return f"## Faults\n\n{said}\n\n{markdown(head, cells)}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _rate(rate: float) -> str:
    return f"{rate / 1e6:g} Mbps"


PAGE = Page("latency", "latency.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__)
    parser.add_argument("--runs", type=int, default=9, metavar="N", help="runs that medians are taken of (default: 9)")
    args = parser.parse_args(argv)
    configure()
    todo = [] if args.render else ["latency"]
    code = make(PAGE, ["latency"], todo, args, lambda name: measure(args.out, args.docs, args.runs))
    if code == 0:
        (row,) = PAGE.read(args.docs)
        wrong = [fault["name"] for fault in row["faults"] if not fault["kept"]]
        wrong += ["random cuts"] if row["cuts"]["wrong"] else []
        wrong += ["clients at once"] if row["crowd"]["errors"] else []
        for name in wrong:
            print(f"latency: error: wrong under faults: {name}", file=sys.stderr)
        code = int(bool(wrong))
    return code


if __name__ == "__main__":
    sys.exit(main())
