"""Exposures of several cameras: trained apart from the model, kept in checkpoints, none with one camera."""

import dataclasses

import numpy as np
import pytest
import torch

from pd4dgs_codec.data import dataset
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.schedule import Schedule

CONFIG = TrainConfig(preset="tiny", iterations=60)


def learner(cameras, gain=1.0):
    """A run on a still scene whose views are spread over `cameras`; the pictures of camera 1 are `gain` as bright."""
    given = dataset.load("synthetic:static?size=40x30&frames=24&path=jump")
    views = tuple(
        dataclasses.replace(
            view, camera_id=i % cameras, image=(view.image * (gain if i % cameras == 1 else 1)).astype(np.uint8)
        )
        for i, view in enumerate(given.train)
    )
    return Learner(CONFIG, dataclasses.replace(given, train=views), Schedule(60), torch.device("cpu"))


def test_a_single_camera_has_no_exposure():
    run = learner(1)
    assert not run.views.exposures and "exposure" not in run.optimiser.groups and run.views[0].exposure is None


def test_a_darker_camera_gets_a_darker_exposure_and_the_mean_stays_zero():
    run = learner(3, gain=0.7)
    for _ in range(60):
        run.step()
    found = {camera: exposure.detach() for camera, exposure in run.views.exposures.items()}
    torch.testing.assert_close(sum(found.values()), torch.zeros(2, 3), rtol=0, atol=1e-6)
    image = torch.full((1, 1, 3), 0.6)
    shown = [float(run.views[i].exposed(image).detach().mean()) for i in range(3)]
    assert shown[1] < 0.57 and min(shown[0], shown[2]) > 0.6


def test_a_resumed_run_has_the_same_exposures():
    run, again = learner(3, gain=0.7), learner(3, gain=0.7)
    for _ in range(5):
        run.step()
    state = run.state()
    again.restore(run.model, state)
    for camera, exposure in run.views.exposures.items():
        assert torch.equal(again.views.exposures[camera], exposure) and exposure.abs().sum() > 0
    for broken, error in (
        ({0: state["exposures"][0]}, KeyError),
        (dict.fromkeys(range(3), torch.zeros(3)), ValueError),
    ):
        with pytest.raises(error):
            learner(3).restore(run.model, state | {"exposures": broken})


def test_spread_views_are_of_all_cameras_though_listed_by_instant_and_camera():
    run = learner(4)
    for turn in range(3):
        views = run.views.spread(6, turn=turn)
        assert {view.view.camera_id for view in views} == {0, 1, 2, 3} and len({view.view.name for view in views}) == 6
    alone = learner(1)
    names = [view.name for view in alone.views.views]
    for turn in (0, 1, 5):
        assert [view.view.name for view in alone.views.spread(6, turn=turn)] == names[turn % 4 :: 4]
        assert [view.view.name for view in alone.views.spread(6, range(12), turn)] == names[turn % 2 : 12 : 2]
