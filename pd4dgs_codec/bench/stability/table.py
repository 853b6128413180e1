"""The stability table: the cases of every room, run one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from pd4dgs_codec.bench.markdown import markdown
from pd4dgs_codec.bench.stability import deformation, fitting, quantiser, rasteriser, rate, training
from pd4dgs_codec.bench.stability.rows import FAIL, PASS, REFUSED, Case, Row, judge

ROOMS = (rate, fitting, quantiser, deformation, rasteriser, training)


def all_cases() -> list[Case]:
    """Every case, in the table's order. Needs torch and numba."""
    return [case for room in ROOMS for case in room.cases()]


def chosen(cases: Sequence[Case], name: str | None) -> list[Case]:
    """The cases of the group `name`, else those with `name` in their own name; all for None."""
    if name is None:
        return list(cases)
    return [c for c in cases if c.group == name] or [c for c in cases if name.lower() in c.case.lower()]


def run(cases: Sequence[Case], step: Callable[[], None] = lambda: None) -> list[Row]:
    """A row per case; `step` is called after each."""
    rows = []
    for case in cases:
        rows.append(judge(case))
        step()
    return rows


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Rows per status."""
    found = Counter(row.status for row in rows)
    return {status: found[status] for status in (PASS, REFUSED, FAIL)}


def text(rows: Sequence[Row]) -> str:
    """The rows as one Markdown table per group, and a line that counts them."""
    parts = []
    for group in dict.fromkeys(row.group for row in rows):
        head = ("case", "fed", "promised", "came out", "error", "bound", "status")
        lines: list[tuple[Any, ...]] = [
            (r.case, r.fed, r.promised, r.got, _number(r.error), _number(r.bound), r.status)
            for r in rows
            if r.group == group
        ]
        cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
        parts.append(f"## {group}\n\n" + markdown(head, cells))
    found = counts(rows)
    parts.append(f"{len(rows)} rows: {found[PASS]} pass, {found[REFUSED]} refused as promised, {found[FAIL]} fail")
    return "\n\n".join(parts)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"
