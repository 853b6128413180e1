"""The stability table: promises, their inputs, outcomes as rows, and a scene that some inputs share."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from pd4dgs_codec.bench.report import markdown, optional
from pd4dgs_codec.errors import Pd4Error, required
from pd4dgs_codec.scene import Camera, Deformation, Network, Scene, SceneInfo, Steps, Widths

PASS, REFUSED, FAIL = "pass", "refused", "fail"
#: Modules with PROMISES, in the order of the table.
MODULES = ("stable_symbols", "stable_scenes")
#: The outcome in words, and the error; NaN exceeds every bound.
Found = tuple[str, float]


@dataclass(frozen=True)
class Promise:
    """A promise about stiff or extreme inputs. inputs: (case, description, *arguments of `measure`), a row each.
    bound: the largest error that passes. refuses: `measure` must raise this error, in one line, instead of returning
    an error within `bound`."""

    group: str
    promised: str
    measure: Callable[..., Any]
    inputs: Sequence[tuple[Any, ...]]
    bound: float = 0.0
    refuses: type[Pd4Error] | None = None


#: A promise and one of its inputs.
Case = tuple[Promise, tuple[Any, ...]]


#: A case and its outcome: case, group, fed, promised, got, error, bound (None if nothing was measured), status.
Row = dict[str, Any]


def refusal(group: str, error: type[Pd4Error], act: Callable[..., object], *inputs: tuple[Any, ...]) -> Promise:
    """The promise that `act` refuses each input with `error` in one line."""
    return Promise(group, f"refused in one line ({error.__name__})", act, inputs, refuses=error)


def run_case(promise: Promise, given: tuple[Any, ...]) -> Row:
    """Tests one input and returns its row. Any exception fails the row, except the promised refusal; that of a missing
    module is raised."""
    case, fed, *arguments = given
    bound = error = None
    try:
        if promise.refuses is None:
            bound = promise.bound
            got, error = promise.measure(*arguments)
            status = PASS if error <= bound else FAIL
        else:
            promise.measure(*arguments)
            got, status = "accepted", FAIL
    except ModuleNotFoundError:
        raise
    except Exception as problem:
        kept = promise.refuses is not None and isinstance(problem, promise.refuses) and "\n" not in str(problem)
        status = REFUSED if kept else FAIL
        got = " ".join(f"{type(problem).__name__}: {problem}".split())
    row: Row = {"case": case, "group": promise.group, "fed": fed, "promised": promise.promised}
    return row | {"got": got, "error": error, "bound": bound, "status": status}


def chosen(name: str | None) -> list[Case]:
    """Returns the cases of the group `name`, else the cases whose name contains it, in the table's order; None: all."""
    modules = (import_module(f"{__package__}.{module}") for module in MODULES)
    cases = [(promise, given) for module in modules for promise in module.PROMISES for given in promise.inputs]
    if name is None:
        return cases
    return [c for c in cases if c[0].group == name] or [c for c in cases if name.lower() in c[1][0].lower()]


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Counts the rows per status."""
    found = Counter(row["status"] for row in rows)
    return {status: found[status] for status in (PASS, REFUSED, FAIL)}


def text(rows: Sequence[Row]) -> str:
    """Formats the rows as one Markdown table per group, and a line with the counts."""
    head, parts = ("case", "input", "promise", "result", "error", "bound", "status"), []
    for group in dict.fromkeys(row["group"] for row in rows):
        cells = [
            [*(r[key].replace("|", "\\|") for key in ("case", "fed", "promised", "got"))]
            + [optional(r["error"], ".2g"), optional(r["bound"], ".2g"), r["status"]]
            for r in rows
            if r["group"] == group
        ]
        parts.append(f"## {group}\n\n{markdown(head, cells)}")
    found = counts(rows)
    parts.append(f"{len(rows)} rows: {found[PASS]} pass, {found[REFUSED]} refused as promised, {found[FAIL]} fail")
    return "\n\n".join(parts)


# -- shared by the promises --------------------------------------------------------------------------------------------


def mpmath() -> Any:
    """The library of the high-precision references. Raises DataError if it is not installed."""
    return required("mpmath", "test", "the references of the stability table")


def largest(errors: Iterable[float]) -> float:
    """Returns the largest number, NaN if one is NaN."""
    return float(np.max(np.array(list(errors))))


WIDTH, HEIGHT = 40, 30
BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
_VIEWMAT = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], np.float32)
CAMERA = Camera(_VIEWMAT, np.array([[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]], np.float32), WIDTH, HEIGHT)


def small_scene(deformation: Deformation | None = None) -> Scene:
    """Makes 40 anchors in front of CAMERA: layer 0, or layers 0 and 1 with a global deformation."""
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
        mask=(np.full(anchors, 255, np.uint8),) * len(layers),
        networks=networks,
        global_deformation=deformation,
    )
