"""Seconds of a piece of work: warm, repeated in this process, and cold, each time in a process of its own."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from pd4dgs_codec.errors import Pd4Error

T = TypeVar("T")

#: Seconds after which nothing is repeated any more: a long piece of work is timed once or twice.
BUDGET = 5.0

#: Runs a command, then prints the largest resident memory of its own. The peak that getrusage gives is no use: a child
#: inherits its parent's.
_CHILD = """
import json, resource, sys
from importlib import import_module
code = import_module("pd4dgs_codec.cli." + sys.argv[1]).main(sys.argv[2:])
try:
    lines = open("/proc/self/status").read().splitlines()
    peak = next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
except (OSError, StopIteration):
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps(peak))
sys.exit(code)
"""


@dataclass(frozen=True)
class Timing:
    """Seconds: the median and the quartiles of `repeats` runs."""

    median: float
    low: float
    high: float
    repeats: int

    def text(self) -> str:
        """ "0.123 (0.120..0.130)", or the median alone where there was one run."""
        spread = f" ({self.low:.3g}..{self.high:.3g})" if self.repeats > 1 else ""
        return f"{self.median:.3g}{spread}"


@dataclass(frozen=True)
class Cold:
    """Fresh processes: seconds from their start to their end, and the largest resident memory of any in bytes."""

    seconds: Timing
    peak_bytes: int


def summary(seconds: Sequence[float]) -> Timing:
    """Median and quartiles (linear between the values) of at least one duration."""
    if len(seconds) == 1:
        return Timing(seconds[0], seconds[0], seconds[0], 1)
    low, median, high = statistics.quantiles(seconds, n=4, method="inclusive")
    return Timing(median, low, high, len(seconds))


def clock(work: Callable[[], T], repeats: int, budget: float = BUDGET) -> tuple[T, list[float]]:
    """(what `work` returned last, seconds of each run) of up to `repeats` runs, none begun after `budget` seconds."""
    seconds: list[float] = []
    while True:
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
        if len(seconds) >= repeats or sum(seconds) >= budget:
            return result, seconds


def measure(work: Callable[[], T], repeats: int, budget: float = BUDGET) -> tuple[T, Timing]:
    """(what `work` returned, its timing), as clock."""
    result, seconds = clock(work, repeats, budget)
    return result, summary(seconds)


def cold(verb: str, arguments: Sequence[str], repeats: int) -> Cold:
    """`pd4dgs-VERB` run `repeats` times, each in a fresh process: start, imports and reading included.

    Raises Pd4Error with the command's own last line if it fails.
    """
    seconds, peaks = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", _CHILD, verb, *arguments], capture_output=True, text=True)
        seconds.append(time.perf_counter() - start)
        if done.returncode:
            raise Pd4Error((done.stderr.strip().splitlines() or [f"pd4dgs-{verb} failed"])[-1])
        peaks.append(int(json.loads(done.stdout.splitlines()[-1])))
    return Cold(summary(seconds), max(peaks))
