"""Helpers of tests that train: runs of a few steps, their logs and weights, and that resuming changes nothing."""

import json
import signal

import torch

from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer


def read_log(path) -> list[dict]:
    """The records of a log."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def trainer_of(dataset, iterations: int | None = 30, steps: int = 0, **options) -> Trainer:
    """A run of the preset tiny that has made so many steps."""
    trainer = Trainer(TrainConfig(preset="tiny", iterations=iterations, **options), dataset)
    for _ in range(steps):
        trainer.learner.step()
    return trainer


def records_of(trainer, folder, name: str = "m.pt") -> list[dict]:
    """Runs a trainer, which writes the checkpoint `name` in the folder, and returns its log."""
    trainer.run(folder / name, log=folder / "log.jsonl")
    return read_log(folder / "log.jsonl")


def assert_same_weights(path, other, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Two checkpoints hold one model, bit for bit unless said otherwise."""
    a, b = (checkpoint.load(p)[0].state_dict() for p in (path, other))
    torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


def interrupt(trainer, number, when) -> None:
    """Raises the signal in the middle of each step in which `when()` is true."""
    update = trainer.learner.optimiser.step

    def interrupted(*at):
        if when():
            signal.raise_signal(number)
        update(*at)

    trainer.learner.optimiser.step = interrupted


def run_saving(trainer, folder, cuts) -> list[dict]:
    """Runs a trainer to folder/whole.pt and returns its log. Before each step in `cuts` it saves the checkpoint that a
    run interrupted there leaves."""
    step = trainer.learner.step

    def saved_before():
        if trainer.iteration in cuts:
            trainer.save(folder / f"cut-{trainer.iteration}.pt")
        return step()

    trainer.learner.step = saved_before
    return records_of(trainer, folder, "whole.pt")


def assert_goes_on_as_one_run(config, dataset, part) -> None:
    """A run resumed at the checkpoint `part` ends as one that was never cut."""
    resumed, whole = (Trainer(config, dataset) for _ in range(2))
    resumed.resume(part)
    resumed.run(part.with_name("resumed.pt"))
    whole.run(part.with_name("uncut.pt"))
    assert not resumed.interrupted
    assert_same_weights(part.with_name("resumed.pt"), part.with_name("uncut.pt"))


def assert_resumes_bit_for_bit(config, dataset, folder, cuts) -> None:
    """What `run_saving` saved at `cuts`, resumed, ends as its run did."""
    for cut in cuts:
        resumed = Trainer(config, dataset)
        resumed.resume(folder / f"cut-{cut}.pt")
        assert resumed.iteration == cut
        resumed.run(folder / f"from-{cut}.pt")
        assert_same_weights(folder / "whole.pt", folder / f"from-{cut}.pt")
