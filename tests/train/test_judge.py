"""Levels that gain nothing on views not seen yet are left out of the model, its optimiser, the log and the file."""

import json
from dataclasses import replace

import pytest
from runs import assert_same_weights, read_log

from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.train import judge
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.schedule import Schedule


@pytest.mark.parametrize(
    "psnr,levels",
    [
        ([30, 31, 32], []),
        ([30, 31, 30.9], [2]),
        ([30, 31, 31 + 0.9 * judge.MIN_GAIN_DB[2]], [2]),
        ([30, 29, 29], [2, 1]),
        ([30, 30.38, 30.4], [2, 1]),  # a scene where nothing moves
        ([30, 29, 29.7], []),  # level 2 gains, and rests on level 1
        ([30], []),
    ],
)
def test_levels_go_from_the_top_while_they_gain_nothing(psnr, levels):
    assert [level for level, _ in judge.levels_without_gain(psnr, [0.0] * 3)] == levels


def test_a_level_must_pay_for_its_bytes():
    megabyte = 1 / judge.MIN_GAIN_PER_MEGABYTE
    assert not judge.levels_without_gain([30, 32, 33], [0, 0, 0.9e6 * megabyte])
    assert [level for level, _ in judge.levels_without_gain([30, 32, 33], [0, 0, 1.1e6 * megabyte])] == [2]


def test_what_a_level_costs_is_its_planes_and_a_byte_a_weight(dataset):
    field = Trainer(TrainConfig(preset="tiny", iterations=30), dataset).model.global_deformation
    weights = 8 * 4 + 8 + 8 * 8 + 8 + (3 + 32 + 30 + 6) * (8 + 1)
    assert judge.field_bytes(field, 800.0) == 100 + weights


def test_short_runs_and_few_views_are_not_judged():
    assert judge.waiting_views(60, 1000) == {8, 24, 40, 56}
    assert not judge.waiting_views(60, judge.MIN_ITERATIONS - 1) and not judge.waiting_views(50, 1000)


def test_a_level_that_goes_stays_away(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(judge, "MIN_ITERATIONS", 10)
    monkeypatch.setattr(judge, "levels_without_gain", lambda psnr, _: [(2, psnr[2] - psnr[1])])
    views = replace(dataset, train=dataset.train * 12)
    config = TrainConfig(preset="tiny", iterations=30)
    trainer = Trainer(config, views)
    seen = []
    original = trainer.learner._next_view
    monkeypatch.setattr(trainer.learner, "_next_view", lambda: seen.append(original()) or seen[-1])
    trainer.run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    start = Schedule(30).rounding
    assert not set(seen[:start]) & judge.waiting_views(72, 30) and len(judge.waiting_views(72, 30)) == 4
    records = read_log(tmp_path / "log.jsonl")
    assert [r["iteration"] for r in records if "left_out" in r] == [start]
    assert records[start]["left_out"][0]["level"] == 2 and max(r["level"] for r in records[start:]) == 1
    model, training = checkpoint.load(tmp_path / "m.pt")
    assert model.local_deformation is None and model.global_deformation is not None
    assert json.loads(training["left_out"]) == trainer.learner.left_out
    assert decode(encode(to_scene(model), effort=1)).layers == (0, 1)

    part = Trainer(config, views)
    for _ in range(25):
        part.learner.step()
    part.save(tmp_path / "part.pt")
    resumed = Trainer(config, views)
    resumed.resume(tmp_path / "part.pt")
    resumed.run(tmp_path / "resumed.pt")
    assert_same_weights(tmp_path / "m.pt", tmp_path / "resumed.pt")
    assert resumed.learner.left_out == trainer.learner.left_out


def test_with_judging_off_all_views_are_learnt_and_all_levels_stay(dataset, monkeypatch):
    monkeypatch.setattr(judge, "MIN_ITERATIONS", 10)
    views = replace(dataset, train=dataset.train * 12)
    assert Trainer(TrainConfig(preset="tiny", iterations=30), views).learner.waiting_views()
    for nothing in ({"judge": False}, {"max_layer": 0}, {"rollout": "top"}):
        assert not Trainer(TrainConfig(preset="tiny", iterations=30, **nothing), views).learner.waiting_views()
