"""Measures what docs/player.md shows: the player's pictures, seconds to them, frame rates, decode times and sizes.

    python tools/player_page.py [--out out] [--docs docs] [--runs 9] [--only shelf-hand] [--render]
    python tools/player_page.py --others node_modules --before FOLDER

Reads out/NAME/scene.pd4, which tools/results.py makes. Needs Chromium and Playwright, and Node. About ten minutes a
scene on two quiet cores; on busy ones the times are worthless. --others also times other players, whose packages npm
put there (see pages/other_players.py). --before also times the decoder of the checkout in FOLDER, on files that both
pack from FOLDER/out/NAME/model.pt, which the older trainer made.
"""

from __future__ import annotations

import argparse
import gzip
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from pages.browser import HARNESS, PATIENCE_MS, call, cameras, copy_player, decibels, launched, resized, shoot, shots
from pages.other_players import PAGES as OTHERS
from pages.other_players import STEPS, export
from pages.other_players import lay_out as lay_out_other
from pages.page import Page, Row, keep, make, options, paragraph, say, unpadded
from pages.scenes import SCENES
from player_speed import MANY, NodeDecoder, beside, compare, grown
from player_speed import row as speed_row

from pd4dgs_codec import decode, encode
from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.info import info
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.scene import Camera
from pd4dgs_codec.threads import configure
from pd4dgs_codec.web import PAGE as INDEX
from pd4dgs_codec.web.page import page as whole_page
from pd4dgs_codec.web.server import Server

NAMES = ("shelf-hand", "bouncing-balls")
TIMES = (0.0, 0.37, 1.0)
#: Angle and how much nearer, of the cameras beside the scene's own.
TURNS = ((0.12, 0.0), (-0.2, 0.15))
RATES, LATENCY = (2e6, 10e6), 0.05
#: Longest side of compared pictures; pixels. Views of the dataset that levels are scored on.
SIDE, VIEWS = 320, 6
WINDOW = {"width": 480, "height": 360}
BENCH_SIZES = "320x240,640x480"
#: Bytes of a slice, and the name of the first one's row.
SLICES, FIRST = 50_000, "0, first slice"
#: What the page writes down of each picture, against the start of the navigation.
NOTE = """window.noted = [];
  for (const name of ["firstpicture", "upgrade"]) {
    document.addEventListener(name, (event) => {
      const { level, bytes, seconds, arrived, decoded } = event.detail;
      const start = performance.now() / 1000 - seconds;
      noted.push({ level, bytes, shown: performance.now() / 1000, arrived: start + arrived, decoded: start + decoded });
    }, true);
  }"""


