"""The tables themselves: which runs each needs, and its Markdown from their results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pages.page import Page, Row, paragraph
from pages.paper import plots, published
from pages.paper.runs import (
    FIXED,
    FULL,
    MONOLITHIC,
    OURS,
    SCAFFOLD,
    TWO_LAYER,
    UNIFORM,
    WITHOUT,
    Variant,
    at_rate,
)
from pages.paper.statistics import Figure, Result, at_level, figure, gain, monotone, top
from pd4dgs_codec.bench.report import markdown

#: Rate weights of the curve of quality over bytes.
RATE_SCALES = (0.03, 0.1, 0.3, 1.0, 3.0)
#: Preset and steps where masks are looked at: 0.02 to 0.05 a step, they need hundreds to go from visible to absent, and
#: part still from moving anchors only once the deformations tell these apart.
MASK_BUDGET = ("small", 1_500)
#: Where levels are judged and the highest has learnt something.
LEVEL_BUDGET = ("tiny", 1_000)
#: What the comparison promises: dB that a level may lose against the model trained for it alone, share of bytes.
LOWER_LEVEL_LOSS, TOP_LEVEL_LOSS, TOP_SHARE, BASE_SHARE = 0.3, 0.1, 0.25, 0.10


@dataclass(frozen=True)
class Table:
    """One table. scenes, seeds: what it is made from unless told otherwise; text: results -> Markdown lines; plot:
    draws results to a path; budget: preset and iterations of the synthetic scenes instead of their own; sized: variants
    whose layer 0 is packed to have no more bytes than that of `reference`."""

    name: str
    title: str
    variants: tuple[Variant, ...]
    scenes: tuple[str, ...]
    seeds: int
    text: Callable[[Sequence[Result]], list[str]]
    plot: Callable[[Sequence[Result], Any], None]
    budget: tuple[str, int] | None = None
    sized: tuple[Variant, ...] = ()
    reference: Variant | None = None

    @property
    def page(self) -> Page:
        """docs/paper/NAME.md and its figures."""
        return Page(f"paper/{self.name}", f"paper.py {self.name}", self._markdown, self.title)

    def _markdown(self, rows: Sequence[Row]) -> str:
        budgets: dict[str, str] = {}
        for r in rows:
            budgets.setdefault(r["scene"], f"{r['scene']}: {r['config']['preset']}, {r['iterations']:,} iterations")
        said = (
            f"{len(rows)} trainings ({'; '.join(budgets.values())}). Equal iterations for every row of a scene that "
            "does not name its own; held-out views. Published figures are those of the paper, on other scenes."
        )
        return "\n".join([*paragraph(said), "", *self.text(rows), "", f"![{self.title}]({self.name}.png)"])


#: What a page shows of a level.
LEVEL = ("level", "mpsnr", "mssim", "mstlpips", "t_stlpips", "cumulative_bytes", "anchors")


def figures(result: Result, table: str) -> Row:
    """What the page of `table` shows of a run, or of all runs of a row."""
    row = {name: result[name] for name in ("commit", "scene", "variant", "seed", "iterations", "rho")}
    config = {name: result["config"][name] for name in ("preset", "rate_scale")}
    levels = [{name: level[name] for name in LEVEL if name in level} for level in result["levels"]]
    row |= {"name": result["scene"], "config": config, "levels": levels}
    return row | {name: result[name] for name in ("pi", "active", "gap_by_motion") if table == "rho"}


def of(results: Sequence[Result], variant: Variant, scene: str | None = None) -> list[Result]:
    """The results of one variant, on one scene or on all."""
    return [r for r in results if r["variant"] == variant.name and scene in (None, r["scene"])]


def scenes_of(results: Sequence[Result]) -> list[str]:
    """Names of the scenes, in the order they came."""
    return list(dict.fromkeys(r["scene"] for r in results))


def comparison(results: Sequence[Result]) -> list[str]:
    """Our levels beside models trained for one purpose, scene by scene."""
    rows, promises = [], []
    for scene in scenes_of(results):
        alone = [of(results, variant, scene) for variant in (SCAFFOLD, TWO_LAYER, MONOLITHIC)]
        ours = [(what, of(results, variant, scene)) for what, variant in OURS]
        for level, runs in enumerate(alone):
            rows.append((scene, runs[0]["variant"], *_cells(results, runs, 2)))
            rows += [(scene, f"{what}, level {level}", *_cells(results, r, level)) for what, r in ours if r]
        promises.append([_promises(scene, runs, *alone) for _, runs in ours if runs])
    theirs = [
        (
            "other scenes",
            f"{row.method}, published",
            f"{row.mpsnr:.2f}",
            f"{row.mssim:.3f}",
            *_blanks(results),
            f"{row.megabytes * 1e6:,.0f}",
        )
        for row in published.COMPARISON
    ]
    head = ("scene", "promise", "allowed", *(what for what, variant in OURS if of(results, variant)))
    held = [(*row[0][:3], *(cells[3] for cells in row)) for scene in promises for row in zip(*scene, strict=True)]
    return [
        markdown(("scene", "model", *_heads(results), "bytes"), rows + theirs),
        "",
        *paragraph(
            "Each row is a training of its own but for our levels, which are three prefixes of one file. The "
            "monolithic model trains all layers together in every step, without rate, mask terms and noise, and is "
            "shipped in one piece, float32 under LZMA. In each step ours trains one level, drawn by the rollout, so "
            "that in as many steps each level has a third of those of the model made for it alone. The other two give "
            "each level as many, and cost about as much time as those three models together: 'thrice' draws levels "
            "three times as often, 'every level' (`--rollout all`) trains all three in every step, each with a view of "
            "its own. Where layer 0 came out larger than the scaffold alone, ours was packed again to be no larger "
            "(`pd4dgs-encode --target-size`); all of its rows are of that file."
        ),
        "",
        markdown(head, held),
    ]


def _metrics(results: Sequence[Result]) -> list[tuple[str, str, int]]:
    """Heading, key and decimals of the metrics that all results hold; the perceptual ones need their packages."""
    optional = [("mST-LPIPS", "mstlpips", 4), ("t-ST-LPIPS", "t_stlpips", 5)]
    held = [row for row in optional if all(row[1] in level for r in results for level in r["levels"])]
    return [("mPSNR dB", "mpsnr", 2), ("mSSIM", "mssim", 4), *held]


def _heads(results: Sequence[Result]) -> list[str]:
    return [title for title, _, _ in _metrics(results)]


def _blanks(results: Sequence[Result]) -> list[str]:
    """Cells for the metrics that the published rows do not have under these names."""
    return [""] * (len(_metrics(results)) - 2)


def _cells(results: Sequence[Result], runs: Sequence[Result], level: int) -> list[str]:
    """The metrics and the bytes of `runs` at a level; `results` are those of the whole table."""
    metrics = [figure(runs, at_level(level, key)).text(digits) for _, key, digits in _metrics(results)]
    return [*metrics, f"{figure(runs, at_level(level, 'cumulative_bytes')).mean:,.0f}"]


def _promises(
    scene: str, full: list[Result], scaffold: list[Result], two: list[Result], mono: list[Result]
) -> list[tuple[str, ...]]:
    def value(results: list[Result], level: int, key: str) -> float:
        return figure(results, at_level(level, key)).mean

    def row(what: str, found: float, allowed: float, unit: str, at_least: bool) -> tuple[str, ...]:
        digits = 2 if unit == "dB" else 3
        held = found >= allowed if at_least else found <= allowed
        bound = f"{'≥' if at_least else '≤'} {allowed:.{digits}f} {unit}".rstrip()
        told = f"{found:+.{digits}f}" if at_least else f"{found:.{digits}f}"
        return scene, what, bound, told if held else f"{told}, NOT HELD"

    def lead(level: int, other: list[Result]) -> float:
        return value(full, level, "mpsnr") - value(other, 2, "mpsnr")

    size = value(mono, 2, "cumulative_bytes")
    first = value(full, 0, "cumulative_bytes")
    return [
        row("level 0 against the scaffold alone", lead(0, scaffold), -LOWER_LEVEL_LOSS, "dB", True),
        row("its bytes / the scaffold's", first / value(scaffold, 0, "cumulative_bytes"), 1.0, "", False),
        row("level 1 against two layers", lead(1, two), -LOWER_LEVEL_LOSS, "dB", True),
        row("level 2 against the monolithic", lead(2, mono), -TOP_LEVEL_LOSS, "dB", True),
        row("its bytes / the monolithic's", value(full, 2, "cumulative_bytes") / size, TOP_SHARE, "", False),
        row("layer 0 / the monolithic", first / size, BASE_SHARE, "", False),
    ]


def _against(head_what: str, variants: Sequence[Variant], results: Sequence[Result]) -> str:
    """By scene, the highest levels of `variants`, each beside the full method."""
    metrics, rows = _metrics(results), []
    keys = [*(key for _, key, _ in metrics), "cumulative_bytes"]
    for scene in scenes_of(results):
        full = {key: figure(of(results, FULL, scene), top(key)) for key in keys}
        for variant in variants:
            runs = of(results, variant, scene)
            mine = {key: figure(runs, top(key)) for key in keys}
            gains = "", ""
            if variant is not FULL:
                gains = _gain(full, mine, "mpsnr", 2), _gain(full, mine, "cumulative_bytes", 0)
            rows.append(
                (
                    scene,
                    variant.name,
                    *(mine[key].text(digits) for _, key, digits in metrics),
                    mine["cumulative_bytes"].text(0),
                    figure(runs, lambda r: r["levels"][0]["cumulative_bytes"]).text(0),
                    figure(runs, lambda r: r["rho"]).text(3),
                    *gains,
                )
            )
    head = ("scene", head_what, *_heads(results), "bytes", "layer 0 bytes", "rho", "full gains dB", "full spends bytes")
    return markdown(head, rows)


def _gain(full: dict[str, Figure], mine: dict[str, Figure], key: str, digits: int) -> str:
    difference = gain(full[key], mine[key])
    return "none" if difference is None else f"{difference:+,.{digits}f}"


def sampling(results: Sequence[Result]) -> list[str]:
    """How levels are sampled."""
    theirs = [(f"{r.method}, published", f"{r.mpsnr:.2f}", f"{r.megabytes:.2f} MB") for r in published.SAMPLING]
    return [
        _against("rollout", (UNIFORM, FIXED, FULL), results),
        "",
        *_spread_words("adaptive sampling (the full method)"),
        "",
        markdown(("other scenes", "mPSNR dB", "all layers"), theirs),
    ]


def components(results: Sequence[Result]) -> list[str]:
    """The method with one of its parts taken out."""
    theirs = [
        (f"{r.method}, published", f"{r.mpsnr:.2f}", f"{r.mssim:.3f}", f"{r.megabytes:.2f} MB", f"{r.tlpips:.4f}")
        for r in published.COMPONENTS
    ]
    return [
        _against("method", (*WITHOUT, FULL), results),
        "",
        *_spread_words("the full method"),
        "",
        markdown(("other scenes", "mPSNR dB", "mSSIM", "all layers", "t-LPIPS"), theirs),
    ]


def _spread_words(what: str) -> list[str]:
    return paragraph(
        "Highest level; mean over seeds, ± half the distance between the best and the worst. "
        f"Gains are those of {what}: differences at the same seed, and their mean; where that is smaller than what the "
        "differences spread, there is none."
    )


def levels(results: Sequence[Result]) -> list[str]:
    """Each level of each run, and whether the next is always better."""
    rows = []
    for scene in scenes_of(results):
        runs = of(results, FULL, scene)
        held = sum(monotone(r) for r in runs)
        for level in sorted({row["level"] for run in runs for row in run["levels"]}):
            held_by = f"{held} of {len(runs)}" if level == 0 else ""
            rows.append((scene, str(level), *_cells(results, runs, level), held_by))
    theirs = [
        (
            "other scenes, published",
            str(r.level),
            f"{r.mpsnr:.3f}",
            f"{r.mssim:.3f}",
            *_blanks(results),
            f"{r.megabytes * 1e6:,.0f}",
            "",
        )
        for r in published.LEVELS
    ]
    head = ("scene", "level", *_heads(results), "bytes so far", "runs whose every level gains")
    return [markdown(head, rows + theirs)]


def latency(results: Sequence[Result]) -> list[str]:
    """8 S / B until each level is there."""
    rows = []
    for scene in scenes_of(results):
        full = of(results, FULL, scene)
        for row in full[0]["levels"]:
            size = figure(full, at_level(row["level"], "cumulative_bytes")).mean
            rows.append((scene, f"ours, level {row['level']}", *_seconds(size), f"{size:,.0f}"))
        mono = of(results, MONOLITHIC, scene)
        if mono:
            size = figure(mono, top("cumulative_bytes")).mean
            rows.append((scene, "monolithic", *_seconds(size), f"{size:,.0f}"))
    theirs = [
        ("other scenes", f"{r.method}, published", *(f"{s:.2f}" for s in r.seconds), f"{r.megabytes * 1e6:,.0f}")
        for r in published.FIRST_FRAME
    ]
    return [
        markdown(("scene", "what", "s at 2 Mbps", "s at 10 Mbps", "s at 50 Mbps", "bytes"), rows + theirs),
        "",
        "Computed as 8 S / B; `pd4dgs-bench latency` measures them over a paced link.",
    ]


def _seconds(size: float) -> tuple[str, ...]:
    return tuple(f"{8 * size / rate:.2f}" for rate in plots.LINKS)


def rates(results: Sequence[Result]) -> list[str]:
    """Layer sizes and levels as the rate weight moves."""
    rows = []
    for scene in scenes_of(results):
        for scale in RATE_SCALES:
            runs = of(results, at_rate(scale), scene)
            for row in runs[0]["levels"] if runs else ():
                level = row["level"]
                active = figure(runs, at_level(level, "anchors")).mean
                weight = (f"{scale:g}", f"{figure(runs, lambda r: r['rho']).mean:.3f}") if level == 0 else ("", "")
                rows.append((scene, *weight, str(level), *_cells(results, runs, level), f"{active:,.0f}"))
    head = ("scene", "rate scale", "rho", "level", *_heads(results), "bytes so far", "anchors")
    return [
        markdown(head, rows),
        "",
        "Rate scale 1 is the paper's weight; the default quality has 0.08.",
    ]


def rho(results: Sequence[Result]) -> list[str]:
    """rho in the middle and at the end of each run, with the masks of what rests and of what moves."""
    rows = []
    for scene in scenes_of(results):
        for variant in (FULL, at_rate(1.0)):
            for run in of(results, variant, scene):
                half, last = run["pi"][len(run["pi"]) // 2], run["pi"][-1]
                gaps = run["gap_by_motion"]
                rows.append(
                    (
                        scene,
                        f"{run['config']['rate_scale']:g}",
                        f"{half['rho']:.3f}",
                        f"{last['rho']:.3f}",
                        *([f"{gap:.3f}" for gap in gaps] if gaps else ("", "")),
                        " / ".join(f"{p:.3f}" for p in last["pi"]),
                        " / ".join(f"{n:,}" for n in run["active"]),
                    )
                )
    head = ("scene", "rate scale", "rho at N/2", "rho at N", "still half", "moving tenth", "pi at N", "active anchors")
    return [
        markdown(head, rows),
        "",
        *paragraph(
            "Last two columns: levels 0 / 1 / 2. rho follows the mean of m^(2) - m^(0) over all anchors; beside it "
            "stands that mean at the end of the run over the half of the anchors that level 1 moves least and over the "
            "tenth that it moves most, blank where level 1 was left out (from 2N/3 on; rho then falls to 0)."
        ),
    ]


SYNTHETIC = ("global", "local", "fast")
REAL = ("shelf-hand", "bouncing-balls")
TABLES = {
    t.name: t
    for t in (
        Table(
            "comparison",
            "Comparison with models trained for one purpose",
            (SCAFFOLD, TWO_LAYER, MONOLITHIC, *(variant for _, variant in OURS)),
            (*SYNTHETIC, *REAL),
            1,
            comparison,
            plots.comparison,
            sized=tuple(variant for _, variant in OURS),
            reference=SCAFFOLD,
        ),
        Table("sampling", "Sampling of levels", (UNIFORM, FIXED, FULL), REAL, 3, sampling, plots.seeds),
        Table("components", "Components", (*WITHOUT, FULL), REAL, 3, components, plots.seeds),
        Table("levels", "Levels", (FULL,), (*SYNTHETIC, *REAL), 3, levels, plots.levels, LEVEL_BUDGET),
        Table("latency", "First frame", (FULL, MONOLITHIC), REAL, 1, latency, plots.latency),
        Table(
            "rates",
            "Quality over bytes",
            tuple(map(at_rate, RATE_SCALES)),
            ("local", "bouncing-balls"),
            1,
            rates,
            plots.rates,
            MASK_BUDGET,
        ),
        Table(
            "rho",
            "rho over training",
            (FULL, at_rate(1.0)),
            ("static", "fast", "local", "bouncing-balls"),
            1,
            rho,
            plots.rho,
            MASK_BUDGET,
        ),
    )
}
