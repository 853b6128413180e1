"""Pictures a second and what they show while a file plays in Chromium without a GPU: a row per size of the page.

    python benchmarks/playing.py scene.pd4

--player names the folder of another player, such as that of an older version.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import browser
from common import Row, number, table

from pd4dgs_codec import decode
from pd4dgs_codec.web.server import Server

SIZES = "1280x800,390x844"
#: Pictures kept of each run; before it, so many milliseconds for the player to find out how fast the machine is.
KEPT, WARM_MS = 8, 4000
#: Plays for a while and gathers pictures as the screen has them, enlarged to the element's size; then draws the same
#: times at rest: the highest level, every pixel.
MEASURE = """async (kept, warm, span) => {
  const { player } = document.querySelector("pd4-player");
  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const { clientWidth: width, clientHeight: height } = player.canvas;
  const shown = [], levels = [], scales = [];
  player.loop = true;
  player.play();
  await wait(warm);
  const before = { ...player.counts }, started = performance.now();
  await wait(span);
  const seconds = (performance.now() - started) / 1000;
  const drawn = (player.counts.drawn - before.drawn) / seconds;
  const evaluated = (player.counts.evaluated - before.evaluated) / seconds;
  const { bytes, software, gaussians } = player.status;
  const status = document.querySelector("pd4-player").shadowRoot.querySelector(".status").textContent;
  const pixels = (picture) => {
    const whole = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
    const own = new OffscreenCanvas(picture.width, picture.height);
    own.getContext("2d").putImageData(picture, 0, 0);
    whole.drawImage(own, 0, 0, width, height);
    return whole.getImageData(0, 0, width, height).data;
  };
  const [start, end] = player.timeRange;
  for (let i = 0; i < kept; i++) {
    const evaluatedNow = player.counts.evaluated, asked = performance.now();
    while (player.counts.evaluated === evaluatedNow && performance.now() - asked < 2000) await wait(5);
    const { t, level } = player._front.state;
    shown.push({ data: pixels(player.snapshot()), time: start + t * (end - start), level });
    levels.push(level);
    scales.push(player.status.scale);
    await wait(span / kept);
  }
  player.pause();
  const decibels = [];
  for (const { data, time } of shown) {
    player.seek(time);
    await wait(300);
    await player.settled();
    const whole = pixels(player.snapshot());
    let sum = 0;
    for (let i = 0; i < data.length; i++) if (i % 4 < 3) sum += (data[i] - whole[i]) ** 2;
    decibels.push(-10 * Math.log10(Math.max(sum / (0.75 * data.length), 1e-3) / 255 ** 2));
  }
  return { drawn, evaluated, gaussians, levels, scales, decibels, status, software, bytes };
}"""


def measure(file: Path, player: Path, sizes: str, seconds: float) -> list[Row]:
    """What MEASURE finds at each size, "WIDTHxHEIGHT,..."."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name, browser.launched() as opened:
        shutil.copytree(player, Path(name) / "player", ignore=shutil.ignore_patterns("node_modules", "test*"))
        shutil.copy(file, Path(name) / "player" / "scene.pd4")
        with Server(name) as server, server.running():
            for size in sizes.split(","):
                width, height = map(int, size.split("x"))
                page: Any = opened.new_page(viewport={"width": width, "height": height})
                page.set_default_timeout(browser.TIMEOUT_MS)
                page.goto(f"{server.url_of('player/index.html')}?autoplay=0")
                browser.wait_for_level(page, decode(file.read_bytes()).level)
                rows.append({"size": size} | browser.call(page, MEASURE, KEPT, WARM_MS, 1000 * seconds))
                page.close()
    return rows


def main() -> None:
    """The table of the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .pd4 file")
    parser.add_argument("--player", type=Path, default=browser.PLAYER, help="the player's folder (default: this one)")
    parser.add_argument("--sizes", default=SIZES, help="of the page, CSS pixels (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=6, help="of playing that pictures are counted in")
    args = parser.parse_args()
    rows = measure(args.file, args.player, args.sizes, args.seconds)
    cells = [
        (r["size"], number(r["gaussians"], 0), number(r["drawn"], 1), number(r["evaluated"], 1))
        + (" ".join(map(str, sorted(set(r["levels"])))), f"{median(r['scales']):.2f}")
        + (number(median(r["decibels"]), 1), number(min(r["decibels"]), 1), r["status"])
        for r in rows
    ]
    head = ("page", "Gaussians", "pictures/s", "times/s", "levels", "size", "median dB", "least dB", "status line")
    print(table(head, cells))


if __name__ == "__main__":
    main()
