"""The step on a scene of a few tiny pictures: levels, terms, what it skips, what it leaves as it is."""

import math

import pytest
import torch

from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.model.rounding import EXACT
from pd4dgs_codec.train.config import ABLATIONS, Schedule, TrainConfig
from pd4dgs_codec.train.learner import Learner


def learner(dataset, iterations: int | None = 30, **config) -> Learner:
    return Learner(TrainConfig(preset="tiny", **config), dataset, Schedule(iterations), torch.device("cpu"))


def spied(learner, monkeypatch) -> list[tuple[int, int]]:
    """The (view, level) pairs that the learner computes a loss of from now on."""
    seen, loss = [], learner.loss
    monkeypatch.setattr(learner, "loss", lambda *args, **kw: seen.append(args[:2]) or loss(*args, **kw))
    return seen


def test_every_level_is_trained_in_every_step_on_a_view_of_its_own_if_asked(dataset, monkeypatch):
    steps = learner(dataset, 40, rollout="all")
    for _ in range(5):
        record = steps.step()
    assert record["level"] == 2 and record["pi"] == (1.0, 1.0, 1.0)
    seen = spied(steps, monkeypatch)
    steps.step()
    views, levels = zip(*seen, strict=True)
    assert levels == (0, 1, 2) and len(set(views)) == 3


@pytest.mark.parametrize("iteration", [0, 15])
def test_levels_given_on_purpose_are_trained_and_none_is_drawn(dataset, monkeypatch, iteration):
    steps = learner(dataset)
    steps.step()  # draws the views' order
    steps.iteration = iteration
    seen, state = spied(steps, monkeypatch), steps.generator.get_state()
    monkeypatch.setattr(steps, "_mask_terms", lambda *_: torch.zeros(()))  # they draw too
    for levels in ((2,), (0,), (0, 1)):
        record = steps.step(levels)
        assert record["level"] == levels[-1] and record["pi"] == tuple(float(level in levels) for level in range(3))
    assert [level for _, level in seen] == [2, 0, 0, 1]
    assert torch.equal(state, steps.generator.get_state())


def test_until_n_is_known_steps_stay_in_the_coarse_phase(dataset):
    steps = learner(dataset, None, max_seconds=100.0)
    records = [steps.step() for _ in range(45)]
    assert all(r["level"] == 0 and "rate" not in r and "grown" not in r for r in records)
    assert [r["iteration"] for r in records if "active" in r] == [0]
    assert steps.densifier.anchor_visits.sum() == 0 and steps.state()["total"] == 0
    assert steps.optimiser.rate["feature"] == 7.5e-3
    steps.schedule = Schedule(60)
    assert "rate" in steps.step()


@pytest.mark.parametrize(
    "part, gone",
    [("rate", {"rate"}), ("binary", {"tmc_binary"}), ("smooth", {"tmc_smooth"}), ("tmc", {"tmc_binary", "tmc_smooth"})],
)
def test_an_ablation_takes_out_its_terms_alone(dataset, part, gone):
    terms = {"rate", "tmc_binary", "tmc_smooth"}
    steps = learner(dataset, 3, **ABLATIONS[part])
    records = [steps.step() for _ in range(3)]
    assert terms & set(records[-1]) == terms - gone


def test_the_planes_rate_joins_with_the_rate_terms_and_grows(dataset):
    """Unweighted among the terms, ramped in the loss."""
    steps = learner(dataset, plane_rate=1e-3)
    assert not any("rate_proxy" in name for _ in range(10) for name in steps.step())
    shares = []
    for iteration in (11, 15, 25):
        steps.iteration = iteration
        steps.config = TrainConfig(preset="tiny", plane_rate=1e-3)
        _, terms, loss = _loss(steps)
        steps.config = TrainConfig(preset="tiny", plane_rate=0.0)
        _, without, rest = _loss(steps)
        assert set(terms) - set(without) == {"global_rate_proxy", "local_rate_proxy"}
        bits = float(terms["global_rate_proxy"].detach() + terms["local_rate_proxy"].detach())
        shares.append(float(loss.detach() - rest.detach()) / (1e-3 * bits))
    assert shares == pytest.approx([0.1, 0.5, 1.0], rel=1e-2)


def _loss(steps):
    state = steps.generator.get_state()
    result = steps.loss(0, 2, EXACT, mask_terms=True)
    steps.generator.set_state(state)
    return result


def test_without_planes_they_have_no_rate_and_anchors_do(dataset):
    steps = learner(dataset, 3, **ABLATIONS["planes"])
    names = [name for _ in range(3) for name in steps.step()]
    assert "rate" in names and not any("proxy" in name for name in names)


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

    def refuse(error):
        monkeypatch.setattr(steps, "loss", lambda *_: (_ for _ in ()).throw(error))

    refuse(NotFinite("colors"))
    assert steps.step()["refused"] == "colors"
    refuse(RenderError("no gsplat"))
    with pytest.raises(RenderError, match="no gsplat"):
        steps.step()
