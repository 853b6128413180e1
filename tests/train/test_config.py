"""Options of training, the schedule that follows from them, and configurations as checkpoints store them."""

import json
import math
from dataclasses import replace

import pytest
import torch

from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.scene import Steps
from pd4dgs_codec.train.config import ABLATIONS, COARSENED, DIAL, SHORT_RUN, LearningRates, TrainConfig, at_quality
from pd4dgs_codec.train.optimiser import learning_rate
from pd4dgs_codec.train.rollout import rollout_probabilities, updated_rho
from pd4dgs_codec.train.schedule import Schedule


@pytest.mark.parametrize(
    "bad, message",
    [
        ({"preset": "huge"}, "preset must be one of tiny, small, paper, found huge"),
        ({"iterations": 0}, "iterations must be from 1 to 2e[+]09, found 0"),
        ({"max_seconds": 0.0}, "max_seconds must be more than 0, found 0.0"),
        ({"rollout": "greedy"}, "rollout must be one of key"),
        ({"seed": -1}, "seed must be from 0"),
        ({"max_layer": 3}, "max_layer must be one of 0, 1, 2, found 3"),
        ({"prune": 1.5}, "prune must be from 0 to 1, found 1.5"),
        ({"rate_scale": math.inf}, "rate_scale must be at least 0, found inf"),
        ({"background": (0.0, 2.0, 0.0)}, "background must be from 0 to 1, found"),
        ({"background": (0.0, 1.0)}, "background must be from 0 to 1, found"),
        ({"grading": math.nan}, "grading must be from 0 to 1, found nan"),
    ],
)
def test_options_out_of_range_are_refused(bad, message):
    with pytest.raises(TrainError, match=message):
        TrainConfig(**bad)


def test_a_stored_configuration_comes_back():
    config = TrainConfig(iterations=7, background=(0.0, 0.5, 1.0), **ABLATIONS["binary"])
    assert TrainConfig.from_json(config.to_json(), "m.pt") == config
    for broken in ("[", "[]", '{"colour": 1}', '{"iterations": [5]}', '{"background": [0, "a", 1]}'):
        with pytest.raises(TrainError, match="m.pt: its stored configuration"):
            TrainConfig.from_json(broken, "m.pt")


def test_the_dial_is_log_linear_and_stands_at_the_defaults():
    default = TrainConfig()
    assert at_quality(50) == {name: getattr(default, name) for name in DIAL}
    low, middle, high = (at_quality(q) for q in (20, 50, 80))
    for name in DIAL:
        assert low[name] > middle[name] > high[name] > 0
        assert low[name] * high[name] == pytest.approx(middle[name] ** 2)
    for bad in (-1, 101, math.nan):
        with pytest.raises(TrainError, match="0 to 100"):
            at_quality(bad)


def test_the_step_scale_moves_features_scalings_and_planes_only():
    steps = Steps()
    moved = TrainConfig(step_scale=2.0).model_steps(steps)
    assert {name for name, value in vars(moved).items() if value != vars(steps)[name]} == set(COARSENED)
    assert all(vars(moved)[name] == 2 * vars(steps)[name] for name in COARSENED)


def test_the_schedule_is_the_papers_at_its_own_length():
    s = Schedule(30_000)
    assert (s.progressive, s.rho_every, s.coarse_end, s.rounding) == (10_000, 300, 3_000, 20_000)
    assert s.grow.start > 500 and s.grow.stop == 15_001
    assert s.phases_not_reached(30_000) == Schedule(4).phases_not_reached(4) == []
    assert s.phases_not_reached(27_000)[0] == "exact rounding of attributes"
    assert s.phases_not_reached(5_000)[0] == "rate and mask terms"


def test_until_its_length_is_known_a_run_stays_in_its_first_phase():
    s = Schedule(None)
    assert min(s.coarse_end, s.progressive, s.rounding, s.exact_rounding) == math.inf
    assert not s.grow and not s.prune and s.separation(7) == s.pressure(7) == s.progress(7) == 0.0
    assert s.phases_not_reached(10**9) == Schedule(3_000).phases_not_reached(0)
    assert [i for i in range(500) if i % s.rho_every == 0] == [0]


def test_ramps_rise_from_the_rate_terms_to_rounding():
    s = Schedule(3_000)
    assert [s.separation(i) for i in (0, 1_000, 1_850, 2_700, 2_999)] == pytest.approx([0, 0, 0.5, 1, 1])
    assert [s.pressure(i) for i in (0, 1_000, 1_500, 2_000, 2_999)] == pytest.approx([0, 0, 0.5, 1, 1])


def test_learning_rates_are_log_linear():
    assert learning_rate((1e-2, 1e-4), 0.5) == pytest.approx(1e-3)
    assert learning_rate((1e-2, 1e-4), 0.5, 0.1) == pytest.approx(1e-3)
    assert learning_rate((1e-2, 1e-2), 0.95, 0.1) == pytest.approx(5e-3) and learning_rate((1, 1), 1.0, 0.1) == 0


def test_the_deformation_of_a_long_run_ends_at_lower_rates():
    rates = LearningRates()
    assert rates.of_run(None) == rates.of_run(800) == rates
    long = rates.of_run(4 * SHORT_RUN)
    assert long.planes == pytest.approx((rates.planes[0] / 2, rates.planes[1] / 4))
    assert long.deformation == pytest.approx((rates.deformation[0], rates.deformation[1] / 4))
    assert replace(long, planes=rates.planes, deformation=rates.deformation) == rates


def test_rollout_probabilities():
    assert rollout_probabilities(0.0) == pytest.approx((1 / 3,) * 3)
    assert rollout_probabilities(1.0) == pytest.approx((0.15, 0.30, 0.55))
    assert sum(rollout_probabilities(0.37)) == pytest.approx(1.0)
    assert updated_rho(0.5, torch.zeros(4), torch.ones(4)) == pytest.approx(0.525)
    assert updated_rho(0.5, torch.ones(0), torch.ones(0)) == pytest.approx(0.475)


@pytest.mark.parametrize("name", ["seed", "iterations", "ssim", "source", "lambdas", "rates", "background", "noise"])
@pytest.mark.parametrize("value", [True, [1, [2]], {}, 10**400, math.nan, "x" * 9, None])
def test_a_stored_configuration_is_read_or_refused_in_one_line(name, value):
    text = json.dumps(json.loads(TrainConfig().to_json()) | {name: value})
    try:
        found = TrainConfig.from_json(text, "m.pt")
    except TrainError as error:
        assert str(error).startswith("m.pt: ") or name in str(error)
        assert "\n" not in str(error) and len(str(error)) < 400
    else:
        allowed = [("noise", True), ("iterations", None), ("background", None), ("source", "x" * 9), ("rates", {})]
        assert (name, value) in allowed and getattr(found, name) == (value if name != "rates" else LearningRates())
