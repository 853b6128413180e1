"""Seconds to the first pictures: over a paced link, slice by slice, and in a browser.

    python benchmarks/delivery.py PACKAGE -o out/paint

visits the page of a package over slow links: bytes and seconds on the terminal, screenshots in the folder.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import io
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from browser import ELEMENT, TIMEOUT_MS, launched, until
from common import ONE, TWO, Benchmark, Row, Run, Scene, command, levels, number, package, seconds_at, table
from PIL import Image

from pd4dgs_codec.bench.latency import python
from pd4dgs_codec.bench.report import drawing
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.quality.image import mpsnr

# -- latency -----------------------------------------------------------------------------------------------------------


def measure_latency(run: Run, scene: Scene) -> list[Row]:
    """What `pd4dgs-bench latency` measures: a row per rate and level."""
    options = ("--rates", "50M", "--runs", "1") if run.quick else ("--rates", "2M,10M", "--runs", "3")
    (found,) = command("bench", "latency", run.packed(scene), *options)["files"]
    first = {"scene": scene.name, "first_start": found["first_start"]}
    return [first | row for row in found["times"]]


def latency_text(rows: Sequence[Row]) -> str:
    """A row per scene, rate and level."""
    cells = [
        (r["scene"], f"{r['rate'] / 1e6:g}", r["level"], number(r["bytes"], 0), number(r["expected"], 3))
        + tuple(number(r[key], 3) for key in ("network", "picture", "after_last_byte", "cold"))
        for r in rows
    ]
    head = ("scene", "Mbps", "level", "bytes S", "8S/B", "last byte", "picture", "after the last byte", "cold process")
    return (
        "Median seconds from the request over `pd4dgs-serve --rate` to the last byte of the level, to its picture "
        "drawn on the CPU, and to its picture in a process that starts with the request (`pd4dgs-bench latency`). With "
        f"empty kernel caches the first picture takes {rows[0]['first_start']:.1f} s."
        f"\n\n{table(head, cells)}"
    )


# -- slices ------------------------------------------------------------------------------------------------------------


#: (bytes of a prefix, held-out mPSNR in dB).
Point = tuple[int, float]


def measure_slices(run: Run, scene: Scene) -> list[Row]:
    """A row per slice of a file in slices, with the quality of the prefix that ends with it. whole: the same of every
    layer of a file with one slice each."""
    size = "60k" if run.quick else "50k"
    whole = [(row["bytes"], row["mpsnr"]) for row in levels(scene, run.packed(scene))]
    file = run.packed(scene, "--slices", size, *scene.data, name="slices")
    rows = []
    for layer in command("info", file)["layers"]:
        for part in layer["slices"]:
            prefix = file.with_name("prefix.pt")
            command("decode", file, "-o", prefix, "-f", "--max-bytes", part["end"])
            best = levels(scene, prefix)[-1]
            rows.append({"scene": scene.name, "layer": layer["layer"], "mpsnr": best["mpsnr"], "bytes": part["end"]})
    return [row | {"whole": whole} for row in rows]


def share_of_bytes(slices: Sequence[Point], whole: Sequence[Point]) -> float:
    """The median, over the qualities between the first prefix and the whole file, of the bytes that `slices` take to a
    quality as a share of those that whole layers take."""
    least, most = slices[0][1], min(slices[-1][1], whole[-1][1])
    qualities = [least + (most - least) * i / 100 for i in range(1, 100)]
    reached = [[next(size for size, found in curve if found >= q) for curve in (slices, whole)] for q in qualities]
    return median(own / other for own, other in reached)


def slices_text(rows: Sequence[Row]) -> str:
    """One row per scene: what the first slices show beside whole layers, and what slices cost."""
    cells = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        points, whole = [(row["bytes"], row["mpsnr"]) for row in own], own[0]["whole"]
        moving = [point for point, row in zip(points, own, strict=True) if row["layer"]]
        fall = max((a - b for (_, a), (_, b) in pairwise(points)), default=0.0)
        shown = [whole[0], *moving[:1], points[-1]]
        texts = [f"{number(quality)} in {size:,}" for size, quality in shown]
        cells.append(
            (scene, len(own), number(points[0][0], 0), seconds_at(points[0][0]), number(points[0][1]), texts[0])
            + (texts[1] if moving else "-", texts[-1], f"{points[-1][0] / whole[-1][0] - 1:+.1%}")
            + (number(max(fall, 0.0), 3), number(share_of_bytes(points, whole)))
        )
    head = ("scene", "slices", "first slice", "s at 2 Mbps", "mPSNR dB", "layer 0 whole", "first with motion")
    more = ("whole file", "cost", "largest drop dB", "share")
    return (
        "`pd4dgs-encode --slices 50k --data SOURCE`: the quality of every prefix on held-out views. *layer 0 whole* "
        "and *cost* compare with a file of one slice per layer. *share*: bytes to reach a quality, as a share of the "
        "bytes in that file; median over all qualities above that of the first slice.\n\n"
        f"{table((*head, *more), cells)}"
    )


def slices_pictures(rows: Sequence[Row], folder: Path) -> list[str]:
    """Quality over bytes, of two scenes, beside that of whole layers."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))[: len(TWO)]
    with drawing(folder / "slices.png", scenes, "held-out mPSNR, dB", (4.6, 3.4), legend=True) as axes:
        for axis, scene in zip(axes, scenes, strict=True):
            own = [row for row in rows if row["scene"] == scene]
            points = [(row["bytes"], row["mpsnr"]) for row in own]
            curves = (own[0]["whole"], "-s", "tab:blue", "layers"), (points, "-o", "black", "slices")
            for curve, style, colour, name in curves:
                sizes, qualities = zip(*((size / 1e3, quality) for size, quality in curve), strict=True)
                axis.step(sizes, qualities, style, color=colour, mfc="white", where="post", label=name)
            axis.set_xlabel("kB")
    return ["slices.png"]


