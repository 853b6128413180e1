"""Views picked for measurements are spread over cameras, time and space."""

import numpy as np
import pytest

from pd4dgs_codec.data.view import View, spread


def view(time: float, eye: tuple[float, float, float] = (0, 0, 0), camera: int = 0) -> View:
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, 3] = -np.float32(eye)
    return View(viewmat, np.eye(3, dtype=np.float32), 4, 3, time, np.zeros((3, 4, 3), np.uint8), None, "", camera)


def widest_gap(times: list[float]) -> float:
    return float(np.diff([0.0, *sorted(times), 1.0]).max())


@pytest.mark.parametrize("by_time", [True, False])
def test_every_camera_of_a_rig_is_picked_and_all_of_the_time(by_time):
    """16 cameras at 60 instants: every 30th view would be of two cameras, if sorted by time."""
    pairs = [(camera, k / 59) for k in range(60) for camera in range(16)]
    views = [view(time, (camera, 0, 0), camera) for camera, time in (pairs if by_time else sorted(pairs))]
    picked = spread(views, 32)
    assert sorted(view.camera_id for view in picked) == sorted([*range(16)] * 2)
    assert len({view.camera_id for view in picked[:16]}) == 16
    assert widest_gap([view.time for view in picked]) < 0.2


def test_the_first_half_of_a_path_is_as_wide_as_all_of_it():
    picked = spread([view(k / 199, (np.cos(k / 30), np.sin(k / 30), 0)) for k in range(200)], 32)
    assert len({view.time for view in picked}) == 32
    assert widest_gap([view.time for view in picked]) < 0.08 and widest_gap([v.time for v in picked[:16]]) < 0.15


def test_few_views_are_all_taken_even_if_they_are_alike():
    views = [view(0.5) for _ in range(5)]
    assert {id(v) for v in spread(views, 32)} == {id(v) for v in views} and spread(views, 2)[0] is views[0]
