"""Several workers on one scene, started by torchrun: each trains on its share of a step's views.

All hold the same model. Gradients are summed, so that all make the same update. The first worker makes occasional
measurements, such as the errors of pruning, for all. A single process communicates nothing.

If a worker ends early, those that wait for it raise TrainError.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

from pd4dgs_codec.errors import NotFinite, TrainError

T = TypeVar("T")


def start(device: str, views: int) -> None:
    """Joins the other workers if torchrun started this process. Raises TrainError if `views` do not divide evenly."""
    workers = int(os.environ.get("WORLD_SIZE", "1"))
    if views % workers:
        raise TrainError(f"found {workers} workers, expected a number that divides --views-per-step {views}")
    if workers > 1:
        # The module stores the default process group at import. Imported once the group exists, it would keep the
        # group's threads beyond stop(), which sometimes aborts the process at exit.
        import_module("torch.distributed.nn.functional")
        with _met():
            if device == "cuda":
                torch.cuda.set_device(_local_rank())
            distributed.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")
        atexit.register(stop)  # also after an error, or the group's threads sometimes abort the process at exit


def _local_rank() -> int:
    """The index of this worker on its machine. Raises ValueError, as torch does for torchrun's other variables."""
    if "LOCAL_RANK" not in os.environ:
        raise ValueError("environment variable LOCAL_RANK expected, but not set")
    return int(os.environ["LOCAL_RANK"])


def stop() -> None:
    """Leaves the other workers, if there are any."""
    if count() > 1:
        distributed.destroy_process_group()


def count() -> int:
    """The number of workers on this scene."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def rank() -> int:
    """The index of this worker; worker 0 writes the files."""
    return distributed.get_rank() if count() > 1 else 0


@contextmanager
def _met() -> Iterator[None]:
    """Raises TrainError if the other workers do not answer, or a variable that torchrun sets is missing. A worker that
    failed says why itself."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise TrainError(f"cannot reach the other workers, or one has ended: {error}") from None


def alike(measure: Callable[[], T]) -> T:
    """Returns the first worker's measure() on all workers, as rounding on another machine might change a decision.
    Raises its NotFinite on all workers. Tensors must be on the CPU: each worker has its own device."""
    if count() == 1:
        return measure()
    found: list[Any] = [None, None]
    if rank() == 0:
        try:
            found[1] = measure()
        except NotFinite as error:
            found[0] = str(error)
    with _met():
        distributed.broadcast_object_list(found)
    diverged, value = found
    if diverged is not None:
        raise NotFinite(diverged)
    result: T = value
    return result


def largest(*values: float) -> tuple[float, ...]:
    """The largest of each value over all workers."""
    if count() == 1:
        return values
    shared = torch.tensor(values, dtype=torch.float64)
    with _met():
        distributed.all_reduce(shared, distributed.ReduceOp.MAX)
    return tuple(shared.tolist())


def add_up(tensors: Sequence[Tensor]) -> None:
    """Replaces each tensor by its sum over all workers. All are on one device, of one type."""
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    with _met():
        distributed.all_reduce(flat)
    start = 0
    for tensor in tensors:
        tensor.copy_(flat[start : start + tensor.numel()].view_as(tensor))
        start += tensor.numel()
