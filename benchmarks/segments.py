"""A long sequence of Gaussians as one file, as files of their own, and as segments that share what stands still.

`python benchmarks/segments.py` writes a PLY sequence of a room, most of which stands still, with balls that never move
the same way twice, and imports it in three ways at the same dB. It measures bytes, dB inside segments and at their
seams, and how far pictures half a frame before and after differ there. `--long 10` imports it as segments, and a
sequence ten times as long, and measures bytes, what a client fetches for a seek, and memory: that of the import, and of
a page that plays. `--visit DIR` plays a package of segments, and seeks in it over a link of 2 Mbps.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from browser import ELEMENT, call, launched, until
from common import Row, command, say, table

from pd4dgs_codec import decode
from pd4dgs_codec.draw.player import Drawer, drawer
from pd4dgs_codec.interchange import imported
from pd4dgs_codec.interchange.splats import picture, ply_bytes, sphere
from pd4dgs_codec.interchange.teacher import Options, cameras_of
from pd4dgs_codec.kinds.splats import SH_C0, Splats, unit
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.quality.levels import Timeline
from pd4dgs_codec.scene import Camera
from pd4dgs_codec.segments import INDEX, read_index
from pd4dgs_codec.web.page import page
from pd4dgs_codec.web.segments import SegmentsClient
from pd4dgs_codec.web.server import Link, Server

FPS, DB = 12, 40
CAMERAS, SIZE = 36, 240  #: that an import decides by, fewer and smaller than usual
JUDGES = 3  #: cameras that measure
SPEED = 4  #: of the page that plays
At = Callable[[float], tuple[Drawer, float]]  #: seconds -> what draws them, and the normalised time there


def room(seconds: float, still: int = 3000, balls: int = 3, each: int = 250) -> Splats:
    """A floor and two walls, and balls that swing and spin."""
    rng, parts = np.random.default_rng(0), list[tuple[Any, ...]]()
    for axis in range(3):
        at = rng.uniform(-2, 2, (still // 3, 3))
        at[:, axis] = 2
        tint = 0.5 + 0.3 * np.sin(2 * at @ rng.normal(size=(3, 3)))
        size = 0.08 * rng.uniform(0.7, 1.3, (len(at), 1)) * np.ones(3)
        parts.append((at, tint, size, unit(rng.normal(size=(len(at), 4)))))
    for _ in range(balls):
        ball, rates, phases, speed = (
            0.4 * sphere(each),
            rng.uniform(0.5, 2, 3),
            rng.uniform(0, 6, 3),
            rng.uniform(0.5, 1.5),
        )
        tint = np.clip(rng.uniform(0.2, 0.8, 3) + 0.2 * np.sin(8 * ball @ rng.normal(size=(3, 3))), 0, 1)
        cos, sin = np.cos(speed * seconds), np.sin(speed * seconds)
        turned = ball @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        place = 1.2 * np.sin(rates * seconds + phases)
        parts.append((turned + place, tint, np.full((each, 3), 0.05), unit(rng.normal(size=(each, 4)))))
    means, tints, sizes, quats = (np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True))
    sh = ((tints - 0.5) / SH_C0)[:, None].astype(np.float32)
    return Splats(means, quats, sizes, np.full(len(means), 0.95, np.float32), sh)


def write_frames(folder: Path, count: int) -> Path:
    """Writes frames, if they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        if not (path := folder / f"{i:05d}.ply").exists():
            path.write_bytes(ply_bytes(room(i / FPS)))
    return folder


def views() -> list[Camera]:
    found, _ = cameras_of(Path("none"), room(0).means, Options(views=8 * JUDGES, size=(SIZE, SIZE)))
    return found[4::8]


def decibels(at: At, times: list[float]) -> float:
    """Mean PSNR of pictures at these seconds against those of the source."""
    found = []
    for seconds in times:
        part, t = at(seconds)
        for camera in views():
            found.append(mpsnr(part.picture(camera, t), picture(room(seconds), camera, (0.0, 0.0, 0.0))))
    return float(np.mean(found))


