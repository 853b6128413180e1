"""The step on a scene of a few tiny pictures: levels, terms, what it skips, what it leaves as it is."""

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.train import state
from pd4dgs_codec.train.config import ABLATIONS, TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.optimiser import PER_ANCHOR
from pd4dgs_codec.train.schedule import Schedule
from pd4dgs_codec.train.state import TrainingView


def learner(dataset, iterations: int | None = 30, **config) -> Learner:
    return Learner(TrainConfig(preset="tiny", **config), dataset, Schedule(iterations), torch.device("cpu"))


def test_every_level_is_trained_in_every_step_on_a_view_of_its_own_if_asked(dataset, monkeypatch):
    steps = learner(dataset, 40, rollout="all")
    for _ in range(5):
        record = steps.step()
    assert record["level"] == 2 and record["pi"] == (1.0, 1.0, 1.0)
    loss = Mock(wraps=steps.picture_loss)
    monkeypatch.setattr(steps, "picture_loss", loss)
    steps.step()
    views, levels = zip(*(call.args[:2] for call in loss.call_args_list), strict=True)
    assert levels == (0, 1, 2) and len(set(views)) == 3


def test_the_top_rollout_trains_the_highest_level_alone(dataset):
    steps = learner(dataset, 40, rollout="top")
    assert [steps.step()["level"] for _ in range(8)] == [0] * 4 + [2] * 4


def test_until_n_is_known_steps_stay_in_the_coarse_phase(dataset):
    steps = learner(dataset, None, max_seconds=100.0)
    records = [steps.step() for _ in range(45)]
    assert all(r["level"] == 0 and "rate" not in r and "grown" not in r for r in records)
    assert [r["iteration"] for r in records if "active" in r] == [0]
    assert steps.statistics["anchor_visits"].sum() == 0 and steps.state()["total"] == 0
    steps.schedule = Schedule(60)
    assert "rate" in steps.step()


@pytest.mark.parametrize(
    "part, gone",
    [
        ("rate", {"rate", "global_rate_proxy"}),
        ("planes", {"global_rate_proxy"}),
        ("binary", {"binary"}),
    ],
)
def test_an_ablation_takes_out_its_terms_alone(dataset, part, gone):
    terms = {"rate", "binary", "global_rate_proxy"}
    steps = learner(dataset, 3, rollout="all", **ABLATIONS[part])
    records = [steps.step() for _ in range(3)]
    assert terms & set(records[-1]) == terms - gone


def test_the_planes_rate_joins_with_the_rate_terms_and_grows(dataset):
    """It stands unweighted among the terms; its weight in the loss rises."""
    steps = learner(dataset, plane_rate=1e-3)
    assert not any("rate_proxy" in name for _ in range(10) for name in steps.step())
    shares = []
    for iteration in (11, 15, 25):
        steps.iteration = iteration
        steps.model_loss.config = TrainConfig(preset="tiny", plane_rate=1e-3)
        found = _model_terms(steps)
        steps.model_loss.config = TrainConfig(preset="tiny", plane_rate=0.0)
        rest = _model_terms(steps)
        assert set(found.terms) - set(rest.terms) == {"global_rate_proxy", "local_rate_proxy"}
        bits = found.terms["global_rate_proxy"] + found.terms["local_rate_proxy"]
        shares.append((found.loss - rest.loss) / (1e-3 * bits))
    assert shares == pytest.approx([0.1, 0.5, 1.0], rel=1e-2)


def _model_terms(steps):
    state = steps.generator.get_state()
    found = steps.model_loss.begin(steps.model, 2, steps.schedule, steps.iteration)()
    steps.generator.set_state(state)
    return found


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_step_gathers_the_gradients_of_all_its_terms(dataset, level):
    """They equal those of one graph over the model's own parameters, whichever thread computed them."""
    steps = learner(dataset, 30)
    for _ in range(12):
        steps.step()
    index, state, noise = 0, steps.generator.get_state(), steps.noise.generator.get_state()
    record: dict = {}
    steps._gather(index, level, None, record)
    found = [None if p.grad is None else p.grad.clone() for p in steps.optimiser.parameters]
    steps.optimiser.zero_grad()
    steps.generator.set_state(state)
    steps.noise.generator.set_state(noise)

    _, _, loss = steps.picture_loss(index, level)
    of_model, fields = steps.model_loss, steps.model.deformations
    own, place = {name: getattr(steps.model, name) for name in PER_ANCHOR}, steps.position
    terms = list(of_model._mask_terms(steps.model, level, own, steps.schedule.separation(place)))
    for layer in range(1, level + 1):
        planes, step = fields[layer].planes, steps.model.steps.planes(layer)
        terms += of_model._plane_terms(layer, planes, planes.grid, step, steps.schedule.pressure(place))
    (loss + sum(weight * value for _, weight, value in terms)).backward()
    assert {name for name, _, _ in terms} <= set(record)
    whole = float(loss.detach()) + sum(weight * float(value.detach()) for _, weight, value in terms)
    assert record["loss"] == pytest.approx(whole)
    for parameter, gradient in zip(steps.optimiser.parameters, found, strict=True):
        expected = parameter.grad
        assert (expected is None) == (gradient is None)
        if expected is not None:
            torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-9)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_gpu_learns_what_the_cpu_learns(dataset, device="cuda"):
    pytest.importorskip("gsplat")
    losses = []
    for where in ("cpu", device):
        steps = Learner(TrainConfig(preset="tiny"), dataset, Schedule(30), torch.device(where))
        losses.append([steps.step()["loss"] for _ in range(30)])
    assert losses[1] == pytest.approx(losses[0], rel=0.05)


