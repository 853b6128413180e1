"""What the pictures hardly need leaves: the least harmful anchors, as many as the share allows, and no more."""

import numpy as np
import pytest
import torch
from runs import assert_resumes_bit_for_bit, read_log
from tiny import TINY, disc

from pd4dgs_codec.errors import NotFinite
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.rounding import EXACT
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import pruning
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS, Schedule


def test_the_least_go_up_to_the_share():
    harm = torch.tensor([0.5, 0.01, torch.inf, 0.0, 0.02, 0.03], dtype=torch.float64)
    assert pruning.least(harm, 0.03).tolist() == [False, True, False, True, True, False]
    assert pruning.least(harm, 0.0).tolist() == [False, False, False, True, False, False]
    assert not pruning.least(torch.full((3,), torch.inf, dtype=torch.float64), 1.0).any()


UNPRUNED = TrainConfig(preset="tiny", iterations=120, prune=0.0, noise=False)


@pytest.fixture(scope="module")
def finished(once):
    """The checkpoint of a short run without pruning."""
    return once("unpruned", lambda folder: Trainer(UNPRUNED, disc(), size=TINY).run(folder / "m.pt")) / "m.pt"


@pytest.fixture
def trained(dataset, finished):
    """A trainer after that run, and its shots."""
    trainer = Trainer(UNPRUNED, dataset)
    trainer.resume(finished)
    return trainer, trainer.learner.shots


def _pictures(trainer, level: int) -> list[np.ndarray]:
    """Of the training views."""
    return [render_image(trainer.model, level, v.time, v.camera) for v in trainer.dataset.train]


def _difference(pictures, others) -> float:
    return float(np.mean([np.square(a - b).mean() for a, b in zip(pictures, others, strict=True)]))


def _error(trainer, level: int) -> float:
    """Mean squared error over the training views."""
    return _difference(_pictures(trainer, level), [v.image / 255 for v in trainer.dataset.train])


def test_harm_is_the_error_that_an_absence_adds_about(trained):
    trainer, shots = trained
    harm = pruning.relative_harm(trainer.model, 1, shots, EXACT, pruning.anchor_harm).numpy()
    pictures = _pictures(trainer, 1)
    near = np.flatnonzero(np.isfinite(harm) & (harm > 0))
    chosen = near[np.argsort(harm[near])][:: max(1, len(near) // 12)]
    logits = trainer.model.mask_logits.detach().clone()
    added = []
    for row in chosen:
        with torch.no_grad():
            trainer.model.mask_logits[row] = -30.0
        added.append(_difference(_pictures(trainer, 1), pictures))
        with torch.no_grad():
            trainer.model.mask_logits.copy_(logits)
    expected = harm[chosen] * _error(trainer, 1)
    ranks = [np.argsort(np.argsort(x)) for x in (added, expected)]
    assert np.corrcoef(*ranks)[0, 1] > 0.9
    assert 1 / 3 < np.median(expected / added) < 3


def test_pruning_costs_what_it_says_and_keeps_the_masks_above(trained):
    trainer, shots = trained
    model, share = trainer.model, 0.02
    before = [_error(trainer, level) for level in range(3)]
    for turn in range(PRUNING_ROUNDS):
        turns, masks = pruning.turns(model.anchor_q), [model.masks(level).detach() for level in range(3)]
        keep, later = pruning.prune(
            model, trainer.learner.optimiser, shots, range(3), share / PRUNING_ROUNDS, turn, EXACT
        )
        assert 0 < len(model.anchor_q) == len(keep) < len(turns)
        assert torch.isin((turns != turn).nonzero()[:, 0], keep).all()
        for level in (1, 2):
            torch.testing.assert_close(model.masks(level).detach(), masks[level][keep], atol=2e-6, rtol=0)
        left = (model.masks(0) < MASK_THRESHOLD) & (masks[0][keep] >= MASK_THRESHOLD)
        assert int(left.sum()) == later
        torch.testing.assert_close(model.masks(0).detach()[~left], masks[0][keep][~left])
    assert len(model.anchor_q) < 300  # of 600, most of them behind or beside others of the same grey
    for level in range(3):  # estimates from single absences: together they weigh more, level 0 pays twice
        assert _error(trainer, level) < 1.5 * before[level]


def test_a_level_that_is_not_trained_has_no_say(trained):
    trainer, shots = trained
    keep, later = pruning.prune(trainer.model, trainer.learner.optimiser, shots, range(2, 3), 0.05, 0, EXACT)
    assert later == 0 and 0 < len(keep)


def test_every_anchor_has_its_turn():
    cells = torch.cartesian_prod(*[torch.arange(-40, 40, 8)] * 3).int()
    shares = torch.bincount(pruning.turns(cells), minlength=PRUNING_ROUNDS) / len(cells)
    assert len(shares) == PRUNING_ROUNDS and (shares - 1 / PRUNING_ROUNDS).abs().max() < 0.05


def test_a_run_prunes_half_way_and_resumes_with_the_same_bits(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    config = TrainConfig(preset="tiny", iterations=60, prune=0.05)
    whole = Trainer(config, dataset)
    whole.run(tmp_path / "whole.pt", log=tmp_path / "log.jsonl")
    records = read_log(tmp_path / "log.jsonl")
    pruned = [r for r in records if "left_model" in r]
    rounds = list(Schedule(60).prune)
    assert [r["iteration"] for r in pruned] == rounds and sum(r["left_model"] for r in pruned) > 0
    assert records[rounds[0] - 1]["anchors"] - pruned[-1]["anchors"] == sum(r["left_model"] for r in pruned)
    assert_resumes_bit_for_bit(config, dataset, tmp_path, rounds[1:3])


def test_a_round_that_meets_infinity_is_passed_over(dataset, tmp_path, monkeypatch):
    def diverged(*_, **__):
        raise NotFinite("colors: found inf")

    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    monkeypatch.setattr(pruning, "anchor_harm", diverged)
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30, prune=0.5), dataset)
    trainer.run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    assert trainer.iteration == 30 and "left_model" not in (tmp_path / "log.jsonl").read_text()


def test_a_scene_that_needs_no_anchor_keeps_some(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    monkeypatch.setattr(pruning, "relative_harm", lambda model, *_: torch.zeros(len(model.anchor_q)).double())
    trainer = Trainer(TrainConfig(preset="tiny", iterations=40), dataset)
    trainer.run(tmp_path / "m.pt")
    assert 0 < trainer.learner.active_anchors()[0] <= len(trainer.model.anchor_q) < 300


def test_short_runs_are_not_pruned(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=60, prune=0.5), dataset)
    trainer.run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    assert "left_model" not in (tmp_path / "log.jsonl").read_text()