@contextmanager
def served(folder: Path, rate: float) -> Iterator[str]:
    """The URL of a folder behind a link of `rate` bits per second, from `pd4dgs-serve` in another process."""
    command = ["serve", str(folder), "--port", "0", "--rate", repr(rate), "--latency", f"{LATENCY}s"]
    process = subprocess.Popen([sys.executable, "-m", "pd4dgs_codec", *command], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        with process.stdout as lines:
            url = lines.readline().strip()
            if not url:
                raise DataError("pd4dgs-serve did not start")
            yield url
    finally:
        process.terminate()
        process.wait()


def opened(browser: Any) -> Any:
    """A page with nothing in its caches."""
    context = browser.new_context(viewport=WINDOW)
    context.set_default_timeout(PATIENCE_MS)
    return context.new_page()


def lay_out(folder: Path, data: bytes) -> None:
    """The packed page and the scene, as `pd4dgs-package` has them."""
    (folder / INDEX).write_text(whole_page())
    (folder / "scene.pd4").write_bytes(data)


def fitting(camera: Camera) -> Camera:
    """The same view with sides of at most SIDE."""
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    return resized(camera, round(camera.width * scale), round(camera.height * scale))


def pictures(browser: Any, name: str, data: bytes) -> tuple[list[float], list[float] | None, str]:
    """(least dB per level against the rasteriser, mean mPSNR per level against the dataset's views if it is there, what
    drew)."""
    scene = decode(data)
    views = [fitting(camera) for camera in cameras(scene, TURNS)]
    with tempfile.TemporaryDirectory() as folder:
        copy_player(Path(folder))
        (Path(folder) / "scene.pd4").write_bytes(data)
        with Server(folder) as server, server.running():
            page = opened(browser)
            page.goto(server.url_of(HARNESS))
            page.wait_for_function("!!window.harness")
            call(page, "harness.open", server.url_of("scene.pd4"), views[0].width, views[0].height)
            renderer = page.evaluate("harness.player.renderer")
            least = {level: float("inf") for level in scene.layers}
            for shot in shots(page, data, views, TIMES):
                least[shot.level] = min(least[shot.level], decibels(shot.player, shot.expected))
            truth = against_truth(page, server, name, scene.layers, scene.info.time_range)
            page.context.close()
    return list(least.values()), truth, renderer


def against_truth(
    page: Any, server: Server, name: str, levels: Sequence[int], span: tuple[float, float]
) -> list[float] | None:
    """Mean mPSNR of each level over views of the dataset that training did not see."""
    if not SCENES[name].there:
        return None
    views = SCENES[name].load().test
    chosen = [views[i * (len(views) - 1) // max(VIEWS - 1, 1)] for i in range(min(VIEWS, len(views)))]
    call(page, "harness.open", server.url_of("scene.pd4"), chosen[0].width, chosen[0].height)
    low, high = span
    means = []
    for level in levels:
        values = []
        for view in chosen:
            got = shoot(page, view.camera, level, low + view.time * (high - low))
            values.append(mpsnr(got, view.image, view.mask))
        means.append(sum(values) / len(values))
    return means


def seconds(browser: Any, data: bytes, runs: int) -> list[Row]:
    """A row per rate and level, and of a first slice: bytes, and medians of the seconds since the navigation began."""
    layers = info(data)["layers"]
    ends = {str(row["layer"]): row["end"] for row in layers}
    if len(layers[0]["slices"]) > 1:
        ends = {FIRST: layers[0]["slices"][0]["end"], **ends}
    last = layers[-1]["layer"]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        lay_out(Path(folder), data)
        for rate in RATES:
            found: list[list[Row]] = []
            with served(Path(folder), rate) as url:
                for _ in range(runs):
                    page = opened(browser)
                    page.add_init_script(NOTE)
                    page.goto(f"{url}?autoplay=0")
                    page.wait_for_function(f"noted.some(({{ level }}) => level === {last})")
                    found.append(page.evaluate("noted"))
                    page.context.close()
            for level, end in ends.items():
                # a level is skipped where the next one is there before it is evaluated
                noted = [run[0] if level == FIRST else _shown(run, int(level)) for run in found]
                row: Row = {"rate": rate, "level": level, "bytes": end}
                rows.append(row | {key: median(n[key] for n in noted) for key in ("arrived", "decoded", "shown")})
    return rows


def _shown(run: Sequence[Row], level: int) -> Row:
    """When a level and all its slices were shown."""
    whole = [note for note in run if note["level"] == level]
    return whole[-1] if whole else next(note for note in run if note["level"] > level)


def frame_rates(browser: Any, data: bytes) -> list[Row]:
    """What `?bench` finds."""
    with tempfile.TemporaryDirectory() as folder:
        lay_out(Path(folder), data)
        with Server(folder) as server, server.running():
            page = opened(browser)
            page.goto(f"{server.url}?bench&sizes={BENCH_SIZES}")
            page.wait_for_function("!!window.benchResult", timeout=5 * PATIENCE_MS)
            rows: list[Row] = page.evaluate("benchResult.rows")
            page.context.close()
    return rows


def screenshot(browser: Any, data: bytes, path: Path) -> None:
    """The element with the scene half way through its time."""
    scene = decode(data)
    low, high = scene.info.time_range
    with tempfile.TemporaryDirectory() as folder:
        lay_out(Path(folder), data)
        with Server(folder) as server, server.running():
            page = opened(browser)
            page.goto(f"{server.url}?autoplay=0&time={(low + high) / 2}")
            page.wait_for_function("document.querySelector('pd4-player')")
            call(page, "() => document.querySelector('pd4-player').player.settled()")
            page.wait_for_timeout(500)  # the status line is brought up to date
            page.screenshot(path=str(path), type="jpeg", quality=85)
            page.context.close()


def others(browser: Any, name: str, path: Path, modules: Path, out: Path, runs: int) -> list[Row]:
    """A row per rate and other player: bytes, and the median of the seconds until its picture of the first instant is
    there. Leaves a picture of each page in `out`."""
    source, known, rows = SCENES[name], decode(path.read_bytes()).info, []
    with tempfile.TemporaryDirectory() as splats:
        export(path, source.source, source.downscale, modules, Path(splats))
        for other in OTHERS:
            with tempfile.TemporaryDirectory() as folder:
                size = WINDOW["width"], WINDOW["height"]
                laid = lay_out_other(other, known, size, Path(splats), modules, Path(folder))
                for rate in RATES:
                    found = []
                    with served(Path(folder), rate) as url:
                        for _ in range(runs):
                            page = opened(browser)
                            page.goto(url)
                            page.wait_for_function("!!window.seen")
                            found.append(page.evaluate("window.seen"))
                            if len(found) == runs:
                                page.screenshot(path=str(out / f"{name}-{other}.png"))
                            page.context.close()
                    row = {"rate": rate, "player": other, "page": laid.page, "bytes": laid.splats}
                    rows.append(row | {"shown": median(found)})
    return rows


def decoding(name: str, data: bytes, runs: int) -> list[Row]:
    """Decode times of the file and of one with MANY anchors, in Node and in Python."""
    with tempfile.TemporaryDirectory() as folder, NodeDecoder() as node:
        files = {f"{name}.pd4": data, f"{name}-{MANY}.pd4": b""}
        files[f"{name}-{MANY}.pd4"] = encode(grown(decode(data), MANY), effort=1, omit="nothing", verify=False)
        rows = []
        for file, content in files.items():
            path = Path(folder) / file
            path.write_bytes(content)
            rows.append(speed_row(path, *compare(path, runs, node)))
    return rows


def measure(name: str, args: argparse.Namespace) -> Row:
    """All that the page shows of one scene."""
    out, docs, runs = args.out, args.docs, args.runs
    path = out / name / "scene.pd4"
    if not path.is_file():
        raise DataError(f"{path}: is not there; tools/results.py makes it")
    data = path.read_bytes()
    scene = decode(data)
    row: Row = {"bytes": len(data), "anchors": scene.rows[-1], "layers": list(scene.layers), "runs": runs}
    say(f"{name}: decoding")
    row["decoding"] = decoding(name, data, runs)
    if args.before:
        with NodeDecoder() as node:
            row["before"] = beside(args.before / "out" / name / "model.pt", args.before, runs, node)
    with launched() as browser:
        row["browser"] = f"Chromium {browser.version.split('.')[0]}"
        say(f"{name}: seconds to pictures")
        row["seconds"] = seconds(browser, data, runs)
        say(f"{name}: seconds to pictures, in slices of {SLICES:,} bytes")
        sliced = encode(scene, effort=1, omit="nothing", slices=SLICES)
        row["sliced"] = {"slices": sum(len(r["slices"]) for r in info(sliced)["layers"])}
        row["sliced"]["seconds"] = seconds(browser, sliced, runs)
        if args.others:
            say(f"{name}: other players")
            row["others"] = others(browser, name, path, args.others.resolve(), out, runs)
        say(f"{name}: frame rates")
        row["rates"] = frame_rates(browser, data)
        say(f"{name}: pictures")
        row["least"], row["truth"], row["renderer"] = pictures(browser, name, data)
        screenshot(browser, data, docs / "img" / f"player-{name}.jpg")
    row["page"] = len(gzip.compress(whole_page().encode(), 9, mtime=0))
    keep(out, f"player-{name}", row)
    return row


# -- the page ----------------------------------------------------------------------------------------------------------


def render(rows: Sequence[Row]) -> str:
    """Sizes, pictures, seconds, frame rates and decode times of every scene."""
    visit = rows[-1]["page"]
    first = f"{rows[-1]['browser']}, {rows[-1]['renderer']}; two cores. Page and player: {visit:,} bytes gzipped."
    heads = ["\n".join(paragraph(first))]
    parts = [_pictures(rows), _seconds(rows, visit), _others(rows, visit), _rates(rows), _decoding(rows)]
    return "\n\n".join([*heads, *filter(None, [*parts, _before(rows)])])


def _block(said: str, head: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A paragraph and its table."""
    return "\n".join([*paragraph(said), "", unpadded(markdown(head, cells))])


def _pictures(rows: Sequence[Row]) -> str:
    cells = []
    for row in rows:
        for i, level in enumerate(row["layers"]):
            truth = f"{row['truth'][i]:.2f}" if row["truth"] else "-"
            cells.append((row["name"], str(level), f"{row['least'][i]:.1f}", truth))
    said = (
        f"**Pictures**, dB. Least: of {len(TIMES)} times × {1 + len(TURNS)} cameras against the package's rasteriser, "
        "whose own 8 bits alone leave 59. Truth: mean mPSNR of the player's pictures against views that training did "
        f"not see, up to {VIEWS} of them."
    )
    return _block(said, ("scene", "level", "least", "truth"), cells)


def _seconds(rows: Sequence[Row], visit: int) -> str:
    cells = []
    named = [(row["name"], row["seconds"]) for row in rows]
    named += [
        (f"{row['name']}, {row['sliced']['slices']} slices", row["sliced"]["seconds"])
        for row in rows
        if "sliced" in row
    ]
    for name, found in named:
        for r in found:
            ideal = 8 * (r["bytes"] + visit) / r["rate"]
            cells.append(
                (
                    name,
                    f"{r['rate'] / 1e6:g}",
                    str(r["level"]),
                    f"{r['bytes']:,}",
                    f"{8 * r['bytes'] / r['rate']:.2f}",
                    f"{ideal:.2f}",
                    f"{r['arrived']:.2f}",
                    f"{r['decoded'] - r['arrived']:.2f}",
                    f"{r['shown'] - r['decoded']:.2f}",
                    f"{r['shown']:.2f}",
                )
            )
    said = (
        f"**Seconds from navigation to each picture**, cold cache, median of {rows[-1]['runs']}, round trip "
        f"{LATENCY * 1e3:g} ms. S: bytes up to the end of the layer or slice. P: page and player, {visit:,} bytes. "
        "Arrived: the last of these bytes. Then decoding, and what it takes to evaluate, sort and draw, in software. "
        "Files in slices are of the same scene, encoded with less effort."
    )
    head = ("scene", "Mbps", "level", "S", "8S/B", "8(S+P)/B", "arrived", "decode", "evaluate, draw", "picture")
    return _block(said, head, cells)


def _others(rows: Sequence[Row], visit: int) -> str:
    """Other players beside this one, where they were measured."""
    cells = []
    for row in [row for row in rows if "others" in row]:
        for rate in RATES:
            own = [r for r in row["seconds"] if r["rate"] == rate]
            found = [("this player, first picture", visit, own[0]["bytes"], own[0]["shown"])]
            found += [("this player, every level", visit, own[-1]["bytes"], own[-1]["shown"])]
            found += [(r["player"], r["page"], r["bytes"], r["shown"]) for r in row["others"] if r["rate"] == rate]
            cells += [
                (row["name"], f"{rate / 1e6:g}", player, f"{page:,}", f"{size:,}", f"{8 * (page + size) / rate:.2f}")
                + (f"{shown:.2f}",)
                for player, page, size, shown in found
            ]
    said = (
        "**Beside other players**, seconds from navigation to a picture as above. They show one instant of the scene, "
        f"exported with {STEPS} steps of refinement: Spark 2.2 with three.js 0.180 an SPZ file with harmonics of "
        "degree 3, PlayCanvas 2.23 an SOG file without any; both at their defaults. Their picture counts as there when "
        "a hundredth of its pixels is no longer background. Page: bytes of the page and its scripts, gzipped. Network: "
        "all these bytes at the rate."
    )
    head = ("scene", "Mbps", "player", "page", "scene's bytes", "network", "picture")
    return _block(said, head, cells) if cells else ""


def _rates(rows: Sequence[Row]) -> str:
    cells = [
        (
            row["name"],
            str(r["level"]),
            f"{r['width']:.0f} × {r['height']:.0f}",
            f"{r['gaussians']:,}",
            f"{r['moving']:.1f}",
            f"{r['playing']:.1f}" if r["playing"] else "-",
        )
        for row in rows
        for r in row["rates"]
    ]
    said = (
        "**Pictures per second** as `?bench` measures them, without the steps that make a slow machine faster. Moving: "
        "the camera turns. Playing: time moves."
    )
    return _block(said, ("scene", "level", "size", "Gaussians", "moving", "playing"), cells)


def _decoding(rows: Sequence[Row]) -> str:
    cells = [
        (
            r["file"],
            f"{r['anchors']:,}",
            f"{r['bytes']:,}",
            f"{r['node_cpu_s']:.3f}",
            f"{r['python_cpu_s']:.3f}",
            f"{r['cpu_ratio']:.2f}",
        )
        for row in rows
        for r in row["decoding"]
    ]
    said = (
        f"**Decoding**, seconds of processor time, median of {rows[-1]['runs']} in turn, warm. The large file "
        "is made of copies of the scene's anchors."
    )
    return _block(said, ("file", "anchors", "bytes", "Node", "Python", "Node/Python"), cells)


def _before(rows: Sequence[Row]) -> str:
    """The same beside another commit's package, where it was measured."""
    cells = [
        (r["file"], f"{r['anchors']:,}")
        + tuple(f"{r[key]:.3f}" for key in ("node_cpu_s", "python_cpu_s", "before_cpu_s"))
        + tuple(f"{r[key]:.2f}" for key in ("cpu_ratio", "before_ratio"))
        for row in rows
        for r in row.get("before", [])
    ]
    said = (
        "**Decoding, beside commit 9275c5f**, measured likewise. Each commit packed the same checkpoint, as it is and "
        "with copies of its anchors; Node decodes this commit's file."
    )
    head = ("file", "anchors", "Node", "Python", "Python before", "Node/Python", "Node/Python before")
    return _block(said, head, cells) if cells else ""


PAGE = Page("player", "player_page.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, NAMES)
    parser.add_argument("--runs", type=int, default=9, metavar="N", help="runs that medians are taken of (default: 9)")
    parser.add_argument("--others", type=Path, metavar="FOLDER", help="a node_modules with other players")
    parser.add_argument("--before", type=Path, metavar="FOLDER", help="a checkout of another commit")
    args = parser.parse_args(argv)
    configure()
    todo = [name for name in NAMES if not args.only or name in args.only]
    return make(PAGE, NAMES, [] if args.render else todo, args, lambda name: measure(name, args))


if __name__ == "__main__":
    sys.exit(main())
