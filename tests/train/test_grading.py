"""Step classes: where they come from, and what training does with them."""

import numpy as np
import pytest
import torch

from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.harm import step_harm
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.quality.train_rate import train_rate_bits
from pd4dgs_codec.scene import ATTRIBUTES, MAX_CLASS
from pd4dgs_codec.train import grading, losses, pruning
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.grading import classes_within
from pd4dgs_codec.train.loop import Trainer


def test_classes_stay_within_their_budget_and_use_it():
    harm = torch.from_numpy(np.random.default_rng(0).lognormal(0, 3, 4000))
    for share in (0.01, 1.0, 30.0):
        classes = classes_within(harm, share * float(harm.sum())).double()
        added = float((harm * (4**classes - 1)).sum() / harm.sum())
        assert 0.97 * share < added <= share
        order = harm.argsort()
        assert (classes[order].diff() <= 0).all(), "the more a step harms, the finer it is"


def test_classes_at_the_edges():
    harm = torch.tensor([0.0, 1.0, torch.inf, 1e-12], dtype=torch.float64)
    assert classes_within(harm, 0.0).tolist() == [MAX_CLASS, 0, 0, 0]
    assert classes_within(harm, 1e30).tolist() == [MAX_CLASS, MAX_CLASS, 0, MAX_CLASS]
    assert classes_within(torch.full((3,), torch.inf, dtype=torch.float64), 1.0).tolist() == [0, 0, 0]


def test_the_harm_of_a_step_is_about_what_rounding_does(dataset):
    """Against pictures of anchors whose attributes are moved at random by up to half a step."""
    model = Trainer(TrainConfig(preset="tiny", iterations=30), dataset).model
    view, generator = dataset.train[2], torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.feature.add_(0.3 * torch.randn(model.feature.shape, generator=generator))
        model.offset.add_(2 * torch.randn(model.offset.shape, generator=generator))  # none in the same place
    harms = [step_harm(model, 1, view.time, view.camera, generator) for _ in range(20)]
    expected = float(sum(harm.sum() for harm, _, _ in harms) / len(harms))
    assert (harms[0][0] >= 0).all() and not harms[0][0][~harms[0][1]].any()
    still, found = render_image(model, 1, view.time, view.camera), []
    values = {name: getattr(model, name).detach().clone() for name in ("feature", "scaling_log", "offset")}
    for _ in range(20):
        with torch.no_grad():
            for name, value in values.items():
                noise = torch.rand(value.shape, generator=generator) - 0.5
                getattr(model, name).copy_(value + noise * getattr(model.steps, name))
        found.append(float(((render_image(model, 1, view.time, view.camera) - still) ** 2).sum()))
    assert np.mean(found) == pytest.approx(expected, rel=0.35)


def test_a_run_grades_its_anchors_once_and_packs_them(dataset, monkeypatch):
    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30, grading=0.5), dataset)
    records = [trainer.learner.step() for _ in range(30)]
    (told,) = [r["step_classes"] for r in records if "step_classes" in r]
    model = trainer.model
    assert sum(told) == len(model.anchor_q) and torch.bincount(model.step_class.long(), minlength=7).tolist() == told
    assert len(set(model.step_class.tolist())) > 1
    model.round_to_steps()
    scene = to_scene(model)
    _, report = encode_with_report(scene, priors="gauss", layers=2, omit="nothing", effort=1)
    for own, row in zip(train_rate_bits(scene), report.layers, strict=True):
        coded = {s.name: s.rate_bits for s in row.streams}
        assert own["attributes"] == pytest.approx(coded.get("attributes", 0.0), rel=0.02)


def test_without_classes_there_are_none(dataset, monkeypatch):
    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30, grading=0.0), dataset)
    assert not any("step_classes" in trainer.learner.step() for _ in range(30))
    assert to_scene(trainer.model).grading is None


def test_a_step_that_diverges_leaves_the_classes_as_they_are(dataset, monkeypatch):
    from pd4dgs_codec.errors import NotFinite

    def refuse(*args):
        raise NotFinite("means")

    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    monkeypatch.setattr(grading, "grade", refuse)
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30, grading=0.5), dataset)
    assert not any("step_classes" in trainer.learner.step() for _ in range(30))


def test_the_rate_is_that_of_each_class_alone(dataset):
    model = Trainer(TrainConfig(preset="tiny", iterations=30), dataset).model
    with torch.no_grad():
        for values in (model.feature, model.scaling_log, model.offset):
            values.normal_(generator=torch.Generator().manual_seed(1))
    rows, anchors = torch.arange(40), {name: getattr(model, name) for name in ATTRIBUTES}
    plain = losses.anchor_bits(model, anchors, rows, rows)
    model.step_class[20:40] = 3
    graded = losses.anchor_bits(model, anchors, rows.flip(0), rows).flip(0)
    first, second = rows[:20], rows[20:]
    torch.testing.assert_close(graded[:20], losses.anchor_bits(model, anchors, first, first))
    assert float((plain[20:] - graded[20:]).detach().mean()) == pytest.approx(3, abs=0.4)
    torch.testing.assert_close(graded[20:], losses.anchor_bits(model, anchors, second, second))