# -- player ------------------------------------------------------------------------------------------------------------

RATES, ROUND_TRIP = (2e6, 10e6), "50ms"
SIZES = "320x240,640x480"
#: What a page notes of each picture: its level, and seconds since the navigation began.
NOTE = """window.noted = [];
  for (const name of ["firstpicture", "upgrade"]) {
    document.addEventListener(name, (event) => {
      noted.push({ level: event.detail.level, shown: performance.now() / 1000 });
    }, true);
  }"""


@contextmanager
def served(folder: Path, *options: str) -> Iterator[str]:
    """The URL of a folder served by `pd4dgs-serve`. Raises DataError if it does not start."""
    with python("-m", "pd4dgs_codec", "serve", str(folder), "--port", "0", *options) as lines:
        url = lines.readline().strip()
        if not url:
            raise DataError("pd4dgs-serve did not start")
        yield url


def measure_player(run: Run, scene: Scene) -> list[Row]:
    """Rows of first pictures per rate and level, and of frame rates per level and size."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name, launched() as browser:
        folder = Path(name) / "package"
        command("package", run.packed(scene), "-o", folder, "--no-video")
        ends = {row["layer"]: row["end"] for row in command("info", run.packed(scene))["layers"]}
        for rate in RATES:
            with served(folder, "--rate", repr(rate), "--latency", ROUND_TRIP) as url:
                visits = [first_pictures(browser, url, max(ends)) for _ in range(1 if run.quick else 3)]
            for level, end in ends.items():
                shown = median(next(n["shown"] for n in noted if n["level"] >= level) for noted in visits)
                rows.append({"what": "picture", "rate": rate, "level": level, "bytes": end, "shown": shown})
        with served(folder) as url:
            page = opened(browser)
            page.goto(f"{url}?bench&sizes={SIZES}")
            until(page, "!!window.benchResult", 5 * TIMEOUT_MS)
            rows += [{"what": "rate"} | row for row in page.evaluate("benchResult.rows")]
            page.context.close()
        version = f"Chromium {browser.version.split('.')[0]}"
    return [{"scene": scene.name, "browser": version} | row for row in rows]


def opened(browser: Any) -> Any:
    """A page with nothing in its caches."""
    context = browser.new_context(viewport={"width": 480, "height": 360})
    context.set_default_timeout(TIMEOUT_MS)
    return context.new_page()


def first_pictures(browser: Any, url: str, last: int) -> list[Row]:
    """What a visit notes until level `last` is shown."""
    page = opened(browser)
    page.add_init_script(NOTE)
    page.goto(f"{url}?autoplay=0")
    until(page, f"noted.some(({{ level }}) => level === {last})")
    noted: list[Row] = page.evaluate("noted")
    page.context.close()
    return noted


def player_text(rows: Sequence[Row]) -> str:
    """Both tables."""
    shown = [
        (r["scene"], f"{r['rate'] / 1e6:g}", r["level"], number(r["bytes"], 0), seconds_at(r["bytes"], r["rate"]))
        + (number(r["shown"]),)
        for r in rows
        if r["what"] == "picture"
    ]
    rates = [
        (r["scene"], r["level"], f"{r['width']:.0f} x {r['height']:.0f}", number(r["gaussians"], 0))
        + (number(r["moving"], 1), number(r["playing"] or None, 1))
        for r in rows
        if r["what"] == "rate"
    ]
    return (
        f"{rows[0]['browser']} with software rendering on two cores. Seconds from navigation to the final picture of "
        f"a level, cold cache, round trip {ROUND_TRIP}; page and player arrive over the same link.\n\n"
        f"{table(('scene', 'Mbps', 'level', 'bytes', '8S/B', 'picture'), shown)}\n\n"
        "Pictures per second (`?bench`) with a moving camera and in playback:\n\n"
        f"{table(('scene', 'level', 'size', 'Gaussians', 'moving', 'playing'), rates)}"
    )


# -- a page over slow links --------------------------------------------------------------------------------------------

SLOW, SHOTS = (2e5, 2e6), (0.3, 1.0, 3.0)  #: bits per second; seconds after the navigation began
PAINTED = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime / 1000"


def measure_paint(folder: Path, out: Path, visits: int = 5) -> list[Row]:
    """A row per rate: seconds, median and least of the visits, to the first paint and the first rendered picture of the
    package's page; and (seconds, dB against the settled page) of what it shows meanwhile. Writes the screenshots
    RATE-SECONDS.png, and RATE-end.png of the settled page, to `out`."""
    rows, out_names = [], {rate: f"{rate / 1e3:g}k" for rate in SLOW}
    out.mkdir(parents=True, exist_ok=True)
    page_bytes = (folder / "index.html").read_bytes()
    sizes = {"plain": len(page_bytes), "gzip": len(gzip.compress(page_bytes, 9, mtime=0))}
    with launched() as browser:
        for rate in SLOW:
            with served(folder, "--rate", repr(rate), "--latency", ROUND_TRIP) as url:
                seen = []
                for _ in range(visits):
                    page = opened(browser)
                    page.add_init_script(NOTE)
                    page.goto(f"{url}?autoplay=0", wait_until="commit")
                    until(page, "noted.length")
                    seen.append((page.evaluate(PAINTED), page.evaluate("noted[0].shown")))
                    page.context.close()
                painted, drawn = ((median(times), min(times)) for times in zip(*seen, strict=True))
                rows.append({"rate": rate, **sizes, "painted": painted, "drawn": drawn, "film": film(browser, url)})
                page = opened(browser)
                camera = page.context.new_cdp_session(page)
                page.goto(f"{url}?autoplay=0", wait_until="commit")
                start = page.evaluate("performance.timeOrigin / 1000")
                for seconds in SHOTS:
                    time.sleep(max(0.0, start + seconds - time.time()))
                    shot = base64.b64decode(camera.send("Page.captureScreenshot")["data"])
                    (out / f"{out_names[rate]}-{seconds:g}s.png").write_bytes(shot)
                until(page, f"{ELEMENT}?.player?.status.level >= 0")
                page.evaluate(f"{ELEMENT}.player.settled()")
                page.screenshot(path=out / f"{out_names[rate]}-end.png")
                page.context.close()
    return rows


def film(browser: Any, url: str) -> list[tuple[float, float]]:
    """(seconds since the navigation began, dB against the settled page) of screenshots of a page, one after the other;
    one that is the settled page has infinitely many."""
    page = opened(browser)
    camera, shots = page.context.new_cdp_session(page), list[tuple[float, bytes]]()

    def shoot() -> None:
        shot = base64.b64decode(camera.send("Page.captureScreenshot")["data"])
        shots.append((page.evaluate("performance.now() / 1000"), shot))

    page.goto(f"{url}?autoplay=0&controls=0", wait_until="commit")
    while not page.evaluate(f"{ELEMENT}?.player?._isSettled() && {ELEMENT}.player.scene.layers.length > 1"):
        shoot()
    time.sleep(0.5)  # until nothing fades
    shoot()
    page.context.close()
    pictures = [np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")) for _, shot in shots]
    return [(seconds, mpsnr(shown, pictures[-1])) for (seconds, _), shown in zip(shots, pictures, strict=True)]


def paint_text(rows: Sequence[Row]) -> str:
    """A row per rate."""
    cells = [
        (f"{r['rate'] / 1e6:g}", number(r["plain"], 0), number(r["gzip"], 0))
        + tuple(f"{middle:.2f} ({least:.2f})" for middle, least in (r["painted"], r["drawn"]))
        for r in rows
    ]
    head = ("Mbps", "bytes of the page", "gzip", "first paint s (least)", "first picture s (least)")
    text = table(head, cells)
    for r in rows:
        seen = [(s, dB) for s, dB in r["film"] if s >= r["painted"][0]]
        fall = max((a - b for (_, a), (_, b) in pairwise(seen) if a != b), default=0.0)
        curve = ", ".join(f"{dB:.1f} at {s:.1f} s" for s, dB in seen)
        text += f"\n\n{r['rate'] / 1e6:g} Mbps: largest fall {max(fall, 0):.1f} dB; dB against the end: {curve}"
    return text


LATENCY = Benchmark("latency", "First picture", ONE, measure_latency, latency_text, measured=package("delivery"))
#: Whose layer 0 is larger than a slice.
SLICED = (*TWO, "orbit", "static", "global", "local", "fast")
SLICES = Benchmark("slices", "Slices", SLICED, measure_slices, slices_text, slices_pictures)
PLAYER = Benchmark(
    "player",
    "The player in a browser",
    ONE,
    measure_player,
    player_text,
    measured=(*package("delivery"), "player", ":!player/test*", ":!*.md"),
)


def main() -> None:
    """The page of the package that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path, help="folder by pd4dgs-package")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the screenshots")
    args = parser.parse_args()
    print(paint_text(measure_paint(args.package, args.output)))


if __name__ == "__main__":
    main()
