"""What a file costs in pieces, by their bytes: time and memory as multiples of decode's, as a Markdown table.

    pd4dgs-encode model.pt -o scene.pd4 --slices 4k
    python benchmarks/streams.py scene.pd4     # two minutes; without a browser, the rows of Chromium are left out

Time is the least of seven runs, processor time, in a page wall time; memory is the peak of arrays in Python, of the
whole process, one for each figure, in Node and Chromium (on Linux).
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tracemalloc
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from browser import PATIENCE_MS, PLAYER, launched

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


def node(path: Path, way: str, size: int) -> tuple[float, int]:
    """(seconds, peak bytes of the process)."""
    words = ["node", str(PLAYER / "testing" / "streams.mjs"), str(path), way, str(size)]
    seconds, peak = json.loads(subprocess.run(words, capture_output=True, check=True).stdout)
    return seconds, peak


def chromium(path: Path, way: str, size: int) -> tuple[float, int]:
    """(seconds of wall time, peak bytes of the page's process). Raises DataError without a browser."""
    with launched() as browser:
        page = browser.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.route("**/*.js", lambda route: route.fulfill(path=PLAYER / route.request.url.split("/", 3)[3]))
        page.route("**/scene.pd4", lambda route: route.fulfill(path=path))
        page.route("http://localhost/", lambda route: route.fulfill(content_type="text/html", body=""))
        page.goto("http://localhost/")
        seconds = page.evaluate(
            """async ([way, size]) => {
              const { cost } = await import("/testing/splits.js");
              const bytes = new Uint8Array(await (await fetch("/scene.pd4")).arrayBuffer());
              return await cost(bytes, way, size, () => performance.now() / 1000);
            }""",
            [way, size],
        )
        return seconds, max(renderer_peaks())


def renderer_peaks() -> list[int]:
    """Peak bytes of Chromium's processes for pages."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                told = (folder / "status").read_text().split("VmHWM:")[1].split()[0]
                found.append(1024 * int(told))
        except (OSError, IndexError):
            pass  # it has ended
    return found


ROWS = [
    ("Python", python, "stream"),
    ("Python, the newest scene kept", python, "kept"),
    ("Node, `Stream`", node, "stream"),
    ("Node, `SceneSource`", node, "source"),
    ("Node, reading its pieces alone", node, "pieces"),
    ("Chromium, `Stream`", chromium, "stream"),
    ("Chromium, `SceneSource`", chromium, "source"),
    ("Chromium, reading its pieces alone", chromium, "pieces"),
]


def main() -> None:
    """The table."""
    path = Path(sys.argv[1])
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
