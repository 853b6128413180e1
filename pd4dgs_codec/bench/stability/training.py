"""Stability of training: runs that ought to fail end in a whole checkpoint, a file that decodes and finite pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.bench.stability.cases import Case, Found, picture_error
from pd4dgs_codec.data.view import Dataset, View
from pd4dgs_codec.format import decoder, encoder
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
from pd4dgs_codec.model.convert import from_scene, to_scene
from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS
from pd4dgs_codec.train.config import LearningRates, TrainConfig
from pd4dgs_codec.train.loop import Trainer

ITERATIONS = 60
WIDTH, HEIGHT = 32, 24
PROMISED = "finite checkpoint, a file that decodes, pictures of all levels within 1/255 of the float64 oracle's"
BOUND = 1 / 255
_FIELD = DeformationConfig(4, 4, 8, (1,), 8, tuple(GLOBAL_HEADS))
#: Like the preset `tiny`, but a step takes milliseconds.
SMALLEST = ModelConfig(
    _FIELD, replace(_FIELD, heads=tuple(LOCAL_HEADS)), hidden=8, initial_anchors=300, max_anchors=600
)


def cases() -> Iterator[Case]:
    """Each a run on six small pictures."""
    blind, still, flat = np.zeros((HEIGHT, WIDTH), bool), {"time_range": (2.0, 2.0)}, {"points": None, "box": _box(0)}
    runs: list[tuple[str, str, Callable[[], Trainer]]] = [
        ("as it should be", "a disc that moves over a grey ground", _trainer),
        ("learning rates times 100", "every learning rate times 100", partial(_trainer, factor=100.0)),
        ("learning rates times 1e4", "every learning rate times 10,000", partial(_trainer, factor=1e4)),
        ("a single Gaussian", "one anchor, of whose Gaussians one is seen", _single),
        ("10^6 between scales", "Gaussians and offsets of 1 and of 1e-6 scene units", _two_scales),
        ("one instant", "six views with one time stamp, time range 0", _on(lambda v, i: replace(v, time=0.0), **still)),
        ("repeated time stamps", "three instants, two views each", _on(lambda v, i: replace(v, time=(i // 2) / 2))),
        ("the same view six times", "one picture, one camera, one instant", _on(lambda v, i: _view(0.0))),
        ("black pictures", "all pixels 0", _on(partial(_painted, value=0))),
        ("white pictures", "all pixels 255 over black", _on(partial(_painted, value=255))),
        ("nothing valid", "masks that hide every pixel", _on(lambda v, i: replace(v, mask=blind))),
        ("a flat box", "a box without depth", _on(lambda v, i: v, **flat)),
    ]
    row = partial(Case, "training")
    for name, fed, make in runs:
        yield row(name, f"{fed}; {ITERATIONS} steps", PROMISED, BOUND, partial(_run, make))
    fed, counted = "NaN in a network for two steps, then the weight it had", "both steps are skipped and counted"
    yield row("a weight that is not a number", fed, f"{counted}; {PROMISED}", BOUND, _passing_nan)


# -- data --------------------------------------------------------------------------------------------------------------


def _box(depth: float) -> np.ndarray:
    return np.array([[-1.5, -1.2, -depth], [1.5, 1.2, depth]], np.float32)


def _view(t: float) -> View:
    """A disc that moves to the right; the camera sways a little."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    image[(x - 8 - 16 * t) ** 2 + (y - 12) ** 2 < 16] = (230, 60, 40)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3], viewmat[2, 3] = 0.1 * np.sin(6 * t), 3.0
    K = np.array([[30, 0, WIDTH / 2], [0, 30, HEIGHT / 2], [0, 0, 1]], np.float32)
    return View(viewmat, K, WIDTH, HEIGHT, t, image, None, f"{t:.2f}", 0)


def _painted(view: View, index: int, value: int) -> View:
    return replace(view, image=np.full_like(view.image, value))


def _disc(change: Callable[[View, int], View] = lambda view, i: view, **changes: Any) -> Dataset:
    """Six views, each changed, and other fields instead of these."""
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    fields: dict[str, Any] = dict(
        name="disc", train=tuple(change(_view(t), i) for i, t in enumerate(np.linspace(0, 1, 6))), test=(_view(0.5),),
        points=points, point_colors=None, box=_box(1), near=0.1, far=10.0, background=(0.0, 0.0, 0.0),
        time_range=(0.0, 1.0), up=(0.0, -1.0, 0.0), unit=0.0, masked=False,
    )  # fmt: skip
    return Dataset(**(fields | changes))


# -- runs --------------------------------------------------------------------------------------------------------------


def _on(change: Callable[[View, int], View], **changes: Any) -> Callable[[], Trainer]:
    """A run on the changed data."""
    return lambda: _trainer(_disc(change, **changes))


def _trainer(data: Dataset | None = None, config: ModelConfig = SMALLEST, factor: float = 1.0) -> Trainer:
    """factor: on all learning rates."""
    data = data or _disc()
    rates = LearningRates(**{k: (factor * a, factor * b) for k, (a, b) in asdict(LearningRates()).items()})
    return Trainer(TrainConfig(preset="tiny", iterations=ITERATIONS, rates=rates, cooldown=0.0), data, size=config)


@torch.no_grad()
def _single() -> Trainer:
    one = replace(SMALLEST, initial_anchors=1, max_anchors=1)
    trainer = _trainer(_disc(points=np.zeros((1, 3), np.float32)), one)
    trainer.model.network("opacity").layers[-1].bias[1:] = -3.0
    return trainer


@torch.no_grad()
def _two_scales() -> Trainer:
    trainer = _trainer()
    trainer.model.scaling_log[::2] = 0.0
    trainer.model.scaling_log[1::2] = np.log(1e-6)
    return trainer


def _passing_nan() -> Found:
    trainer = _trainer()
    bias = trainer.model.network("color").layers[-1].bias
    kept = bias.detach().clone()
    with torch.no_grad():
        bias.fill_(np.nan)
    for _ in range(2):
        trainer.learner.step()
    with torch.no_grad():
        bias.copy_(kept)
    got, error = _run(lambda: trainer)
    return got, error if trainer.learner.skipped == 2 else np.nan


def _run(make: Callable[[], Trainer]) -> Found:
    """Runs to the end, writes, packs, unpacks and draws. (in words, the pictures' error)"""
    trainer = make()
    with tempfile.TemporaryDirectory() as folder:
        trainer.run(Path(folder) / "model.pt")
        model, _ = checkpoint.load(Path(folder) / "model.pt")
    data = encoder.encode(to_scene(model), effort=1)
    scene = decoder.decode(data)
    decoded = from_scene(scene)
    view = trainer.dataset.train[-1]
    errors = [picture_error(decoded, level, view.time, view.camera) for level in (0, 1, 2)]
    skipped = f"{trainer.learner.skipped} of {trainer.iteration} steps skipped"
    return f"{skipped}, {len(scene.anchor_q):,} anchors, {len(data):,} bytes", float(np.max(errors))
