"""Compilation beside the reading of data: a run finds its kernels compiled and is the same, bit for bit."""

import threading

import torch

from pd4dgs_codec.draw import compositing, gaussians, hexplane, layers, projection
from pd4dgs_codec.model import plane_terms, rate
from pd4dgs_codec.train import ssim
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.kernels import compiling
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.schedule import Schedule

KERNELS = {
    compositing.composite_backward, gaussians.linear_backward, gaussians.assemble_backward, gaussians.pick_backward,
    hexplane.sample_backward, layers.backward, projection.project_backward, plane_terms._gradient,
    plane_terms._proxy_gradient, rate.scalar_bits, ssim.loss_backward,
}  # fmt: skip


def signatures() -> dict[str, list[tuple]]:
    return {kernel.__qualname__: list(kernel.__wrapped__.signatures) for kernel in KERNELS}


def test_a_run_compiles_nothing_more(dataset):
    config = TrainConfig(preset="tiny", iterations=1)
    with compiling(config, "cpu"):
        pass
    for thread in threading.enumerate():
        if thread.name == "compiling":
            thread.join()
    before = signatures()
    assert all(before.values())
    learner = Learner(config, dataset, Schedule(1), torch.device("cpu"))
    learner.step()
    learner.step()
    assert signatures() == before


def losses(dataset) -> list[float]:
    learner = Learner(TrainConfig(preset="tiny", iterations=4), dataset, Schedule(4), torch.device("cpu"))
    return [learner.step()["loss"] for _ in range(4)]


def test_a_run_beside_is_the_same(dataset):
    alone = losses(dataset)
    with compiling(TrainConfig(preset="tiny", iterations=4), "cpu"):
        pass
    assert losses(dataset) == alone
