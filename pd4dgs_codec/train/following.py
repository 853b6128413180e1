"""Follows what moves through all views, from the key instant outwards, before any picture of another instant is learnt.

The points that `movers` finds hang together in bodies. The offset of a body at the next instant is the one at which its
points have their colours in the views of this instant and of those before, if it moves evenly among them: one view
shows no depth, several do. No model of the scene is needed, and a body may move by its size between instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pd4dgs_codec.data.view import Dataset, thinned
from pd4dgs_codec.train.movers import AGREE, ALIKE, CELLS, NEAR, Photo

#: Views that are searched at most.
VIEWS = 240
#: Bodies that are followed at most, the largest first, and points of each that are compared.
BODIES, SAMPLE = 12, 48
#: Steps of the search, in sizes of the body, each up to REACH times in every direction.
STEPS, REACH = (0.3, 0.12, 0.06), 2
#: A body is lost where its points are less than KEPT times as alike as at the key instant at AGREE instants in a row.
KEPT = 0.4
#: It moves if its points are so much more alike where it is followed than where it was.
MOVES = 0.03


class Track(NamedTuple):
    """points: [n, 3], world, of a body at the key instant. times: [T], normalised. offsets: [T, 3], its way."""

    points: Tensor
    times: Tensor
    offsets: Tensor


@torch.no_grad()
def followed(dataset: Dataset, points: Tensor, key: float) -> list[Track]:
    """The tracks of the bodies to which `points` [n, 3], world, at the key instant `key` belong; none of what stays."""
    pictures = [Photo(view) for view in thinned(sorted(dataset.train, key=lambda view: view.time), VIEWS)]
    cell = float((dataset.box[1] - dataset.box[0]).max()) / CELLS
    near = sorted(pictures, key=lambda picture: abs(picture.time - key))[:NEAR]
    colour = torch.stack([picture.at(points)[0] for picture in near]).median(0).values
    bodies = sorted(bodies_of(points, cell), key=len, reverse=True)[:BODIES]
    tracks = [_followed(pictures, points[rows], colour[rows], key, cell) for rows in bodies if len(rows) > NEAR]
    return [track for track in tracks if track is not None]


def bodies_of(points: Tensor, apart: float) -> list[Tensor]:
    """int64 [n] of each body: the `points` [n, 3] that hang together over gaps of less than `apart`."""
    label, near = torch.arange(len(points)), torch.cdist(points, points) < apart
    while len(points):
        lower = torch.where(near, label, len(points)).amin(1)
        lower = lower[lower]
        if (lower == label).all():
            break
        label = lower
    return [(label == one).nonzero()[:, 0] for one in set(label.tolist())]


class _Body(NamedTuple):
    points: Tensor
    colour: Tensor

    def alike(self, pictures: Sequence[Photo], time: float, offset: Tensor, speed: Tensor) -> Tensor:
        """[k]: how alike, 0..1, the points are in the pictures at each of k offsets [k, 3] at `time` and speeds."""
        total = torch.zeros(2, len(offset))
        for picture in pictures:
            places = self.points + (offset + speed * (picture.time - time))[:, None]
            contrast = picture.contrast(places, self.colour)
            alike, seen = (-(contrast / ALIKE).square()).exp().nan_to_num(0.0), contrast.isfinite().float()
            total += torch.stack([alike.mean(1), seen.mean(1).clamp(min=0.5)])
        return total[0] / total[1]


def _followed(pictures: Sequence[Photo], points: Tensor, colour: Tensor, key: float, cell: float) -> Track | None:
    """The track of one body; None if it stays where it is."""
    chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:SAMPLE]
    body = _Body(points[chosen], colour[chosen])
    way = _way(pictures, body, key, cell)
    still = torch.zeros(1, 3)
    gained = [_alike_at(pictures, body, *place) - _alike_at(pictures, body, place[0], still) for place in way]
    if len(way) < NEAR or torch.cat(gained).mean() < MOVES:
        return None
    return Track(points, torch.tensor([time for time, _ in way]), torch.cat([offset for _, offset in way]))


def _alike_at(pictures: Sequence[Photo], body: _Body, time: float, offset: Tensor) -> Tensor:
    """As `_Body.alike`, in the pictures of one instant."""
    return body.alike([picture for picture in pictures if picture.time == time], time, offset, torch.zeros(1, 3))


def _way(pictures: Sequence[Photo], body: _Body, key: float, cell: float) -> list[tuple[float, Tensor]]:
    """(time, offset [1, 3]) of a body at each instant at which it is not lost."""
    size = max(2 * float((body.points - body.points.mean(0)).norm(dim=1).mean()), cell)
    times = sorted({picture.time for picture in pictures})
    grid = torch.cartesian_prod(*[torch.arange(-REACH, REACH + 1.0)] * 3)
    here, start = torch.zeros_like(grid), torch.zeros(1, 3)
    near = sorted(pictures, key=lambda picture: abs(picture.time - key))[:NEAR]
    least = min(later - time for time, later in zip(times, times[1:], strict=False))
    for step in STEPS:
        speeds = start + grid * step * size / least
        start = speeds[body.alike(near, key, here, speeds).argmax()][None]
    first, found = float(body.alike(near, key, here[:1], start)), list[tuple[float, Tensor]]()
    for sign in (-1, 1):
        offset, speed, last, lost = here[:1], start, key, 0
        for time in sorted((t for t in times if (t - key) * sign >= 0), key=lambda t: abs(t - key)):
            behind = [picture for picture in pictures if (picture.time - time) * sign <= 0]
            window = sorted(behind, key=lambda picture: abs(picture.time - time))[:NEAR]
            span, before, offset = abs(window[-1].time - time), offset, offset + speed * (time - last)
            for step in STEPS:  # the whole window moves, or its newest instant most
                moves = grid * step * size
                turned = moves * (sign / span) if span else here
                offsets, speeds = torch.cat([offset + moves] * 2), torch.cat([speed + here, speed + turned])
                best = body.alike(window, time, offsets, speeds).argmax()
                offset, speed = offsets[best][None], speeds[best][None]
            if not span and time != last:
                speed = (offset - before) / (time - last)
            lost = 0 if float(body.alike(window, time, offset, speed)) > KEPT * first else lost + 1
            found.append((time, offset))
            last = time
            if lost == AGREE:
                found = found[:-AGREE]
                break
    return found
