"""docs/results.md, made from docs/figures/results.json alone."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import Benchmark, Row

from pd4dgs_codec.io import finite, whole_file

DIGITS = 6  #: significant digits of a figure in git
INTRODUCTION = """\
`python benchmarks/run.py` made this page: it trains, packs and measures every scene. Times are wall
times on a machine that may run other work; sizes and qualities repeat for the same package and machine. 1 MB is 1e6
bytes."""


def write(docs: Path, benchmarks: Sequence[Benchmark], sections: Mapping[str, Row]) -> None:
    """The figures as JSON, and the page as they make it. sections: by the name of their benchmark."""
    figures = {"sections": shortened(finite([sections[b.name] for b in benchmarks if b.name in sections]))}
    path = docs / "figures" / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, overwrite=True) as temporary:
        temporary.write_text(lines(figures))
    with whole_file(docs / "results.md", overwrite=True) as temporary:
        temporary.write_text(text(benchmarks, json.loads(path.read_text())))


def text(benchmarks: Sequence[Benchmark], figures: Row) -> str:
    """The page. What made most sections is said once; a section that was made otherwise says so itself."""
    sections, known = figures["sections"], {b.name: b for b in benchmarks}
    made = [f"commit `{s['commit']}`, {s['date']}, `{s['command']}`, {s['machine']}" for s in sections]
    usual = max(made, key=made.count)
    common = sections[made.index(usual)]
    parts = ["# Results", wrapped(INTRODUCTION), wrapped(f"Unless a section says otherwise: {usual}.")]
    for found, by in zip(sections, made, strict=True):
        title = known[found["name"]].title
        shown = [f"![{title}: {name.rsplit('.', 1)[0]}](img/{name})" for name in found["pictures"]]
        parts += [f"## {title}", wrapped(known[found["name"]].text(found["rows"]))]
        parts += ["\n".join(shown)] if shown else []
        if by != usual:
            same = by == usual.replace(f"`{common['command']}`", f"`{found['command']}`")
            parts.append(wrapped(f"Made by `{found['command']}`." if same else f"Made at {by}."))
    return "\n\n".join(parts) + "\n"


def wrapped(markdown: str) -> str:
    """Paragraphs in lines of at most 120 characters; tables as they are."""
    blocks = markdown.split("\n\n")
    return "\n\n".join(b if b.startswith("|") else textwrap.fill(b, 120, break_on_hyphens=False) for b in blocks)


def shortened(value: Any) -> Any:
    """`value` as JSON has it, with every float rounded to DIGITS significant digits."""
    return json.loads(json.dumps(value), parse_float=lambda text: float(f"{float(text):.{DIGITS}g}"))


def lines(figures: Row) -> str:
    """JSON with a line for each row, so that git can compare it."""
    sections = []
    for found in figures["sections"]:
        head = json.dumps(found | {"rows": []})[:-1]
        rows = ",\n".join(json.dumps(row) for row in found["rows"])
        sections.append(head.replace('"rows": []', f'"rows": [\n{rows}\n]') + "}")
    return '{"sections": [\n' + ",\n".join(sections) + "\n]}\n"
