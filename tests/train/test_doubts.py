"""What a finished run warns of: pictures worse than their mean, and levels that lack what level 0 shows."""

import dataclasses

import numpy as np
import pytest
import torch
from runs import trainer_of

from pd4dgs_codec.quality.image import mean_image_baseline
from pd4dgs_codec.train.doubts import doubts


@pytest.fixture
def trained(dataset, tmp_path):
    trainer = trainer_of(dataset, 200)
    trainer.run(tmp_path / "m.pt")
    return trainer


def test_a_level_whose_motion_throws_an_object_away_is_told_with_its_place(trained):
    views, psnr = trained.dataset.test, [40.0] * 3
    assert doubts(trained.learner, views, psnr) == []
    with torch.no_grad():
        for parameter in trained.model.local_deformation.heads["position"].parameters():
            parameter.copy_(torch.full_like(parameter, 30.0))
    (told,) = doubts(trained.learner, views, psnr)
    assert told.startswith("level 2 lacks what level 0 shows around pixel (") and "level 0 " in told
    name = told.partition(" of ")[2].partition(":")[0]
    view = next(view for view in trained.dataset.train if view.name == name)
    column, row = (int(v) for v in told.partition("(")[2].partition(")")[0].split(", "))
    assert 0 <= column < view.width and 0 <= row < view.height and "longer training" in told


def test_held_out_pictures_below_the_mean_picture_are_told(trained):
    mean = mean_image_baseline(trained.dataset.train, trained.dataset.test)
    (told,) = doubts(trained.learner, trained.dataset.test, [mean - 0.1, mean - 3, mean - 2])
    assert f"{mean - 0.1:.2f} dB on held-out views" in told and f"{mean:.2f} dB" in told and "axes" in told
    assert doubts(trained.learner, trained.dataset.test, [mean - 3, mean + 0.1, mean - 3]) == []


@pytest.mark.filterwarnings("error")
def test_arrays_that_cannot_be_written_raise_no_warning_of_torch(dataset):
    """Torch warns of each such array, once a process."""

    def locked(array):
        array = np.array(array)
        array.flags.writeable = False
        return array

    def view_of(view):
        parts = {name: locked(getattr(view, name)) for name in ("image", "viewmat", "K")}
        return dataclasses.replace(view, **parts, mask=locked(np.ones(view.image.shape[:2], bool)))

    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    try:
        points = locked(np.random.default_rng(0).uniform(*dataset.box, (50, 3)).astype(np.float32))
        for own in (points, None):
            train = tuple(map(view_of, dataset.train))
            given = dataclasses.replace(dataset, train=train, points=own, box=locked(dataset.box))
            trainer_of(given, 30, steps=25)
            trainer_of(dataclasses.replace(given, background=(1.0, 0.0, 0.0)), 30, steps=1)
    finally:
        torch.set_warn_always(before)
