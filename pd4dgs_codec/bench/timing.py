"""Seconds of a piece of work, warm in this process and cold in processes of its own, and the machine they hold for."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pd4dgs_codec import threads
from pd4dgs_codec.errors import Pd4Error

T = TypeVar("T")

#: Seconds after which nothing is repeated any more: a long piece of work is timed once or twice.
BUDGET = 5.0
#: Packages whose versions decide about times.
PACKAGES = ("pd4dgs-codec", "numpy", "constriction", "torch", "numba")

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


def machine(*others: str) -> dict[str, Any]:
    """What makes times comparable, without a name or a path: CPU model, CPUs this process may use, threads in use,
    memory in bytes, load before the run, versions. others: further packages; None for one that is not installed."""
    return {
        "cpu": _cpu_model(),
        "cpus": threads.available(),
        "threads": threads.kernel_threads(),
        "memory_bytes": _memory_bytes(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in (*PACKAGES, *others)},
    }


def machine_line(about: dict[str, Any]) -> str:
    """`machine` in one line, for a table's foot."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items() if version)
    memory = f", {about['memory_bytes'] / 2**30:.0f} GiB" if about["memory_bytes"] else ""
    load = "" if about["load_average"] is None else f", load {about['load_average']:.2f} before the run"
    cpus = f"{about['cpus']} CPUs, threads used: {about['threads']}"
    return f"{about['cpu']}, {cpus}{memory}{load}; {about['system']}, Python {about['python']}, {versions}"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _memory_bytes() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