def test_the_graph_beside_the_picture_s_shares_no_leaf_with_it(dataset, monkeypatch):
    """Two threads whose graphs share one can wait for each other for ever."""
    steps, leaves, grad = learner(dataset, 3), [], torch.autograd.grad

    def watched(loss, *args, **kw):
        left = [loss.grad_fn]
        while left:
            node = left.pop()
            leaves.extend([node.variable] if hasattr(node, "variable") else [])
            left.extend(before for before, _ in node.next_functions if before is not None)
        return grad(loss, *args, **kw)

    monkeypatch.setattr(torch.autograd, "grad", watched)
    steps.model_loss.begin(steps.model, 2, steps.schedule, 2)()
    own = {id(parameter) for parameter in steps.model.parameters()}
    assert leaves and not own & {id(leaf) for leaf in leaves}


def test_a_non_finite_step_is_skipped_and_counted(dataset):
    steps = learner(dataset)
    steps.step()
    with torch.no_grad():
        steps.model.networks["color"].linears[1].bias[:] = math.nan
    before = steps.model.feature.detach().clone()
    record = steps.step()
    assert record["skipped"] == 1 == steps.skipped
    assert torch.equal(before, steps.model.feature.detach())


def test_only_what_is_not_finite_is_skipped(dataset, monkeypatch):
    steps = learner(dataset, 8)
    monkeypatch.setattr(steps, "picture_loss", Mock(side_effect=[NotFinite("colors"), RenderError("no gsplat")]))
    assert steps.step()["refused"] == "colors"
    with pytest.raises(RenderError, match="no gsplat"):
        steps.step()


# -- the pixels of a step ----------------------------------------------------------------------------------------------


def test_large_pictures_are_small_at_first(dataset, monkeypatch):
    """A quarter, then half as wide: means of blocks, before a camera of that size. Other pictures stay whole."""
    monkeypatch.setattr(state, "LARGE", 24)
    steps = learner(dataset, 40, small_pictures=0.5)
    sizes = {}
    for steps.iteration in range(40):
        sizes[steps.iteration] = steps.picture(0).view.width
    assert [sizes[i] for i in (0, 9, 10, 19, 20, 39)] == [8, 8, 16, 16, 32, 32]
    assert learner(dataset, 40, small_pictures=0.0).picture(0).view.width == 32
    steps.iteration = 0
    small, whole = steps.picture(0), steps.views[0]
    blocks = whole.pixels.float().view(6, 4, 8, 4, 3).mean((1, 3))
    assert (small.pixels - blocks).abs().max() <= 0.5 and small.view.camera.height == 6
    assert np.array_equal(small.view.K[:2], whole.view.K[:2] / 4) and small.weights.sum() == pytest.approx(1 / 3)
    monkeypatch.setattr(state, "LARGE", 25)
    assert steps.picture(0).view.width == 32


def test_the_loss_looks_at_what_is_drawn_or_shown(dataset):
    """At all that differs from the background, in the image or the picture, and as far around as two windows reach."""
    image = np.full((90, 80, 3), 90, np.uint8)
    image[30:32, 40, 1] += 1
    view = replace(dataset.train[0], image=image, width=80, height=90)
    shown, alpha = TrainingView.of(view, (90 / 255,) * 3, torch.device("cpu")), torch.zeros(90, 80)
    assert shown.content(alpha) == (slice(20, 42), slice(30, 51))
    alpha[2, 60] = 0.004
    assert shown.content(alpha) == (slice(0, 42), slice(30, 71))
    other = TrainingView.of(view, (0.0, 0.0, 0.0), torch.device("cpu"))
    assert other.image[other.content(alpha)].shape == (90, 80, 3)
