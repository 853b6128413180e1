"""Steps that see the most useful anchors alone."""

import pytest
import torch
from runs import assert_resumes_bit_for_bit, read_log

from pd4dgs_codec.model.picture import render
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import prefixes
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.prefixes import OCTAVES, draw_prefix, rank_anchors


def test_prefixes_are_nested_and_of_every_size():
    rank = torch.tensor([0.5, -torch.inf, 3.0, 2.0, 0.0, 1.0] + [4.0 + i for i in range(58)], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    drawn = [draw_prefix(rank, generator) for _ in range(200)]
    sizes = sorted({int(chosen.sum()) for chosen in drawn})
    assert sizes[0] == round(63 / 2**OCTAVES) and sizes[-1] > 55 and len(sizes) > 20
    for chosen in drawn:
        assert not chosen[1]
        assert rank[chosen].min() > rank[~chosen].max()


def test_the_rank_is_of_what_is_at_level_0(dataset):
    model = Trainer(TrainConfig(preset="tiny", iterations=30), dataset).model
    with torch.no_grad():
        model.mask_logits[::3, 0] = -20.0
    rank = rank_anchors(model, dataset.train[:2])
    assert torch.equal(rank.isfinite(), model.masks(0) > MASK_THRESHOLD)


@pytest.mark.parametrize("fused", (True, False))
def test_a_picture_of_some_anchors_is_that_of_the_model_without_the_others(dataset, monkeypatch, fused):
    model = Trainer(TrainConfig(preset="tiny", iterations=30), dataset).model
    if not fused:
        monkeypatch.setattr(type(model), "_fusible", lambda self: False)
    view = dataset.test[0]
    only = torch.arange(len(model.anchor_q)) % 2 == 0
    part = render(model, 0, view.time, view.camera, only=only)
    assert set(torch.unique(part.gaussians.anchors % 2).tolist()) == {0}
    with torch.no_grad():
        model.mask_logits[~only] = -20.0
    torch.testing.assert_close(part.image, render(model, 0, view.time, view.camera).image)


def test_a_run_draws_them_in_its_last_third_and_goes_on_bit_for_bit(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(prefixes, "VIEWS", 2)
    config = TrainConfig(preset="tiny", iterations=30, prefixes=0.5)
    trainer = Trainer(config, dataset)
    trainer.run(tmp_path / "whole.pt", log=tmp_path / "log.jsonl")
    records = read_log(tmp_path / "log.jsonl")
    drawn = [r for r in records if "prefix" in r]
    assert 0 < len(drawn) < 10 and min(r["iteration"] for r in drawn) >= 20
    assert all(r["level"] == 0 for r in drawn)
    assert_resumes_bit_for_bit(config, dataset, tmp_path, [24])


def test_without_them_nothing_is_ranked(dataset):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=9), dataset)
    assert not any("prefix" in trainer.learner.step() for _ in range(9))
    assert trainer.learner.rank is None and not len(trainer.learner.state()["rank"])
