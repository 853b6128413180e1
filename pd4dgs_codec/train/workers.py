"""Several workers on one scene, as torchrun starts them: each learns from its share of a step's views.

All hold the same model. Gradients are summed, so that all take the same step; what is measured now and then, such as
what pruning goes by, the first one measures for all. One process alone communicates nothing.
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
    """Joins the others if torchrun started this process. TrainError unless `views` of a step can be shared evenly."""
    workers = int(os.environ.get("WORLD_SIZE", "1"))
    if views % workers:
        raise TrainError(f"found {workers} workers, expected a number that divides --views-per-step {views}")
    if workers > 1:
        # Its functions have the group of all workers as a default, taken when it is loaded. Adam loads it. Loaded later
        # than the group it would keep the group's threads beyond stop(), to abort the process now and then at its end.
        import_module("torch.distributed.nn.functional")
        if device == "cuda":
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        distributed.init_process_group("cpu:gloo,cuda:nccl" if device == "cuda" else "gloo")


def stop() -> None:
    """Leaves the others, where there are any."""
    if count() > 1:
        distributed.destroy_process_group()


def count() -> int:
    """Workers on this scene."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this is, from 0 on; the first one writes."""
    return distributed.get_rank() if count() > 1 else 0


def alike(measure: Callable[[], T]) -> T:
    """What the first worker measures, for all: rounding on another machine must not decide otherwise there. NotFinite
    is raised on all of them."""
    if count() == 1:
        return measure()
    found: list[Any] = [None, None, None]
    if rank() == 0:
        try:
            value = measure()
            device = value.device.type if isinstance(value, Tensor) else None
            found = [None, value.cpu() if isinstance(value, Tensor) else value, device]
        except NotFinite as error:
            found[0] = str(error)
    distributed.broadcast_object_list(found)
    diverged, value, device = found
    if diverged is not None:
        raise NotFinite(diverged)
    result: T = value.to(device) if device else value  # each worker has a device of its own
    return result


def largest(*values: float) -> tuple[float, ...]:
    """The largest of each value over all workers."""
    if count() == 1:
        return values
    shared = torch.tensor(values, dtype=torch.float64)
    distributed.all_reduce(shared, distributed.ReduceOp.MAX)
    return tuple(shared.tolist())


def add_up(tensors: Sequence[Tensor]) -> None:
    """Gives each tensor its sum over all workers. All on one device, of one type."""
    flat = torch.cat([tensor.flatten() for tensor in tensors])
    distributed.all_reduce(flat)
    start = 0
    for tensor in tensors:
        tensor.copy_(flat[start : start + tensor.numel()].view_as(tensor))
        start += tensor.numel()
