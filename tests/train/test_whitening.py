"""Mixing the features' channels: pictures stay, and so does the course of the training; bytes fall."""

import numpy as np
import pytest
import torch

from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.model.rounding import EXACT
from pd4dgs_codec.train import pruning
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.whitening import mixing, whiten


def matrix(seed: int, width: int) -> torch.Tensor:
    """float64 [width, width], symmetric, positive, of eigenvalues that span three decades."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(width, width)))
    return torch.from_numpy(axes @ np.diag(np.logspace(-1.5, 1.5, width)) @ axes.T)


def test_mixed_channels_are_harmed_alike_and_tell_nothing_of_each_other():
    harm, covariance = matrix(0, 12), matrix(1, 12)
    mix = mixing(harm, covariance)
    back = torch.linalg.inv(mix)
    felt = back.T @ harm @ back
    assert float(felt.trace()) == pytest.approx(float(harm.trace()))
    felt = (felt / felt.trace() * 12).numpy()
    np.testing.assert_allclose(felt - np.diag(np.diag(felt)), 0, atol=0.5)  # not quite: all have a least harm
    assert np.linalg.cond(felt) < 0.2 * np.linalg.cond(harm)
    spread = (mix @ covariance @ mix.T).numpy()
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0, atol=1e-8 * spread.max())
    assert (np.diff(np.diag(spread)) <= 0).all()


def trained(dataset, iterations: int = 60) -> Trainer:
    trainer = Trainer(TrainConfig(preset="tiny", iterations=iterations, whitening=False), dataset)
    for _ in range(iterations // 2):
        trainer.learner.step()
    return trainer


def whitened(trainer: Trainer) -> None:
    learner = trainer.learner
    whiten(learner.model, learner.optimiser, learner.shots[::4], range(learner.model.level + 1), EXACT)


def test_pictures_stay_and_steps_lead_to_them(dataset):
    """Also through the global head that moves features, once it moves them."""
    trainer = trained(dataset)
    model, view = trainer.model, dataset.test[0]
    head = model.global_deformation.heads["feature"].layers[-1]
    with torch.no_grad():
        head.weight.normal_(0, 0.2, generator=torch.Generator().manual_seed(0))
        head.bias.normal_(0, 0.2, generator=torch.Generator().manual_seed(1))
    before, kept = [render_image(model, i, view.time, view.camera) for i in range(3)], model.feature.detach().clone()
    whitened(trainer)
    assert float((model.feature - kept).detach().abs().max()) > 0.1
    for level, picture in enumerate(before):
        np.testing.assert_allclose(render_image(model, level, view.time, view.camera), picture, atol=2e-3)


def test_gradients_and_their_moments_change_alike(dataset):
    """The mean of the gradients after mixing is what mixed parameters would have had."""
    trainer = trained(dataset)
    model, optimiser = trainer.model, trainer.learner.optimiser
    width = model.widths.feature
    layer = model.network("color").layers[0].weight
    moments = {name: optimiser.moments[p]["exp_avg"].clone() for name, p in (("f", model.feature), ("w", layer))}
    product = (moments["f"] * model.feature.detach()).sum(), (moments["w"] * layer.detach()).sum()
    whitened(trainer)
    after = {name: optimiser.moments[p]["exp_avg"] for name, p in (("f", model.feature), ("w", layer))}
    assert not torch.equal(after["f"], moments["f"])
    torch.testing.assert_close(after["w"][:, width:], moments["w"][:, width:])  # view directions are not mixed
    # <G, X> does not depend on the basis
    torch.testing.assert_close((after["f"] * model.feature.detach()).sum(), product[0], rtol=1e-3, atol=1e-9)
    torch.testing.assert_close((after["w"] * layer.detach()).sum(), product[1], rtol=1e-3, atol=1e-9)
    assert all((optimiser.moments[p]["exp_avg_sq"] >= 0).all() for p in (model.feature, layer))


def test_files_are_smaller_at_the_same_error_of_rounding(dataset):
    trainer = trained(dataset, 120)
    plain = len(encode(to_scene(trainer.model), effort=1, omit="nothing", layers=0))
    whitened(trainer)
    assert len(encode(to_scene(trainer.model), effort=1, omit="nothing", layers=0)) < plain


def test_a_run_mixes_once_where_planes_begin_to_be_rounded(dataset, monkeypatch):
    calls = []
    monkeypatch.setattr(pruning, "MIN_ITERATIONS", 10)
    monkeypatch.setattr("pd4dgs_codec.train.whitening.whiten", lambda *args: calls.append(trainer.iteration))
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30, grading=0.0), dataset)
    for _ in range(30):
        trainer.learner.step()
    assert calls == [20]
