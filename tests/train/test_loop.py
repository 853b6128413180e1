"""Runs on a scene of a few tiny pictures: they learn, resume bit for bit, end on time and leave whole checkpoints."""

import dataclasses
import json
import math
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from runs import assert_goes_on_as_one_run, interrupt, records_of, trainer_of

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import to_scene
from pd4dgs_codec.train import loop, phases
from pd4dgs_codec.train.config import ABLATIONS, TrainConfig
from pd4dgs_codec.train.loop import RecordLog, Trainer
from pd4dgs_codec.train.phases.prune import Prune
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS, Schedule


def test_it_learns_and_logs_every_term(dataset, tmp_path):
    records = records_of(trainer_of(dataset, 90), tmp_path)
    assert [r["iteration"] for r in records] == list(range(90))
    assert np.mean([r["l1"] for r in records[-10:]]) < 0.6 * np.mean([r["l1"] for r in records[:5]])
    assert {"l1", "dssim", "volume", "rate", "binary", "rho", "pi", "anchors"} <= set(records[-1])
    assert all(r["level"] == 0 for r in records[: Schedule(90).coarse_end])
    assert {r["level"] for r in records} == {0, 1, 2}
    assert "rate" not in records[Schedule(90).progressive - 1] and "rate" in records[Schedule(90).progressive]
    assert records[-1]["rho"] > 0
    assert any("held_out_psnr" in r for r in records)


@pytest.mark.parametrize("max_layer", [0, 1])
def test_a_model_without_upper_layers_is_packed_as_it_was_trained(dataset, tmp_path, max_layer):
    trainer_of(dataset, 40, max_layer=max_layer).run(tmp_path / "m.pt")
    model = checkpoint.load(tmp_path / "m.pt")[0]
    assert model.level == max_layer
    seen = {(view.time, view.viewmat.tobytes()) for view in dataset.train}
    remembered = checkpoint.load(tmp_path / "m.pt")[1]["viewpoints"]
    assert len(remembered) == min(32, len(seen)) and {(t, c.viewmat.tobytes()) for c, t in remembered} <= seen
    own = [float((model.masks(level) - model.masks(level - 1)).detach().max()) > 1e-6 for level in (1, 2)]
    assert own == [max_layer >= 1, False], "absent levels have masks of their own"
    scene = decode(encode(to_scene(model), effort=1))
    assert scene.level <= max_layer


@pytest.mark.parametrize("options, off_grid", [({}, 0.0), (ABLATIONS["noise"], 0.5)])
def test_a_finished_checkpoint_is_rounded_unless_without_quantisation(dataset, tmp_path, options, off_grid):
    trainer_of(dataset, 20, **options).run(tmp_path / "m.pt")
    model = checkpoint.load(tmp_path / "m.pt")[0]
    weights = model.networks["color"].linears[0].weight.detach()
    rest = (weights / model.steps.weights_scaffold).frac().abs()
    share = float(((rest > 0.001) & (rest < 0.999)).float().mean())
    assert share > off_grid or share == off_grid == 0


def test_another_seed_gives_another_model(dataset):
    a, b = (trainer_of(dataset, steps=12, seed=seed).model for seed in (0, 1))
    assert not torch.equal(a.feature[:10], b.feature[:10])


