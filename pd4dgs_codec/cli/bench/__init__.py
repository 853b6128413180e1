"""`pd4dgs-bench`: reports on the codec, the renderer and the trainer themselves; one module per report."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from pd4dgs_codec.cli.common import Console, Parser, UsageError, run

#: Report: what it is. The module of that name holds its `parser()` and `execute(args, console)`.
REPORTS = {
    "codec": "error against bytes and seconds per step, mode and effort; other coders on the same data",
    "render": "the rasteriser's error against milliseconds: precision, tiles, thresholds",
    "train": "held-out quality against wall time per preset",
    "latency": "seconds from the request to bytes and pictures over a slow link, and what the client does under faults",
    "stability": "stiff and extreme cases: what was fed, promised and came out, against high-precision references",
}


def details() -> str:
    """The text of `pd4dgs-bench --help` below the options."""
    lines = [f"  {name:<11} {what}" for name, what in REPORTS.items()]
    examples = [f"  pd4dgs-bench {name} --help" for name in REPORTS]
    return "\n".join(["REPORT is one of", *lines, "", "examples:", *examples])


def parser() -> Parser:
    """The options of `pd4dgs-bench` without a report."""
    p = Parser("bench", "REPORT", "Measure what the codec, the renderer and the trainer promise.", details())
    p.add_argument("report", metavar="REPORT", choices=tuple(REPORTS), help="what to measure, see below")
    p.add_common()
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in REPORTS:
        report = importlib.import_module(f"{__name__}.{arguments[0]}")
        return run(report.parser(), report.execute, arguments[1:])
    return run(parser(), _misplaced, arguments)


def _misplaced(args: argparse.Namespace, console: Console) -> int:
    raise UsageError(f"found options before {args.report!r}, expected the report first")
