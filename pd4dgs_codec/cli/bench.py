"""`pd4dgs-bench`: reports on the codec, the renderer and the trainer themselves."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

from pd4dgs_codec.cli.common import FAILED, OK, Console, Parser, UsageError, run, use_threads
from pd4dgs_codec.cli.files import STDIO, check_output, write_bytes
from pd4dgs_codec.cli.progress import progress_bar
from pd4dgs_codec.jsonable import finite

STABILITY = "stability"

DETAILS = """\
REPORT is one of
  stability   stiff and extreme cases: what was fed, promised and came out, against high-precision references

examples:
  pd4dgs-bench stability
  pd4dgs-bench stability --help"""

STABILITY_DETAILS = """\
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
    """The options of `pd4dgs-bench` without a report."""
    p = Parser("bench", "REPORT", "Measure what the codec, the renderer and the trainer promise.", DETAILS)
    p.add_argument("report", metavar="REPORT", choices=(STABILITY,), help="what to measure, see below")
    p.add_common()
    return p


def stability_parser() -> Parser:
    """The options of `pd4dgs-bench stability`."""
    summary = "Feed stiff and extreme cases, and print a Markdown table of what became of each."
    p = Parser(f"bench {STABILITY}", "", summary, STABILITY_DETAILS)
    p.add_argument("--only", metavar="NAME", help="the group NAME, or the cases with NAME in their name")
    p.add_common(json_file=True)
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == [STABILITY]:
        return run(stability_parser(), _stability, arguments[1:])
    return run(parser(), _misplaced, arguments)


def _misplaced(args: argparse.Namespace, console: Console) -> int:
    raise UsageError(f"found options before {args.report!r}, expected the report first")


def _stability(args: argparse.Namespace, console: Console) -> int:
    to_file = args.json not in (None, STDIO)
    console.json = args.json == STDIO
    if to_file:
        check_output(args.json, args.overwrite)
    use_threads(args)
    from pd4dgs_codec.report.stability import rows as kinds
    from pd4dgs_codec.report.stability import table

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
    if to_file:
        write_bytes(args.json, (json.dumps(finite(result), indent=1) + "\n").encode(), args.overwrite)
    console.result(result, table.text(rows), on_stdout=True)
    return FAILED if any(row.status == kinds.FAIL for row in rows) else OK
