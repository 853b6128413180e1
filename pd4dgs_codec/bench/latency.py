"""Seconds from the request to bytes and to pictures, over the paced link of `pd4dgs-serve` in a process of its own."""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import IO, Any

import numpy as np

from pd4dgs_codec.bench.report import drawing, markdown
from pd4dgs_codec.bench.viewer import pictures
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.quality.evaluate import evaluate_file
from pd4dgs_codec.web.transfer import Transfer

#: What the median over the paced link may be off from 8S/B: the larger of a share and of seconds.
TOLERANCE, TOLERANCE_SECONDS = 0.03, 0.010
#: Megabytes (1e6) until the first frame, as the PD-4DGS paper publishes them: averages over the Dycheck iPhone scenes.
PUBLISHED_MEGABYTES = {
    "SC-GS": 232.4,
    "Deformable 3DGS": 109.4,
    "4DGS": 78.5,
    "MoDec-GS": 18.37,
    "PD-4DGS, all layers": 6.88,
    "PD-4DGS, layer 0": 0.436,
}
#: Copies of anchors lie this many voxels from their original at most, along each axis.
REACH = 3
#: Times as many anchors; more would hardly find free voxels.
MOST = 20
#: Of the encoder of such files; more gains little here.
EFFORT = 3


@dataclass(frozen=True)
class Times:
    """Medians for one level at one rate, in seconds since the request or since the process was started (cold).

    bytes: S, of the prefix. expected: 8S/B. network: to the last byte. picture: to the picture in a warm process, of
    which after_last_byte passed since that byte. cold: to the picture in a process that starts with nothing loaded.
    """

    rate: float
    level: int
    bytes: int
    expected: float
    network: float
    picture: float
    after_last_byte: float
    cold: float

    @property
    def within(self) -> bool:
        """Whether network is as close to 8S/B as promised."""
        return abs(self.network - self.expected) <= max(TOLERANCE * self.expected, TOLERANCE_SECONDS)


@dataclass(frozen=True)
class FileReport:
    """What was measured of one file. anchors: in layer 0. quality: mPSNR in dB per level, None without a dataset.
    first_start: seconds to the first picture where no kernel is compiled yet."""

    name: str
    bytes: int
    anchors: int
    size: tuple[int, int]
    times: list[Times]
    quality: list[float] | None
    first_start: float


@contextlib.contextmanager
def served(data: bytes, rate: float) -> Iterator[str]:
    """The URL of a file behind a link of `rate` bits per second, from `pd4dgs-serve` in another process."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as folder:
        (Path(folder) / "scene.pd4").write_bytes(data)
        with _python(["-m", "pd4dgs_codec", "serve", folder, "--port", "0", "--rate", repr(rate)]) as lines:
            line = lines.readline().strip()
            if not line:
                raise DeliveryError("pd4dgs-serve did not start")
            yield f"{line}scene.pd4"


@contextlib.contextmanager
def _python(arguments: Sequence[str], **environment: str) -> Iterator[IO[str]]:
    """The stdout of a Python process that ends with the block."""
    command = [sys.executable, *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment})
    assert process.stdout is not None
    try:
        with process.stdout as lines:
            yield lines
    finally:
        process.terminate()
        process.wait()


def layer_rows(data: bytes) -> list[tuple[int, int]]:
    """(layer, end of its prefix in bytes) of a whole file."""
    return [(row["layer"], row["end"]) for row in info(data)["layers"]]


def arrivals(url: str, ends: Sequence[int]) -> list[float]:
    """Seconds from the request to each of these bytes, read as a stream and not decoded."""
    transfer, start, seconds = Transfer(url), time.perf_counter(), []
    for end in ends:
        while transfer.read(end):
            pass
        seconds.append(time.perf_counter() - start)
    transfer.close()
    return seconds


def cold_start(url: str, size: tuple[int, int], **environment: str) -> list[float]:
    """Seconds from the start of a viewer's process to each of its pictures. Raises DeliveryError if it fails."""
    start, seconds = time.perf_counter(), []
    with _python(["-m", "pd4dgs_codec.bench.viewer", url, *map(str, size)], **environment) as lines:
        for line in lines:
            if "level" in json.loads(line):
                seconds.append(time.perf_counter() - start)
    if not seconds:
        raise DeliveryError(f"{url}: the viewer's process showed nothing")
    return seconds


