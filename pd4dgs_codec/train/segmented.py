"""Trains a long capture as a folder of segments, see `segments`, with views of one segment at a time in memory.

First a model is trained on views of all times, with its motion: the *whole*. Its layer 0 alone is the base, which holds
all anchors and the networks that make Gaussians of them. Each segment then starts with the rows and networks of the
base as its file decodes, which stay as they are, and with the part of the whole's motion that is in its time, and
learns the motion in the views of its time. Its file names the base's layer 0 and does not repeat it (clause 5.6).
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
from torch.nn import functional as F

from pd4dgs_codec.data.view import Dataset, LaterView, View, spread
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.format.container import CHUNK_OVERHEAD, read_preamble, write_preamble
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.format.header import pack_header, unpack_header
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.reader import Base, read_base
from pd4dgs_codec.io import write_bytes
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.deformation import DeformationField
from pd4dgs_codec.model.model import Model, from_scene, to_scene
from pd4dgs_codec.model.networks import Rounding
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.initialise import scene_info
from pd4dgs_codec.train.loop import Progress, Trainer
from pd4dgs_codec.train.optimiser import Optimiser

#: Views of all times from which a whole is trained, at most.
WHOLE_VIEWS = 600
#: Times differ by rounding; a view at the seam belongs to both segments. Seconds.
ROUNDING = 1e-4
#: Steps of a segment, as a share of those of the whole, from which it starts.
SHARE = 1 / 18
#: Pictures of a segment for each of its finest planes' instants, see `ModelConfig`.
PICTURES = 4
#: Steps that fit a segment's motion to that of the whole, before pictures do; the share of the anchors in each; and the
#: weight of the rate, of which 1 would be right if an attribute's error cost as much as the quantisation of its anchor.
FITTING, SAMPLE, WEIGHT = 6000, 0.1, 0.4
#: Squared steps that an attribute's error grows by when it has a bit less, at high rates (Gersho and Gray, Vector
#: quantization and signal compression, 1992).
SQUARES_PER_BIT = math.log(2) / 6


@dataclass(frozen=True)
class Cuts:
    """A dataset's segments. ranges: seconds of each, of which neighbours share the overlap. views: numbers of training
    views, of each segment and of the whole."""

    ranges: tuple[tuple[float, float], ...]
    views: tuple[int, ...]
    whole_views: int


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
    return Cuts(tuple(ranges), tuple(views), min(len(dataset.train), WHOLE_VIEWS))


def seconds_of(dataset: Dataset, view: View) -> float:
    """The time of a view in seconds."""
    low, high = dataset.time_range
    return low + view.time * (high - low)


def _within(dataset: Dataset, views: Sequence[View], times: tuple[float, float]) -> list[View]:
    return [v for v in views if times[0] - ROUNDING <= seconds_of(dataset, v) <= times[1] + ROUNDING]


def part_of(dataset: Dataset, times: tuple[float, float] | None) -> Dataset:
    """The dataset of a time range, seconds, with its pixels in memory; None: of all times, for the whole."""
    test: Sequence[View]
    if times is None:
        train, times = spread(dataset.train, WHOLE_VIEWS), dataset.time_range
        test = spread(dataset.test, WHOLE_VIEWS) if dataset.test else ()
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


def continued(config: TrainConfig, dataset: Dataset, whole: Scene) -> Model:
    """Returns the model with which the training of a segment starts: the rows and networks of the whole, frozen, and a
    single layer of motion, fitted to that of the whole within the segment's time."""
    old, info, size = from_scene(whole), scene_info(dataset), PRESETS[config.preset]
    finest = [field for field in (size.global_deformation, size.local_deformation) if field][-1]
    side, most = finest.scales[-1]
    instants = math.ceil(len({view.time for view in dataset.train}) / PICTURES) + 1
    torch.manual_seed(config.seed)
    motion = replace(finest, scales=((side, min(instants, most)),))
    model = Model(
        replace(whole.info, time_range=info.time_range),
        replace(whole.steps, weights_global=whole.steps.weights_scaffold),  # a few seconds need no finer ones
        old.anchor_q,
        old.feature.detach(),
        old.scaling_log.detach(),
        old.offset.detach(),
        old.mask_logits.detach(),
        {name: old.network(name) for name in old.networks},
        DeformationField.fresh(motion, whole.info.box, old.widths.heads),
        None,
        old.step_class,
        old.centre,
    )
    model.freeze(len(old.anchor_q))
    fit(model, old, config)
    return model


