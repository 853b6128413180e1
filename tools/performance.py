"""How long encoding, decoding and drawing take, before and after. Writes docs/performance.md.

    python tools/performance.py --before FOLDER [--own FOLDER] [--only NAME ...] [--repeats 9] [--lines WHAT ...]
                                [--out out] [--docs docs] [--render]

FOLDER is a checkout of another commit of this project, measured by turns with this one: one process of each, then the
next pair (of encodings and first steps a ninth as many, of steps a third). Each checkpoint in --out/NAME/model.pt that
both can read is one scene; its data must be there for the lines on training. Figures are medians over the repeats; the
page states the processors and the load. Of this checkout alone: what --own holds, checkpoints of today, as users have
them; and on the first scene how cost grows, and what other coders take for the same symbols. Two scenes and nine
repeats take some ten minutes on two idle processors. --lines measures some lines anew and keeps the others. The line
`race` trains the real scenes with both at once, a thread each, in --out/NAME/race, which takes a quarter of an hour; it
is measured only where it is asked for.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pages.child import printed
from pages.page import ROOT, Page, Row, commit, make, options, paragraph, say
from pages.race import race, race_plot, race_table
from pages.scenes import SCENES

from pd4dgs_codec.bench.report import drawing, markdown
from pd4dgs_codec.bench.timing import machine, machine_line

NAMES = ("shelf-hand", "bouncing-balls", "synthetic-local")
EFFORTS = (1, 3, 5, 7, 9)
#: Anchors of the scenes that show how cost grows.
ANCHORS = (10_000, 100_000, 300_000, 1_000_000)
#: Runs in either checkout, so it keeps to what both have. argv: what to measure, a checkpoint, a file, options.
PROGRAM = Path(__file__).parent / "pages" / "stopwatch.py"
#: Of both checkouts, kept as that of an installed package is: else commands compile their modules anew each time.
BYTECODE = tempfile.TemporaryDirectory(prefix="pd4dgs-bytecode-")


def run(checkout: Path, what: str, *arguments: str) -> Row:
    """What the stopwatch prints, measured with the package of `checkout` in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"PYTHONPATH": str(checkout), "PYTHONPYCACHEPREFIX": BYTECODE.name}
    environment |= {"OMP_NUM_THREADS": "1"} if what == "step" else {}
    line = [str(PROGRAM), what, *arguments]
    return printed(f"{what} of {checkout}", line, environment=environment, folder=checkout)


