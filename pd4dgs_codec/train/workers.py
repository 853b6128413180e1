"""Several workers on one scene, started by torchrun: each trains on its share of a step's views.

All hold the same model. Gradients are summed, so that all take the same step. Occasional measurements, such as those of
pruning, are made by the first worker for all. A single process communicates nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

from pd4dgs_codec.errors import NotFinite, TrainError

T = TypeVar("T")


def start(device: str, views: int) -> None:
    """Joins the other workers if torchrun started this process. TrainError if they cannot share `views` evenly."""
    workers = int(os.environ.get("WORLD_SIZE", "1"))
    if views % workers:
        raise TrainError(f"found {workers} workers, expected a number that divides --views-per-step {views}")
    if workers > 1:
        # Its functions take the group of all workers as a default when it is loaded. Loaded after the group is made, it
        # would keep the group's threads beyond stop(), which sometimes aborts the process at its end.
        import_module("torch.distributed.nn.functional")
        if device == "cuda":
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        distributed.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")


def stop() -> None:
    """Leaves the other workers, if there are any."""
    if count() > 1:
        distributed.destroy_process_group()


def count() -> int:
    """Workers on this scene."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def rank() -> int:
    """The index of this worker; worker 0 writes the files."""
    return distributed.get_rank() if count() > 1 else 0


def alike(measure: Callable[[], T]) -> T:
    """measure() of the first worker, for all: rounding on another machine must not lead to another decision. NotFinite
    is raised on all workers. Tensors are on the CPU: each worker has a device of its own."""
    if count() == 1:
        return measure()
    found: list[Any] = [None, None]
    if rank() == 0:
        try:
            found[1] = measure()
        except NotFinite as error:
            found[0] = str(error)
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
    distributed.all_reduce(shared, distributed.ReduceOp.MAX)
    return tuple(shared.tolist())


def add_up(tensors: Sequence[Tensor]) -> None:
    """Replaces each tensor by its sum over all workers. All are on one device, of one type."""
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    distributed.all_reduce(flat)
    start = 0
    for tensor in tensors:
        tensor.copy_(flat[start : start + tensor.numel()].view_as(tensor))
        start += tensor.numel()
