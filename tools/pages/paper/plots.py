"""One picture per table, legible in black and white: what is compared has its own marker, levels their own line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pages.paper.published import FIRST_FRAME
from pages.paper.runs import OURS
from pages.paper.statistics import Result, figure, top
from pd4dgs_codec.bench.report import drawing

MARKERS = "os^DvPX*<>"
LEVEL_STYLES = ((":", "o"), ("--", "s"), ("-", "^"))
#: Link rates, bits per second.
LINKS = (2e6, 10e6, 50e6)


def _by(results: Sequence[Result], key: str) -> dict[str, list[Result]]:
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result[key], []).append(result)
    return groups


def _quality_over_bytes(axis: Any, results: Sequence[Result], line: str, marker: str, label: str) -> None:
    for i, result in enumerate(results):
        points = [(row["cumulative_bytes"] / 1e3, row["mpsnr"]) for row in result["levels"]]
        style = line + marker if len(points) > 1 else marker
        axis.plot(*zip(*points, strict=True), style, color="black", mfc="white", ms=6, lw=1, label=None if i else label)
    axis.set_xlabel("kB")


def _kilobytes(axes: Any) -> None:
    """A logarithmic x axis in kB with plain numbers at 1, 2 and 5; after all of a panel is drawn."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes:
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axis.xaxis.set_minor_formatter(NullFormatter())


def comparison(results: Sequence[Result], path: Path) -> None:
    """Quality over bytes; the levels of one file joined by a line."""
    scenes = _by(results, "scene")
    ours = {variant.name: f"{what}, its levels" for what, variant in OURS}
    with drawing(path, list(scenes), "held-out mPSNR, dB", (4.2, 3.6)) as axes:
        for axis, rows in zip(axes, scenes.values(), strict=True):
            for marker, (variant, runs) in zip(MARKERS, _by(rows, "variant").items(), strict=False):
                shown = runs if variant in ours else [r | {"levels": r["levels"][-1:]} for r in runs]
                _quality_over_bytes(axis, shown, "-", marker, ours.get(variant, variant))
        axes[0].legend(fontsize=8)
        _kilobytes(axes)


def seeds(results: Sequence[Result], path: Path) -> None:
    """Per scene, one point per seed and row, with the row's mean as a bar: quality, bytes."""
    figures = (("mpsnr", "mPSNR of the highest level, dB"), ("cumulative_bytes", "bytes of all layers"))
    panels = [(scene, rows, *shown) for scene, rows in _by(results, "scene").items() for shown in figures]
    with drawing(path, [scene for scene, *_ in panels], "", (5.2, 3.2), across=len(figures)) as axes:
        for axis, (_, rows, key, label) in zip(axes, panels, strict=True):
            groups = _by(rows, "variant")
            for y, runs in enumerate(groups.values()):
                value = figure(runs, top(key))
                axis.plot(value.seeds, [y] * len(value.seeds), "o", color="black", mfc="white", ms=7)
                axis.plot(value.mean, y, "|", color="black", ms=18)
            axis.set_yticks(range(len(groups)), list(groups))
            axis.locator_params(axis="x", nbins=5)
            axis.set_xlabel(label)


def levels(results: Sequence[Result], path: Path) -> None:
    """Quality over bytes of each run, one line per seed."""
    scenes = _by(results, "scene")
    with drawing(path, list(scenes), "held-out mPSNR, dB", (3.4, 3.6)) as axes:
        for axis, runs in zip(axes, scenes.values(), strict=True):
            for marker, run in zip(MARKERS, runs, strict=False):
                _quality_over_bytes(axis, [run], "-", marker, f"seed {run['seed']}")
        axes[0].legend(fontsize=8)
        _kilobytes(axes)


def latency(results: Sequence[Result], path: Path) -> None:
    """Seconds until each of our levels, a monolithic model and the published ones are there, over the link's rate."""
    scenes = _by(results, "scene")
    with drawing(path, list(scenes), "seconds, 8 S / B", (5, 3.6)) as axes:
        rates = [rate / 1e6 for rate in LINKS]
        for axis, runs in zip(axes, scenes.values(), strict=True):
            for run in runs:
                for row in run["levels"]:
                    ours = run["variant"] == "full"
                    line, marker = LEVEL_STYLES[row["level"]] if ours else ("-.", "D")
                    label = f"ours, level {row['level']}" if ours else run["variant"]
                    seconds = [8 * row["cumulative_bytes"] / rate for rate in LINKS]
                    axis.plot(rates, seconds, line + marker, color="black", mfc="white", ms=6, lw=1, label=label)
            for marker, theirs in zip("x+1234", FIRST_FRAME, strict=False):
                axis.plot(rates, theirs.seconds, marker, color="grey", ms=7, label=f"{theirs.method}, published")
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_xticks(rates, [f"{rate:g}" for rate in rates])
            axis.set_xticks([], minor=True)
            axis.set_xlabel("link, Mbps")
        axes[-1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))


def rates(results: Sequence[Result], path: Path) -> None:
    """Per level, quality over the bytes of its prefix, joined over the rate weights, which stand beside the points."""
    scenes = _by(results, "scene")
    with drawing(path, [f"{scene}; numbers: rate scale" for scene in scenes], "held-out mPSNR, dB", (6, 3.6)) as axes:
        for axis, runs in zip(axes, scenes.values(), strict=True):
            runs = sorted(runs, key=lambda r: r["config"]["rate_scale"])
            for level, (line, marker) in enumerate(LEVEL_STYLES):
                rows = [next((row for row in r["levels"] if row["level"] == level), None) for r in runs]
                points = [
                    (row["cumulative_bytes"] / 1e3, row["mpsnr"], r["config"]["rate_scale"])
                    for row, r in zip(rows, runs, strict=True)
                    if row
                ]
                if not points:
                    continue
                x, y, scales = zip(*points, strict=True)
                axis.plot(x, y, line + marker, color="black", mfc="white", ms=6, lw=1, label=f"level {level}")
                for i in range(len(points)):
                    axis.annotate(
                        f"{scales[i]:g}", (x[i], y[i]), xytext=(4, -10), textcoords="offset points", fontsize=7
                    )
            axis.set_xlabel("kB of the prefix")
        axes[0].legend()


def rho(results: Sequence[Result], path: Path) -> None:
    """rho, and pi of the highest level, over training; scenes by marker, rate weights by line."""
    with drawing(path, ["", ""], "", (5.2, 3.6)) as axes:
        scales = sorted({run["config"]["rate_scale"] for run in results})
        for marker, (scene, runs) in zip(MARKERS, _by(results, "scene").items(), strict=False):
            for run in runs:
                scale = run["config"]["rate_scale"]
                line = ("-", "--")[scales.index(scale) > 0]
                label = f"{scene}, rate scale {scale:g}"
                style = {"color": "black", "mfc": "white", "ms": 5, "lw": 1, "markevery": 3, "label": label}
                iterations = [p["iteration"] for p in run["pi"]]
                axes[0].plot(iterations, [p["rho"] for p in run["pi"]], line + marker, **style)
                axes[1].plot(iterations, [p["pi"][2] for p in run["pi"]], line + marker, **style)
        axes[0].set_ylabel("rho")
        axes[1].set_ylabel("pi of level 2")
        for axis in axes:
            axis.set_xlabel("iteration")
        axes[0].legend(fontsize=8)
