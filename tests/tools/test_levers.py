"""What the page on levers is made with."""

import pytest
from levers import WITHOUT, bjontegaard, gains, levers

from pd4dgs_codec.train.config import TrainConfig


def test_half_the_bytes_at_every_quality_are_minus_half():
    curve = [(100.0, 30.0), (200.0, 33.0), (400.0, 35.0)]
    halved = [(size / 2, db) for size, db in curve]
    assert bjontegaard(halved, curve) == pytest.approx(-0.5)
    assert bjontegaard(curve, halved) == pytest.approx(1.0)
    assert bjontegaard(curve, curve[::-1]) == pytest.approx(0)
    assert bjontegaard([(1.0, 20.0), (2.0, 21.0)], curve) is None


def test_levels_that_one_curve_lacks_are_not_compared():
    before = [[(100, 30.0), (200, 33.0)], [(200, 31.0), (400, 34.0)]]
    after = [[(50, 30.0)], [(100, 31.0), (200, 34.0)]]  # the first was judged to have one level
    whole = bjontegaard([(50, 30.0), (200, 34.0)], [(200, 33.0), (400, 34.0)])
    assert gains({"before": before, "after": after}) == [pytest.approx(-0.5), None, None, whole]


def test_every_lever_alone_is_at_its_default_and_all_others_are_off():
    default, alone = TrainConfig(), {name: TrainConfig(**changes) for name, changes in levers().items()}
    assert alone["all"] == default
    moved = {name: {f for f in WITHOUT if getattr(c, f) != WITHOUT[f]} for name, c in alone.items()}
    assert set.union(*(moved[name] for name in moved if name != "all")) == set(WITHOUT) == moved["all"]
    assert not moved["none"]
    for name, config in alone.items():
        assert all(getattr(config, f) == getattr(default, f) for f in moved[name])
