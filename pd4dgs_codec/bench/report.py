"""Times repeated work, describes the machine, formats Markdown tables and plots error against cost."""

import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pd4dgs_codec import threads

T = TypeVar("T")

#: No repetition begins after this many seconds.
BUDGET = 5.0
#: Packages whose versions affect times.
PACKAGES = ("pd4dgs-codec", "numpy", "constriction", "torch", "numba", "gsplat")

#: Marker and line style per series, to tell them apart without colours.
MARKERS, LINES = "os^Dvx*P<>p+", ("-", "--", ":", "-.")
#: A cost axis spans at least this factor, so that small differences look small.
LEAST_SPAN = 4.0
#: Points with an error of 0 are drawn this factor below the smallest other error.
ZERO_BELOW = 3.0

#: Points (cost > 0, error >= 0), in the order in which a line connects them.
Points = Sequence[tuple[float, float]]


# -- times -------------------------------------------------------------------------------------------------------------


def summary(seconds: Sequence[float]) -> dict[str, Any]:
    """Returns median, low and high quartile (linear interpolation) and number of one or more durations."""
    low, median, high = np.percentile(seconds, (25, 50, 75)).tolist()
    return {"median": median, "low": low, "high": high, "repeats": len(seconds)}


def quartiles(found: dict[str, Any] | None) -> str:
    """Formats a `summary`: "0.123 (0.120..0.130)", only the median of a single run, or "-" for None."""
    if found is None:
        return "-"
    around = f" ({found['low']:.3g}..{found['high']:.3g})" if found["repeats"] > 1 else ""
    return f"{found['median']:.3g}{around}"


def clock(work: Callable[[], T], repeats: int, budget: float = BUDGET) -> tuple[T, list[float]]:
    """Runs `work` up to `repeats` times, but not again after `budget` seconds: (last result, seconds of each run)."""
    seconds: list[float] = []
    while True:
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
        if len(seconds) >= repeats or sum(seconds) >= budget:
            return result, seconds


def machine() -> dict[str, Any]:
    """Describes the machine without names or paths: CPU model, CPUs this process may use, threads, memory in bytes,
    load before the run, versions of installed packages. None: unknown on this system."""
    cpu = memory = load = None
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None)
    with suppress(AttributeError, OSError, ValueError):
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(AttributeError, OSError):
        load = round(os.getloadavg()[0], 2)
    versions = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
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
    """Formats `machine` as one line for below a table."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    memory = f", {about['memory_bytes'] / 2**30:.0f} GiB" if about["memory_bytes"] else ""
    load = "" if about["load_average"] is None else f", load {about['load_average']:.2f} before the run"
    cpus = f"{about['cpus']} CPUs, threads used: {about['threads']}"
    return f"{about['cpu']}, {cpus}{memory}{load}; {about['system']}, Python {about['python']}, {versions}"


# -- tables and plots --------------------------------------------------------------------------------------------------


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Formats a Markdown table with padded columns, so that it also reads as plain text."""
    cells = [list(head), *map(list, rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def optional(value: Any, form: str) -> str:
    """Formats a value; "-" for None."""
    return "-" if value is None else format(value, form)


def pareto_front(points: Points) -> list[tuple[float, float]]:
    """Returns the distinct points (cost, error) that no other point dominates, by ascending cost."""
    front: list[tuple[float, float]] = []
    for point in sorted(set(points)):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


@dataclass(frozen=True)
class Panel:
    """One plot of error against a cost. cost: its name and unit; series: (name, points)."""

    cost: str
    series: Sequence[tuple[str, Points]]


@contextmanager
def drawing(
    path: Path,
    titles: Sequence[str],
    ylabel: str,
    size: tuple[float, float],
    *,
    across: int = 4,
    sharey: bool = False,
    legend: bool = False,
) -> Iterator[list[Any]]:
    """Yields axes with a grid, one per title, at most `across` in a row, and writes them as a PNG after the block.

    size: width and height of each axis, inches. ylabel: of the first axis in each row. legend: of all series, below.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = min(len(titles), across)
    rows = -(-len(titles) // columns)
    shape: dict[str, Any] = {"figsize": (size[0] * columns, size[1] * rows), "squeeze": False, "sharey": sharey}
    figure, grid = pyplot.subplots(rows, columns, layout="constrained", **shape)
    for axis in grid.flat[len(titles) :]:
        axis.remove()
    axes = list(grid.flat[: len(titles)])
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title)
        axis.grid(alpha=0.3)
    for first in grid[:, 0]:
        first.set_ylabel(ylabel)
    yield axes
    if legend:
        handles = {label: h for axis in axes for h, label in zip(*axis.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles, loc="outside lower center", ncol=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)


def draw(panels: Sequence[Panel], ylabel: str, path: Path) -> None:
    """Writes a PNG with the panels side by side over a shared error axis, log-log. Points on the Pareto front are
    ringed and connected by steps. Errors of 0 lie at the bottom, and the axis says so."""
    errors = [error for panel in panels for _, points in panel.series for _, error in points]
    floor = min((error for error in errors if error > 0), default=1.0) / ZERO_BELOW
    names = list(dict.fromkeys(name for panel in panels for name, _ in panel.series))
    looks = {
        name: {"marker": MARKERS[i % len(MARKERS)], "ls": LINES[(i + i // len(MARKERS)) % len(LINES)]}
        for i, name in enumerate(names)
    }
    zero = f" (0 is drawn at {floor:.2g})" if 0 in errors else ""
    size, titles = (4.5, 3.9 + 0.2 * len(names) / 3), [f"error against {panel.cost}" for panel in panels]
    with drawing(path, titles, ylabel + zero, size, sharey=True, legend=True) as axes:
        for axis, panel in zip(axes, panels, strict=True):
            _draw_panel(axis, panel, looks, floor)


def _draw_panel(axis: Any, panel: Panel, looks: dict[str, dict[str, Any]], floor: float) -> None:
    series = [(name, [(cost, max(error, floor)) for cost, error in points]) for name, points in panel.series if points]
    for name, points in series:
        style = {"color": "black", "mfc": "white", "lw": 1, "ms": 6, "zorder": 3}
        axis.plot(*zip(*points, strict=True), label=name, **style, **looks[name])
    if shown := [point for _, points in series for point in points]:
        front, costs = pareto_front(shown), [cost for cost, _ in shown]
        label = "Pareto front"
        axis.step(*zip(*front, strict=True), where="post", color="0.75", lw=4, zorder=1)
        axis.plot(*zip(*front, strict=True), "o", color="black", mfc="none", ms=13, lw=0, zorder=2, label=label)
        margin = max(1.44, LEAST_SPAN * min(costs) / max(costs)) ** 0.5
        axis.set_xlim(min(costs) / margin, max(costs) * margin)
    axis.set(xscale="log", yscale="log", xlabel=panel.cost)
