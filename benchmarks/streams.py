"""What a file costs in pieces, by their bytes: time and memory as multiples of decode's, as a Markdown table.

    pd4dgs-encode model.pt -o scene.pd4 --slices 4k
    python benchmarks/streams.py scene.pd4     # two minutes; without a browser, the rows of Chromium are left out

Time is the least of seven runs, processor time of the process, in Chromium of the page's; memory is the peak of arrays
in Python, of the process, one for each figure, in Node and Chromium (on Linux). A server writes its pieces to a socket
one by one, and the reader gets what has arrived.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import threading
import time
import tracemalloc
from collections import deque
from collections.abc import Callable, Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from browser import PLAYER, TIMEOUT_MS, launched
from common import peak_bytes

from pd4dgs_codec import decode, open_stream
from pd4dgs_codec.errors import DataError

SIZES = [1, 7, 1 << 10, 1 << 16, 1 << 30]
MEGABYTE = 1 << 20


def python(path: Path, way: str, size: int) -> tuple[float, int]:
    """(seconds, peak bytes). way: decode, stream, or "kept": a stream whose caller keeps the newest scene."""
    data = path.read_bytes()

    def work() -> None:
        if way == "decode":
            decode(data)
            return
        stream, kept = open_stream(), deque[Any](maxlen=way == "kept")
        for at in range(0, len(data), size):
            kept.extend(stream.feed(data[at : at + size]))
        stream.finish()

    return cost(work, 7)


def cost(work: Callable[[], Any], runs: int) -> tuple[float, int]:
    """(least seconds of processor time of so many runs, peak bytes of arrays and objects)."""
    seconds = []
    for _ in range(runs):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return min(seconds), peak


@contextlib.contextmanager
def served(path: Path, size: int) -> Iterator[str]:
    """The address of a server of the player's files and, in pieces of `size` bytes, of scene.pd4."""

    class Handler(SimpleHTTPRequestHandler):
        disable_nagle_algorithm = True

        def translate_path(self, asked: str) -> str:
            return str(path if asked == "/scene.pd4" else PLAYER / asked[1:])

        def copyfile(self, source: Any, to: Any) -> None:
            while piece := source.read(size):
                to.write(piece)

        def log_message(self, *args: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:  # else a failing reader leaves a thread that the program waits for
            server.shutdown()


def node(path: Path, way: str, size: int) -> tuple[float, int]:
    """(seconds, peak bytes of the process)."""
    with served(path, size) as address:
        script = str(PLAYER / "testing" / "streams.mjs")
        words = ["node", script, str(path), way, str(size), f"{address}/scene.pd4"]
        seconds, peak = json.loads(subprocess.run(words, capture_output=True, check=True).stdout)
    return seconds, peak


def chromium(path: Path, way: str, size: int) -> tuple[float, int]:
    """(seconds, peak bytes of the page's process). Raises DataError without a browser."""
    others = renderers()
    with served(path, size) as address, launched() as browser:
        page = browser.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.goto(f"{address}/package.json")
        page.evaluate(
            """async ([way, size, url]) => {
              const { working } = await import("/testing/splits.js");
              const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
              globalThis.work = working(bytes, way, size, url);
            }""",
            [way, size, f"{address}/scene.pd4"],
        )
        (own,) = renderers() - others
        seconds = []
        for _ in range(7):
            start = processor_time(own)
            page.evaluate("work()")
            seconds.append(processor_time(own) - start)
        return min(seconds), peak_bytes(own)


def renderers() -> set[Path]:
    """Chromium's processes for pages, in /proc."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                found.add(folder)
    return found


def processor_time(process: Path) -> float:
    """Seconds, of all threads."""
    return sum(int(task.read_text().split()[0]) for task in process.glob("task/*/schedstat")) / 1e9


ROWS = [
    ("Python", python, "stream"),
    ("Python, the newest scene kept", python, "kept"),
    ("Node, `Stream`", node, "stream"),
    ("Node, `SceneSource` of a server", node, "served"),
    ("Node, reading the server alone", node, "serverAlone"),
    ("Node, `SceneSource` of a script's pieces", node, "source"),
    ("Node, reading these alone", node, "sourceAlone"),
    ("Chromium, `Stream`", chromium, "stream"),
    ("Chromium, `SceneSource` of a server", chromium, "served"),
    ("Chromium, reading the server alone", chromium, "serverAlone"),
    ("Chromium, `SceneSource` of a script's pieces", chromium, "source"),
    ("Chromium, reading these alone", chromium, "sourceAlone"),
]


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .pd4 file")
    path = parser.parse_args().file
    names = ["1", "7", "1 KiB", "64 KiB", "whole"]
    print(f"| reader | decode | {' | '.join(names)} |\n|---|---|{'---:|' * len(names)}")
    for name, measure, way in ROWS:
        try:
            usual = measure(path, "decode", 1)
            found = [measure(path, way, size) for size in SIZES]
        except DataError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        base = f"{1e3 * usual[0]:.0f} ms, {usual[1] / MEGABYTE:.0f} MiB"
        cells = [f"{own[0] / usual[0]:.1f} / {own[1] / usual[1]:.2f}" for own in found]
        print(f"| {name} | {base} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
