"""Start points of a capture without any, by stereo between its cameras.

Random points fill the space in front of the cameras. Where walls have little texture, they stay as fog that training
views do not show and others do. Therefore points are searched for along the rays of pixels with contrast: at the right
depth, the surroundings of a pixel look alike in its own view and in its neighbours (plane sweep: Collins, A space-sweep
approach to true multi-image matching, 1996). Normalised cross-correlation ignores the exposure of each camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, unfold

from pd4dgs_codec.data.view import Dataset, View, depth_bounds, points_box, shrunk_view, spans_volume, thinned
from pd4dgs_codec.train import workers

#: Views that are searched, and patches of PATCH x PATCH pixels in each.
VIEWS, PIXELS, PATCH = 32, 1000, 5
#: Pictures are searched at a size of at least this many pixels on the shorter side, if they have more.
SIZE = 180
#: Steps of 1/depth from NEAREST, a share of the cameras' distance from the middle of the box, to 1/NEAREST of it.
DEPTHS, NEAREST = 100, 0.2
#: Neighbours of a view: so many of the nearest cameras that are LEAST_BASE of that distance away, an angle of 3 degrees
#: as in COLMAP. Two of them have to agree, since others may not see the point.
NEIGHBOURS, AGREE, LEAST_BASE = 4, 2, 0.05
#: A depth is taken if its correlation is ALIKE, and CLEAR above that of depths a patch or more away.
ALIKE, CLEAR = 0.8, 0.05
#: Depths on a ray within the box. A pixel's colour tells its depth if a share of at most AMBIGUOUS of them agrees.
DEPTH_STEPS, AMBIGUOUS = 64, 0.3
#: Points are used if at least so many of the searched pixels have one, here and in `phases.matching`: otherwise the
#: cameras are too near to each other, or move too little between views, for depths to be trusted.
LEAST_FOUND = 1 / 6


def with_points(dataset: Dataset, key: float | None) -> Dataset:
    """The dataset with points found by stereo, and with the box and the depths that they span; without them if too few
    are found. key: the key instant, normalised time, or None."""
    views = _chosen(dataset.train, 0.5 if key is None else key)
    points, depths = workers.alike(lambda: stereo_points(views, dataset.box.mean(0)))
    if not spans_volume(points):
        return dataset
    near, far = depth_bounds(depths)
    return replace(dataset, points=points, box=points_box(points).astype(np.float32), near=near, far=far)


def _chosen(views: Sequence[View], key: float) -> Sequence[View]:
    """The views to search: those of the instant nearest `key` if most views of it have neighbours, else evenly spread
    ones."""
    nearest = min(views, key=lambda view: abs(view.time - key)).time
    together = [view for view in views if view.time == nearest]
    return thinned(together if len(together) >= 2 * NEIGHBOURS else views, VIEWS)


def pixel_rays(rotation: Tensor, K: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """[..., 3]: the rays of pixels, in world axes, of depth 1. rotation: [3, 3], world to camera. K: [3, 3]."""
    x, y = (columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]
    return torch.stack([x, y, torch.ones_like(x)], -1) @ rotation


class Rays(NamedTuple):
    """Rays of n pixels, cut by a box. eye: [3]. places: [n, DEPTH_STEPS, 3], world, at depths that are evenly
    spread. inside: bool [n], whether the ray meets the box."""

    eye: Tensor
    places: Tensor
    inside: Tensor


def rays_of(view: View, pixels: Tensor, low: Tensor, high: Tensor, near: float) -> Rays:
    """The rays of `pixels` (int64 [n, 2], row and column), beyond the depth `near` and in the box `low` to `high`."""
    viewmat, K = (torch.from_numpy(np.array(matrix, np.float32)) for matrix in (view.viewmat, view.K))
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    rays = pixel_rays(viewmat[:3, :3], K, *pixels.unbind(1))
    bounds = torch.stack([(low - eye) / rays, (high - eye) / rays])
    first, last = bounds.amin(0).amax(1).clamp(min=near), bounds.amax(0).amin(1)
    depths = first[:, None] + (last - first)[:, None] * ((torch.arange(DEPTH_STEPS) + 0.5) / DEPTH_STEPS)
    return Rays(eye, eye + depths[..., None] * rays[:, None], first < last)


class Eye:
    """A view for the search. picture: float32 [H, W], 0..1, NaN where the view is not valid. position: [3], world.
    rotation: [3, 3], world to camera. K: [3, 3]."""

    def __init__(self, view: View):
        small = shrunk_view(view, max(1, min(view.width, view.height) // SIZE))
        self.picture = torch.from_numpy(small.image.astype(np.float32).mean(2) / 255)
        if small.mask is not None:
            self.picture[torch.from_numpy(~small.mask)] = torch.nan
        viewmat, self.K = (torch.from_numpy(np.array(matrix, np.float32)) for matrix in (small.viewmat, small.K))
        self.rotation = viewmat[:3, :3]
        self.position = -self.rotation.T @ viewmat[:3, 3]

    def patches(self) -> tuple[Tensor, Tensor]:
        """(float32 [m, PATCH²], the surroundings of each pixel that is not too near to the border, by line; int64 [n],
        the indices of those whose contrast is at least the mean)."""
        if min(self.picture.shape) < PATCH:
            return torch.zeros(0, PATCH**2), torch.zeros(0, dtype=torch.int64)
        found = unfold(self.picture[None, None], PATCH)[0].T
        contrast = found.std(1)
        return found, (contrast >= contrast.nanmean()).nonzero()[:, 0]

    def sample(self, places: Tensor) -> Tensor:
        """[n, p]: the picture at places [n, p, 3]; NaN where one of the p is outside."""
        x, y, z = ((places - self.position) @ self.rotation.T).unbind(-1)
        height, width = self.picture.shape
        column = (self.K[0, 0] * x / z + self.K[0, 2]) * 2 / width - 1
        row = (self.K[1, 1] * y / z + self.K[1, 2]) * 2 / height - 1
        inside = ((z > 0) & (column.abs() < 1) & (row.abs() < 1)).all(1)
        found = torch.full(x.shape, torch.nan)
        grid = torch.stack([column[inside], row[inside]], -1)[None]
        found[inside] = grid_sample(self.picture[None, None], grid, align_corners=False)[0, 0]
        return found


@torch.no_grad()
def stereo_points(views: Sequence[View], middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(float32 [n, 3] points, world; float32 [n] their depths in the views that found them); none if fewer than
    LEAST_FOUND of the searched pixels have one. middle: [3], around which the cameras stand or at which they look."""
    eyes, generator = [Eye(view) for view in views], torch.Generator().manual_seed(0)
    at = torch.stack([eye.position for eye in eyes])
    unit = float((at - torch.from_numpy(middle)).norm(dim=1).median())
    apart, ahead = torch.cdist(at, at) / unit, torch.stack([eye.rotation[2] for eye in eyes])
    depths: Tensor = unit / torch.linspace(1 / NEAREST, NEAREST, DEPTHS)
    found, searched = [(torch.zeros(0, 3), torch.zeros(0))], 0
    for i, eye in enumerate(eyes):
        beside = (apart[i] >= LEAST_BASE) & (ahead @ ahead[i] > 0)
        neighbours = [eyes[j] for j in apart[i].argsort().tolist() if beside[j]][:NEIGHBOURS]
        patches, pixels = eye.patches()
        pixels = pixels[torch.randperm(len(pixels), generator=generator)[:PIXELS]]
        searched += len(pixels)
        if len(neighbours) >= AGREE:
            found.append(_search(eye, neighbours, patches[pixels], pixels, depths))
    points, depth = (torch.cat(parts).numpy() for parts in zip(*found, strict=True))
    enough = len(points) > LEAST_FOUND * searched
    return (points, depth) if enough else (points[:0], depth[:0])