@dataclass(frozen=True)
class Turns:
    """Checkouts that are measured by turns with one checkpoint, and the file that each made of it, since each reads its
    own draft."""

    checkpoint: Path
    checkouts: dict[str, Path]
    files: dict[str, str]

    @classmethod
    def of(cls, checkpoint: Path, checkouts: dict[str, Path], folder: Path) -> Turns:
        """Encodes into `folder` and draws once, so that caches are warm."""
        files = {name: str(folder / f"{name}.pd4") for name in checkouts}
        for name, checkout in checkouts.items():
            for what in ("encode", "start"):
                run(checkout, what, str(checkpoint), files[name], "5")
        return cls(checkpoint, checkouts, files)

    def line(self, what: str, repeats: int) -> Row:
        """The medians of one line of the page, by checkout."""
        found: dict[str, list[Row]] = {name: [] for name in self.checkouts}
        for _ in range(-(-repeats // SLOW.get(what, 1))):
            for name, checkout in self.checkouts.items():
                found[name].append(run(checkout, what, str(self.checkpoint), self.files[name], "5"))
        medians = {name: _medians(rows) for name, rows in found.items()}
        say(f"{self.checkpoint.parent.name}: {what} {medians}")
        return medians


def measure_again(
    row: Row, path: Path, both: dict[str, Path], repeats: int, own: Path | None, lines: Sequence[str]
) -> Row:
    """The row with some of its lines as they are now."""
    timed = [what for what in lines if what in LINES]
    found = {}
    if timed:
        with tempfile.TemporaryDirectory() as folder:
            turns = Turns.of(path, both, Path(folder))
            found = {what: turns.line(what, repeats) for what in timed}
    parts: Row = {}
    scene = SCENES[path.parent.name]
    if RACE in lines and scene.there and not scene.source.startswith("synthetic:"):
        parts[RACE] = race(scene, both, path.parent / "race")
    if OWN in lines:
        parts |= measure_own(own, repeats)
    if GROWTH in lines:
        parts |= measure_growth(path)
    later = row.get("later", {}) | dict.fromkeys([*found, *(what for what in parts if what in HEADS)], commit())
    return row | {"lines": row["lines"] | found, "later": later} | parts


def measure_own(own: Path | None, repeats: int) -> Row:
    """What users of this commit's checkpoint `own` wait for, if it is there, and where that time goes."""
    if own is None or not own.is_file():
        return {}
    with tempfile.TemporaryDirectory() as folder:
        turns = Turns.of(own, {"after": ROOT}, Path(folder))
        return {OWN: {what: turns.line(what, repeats) for what in USED}, "parts": turns.line("parts", repeats)["after"]}


def measure_growth(path: Path) -> Row:
    """How cost grows with the number of anchors, of the first scene."""
    if path.parent.name != NAMES[0]:
        return {}
    say("growth")
    with tempfile.TemporaryDirectory() as folder:
        grown = str(Path(folder) / "grown.pd4")
        return {GROWTH: [run(ROOT, "grow", str(path), grown, str(anchors)) for anchors in ANCHORS]}


def measure(path: Path, both: dict[str, Path], repeats: int, own: Path | None) -> Row:
    """Of one checkpoint: per line of the page the medians before and after, and what every effort takes; of the
    checkpoint `own`, if it is there, what its user waits for."""
    with tempfile.TemporaryDirectory() as folder:
        turns = Turns.of(path, both, Path(folder))
        lines = {what: turns.line(what, repeats) for what in LINES}
        file, efforts = turns.files["after"], list[Row]()
        for effort in EFFORTS:
            efforts.append({"effort": effort, **run(ROOT, "encode", str(path), file, str(effort))})
        alone: Row = {}
        if path.parent.name == NAMES[0]:
            say("other coders")
            alone["beside"] = run(ROOT, "beside", str(path), file, "5")
    alone |= measure_growth(path) | measure_own(own, repeats)
    return {"lines": lines, "efforts": efforts, **alone, "machine": machine_line(machine())}


def _medians(rows: Sequence[Row]) -> Row:
    return {key: statistics.median(row[key] for row in rows) for key in rows[0]}


#: What a line says, by what was measured: (text, key, factor, decimals).
LINES = {
    "encode": (
        ("encode in process, default effort, s", "wall", 1, 2),
        ("the same, processor s", "cpu", 1, 2),
        ("its memory beside the loaded scene, MiB", "memory", 1, 0),
    ),
    "decode": (
        ("decode in process, ms", "wall", 1e3, 0),
        ("the same, processor ms", "cpu", 1e3, 0),
        ("million symbols per processor second", "rate", 1e-6, 1),
    ),
    "command": (("pd4dgs-decode, s", "wall", 1, 2), ("the same, processor s", "cpu", 1, 2)),
    "draw": (("picture of the top level, 480 x 360, ms", "wall", 1e3, 1), ("the same, processor ms", "cpu", 1e3, 1)),
    "start": (("pd4dgs-render, start to picture, s", "wall", 1, 2), ("the same, processor s", "cpu", 1, 2)),
    "first": (("pd4dgs-train, one step with its data, s", "wall", 1, 2), ("the same, processor s", "cpu", 1, 2)),
    "steps": tuple((f"training step at level {n}, all threads, ms", f"level {n}", 1e3, 1) for n in range(3)),
    "step": tuple((f"training step at level {n}, one thread, processor ms", f"level {n}", 1e3, 1) for n in range(3)),
}
#: Repeats that one process of these takes the place of.
SLOW = {"encode": 9, "first": 9, "parts": 9, "steps": 3, "step": 3}
#: What a user of a file waits for.
USED = ("encode", "decode", "command", "draw", "start")
RACE, OWN, GROWTH = "race", "own", "growth"
#: How a table that may be measured by itself begins, by what is measured.
HEADS = {what: texts[0][0] for what, texts in LINES.items()} | {
    RACE: "both trainers at once",
    OWN: "today's own models",
    GROWTH: "growth",
}
#: Lines whose figures are better when they are larger.
RATES = ("rate",)


def render(rows: Sequence[Row]) -> str:
    """One table of ratios, one of efforts."""
    table = []
    for row in rows:
        for text, key, figures, (old, new) in _lines(row["lines"]):
            table.append((row["name"], text, *figures, f"{new / old if key in RATES else old / new:.1f}"))
        old, new = (row["lines"]["encode"][name]["bytes"] for name in ("before", "after"))
        table.append((row["name"], "bytes at the default effort", f"{old:,.0f}", f"{new:,.0f}", f"{old / new:.4f}"))
    efforts = [
        (row["name"], str(effort["effort"]), f"{effort['wall']:.2f}", f"{effort['cpu']:.2f}", f"{effort['bytes']:,}")
        for row in rows
        for effort in row["efforts"]
    ]
    later = sorted({(sha, HEADS[what]) for row in rows for what, sha in row.get("later", {}).items()})
    newer = "; ".join(f'"{text}" and what follows it: `{sha}`' for sha, text in later)
    parts = [
        "\n".join(sorted({row["machine"] for row in rows})),
        markdown(("scene", "what", "before", "after", "times"), table),
        *(["\n".join(paragraph(f"Measured at another commit: {newer}."))] if newer else []),
        *_own([row for row in rows if OWN in row]),
        *_parts([row for row in rows if "parts" in row]),
        "What each effort takes, all with warm caches and verified:",
        markdown(("scene", "effort", "s", "processor s", "bytes"), efforts),
    ]
    for row in rows:
        parts += [*_growth(row), *_beside(row)]
    if raced := [row for row in rows if RACE in row]:
        text = (
            "Both trainers at once, a thread each: held-out dB at levels 0 / 1 / 2 at the same wall time, as training "
            "draws a few held-out views, before anything is packed. Less is rounded before; what ends there is larger "
            "([levers](levers.md))."
        )
        parts += ["\n".join(paragraph(text)), *race_table(raced), "![dB against time](img/race.png)"]
    return "\n\n".join(parts)


def _lines(found: Row) -> Iterator[tuple[str, str, list[str], list[float]]]:
    """What each line says of what was measured: (text, key, what it shows and what was found by checkout)."""
    for what in [what for what in LINES if what in found]:
        sides = found[what].values()
        for text, key, factor, decimals in LINES[what]:
            if all(key in side for side in sides):  # else a model of fewer levels
                yield (
                    text,
                    key,
                    [f"{side[key] * factor:,.{decimals}f}" for side in sides],
                    [side[key] for side in sides],
                )


def _own(rows: Sequence[Row]) -> list[str]:
    """What a user of files of this commit waits for: a column per scene."""
    if not rows:
        return []
    columns = [[figures[0] for _, _, figures, _ in _lines(row[OWN])] for row in rows]
    texts = [text for text, *_ in _lines(rows[0][OWN])]
    sizes = [f"{row[OWN]['encode']['after']['bytes']:,.0f}" for row in rows]
    head = ("what", *(row["name"] for row in rows))
    return ["Today's own models:", markdown(head, [("bytes", *sizes), *zip(texts, *columns, strict=True)])]


def _parts(rows: Sequence[Row]) -> list[str]:
    """Where the time of what users wait for goes: a column per scene."""
    if not rows:
        return []
    found = [row["parts"] for row in rows]
    most = {name: max(parts.get(name, 0.0) for parts in found) for parts in found for name in parts}
    names = sorted(most, key=lambda name: (name.split(": ")[0], -most[name]))
    table = [(name, *(f"{1e3 * parts[name]:.1f}" if name in parts else "" for parts in found)) for name in names]
    text = "Where the time of these goes, in process, processor ms:"
    return [text, markdown(("part", *(row["name"] for row in rows)), table)]


def growth_plot(row: Row, path: Path) -> None:
    """Panels of time and memory over the number of anchors, both axes logarithmic."""
    from matplotlib.ticker import LogLocator

    anchors = [found["anchors"] for found in row[GROWTH]]
    panels = (("encode", "encode, processor s"), ("decode", "decode, processor s"), ("memory", "encoder's memory, MiB"))
    with drawing(path, [title for _, title in panels], "", (3.6, 3.0)) as axes:
        for axis, (key, _) in zip(axes, panels, strict=True):
            axis.loglog(anchors, [found[key] for found in row[GROWTH]], "o-", color="black", lw=1, ms=4)
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter("")
            axis.set_xlabel("anchors")


def _growth(row: Row) -> list[str]:
    """How cost grows with the number of anchors, if it was measured of this scene."""
    if GROWTH not in row:
        return []
    table = [
        (
            f"{found['anchors']:,}",
            *(f"{found[key]:.2f}" for key in ("encode", "decode")),
            f"{found['bytes'] / found['anchors']:.1f}",
            *(f"{found[key]:,.0f}" for key in ("arrays", "memory")),
        )
        for found in row[GROWTH]
    ]
    text = (
        f"Growth: {row['name']} and copies of its anchors some voxels off, with noise of two steps, at the default "
        "effort. Processor seconds in process; memory is that of the scene's arrays and of encoding."
    )
    heads = ("anchors", "encode, s", "decode, s", "bytes per anchor", "float32 arrays, MiB", "encoder's memory, MiB")
    return ["\n".join(paragraph(text)), markdown(heads, table), "![time and memory against anchors](img/growth.png)"]


def _beside(row: Row) -> list[str]:
    """What other coders take for the same symbols, if it was measured of this scene."""
    if "beside" not in row:
        return []
    found = row["beside"]
    count = f"{found['symbols']:,.0f} attributes of layer 0"
    table = [
        (count, "constriction, QuantizedGaussian per channel", found["gaussian bytes"], found["gaussian decode"]),
        (count, "this codec", found["own bytes"], found["own decode"]),
        ("the whole file", "LZMA (`--mode lzma`)", found["xz file"], found["xz decode"]),
        ("the whole file", "this codec", found["own file"], found["own file decode"]),
    ]
    rows = [(what, how, f"{size:,.0f}", f"{1e3 * seconds:.0f}") for what, how, size, seconds in table]
    text = f"Other coders on the same symbols, {row['name']}:"
    return [text, markdown(("symbols", "coder", "bytes", "decode, processor ms"), rows)]


PAGE = Page("performance", "performance.py", render)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, NAMES)
    parser.add_argument("--before", type=Path, metavar="FOLDER", help="a checkout to compare with")
    parser.add_argument("--lines", nargs="+", choices=tuple(HEADS), metavar="WHAT", help="these alone, of scenes there")
    parser.add_argument("--repeats", type=int, default=9, metavar="N", help="of each measurement (default: 9)")
    parser.add_argument("--own", type=Path, metavar="FOLDER", help="checkpoints of this commit, FOLDER/NAME/model.pt")
    args = parser.parse_args(argv)
    if not args.render and (args.before is None or not (args.before / "pd4dgs_codec").is_dir()):
        parser.error("--before FOLDER: expected a checkout of this project")
    todo = [n for n in args.only or NAMES if (args.out / n / "model.pt").is_file()]  # needs no data
    there = {row["name"]: row for row in PAGE.read(args.docs)}
    todo = [name for name in todo if not args.lines or name in there]

    def measured(name: str) -> Row:
        both = {"before": args.before.resolve(), "after": ROOT}
        own = args.own / name / "model.pt" if args.own else None
        given = args.out / name / "model.pt", both, args.repeats, own
        if args.lines:
            return measure_again(there[name], *given, args.lines)
        old = there.get(name, {})
        raced = {RACE: old[RACE], "later": {RACE: old["later"][RACE]}} if RACE in old else {}
        return measure(*given) | raced

    def finish(rows: list[Row]) -> None:
        if raced := [row for row in rows if RACE in row]:
            race_plot(raced, args.docs / "img" / "race.png")
        for row in rows:
            if GROWTH in row:
                growth_plot(row, args.docs / "img" / "growth.png")

    return make(PAGE, NAMES, todo, args, measured, finish)


if __name__ == "__main__":
    sys.exit(main())
