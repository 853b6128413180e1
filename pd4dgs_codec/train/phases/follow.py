"""Teaches motion what `train.following` found, before pictures of other instants do.

A picture teaches motion only where a body's picture and its image overlap. The tracks say where a body is at each
instant: the deformations first learn them alone, which takes no picture. Then all views take part at once. If those
near the key instant see the scene from one side, which tells little of depth, all views place the anchors, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pd4dgs_codec.train import phases
from pd4dgs_codec.train.following import Track
from pd4dgs_codec.train.movers import CELLS
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.rollout import near_key
from pd4dgs_codec.train.state import TrainState

#: Steps that teach the tracks alone; points of each body in a step, and anchors that stay.
STEPS, POINTS, STAYING = 1200, 60, 400


class Follow(phases.Phase):
    """Teaches motion the tracks of what moves, before the first step."""

    def due(self, state: TrainState) -> bool:
        """Before the first step, if there is a key instant."""
        return state.key is not None and state.iteration == 0

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Teaches the tracks; sets `TrainState.opened` if there are any, and `TrainState.placing`."""
        record["bodies"] = len(state.tracks)
        if state.tracks:
            teach(state, state.tracks)
            state.opened, state.placing = True, _from_one_side(state)


def _from_one_side(state: TrainState) -> bool:
    """Whether the views near the key instant have a smaller share of the spread of all directions than of all views, as
    those of a camera that goes by or around once have."""
    views = list(range(len(state.views)))
    near = near_key(state, views)
    return _spread(state, near) * len(views) < _spread(state, views) * len(near)


def _spread(state: TrainState, among: Sequence[int]) -> float:
    """0..1: the spread of the directions in which views see the middle of the scene, 1 less their mean's length."""
    viewmats = np.stack([state.views.views[index].viewmat for index in among]).astype(np.float64)
    ways = viewmats[:, :3, :3].transpose(0, 2, 1) @ viewmats[:, :3, 3:] + np.mean(state.dataset.box, axis=0)[:, None]
    return 1 - float(np.linalg.norm((ways / np.linalg.norm(ways, axis=1, keepdims=True)).mean(axis=0)))


def teach(state: TrainState, tracks: Sequence[Track]) -> None:
    """Trains the deformations until bodies at the key instant move along `tracks` and anchors elsewhere stay."""
    model, rates = state.model, state.config.rates
    generator, fields = torch.Generator().manual_seed(state.config.seed), model.deformations.values()
    for field in fields:  # fresh planes are the same at all times, from where no gradient leads
        grid = field.planes.grid
        grid.data.add_(rates.planes[0] * torch.randn(grid.shape, generator=generator).to(grid))
    adam = Optimiser(model, rates, state.config.cooldown)
    anchors, bodies = model.anchor.detach().cpu(), torch.cat([track.points for track in tracks])
    apart = 2 * float((model.info.box[1] - model.info.box[0]).max()) / CELLS
    staying = anchors[torch.cat([torch.cdist(part, bodies).amin(1) > apart for part in torch.split(anchors, STAYING)])]
    times = sorted({time for track in tracks for time in track.times.tolist()})
    for k in range(STEPS):
        time = times[int(torch.randint(len(times), (), generator=generator))]
        points = [staying[torch.randint(len(staying), (STAYING,), generator=generator)]] if len(staying) else []
        places = list(points)
        for track in tracks:
            for offset in track.offsets[track.times == time]:
                points.append(track.points[torch.randint(len(track.points), (POINTS,), generator=generator)])
                places.append(points[-1] + offset)
        moved = model.moved_points(torch.cat(points).to(state.device), (1, model.level)[k % 2], time).cpu()
        loss: Tensor = ((moved - torch.cat(places)) / model.deformations[1].unit).norm(dim=1).mean()
        adam.zero_grad()
        torch.autograd.backward(loss)
        adam.step(k / STEPS, None)
    adam.zero_grad()
