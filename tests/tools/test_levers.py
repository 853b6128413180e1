"""What the page on levers is made with."""

import pytest
from levers import BEFORE, bjontegaard, levers

from pd4dgs_codec.scene import Steps
from pd4dgs_codec.train.config import TrainConfig


def test_half_the_bytes_at_every_quality_are_minus_half():
    curve = [(100.0, 30.0), (200.0, 33.0), (400.0, 35.0)]
    halved = [(size / 2, db) for size, db in curve]
    assert bjontegaard(halved, curve) == pytest.approx(-0.5)
    assert bjontegaard(curve, halved) == pytest.approx(1.0)
    assert bjontegaard(curve, curve[::-1]) == pytest.approx(0)
    assert bjontegaard([(1.0, 20.0), (2.0, 21.0)], curve) is None


def test_a_lever_alone_changes_what_it_is_called_after():
    default = TrainConfig()
    alone = levers()
    planes, pruning = (TrainConfig(**alone[name]) for name in ("planes' rate and steps", "pruning"))
    assert planes.plane_rate == default.plane_rate > 0 and planes.steps is None and planes.prune == BEFORE["prune"]
    assert pruning.prune == default.prune > BEFORE["prune"] and not pruning.plane_rate and pruning.steps == Steps()
