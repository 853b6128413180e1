"""The machine that figures were taken on: what makes a time comparable, and nothing that names a host or a path."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pd4dgs_codec.render import threads

#: Packages whose versions decide about times.
PACKAGES = ("pd4dgs-codec", "numpy", "constriction", "torch", "numba")


def describe(others: Sequence[str] = ()) -> dict[str, Any]:
    """CPU model, CPUs this process may use, threads in use, memory in bytes, load before the run, versions.

    others: further packages to name; None stands for one that is not installed.
    """
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


def sentence(machine: dict[str, Any]) -> str:
    """The description as one line for a table's foot."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items() if version)
    memory = f", {machine['memory_bytes'] / 2**30:.0f} GiB" if machine["memory_bytes"] else ""
    load = "" if machine["load_average"] is None else f", load {machine['load_average']:.2f} before the run"
    cpus = f"{machine['cpus']} CPUs, threads used: {machine['threads']}"
    return f"{machine['cpu']}, {cpus}{memory}{load}; {machine['system']}, Python {machine['python']}, {versions}"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


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
