"""Guides motion where pictures cannot: points of what moves are found at each instant and matched between instants.

A picture teaches motion only where a body's picture and its image overlap. A small body that moves by its own size in a
few views overlaps nowhere, and fades. Its points are found without a model of its motion, where pixels that differ from
level 0 agree in successive views (photo-consistency: Seitz and Dyer, Photorealistic scene reconstruction by voxel
coloring, 1997). The deformation moves the points of the key instant to another instant, where the nearest point of
similar colour attracts each (iterative closest points: Besl and McKay, A method for registration of 3-D shapes, 1992).
Large surfaces slide along themselves in such matches, so the term ends early. `opening` finds steady motion better.

If most of what the views show is elsewhere in level 0, bodies would fade before their motion is learnt. Points then
guide the run: matching is stronger, pictures of levels 1 and 2 train motion alone at first, and level 0 is
trained near the key instant alone. Where much stands still, it would learn too little from so few pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from pd4dgs_codec.data.view import View
from pd4dgs_codec.train import phases, workers
from pd4dgs_codec.train.movers import ALIKE
from pd4dgs_codec.train.phases.levels import MIN_VIEWS, images, other_views
from pd4dgs_codec.train.schedule import OPENING_SHARE
from pd4dgs_codec.train.state import TrainState
from pd4dgs_codec.train.stereo import AMBIGUOUS, DEPTH_STEPS, LEAST_FOUND, rays_of

#: Weights of the loss term at the start of a run, by whether points guide it (`TrainState.guided`). They fall to 0 at
#: OPENING_SHARE of the run.
WEIGHT = {False: 0.4, True: 2.0}
#: Instants that a step matches with the key instant, and points of the key instant for each.
INSTANTS, SAMPLE = 4, 150
#: Training views that are searched at most; more views are searched in groups of three, evenly spread.
MOST_VIEWS = 240
#: Pixels of a view that are searched, at random.
PIXELS = 400
#: Most of what the views show is elsewhere in level 0 if such pixels are at least this share of those that differ from
#: the background: a body that has moved away changes the pixels that it had and those that it has.
ELSEWHERE = 1.0
#: A match has the least distance, to which a difference in colour adds COLOUR_WEIGHT times. It attracts if the colours
#: are ALIKE. Distances are in units of the deformation, colour differences are means over RGB.
COLOUR_WEIGHT = 4.0


class Points(NamedTuple):
    """n points of what moves. time: [n], normalised. position: [n, 3], world. colour: [n, 3], 0..1."""

    time: Tensor
    position: Tensor
    colour: Tensor

    @staticmethod
    def joined(parts: Sequence[Points]) -> Points:
        """All points of `parts`."""
        none = Points(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, 3))
        return Points(*(torch.cat(values) for values in zip(none, *parts, strict=True)))

    def at(self, index: Tensor) -> Points:
        """The points at an index or in a mask."""
        return Points(*(values[index] for values in self))


class Match(phases.Phase):
    """Finds the points at the end of the coarse phase; then `term` matches them."""

    def __init__(self) -> None:
        self._instants: list[Points] = []  #: ascending
        self._here: Points | None = None  #: those of the key instant

    @property
    def points(self) -> Points:
        """All points, by time."""
        return Points.joined(self._instants)

    def due(self, state: TrainState) -> bool:
        """At the end of the coarse phase, if motion is not steady."""
        return state.reached(state.schedule.coarse_end) and state.opened

    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Finds the points and logs their number; sets `TrainState.guided`."""
        found, share = workers.alike(lambda: moving_points(state))
        self._keep(found)
        record |= {"moving_points": len(found.time), "moving_share": share}
        state.guided = bool(self._instants) and share >= ELSEWHERE

    def weight(self, state: TrainState) -> float:
        """The weight of `term` at this step."""
        return WEIGHT[state.guided] * max(0.0, 1 - state.schedule.progress(state.position) / OPENING_SHARE)

    def term(self, state: TrainState, level: int) -> Tensor | None:
        """The mean `attraction` of points of the key instant that `level` moves to other instants; None if there are no
        points, at level 0 and in trials. The points are dropped once the weight is 0."""
        key, generator = state.key, state.noise.generator  # another thread draws from `state.generator` meanwhile
        if self._instants and not self.weight(state):
            self._keep(Points.joined([]))
        if key is None or level == 0 or state.practising or not self._instants:
            return None
        if self._here is None:
            nearest = sorted(self._instants, key=lambda points: abs(float(points.time[0]) - key))
            self._here = Points.joined(nearest[:MIN_VIEWS])
        pulls = []
        for k in torch.randint(len(self._instants), (INSTANTS,), generator=generator).tolist():
            drawn = torch.randint(len(self._here.time), (SAMPLE,), generator=generator)
            pulls.append(attraction(state, level, self._here.at(drawn), self._instants[k]))
        return torch.stack(pulls).mean()

    def _keep(self, found: Points) -> None:
        self._here = None
        self._instants = [found.at(found.time == t) for t in torch.unique(found.time)]

    def stored(self) -> dict[str, Any]:
        """The points, as tensors."""
        return {f"moving_{name}": values for name, values in self.points._asdict().items()}

    def restore(self, stored: Mapping[str, Any]) -> None:
        self._keep(Points(*(stored[f"moving_{name}"] for name in Points._fields)))


