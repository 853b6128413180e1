"""Start points of what moves, where it is at the key instant.

A capture's points, and those of `stereo`, are of what stands still: a body that flies through a room has none, and no
gradient makes it appear before a wall that has. A pixel of a view near the key instant shows something that moves if
nowhere along its ray a colour is alike in views of other times by cameras near it. Its point is where views near the
key instant agree on a colour (photo-consistency: Seitz and Dyer, Photorealistic scene reconstruction by voxel coloring,
1997), which a body that moves by less than its size between them does. A point found by one view alone is chance.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from pd4dgs_codec.data.view import Dataset, View, shrunk_view
from pd4dgs_codec.train.schedule import NEAR_SHARE
from pd4dgs_codec.train.stereo import AMBIGUOUS, SIZE, rays_of

#: Views near the key instant; views of other times, at which a body has left its place, that tell what stands still.
NEAR, OTHERS = 6, 8
#: Pixels of a view that are searched, about, evenly spread over what differs from the background.
PIXELS = 3000
#: Colours are alike if no channel differs by more. A place stands still if it is alike in a share STILL of the other
#: views; a body is there if it is alike in AGREE views near the key instant besides its own.
ALIKE, STILL, AGREE = 0.12, 0.6, 3
#: Cells along the longest side of the box of which each must have points of two views.
CELLS = 32


@torch.no_grad()
def moving_starts(dataset: Dataset, key: float) -> Tensor:
    """float32 [n, 3] points, world, of what moves, where it is at the key instant `key`, normalised time."""
    views, none = dataset.train, torch.zeros(0, 3)
    order = sorted(range(len(views)), key=lambda index: abs(views[index].time - key))
    away = [index for index in order if abs(views[index].time - key) >= 2 * NEAR_SHARE]
    near = [Photo(views[index]) for index in order[:NEAR] if index not in away]
    if len(near) <= AGREE or len(away) < OTHERS:
        return none
    eyes = np.stack([-view.viewmat[:3, :3].T @ view.viewmat[:3, 3] for view in views])
    others: dict[int, Photo] = {}
    low, high = torch.from_numpy(np.array(dataset.box, np.float32))
    background = torch.tensor(dataset.background)
    found, owners = [none], [torch.zeros(0, dtype=torch.int64)]
    searched: list[tuple[Tensor, Tensor]] = []
    for own in near:
        shown = own.valid & ((own.colour - background).abs() > ALIKE).any(-1)
        own.stride = max(1, round(math.sqrt(int(shown.sum()) / PIXELS)))
        shown = shown[:: own.stride, :: own.stride]
        pixels = shown.nonzero() * own.stride
        colour = own.colour[pixels[:, 0], pixels[:, 1]]
        rays = rays_of(own.view, pixels, low, high, dataset.near)
        distance = np.linalg.norm(eyes[away] - rays.eye.numpy(), axis=1)
        beside = [away[k] for k in distance.argsort(kind="stable")[:OTHERS]]
        others |= {index: Photo(views[index]) for index in beside if index not in others}
        still = torch.stack([others[index].contrast(rays.places, colour[:, None]) for index in beside])
        share = (still <= ALIKE).sum(0) / still.isfinite().sum(0).clamp(min=OTHERS // 2)
        moves = rays.inside & (share.amax(1) < STILL)
        own.moves = torch.zeros(shown.shape).masked_scatter(shown, moves.float())
        own.moves = max_pool2d(own.moves[None], 3, 1, 1)[0] > 0
        searched.append((rays.places[moves], colour[moves]))
    for i, (own, (places, colour)) in enumerate(zip(near, searched, strict=True)):
        agree = torch.stack(
            [other.contrast(places, colour[:, None], moving=True) for other in near if other is not own]
        )
        contrast = agree.nan_to_num(1.0).sort(0).values[AGREE - 1]
        least, best = contrast.min(1)
        clear = (least <= ALIKE) & ((contrast <= ALIKE).float().mean(1) <= AMBIGUOUS)
        found.append(places[clear, best[clear]])
        owners.append(torch.full((len(found[-1]),), i))
    points, owner = torch.cat(found), torch.cat(owners)
    return points[_found_twice(torch.floor(points / ((high - low).max() / CELLS)), owner)]


class Photo:
    """A view for the search, at most about twice SIZE pixels on the shorter side. colour: float32 [H, W, 3], 0..1,
    means over 3 x 3 pixels. valid: bool [H, W]. time: normalised."""

    def __init__(self, view: View):
        self.view = view = shrunk_view(view, max(1, min(view.width, view.height) // SIZE))
        image = torch.from_numpy(view.image.astype(np.float32) / 255).permute(2, 0, 1)
        self.colour = avg_pool2d(image, 3, 1, 1, count_include_pad=False).permute(1, 2, 0)
        mask = np.ones(view.image.shape[:2], bool) if view.mask is None else np.array(view.mask)
        self.valid, self.time = torch.from_numpy(mask), float(view.time)
        self.moves, self.stride = self.valid, 1
        viewmat, K = (np.array(matrix, np.float32) for matrix in (view.viewmat, view.K))
        self._turn, self._shift = torch.from_numpy(K @ viewmat[:3, :3]).T, torch.from_numpy(K @ viewmat[:3, 3])

    def at(self, places: Tensor, *, moving: bool = False) -> tuple[Tensor, Tensor]:
        """(colours [..., 3] at places [..., 3], world; bool [...]: whether the view shows them)."""
        x, y, z = (places @ self._turn + self._shift).unbind(-1)
        height, width = self.valid.shape
        column, row = (x / z).clamp(0, width - 1).long(), (y / z).clamp(0, height - 1).long()
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width * z) & (y < height * z)
        shown = self.moves[row // self.stride, column // self.stride] if moving else self.valid[row, column]
        return self.colour[row, column], inside & shown

    def contrast(self, places: Tensor, colour: Tensor, *, moving: bool = False) -> Tensor:
        """[...]: the largest difference of a channel of `colour` [..., 3] at places [..., 3]; NaN outside the view, and
        if `moving` where it shows nothing that moves."""
        found, inside = self.at(places, moving=moving)
        return (found - colour).abs().amax(-1).where(inside, torch.nan)


def _found_twice(cells: Tensor, owner: Tensor) -> Tensor:
    """bool [n]: in which of the `cells` [n, 3] there are points of two owners (int64 [n])."""
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    owners = torch.unique(torch.stack([cell, owner]), dim=1)[0].bincount()
    twice: Tensor = owners[cell] > 1
    return twice
