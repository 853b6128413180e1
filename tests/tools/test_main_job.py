"""The main job on a few tiny pictures: everything is written, a finished run is used again, the tables read well."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pages import main_job, tables, trainings
from pages.main_job import Job, run_job
from PIL import Image
from tiny import HEIGHT, TINY, WIDTH, disc

from pd4dgs_codec import decode
from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.info import info
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.learner import Learner

FRAMES = 6
CONFIG = TrainConfig(preset="tiny", source="disc", iterations=40)


@pytest.fixture(scope="module")
def job() -> Iterator[Job]:
    """A tiny job whose dataset comes from here, whose model has few anchors and whose files are coded fast."""
    dataset = disc(held_out=(0.3, 0.7))

    def load(source, *, downscale, holdout):
        assert source == "disc" and (downscale, holdout) == (CONFIG.downscale, CONFIG.holdout)
        return dataset

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(main_job, "load", load)
        patch.setitem(PRESETS, "tiny", TINY)
        patch.setattr(main_job, "VARIANTS", {k: {"effort": 1, **v} for k, v in main_job.VARIANTS.items()})
        yield Job("discs", CONFIG)


@pytest.fixture(scope="module")
def finished(job, tmp_path_factory) -> tuple[Path, dict, list[str]]:
    """(folder, result, lines said) of one run; tests read it and never write there."""
    folder = tmp_path_factory.mktemp("finished")
    return folder, *_run(job, folder)


@pytest.fixture
def copied(finished, tmp_path) -> Path:
    """A copy of the run's folder that a test may change."""
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    return tmp_path


class _Started(Exception):
    pass


@pytest.fixture
def no_training(monkeypatch) -> None:
    """Raises _Started where training would start."""

    def run(self, *_, **__):
        raise _Started

    monkeypatch.setattr(trainings.Trainer, "run", run)


def _run(job: Job, folder) -> tuple[dict, list[str]]:
    said: list[str] = []
    return run_job(job, folder, say=said.append), said


def test_it_writes_figures_file_and_pictures(finished):
    folder, result, said = finished[0] / "discs", *finished[1:]
    assert json.loads((folder / "results.json").read_text()) == result
    assert all(line.startswith("discs: ") for line in said) and any("training" in line for line in said)
    assert (result["iterations"], result["skipped_steps"]) == (40, 0) and result["train_seconds"] > 0
    assert len((folder / "train.jsonl").read_text().splitlines()) == 40

    data = (folder / "scene.pd4").read_bytes()
    layers = [row["layer"] for row in info(data)["layers"]]
    assert decode(data).layers == tuple(layers) and layers[0] == 0
    levels = result["evaluation"]["levels"]
    assert [row["level"] for row in levels] == layers == [row["layer"] for row in result["coding"]]
    assert levels[-1]["cumulative_bytes"] == len(data)
    for row in levels:
        assert row["first_frame_seconds"] == pytest.approx(row["cumulative_bytes"] * 8 / 2e6)
        assert 5 < row["mpsnr"] < 60 and abs(row["loss_db"]) < 3
    for row in result["coding"]:
        assert row["best_over_gauss"] <= 1 and row["position_bytes"] > 0 or row["anchors"] == 0
        assert row["lzma_bytes"] > 0 and row["rate_bits"] > 0

    assert result["pictures"] == ["levels.png", "levels.gif"]
    panels = 1 + len(layers)
    still = Image.open(folder / "levels.png")
    assert still.width >= panels * WIDTH and still.height >= 2 * HEIGHT
    movie = Image.open(folder / "levels.gif")
    assert movie.n_frames == FRAMES and movie.width == still.width


def test_a_finished_checkpoint_is_used_again(job, finished, copied, no_training):
    first, path = finished[1], copied / "discs" / "model.pt"
    before, when = path.read_bytes(), path.stat().st_mtime_ns
    second, said = _run(job, copied)
    assert said and not any("training" in line for line in said)
    assert path.read_bytes() == before and path.stat().st_mtime_ns == when
    for name in ("train_seconds", "curve", "coding", "left_out", "pictures"):
        assert second[name] == first[name], name
    assert [r["mpsnr"] for r in second["evaluation"]["levels"]] == [r["mpsnr"] for r in first["evaluation"]["levels"]]


@pytest.mark.parametrize("change", [{"seed": 1}, {"iterations": 41}, {"ssim": 0.3}])
def test_another_configuration_trains_anew(job, copied, no_training, change):
    with pytest.raises(_Started):
        _run(dataclasses.replace(job, config=dataclasses.replace(CONFIG, **change)), copied)
    assert not (copied / "discs" / "train.jsonl").exists()  # the new run's log will hold that run alone


def test_an_unfinished_checkpoint_is_trained_again(job, copied, no_training):
    path, log = copied / "discs" / "model.pt", copied / "discs" / "train.jsonl"
    model, training = checkpoint.load(path)
    for iteration, total in ((39, 40), (0, 0)):
        checkpoint.save(path, model, training | {"place": iteration, "total": total})
        with pytest.raises(_Started):
            _run(job, copied)
        assert len(log.read_text().splitlines()) == 40  # it goes on, and so does its log


@pytest.mark.parametrize(
    ("seconds", "total", "ended"), [(1.0, 50, False), (9.0, 50, True), (1.0, 40, True), (1.0, 0, False)]
)
def test_a_run_ends_with_its_steps_or_its_time(seconds, total, ended):
    config = dataclasses.replace(CONFIG, max_seconds=9.0)
    assert trainings._ended({"iteration": 40, "total": total, "seconds": seconds}, config) is ended


