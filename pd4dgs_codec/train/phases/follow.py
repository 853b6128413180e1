"""Teaches motion what `train.following` found, before pictures of other instants do.

A picture teaches motion only where a body's picture and its image overlap. The tracks say where a body is at each
instant: the deformations first learn them alone, which takes no picture. Then all views take part at once, and the
tracks keep a body in its place while its picture is learnt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.following import Track, followed
from pd4dgs_codec.train.movers import CELLS, moving_starts
from pd4dgs_codec.train.state import TrainState

#: Steps that teach the tracks alone; points of each body in a step, and anchors that stay.
STEPS, POINTS, STAYING = 400, 60, 400
#: Decay of the learning rates over these steps.
DECAY = 0.1


class Follow(phases.Phase):
    """Follows what moves, and teaches motion its tracks, at the end of the coarse phase; then `term` keeps to them."""

    def __init__(self) -> None:
        self._tracks: list[Track] = []

    def due(self, state: TrainState) -> bool:
        """At the end of the coarse phase, if there is a key instant."""
        return state.key is not None and phases.long_enough(state) and state.reached(state.schedule.coarse_end)

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Teaches the tracks; sets `TrainState.opened` if there are any."""
        info, key = state.model.info, state.key or 0.0
        dataset = replace(state.dataset, box=info.box, near=info.near)
        self._tracks = workers.alike(lambda: followed(dataset, moving_starts(dataset, key), key))
        record["bodies"] = len(self._tracks)
        if self._tracks:
            self._teach(state)
            state.opened = state.followed = True

    def term(self, state: TrainState, level: int) -> Tensor | None:
        """The mean distance of points of the key instant that `level` moves to another instant from where they are
        then, in units of the deformation: points of bodies, and of anchors that stay. None without tracks, at level 0
        and in trials."""
        if not self._tracks or level == 0 or state.practising:
            return None
        generator = state.noise.generator  # another thread draws from `state.generator` meanwhile
        times = torch.cat([track.times for track in self._tracks]).unique()
        time = times[torch.randint(len(times), (), generator=generator)]
        anchors = state.model.anchor.detach()[torch.randint(len(state.model.anchor), (STAYING,), generator=generator)]
        anchors = anchors.cpu()
        bodies = torch.cat([track.points for track in self._tracks])
        near = 2 * float((state.model.info.box[1] - state.model.info.box[0]).max()) / CELLS
        points = [anchors[torch.cdist(anchors, bodies).amin(1) > near]]
        places = list(points)
        for track in self._tracks:
            for offset in track.offsets[track.times == time]:
                drawn = track.points[torch.randint(len(track.points), (POINTS,), generator=generator)]
                points.append(drawn)
                places.append(drawn + offset)
        moved = state.model.moved_points(torch.cat(points).to(state.device), level, float(time)).cpu()
        found: Tensor = ((moved - torch.cat(places)) / state.model.deformations[1].unit).norm(dim=1).mean()
        return found

    def _teach(self, state: TrainState) -> None:
        """Trains the deformations by `term` alone."""
        fields, rates = state.model.deformations.values(), state.config.rates
        for field in fields:  # fresh planes are the same at all times, from where no gradient leads
            noise = torch.randn(field.planes.grid.shape, generator=state.noise.generator)
            field.planes.grid.data.add_(rates.planes[0] * noise.to(state.device))
        groups = (
            ([field.planes.grid for field in fields], rates.planes[0]),
            ([p for field in fields for p in field.weights], rates.deformation[0]),
        )
        adam = torch.optim.Adam([{"params": parameters, "lr": rate} for parameters, rate in groups])
        fall = torch.optim.lr_scheduler.ExponentialLR(adam, DECAY ** (1 / STEPS))
        for k in range(STEPS):
            loss = self.term(state, (1, state.model.level)[k % 2])
            adam.zero_grad()
            assert loss is not None
            loss.backward()
            adam.step()
            fall.step()
        state.optimiser.zero_grad()

    def stored(self) -> dict[str, Any]:
        """The tracks, as tensors."""
        return {"tracks": [tuple(track) for track in self._tracks]}

    def restore(self, stored: Mapping[str, Any]) -> None:
        self._tracks = [Track(*track) for track in stored["tracks"]]
