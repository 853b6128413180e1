"""What tests ask of runs: their logs, their weights, and that resuming changes nothing."""

import json

import torch

from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.train.loop import Trainer


def read_log(path) -> list[dict]:
    """The records of a log."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def assert_same_weights(path, other) -> None:
    """Two checkpoints hold one model, bit for bit."""
    a, b = (checkpoint.load(p)[0].state_dict() for p in (path, other))
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a), (path, other)


def run_saving(trainer, folder, cuts, **options) -> None:
    """Runs a trainer to folder/whole.pt. Before each of the steps `cuts` it saves what a run cut there leaves."""
    step = trainer.learner.step

    def saved_before():
        if trainer.iteration in cuts:
            trainer.save(folder / f"cut-{trainer.iteration}.pt")
        return step()

    trainer.learner.step = saved_before
    trainer.run(folder / "whole.pt", **options)


def assert_resumes_bit_for_bit(config, dataset, folder, cuts) -> None:
    """What `run_saving` saved at `cuts`, resumed, ends as its run did."""
    for cut in cuts:
        resumed = Trainer(config, dataset)
        resumed.resume(folder / f"cut-{cut}.pt")
        assert resumed.iteration == cut
        resumed.run(folder / f"from-{cut}.pt")
        assert_same_weights(folder / "whole.pt", folder / f"from-{cut}.pt")
