"""Measures seconds from a request to each level's bytes and rendered image, over the paced link of `pd4dgs-serve`.

    python -m pd4dgs_codec.bench.latency URL

is the cold viewer: a process that renders each level as it arrives and prints a line per image, its level first.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import IO, Any

from pd4dgs_codec import threads
from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.web.client import SceneClient, Transfer


@contextlib.contextmanager
def served(data: bytes, rate: float) -> Iterator[str]:
    """Serves a file over a link of `rate` bits per second by `pd4dgs-serve` in another process; yields its URL."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as folder:
        (Path(folder) / "scene.pd4").write_bytes(data)
        with python("-m", "pd4dgs_codec", "serve", folder, "--port", "0", "--rate", repr(rate)) as lines:
            line = lines.readline().strip()
            if not line:
                raise DeliveryError("pd4dgs-serve did not start")
            yield f"{line}scene.pd4"


@contextlib.contextmanager
def python(*arguments: str, **environment: str) -> Iterator[IO[str]]:
    """Runs a Python process within the block and yields its stdout as text; SIGTERM ends it with the block.

    arguments: of the interpreter, such as "-m", "pd4dgs_codec". environment: variables to set beside those of this
    process.
    """
    command, variables = [sys.executable, *arguments], os.environ | environment
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables)
    assert process.stdout is not None
    try:
        with process.stdout as lines:
            yield lines
    finally:
        process.terminate()
        process.wait()


def arrivals(url: str, ends: Sequence[int]) -> list[float]:
    """Returns the seconds from the request until the file has arrived up to each offset in `ends`, without decoding."""
    with contextlib.closing(Transfer(url)) as transfer:
        start, seconds = time.perf_counter(), []
        for end in ends:
            while transfer.read(end):
                pass
            seconds.append(time.perf_counter() - start)
    return seconds


def pictures(url: str, ready: Callable[[], object] = lambda: None) -> Iterator[tuple[int, float, float]]:
    """Renders each slice at time 0 with the file's own camera as soon as it is decoded. Yields (level, seconds since
    the request, seconds since the last byte of the slice). ready: called before each rendering.

    Raises what SceneClient.scenes raises, and DataError for a file without a camera.
    """
    start = time.monotonic()
    with SceneClient(url) as client:
        for scene in client.scenes():
            last_byte = client.arrived_at
            if scene.info.camera is None:
                raise DataError("the file holds no camera, expected one to render with")
            ready()
            from pd4dgs_codec.quality.levels import level_of

            level_of(scene).picture(scene.info.camera, 0.0)
            now = time.monotonic()
            yield scene.level, now - start, now - last_byte


def cold_start(url: str, **environment: str) -> list[tuple[int, float]]:
    """Returns (level, seconds from the start of a viewer's process) of each of its images. Raises DeliveryError if it
    fails."""
    start = time.perf_counter()
    with python("-m", "pd4dgs_codec.bench.latency", url, **environment) as lines:
        images = [(int(line.partition(":")[0]), time.perf_counter() - start) for line in lines]
    if not images:
        raise DeliveryError(f"{url}: the viewer's process rendered nothing")
    return images


def times(data: bytes, rate: float, runs: int, step: Callable[[], None] = lambda: None) -> list[dict[str, Any]]:
    """Returns a row per level of a file: rate (bits per second), level, bytes S of the prefix, and seconds, medians of
    `runs`. expected: 8S/rate. network: from the request to the last byte. picture: from the request to the image in a
    warm process, of which after_last_byte come after the last byte. cold: from the start of a new process to the image.
    The image of a sliced level is that with all its slices.

    `step` is called 3 times per run.
    """
    _warm_up()
    layers = [(row["layer"], row["end"]) for row in info(data)["layers"]]
    network, warm, cold = [], [], []
    with served(data, rate) as url:
        for _ in range(runs):
            network.append(arrivals(url, [end for _, end in layers]))
            step()
            warm.append({level: seconds for level, *seconds in pictures(url)})  # the last image of a level is whole
            step()
            cold.append(dict(cold_start(url)))
            step()
    return [
        {
            "rate": rate,
            "level": layer,
            "bytes": end,
            "expected": 8 * end / rate,
            "network": median(run[i] for run in network),
            "picture": median(run[layer][0] for run in warm),
            "after_last_byte": median(run[layer][1] for run in warm),
            "cold": median(run[layer] for run in cold),
        }
        for i, (layer, end) in enumerate(layers)
    ]


def first_start(data: bytes, rate: float) -> float:
    """Returns seconds to the first image of a process without compiled kernels, as after installation."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as cache, served(data, rate) as url:
        return cold_start(url, NUMBA_CACHE_DIR=cache)[0][1]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Formats rows of `times` as a Markdown table."""
    from pd4dgs_codec.bench.report import markdown

    head = ("rate", "level", "S, bytes", "8S/B", "network", "picture, warm", "after last byte", "picture, cold")
    keys = ("expected", "network", "picture", "after_last_byte", "cold")
    cells = [
        (f"{row['rate'] / 1e6:g} Mbps", str(row["level"]), f"{row['bytes']:,}", *(f"{row[key]:.3f}" for key in keys))
        for row in rows
    ]
    return markdown(head, cells)


def _warm_up() -> None:
    """Imports the player and loads its kernels."""
    from pd4dgs_codec.draw.player import warm_up

    warm_up()


def main(url: str) -> None:
    """Runs the cold viewer: imports and kernels load in a thread while the bytes arrive."""
    threads.configure()
    threads.load_numba()
    warming = threading.Thread(target=_warm_up)
    warming.start()
    for level, seconds, _ in pictures(url, ready=warming.join):
        print(f"{level}: image after {seconds:.3f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
