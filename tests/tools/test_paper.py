"""The paper's tables: statistics by hand, every table and plot from made-up results, one real run end to end."""

import dataclasses
import importlib.util
import json
from functools import partial
from pathlib import Path

import pytest
from pages.paper import plots, runs, statistics, tables
from pages.paper.published import FIRST_FRAME
from pages.paper.runs import FULL, MONOLITHIC, SCAFFOLD, Run, Scene, at_rate, held_to, measure
from tiny import TINY, disc, write_views

from pd4dgs_codec.format.options import EncodeOptions
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.quality import target
from pd4dgs_codec.train.config import TrainConfig

TOOL = Path(__file__).resolve().parents[2] / "tools" / "paper.py"


def result(scene="local", variant="full", seed=0, psnr=(20.0, 22.0, 23.0), sizes=(100, 200, 300), **changes) -> dict:
    """A made-up result; levels as given."""
    levels = [
        {"level": i, "mpsnr": p, "mssim": 0.8 + 0.01 * i, "cumulative_bytes": s, "anchors": 10 + i}
        for i, (p, s) in enumerate(zip(psnr, sizes, strict=True))
    ]
    pi = [{"iteration": i, "rho": 0.1 * i, "pi": [0.3, 0.3, 0.4]} for i in range(3)]
    whole = {
        "scene": scene, "variant": variant, "seed": seed, "iterations": 9, "seconds": 1.0, "rho": 0.2, "anchors": 12,
        "active": [10, 11, 12], "pi": pi, "levels": levels,
        "gap_by_motion": [0.01, 0.2], "config": {"preset": "tiny", "rate_scale": 0.1},
    }  # fmt: skip
    return whole | changes


def test_a_figure_is_the_mean_over_scenes_then_over_seeds():
    rows = [
        result("a", seed=0, psnr=(1, 2, 10)),
        result("b", seed=0, psnr=(1, 2, 20)),
        result("a", seed=1, psnr=(1, 2, 13)),
    ]
    figure = statistics.figure(rows, statistics.top("mpsnr"))
    assert figure.seeds == (15, 13) and figure.mean == 14 and figure.spread == 2
    assert figure.text(1) == "14.0 ± 1.0"
    assert statistics.figure(rows[:1], statistics.top("mpsnr")).text(1) == "10.0"


@pytest.mark.parametrize("differences, told", [((0.9, 0.0), None), ((-1.1, -0.4), -0.75), ((1.1, 1.0), 1.05)])
def test_a_gain_within_the_spread_of_its_seeds_is_none(differences, told):
    other = statistics.Figure(0.0, 9.0, (16.0, 25.0))  # seeds far apart: their differences need not be
    ours = statistics.Figure(0.0, 9.0, tuple(a + d for a, d in zip(other.seeds, differences, strict=True)))
    assert statistics.gain(ours, other) == (None if told is None else pytest.approx(told))


def test_monotone_needs_psnr_strictly_and_ssim_weakly():
    assert statistics.monotone(result())
    assert not statistics.monotone(result(psnr=(20, 22, 22)))
    fallen = result()
    fallen["levels"][2]["mssim"] = 0.805
    assert not statistics.monotone(fallen)


def test_the_comparison_tells_which_promise_is_broken():
    rows = [
        result(variant="static scaffold alone", psnr=(20.2,), sizes=(110,)),
        result(variant="two layers", psnr=(20.0, 22.5), sizes=(100, 210)),
        result(variant="monolithic", psnr=(23.05,), sizes=(1_100,)),
        result(),
    ]
    rows[2]["levels"][0]["level"] = 2
    table = [[cell.strip() for cell in line.split("|")[2:5]] for line in tables.comparison(rows)[-1].splitlines()]
    found = {what: (allowed, told) for what, allowed, told in table}
    assert found["level 0 against the scaffold alone"] == ("≥ -0.30 dB", "-0.20")
    assert found["its bytes / the scaffold's"] == ("≤ 1.000", "0.909")
    assert found["level 1 against two layers"] == ("≥ -0.30 dB", "-0.50, NOT HELD")
    assert found["level 2 against the monolithic"] == ("≥ -0.10 dB", "-0.05")
    assert found["its bytes / the monolithic's"] == ("≤ 0.250", "0.273, NOT HELD")
    assert found["layer 0 / the monolithic"] == ("≤ 0.100", "0.091")