class Clock:
    """Time that passes only when it is told to."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    """The clock of runs from now on."""
    monkeypatch.setattr(loop, "time", Clock())
    return loop.time


LIMIT = 18.0
COST = (0.1, 0.2, 0.3)  #: seconds of a step at each level
#: What else the machine does: factor on the cost of a step that begins at `seconds`, and a pause within it.
MACHINES = {
    "quiet": lambda seconds: (1, 0.0),
    "slow in the middle": lambda seconds: (5 if 0.4 * LIMIT < seconds < 0.6 * LIMIT else 1, 0.0),
    "fast from the middle on": lambda seconds: (0.5 if 0.5 * LIMIT < seconds else 1, 0.0),
    "stopped": lambda seconds: (1, 0.25 * LIMIT if 0.3 * LIMIT < seconds < 0.35 * LIMIT else 0.0),
}


def timed(dataset, monkeypatch, clock, machine, limit: float = LIMIT) -> Trainer:
    """A timed run whose steps and evaluations take the clock's time, and which is never too short to prune."""
    monkeypatch.setattr(loop, "TIMED_STEPS", 6)
    monkeypatch.setattr(phases, "MIN_ITERATIONS", 0)
    trainer = trainer_of(dataset, None, max_seconds=limit)
    step, level_psnr, begun = trainer.learner.step, trainer.learner.level_psnr, clock.now

    def slow_step():
        factor, pause = MACHINES[machine](clock.now - begun)
        record = step()
        clock.now += factor * COST[record["level"]] + pause
        return record

    def slow_evaluation(views):
        clock.now += 0.1
        return level_psnr(views)

    monkeypatch.setattr(trainer.learner, "step", slow_step)
    monkeypatch.setattr(trainer.learner, "level_psnr", slow_evaluation)
    return trainer


@pytest.mark.parametrize("machine", MACHINES)
def test_a_time_limit_is_kept_and_the_schedule_completes(dataset, tmp_path, monkeypatch, clock, machine):
    turns, apply = [], Prune.apply
    monkeypatch.setattr(Prune, "apply", lambda self, *args: turns.append(self.turn) or apply(self, *args))
    trainer, begun = timed(dataset, monkeypatch, clock, machine), clock.now
    records = records_of(trainer, tmp_path)
    assert trainer.seconds == pytest.approx(clock.now - begun) == pytest.approx(LIMIT, rel=0.03)
    assert trainer.finished and turns == list(range(PRUNING_ROUNDS))
    schedule, stored = trainer.learner.schedule, checkpoint.load(tmp_path / "m.pt")[1]
    position = trainer.learner.position
    assert position == schedule.iterations and schedule.phases_not_reached(position) == []
    assert json.loads(stored["config"])["iterations"] is None
    coarse = [r["seconds"] for r in records if r["level"] == 0 and "rate" not in r]
    assert {r["level"] for r in records} == {0, 1, 2} and any("grown" in r for r in records)
    assert max(coarse) < (0.5 if machine == "stopped" else 0.4) * LIMIT  # the rate term begins at a third
    assert schedule.progress(records[-1]["position"]) > 0.8  # the cooldown, ten steps long, went on to its end
    assert len(trainer.curve) >= 0.75 * loop.CURVE_POINTS  # a pause passes some over


def test_a_resumed_timed_run_spends_what_is_left(dataset, tmp_path, monkeypatch, clock):
    limit = 1.5 * LIMIT
    first = timed(dataset, monkeypatch, clock, "quiet")
    interrupt(first, signal.SIGINT, lambda: first.seconds > 0.5 * LIMIT)
    first.run(tmp_path / "m.pt")
    assert first.interrupted and 0.5 * LIMIT < first.seconds < 0.6 * LIMIT
    clock.now += 1e4  # between the runs
    second = timed(dataset, monkeypatch, clock, "quiet", limit)
    second.resume(tmp_path / "m.pt")
    assert second.learner.share == first.learner.share and second.total == first.total
    begun = clock.now
    records = records_of(second, tmp_path, "n.pt")
    assert second.finished and second.seconds == pytest.approx(limit, rel=0.03)
    assert second.seconds - first.seconds == pytest.approx(clock.now - begun)
    positions = [r["position"] for r in records]
    assert positions == sorted(positions) and positions[0] == first.learner.position


