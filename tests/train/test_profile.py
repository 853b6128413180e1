"""tools/profile_training.py: exclusive times, and nothing left behind."""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from profile_training import Stopwatch, rows  # noqa: E402


class Work:
    """A slow outer part around a slow inner one."""

    @staticmethod
    def inner() -> None:
        time.sleep(0.02)

    def outer(self) -> str:
        time.sleep(0.01)
        self.inner()
        return "done"


def test_what_a_part_spends_in_another_counts_there_alone():
    stopwatch, plain = Stopwatch(), dict(vars(Work))
    stopwatch.wrap(Work, "inner", "inside")
    stopwatch.wrap(Work, "outer", "outside")
    assert Work().outer() == "done"
    seconds = stopwatch.take()
    assert seconds["inside"] >= 0.02 and 0.01 <= seconds["outside"] < seconds["inside"] + 0.01
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
