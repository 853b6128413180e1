"""Levels, views and pixels of steps with a key instant."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from runs import trainer_of

from pd4dgs_codec.model.picture import render
from pd4dgs_codec.train import rollout
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.rollout import LOWEST, draw_levels, near_key, next_view, without_motion
from pd4dgs_codec.train.ssim import REACH


def learner(dataset, key: float = 0.5, **config) -> Learner:
    views = replace(dataset, train=dataset.train * 6)
    return trainer_of(views, 1000, key_instant=key, **config).learner


def times(state: Learner, indices: list[int]) -> set[float]:
    return {state.views.views[index].time for index in indices}


def test_the_still_start_sees_views_near_the_key_instant_alone(dataset):
    state = learner(dataset, key=0.0)
    near = near_key(state, list(range(len(state.views))))
    assert max(times(state, near)) < min(view.time for view in state.views.views if view.time not in times(state, near))
    assert draw_levels(state) == ((0,), LOWEST)
    assert {next_view(state, 0) for _ in range(60)} <= set(near)
    assert len({next_view(state, 1) for _ in range(len(state.views))}) > len(near), "level 1 takes every view in turn"


def test_most_steps_train_the_highest_level(dataset):
    state, odds = learner(dataset), (0.15, 0.1, 0.75)
    state.iteration = 500
    drawn = [draw_levels(state) for _ in range(300)]
    assert drawn[0][1] == pytest.approx(odds, abs=1e-3)
    counts = [sum(levels == (level,) for levels, _ in drawn) / 300 for level in range(3)]
    assert counts == pytest.approx(odds, abs=0.1)


def test_level_0_learns_nothing_where_motion_has_changed_the_picture(dataset):
    state = learner(dataset, noise=False)
    state.iteration = 500
    view = state.views[0]
    place = view.view.time, view.view.camera
    image = render(state.model, 0, *place).image
    differs = (image - view.image).abs().amax(-1) >= rollout.STILL_CONTRAST
    assert differs.any() and not differs.all()
    weights = without_motion(state, view, image).weights
    assert torch.equal(weights == 0, differs | (view.weights == 0))
    assert torch.equal(without_motion(state, view, view.image).weights, view.weights)
    state.guided = True  # then the pixels up to REACH away have weight 0, too
    near = np.lib.stride_tricks.sliding_window_view(np.pad(differs.numpy(), REACH), (2 * REACH + 1,) * 2).any((2, 3))
    assert torch.equal(without_motion(state, view, image).weights == 0, torch.from_numpy(near) | (view.weights == 0))
    state.guided = False
    for level, counted in ((0, weights), (2, view.weights)):
        errors = (render(state.model, level, *place).image - view.image).abs() * counted[..., None]
        assert state.picture_loss(0, level)[1]["l1"].item() == pytest.approx(errors.sum().item(), rel=1e-5)


def test_the_first_steps_of_level_0_learn_all_pixels(dataset):
    state = learner(dataset)
    assert without_motion(state, state.views[0], 1 - state.views[0].image) is state.views[0]


def test_other_rollouts_have_no_key_instant(dataset):
    state = learner(dataset, rollout="adaptive")
    assert state.key is None and state.model.global_deformation.key is None
    state.iteration = 500
    assert without_motion(state, state.views[0], 1 - state.views[0].image) is state.views[0]


def test_frozen_anchors_and_networks_neither_move_nor_leave(dataset, short_runs_have_phases):
    start = trainer_of(dataset, 40).model
    start.round_to_steps()
    start.freeze(100)
    before = {name: value.clone() for name, value in start.state_dict().items()}
    trainer = Trainer(TrainConfig(preset="tiny", iterations=40, prune=1.0), dataset, start=start)
    for _ in range(40):
        trainer.learner.step()
    trainer.model.round_to_steps()
    after = trainer.model.state_dict()
    for name, value in before.items():
        if name in ("anchor_q", "feature", "scaling_log", "offset", "mask_logits", "step_class"):
            assert torch.equal(after[name][:100], value[:100]), name
        elif name.startswith("networks") or name == "centre":
            assert torch.equal(after[name], value), name
    assert not torch.equal(after["feature"][100:110], before["feature"][100:110])