def test_the_first_step_after_a_resumption_does_not_set_n(dataset, tmp_path, monkeypatch, clock):
    """It compiles kernels, as the very first step does."""
    first = timed(dataset, monkeypatch, clock, "quiet")
    interrupt(first, signal.SIGINT, lambda: first.iteration == 3)
    first.run(tmp_path / "m.pt")
    assert first.iteration == 4 and first.total is None
    second = timed(dataset, monkeypatch, clock, "quiet")
    second.resume(tmp_path / "m.pt")
    step = second.learner.step

    def compiling():
        clock.now += 0.2 * LIMIT if second.iteration == first.iteration else 0.0
        return step()

    monkeypatch.setattr(second.learner, "step", compiling)
    interrupt(second, signal.SIGINT, lambda: second.total is not None)
    second.run(tmp_path / "m.pt")
    assert second.total == pytest.approx(LIMIT / (loop.LATER_COST * COST[0]), rel=0.01)


def test_a_pause_beyond_the_limit_leaves_a_cut_run_that_says_so(dataset, tmp_path, monkeypatch, clock):
    trainer = timed(dataset, monkeypatch, clock, "quiet")
    step = trainer.learner.step

    def stopped():
        clock.now += LIMIT if trainer.seconds > 0.5 * LIMIT else 0.0
        return step()

    monkeypatch.setattr(trainer.learner, "step", stopped)
    trainer.run(tmp_path / "m.pt")
    assert not trainer.finished
    assert "exact rounding of attributes" in trainer.learner.schedule.phases_not_reached(trainer.learner.position)


@pytest.mark.parametrize("iterations, limit, done", [(30, 5.5, 6), (None, 0.5, 1)])
def test_a_run_cut_at_its_limit_leaves_a_checkpoint(dataset, tmp_path, monkeypatch, clock, iterations, limit, done):
    trainer = trainer_of(dataset, iterations, max_seconds=limit)
    step = trainer.learner.step
    monkeypatch.setattr(trainer.learner, "step", lambda: setattr(clock, "now", clock.now + 1) or step())
    trainer.run(tmp_path / "m.pt")
    assert (trainer.iteration, trainer.total, trainer.seconds) == (done, iterations, done)
    assert not (trainer.finished or trainer.interrupted) and trainer.learner.schedule.phases_not_reached(done)
    assert checkpoint.load(tmp_path / "m.pt")[1]["iteration"] == done


def test_a_time_limit_ends_a_trial(dataset, tmp_path, monkeypatch, clock):
    trainer = trainer_of(dataset, 30, max_seconds=5.5)

    def practise():
        for done in range(100):
            trainer.learner.before_practice(done, 100)
            clock.now += 1

    monkeypatch.setattr(trainer.learner, "step", practise)
    trainer.run(tmp_path / "m.pt")
    assert (trainer.iteration, trainer.seconds) == (0, 6) and not (trainer.finished or trainer.interrupted)
    assert checkpoint.load(tmp_path / "m.pt")[1]["seconds"] == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_ends_the_run_after_a_whole_step(dataset, tmp_path, number):
    config = TrainConfig(preset="tiny", iterations=8)
    trainer = Trainer(config, dataset)
    before = signal.getsignal(number)
    interrupt(trainer, number, lambda: trainer.iteration == 2)
    trainer.run(tmp_path / "m.pt")
    assert trainer.interrupted and trainer.iteration == 3 == checkpoint.load(tmp_path / "m.pt")[1]["iteration"]
    assert signal.getsignal(number) is before
    assert_goes_on_as_one_run(config, dataset, tmp_path / "m.pt")


def test_a_second_signal_ends_it_at_once_and_saves_nothing(dataset, tmp_path, monkeypatch):
    trainer = trainer_of(dataset, 8)
    before = signal.getsignal(signal.SIGINT)
    twice = lambda *_: [signal.raise_signal(signal.SIGINT) for _ in range(2)]  # noqa: E731
    monkeypatch.setattr(trainer.learner.optimiser, "step", twice)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(tmp_path / "m.pt")
    assert not (tmp_path / "m.pt").exists() and signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_that_cannot_be_written_ends_the_run_with_a_checkpoint(dataset, tmp_path):
    trainer = trainer_of(dataset, 8)
    with pytest.raises(DataError, match="/dev/full: .*No space left"):
        trainer.run(tmp_path / "m.pt", log=Path("/dev/full"))
    assert checkpoint.load(tmp_path / "m.pt")[1]["iteration"] == 1
    with pytest.raises(DataError, match="none"):
        trainer.run(tmp_path / "n.pt", log=tmp_path / "none" / "log.jsonl")