def steps(at: At, times: list[float]) -> float:
    """Mean PSNR of pictures half a frame before these seconds against those half a frame after, in dB."""
    half, found = 0.5 / FPS, []
    for seconds in times:
        (before, s), (after, t) = at(seconds - half), at(seconds + half)
        found += [mpsnr(before.picture(camera, s), after.picture(camera, t)) for camera in views()]
    return float(np.mean(found))


def natural(times: list[float]) -> float:
    """`steps` of the source."""
    half, black = 0.5 / FPS, (0.0, 0.0, 0.0)
    pairs = [(room(t - half), room(t + half), camera) for t in times for camera in views()]
    return float(np.mean([mpsnr(picture(a, camera, black), picture(b, camera, black)) for a, b, camera in pairs]))


def compared(out: Path, seconds: int, length: int) -> list[Row]:
    """Imports a sequence in three ways."""
    frames = write_frames(out / "frames", seconds * FPS + 1)
    count = seconds // length
    asked = ("--psnr", DB, "--fps", FPS, "-f")
    command("import_model", frames, "-o", out / "whole.pd4", *asked)
    parts = list[bytes]()
    for k in range(count):
        shutil.rmtree(some := out / "part", ignore_errors=True)
        some.mkdir()
        for i in range(k * length * FPS, (k + 1) * length * FPS + 1):
            os.link(frames / f"{i:05d}.ply", some / f"{i:05d}.ply")
        command("import_model", some, "-o", out / f"part-{k}.pd4", *asked)
        parts.append((out / f"part-{k}.pd4").read_bytes())
    command("import_model", frames, "-o", out / "segments", "--segments", length, *asked)
    _, index = read_index(out / "segments")
    whole, alone = drawer(decode(out / "whole.pd4")), [drawer(decode(data)) for data in parts]
    timeline = Timeline(out / "segments")

    def of_parts(t: float) -> tuple[Drawer, float]:
        k = min(int(t / length), count - 1)
        return alone[k], t / length - k

    seams = [float(k * length) for k in range(1, count)]
    inside = [(k + share) * length for k in range(count) for share in (0.26, 0.74)]
    just = [t + sign * 1e-6 for t in seams for sign in (-1, 1)]
    rows, size = list[Row](), (out / "whole.pd4").stat().st_size
    base = sum(file.bytes for file in index.bases)
    own = [file.bytes for file in index.segments]
    for name, at, sizes in (
        ("one file", lambda t: (whole, t / seconds), [size]),
        ("files of their own", of_parts, [len(data) for data in parts]),
        ("segments", lambda t: (timeline, t / seconds), [base + own[0], *own[1:]]),
    ):
        row = {"way": name, "bytes": sum(sizes), "first": sizes[0], "later": np.mean(sizes[1:]) if sizes[1:] else None}
        row |= {"inside": decibels(at, inside), "seams": decibels(at, just)}
        rows.append(row | {"step inside": steps(at, inside), "step seams": steps(at, seams)})
        say(str(rows[-1]))
    say(f"the source itself differs by {natural(inside):.2f} dB inside and {natural(seams):.2f} dB at seams")
    return rows


def remembered(arguments: list[object]) -> float:
    """Runs pd4dgs-import in a process of its own, with this module's cameras; returns its largest memory, MB."""
    code = "import sys; from pd4dgs_codec.interchange import imported; from pd4dgs_codec.cli.import_model import main\n"
    code += f"imported.CAMERAS, imported.SIZE = {CAMERAS}, {SIZE}; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit("the import failed")
    return usage.ru_maxrss / 1e3


