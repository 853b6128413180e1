"""What a row of the stability table is, and how a case becomes one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

from pd4dgs_codec.errors import DataError, Pd4Error

PASS, REFUSED, FAIL = "pass", "refused", "fail"


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input.

    fed, promised: in words. bound: the largest error that keeps the promise. measure: does the work and returns what
    came out, in words, and the error (NaN breaks the promise). refuses: the error that must be raised instead, for
    input that has no answer; bound is then unused.
    """

    group: str
    case: str
    fed: str
    promised: str
    bound: float
    measure: Callable[[], tuple[str, float]]
    refuses: type[Pd4Error] | None = None


@dataclass(frozen=True)
class Row:
    """A case and its outcome. error and bound: None where there was nothing to measure. status: pass, refused, fail."""

    case: str
    group: str
    fed: str
    promised: str
    got: str
    error: float | None
    bound: float | None
    status: str


def refusal(group: str, case: str, fed: str, error: type[Pd4Error], act: Callable[[], object]) -> Case:
    """The case of an input that must be refused with `error` in one line; anything that `act` returns is a failure."""

    def measure() -> tuple[str, float]:
        act()
        return "accepted", math.nan

    return Case(group, case, fed, f"refused in one line ({error.__name__})", math.nan, measure, error)


def judge(case: Case) -> Row:
    """Runs a case. Whatever it raises is a failed row, but for the refusal that was promised; a module that is missing
    is the caller's concern."""
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


def mpmath() -> ModuleType:
    """The library of the high-precision references. Raises DataError where it is not installed."""
    try:
        import mpmath as library
    except ModuleNotFoundError:
        message = "the references of the stability table need mpmath, which is not installed"
        raise DataError(f"{message}: pip install 'pd4dgs-codec[test]'") from None
    return library