def times(
    data: bytes, rates: Sequence[float], runs: int, size: tuple[int, int], step: Callable[[], None] = lambda: None
) -> list[Times]:
    """A row per rate and level of a file, medians of `runs`. `step` is called after each run, 3 per rate and run.

    The calling process must be warm (`playback.warm.warm_up`).
    """
    rows = []
    for rate in rates:
        network, warm, cold = [], [], []
        with served(data, rate) as url:
            for _ in range(runs):
                network.append(arrivals(url, [end for _, end in layer_rows(data)]))
                step()
                warm.append(list(pictures(url, size)))
                step()
                cold.append(cold_start(url, size))
                step()
        shown = [[picture.seconds for picture in run] for run in warm]
        after = [[picture.after_last_byte for picture in run] for run in warm]
        for i, (layer, end) in enumerate(layer_rows(data)):
            medians = [statistics.median(run[i] for run in kind) for kind in (network, shown, after, cold)]
            rows.append(Times(rate, layer, end, 8 * end / rate, *medians))
    return rows


def first_start(data: bytes, rate: float, size: tuple[int, int]) -> float:
    """Seconds to the first picture of a process that finds no compiled kernels, as after installation."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as cache, served(data, rate) as url:
        return cold_start(url, size, NUMBA_CACHE_DIR=cache)[0]


def report(
    name: str,
    data: bytes,
    rates: Sequence[float],
    runs: int,
    size: tuple[int, int] | None = None,
    dataset: Dataset | None = None,
    step: Callable[[], None] = lambda: None,
) -> FileReport:
    """What the tables tell of a file that holds a camera. size: of the pictures, the camera's for None."""
    base = decode(data, max_layer=0)
    assert base.info.camera is not None
    size = size or (base.info.camera.width, base.info.camera.height)
    quality = None if dataset is None else [row["mpsnr"] for row in evaluate_file(data, dataset)["levels"]]
    measured, start = times(data, rates, runs, size, step), first_start(data, max(rates), size)
    return FileReport(name, len(data), int((base.mask[0] > 0).sum()), size, measured, quality, start)


def with_anchors(data: bytes, count: int, seed: int = 5) -> bytes:
    """A file of any size, for times that depend on it: layer 0 shows `count` anchors, those of `data` and copies of
    random ones among them, each moved to a free voxel nearby. Raises DataError if there are more already, or far too
    few."""
    scene, rng = decode(data), np.random.default_rng(seed)
    masks = [np.pad(codes, (0, len(scene.anchor_q) - len(codes))) for codes in scene.mask]
    shown = np.flatnonzero(masks[0])
    if not len(shown) <= count <= MOST * len(shown):
        few, found = f"{count // MOST:,}", f"{len(shown):,}"
        raise DataError(f"layer 0 shows {found} anchors, expected {few} to {count:,} to make {count:,}")
    taken = {tuple(cell) for cell in scene.anchor_q.tolist()}
    copies: list[int] = []
    cells: list[tuple[int, ...]] = []
    while len(copies) < count - len(shown):
        row = int(rng.choice(shown))
        cell = tuple((scene.anchor_q[row] + rng.integers(-REACH, REACH + 1, 3)).tolist())
        if cell not in taken:
            taken.add(cell)
            copies.append(row)
            cells.append(cell)
    rows = np.concatenate([np.arange(len(scene.anchor_q)), np.array(copies, np.int64)])
    places = np.concatenate([scene.anchor_q, np.array(cells, np.int32).reshape(-1, 3)])
    anchors = scene.of_anchors(rows) | {"anchor_q": places}
    counts = (len(rows),) * len(scene.layers)
    larger = replace(scene, rows=counts, mask=tuple(codes[rows] for codes in masks), **anchors)
    return encode(larger, effort=EFFORT)


# -- as tables and a plot ----------------------------------------------------------------------------------------------


def text(files: Sequence[FileReport], runs: int) -> str:
    """A table per file, and one of their sizes beside those of monolithic models, as Markdown."""
    return "\n\n".join([*(_times(file, runs) for file in files), _beside_monoliths(files)])


