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


def assert_resumes_bit_for_bit(config, dataset, folder, cuts) -> None:
    """Runs cut before each of the steps `cuts` and resumed end as the one in folder/whole.pt."""
    part = Trainer(config, dataset)
    for cut in sorted(cuts):
        while part.iteration < cut:
            part.learner.step()
        part.save(folder / "part.pt")
        resumed = Trainer(config, dataset)
        resumed.resume(folder / "part.pt")
        resumed.run(folder / f"from-{cut}.pt")
        assert_same_weights(folder / "whole.pt", folder / f"from-{cut}.pt")
