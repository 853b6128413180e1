"""What moves: start points at the key instant, tracks through all views, and motion that learns them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_bodies import movers
from runs import trainer_of

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.synthetic import parse
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.train.following import bodies_of, followed
from pd4dgs_codec.train.movers import moving_starts

#: A room with a small body that flies through it, seen by a camera that jumps; six cameras around three bodies; a
#: camera that goes around two once.
ROOM, CAMERAS = "synthetic:random?seed=9&frames=40&size=80x80", "synthetic:random?seed=0&frames=20&size=80x80"
AROUND = "synthetic:random?seed=10&frames=40&size=80x80"

REAL = PRESETS["tiny"]  #: before the tests' smaller one takes its place, whose planes cannot hold three bodies' ways


def ways(source: str) -> list[tuple[np.ndarray, float]]:
    """Of each moving body: its places [65, 3] at instants spread evenly, and its size."""
    found = []
    for body in parse(source).bodies():
        poses = [body.pose(t) for t in np.linspace(0, 1, 65)]
        way = np.stack([c for _, c in poses])
        if np.ptp(way, axis=0).max() > 0:
            found.append((way, 2 * float(np.cbrt(abs(np.linalg.det(poses[0][0]))))))
    return found


@pytest.mark.parametrize("source, least", [(ROOM, 0.1), (CAMERAS, 0.9)])
def test_points_of_what_moves_lie_on_it(source, least):
    points = moving_starts(load(source), 0.5).numpy()
    away = [np.linalg.norm(points - way[32], axis=1) / size for way, size in ways(source)]
    assert all((a < 1).sum() >= 8 for a in away)  # each body has some
    assert np.mean(np.min(away, axis=0) < 1) > least


@pytest.mark.parametrize("source", [ROOM, CAMERAS])
def test_bodies_are_followed(source):
    dataset = load(source)
    tracks = followed(dataset, moving_starts(dataset, 0.5), 0.5)
    for way, size in ways(source):
        track = min(tracks, key=lambda track: float((track.points.mean(0) - torch.from_numpy(way[32])).norm()))
        true = np.stack([np.interp(track.times.numpy(), np.linspace(0, 1, 65), way[:, k]) for k in range(3)], 1)
        error = np.linalg.norm(track.offsets.numpy() - (true - way[32]), axis=1)
        assert len(track.times) >= 15 and np.median(error) < 0.5 * size


def test_what_stands_still_has_no_points():
    dataset = load(CAMERAS)
    frozen = {view.camera_id: view for view in dataset.train if view.time == dataset.train[0].time}
    still = tuple(replace(frozen[view.camera_id], time=view.time) for view in dataset.train)
    assert len(moving_starts(replace(dataset, train=still), 0.5)) == 0


def test_points_that_hang_together_are_one_body():
    points = torch.tensor([[0.0, 0, 0], [9.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [9.5, 0, 0], [9.2, 0, 0]])
    colour = torch.tensor([[0.1, 0, 0]] * 5 + [[0.9, 0, 0]])
    assert [rows.tolist() for rows in bodies_of(points, colour, 1.5)] == [[0, 2, 3], [1, 4], [5]]
    assert bodies_of(points[:0], colour[:0], 1.5) == []


def test_motion_knows_where_bodies_are_before_it_sees_a_picture(monkeypatch):
    """Level 0, learnt near the key instant, shows bodies; level 2 then shows them where they are at other times, which
    it learnt from tracks alone. Bodies of this scene were lost before."""
    monkeypatch.setitem(PRESETS, "tiny", REAL)
    dataset = load(CAMERAS)
    learner = trainer_of(dataset, 500, 50).learner
    assert len(learner.tracks) == 3 and learner.opened and not learner.placing
    views = [view for view in dataset.train if abs(view.time - 0.5) > 0.3][::12]
    truth = np.stack([view.image for view in views]) / 255.0
    drawn = [
        np.stack([np.asarray(render_image(learner.model, level, view.time, view.camera)) for view in views])
        for level in (0, 2)
    ]
    for body in movers(CAMERAS, views):
        still, moved = (np.square(image - truth)[body.shown].mean() for image in drawn)
        assert moved < 0.4 * still


def test_where_a_camera_goes_around_all_views_place_the_anchors(monkeypatch):
    """Views near the key instant are from one side there: a model learnt from them alone is flat seen from another."""
    monkeypatch.setitem(PRESETS, "tiny", REAL)
    dataset = load(AROUND)
    far = [view for view in dataset.train if 0.2 < abs(view.time - 0.5) < 0.3]
    errors = []
    for placing in (True, False):
        learner = trainer_of(dataset, 500, 1).learner
        assert learner.tracks and learner.placing
        learner.placing = placing
        taught = [p.detach().clone() for field in learner.model.deformations.values() for p in field.parameters()]
        for _ in range(learner.schedule.coarse_end - 1):
            learner.step()
        now = [p for field in learner.model.deformations.values() for p in field.parameters()]
        assert all(map(torch.equal, taught, now)), "pictures teach the anchors alone"
        drawn = np.stack([np.asarray(render_image(learner.model, 2, view.time, view.camera)) for view in far])
        errors.append(np.square(drawn - np.stack([view.image for view in far]) / 255).mean())
    assert errors[0] < 0.5 * errors[1]