def lengthened(out: Path, seconds: int, length: int) -> Row:
    """Imports, fetches and plays a sequence: bytes, and memory in MB."""
    frames, folder = write_frames(out / f"frames-{seconds}", seconds * FPS + 1), out / f"segments-{seconds}"
    shutil.rmtree(folder, ignore_errors=True)
    memory = remembered([frames, "-o", folder, "--segments", length, "--psnr", DB, "--fps", FPS])
    _, index = read_index(folder)
    base, own = (sum(file.bytes for file in files) for files in (index.bases, index.segments))
    row: Row = {"seconds": seconds, "base": base, "a minute": 60 * own / seconds, "import MB": memory}
    (folder / "index.html").write_text(page(INDEX))
    with Server(folder) as server, server.running():
        client = SegmentsClient(server.url_of(INDEX))
        client.at(seconds * 0.7)
        row["first seek"], before = client.received, client.received
        client.at(seconds * 0.3)
        row["later seek"] = client.received - before
        row |= played(server.url, seconds)
    return row


def played(url: str, seconds: int) -> Row:
    """Plays all of it; returns the page's heap after the first fifth and at the end, MB, and the most parts held."""
    heap = "(gc(), performance.memory.usedJSHeapSize / 1e6)"
    with launched() as browser:
        shown = browser.new_page(viewport={"width": 160, "height": 120})
        shown.goto(f"{url}?loop=0&autoplay=0&speed={SPEED}")
        until(shown, f"{ELEMENT}?.player?.scene?.layers.length > 1")
        shown.evaluate(f"{ELEMENT}.play()")
        until(shown, f"{ELEMENT}.time >= {seconds / 5}")
        early, most = shown.evaluate(heap), 0
        while not shown.evaluate(f"{ELEMENT}.paused"):
            most = max(most, shown.evaluate(f"{ELEMENT}.player._parts.size"))
        return {"heap early": early, "heap at the end": shown.evaluate(heap), "parts": most}


#: Seconds from a seek until what shows its time has been drawn.
SEEK = """async (seconds) => {
  const { player } = document.querySelector("pd4-player");
  const started = performance.now();
  player.seek(seconds);
  while (player.awaited || player._front?.scene !== player.scene || player._dirty || player._drawing) {
    await new Promise((resolve) => setTimeout(resolve, 5));
  }
  return (performance.now() - started) / 1000;
}"""


def memory_of_browser() -> float:
    """Memory of all processes that this one started and theirs, shared pages by share, MB."""
    parents = {}
    for status in Path("/proc").glob("[0-9]*/status"):
        with contextlib.suppress(OSError):
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
            parents[int(fields["Pid"])] = int(fields["PPid"])
    own, total = {os.getpid()}, 0.0
    while more := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= more
    for pid in own - {os.getpid()}:
        with contextlib.suppress(OSError):
            total += int(re.findall(r"^Pss: *([0-9]+)", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.M)[0]) / 1e3
    return total


def endured(folder: Path) -> None:
    """Plays a package of segments to its end; prints the memory on the way."""
    _, index = read_index(folder)
    low, high = index.time_range
    heap = "(gc(), performance.memory.usedJSHeapSize / 1e6)"
    with Server(folder) as server, server.running(), launched() as browser:
        shown = browser.new_page(viewport={"width": 320, "height": 240})
        shown.goto(f"{server.url}?loop=0&autoplay=0&speed={SPEED}")
        until(shown, f"{ELEMENT}?.player?.scene?.layers.length > 1")
        shown.evaluate(f"{ELEMENT}.play()")
        rows, most = list[list[object]](), 0
        for tenth in range(1, 11):
            while shown.evaluate(f"{ELEMENT}.time < {low + tenth * (high - low) / 10} && !{ELEMENT}.paused"):
                most = max(most, shown.evaluate(f"{ELEMENT}.player._parts.size"))
                shown.wait_for_timeout(200)
            rows.append([f"{shown.evaluate(f'{ELEMENT}.time'):.0f}", f"{shown.evaluate(heap):.1f}"])
            rows[-1] += [f"{memory_of_browser():.0f}", shown.evaluate(f"{ELEMENT}.player.counts.drawn")]
            say(str(rows[-1]))
        print(table(["seconds", "heap MB", "browser MB", "pictures"], rows), f"\n\nparts held: {most} at most\n")


