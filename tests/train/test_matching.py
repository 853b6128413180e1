"""Points of what moves: where they are found, what they attract, and when they guide a run."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from runs import assert_resumes_bit_for_bit, run_saving, trainer_of

from pd4dgs_codec.data import synthetic
from pd4dgs_codec.data.bodies import THINGS, bodies
from pd4dgs_codec.interchange.teacher import load_source
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.quality.image import moving_regions, mpsnr
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.movers import ALIKE
from pd4dgs_codec.train.phases import matching, opening
from pd4dgs_codec.train.phases.matching import Points, attraction, moving_points
from pd4dgs_codec.train.schedule import OPENING_SHARE

WHOLE_TINY = PRESETS["tiny"]  # tests have a smaller one


@pytest.fixture
def short_runs_match(monkeypatch, short_runs_have_phases):
    """Short runs find points, at any depth; time opens at once."""
    monkeypatch.setattr(opening, "_errors_beyond", lambda state: [1.0 - state.opened])
    monkeypatch.setattr(matching, "AMBIGUOUS", 1.0)
    monkeypatch.setattr(matching, "LEAST_FOUND", 0.0)
    monkeypatch.setattr(matching, "ELSEWHERE", 0.0)
    monkeypatch.setattr(matching, "_contrast", lambda places, *_: torch.zeros(places.shape[:2]))


def points(position: list[list[float]], colour: list[list[float]], time: float = 0.25) -> Points:
    return Points(torch.full((len(position),), time), torch.tensor(position), torch.tensor(colour))


def empty_level_0(trainer: Trainer) -> Trainer:
    """Makes its level 0 show the background alone."""
    with torch.no_grad():
        trainer.learner.model.mask_logits[:, 0] = -20
    return trainer


def test_points_lie_on_the_moving_ball(monkeypatch):
    """A ball that no level follows: its points are found from pictures of a camera that jumps."""
    monkeypatch.setattr(matching, "MOST_VIEWS", 60)
    dataset = load_source("synthetic:dart", downscale=1, holdout=8, background=None)
    found, share = moving_points(empty_level_0(trainer_of(dataset)).learner)
    assert share > matching.ELSEWHERE
    (ball,) = bodies("dart", 0)
    centres = np.array([ball.pose(float(t))[1] for t in found.time])
    away = np.linalg.norm(found.position.numpy() - centres, axis=1)
    assert len(torch.unique(found.time)) >= 12
    assert np.median(away) < 0.15 and np.mean(away < 0.3) > 0.9  # the ball's radius is 0.1, it moves 0.1 in a view


def test_a_camera_that_stands_still_shows_no_depth():
    dataset = load_source("synthetic:dart?frames=40&size=48x48", downscale=1, holdout=8, background=None)
    for view in dataset.train:
        view.viewmat[:] = dataset.train[0].viewmat
    assert not len(moving_points(empty_level_0(trainer_of(dataset)).learner)[0].time)


def test_few_points_are_not_trusted(monkeypatch):
    monkeypatch.setattr(matching, "MOST_VIEWS", 30)
    dataset = load_source("synthetic:dart", downscale=1, holdout=8, background=None)
    learner = empty_level_0(trainer_of(dataset)).learner
    counts = []
    for least in (0.0, 1.0):
        monkeypatch.setattr(matching, "LEAST_FOUND", least)
        counts.append(len(moving_points(learner)[0].time))
    assert counts[0] > 0 and counts[1] == 0


def test_views_that_show_nothing_moving_have_no_points(dataset, monkeypatch):
    monkeypatch.setattr(matching, "ALIKE", 2.0)
    found, share = moving_points(trainer_of(dataset).learner)
    assert share == 0 and [value.shape for value in found] == [(0,), (0, 3), (0, 3)]


def test_the_nearest_point_of_similar_colour_attracts(dataset):
    """The deformation learns to move a red point to the red point, past a green one."""
    torch.manual_seed(0)
    learner = trainer_of(dataset).learner
    for field in learner.model.deformations.values():  # fresh planes are constant in time
        field.planes.grid.data += 0.3 * torch.randn_like(field.planes.grid)
    unit = learner.model.deformations[1].unit
    here = points([[0.0, 0.0, 0.0]], [[0.8, 0.1, 0.1]])
    red, green = [0.6 * unit, 0.0, 0.0], [0.1 * unit, 0.0, 0.0]
    there = points([red, green], [[0.75, 0.1, 0.1], [0.1, 0.8, 0.1]])
    optimiser = torch.optim.Adam([p for f in learner.model.deformations.values() for p in f.parameters()], 1e-2)
    first = attraction(learner, 2, here, there)
    assert float(first.detach()) == pytest.approx(0.6, abs=1e-5)
    for _ in range(150):
        optimiser.zero_grad()
        attraction(learner, 2, here, there).backward()
        optimiser.step()
    reached = learner.model.moved_points(here.position, 2, 0.25)[0].detach()
    assert float((reached - torch.tensor(red)).norm()) < 0.05 * unit
    still = learner.model.moved_points(here.position, 2, learner.key)[0].detach()
    assert torch.equal(still, here.position[0])


def test_points_of_other_colours_do_not_attract(dataset):
    learner = trainer_of(dataset).learner
    unit = learner.model.deformations[1].unit
    here, colour = points([[0.0, 0.0, 0.0]], [[0.5, 0.5, 0.5]]), [[0.5, 0.5, 0.5]]
    other = points([[0.3 * unit, 0.0, 0.0]], [[0.5 + 3.1 * ALIKE, 0.5, 0.5]])
    assert float(attraction(learner, 1, here, other).detach()) == 0
    same = points([[3.0 * unit, 0.0, 0.0]], colour)
    assert float(attraction(learner, 1, here, same).detach()) == pytest.approx(3.0, abs=1e-5)


@pytest.mark.usefixtures("short_runs_match")
def test_guided_pictures_of_motion_train_motion_alone(dataset):
    learner = trainer_of(dataset, 60, steps=7).learner
    assert learner.guiding
    for _ in range(8):
        before = learner.snapshot()[0]
        level = learner.step()["level"]
        fields = learner.model.deformations.values()
        deformations = {p for field in fields for p in field.parameters()}
        appearance = {p for field in fields for head in ("feature", "scaling") for p in field.heads[head].parameters()}
        changed = {p for p, value in before.items() if not torch.equal(p, value)}
        assert changed and (changed <= deformations - appearance if level else not changed & deformations)


@pytest.mark.usefixtures("short_runs_match")
def test_attributes_learn_from_motion_where_much_stands_still(dataset, monkeypatch):
    monkeypatch.setattr(matching, "ELSEWHERE", 1e9)
    learner = trainer_of(dataset, 60, steps=7).learner
    assert len(learner.match.points.time) and not learner.guiding


@pytest.mark.usefixtures("short_runs_match")
def test_points_are_drawn_without_the_numbers_of_the_other_thread(dataset):
    learner = trainer_of(dataset, 60, steps=7).learner
    before, noise = learner.generator.get_state(), learner.noise.generator.get_state()
    assert learner.match.term(learner, 1) is not None
    assert torch.equal(learner.generator.get_state(), before)
    assert not torch.equal(learner.noise.generator.get_state(), noise)


@pytest.mark.usefixtures("short_runs_match")
def test_steady_motion_needs_no_points(dataset, monkeypatch):
    monkeypatch.setattr(opening, "_errors_beyond", lambda state: [float(state.opened)])
    assert not len(trainer_of(dataset, 60, steps=8).learner.match.points.time)


@pytest.mark.usefixtures("short_runs_match")
def test_points_guide_higher_levels_until_their_term_ends_and_the_run_resumes_bit_for_bit(dataset, tmp_path):
    config = TrainConfig(preset="tiny", iterations=40, seed=3)
    trainer = Trainer(config, dataset)
    records = run_saving(trainer, tmp_path, (9,))  # before the term ends
    assert sum(record.get("moving_points", 0) for record in records)
    with_it, end = {r["iteration"] for r in records if "match" in r}, OPENING_SHARE * 40
    assert with_it == {r["iteration"] for r in records if r["level"] and r["iteration"] < end} != set()
    assert not len(trainer.learner.match.points.time) and not trainer.learner.guiding
    assert_resumes_bit_for_bit(config, dataset, tmp_path, (9,))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("slowness", [2, 5])
def test_a_small_ball_alone_on_white_is_followed(monkeypatch, tmp_path, slowness, seed):
    """It flies as in dart, `slowness` times as slowly. A white picture has 17.4 to 18 dB in its moving region."""
    (ball,) = THINGS["dart"]
    monkeypatch.setitem(THINGS, "dart", (replace(ball, at=lambda t: ball.at(t / slowness)),))
    synthetic._dataset.cache_clear()  # of pictures of the ball at its own speed
    dataset = load_source("synthetic:dart", downscale=1, holdout=8, background=None)
    synthetic._dataset.cache_clear()
    trainer = Trainer(TrainConfig(preset="tiny", iterations=1500, seed=seed), dataset, size=WHOLE_TINY)
    trainer.run(tmp_path / "m.pt")
    model, moving = trainer.model, moving_regions(dataset.test)
    scores = [mpsnr(render_image(model, model.level, v.time, v.camera), v.image, mask) for v, mask in moving.items()]
    assert np.mean(scores) > 22