def _search(
    eye: Eye, neighbours: Sequence[Eye], patches: Tensor, pixels: Tensor, depths: Tensor
) -> tuple[Tensor, Tensor]:
    """(points [n, 3], depths [n]) of the pixels whose depth is clear. patches, pixels: from `Eye.patches`."""
    width = eye.picture.shape[1] - PATCH + 1
    row, column = pixels // width, pixels % width
    offsets = torch.arange(PATCH)
    down, across = offsets.repeat_interleave(PATCH), offsets.repeat(PATCH)
    rays = pixel_rays(eye.rotation, eye.K, row[:, None] + down, column[:, None] + across)
    own = _normalised(patches)
    alike = torch.full((len(pixels), len(depths)), -1.0)
    for i, depth in enumerate(depths):
        places = eye.position + depth * rays
        scores = torch.stack([(own * _normalised(other.sample(places))).sum(1) for other in neighbours])
        alike[:, i] = scores.nan_to_num(-1.0).topk(AGREE, dim=0).values.mean(0)
    best, k = alike.max(1)
    beside = (torch.arange(len(depths)) - k[:, None]).abs() < PATCH
    clear = (best >= ALIKE) & (best - alike.masked_fill(beside, -1).amax(1) >= CLEAR) & (k > 0) & (k < len(depths) - 1)
    found = depths[k[clear]]
    return eye.position + found[:, None] * rays[clear, PATCH**2 // 2], found


def _normalised(patches: Tensor) -> Tensor:
    """Patches [n, p] of mean 0 and norm 1; NaN without contrast."""
    patches = patches - patches.mean(1, keepdim=True)
    norm = patches.norm(dim=1, keepdim=True)
    found: Tensor = patches / norm.where(norm > 0, torch.nan)
    return found
