"""Seconds from a request to the bytes and the rendered image of each level, over the paced link of `pd4dgs-serve`.

    python -m pd4dgs_codec.bench.latency URL

is the cold viewer: a process that renders each level as it arrives and prints a JSON line per image.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from pd4dgs_codec import threads
from pd4dgs_codec.errors import DataError, DeliveryError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.transfer import Transfer

#: Largest difference of the median over the paced link from 8S/B: a share or seconds, the larger of both.
TOLERANCE, TOLERANCE_SECONDS = 0.03, 0.010


@dataclass(frozen=True)
class Shown:
    """One image. seconds: since the request. after_last_byte: since the last byte of its layer."""

    level: int
    seconds: float
    after_last_byte: float


@dataclass(frozen=True)
class Times:
    """Medians for one level at one rate, in seconds since the request, or since the start of the process (cold).

    bytes: S, of the prefix. expected: 8S/B. network: to the last byte. picture: to the image in a warm process, of
    which after_last_byte follow that byte. cold: to the image in a process that starts with nothing loaded.
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
        """Whether `network` is within the tolerance of 8S/B."""
        return abs(self.network - self.expected) <= max(TOLERANCE * self.expected, TOLERANCE_SECONDS)


@contextlib.contextmanager
def served(data: bytes, rate: float) -> Iterator[str]:
    """The URL of a file behind a link of `rate` bits per second, from `pd4dgs-serve` in another process."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as folder:
        (Path(folder) / "scene.pd4").write_bytes(data)
        with _python("-m", "pd4dgs_codec", "serve", folder, "--port", "0", "--rate", repr(rate)) as lines:
            line = lines.readline().strip()
            if not line:
                raise DeliveryError("pd4dgs-serve did not start")
            yield f"{line}scene.pd4"


@contextlib.contextmanager
def _python(*arguments: str, **environment: str) -> Iterator[IO[str]]:
    """The stdout of a Python process that ends with the block."""
    command, variables = [sys.executable, *arguments], os.environ | environment
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables)
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
    """Seconds from the request to each of these bytes, read as a stream without decoding."""
    transfer, start, seconds = Transfer(url), time.perf_counter(), []
    for end in ends:
        while transfer.read(end):
            pass
        seconds.append(time.perf_counter() - start)
    transfer.close()
    return seconds


def pictures(url: str, ready: Callable[[], object] = lambda: None) -> Iterator[Shown]:
    """Renders each level at time 0 with the file's own camera as soon as it is decoded. ready: called before each.

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
            yield Shown(scene.level, now - start, now - last_byte)


def cold_start(url: str, **environment: str) -> list[float]:
    """Seconds from the start of a viewer's process to each of its images. Raises DeliveryError if it fails."""
    start = time.perf_counter()
    with _python("-m", "pd4dgs_codec.bench.latency", url, **environment) as lines:
        seconds = [time.perf_counter() - start for line in lines if "level" in json.loads(line)]
    if not seconds:
        raise DeliveryError(f"{url}: the viewer's process rendered nothing")
    return seconds


def times(data: bytes, rates: Sequence[float], runs: int, step: Callable[[], None] = lambda: None) -> list[Times]:
    """A row per rate and level of a file, medians of `runs`. `step` is called after each run, 3 per rate and run."""
    _warm_up()
    rows, layers = [], layer_rows(data)
    for rate in rates:
        network, warm, cold = [], [], []
        with served(data, rate) as url:
            for _ in range(runs):
                network.append(arrivals(url, [end for _, end in layers]))
                step()
                warm.append(list(pictures(url)))
                step()
                cold.append(cold_start(url))
                step()
        shown = [[picture.seconds for picture in run] for run in warm]
        after = [[picture.after_last_byte for picture in run] for run in warm]
        for i, (layer, end) in enumerate(layers):
            medians = [statistics.median(run[i] for run in kind) for kind in (network, shown, after, cold)]
            rows.append(Times(rate, layer, end, 8 * end / rate, *medians))
    return rows


def first_start(data: bytes, rate: float) -> float:
    """Seconds to the first image of a process without compiled kernels, as after installation."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as cache, served(data, rate) as url:
        return cold_start(url, NUMBA_CACHE_DIR=cache)[0]


def table(rows: Sequence[Times]) -> str:
    """A row per rate and level."""
    from pd4dgs_codec.bench.report import markdown

    head = (
        "rate",
        "level",
        "S, bytes",
        "8S/B",
        "network",
        "within",
        "picture, warm",
        "after last byte",
        "picture, cold",
    )
    cells = [
        (f"{row.rate / 1e6:g} Mbps", str(row.level), f"{row.bytes:,}", f"{row.expected:.4f}", f"{row.network:.4f}",
         "yes" if row.within else "no", f"{row.picture:.3f}", f"{row.after_last_byte:.3f}", f"{row.cold:.2f}")
        for row in rows
    ]  # fmt: skip
    return markdown(head, cells)


def _warm_up() -> None:
    """Imports the player and loads its kernels."""
    from pd4dgs_codec.draw.player import warm_up

    warm_up()


def main(url: str) -> None:
    """The cold viewer: imports and kernels load in a thread while the bytes arrive."""
    threads.configure()
    threads.load_numba()
    warming = threading.Thread(target=_warm_up)
    warming.start()
    for shown in pictures(url, ready=warming.join):
        print(json.dumps(asdict(shown)), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
