"""Seconds of repeated work, and the machine that they hold for."""

from __future__ import annotations

import contextlib
import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec import threads

T = TypeVar("T")

#: No repetition begins after so many seconds.
BUDGET = 5.0
#: Packages whose versions affect times.
PACKAGES = ("pd4dgs-codec", "numpy", "constriction", "torch", "numba", "gsplat")


def summary(seconds: Sequence[float]) -> dict[str, Any]:
    """median, low and high quartile (linear interpolation) and number of repeats of at least one duration."""
    low, median, high = np.percentile(seconds, (25, 50, 75)).tolist()
    return {"median": median, "low": low, "high": high, "repeats": len(seconds)}


def spread(found: dict[str, Any] | None) -> str:
    """ "0.123 (0.120..0.130)", only the median of a single run, or "-" for None."""
    if found is None:
        return "-"
    quartiles = f" ({found['low']:.3g}..{found['high']:.3g})" if found["repeats"] > 1 else ""
    return f"{found['median']:.3g}{quartiles}"


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
    load before the run, versions of installed packages. None: unknown on this system."""
    cpu = memory = load = None
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)
    with contextlib.suppress(AttributeError, OSError, ValueError):
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with contextlib.suppress(AttributeError, OSError):
        load = round(os.getloadavg()[0], 2)
    versions = {}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {
        "cpu": cpu or platform.processor() or platform.machine(),
        "cpus": threads.available(),
        "threads": threads.kernel_threads(),
        "memory_bytes": memory,
        "load_average": load,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
    }


def machine_line(about: dict[str, Any]) -> str:
    """`machine` in one line, below a table."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    memory = f", {about['memory_bytes'] / 2**30:.0f} GiB" if about["memory_bytes"] else ""
    load = "" if about["load_average"] is None else f", load {about['load_average']:.2f} before the run"
    cpus = f"{about['cpus']} CPUs, threads used: {about['threads']}"
    return f"{about['cpu']}, {cpus}{memory}{load}; {about['system']}, Python {about['python']}, {versions}"
