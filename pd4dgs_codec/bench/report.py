"""Markdown tables, Pareto fronts, and log-log plots of error over time or bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Marker and line style per series; colours are not needed to tell them apart.
MARKERS, LINES = "os^Dvx*P<>p+", ("-", "--", ":", "-.")
STYLES = tuple((MARKERS[i % 12], LINES[(i + i // 12) % 4]) for i in range(48))
#: A cost axis spans this factor at least, so that small differences look small.
LEAST_SPAN = 4.0
#: Points with an error of 0 are drawn this factor below the smallest other error.
ZERO_BELOW = 3.0

#: Points (cost > 0, error >= 0) in the order in which a line joins them.
Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One plot. title and xlabel in words; series: (name, points)."""

    title: str
    xlabel: str
    series: Sequence[tuple[str, Points]]


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; columns padded, so that it also reads as plain text."""
    cells = [list(head), *map(list, rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def pareto_front(points: Points) -> list[tuple[float, float]]:
    """The distinct points (cost, error) that no other beats in one without losing in the other, by ascending cost."""
    front: list[tuple[float, float]] = []
    for point in sorted(set(points)):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def pyplot() -> Any:
    """matplotlib.pyplot, which draws into files. matplotlib is imported here, for not every command draws."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


@contextmanager
def drawing(
    path: Path, titles: Sequence[str], ylabel: str, size: tuple[float, float], *, across: int = 4, sharey: bool = False
) -> Iterator[list[Any]]:
    """Axes with a grid, one per title, at most `across` in a row; at the end they are the PNG `path`.

    size: width and height of each, inches. ylabel: of the first in each row.
    """
    columns = min(len(titles), across)
    rows = -(-len(titles) // columns)
    shape = {"figsize": (size[0] * columns, size[1] * rows), "squeeze": False, "sharey": sharey}
    figure, grid = pyplot().subplots(rows, columns, **shape)
    for axis in grid.flat[len(titles) :]:
        axis.remove()
    shown = list(grid.flat[: len(titles)])
    for axis, title in zip(shown, titles, strict=True):
        axis.set_title(title)
        axis.grid(alpha=0.3)
    for first in grid[:, 0]:
        first.set_ylabel(ylabel)
    yield shown
    figure.tight_layout()
    figure.savefig(path, dpi=110, format="png")
    pyplot().close(figure)


def draw(panels: Sequence[Panel], ylabel: str, path: Path) -> None:
    """Writes one PNG with the panels side by side over a shared error axis. Front points are ringed and joined by
    steps; errors of 0 lie at the bottom, and the axis says so."""
    from matplotlib.lines import Line2D

    errors = [error for panel in panels for _, points in panel.series for _, error in points]
    positive = [error for error in errors if error > 0]
    floor = min(positive, default=1.0) / ZERO_BELOW
    names = list(dict.fromkeys(name for panel in panels for name, _ in panel.series))
    style = {name: STYLES[i % len(STYLES)] for i, name in enumerate(names)}
    width = 4.4 * len(panels) + 0.4
    columns = max(1, int(width / (0.075 * max(map(len, names), default=0) + 1.0)))
    legend = 0.22 * -(-(len(names) + 1) // columns) + 0.2
    size = (width, 3.6 + legend)
    figure, grid = pyplot().subplots(1, len(panels), figsize=size, sharey=True, squeeze=False)
    for axis, panel in zip(grid[0], panels, strict=True):
        series = [(name, [(cost, max(error, floor)) for cost, error in points]) for name, points in panel.series]
        shown = [point for _, points in series for point in points]
        if front := pareto_front(shown):
            axis.step(*zip(*front, strict=True), where="post", color="0.75", lw=4, zorder=1)
            axis.plot(*zip(*front, strict=True), "o", color="black", mfc="none", ms=13, lw=0, zorder=2)
        for name, points in series:
            if points:
                look: dict[str, Any] = {"marker": style[name][0], "ls": style[name][1], "lw": 1, "ms": 6, "zorder": 3}
                axis.plot(*zip(*points, strict=True), color="black", mfc="white", **look)
        axis.set_xscale("log")
        axis.set_yscale("log")
        if shown:
            _limit(axis, [cost for cost, _ in shown])
            _number(axis.xaxis, *axis.get_xlim())
        axis.set_title(panel.title)
        axis.set_xlabel(panel.xlabel)
        axis.grid(alpha=0.3, which="both")
    if errors:
        _number(grid[0][0].yaxis, *grid[0][0].get_ylim())
    grid[0][0].set_ylabel(ylabel if len(positive) == len(errors) else f"{ylabel}\n(lowest marks: 0)")
    marks = [(*style[name], "black", "white", 6, 1, name) for name in names]
    marks.append(("o", "-", "0.75", "none", 11, 4, "front"))
    handles = [
        Line2D([], [], marker=mark, ls=line, color=color, mec="black", mfc=fill, ms=ms, lw=lw, label=label)
        for mark, line, color, fill, ms, lw, label in marks
    ]
    figure.tight_layout(rect=(0, legend / size[1], 1, 1))
    figure.legend(handles=handles, loc="lower center", ncol=columns, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110, format="png")
    pyplot().close(figure)


def _limit(axis: Any, costs: Sequence[float]) -> None:
    """The cost axis around its points."""
    low, high = min(costs) / 1.2, max(costs) * 1.2
    margin = max(1.0, LEAST_SPAN * low / high) ** 0.5
    axis.set_xlim(low / margin, high * margin)


def _number(axis: Any, low: float, high: float) -> None:
    """Few and plain numbers on a logarithmic axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high / low < 10 else (1.0, 2.0, 5.0) if high / low < 300 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
    axis.set_minor_formatter(NullFormatter())
