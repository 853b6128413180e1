"""tools/profile_training.py: exclusive times that add up, of the levels that they are said to be of."""

import time

import pytest
import torch
from pages import parts
from pages.parts import Stopwatch
from profile_training import measure, rows

from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.schedule import Schedule


class Work:
    """An outer part around an inner one, on a clock that moves as they say."""

    now = 0.0

    @staticmethod
    def inner() -> None:
        Work.now += 5.0

    def outer(self) -> str:
        Work.now += 2.0
        self.inner()
        return "done"


@pytest.fixture
def clock(monkeypatch):
    """The stopwatch reads Work.now."""
    monkeypatch.setattr(parts.time, "process_time", lambda: Work.now)


def test_what_a_part_spends_in_another_counts_there_alone(clock):
    stopwatch, plain = Stopwatch(), dict(vars(Work)) | {"now": Work.now + 7.0}
    stopwatch.wrap(Work, "inner", "inside")
    stopwatch.wrap(Work, "outer", "outside")
    assert Work().outer() == "done"
    assert stopwatch.take() == {"inside": 5.0, "outside": 2.0}
    assert stopwatch.take() == {}
    stopwatch.unwrap()
    assert dict(vars(Work)) == plain
    Work().outer()
    assert stopwatch.take() == {}


def test_an_object_gets_its_own_class_back():
    thing, stopwatch = Work(), Stopwatch()
    stopwatch.wrap(thing, "outer", "outside")
    assert "outer" in vars(thing)
    stopwatch.unwrap()
    assert vars(thing) == {}


def test_rows_are_medians_the_costliest_first():
    step = [{"a": 0.001, "b": 0.004}, {"a": 0.002}, {"a": 0.003, "b": 0.004}]
    assert rows([step]) == [("b", [4.0]), ("a", [2.0]), ("whole step", [5.0])]


@pytest.fixture
def learner(dataset) -> Learner:
    return Learner(TrainConfig(preset="tiny"), dataset, Schedule(100), torch.device("cpu"))


def test_each_column_is_of_its_level(learner, monkeypatch):
    seen, loss = [], learner.picture_loss
    monkeypatch.setattr(
        learner, "picture_loss", lambda index, level, *rest: seen.append(level) or loss(index, level, *rest)
    )
    found = measure(learner, 2, 55)
    assert seen == [0, 1, 2] * 3  # one turn warms up
    fields = [{part.split()[0] for part in step if "deformation" in part} for level in found for step in level]
    assert fields == [set()] * 2 + [{"global"}] * 2 + [{"global", "local"}] * 2
    assert all("rate term" in step and "Adam" in step for level in found for step in level)
    assert "step" not in vars(learner) and learner.iteration == 56


def test_the_parts_add_up_to_the_step(learner, monkeypatch):
    """On a clock that ticks at each look: what the parts leave out would be missing from the sum."""
    ticks, whole = iter(range(10**9)), []
    monkeypatch.setattr(parts.time, "process_time", lambda: float(next(ticks)))
    step = learner.step

    def timed(levels):
        before = next(ticks)
        step(levels)
        whole.append(next(ticks) - before)

    monkeypatch.setattr(learner, "step", timed)
    found = measure(learner, 2, 55)
    # the step's own two looks lie just outside `timed`
    assert [sum(step.values()) for turn in zip(*found, strict=True) for step in turn] == [w + 2 for w in whole[3:]]


@pytest.mark.slow
def test_a_profiled_step_takes_about_what_a_step_takes(learner):
    """Wide, for the machine has other things to do."""
    measured = [column for column in rows(measure(learner, 15, 55)) if column[0] == "whole step"][0][1]
    plain = []
    for level in range(3):
        times = []
        for _ in range(15):
            learner.iteration = 55
            before = time.process_time()
            learner.step((level,))
            times.append(1e3 * (time.process_time() - before))
        plain.append(sorted(times)[7])
    assert all(0.4 < a / b < 2.5 for a, b in zip(measured, plain, strict=True)), (measured, plain)
