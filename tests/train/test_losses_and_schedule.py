"""Hand-computed cases of the mask terms, the rollout and the schedule."""

import math

import pytest
import torch

from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.model.masks import level_mask
from pd4dgs_codec.scene import Steps
from pd4dgs_codec.train import losses
from pd4dgs_codec.train.config import COARSENED, DEFAULT_QUALITY, DIAL, TrainConfig, at_quality
from pd4dgs_codec.train.rollout import sample_level, updated_rho
from pd4dgs_codec.train.schedule import Schedule, learning_rate, rollout_probabilities


def test_masks_start_where_the_method_says():
    first, _, last = (level_mask(torch.tensor([[2.0, 0.0, 0.0]]), level) for level in range(3))
    rho = float(last - first)
    assert rho == pytest.approx(1 / (1 + math.exp(-2 - 2 * math.log(2))) - 1 / (1 + math.exp(-2)))
    assert rho == pytest.approx(0.0866, abs=5e-4)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_level_moves_its_own_masks_and_no_other_level_s(level):
    logits = torch.tensor([[2.0, 0.0, 0.0], [-3.0, 1.0, 2.0]], requires_grad=True)
    level_mask(logits, level).sum().backward()
    assert logits.grad is not None
    moved = (logits.grad != 0).all(0)
    assert moved.tolist() == [j == level for j in range(3)]


def test_binary_term_is_the_mean_entropy_in_bits():
    assert float(losses.binary_term(torch.full((5,), 0.5))) == pytest.approx(1.0)
    assert float(losses.binary_term(torch.tensor([0.0, 1.0]))) < 1e-4
    quarter = -(0.25 * math.log2(0.25) + 0.75 * math.log2(0.75))
    assert float(losses.binary_term(torch.tensor([0.25, 0.75]))) == pytest.approx(quarter, rel=1e-5)


def test_binary_term_has_finite_gradients_at_the_ends():
    mask = torch.tensor([0.0, 1.0, 0.5], requires_grad=True)
    losses.binary_term(mask).backward()
    assert torch.isfinite(mask.grad).all()


def test_binary_term_is_differentiated_right():
    mask = torch.rand(30, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    torch.autograd.gradcheck(losses.binary_term, mask)
    outside = torch.tensor([0.0, 1.0, 1e-7], requires_grad=True)
    losses.binary_term(outside).backward()
    assert not outside.grad.any()


def _curve(count: int, side: int = 12) -> losses.Neighbours:
    grid = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = grid[torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))[:count]].int()
    return losses.Neighbours(cells, 4.0)


def test_smooth_term_weighs_differences_by_distance():
    near = losses.Neighbours(torch.tensor([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), 4.0)
    assert near.order.tolist() == [0, 1, 2]
    found = losses.smooth_term(torch.tensor([0.0, 1.0, 0.5]), near, torch.tensor([1, 1, 1]))
    assert float(found) == pytest.approx((math.exp(-1 / 4) + 0.5 * math.exp(-2 / 4)) / 2)
    found = losses.smooth_term(torch.tensor([0.0, 1.0, 0.5]), near, torch.tensor([2, 7, 1]))
    assert float(found) == pytest.approx(0.5 * math.exp(-3 / 4))  # of the pairs that are on the curve


def test_smooth_term_equals_its_plain_form():
    near, generator = _curve(700), torch.Generator().manual_seed(1)
    mask = torch.rand(700, dtype=torch.float64, generator=generator)
    mask[:100] = mask[100:200]  # some do not differ
    away, found = near.draw(generator), []
    assert set(away.tolist()) == set(range(1, 9))
    for form in (losses.smooth_term, losses.smooth_term_reference):
        leaf = mask.clone().requires_grad_()
        value = form(leaf, near, away)
        found.append((value.detach(), *torch.autograd.grad(3 * value, leaf)))
    torch.testing.assert_close(*found)


def test_neighbours_are_near():
    near = _curve(12**3)
    distance = -4 * near.weights[:-8].log()
    assert float(distance.mean()) < 4  # random pairs of this cube are 8 apart on average
    cells = near.anchor_q[near.order].float()
    torch.testing.assert_close(distance[:, 2], (cells[3:-5] - cells[:-8]).norm(dim=1), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1])
def test_no_pairs_without_two_anchors(count):
    near = losses.Neighbours(torch.zeros(count, 3, dtype=torch.int32), 4.0)
    away = near.draw(torch.Generator())
    for form in (losses.smooth_term, losses.smooth_term_reference):
        assert away.shape == (count,) and float(form(torch.ones(count), near, away)) == 0