def sought(folder: Path, out: Path, seeks: int = 12) -> None:
    """Seeks in a package of segments over a slow link, then takes segments away; prints what it finds, and writes
    screenshots to `out`."""
    out.mkdir(parents=True, exist_ok=True)
    _, index = read_index(folder)
    low, high = index.time_range
    rate, rng, rows = 2e6, np.random.default_rng(0), []
    with Server(folder, link=Link(rate)) as server, server.running(), launched() as browser:
        shown = browser.new_page(viewport={"width": 320, "height": 240})
        shown.goto(f"{server.url}?loop=0&autoplay=0")
        until(shown, f"{ELEMENT}?.player?.scene?.layers.length > 1 && {ELEMENT}.player._isSettled()")
        for seconds in rng.uniform(low, high, seeks):
            files = [s for s in index.segments if s.time_range[0] <= seconds < s.time_range[1]]
            missing = sum(file.bytes for file in files)
            took = call(shown, SEEK, seconds)
            rows.append([f"{seconds:.1f}", len(files), missing, f"{took:.2f}", f"{8 * missing / rate + 0.4:.2f}"])
        print(table(["seek to s", "segments", "bytes missing", "drawn after s", "8 bytes/B + 0.4"], rows), "\n")
        shown.screenshot(path=out / "there.png")
        faults: dict[str, Callable[[Any], None]] = {
            "missing": lambda route: route.fulfill(status=404),
            "damaged": lambda route: route.fulfill(body=bytes(index.segments[2 * seeks].bytes)),
            "late": lambda route: None,
        }
        places = dict(zip(faults, (seeks, 2 * seeks, 3 * seeks), strict=True))
        for name, k in places.items():
            shown.route(f"**/{index.segments[k].file}", faults[name])
        for name, k in places.items():
            start, end = index.segments[k].time_range
            shown.evaluate(f"{ELEMENT}.seek({(start + end) / 2})")
            shown.wait_for_timeout(3000)
            words = [
                shown.evaluate(f"{ELEMENT}.shadowRoot.querySelector('{c}').textContent") for c in (".error", ".status")
            ]
            print(f"{name}: {words}")
            shown.screenshot(path=out / f"{name}.png")
        shown.evaluate(f"{ELEMENT}.play()")  # past it
        after = index.segments[3 * seeks + 2].time_range[0]
        until(shown, f"{ELEMENT}.time > {after} && {ELEMENT}.player.scene.layers.length > 1")
        print(f"it goes on after it: {shown.evaluate(f'{ELEMENT}.player.problem')!r}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="out/segments", help="folder for frames and files")
    parser.add_argument("--seconds", type=int, default=6)
    parser.add_argument("--length", type=int, default=1, help="seconds of a segment")
    parser.add_argument("--long", type=int, default=0, metavar="N", help="measure N times the length instead, and once")
    parser.add_argument("--visit", type=Path, metavar="DIR", help="visit this package of segments instead")
    args = parser.parse_args()
    if args.visit:
        endured(args.visit)
        sought(args.visit, Path(args.output))
        return
    imported.CAMERAS, imported.SIZE = CAMERAS, SIZE
    out = Path(args.output)
    if args.long:
        rows = [lengthened(out, n * args.seconds, args.length) for n in (1, args.long)]
    else:
        rows = compared(out, args.seconds, args.length)
    shown = [[value if isinstance(value, str) else _number(value) for value in row.values()] for row in rows]
    print(table(list(rows[0]), shown))


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f}" if isinstance(value, int) or value >= 1000 else f"{value:.2f}"


if __name__ == "__main__":
    main()