@pytest.mark.parametrize("name", list(tables.TABLES))
def test_every_table_names_what_it_compares_and_draws_it(name, tmp_path):
    table = tables.TABLES[name]
    rows = []
    for scene in table.scenes:
        for variant in table.variants:
            for seed in range(2):
                row = result(
                    scene, variant.name, seed, config={"preset": "tiny"} | {"rate_scale": 0.1} | variant.changes
                )
                if variant.monolithic:
                    row["levels"] = row["levels"][-1:]
                elif "max_layer" in variant.changes:
                    row["levels"] = row["levels"][: variant.changes["max_layer"] + 1]
                rows.append(row)
    text = "\n".join(table.text(rows))
    for scene in table.scenes if name not in ("sampling", "components") else ():
        assert scene in text
    if name in ("comparison", "sampling", "components"):
        assert all(v.name in text for v in table.variants if v not in dict(tables.OURS).values())
    table.plot(rows, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5_000


def test_published_seconds_are_those_of_the_published_sizes():
    for row in FIRST_FRAME:
        for seconds, rate in zip(row.seconds, plots.LINKS, strict=True):
            assert seconds == pytest.approx(8e6 * row.megabytes / rate, rel=0.01), row


@pytest.fixture
def small(monkeypatch):
    """The tiny preset, tinier; files packed the fast way; few sizes to try; no perceptual distances."""
    fast = EncodeOptions(mode="lzma", effort=1)
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setattr(runs, "encode_with_report", partial(runs.encode_with_report, options=fast))
    monkeypatch.setattr(runs, "pack", partial(runs.pack, options=fast))
    monkeypatch.setattr(runs, "load_perceptual", lambda: None)
    monkeypatch.setattr(target, "OCTAVES", (0.0, 2.0))
    monkeypatch.setattr(target, "SHARES", (0.0, 0.5))


#: Of six pictures.
DISC = Scene("disc", TrainConfig(preset="tiny", source="disc", iterations=12), 1)


def test_runs_are_made_once_and_again_when_settings_change(small, tmp_path):
    said: list[str] = []

    def made(variant, **changes):
        changed = dataclasses.replace(DISC, config=dataclasses.replace(DISC.config, **changes))
        return measure(Run(changed, variant, 0), disc, tmp_path, say=said.append)

    full, scaffold, mono = made(FULL), made(SCAFFOLD), made(MONOLITHIC)
    assert [row["level"] for row in scaffold["levels"]] == [0]
    assert [row["level"] for row in mono["levels"]] == [2]
    assert mono["levels"][0]["cumulative_bytes"] > full["levels"][-1]["cumulative_bytes"]
    assert scaffold["gap_by_motion"] is None and len(full["gap_by_motion"]) == 2
    assert len(full["pi"]) and full["config"]["rollout"] == "adaptive" and mono["config"]["rollout"] == "top"
    begun = len(said)
    assert made(FULL) == full and len(said) == begun, "a kept result was made again"
    assert made(FULL, volume=0.02)["config"]["volume"] == 0.02 and len(said) > begun
    model = Run(DISC, FULL, 0).folder(tmp_path) / "model.pt"
    assert json.loads(checkpoint.load(model)[1]["config"])["volume"] == 0.02


def test_a_file_is_packed_again_if_its_layer_0_is_too_large_and_that_is_kept(small, tmp_path):
    run = Run(DISC, FULL, 0)
    said: list[str] = []
    full = measure(run, disc, tmp_path, say=said.append)
    size = full["levels"][0]["cumulative_bytes"]
    assert held_to(full, run, size, disc, tmp_path, say=said.append) is full
    begun = len(said)
    held = held_to(full, run, size - 200, disc, tmp_path, say=said.append)
    assert 0.5 * size < held["levels"][0]["cumulative_bytes"] <= size - 200 and len(said) == begun + 1
    assert held_to(full, run, size - 200, disc, tmp_path, say=said.append) == held
    assert len(said) == begun + 1, "a kept file was made again"
    assert measure(run, disc, tmp_path, say=said.append) == full


def test_the_default_rate_is_the_full_method():
    assert at_rate(0.1) is FULL and at_rate(1.0).changes == {"rate_scale": 1.0}


def test_the_tool_trains_and_writes_a_table(small, tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("paper_tool", TOOL)
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    tool.OTHERS = ("tiny", 12, 1)
    docs = tmp_path / "docs"
    where = ("--out", str(tmp_path / "out"), "--docs", str(docs))
    assert tool.main(["levels", "--scenes", str(write_views(tmp_path / "six")), "--iterations", "12", *where]) == 0
    page = (docs / "paper" / "levels.md").read_text()
    assert "| level |" in page and (docs / "paper" / "levels.png").exists()
    assert json.loads((docs / "figures" / "paper" / "levels.json").read_text())[0]["variant"] == "full"
    assert tool.main(["levels", "--render", *where]) == 0 and (docs / "paper" / "levels.md").read_text() == page
    capsys.readouterr()
    assert tool.main(["levels", "--scenes", str(tmp_path / "nowhere"), *where]) == 1
    assert capsys.readouterr().err.count("\n") == 1
