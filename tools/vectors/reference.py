"""The reference decoder under test: which of its checks refuses a file, and what it makes of the file without that
check.

Every rule of `spec/refdec.py` is held by a call of its `need`. Here the module's `need` is another function, which
knows the place that called it and lets a fault pass at one of these places: the decoder itself has no hook.
"""

from __future__ import annotations

import ast
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

PATH = Path(__file__).resolve().parents[2] / "spec" / "refdec.py"
#: Functions that check on behalf of their callers: the place of such a check is the call of the outermost of them.
HELPERS = frozenset("limited registered shortest check_finite fields a_list reals real a_step".split())
READER = "Reader."
#: Bytes that end early are one rule (clause 15), wherever they are missed.
TAKE = "Reader.take"

SECONDS = 60  #: of processor time for one file; the slowest of the vectors takes a third
MEMORY = 3 << 30  #: bytes of address space


@dataclass(frozen=True)
class Check:
    """A place where the reference decoder refuses files: (function, line) of the calls from the rule's own function
    inwards. line: that of the call of `need`. clauses: those that the functions quote."""

    calls: tuple[tuple[str, int], ...]
    line: int = field(compare=False)
    clauses: frozenset[str] = field(compare=False)

    def __str__(self) -> str:
        return " > ".join(f"{function}:{line}" for function, line in self.calls)


@dataclass(frozen=True)
class Outcome:
    """What the decoder makes of a file. error: a name of clause 15, "crash" or "runs away", None if it decodes; hashes:
    then those of clause 12.4. check: the place that refused it. what: the fault in words."""

    error: str | None
    hashes: list[dict] | None = None
    check: Check | None = None
    what: str = ""

    @property
    def answer(self) -> object:
        """All that a user of the decoder sees."""
        return self.hashes if self.error is None else self.error


class RunsAway(BaseException):
    """A file takes more processor time than SECONDS."""


@cache
def reference_source() -> str:
    """The text of spec/refdec.py."""
    return PATH.read_text(encoding="utf-8")


class Reference:
    """The decoder that a source text of refdec.py makes."""

    def __init__(self, source: str | None = None):
        self.source = source or reference_source()
        self.module = ModuleType("refdec")
        exec(compile(self.source, PATH.name, "exec"), self.module.__dict__)

    @cached_property
    def _functions(self) -> dict[int, tuple[str, frozenset[str]]]:
        """First line of each named function -> its name and the clauses quoted above it, or above its class."""
        found: dict[int, tuple[str, frozenset[str]]] = {}
        for node in ast.parse(self.source).body:
            if isinstance(node, ast.FunctionDef):
                found[node.lineno] = node.name, self._quoted(node.lineno)
            elif isinstance(node, ast.ClassDef):
                for method in node.body:
                    if isinstance(method, ast.FunctionDef):
                        clauses = self._quoted(method.lineno) or self._quoted(node.lineno)
                        found[method.lineno] = f"{node.name}.{method.name}", clauses
        return found

    def _quoted(self, line: int) -> frozenset[str]:
        above = []
        for text in reversed(self.source.splitlines()[: line - 1]):
            if not text.lstrip().startswith("#"):
                break
            above.append(text)
        return frozenset(found[1] for text in above if (found := re.match(r' *# (\d+(?:\.\d+)?) [A-Z][^:]*: "', text)))

    def rules(self) -> dict[int, str]:
        """Line of every call of `need` -> what it asks for, as the source has it."""
        calls = (node for node in ast.walk(ast.parse(self.source)) if isinstance(node, ast.Call))
        return {
            node.lineno: ast.unparse(node.args[0])
            for node in calls
            if isinstance(node.func, ast.Name) and node.func.id == "need"
        }

    def _check(self, frame: FrameType | None) -> Check:
        """The place of the check that called `need` in this frame."""
        calls, line = list[tuple[str, int]](), frame.f_lineno if frame else 0
        clauses: frozenset[str] = frozenset()
        while frame is not None and frame.f_globals is self.module.__dict__:
            code: CodeType = frame.f_code
            if code.co_firstlineno in self._functions and not code.co_name.startswith("<"):
                name, quoted = self._functions[code.co_firstlineno]
                calls.insert(0, (name, frame.f_lineno))
                clauses |= quoted
                if name not in HELPERS and not name.startswith(READER):
                    break
            frame = frame.f_back
        return Check(tuple(calls[-1:] if calls[-1][0] == TAKE else calls), line, clauses)

    def decode(self, data: bytes, without: Check | None = None, max_layer: int | None = None) -> Outcome:
        """What becomes of `data` when the check `without` is left out."""
        module, refused = self.module, dict[str, Check]()

        def need(ok: object, what: str, name: str = "Malformed") -> None:
            if not ok:
                check = self._check(sys._getframe(1))
                if check != without:
                    refused["at"] = check
                    raise module.Fault(name, what)

        kept, module.need = module.need, need
        try:
            with _limited_time():
                return Outcome(None, module.hashes(data, max_layer))
        except module.Fault as fault:
            return Outcome(fault.name, None, refused.get("at"), str(fault))
        except RunsAway:
            return Outcome("runs away")
        except Exception as error:
            return Outcome("crash", None, None, f"{type(error).__name__}: {error}")
        finally:
            module.need = kept


@contextmanager
def _limited_time() -> Iterator[None]:
    def stop(signum: int, frame: FrameType | None) -> None:
        raise RunsAway

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def limit_memory() -> None:
    """For a process that decodes with checks left out: what asks for more memory than any vector needs is an error."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard), hard))


def in_processes(function: Callable[[Any], Any], items: Sequence[Any], jobs: int) -> Iterator[Any]:
    """function(item) of each item in order, in `jobs` processes of limited memory."""
    import multiprocessing

    with multiprocessing.get_context("fork").Pool(jobs, limit_memory) as pool:
        yield from pool.imap(function, items, chunksize=1)
