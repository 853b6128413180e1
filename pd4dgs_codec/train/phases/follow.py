"""Teaches motion what `train.following` found, before pictures of other instants do.

A picture teaches motion only where a body's picture and its image overlap. The tracks say where a body is at each
instant: the deformations first learn them alone, which takes no picture. Then all views take part at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.train import phases
from pd4dgs_codec.train.following import Track
from pd4dgs_codec.train.movers import CELLS
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.state import TrainState

#: Steps that teach the tracks alone; points of each body in a step, and anchors that stay.
STEPS, POINTS, STAYING = 400, 60, 400


class Follow(phases.Phase):
    """Teaches motion the tracks of what moves, at the end of the coarse phase."""

    def due(self, state: TrainState) -> bool:
        """At the end of the coarse phase, if there is a key instant."""
        return state.key is not None and phases.long_enough(state) and state.reached(state.schedule.coarse_end)

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Teaches the tracks; sets `TrainState.opened` if there are any."""
        tracks, state.tracks = state.tracks, []
        record["bodies"] = len(tracks)
        if tracks:
            teach(state, tracks)
            state.opened = True


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
