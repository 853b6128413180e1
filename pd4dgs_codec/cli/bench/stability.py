"""`pd4dgs-bench stability`: stiff and extreme cases, each against its bound."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from pd4dgs_codec.cli.bench.output import prepare, publish
from pd4dgs_codec.cli.common import FAILED, OK, Console, Parser, UsageError, use_threads
from pd4dgs_codec.cli.progress import progress_bar

DETAILS = """\
A row passes if its error is within its bound, or if input that has no answer was refused in one line. References are
computed by mpmath or in float64. The exit code is 1 if any row fails.

groups: rate, fitting, quantiser, hexplane, deformation, masks, rasteriser, training
The row that compares one thread with two is there only where numba has two.

examples:
  pd4dgs-bench stability > table.md
  pd4dgs-bench stability --only rasteriser
  pd4dgs-bench stability --only needle --json
  pd4dgs-bench stability --json rows.json > table.md"""


def parser() -> Parser:
    """The options of the report."""
    summary = "Feed stiff and extreme cases, and print a Markdown table of what became of each."
    p = Parser("bench stability", "", summary, DETAILS)
    p.add_argument("--only", metavar="NAME", help="the group NAME, or the cases with NAME in their name")
    p.add_common(json_file=True)
    return p


def execute(args: argparse.Namespace, console: Console) -> int:
    """Runs the chosen cases; FAILED if any row fails."""
    prepare(args, console)
    use_threads(args)
    from pd4dgs_codec.bench.stability import rows as kinds
    from pd4dgs_codec.bench.stability import table

    kinds.mpmath()
    cases = table.chosen(table.all_cases(), args.only)
    if not cases:
        raise UsageError(f"--only: found {args.only!r}, expected a group or a part of a case's name")
    with progress_bar(len(cases), "cases", "stability") as step:
        rows = table.run(cases, step)
    for row in rows:
        if row.status == kinds.FAIL:
            console.message(f"fail: {row.group}: {row.case}: {row.got}, error {row.error}, bound {row.bound}")
    result = {"rows": [asdict(row) for row in rows], "counts": table.counts(rows)}
    publish(args, console, result, table.text(rows))
    return FAILED if any(row.status == kinds.FAIL for row in rows) else OK
