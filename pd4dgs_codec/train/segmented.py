"""Trains a long capture as a folder of segments, see `segments`, with views of one segment at a time in memory.

A base is trained on views of all times: level 0 alone, without what moves. Each segment then starts with the rows and
networks of the base as its file decodes, which stay as they are, and learns from the views of its time what the base
lacks: anchors of its own, and the motion of all. Its file names the base's layer 0 and does not repeat it (clause 5.6).
Segments do not depend on each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.data.view import Dataset, LaterView, View, spread
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.reader import Base, read_base
from pd4dgs_codec.io import write_bytes
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.model import Model, from_scene, to_scene
from pd4dgs_codec.model.networks import EXACT
from pd4dgs_codec.scene import SCALING_DIM, Grading, Scene
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.initialise import fresh_mask_logits, fresh_model, nearest_distances
from pd4dgs_codec.train.loop import Progress, Trainer
from pd4dgs_codec.train.phases.grow import contained
from pd4dgs_codec.train.phases.levels import MIN_VIEWS
from pd4dgs_codec.train.phases.matching import Points, moving_points
from pd4dgs_codec.train.schedule import Schedule
from pd4dgs_codec.train.state import TrainState

#: Views of all times from which a base is trained, at most.
BASE_VIEWS = 600
#: Times differ by rounding; a view at the seam belongs to both segments. Seconds.
ROUNDING = 1e-4


@dataclass(frozen=True)
class Cuts:
    """A dataset's segments. ranges: seconds of each, of which neighbours share the overlap. views: numbers of training
    views, of each segment and of the base."""

    ranges: tuple[tuple[float, float], ...]
    views: tuple[int, ...]
    base_views: int


def cuts_of(dataset: Dataset, length: float, overlap: float) -> Cuts:
    """Cuts a dataset into segments of about `length` seconds at instants of its views, so that neighbours share a view
    at least, and `overlap` seconds more. Raises DataError for a segment without views of its own."""
    (low, high), instants = dataset.time_range, np.unique([seconds_of(dataset, view) for view in dataset.train])
    count = max(round((high - low) / length), 1)
    step = (high - low) / count
    if overlap >= step:
        raise DataError(
            f"{dataset.name}: an overlap of {overlap:g} s, expected less than the {step:.3g} s of a segment"
        )
    inner = [float(instants[np.abs(instants - (low + k * step)).argmin()]) for k in range(1, count)]
    ends = [low, *inner, high]
    ranges = [(start, min(stop + overlap, high)) for start, stop in zip(ends[:-1], ends[1:], strict=True)]
    views = [len(_within(dataset, dataset.train, each)) for each in ranges]
    for k, (start, stop) in enumerate(ranges):
        own = instants[(instants >= start - ROUNDING) & (instants <= stop + ROUNDING)] if stop > start else ()
        if len(own) < 2:
            times = f"{low + k * step:.4g} to {low + (k + 1) * step:.4g} s"
            raise DataError(
                f"{dataset.name}: segment {k}, {times}, has training views of {len(own)} instants, expected two at "
                "least; longer --segments"
            )
    return Cuts(tuple(ranges), tuple(views), min(len(dataset.train), BASE_VIEWS))


def seconds_of(dataset: Dataset, view: View) -> float:
    """The time of a view in seconds."""
    low, high = dataset.time_range
    return low + view.time * (high - low)


def _within(dataset: Dataset, views: Sequence[View], times: tuple[float, float]) -> list[View]:
    return [v for v in views if times[0] - ROUNDING <= seconds_of(dataset, v) <= times[1] + ROUNDING]


def part_of(dataset: Dataset, times: tuple[float, float] | None) -> Dataset:
    """The dataset of a time range, seconds, with its pixels in memory; None: of all times, for the base."""
    test: Sequence[View]
    if times is None:
        train, times = spread(dataset.train, BASE_VIEWS), dataset.time_range
        test = spread(dataset.test, BASE_VIEWS // 10) if dataset.test else ()
    else:
        train, test = (_within(dataset, views, times) for views in (dataset.train, dataset.test))
    start, stop = times

    def read(view: View) -> View:
        time = min(max((seconds_of(dataset, view) - start) / (stop - start), 0.0), 1.0)
        image, mask = view.read() if isinstance(view, LaterView) else (view.image, view.mask)
        return View(view.viewmat, view.K, view.width, view.height, time, image, mask, view.name, view.camera_id)

    own, held_out = (tuple(v for v in map(read, views) if v.mask is None or v.mask.any()) for views in (train, test))
    if not own:
        raise DataError(f"{dataset.name}: the masks of all training views from {start:g} to {stop:g} s hide everything")
    return replace(dataset, train=own, test=held_out, time_range=(start, stop))


# -- the model of a segment --------------------------------------------------------------------------------------------


def continued(config: TrainConfig, dataset: Dataset, base: Scene) -> Model:
    """Returns the model with which the training of a segment starts: the rows and networks of its base, frozen, anchors
    at points of what moves near the key instant, and fresh deformations."""
    size, own = PRESETS[config.preset], from_scene(base)
    key = config.key_instant if config.rollout == "key" else None
    shared = {name: getattr(base.steps, name) for name in (*base.steps.attributes, "weights_scaffold")}
    few, steps = replace(size, initial_anchors=8), replace(config.model_steps(size.steps), **shared)
    dataset = replace(dataset, box=base.info.box)
    fresh = fresh_model(few, dataset, config.widths, steps, config.seed, config.max_layer, key)

    def joined(added: dict[str, Tensor]) -> Model:
        rows = {name: torch.cat([getattr(own, name).detach(), values]) for name, values in added.items()}
        classes = own.step_class.new_zeros(len(rows["anchor_q"]))
        classes[: len(own.step_class)] = own.step_class
        model = Model(
            replace(base.info, time_range=fresh.info.time_range),
            steps,
            networks={name: own.network(name) for name in own.networks},
            global_deformation=fresh.global_deformation,
            local_deformation=fresh.local_deformation,
            step_class=classes,
            centre=own.centre,
            **rows,
        )
        model.freeze(len(own.anchor_q))
        return model

    names = ("anchor_q", "feature", "scaling_log", "offset", "mask_logits")
    model = joined({name: getattr(own, name).detach()[:0] for name in names})
    state = TrainState(replace(config, noise=False), dataset, Schedule(1), torch.device("cpu"), size, model)
    state.iteration = 1
    points, _ = moving_points(state)
    apart = (points.time - config.key_instant).abs()
    near = torch.unique(apart)[:MIN_VIEWS]
    return joined(_anchors_at(state, points.at(torch.isin(apart, near))))


@torch.no_grad()
def _anchors_at(state: TrainState, points: Points) -> dict[str, Tensor]:
    """The attributes of anchors at points in free voxels, by name. Networks that do not change make of their features
    what they make of those of the base, so each takes the one of the base's Gaussian of most similar colour."""
    model = state.model
    cells = torch.round(points.position.double() / model.info.voxel_size).to(torch.int32)
    unique, first = np.unique(cells.numpy(), axis=0, return_index=True)
    found = torch.from_numpy(unique)
    free = ~contained(found.long(), model.anchor_q.long()) if len(found) else torch.zeros(0, dtype=torch.bool)
    found, colour = found[free], points.colour[torch.from_numpy(first)][free]
    feature = model.feature.new_zeros(len(found), model.widths.feature)
    if len(found):
        shown = model.gaussians(0, 0.0, state.dataset.camera, EXACT)
        solid = (shown.opacities >= 0.5).nonzero()[:, 0]
        if len(solid):
            nearest = torch.cdist(colour, shown.colors[solid]).argmin(1)
            feature = model.feature[shown.slots[solid[nearest]] // model.widths.slots]
    size = nearest_distances((found.double() * model.info.voxel_size).float()).clamp(min=model.info.voxel_size)
    return {
        "anchor_q": found,
        "feature": feature.detach().clone(),
        "scaling_log": size.log()[:, None].repeat(1, SCALING_DIM),
        "offset": model.offset.new_zeros(len(found), *model.offset.shape[1:]),
        "mask_logits": fresh_mask_logits(len(found), model.level),
    }


def encoded(model: Model, base: tuple[Base, Scene] | None, metadata: Metadata) -> bytes:
    """The file of a trained base, or of a segment that continues one, whose first rows it takes bit for bit."""
    scene = to_scene(model)
    if base is None:
        return encode_with_report(scene, metadata=metadata)[0]
    file, own = base
    n, graded = len(own.anchor_q), None
    if own.grading is not None:
        classes = np.concatenate([own.grading.classes, model.step_class[n:].numpy()])
        graded = Grading(classes, own.grading.centre)
    rows: dict[str, Any] = {name: np.concatenate([x, getattr(scene, name)[n:]]) for name, x in own.attributes.items()}
    masks = tuple(np.concatenate([own.mask[0], codes[n:]]) for codes in scene.mask)
    scene = replace(scene, mask=masks, grading=graded, networks=own.networks, **rows)
    return encode_with_report(scene, base=file, metadata=metadata)[0]


# -- a part ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A base or a segment to train. config: with `still` for a base. output: its file, beside which its checkpoint
    lies. times: seconds, None for a base. base: the file that a segment continues."""

    config: TrainConfig
    output: Path
    times: tuple[float, float] | None = None
    base: Path | None = None
    device: str = "cpu"

    @property
    def checkpoint(self) -> Path:
        """Where the training is saved."""
        return self.output.with_suffix(".pt")


def base_config(config: TrainConfig) -> TrainConfig:
    """The configuration of the base of segments that are trained as `config` says."""
    return replace(config, max_layer=0, rollout="key", keep_layers=False, still=True)


def train_part(part: Part, dataset: Dataset, progress: Progress | None) -> dict[str, Any]:
    """Trains a part of a dataset from its checkpoint on, if there is one, to its end or its time limit, and writes its
    file, unless a signal ended it early. Returns numbers: steps done, whether `finished` and `interrupted`, psnr in dB
    by level. Raises DataError and TrainError."""
    own, base, start = part_of(dataset, part.times), None, None
    if part.base is not None:
        data = part.base.read_bytes()
        scene = decode(data)
        if not isinstance(scene, Scene):
            raise DataError(f"{part.base}: holds splats, expected a base that pd4dgs-train wrote")
        base, start = (read_base(data), scene), continued(part.config, own, scene)
    trainer = Trainer(part.config, own, part.device, start=start)
    if part.checkpoint.exists():
        trainer.resume(part.checkpoint)
    trainer.run(part.checkpoint, progress=progress)
    if trainer.iteration and trainer.learner.skipped == trainer.iteration:
        raise TrainError(f"{part.output}: training failed: no step had a finite loss and gradient")
    psnr = trainer.curve[-1]["psnr"] if trainer.curve else []
    finished = trainer.finished or bool(part.config.max_seconds and not trainer.interrupted)
    if finished:
        about = Metadata(quality={level: value for level, value in enumerate(psnr) if math.isfinite(value)})
        write_bytes(part.output, encoded(trainer.model.cpu(), base, about), overwrite=True)
    return {
        "iterations": trainer.iteration,
        "finished": finished,
        "interrupted": trainer.interrupted,
        "anchors": len(trainer.model.anchor_q),
        "psnr": psnr,
    }
