"""Pages of the docs that a tool writes: docs/NAME.md, and what it shows in docs/figures/NAME.json.

A tool measures, leaves all that it found in out/, keeps the figures that the page shows, and makes the page from these
alone. Git holds page and figures. Each row of figures names the commit that it was measured at.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import DataError, Pd4Error

ROOT = Path(__file__).resolve().parents[2]
#: Significant digits of a figure in git; pages show fewer.
DIGITS = 8
WIDTH = 120

#: One row of figures: "name" and "commit", and what the page shows.
Row = dict[str, Any]


@dataclass(frozen=True)
class Page:
    """One page. name: docs/NAME.md. tool: what follows `python tools/`. render: rows -> Markdown. title: of a page that
    is written as a whole; without one, text around the page's markers is written by hand."""

    name: str
    tool: str
    render: Callable[[Sequence[Row]], str]
    title: str = ""

    def read(self, docs: Path) -> list[Row]:
        """Its figures, none if there are none yet."""
        path = docs / "figures" / f"{self.name}.json"
        rows: list[Row] = json.loads(path.read_text()) if path.is_file() else []
        return rows

    def text(self, docs: Path, rows: Sequence[Row]) -> str:
        """The whole page as these figures make it."""
        path = docs / f"{self.name}.md"
        block = f"{stamp(f'python tools/{self.tool}', rows, bool(self.title))}\n\n{self.render(rows)}"
        if self.title:
            return f"# {self.title}\n\n{block}\n"
        return filled(path.read_text(), self.name, self.tool, block, path)

    def write(self, docs: Path, rows: Sequence[Row]) -> None:
        """The figures, shortened, and the page that is made from them."""
        path, page = docs / "figures" / f"{self.name}.json", docs / f"{self.name}.md"
        for folder in (path.parent, page.parent):
            folder.mkdir(parents=True, exist_ok=True)
        path.write_text(dumps(shortened(rows)) + "\n")
        page.write_text(self.text(docs, self.read(docs)))


def filled(text: str, name: str, tool: str, block: str, path: Path) -> str:
    """`text` with `block` between the two markers of `name`. Raises DataError naming `path` without them."""
    begin, end = f"<!-- {name}: written by tools/{tool.split()[0]} -->", f"<!-- end of {name} -->"
    if text.count(begin) != 1 or text.count(end) != 1:
        raise DataError(f"{path}: expected each of these lines once: {begin} {end}")
    return f"{text[: text.index(begin)]}{begin}\n\n{block}\n\n{text[text.index(end) :]}"


def stamp(command: str, rows: Sequence[Row], whole: bool) -> str:
    """The sentence that says what made the figures, and at which commit each was made. whole: there is nothing else."""
    commits: dict[str, list[str]] = {}
    for row in rows:
        names = commits.setdefault(row["commit"], [])
        names += [row["name"]] if row["name"] not in names else []
    which = {c: f" ({', '.join(names)})" if len(commits) > 1 else "" for c, names in commits.items()}
    told = " and ".join(f"`{c}`{names}" for c, names in which.items())
    what = "This page is an artefact. Its figures" if whole else "The figures here"
    return f"{what} are of commit {told}; `{command}` makes them anew."


def commit(checkout: Path = ROOT) -> str:
    """The commit that is checked out, short, and whether its package was changed since; "unknown" without git."""
    try:
        head = ["git", "-C", str(checkout), "rev-parse", "--short=7", "HEAD"]
        name = subprocess.run(head, capture_output=True, text=True, check=True).stdout.strip()
        tree = ["git", "-C", str(checkout), "status", "--porcelain", "--", "pd4dgs_codec"]
        changed = subprocess.run(tree, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{name}, changed" if changed else name


def shortened(value: Any) -> Any:
    """`value` with every float rounded to DIGITS significant digits."""
    if isinstance(value, dict):
        return {key: shortened(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [shortened(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def dumps(value: Any, indent: int = 0) -> str:
    """JSON that git can compare: what fits into a line stands on one."""
    flat = json.dumps(value, ensure_ascii=False, allow_nan=False)
    if not isinstance(value, (dict, list)) or len(flat) + indent <= WIDTH:
        return flat
    pad, inner = " " * indent, " " * (indent + 1)
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {dumps(item, indent + 1)}" for key, item in value.items()]
    else:
        items = [dumps(item, indent + 1) for item in value]
    left, right = "{}" if isinstance(value, dict) else "[]"
    return f"{left}\n{inner}" + f",\n{inner}".join(items) + f"\n{pad}{right}"


def paragraph(text: str) -> list[str]:
    """Lines of at most 120 characters."""
    return textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def unpadded(table: str) -> str:
    """Markdown tables without the blanks that line up their columns: wide ones take half the bytes."""
    lines = []
    for line in table.split("\n"):
        if line.startswith("|"):
            cells = [cell.strip() for cell in line.replace("\\|", "\0").strip("|").split("|")]
            cells = ["-" if cell and not cell.strip("-") and len(cell) > 1 else cell for cell in cells]
            line = f"| {' | '.join(cells)} |".replace("\0", "\\|")
        lines.append(line)
    return "\n".join(lines)


def say(line: str) -> None:
    """Prints a stage as it begins."""
    print(line, flush=True)


def options(doc: str | None, names: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The options that the tools share. names: what --only may choose from."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if names:
        parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, help="these alone; other rows stay")
    parser.add_argument("--out", type=Path, default=Path("out"), help="where trainings are and all figures go to (out)")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="where the page is (docs)")
    parser.add_argument("--render", action="store_true", help="make the page from its figures and measure nothing")
    return parser


def make(
    page: Page,
    names: Sequence[str],
    todo: Sequence[str],
    args: argparse.Namespace,
    measure: Callable[[str], Row],
    finish: Callable[[list[Row]], None] = lambda rows: None,
) -> int:
    """Measures a row for each of `todo` and writes the page after each; other rows of it stay, all in the order of
    `names`. With --render nothing is measured.

    finish: called with all rows once the page is written. Returns the exit code; a failure is one line.
    """
    rows = {row["name"]: row for row in page.read(args.docs)}
    try:
        if not (todo or args.render):
            raise DataError(f"none of {', '.join(names)} is there")
        for name in [None] if args.render else todo:
            if name is not None:
                rows[name] = {"name": name, "commit": commit()} | measure(name)
            page.write(args.docs, [rows[n] for n in names if n in rows])
            finish(page.read(args.docs))
    except (Pd4Error, OSError, KeyboardInterrupt) as error:
        print(f"{page.name}: error: {str(error) or 'interrupted'}", file=sys.stderr)
        return 1
    return 0


def keep(out: Path, name: str, whole: Any) -> None:
    """Leaves all that was measured in out/NAME.json."""
    from pd4dgs_codec.io import finite

    path = out / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(finite(whole), indent=1) + "\n")