def _times(file: FileReport, runs: int) -> str:
    head = ("rate", "level", "mPSNR dB", "S, bytes", "8S/B", "network", "off", "within", "picture, warm",
            "after last byte", "picture, cold")  # fmt: skip
    levels = sorted({row.level for row in file.times})
    rows = []
    for row in file.times:
        quality = "-" if file.quality is None else f"{file.quality[levels.index(row.level)]:.2f}"
        off = row.network - row.expected
        network = (f"{row.expected:.4f}", f"{row.network:.4f}", f"{1e3 * off:+.1f} ms, {off / row.expected:+.1%}")
        picture = (f"{row.picture:.3f}", f"{row.after_last_byte:.3f}", f"{row.cold:.2f}")
        what = (f"{row.rate / 1e6:g} Mbps", str(row.level), quality, f"{row.bytes:,}")
        rows.append((*what, *network, "yes" if row.within else "no", *picture))
    promise = f"max({TOLERANCE:.0%}, {1e3 * TOLERANCE_SECONDS:.0f} ms)"
    lines = [
        f"## {file.name}: {file.anchors:,} anchors in layer 0, {file.size[0]}x{file.size[1]}",
        f"Seconds since the request, medians of {runs}. Within: the network's time is off from 8S/B by at most "
        f"{promise}. Cold: since the start of a process, whose imports run while the bytes arrive.",
        markdown(head, rows),
        f"A first start after installation, which compiles the kernels: {file.first_start:.1f} s to the first picture.",
    ]
    return "\n\n".join(lines)


def _beside_monoliths(files: Sequence[FileReport]) -> str:
    rates = sorted({row.rate for row in files[0].times})
    rows = [
        (f"{method}, published", f"{1e6 * size:,.0f}", *(f"{8e6 * size / rate:,.2f}" for rate in rates))
        for method, size in PUBLISHED_MEGABYTES.items()
    ]
    for file in files:
        levels = {row.level: row.bytes for row in file.times}
        for level in (max(levels), min(levels)):
            seconds = [row.network for row in sorted(file.times, key=lambda r: r.rate) if row.level == level]
            what = "layer 0" if level == 0 else f"layers to {level}"
            rows.append((f"{file.name}, {what}, measured", f"{levels[level]:,}", *(f"{s:,.2f}" for s in seconds)))
    head = ("what must arrive before it shows", "bytes", *(f"s at {rate / 1e6:g} Mbps" for rate in rates))
    said = (
        "Published are sizes, averages over seven scenes of the Dycheck iPhone captures (other scenes than ours), and "
        "their seconds are 8S/B: the network alone."
    )
    return f"## Beside monolithic models\n\n{said}\n\n{markdown(head, rows)}"


#: Of the lines of a plot that is told apart without colours.
STYLES: tuple[tuple[Any, str], ...] = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ((0, (1, 4)), "v"))
#: What is shown: (seconds since the request, level) by the name of a line.
Shown = dict[str, list[tuple[float, int]]]


def draw(file: FileReport, path: Path, beside: tuple[str, Shown] | None = None) -> None:
    """Writes a picture of one file: per rate when each level's picture is there (warm process). Legible in black and
    white. y: mPSNR in dB, or the level without a dataset. beside: the title and the lines of a second panel."""
    levels = sorted({row.level for row in file.times})
    heights = dict(zip(levels, levels if file.quality is None else file.quality, strict=True))
    own: Shown = {}
    for row in file.times:
        own.setdefault(f"{row.rate / 1e6:g} Mbps", []).append((row.picture, row.level))
    panels = [(file.name, own), *([beside] if beside else [])]
    ylabel = "level" if file.quality is None else "held-out mPSNR, dB"
    with drawing(path, [title for title, _ in panels], ylabel, (5.2, 3.8), sharey=True) as axes:
        for axis, (_, lines) in zip(axes, panels, strict=True):
            until = 1.15 * max((x for points in lines.values() for x, _ in points), default=1.0)
            for (label, points), (line, mark) in zip(lines.items(), cycle(STYLES), strict=False):
                if points:  # each level is shown until the next one, the last for a while
                    x, y = zip(*((x, heights[level]) for x, level in (*points, (until, points[-1][1]))), strict=True)
                    look = {"linestyle": line, "marker": mark, "markevery": range(len(points)), "ms": 4, "lw": 1}
                    axis.step(x, y, where="post", color="black", label=label, **look)
            axis.set_xlabel("seconds since the request")
            axis.set_xlim(left=0)
            axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
        if file.quality is None:
            axes[0].set_yticks(levels)
