"""Seconds from the request to bytes and to pictures, over the paced link of `pd4dgs-serve` in a process of its own."""

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
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from pd4dgs_codec.bench.latency.viewer import pictures
from pd4dgs_codec.codec.info import info
from pd4dgs_codec.delivery.transfer import Transfer
from pd4dgs_codec.errors import DeliveryError

#: What the median over the paced link may be off from 8S/B: the larger of a share and of seconds.
TOLERANCE, TOLERANCE_SECONDS = 0.03, 0.010
CLIENTS = 64
CLIENTS_RATE = 200e6


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


@contextlib.contextmanager
def served(data: bytes, rate: float) -> Iterator[str]:
    """The URL of a file behind a link of `rate` bits per second, from `pd4dgs-serve` in another process."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as folder:
        (Path(folder) / "scene.pd4").write_bytes(data)
        command = ["-m", "pd4dgs_codec", "serve", folder, "--port", "0", "--rate", repr(rate)]
        with _python(command) as lines:
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
    command = ["-m", "pd4dgs_codec.bench.latency.viewer", url, *map(str, size)]
    start, seconds = time.perf_counter(), []
    with _python(command, **environment) as lines:
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

    The calling process must be warm (`render.warm.warm_up`).
    """
    layers, rows = layer_rows(data), []
    ends = [end for _, end in layers]
    for rate in rates:
        network, warm, cold = [], [], []
        with served(data, rate) as url:
            for _ in range(runs):
                network.append(arrivals(url, ends))
                step()
                warm.append(list(pictures(url, size)))
                step()
                cold.append(cold_start(url, size))
                step()
        for i, (layer, end) in enumerate(layers):
            rows.append(
                Times(
                    rate=rate,
                    level=layer,
                    bytes=end,
                    expected=8 * end / rate,
                    network=statistics.median(run[i] for run in network),
                    picture=statistics.median(run[i].seconds for run in warm),
                    after_last_byte=statistics.median(run[i].after_last_byte for run in warm),
                    cold=statistics.median(run[i] for run in cold),
                )
            )
    return rows


def first_start(data: bytes, rate: float, size: tuple[int, int]) -> float:
    """Seconds to the first picture of a process that finds no compiled kernels, as after installation."""
    with tempfile.TemporaryDirectory(prefix="pd4dgs-") as cache, served(data, rate) as url:
        return cold_start(url, size, NUMBA_CACHE_DIR=cache)[0]


@dataclass(frozen=True)
class Crowd:
    """Clients at once over one link. seconds: until the last one has its last byte. errors: in words."""

    clients: int
    rate: float
    bytes: int
    expected: float
    seconds: float
    errors: list[str]


def crowd(data: bytes, clients: int = CLIENTS, rate: float = CLIENTS_RATE) -> Crowd:
    """Fetches the file by many clients at once; a byte that differs is an error too."""
    errors: list[str] = []
    with served(data, rate) as url:
        barrier = threading.Barrier(clients + 1)

        def client() -> None:
            transfer = Transfer(url)
            barrier.wait()
            try:
                while transfer.read():
                    pass
                if transfer.data != data or transfer.cuts:
                    errors.append(f"{transfer.cuts} cuts, {len(transfer.data):,} bytes, expected {len(data):,}")
            except Exception as error:
                errors.append(f"{type(error).__name__}: {error}")
            finally:
                transfer.close()

        threads = [threading.Thread(target=client) for _ in range(clients)]
        for thread in threads:
            thread.start()
        barrier.wait()
        start = time.perf_counter()
        for thread in threads:
            thread.join()
        seconds = time.perf_counter() - start
    return Crowd(clients, rate, len(data), 8 * clients * len(data) / rate, seconds, errors)
