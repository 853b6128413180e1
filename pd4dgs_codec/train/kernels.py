"""Compilation of a run's kernels while its data are read.

numba compiles a kernel at its first call, which takes a fresh environment longer than many runs take to read their
data. A second thread therefore trains a model of a few anchors first: compilers wait for machine code half of the time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from subprocess import DEVNULL, Popen
from threading import Event, Thread

import numpy as np
import torch

from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.threads import available
from pd4dgs_codec.train import initialise
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.learner import Learner
from pd4dgs_codec.train.schedule import Schedule
from pd4dgs_codec.train.ssim import image_loss


@contextmanager
def compiling(config: TrainConfig, device: str) -> Iterator[None]:
    """Compiles, or loads from numba's cache, the kernels of a run on the CPU beside the `with` block. Those of the
    first steps are ready after it; those of higher levels and later phases may follow beside the first steps."""
    ready = Event()
    if device == "cpu":
        size = replace(PRESETS["tiny"], initial_anchors=8)
        # made here, since it draws from torch's global generator
        learner = Learner(replace(config, iterations=100), _ball(), Schedule(100), torch.device("cpu"), size)
        Thread(target=_compile, args=(learner, ready), name="compiling").start()
    else:
        ready.set()
    yield
    ready.wait()


def _compile(learner: Learner, ready: Event) -> None:
    """Finds the gradients of one picture as in the first step, then as in the last, at the highest level. A process
    compiles one kernel at a time, so another one, without torch, meanwhile compiles those of the rasteriser."""
    with suppress(Exception):  # the run compiles for itself, or has ended: it failed to read its data
        beside = _rasteriser()
        view = learner.views[0]
        image = view.image.requires_grad_()
        terms = list(image_loss(image, view.image, view.weights))
        terms += [x.sum() for x in vars(learner.model.gaussians(0, 0.0, view.view.camera)).values() if x.requires_grad]
        torch.autograd.backward(torch.stack(terms).sum())
        if beside:
            beside.wait()
        for step, level in ((0, 0), (99, learner.model.level)):
            learner.iteration = step
            finish = learner.model_loss.begin(learner.model, level, learner.schedule, learner.position)
            _, _, loss = learner.picture_loss(0, level)
            torch.autograd.backward(loss)
            finish()
            ready.set()
    ready.set()


@cache  # once a process: what it compiles stays in numba's cache
def _rasteriser() -> Popen[bytes] | None:
    """Starts the process that compiles the rasteriser's kernels, if numba had to compile the first kernel of this one,
    since its cache is empty, and if there is a core for it."""
    fresh = initialise._nearest_squares.__wrapped__.stats.cache_misses  # type: ignore[attr-defined]
    words = [sys.executable, "-c", "from pd4dgs_codec.draw import rasteriser; rasteriser.compile_kernels()"]
    return Popen(words, stderr=DEVNULL) if fresh and available() > 1 else None


def _ball() -> Dataset:
    """Eight points around 0 and a picture of them."""
    viewmat, K = np.eye(4, dtype=np.float32), np.array([[16, 0, 8], [0, 16, 8], [0, 0, 1]], np.float32)
    viewmat[2, 3] = 4
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3).astype(np.float32)
    view = View(viewmat, K, 16, 16, 0.5, np.zeros((16, 16, 3), np.uint8), None, "ball", 0)
    box = np.array([[-1, -1, -1], [1, 1, 1]], np.float32)
    black, up = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    return Dataset("ball", (view,), (), corners, box, 1.0, 8.0, black, (0.0, 1.0), up, masked=False)