def fit(model: Model, old: Model, config: TrainConfig) -> None:
    """Trains the motion of a segment's model until it is that of `old`, the model of the whole. They are compared at
    random anchors, in units of the attributes' steps, which are as coarse as an anchor bears, under a rate of the
    planes. Residuals of `old` count from its key instant, which may be in another segment; the segment has none."""
    (low, high), times, planes = old.info.time_range, model.info.time_range, model.deformations[1].planes
    generator, step = torch.Generator().manual_seed(config.seed), model.steps.planes(1)
    units = [torch.full((3,), float(model.info.voxel_size))]
    units += [torch.full((c.numel(),), float(getattr(model.steps, name))) for name, c in model.centres.items()]
    adam, unit = Optimiser(model, config.rates, config.cooldown), torch.cat(units) * old.spacing[:, None]
    anchors, few = old.anchor, math.ceil(SAMPLE * len(unit))
    for k in range(FITTING):
        t = float(torch.rand((), generator=generator))
        seconds, rounding = times[0] + t * (times[1] - times[0]), Rounding(weights=k > FITTING / 4)
        some = torch.randint(len(unit), (few,), generator=generator)
        with torch.no_grad():
            wanted = old.moved_rows(anchors[some], old.level, (seconds - low) / (high - low)) / unit[some]
        apart = F.smooth_l1_loss(model.moved_rows(anchors[some], 1, t, rounding) / unit[some], wanted)
        adam.zero_grad()
        rate = planes.rate(planes.grid, step) / unit.numel()
        torch.autograd.backward(apart + WEIGHT * SQUARES_PER_BIT * rate)
        adam.step(k / FITTING, None)
    adam.zero_grad()
    model.round_to_steps()  # otherwise the first step on images moves values across the boundaries of their rounding


def encoded(model: Model, base: tuple[Base, Scene] | None, metadata: Metadata) -> bytes:
    """The file of a trained whole, or of a segment that continues its layer 0, whose rows it takes bit for bit. Layer 0
    of a whole has the anchors of all levels."""
    scene = to_scene(model)
    if base is None:
        scene = replace(scene, mask=(scene.mask[-1],) * len(scene.layers))
        return encode_with_report(scene, metadata=metadata)[0]
    file, own = base
    masks = (own.mask[0],) * len(scene.layers)
    rows: dict[str, Any] = own.attributes
    scene = replace(scene, mask=masks, grading=own.grading, networks=own.networks, **rows)
    return encode_with_report(scene, base=file, metadata=metadata)[0]


def base_of(whole: bytes) -> bytes:
    """The layer 0 of a file as a file of its own."""
    preamble = read_preamble(whole)
    header, offset, parts = unpack_header(preamble.header), preamble.size, []
    for kind, length in header.chunks:
        end = offset + CHUNK_OVERHEAD + length
        parts += [whole[offset:end]] if kind == 0 else []
        offset = end
    chunks = tuple(chunk for chunk in header.chunks if chunk[0] == 0)
    return write_preamble(pack_header(replace(header, chunks=chunks))) + b"".join(parts)


# -- a part ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """The whole or a segment to train. config: of the whole. output: its file, beside which its checkpoint lies. times:
    seconds, None for the whole. whole: the file that a segment continues."""

    config: TrainConfig
    output: Path
    times: tuple[float, float] | None = None
    whole: Path | None = None
    device: str = "cpu"

    @property
    def checkpoint(self) -> Path:
        """Where the training is saved."""
        return self.output.with_suffix(".pt")


def segment_config(config: TrainConfig) -> TrainConfig:
    """The configuration of segments whose whole is trained as `config` says. Their motion, which is known, begins at
    the rates at which that of a whole ends."""
    steps, seconds = config.total and math.ceil(config.total * SHARE), config.max_seconds and config.max_seconds * SHARE
    planes, deformation = config.rates.planes[1], config.rates.deformation[1]
    rates = replace(config.rates, planes=(planes, planes), deformation=(deformation, deformation))
    few = replace(config, iterations=steps, max_seconds=seconds, rates=rates)
    return replace(few, max_layer=1, rollout="top", small_pictures=0.0)


def train_part(part: Part, dataset: Dataset, progress: Progress | None) -> dict[str, Any]:
    """Trains a part of a dataset from its checkpoint on, if there is one, to its end or its time limit, and writes its
    file, unless a signal ended it early. Returns numbers: steps done, whether `finished` and `interrupted`, psnr in dB
    by level. Raises DataError and TrainError."""
    own, base, start, config = part_of(dataset, part.times), None, None, part.config
    size = PRESETS[config.preset]
    if part.whole is not None:
        data = part.whole.read_bytes()
        scene = decode(data)
        if not isinstance(scene, Scene):
            raise DataError(f"{part.whole}: holds splats, expected a model that pd4dgs-train wrote")
        config, size = segment_config(config), replace(size, max_anchors=0)  # none grow: the whole has seen all times
        base, start = (read_base(data), scene.prefix(0)), continued(part.config, own, scene)
    trainer = Trainer(config, own, part.device, size, start)
    if part.checkpoint.exists():
        trainer.resume(part.checkpoint)
    trainer.run(part.checkpoint, progress=progress)
    if trainer.iteration and trainer.learner.skipped == trainer.iteration:
        raise TrainError(f"{part.output}: training failed: no step had a finite loss and gradient")
    psnr = trainer.curve[-1]["psnr"] if trainer.curve else []
    finished = trainer.finished or bool(config.max_seconds and not trainer.interrupted)
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
