"""Trains the scenes, packs and measures them: docs/results.md with its pictures, and the short table of README.md.

    python tools/results.py [--only NAME ...] [--seeds 1] [--out out] [--docs docs] [--render]

Finished trainings in --out are kept, so a stopped run goes on where it was. Real scenes are read from the folder in
PD4DGS_SHARED (default ../shared/data beside the repository); those not there are named and left out. With --seeds N
each scene is trained N times, and a table shows how far that spreads.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pages.page import Page, Row, filled, make, options, paragraph, say
from pages.scenes import SCENES, present
from pages.tables import coding_table, figures, point, quality_table, short_table, spread_table, time_plot

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.threads import configure

#: Bytes per layer that the PD-4DGS paper publishes (average over the seven Dycheck iPhone scenes).
PUBLISHED = (436_000, 1_187_000, 5_275_000)
#: Bytes of a picture in git.
LARGEST_PICTURE = 300_000
#: What README.md shows: scene and levels.
SHORT = {"shelf-hand": (0, 1), "bouncing-balls": (1,)}


def render(rows: Sequence[Row]) -> str:
    """The page's tables."""
    lines = [
        *paragraph(
            "Made on one thread of a shared machine, where a scene does not say otherwise; times are single runs, "
            "sizes and qualities repeat. Quality is that of the `.pd4` prefix whose bytes stand in the same row, on "
            "held-out views."
        ),
        "",
        quality_table(rows),
        "",
        *_spread_lines(rows),
        "![held-out PSNR against training wall time](img/quality-over-time.png)",
        "",
        "## Coding",
        "",
        coding_table(rows),
        "",
    ]
    for row in [row for row in rows if row["preset"] == "paper"]:
        lines += ["## The paper's plane sizes", "", *_paper_lines(row)]
    for row in rows:
        lines += [f"## {row['name']}", "", f"![truth and levels](img/{row['name']}.jpg)", ""]
        lines += [f"- left out: {out['what']} ({out['bytes']:,} bytes): {out['why']}" for out in row["left_out"]]
        skipped, limit = f"{row['skipped_steps']} skipped steps", SCENES[row["name"]].seconds
        steps = f"{row['iterations']:,} iterations"
        steps += f" in {limit / 60:.0f} minutes" if limit else ""
        steps += f" on {row['threads']} threads" if row["threads"] > 1 else ""
        lines += [f"- {steps}, rho {row['rho']:.3f}, {skipped}"]
        lines += [""]
    return "\n".join(lines).rstrip("\n")


def _spread_lines(rows: Sequence[Row]) -> list[str]:
    spread = [row for row in rows if len(row.get("seeds", ())) > 1]
    if not spread:
        return []
    said = "All seeds, the first of which stands above: the median, and in brackets the least and the most."
    return [said, "", spread_table(spread), ""]


def _paper_lines(row: Row) -> list[str]:
    layers = [
        (str(layer["layer"]), f"{layer['ans_bytes']:,}", f"{published:,}", f"{published / layer['ans_bytes']:.1f}")
        for layer, published in zip(row["coding"], PUBLISHED, strict=False)
    ]
    total = sum(layer["ans_bytes"] for layer in row["coding"])
    layers.append(("all", f"{total:,}", f"{sum(PUBLISHED):,}", f"{sum(PUBLISHED) / total:.1f}"))
    return [
        "The scenes differ: ours is shelf-hand, the published bytes are averages over the Dycheck iPhone scenes. The",
        "plane sizes are the same.",
        "",
        markdown(("layer", "bytes here", "published bytes, other scenes", "ratio"), layers),
        "",
        f"Planes and weights of both deformations: {row['deformation_bytes']:,.0f} bytes; anchors: "
        f"{row['levels'][-1]['anchors']:,}.",
        "",
    ]


PAGE = Page("results", "results.py", render, title="Results")


def fill_readme(readme: Path, rows: Sequence[Row]) -> None:
    """Puts the short table between the README's two markers, if all that it shows was measured."""
    shown = [row for row in rows if row["name"] in SHORT]
    if len(shown) == len(SHORT) and readme.is_file():
        text = filled(readme.read_text(), "results", "results.py", short_table(shown, SHORT), readme)
        readme.write_text(text)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, list(SCENES))
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="train each scene with seeds 0 to N - 1 (1)")
    args = parser.parse_args(argv)
    threads = configure()

    from pages.main_job import Job, pack_seed, run_job
    from PIL import Image

    from pd4dgs_codec.cli.progress import TrainingProgress

    def measure(name: str) -> Row:
        scene, progress = SCENES[name], TrainingProgress()
        result = run_job(Job(name, scene.config()), args.out, say=say, progress=progress)
        seeds = [result["evaluation"]["levels"]]
        seeds += [
            pack_seed(Job(name, scene.config(seed=seed)), args.out, say=say, progress=progress)
            for seed in range(1, args.seeds)
        ]
        picture = args.docs / "img" / f"{name}.jpg"
        picture.parent.mkdir(parents=True, exist_ok=True)
        image = Image.open(args.out / name / "levels.png").convert("RGB")
        for quality in (95, 85):
            image.save(picture, quality=quality, subsampling=0)
            if picture.stat().st_size <= LARGEST_PICTURE:
                break
        return figures(result) | {"threads": threads, "seeds": [list(map(point, levels)) for levels in seeds]}

    def finish(rows: list[Row]) -> None:
        if not args.render:
            time_plot(rows, args.docs / "img" / "quality-over-time.png")
        fill_readme(args.docs.parent / "README.md", rows)

    return make(PAGE, list(SCENES), [scene.name for scene in present(args)], args, measure, finish)


if __name__ == "__main__":
    sys.exit(main())
