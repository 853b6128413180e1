"""Measures what the README's table shows; writes it there and, with coding, plot and pictures, into docs/results.md.

    python tools/results.py [--only NAME ...] [--out out] [--docs docs]

Finished trainings in --out are kept, so a stopped run goes on where it was. Real scenes are read from the folder in
PD4DGS_SHARED (default ../shared/data beside the repository); those not there are named and left out. With
--only, docs/results.md holds those scenes alone, and the README stays.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from pd4dgs_codec.render.threads import configure

SHARED = Path(os.environ.get("PD4DGS_SHARED", Path(__file__).resolve().parents[2] / "shared" / "data"))
#: name, source, downscale, preset, iterations, time limit in seconds
SCENES = (
    ("shelf-hand", SHARED / "shelf-hand", 2, "small", 5_000, 600.0),
    ("bouncing-balls", SHARED / "bouncing-balls", 4, "small", 7_000, 600.0),
    ("synthetic-static", "synthetic:static", 1, "small", 1_500, 600.0),
    ("synthetic-global", "synthetic:global", 1, "small", 1_500, 600.0),
    ("synthetic-local", "synthetic:local", 1, "small", 1_500, 600.0),
    ("synthetic-fast", "synthetic:fast", 1, "small", 1_500, 600.0),
    ("shelf-hand-paper", SHARED / "shelf-hand", 2, "paper", 4_600, 1_500.0),
)
#: Bytes per layer that the PD-4DGS paper publishes (average over the seven Dycheck iPhone scenes).
PUBLISHED = (436_000, 1_187_000, 5_275_000)
#: The table of README.md stands between these lines.
MARKERS = ("<!-- results: written by tools/results.py -->", "<!-- end of results -->")


def say(line: str) -> None:
    """Prints a stage as it begins."""
    print(line, flush=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[row[0] for row in SCENES])
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    args = parser.parse_args(argv)
    threads = configure()

    from pages.main_job import Job, run_job

    from pd4dgs_codec.cli.progress import TrainingProgress
    from pd4dgs_codec.errors import Pd4Error
    from pd4dgs_codec.train.config import TrainConfig

    results = []
    for name, source, downscale, preset, iterations, seconds in SCENES:
        if args.only and name not in args.only:
            continue
        if isinstance(source, Path) and not source.is_dir():
            print(f"{name}: {source} is not there, left out")
            continue
        try:
            config = TrainConfig(
                preset=preset, source=str(source), downscale=downscale, iterations=iterations, max_seconds=seconds
            )
            results.append(run_job(Job(name, config), args.out, say=say, progress=TrainingProgress()))
        except (Pd4Error, OSError, KeyboardInterrupt) as error:
            print(f"results: error: {name}: {str(error) or 'interrupted'}", file=sys.stderr)
            return 1
    if not results:
        print(f"results: error: none of the scenes is there; expected them in {SHARED}", file=sys.stderr)
        return 1
    write(results, args.out, args.docs, threads)
    return 0


def write(results: list[dict[str, Any]], out: Path, docs: Path, threads: int) -> None:
    """docs/results.md with its tables, docs/results.json, docs/img/*."""
    from pages.tables import coding_table, quality_table, time_plot

    from pd4dgs_codec.bench.markdown import markdown

    images = docs / "img"
    images.mkdir(parents=True, exist_ok=True)
    time_plot(results, images / "quality-over-time.png")
    for result in results:
        shutil.copy(out / result["name"] / "levels.png", images / f"{result['name']}.png")
    count = "one thread" if threads == 1 else f"{threads} threads"
    lines = [
        "# Results",
        "",
        f"Made by `python tools/results.py` on {count} of a shared machine; times are single runs, sizes and",
        "qualities repeat. Quality is that of the `.pd4` prefix whose bytes stand in the same row, on held-out views.",
        "",
        quality_table(results),
        "",
        "![held-out PSNR against training wall time](img/quality-over-time.png)",
        "",
        "## Coding",
        "",
        coding_table(results),
        "",
    ]
    paper = [r for r in results if r["preset"] == "paper"]
    if paper:
        lines += ["## The paper's plane sizes", "", *_paper_lines(paper[0], markdown)]
    for result in results:
        lines += [f"## {result['name']}", "", f"![truth and levels](img/{result['name']}.png)", ""]
        lines += [f"- left out: {row['what']} ({row['bytes']:,} bytes): {row['why']}" for row in result["left_out"]]
        skipped = f"{result['skipped_steps']} skipped steps"
        steps = f"{result['iterations']} of {result['total']} iterations"
        lines += [f"- {steps}, rho {result['rho']:.3f}, {skipped}"]
        if result["phases_not_reached"]:
            lines += [f"- cut by its time limit before: {', '.join(result['phases_not_reached'])}"]
        lines += [""]
    (docs / "results.md").write_text("\n".join(lines))
    if len(results) == len(SCENES):  # a partial run must not replace the whole table
        _fill_readme(docs.parent / "README.md", quality_table(results))
    slim = [{k: v for k, v in r.items() if k != "source"} for r in results]
    (docs / "results.json").write_text(json.dumps(slim, indent=1) + "\n")


def _fill_readme(readme: Path, table: str) -> None:
    """Puts the table between the README's two result markers, if it is there and has them."""
    text = readme.read_text() if readme.is_file() else ""
    if not all(text.count(marker) == 1 for marker in MARKERS):
        say(f"{readme}: no README with result markers is there, table not written into it")
        return
    before, rest = text.split(MARKERS[0])
    after = rest.split(MARKERS[1])[1]
    readme.write_text(f"{before}{MARKERS[0]}\n\n{table}\n\n{MARKERS[1]}{after}")


def _paper_lines(result: dict[str, Any], markdown: Any) -> list[str]:
    rows = [
        (str(row["layer"]), f"{row['ans_bytes']:,}", f"{published:,}", f"{published / row['ans_bytes']:.1f}")
        for row, published in zip(result["coding"], PUBLISHED, strict=False)
    ]
    total = sum(row["ans_bytes"] for row in result["coding"])
    rows.append(("all", f"{total:,}", f"{sum(PUBLISHED):,}", f"{sum(PUBLISHED) / total:.1f}"))
    deformation = sum(row["streams"].get(name, 0.0) for row in result["coding"][1:] for name in ("planes", "weights"))
    anchors = result["evaluation"]["levels"][-1]["anchors"]
    return [
        "The scenes differ: ours is shelf-hand, the published bytes are averages over the Dycheck iPhone scenes. The",
        "plane sizes are the same.",
        "",
        markdown(("layer", "bytes here", "published bytes, other scenes", "ratio"), rows),
        "",
        f"Planes and weights of both deformations: {deformation:,.0f} bytes; anchors: {anchors:,}.",
        "",
    ]


if __name__ == "__main__":
    sys.exit(main())