def test_the_log_is_json_even_of_a_step_that_is_not_finite(tmp_path):
    log = RecordLog(tmp_path / "log.jsonl")
    assert log.write({"loss": math.nan, "pi": (0.5, math.inf)})
    log.close()
    text = (tmp_path / "log.jsonl").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {"loss": None, "pi": [0.5, None]}


BROKEN_STATES = {
    "order": [0, 6],
    "generator": torch.zeros(3),
    "optimiser": {"state": {0: {"step": torch.zeros(()), "exp_avg": torch.zeros(3), "exp_avg_sq": torch.zeros(3)}}},
    "densifier": {name: torch.zeros(3) for name in ("pull", "visits", "opacity", "anchor_visits")},
    "iteration": -3,
    "total": 10**30,
    "skipped": "many",
    "share": math.nan,
    "rho": math.inf,
    "seconds": -math.inf,
    "noise": torch.zeros(3),
    "rank": torch.zeros(5, 5),
    "left_out": "[" * 5000,
    "curve": '[{"iteration": 1, "seconds": 1, "psnr": [null]}]',
}


@pytest.mark.parametrize("name", BROKEN_STATES)
def test_broken_training_state_is_refused_in_one_line(dataset, tmp_path, name):
    trainer = trainer_of(dataset, 5)
    trainer.save(tmp_path / "m.pt")
    model, training = checkpoint.load(tmp_path / "m.pt")
    for broken in (training | {name: BROKEN_STATES[name]}, {k: v for k, v in training.items() if k != name}):
        checkpoint.save(tmp_path / "m.pt", model, broken)
        with pytest.raises((DataError, TrainError)) as caught:
            trainer.resume(tmp_path / "m.pt")
        assert str(tmp_path / "m.pt") in str(caught.value) and "\n" not in str(caught.value)


def test_a_run_of_n_steps_has_a_total(dataset, tmp_path):
    """With a total of 0, as before a timed run has estimated its own, it would never end."""
    trainer_of(dataset, 5).save(tmp_path / "m.pt")
    model, training = checkpoint.load(tmp_path / "m.pt")
    checkpoint.save(tmp_path / "m.pt", model, training | {"total": 0})
    with pytest.raises(DataError, match="total is 0, expected a number from 1 to"):
        trainer_of(dataset, 5).resume(tmp_path / "m.pt")
    trainer_of(dataset, None, max_seconds=5.0).save(tmp_path / "m.pt")
    trainer_of(dataset, None, max_seconds=5.0).resume(tmp_path / "m.pt")


def test_other_pictures_and_other_cameras_are_refused_and_the_same_under_another_name_are_not(dataset, tmp_path):
    trainer_of(dataset, 5).save(tmp_path / "m.pt")
    trainer_of(dataclasses.replace(dataset, name="moved"), 5).resume(tmp_path / "m.pt")
    view = dataset.train[2]
    for change in (
        {"image": view.image[:, ::-1].copy()},
        {"viewmat": view.viewmat + np.float32(0.001)},
        {"time": 0.41},
    ):
        train = (*dataset.train[:2], dataclasses.replace(view, **change), *dataset.train[3:])
        with pytest.raises(DataError, match="other pictures or cameras in disc than it was trained on"):
            trainer_of(dataclasses.replace(dataset, train=train), 5).resume(tmp_path / "m.pt")


def test_points_that_all_lie_far_outside_are_as_good_as_none(dataset):
    far = dataclasses.replace(dataset, points=np.full((20, 3), 1e4, np.float32))
    assert len(trainer_of(far, 5).model.anchor_q) > 100
