"""Quality over seconds since the request, as steps: what a viewer looks at, and since when."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

from pd4dgs_codec.bench.latency.faults import RATE, Row
from pd4dgs_codec.bench.latency.table import FileReport

STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ((0, (1, 4)), "v"))
#: Lines that can be told apart: of the table of faults the first rows are drawn.
MOST_FAULTS = len(STYLES)


def draw(file: FileReport, faults: Sequence[Row], path: Path) -> None:
    """Writes a picture of one file: per rate when each level's picture is there (warm process), and beside it, if there
    are `faults`, when its levels are decoded under them. Legible in black and white. y: mPSNR in dB, or the level
    without a dataset."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    panels = 2 if faults else 1
    figure, axes = pyplot.subplots(1, panels, figsize=(5.2 * panels, 3.8), squeeze=False, sharey=True)
    levels = sorted({row.level for row in file.times})
    heights = dict(zip(levels, levels if file.quality is None else file.quality, strict=True))
    left = axes[0][0]
    series = {}
    for rate in dict.fromkeys(row.rate for row in file.times):
        rows = [row for row in file.times if row.rate == rate]
        series[f"{rate / 1e6:g} Mbps"] = [(row.picture, heights[row.level]) for row in rows]
    _steps(left, series)
    left.set_title(file.name, fontsize=10)
    if faults:
        shown = {row.name: [(at, heights[n]) for of, n, at in row.shown if of == "old"] for row in faults[:MOST_FAULTS]}
        _steps(axes[0][1], shown)
        axes[0][1].set_title(f"under faults, {RATE / 1e6:g} Mbps", fontsize=10)
    for axis in axes[0]:
        axis.set_xlabel("seconds since the request")
        axis.set_xlim(left=0)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    if file.quality is None:
        left.set_yticks(levels)
    left.set_ylabel("level" if file.quality is None else "held-out mPSNR, dB")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _steps(axis, series: dict[str, list[tuple[float, float]]]) -> None:
    """Each line holds what is shown from a point on until the next one, the last for a while."""
    until = 1.15 * max((x for points in series.values() for x, _ in points), default=1.0)
    for (label, points), (line, mark) in zip(series.items(), cycle(STYLES), strict=False):
        if points:
            x, y = zip(*points, (until, points[-1][1]), strict=True)
            places = range(len(points))
            axis.step(
                x,
                y,
                where="post",
                linestyle=line,
                marker=mark,
                markevery=places,
                color="black",
                ms=4,
                lw=1,
                label=label,
            )
