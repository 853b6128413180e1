"""The stability table: cases, their outcomes as rows, and the scene that the cases share."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from pd4dgs_codec.bench.report import markdown, optional
from pd4dgs_codec.errors import DataError, Pd4Error
from pd4dgs_codec.scene import Camera, Deformation, Network, Scene, SceneInfo, Steps, Widths

PASS, REFUSED, FAIL = "pass", "refused", "fail"
#: Modules with cases, in the order of the table.
MODULES = ("stable_symbols", "stable_scenes")
#: The outcome in words, and the error; NaN fails every bound.
Found = tuple[str, float]


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input. fed, promised: in words. bound: the largest error that passes. refuses: the error
    that must be raised instead, for input without an answer; bound is then unused."""

    group: str
    case: str
    fed: str
    promised: str
    bound: float
    measure: Callable[[], Found]
    refuses: type[Pd4Error] | None = None


@dataclass(frozen=True)
class Row:
    """A case and its outcome. error and bound: None if nothing was measured. status: pass, refused or fail."""

    case: str
    group: str
    fed: str
    promised: str
    got: str
    error: float | None
    bound: float | None
    status: str


def refusal(group: str, case: str, fed: str, error: type[Pd4Error], act: Callable[[], object]) -> Case:
    """The case of an input that must be refused with `error` in one line; if `act` returns, the row fails."""

    def measure() -> Found:
        act()
        return "accepted", math.nan

    return Case(group, case, fed, f"refused in one line ({error.__name__})", math.nan, measure, error)


def judge(case: Case) -> Row:
    """Runs a case. Every exception is a failed row, except the promised refusal and a missing module, which is
    raised."""
    error: float | None = None
    try:
        got, error = case.measure()
        status = PASS if case.refuses is None and error <= case.bound else FAIL
    except ModuleNotFoundError:
        raise
    except Exception as problem:
        kept = case.refuses is not None and isinstance(problem, case.refuses) and "\n" not in str(problem)
        status = REFUSED if kept else FAIL
        got = " ".join(f"{type(problem).__name__}: {problem}".split())
    bound = None if case.refuses else case.bound
    return Row(case.case, case.group, case.fed, case.promised, got, error, bound, status)


def chosen(name: str | None) -> list[Case]:
    """The cases of the group `name`, else those with `name` in their own name; all for None. In the table's order."""
    modules = (import_module(f"{__package__}.{module}") for module in MODULES)
    cases: list[Case] = [case for module in modules for case in module.cases()]
    if name is None:
        return cases
    return [c for c in cases if c.group == name] or [c for c in cases if name.lower() in c.case.lower()]


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Rows per status."""
    found = Counter(row.status for row in rows)
    return {status: found[status] for status in (PASS, REFUSED, FAIL)}


def text(rows: Sequence[Row]) -> str:
    """The rows as one Markdown table per group, and a line with the counts."""
    head, parts = ("case", "fed", "promised", "came out", "error", "bound", "status"), []
    for group in dict.fromkeys(row.group for row in rows):
        cells = [
            (r.case, r.fed, r.promised, r.got, optional(r.error, ".2g"), optional(r.bound, ".2g"), r.status)
            for r in rows
            if r.group == group
        ]
        parts.append(f"## {group}\n\n" + markdown(head, [[c.replace("|", "\\|") for c in line] for line in cells]))
    found = counts(rows)
    parts.append(f"{len(rows)} rows: {found[PASS]} pass, {found[REFUSED]} refused as promised, {found[FAIL]} fail")
    return "\n\n".join(parts)


# -- shared by the cases -----------------------------------------------------------------------------------------------


def mpmath() -> Any:
    """The library of the high-precision references. Raises DataError if it is not installed."""
    try:
        return import_module("mpmath")
    except ModuleNotFoundError:
        message = "the references of the stability table need mpmath, which is not installed"
        raise DataError(f"{message}: pip install 'pd4dgs-codec[test]'") from None


def largest(errors: Iterable[float]) -> float:
    """The largest of some numbers, NaN if one is NaN."""
    return float(np.max(np.array(list(errors))))


WIDTH, HEIGHT = 40, 30
BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
_VIEWMAT = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], np.float32)
CAMERA = Camera(_VIEWMAT, np.array([[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]], np.float32), WIDTH, HEIGHT)


def small_scene(deformation: Deformation | None = None, mask: int = 255) -> Scene:
    """40 anchors in front of CAMERA: layer 0, or layers 0 and 1 with a global deformation. mask: of every anchor."""
    rng, anchors = np.random.default_rng(3), 40
    layers = (0,) if deformation is None else (0, 1)
    cells = rng.choice(21**3, anchors, replace=False)
    networks: dict[str, Network] = {
        name: ((rng.normal(0, 0.3, (n, 35)).astype(np.float32), np.full(n, 0.2, np.float32)),)
        for name, n in Widths().networks.items()
    }
    return Scene(
        info=SceneInfo(0.0625, BOX, (0.0, 1.0), (0.25, 0.5, 0.75), 0.0625, 100.0, (0.0, -1.0, 0.0), 0.0, CAMERA),
        steps=Steps(),
        layers=layers,
        rows=(anchors,) * len(layers),
        anchor_q=np.stack(np.unravel_index(cells, (21, 21, 21)), 1).astype(np.int32) - 10,
        feature=rng.normal(0, 1, (anchors, 32)).astype(np.float32),
        scaling_log=rng.normal(-2.5, 0.3, (anchors, 6)).astype(np.float32),
        offset=rng.normal(0, 1, (anchors, 10, 3)).astype(np.float32),
        mask=(np.full(anchors, mask, np.uint8),) * len(layers),
        networks=networks,
        global_deformation=deformation,
    )