def test_rollout_probabilities():
    assert rollout_probabilities(0.0) == pytest.approx((1 / 3,) * 3)
    assert rollout_probabilities(1.0) == pytest.approx((0.15, 0.30, 0.55))
    assert sum(rollout_probabilities(0.37)) == pytest.approx(1.0)
    assert updated_rho(0.5, torch.zeros(4), torch.ones(4)) == pytest.approx(0.525)
    assert updated_rho(0.5, torch.ones(0), torch.ones(0)) == pytest.approx(0.475)


def test_levels_follow_their_probabilities_and_never_pass_the_highest():
    generator = torch.Generator().manual_seed(1)
    draws = [sample_level((0.15, 0.30, 0.55), 2, generator) for _ in range(4000)]
    assert [draws.count(level) / 4000 for level in range(3)] == pytest.approx([0.15, 0.30, 0.55], abs=0.03)
    assert {sample_level((0.15, 0.30, 0.55), 1, generator) for _ in range(50)} == {0, 1}


def test_the_schedule_is_the_papers_at_its_own_length():
    s = Schedule(30_000)
    assert (s.progressive, s.warm, s.rho_every, s.coarse_end, s.rounding) == (10_000, 2_000, 200, 3_000, 20_000)
    assert s.grow.start > 500 and s.grow.stop == 15_001
    assert s.phases_not_reached(30_000) == Schedule(4).phases_not_reached(4) == []
    assert s.phases_not_reached(27_000)[0] == "exact rounding of attributes"
    assert s.phases_not_reached(5_000)[0] == "rate and mask terms"


def test_while_n_is_not_known_no_phase_but_the_first_is_in_sight():
    s = Schedule(None)
    assert min(s.coarse_end, s.warm, s.progressive, s.rho_start, s.rounding, s.exact_rounding) == math.inf
    assert not s.grow and not s.prune and s.separation(7) == s.progress(7) == 0.0
    assert s.phases_not_reached(10**9) == Schedule(3_000).phases_not_reached(0)
    assert [i for i in range(500) if i % s.rho_every == 0] == [0]


def test_masks_separate_between_the_rate_terms_and_exact_rounding():
    s = Schedule(3_000)
    assert [s.separation(i) for i in (0, 1_000, 1_850, 2_700, 2_999)] == pytest.approx([0, 0, 0.5, 1, 1])


def test_learning_rates_are_log_linear():
    assert learning_rate((1e-2, 1e-4), 0.5) == pytest.approx(1e-3)
    assert learning_rate((1e-2, 1e-4), 0.5, 0.1) == pytest.approx(1e-3)
    assert learning_rate((1e-2, 1e-2), 0.95, 0.1) == pytest.approx(5e-3) and learning_rate((1, 1), 1.0, 0.1) == 0


@pytest.mark.parametrize(
    "bad",
    [
        {"preset": "huge"},
        {"iterations": 0},
        {"max_seconds": -1.0},
        {"rollout": "greedy"},
        {"seed": -1},
        {"max_layer": 3},
    ],
)
def test_bad_configurations_are_refused(bad):
    with pytest.raises(TrainError, match="must be"):
        TrainConfig(**bad)


def test_the_planes_pressure_rises_from_the_rate_terms_to_rounding():
    s = Schedule(3_000)
    assert [s.pressure(i) for i in (0, 1_000, 1_500, 2_000, 2_999)] == pytest.approx([0, 0, 0.5, 1, 1])
    assert Schedule(None).pressure(7) == 0


def test_the_dial_is_log_linear_and_stands_at_the_defaults():
    default = TrainConfig()
    assert at_quality(DEFAULT_QUALITY) == {name: getattr(default, name) for name in DIAL}
    low, middle, high = (at_quality(q) for q in (20, 50, 80))
    for name in DIAL:
        assert low[name] > middle[name] > high[name] > 0
        assert low[name] * high[name] == pytest.approx(middle[name] ** 2)
    for bad in (-1, 101, math.nan):
        with pytest.raises(TrainError, match="0 to 100"):
            at_quality(bad)


def test_the_step_scale_moves_features_scalings_and_planes_alone():
    steps = Steps()
    moved = TrainConfig(step_scale=2.0).model_steps(steps)
    assert {name for name, value in vars(moved).items() if value != vars(steps)[name]} == set(COARSENED)
    assert all(vars(moved)[name] == 2 * vars(steps)[name] for name in COARSENED)
    assert TrainConfig(step_scale=1.0, steps=Steps(feature=1.0)).model_steps(steps).feature == 1.0
