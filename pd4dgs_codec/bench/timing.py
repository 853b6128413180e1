"""Seconds of repeated work, and the machine that they hold for."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pd4dgs_codec import threads

T = TypeVar("T")

#: No repetition begins after so many seconds.
BUDGET = 5.0
#: Packages whose versions affect times.
PACKAGES = ("pd4dgs-codec", "numpy", "constriction", "torch", "numba", "gsplat")


@dataclass(frozen=True)
class Timing:
    """Seconds: median and quartiles of `repeats` runs."""

    median: float
    low: float
    high: float
    repeats: int

    def text(self) -> str:
        """ "0.123 (0.120..0.130)", or only the median of a single run."""
        spread = f" ({self.low:.3g}..{self.high:.3g})" if self.repeats > 1 else ""
        return f"{self.median:.3g}{spread}"


def summary(seconds: Sequence[float]) -> Timing:
    """Median and quartiles (linear interpolation) of at least one duration."""
    if len(seconds) == 1:
        return Timing(seconds[0], seconds[0], seconds[0], 1)
    import statistics

    low, median, high = statistics.quantiles(seconds, n=4, method="inclusive")
    return Timing(median, low, high, len(seconds))


def clock(work: Callable[[], T], repeats: int, budget: float = BUDGET) -> tuple[T, list[float]]:
    """(last result of `work`, seconds of each run) of up to `repeats` runs, none begun after `budget` seconds."""
    seconds: list[float] = []
    while True:
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
        if len(seconds) >= repeats or sum(seconds) >= budget:
            return result, seconds


def machine() -> dict[str, Any]:
    """What times depend on, without names or paths: CPU model, CPUs this process may use, threads, memory in bytes,
    load before the run, versions (None for a package that is not installed)."""
    return {
        "cpu": _cpu_model(),
        "cpus": threads.available(),
        "threads": threads.kernel_threads(),
        "memory_bytes": _memory_bytes(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def machine_line(about: dict[str, Any]) -> str:
    """`machine` in one line, below a table."""
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
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None
