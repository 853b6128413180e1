"""Seconds from a request to the bytes and the picture of each level, over the paced link of `pd4dgs-serve`.

    python benchmarks/latency.py URL

is the cold viewer: a process that draws each level as it arrives and prints a line per picture.
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
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.transfer import Transfer


@contextlib.contextmanager
def served(folder: Path, *options: str) -> Iterator[str]:
    """The URL of a folder served by `pd4dgs-serve`. Raises DataError if it does not start."""
    with _python("-m", "pd4dgs_codec", "serve", str(folder), "--port", "0", *options) as lines:
        url = lines.readline().strip()
        if not url:
            raise DataError("pd4dgs-serve did not start")
        yield url


@contextlib.contextmanager
def _python(*arguments: str, **options: Any) -> Iterator[IO[str]]:
    """The stdout of a Python process that ends with the block."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, text=True, **options)
    assert process.stdout is not None
    try:
        with process.stdout as lines:
            yield lines
    finally:
        process.terminate()
        process.wait()


def arrivals(url: str, ends: Sequence[int]) -> list[float]:
    """Seconds from the request to each of these bytes, read as a stream without decoding."""
    with contextlib.closing(Transfer(url)) as transfer:
        start, seconds = time.perf_counter(), []
        for end in ends:
            while transfer.read(end):
                pass
            seconds.append(time.perf_counter() - start)
    return seconds


def pictures(url: str, ready: Callable[[], object] = lambda: None) -> Iterator[tuple[float, float]]:
    """Draws each level at time 0 with the file's own camera as soon as it is decoded: seconds since the request, and
    since the last byte of its layer. ready: called before each."""
    start = time.monotonic()
    with SceneClient(url) as client:
        for scene in client.scenes():
            last_byte = client.arrived_at
            ready()
            from pd4dgs_codec.quality.levels import level_of

            assert scene.info.camera is not None
            level_of(scene).picture(scene.info.camera, 0.0)
            now = time.monotonic()
            yield now - start, now - last_byte


def cold_start(url: str, **options: Any) -> list[float]:
    """Seconds from the start of a viewer's process to each of its pictures."""
    start = time.perf_counter()
    with _python(__file__, url, **options) as lines:
        return [time.perf_counter() - start for _ in lines]


def times(file: Path, rate: float, runs: int) -> list[dict[str, Any]]:
    """A row per level of a file at a rate, medians of `runs` in seconds: rate; level; bytes, S, of the prefix;
    expected, 8S/rate; since the request, network, to the last byte, and picture, to the picture in a warm process, of
    which after_last_byte follow that byte; cold, from the start of a process with nothing loaded to the picture."""
    _warm_up()
    layers = [(row["layer"], row["end"]) for row in info(file.read_bytes())["layers"]]
    network, warm, cold = [], [], []
    with served(file.parent, "--rate", repr(rate)) as url:
        for _ in range(runs):
            network.append(arrivals(url + file.name, [end for _, end in layers]))
            warm.append(list(pictures(url + file.name)))
            cold.append(cold_start(url + file.name))
    return [
        {
            "rate": rate,
            "level": layer,
            "bytes": end,
            "expected": 8 * end / rate,
            "network": median(run[i] for run in network),
            "picture": median(run[i][0] for run in warm),
            "after_last_byte": median(run[i][1] for run in warm),
            "cold": median(run[i] for run in cold),
        }
        for i, (layer, end) in enumerate(layers)
    ]


def first_start(file: Path, rate: float) -> float:
    """Seconds to the first picture of a process without compiled kernels, as after installation."""
    with tempfile.TemporaryDirectory() as cache, served(file.parent, "--rate", repr(rate)) as url:
        return cold_start(url + file.name, env=os.environ | {"NUMBA_CACHE_DIR": cache})[0]


def _warm_up() -> None:
    """Imports the player and loads its kernels."""
    from pd4dgs_codec.draw.player import warm_up

    warm_up()


if __name__ == "__main__":  # imports and kernels load in a thread while the bytes arrive
    threads.configure()
    threads.load_numba()
    warming = threading.Thread(target=_warm_up)
    warming.start()
    for seconds, _ in pictures(sys.argv[1], ready=warming.join):
        print(f"picture after {seconds:.3f} s", flush=True)
