"""What the reports share: which pictures to take, and JSON, a Markdown table and a plot as their outcome."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pd4dgs_codec.atomic import whole_file
from pd4dgs_codec.cli.common import Console, Parser, UsageError, count, positive_int
from pd4dgs_codec.cli.files import STDIO, check_output, write_bytes
from pd4dgs_codec.jsonable import finite

if TYPE_CHECKING:
    from pd4dgs_codec.bench.plot import Panel

T = TypeVar("T")


def add_views(p: Parser, views: str) -> None:
    """The options that say which pictures to take; views: how many are taken without --views, in words."""
    group = p.add_argument_group("pictures")
    what = "dataset whose held-out views give the cameras (default: the file's own camera over time)"
    group.add_argument("--data", metavar="SOURCE", help=what)
    group.add_argument("--downscale", type=positive_int, metavar="K", help="pictures 1/K as wide and high (default: 1)")
    group.add_argument("--holdout", type=count, metavar="K", help="as in pd4dgs-train (default: 8)")
    group.add_argument("--views", type=positive_int, metavar="N", help=f"how many pictures (default: {views})")


def add_output(p: Parser) -> None:
    """--plot and the common options; --json may name a file."""
    p.add_argument("--plot", metavar="FILE.png", help="write a plot: error against cost, log-log, Pareto front marked")
    p.add_common(json_file=True)


def prepare(args: argparse.Namespace, console: Console) -> None:
    """Refuses outputs that cannot be written, before any work; args.plot need not be there."""
    console.json = args.json == STDIO
    plot = getattr(args, "plot", None)
    if plot is not None and Path(plot).suffix.lower() != ".png":
        raise UsageError(f"found --plot {plot}, expected a name that ends in .png")
    for path in (plot, None if args.json == STDIO else args.json):
        if path is not None:
            check_output(path, args.overwrite)


def finish(
    args: argparse.Namespace,
    console: Console,
    result: dict[str, Any],
    text: str,
    panels: Sequence[Panel],
    ylabel: str,
) -> None:
    """Draws the plot, if it was asked for, and publishes the rest."""
    if args.plot is not None:
        from pd4dgs_codec.bench.plot import draw

        with whole_file(args.plot, args.overwrite) as temporary:
            draw(panels, ylabel, temporary)
    publish(args, console, result, text)


def publish(args: argparse.Namespace, console: Console, result: dict[str, Any], text: str) -> None:
    """Writes the JSON file, and prints the text, or the JSON where that was asked for."""
    if args.json not in (None, STDIO):
        write_bytes(args.json, (json.dumps(finite(result), indent=1) + "\n").encode(), args.overwrite)
    console.result(result, text, on_stdout=True)


def listed(kind: Callable[[str], T]) -> Callable[[str], tuple[T, ...]]:
    """An option's type: comma-separated values of a kind, each once, in the order given."""

    def parse(text: str) -> tuple[T, ...]:
        return tuple(dict.fromkeys(kind(part) for part in text.split(",")))

    return parse


def one_of(names: Sequence[str]) -> Callable[[str], str]:
    """An option's type: one of the names."""

    def parse(text: str) -> str:
        if text not in names:
            raise argparse.ArgumentTypeError(f"found {text!r}, expected one of {', '.join(names)}")
        return text

    return parse
