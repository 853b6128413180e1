"""Promises about stiff and extreme inputs, and the outcome of testing one, a row of the stability table."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pd4dgs_codec.errors import Pd4Error

PASS, REFUSED, FAIL = "pass", "refused", "fail"
#: The outcome in words, and the error; NaN exceeds every bound.
Found = tuple[str, float]
#: A case and its outcome: group, case, fed, promised, got, error, bound (both None if nothing was measured), status.
Row = dict[str, Any]


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


def refusal(group: str, error: type[Pd4Error], act: Callable[..., object], *inputs: tuple[Any, ...]) -> Promise:
    """The promise that `act` refuses each input with `error` in one line."""
    return Promise(group, f"refused in one line ({error.__name__})", act, inputs, refuses=error)


def run_case(promise: Promise, given: tuple[Any, ...]) -> Row:
    """Tests one input and returns its row. Any exception fails the row, except the promised refusal."""
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
    except Exception as problem:
        kept = promise.refuses is not None and isinstance(problem, promise.refuses) and "\n" not in str(problem)
        status = REFUSED if kept else FAIL
        got = " ".join(f"{type(problem).__name__}: {problem}".split())
    row = {"group": promise.group, "case": case, "fed": fed, "promised": promise.promised}
    return row | {"got": got, "error": error, "bound": bound, "status": status}


def largest(errors: Iterable[float]) -> float:
    """Returns the largest number, NaN if one is NaN."""
    return float(np.max(np.array(list(errors))))