def test_an_interrupted_training_is_not_published_and_goes_on(job, finished, tmp_path, monkeypatch):
    step = Learner.step

    def interrupted(self):
        if self.iteration == 10:
            signal.raise_signal(signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Learner, "step", interrupted)
    with pytest.raises(TrainError, match="interrupted at step 11"):
        _run(job, tmp_path)
    assert sorted(p.name for p in (tmp_path / "discs").iterdir()) == ["model.pt", "train.jsonl"]
    monkeypatch.setattr(Learner, "step", step)
    result, said = _run(job, tmp_path)
    assert any("from step 11" in line for line in said) and result["phases_not_reached"] == []
    assert (tmp_path / "discs" / "scene.pd4").read_bytes() == (finished[0] / "discs" / "scene.pd4").read_bytes()


def shown(result: dict) -> dict:
    """The figures that tables show of a result."""
    return {"name": result["name"], **tables.figures(result)}


def test_a_layer_that_one_encoding_drops_is_shown_as_absent(finished):
    scene = to_scene(checkpoint.load(finished[0] / "discs" / "model.pt")[0])
    reports = {name: encode_with_report(scene, **options)[1] for name, options in main_job.VARIANTS.items()}
    whole = main_job.coding_rows(reports, scene)
    reports["lzma"] = dataclasses.replace(reports["lzma"], layers=reports["lzma"].layers[1:])
    rows = main_job.coding_rows(reports, scene)
    assert rows[1]["lzma_bytes"] is None and whole[1]["lzma_bytes"] and rows[2:] == whole[2:]
    assert "| - " in tables.coding_table([shown(finished[1] | {"coding": rows})])


def test_the_results_become_markdown_tables_and_a_plot(finished, tmp_path):
    result = finished[1]
    levels = [str(row["level"]) for row in result["evaluation"]["levels"]]
    for table, numbers in (
        (tables.quality_table([shown(result)] * 2), levels),
        (tables.coding_table([shown(result)] * 2), [*levels, "all"]),
    ):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
        assert len({len(line) for line in table.splitlines()}) == 1  # columns line up
        assert len({len(row) for row in rows}) == 1 and set("".join(rows[1])) == {"-"}
        assert all(row[0] == "discs" for row in rows[2:])
        assert [row[1] for row in rows[2:]] == 2 * numbers
        assert all(cell for row in rows for cell in row)
    assert f"{result['evaluation']['levels'][-1]['cumulative_bytes']:,}" in tables.quality_table([shown(result)])
    assert f"{result['coding'][0]['lzma_bytes']:,}" in tables.coding_table([shown(result)])
    pytest.importorskip("matplotlib")
    tables.time_plot([shown(result)], tmp_path / "plot.png")
    assert Image.open(tmp_path / "plot.png").width > 300


def test_another_seed_is_measured_likewise(job, finished, copied, no_training):
    folder = copied / "discs" / f"seed-{job.config.seed}"
    folder.mkdir()
    shutil.copy(copied / "discs" / "model.pt", folder)
    levels = main_job.pack_seed(job, copied, say=lambda text: None)
    for row, first in zip(levels, finished[1]["evaluation"]["levels"], strict=True):
        assert row["level"] == first["level"] and row["mpsnr"] == pytest.approx(first["mpsnr"], abs=1e-3)
        assert 0.8 < row["cumulative_bytes"] / first["cumulative_bytes"] <= 1  # at the default effort


def test_a_spread_is_that_of_the_levels_that_every_seed_has():
    seeds = [[(0, 1000, 20.0), (1, 3000, 30.0)], [(0, 1200, 21.0)], [(0, 900, 23.0), (1, 2500, 31.0)]]
    named = [[dict(zip(("level", "bytes", "mpsnr"), row, strict=True)) for row in seed] for seed in seeds]
    _, _, *rows = tables.spread_table([{"name": "discs", "seeds": named}]).splitlines()
    (cells,) = ([cell.strip() for cell in row.strip("|").split("|")] for row in rows)
    assert cells == ["discs", "0", "3", "1,000 (900 to 1,200)", "21.00 (20.00 to 23.00)"]


def test_the_row_of_all_layers_holds_sums_and_ratios_of_sums():
    row = {"ans_bytes": 10, "lzma_bytes": 20, "position_bytes": 1.0}
    row |= {"draco_position_bytes": 2.0, "rate_bits": 100.0, "payload_over_rate": 1.0, "train_over_rate": 1.0}
    row |= {"best_over_gauss": 0.5, "ans_over_lzma": 0.5, "lzma_symbol_bytes": 10.0}
    other = row | {"rate_bits": 300.0, "payload_over_rate": 2.0, "best_over_gauss": 1.0, "lzma_symbol_bytes": 30.0}
    total = tables.all_layers([row, other | {"ans_over_lzma": 0.9}])
    assert (total["ans_bytes"], total["lzma_bytes"], total["draco_position_bytes"]) == (20, 40, 4.0)
    assert total["payload_over_rate"] == (100 + 600) / 400
    assert total["best_over_gauss"] == (50 + 600) / 700
    assert total["ans_over_lzma"] == pytest.approx((5 + 27) / 40)
    missing = tables.all_layers([row, other | {"lzma_bytes": None, "ans_over_lzma": None}])
    assert missing["lzma_bytes"] is None and missing["ans_over_lzma"] is None and missing["ans_bytes"] == 20


def test_draco_positions_cost_some_bits_and_no_origin():
    pytest.importorskip("DracoPy")
    cells = np.unique(np.random.default_rng(0).integers(-50, 50, (3000, 3), dtype=np.int32), axis=0)
    bits = main_job.draco_position_bits(cells)
    assert 2 * len(cells) < bits < 21 * len(cells)
    assert main_job.draco_position_bits(cells + np.int32(70_000)) == pytest.approx(bits, rel=0.02)
    assert main_job.draco_position_bits(cells[:0]) == 0