def attraction(state: TrainState, level: int, here: Points, there: Points) -> Tensor:
    """The mean over points `here`, moved to the instant of the points `there`, of their distance from their match,
    in units of the deformation; 0 without a match."""
    model, rounding, time = state.model, state.rounding(noisy=False), float(there.time[0])
    unit = model.deformations[1].unit
    moved = model.moved_points(here.position.to(state.device), level, time, rounding).cpu() / unit
    place = there.position / unit
    with torch.no_grad():
        contrast = torch.cdist(here.colour, there.colour, p=1) / 3
        match = (torch.cdist(moved, place) + COLOUR_WEIGHT * contrast).argmin(1)
        alike = contrast.gather(1, match[:, None])[:, 0] <= ALIKE
    distance = (moved - place[match]).norm(dim=1)
    found: Tensor = (distance * alike).mean()
    return found


# -- finding points ----------------------------------------------------------------------------------------------------


class Evidence(NamedTuple):
    """A view for the search. moved: [H, W], the mean difference of its image from level 0. around: [H, W], the largest
    of these within two pixels. colour: [H, W, 3]. All are means over 3 x 3 pixels. visible: see `TrainingView`."""

    view: View
    moved: Tensor
    around: Tensor
    colour: Tensor
    visible: int


@torch.no_grad()
def moving_points(state: TrainState) -> tuple[Points, float]:
    """(points of what moves, on the CPU, from each training view and the views before and after it in time; the pixels
    that differ from level 0, as a share of those that differ from the background). There are no points if fewer than
    LEAST_FOUND of the searched pixels have one."""
    order = sorted(other_views(state), key=lambda index: state.views.views[index].time)
    stride = 1 if len(order) <= MOST_VIEWS else -(-3 * len(order) // MOST_VIEWS)

    @lru_cache(maxsize=3)
    def evidence(index: int) -> Evidence:
        shown = state.picture(index)
        different = (shown.exposed(images(state, shown, (0,))[0]) - shown.image).abs().mean(-1) * (shown.weights > 0)
        moved, *colour = avg_pool2d(torch.cat([different[None], shown.image.permute(2, 0, 1)]), 3, 1, 1).cpu()
        around = max_pool2d(moved[None], 5, 1, 2)[0]
        return Evidence(shown.view, moved, around, torch.stack(colour, -1), shown.visible)

    low, high = torch.from_numpy(state.model.info.box.copy())
    found, searched, moving, shown, generator = [], 0, 0, 0, torch.Generator().manual_seed(0)
    for k in range(1, len(order) - 1, stride):
        before, own, after = (evidence(order[j]) for j in (k - 1, k, k + 1))
        pixels = (own.moved > ALIKE).nonzero()
        moving, shown = moving + len(pixels), shown + own.visible
        pixels = pixels[torch.randperm(len(pixels), generator=generator)[:PIXELS]]
        searched += len(pixels)
        found.append(_points(own, pixels, (before, after), low, high, state.model.info.near))
    points = Points.joined(found)
    return points if len(points.time) >= LEAST_FOUND * searched else Points.joined([]), moving / max(shown, 1)


def _points(
    own: Evidence, pixels: Tensor, others: Sequence[Evidence], low: Tensor, high: Tensor, near: float
) -> Points:
    """The points of `pixels` (int64 [n, 2], row and column) of view `own`, in the box from `low` to `high` and beyond
    `near`: at the depth at which the colours of three views differ least, if they are ALIKE there, and at a share of at
    most AMBIGUOUS of all depths."""
    rays, colour = rays_of(own.view, pixels, low, high, near), own.colour[pixels[:, 0], pixels[:, 1]]
    contrast = torch.stack([_contrast(rays.places, colour, other) for other in others]).amax(0)
    consistent = contrast <= ALIKE
    best = contrast.argmin(1, keepdim=True)
    clear = rays.inside & consistent.gather(1, best)[:, 0] & (consistent.float().mean(1) <= AMBIGUOUS)
    beside = consistent & ((torch.arange(DEPTH_STEPS) - best).abs() <= 3)  # colours hardly tell neighbours apart
    place = (rays.places * beside[..., None]).sum(1)[clear] / beside.sum(1)[clear, None]
    return Points(torch.full_like(place[:, 0], own.view.time), place, colour[clear])


def _contrast(places: Tensor, colour: Tensor, other: Evidence) -> Tensor:
    """The mean difference [n, depths] of `colour` [n, 3] from a view's colours at `places` [n, depths, 3]; infinite
    outside the view and where it shows nothing that moves."""
    line, column, inside = map(torch.from_numpy, other.view.project(*places.numpy().transpose(2, 0, 1)))
    seen = inside & (other.around[line, column] > ALIKE)
    return torch.where(seen, (other.colour[line, column] - colour[:, None]).abs().mean(-1), torch.inf)
