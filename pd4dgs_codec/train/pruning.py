"""Anchors that the pictures hardly need: once growing has ended they leave the model, or layer 0.

Growing makes more anchors than a scene can use, and the masks do not tell which: the rate presses on all alike, and a
small mask is not a small loss. So what an anchor is worth is measured, by the harm of its absence in training views.
Where many share a place each is needless, but not all of them: in each of several rounds only a part of the anchors,
scattered over the scene, may leave, and what is left is measured anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from pd4dgs_codec.model.harm import anchor_harm
from pd4dgs_codec.model.masks import mask_logits
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.rounding import Rounding
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.optimiser import Optimiser
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS
from pd4dgs_codec.train.shot import Shot

#: `anchor_harm` or `step_harm`.
HarmOf = Callable[..., tuple[Tensor, Tensor, Tensor]]
#: Training views in which it is measured, in each round others.
VIEWS = 24
#: Shorter runs have not learnt half way what they will need.
MIN_ITERATIONS = 500
#: Mask of an anchor at a level that it has left: under the threshold, so that it is neither drawn there nor sent.
GONE = 1e-3


def prune(
    model: Model,
    optimiser: Optimiser,
    shots: Sequence[Shot],
    levels: Sequence[int],
    share: float,
    turn: int,
    rounding: Rounding,
) -> tuple[Tensor, int]:
    """Takes out the anchors whose absence together adds `share` at most to the squared error of any of `levels`, then
    out of level 0 those that add as much there and are needed above it; only anchors whose `turns` is `turn`.

    Returns int64 [n], the anchors that stayed, and how many of them left level 0. Anchors that no shot comes near stay,
    and all do where none would be left: better a needless model than none.
    """
    calm = replace(rounding, noise=None)
    harms = workers.alike(
        lambda: torch.stack([relative_harm(model, level, shots, calm, anchor_harm) for level in levels])
    )
    harms[:, turns(model.anchor_q) != turn] = torch.inf
    needless = least(harms.amax(0), share)
    keep = (~needless | needless.all()).nonzero()[:, 0]
    optimiser.keep_anchors(keep)
    later = least(harms[0, keep], share)
    stays = (model.masks(0) > MASK_THRESHOLD) & ~later
    if levels[0] > 0 or model.level == 0 or not stays.any():
        return keep, 0
    _leave_level_0(model, later)
    return keep, int(later.sum())


def relative_harm(model: Model, level: int, shots: Sequence[Shot], rounding: Rounding, harm_of: HarmOf) -> Tensor:
    """float64 [N]: the squared error that `harm_of` says each anchor adds at `level`, such as its absence would, over
    what there is. Infinite where no shot comes near it."""
    n, device = len(model.anchor_q), model.feature.device
    total = torch.zeros(n, dtype=torch.float64, device=device)
    met = torch.zeros(n, dtype=torch.bool, device=device)
    error, generator = 0.0, torch.Generator().manual_seed(0)
    for shot in shots:
        weights, place = shot.target.weights, (level, shot.view.time, shot.view.camera)
        harm, near, image = harm_of(model, *place, generator, weights=weights, rounding=rounding)
        total += harm
        met |= near
        error += shot.squared_error(image)
    return torch.where(met, total / max(error, 1e-12), torch.inf)


def turns(anchor_q: Tensor) -> Tensor:
    """int64 [N], 0 .. PRUNING_ROUNDS - 1: the round in which each anchor may leave. A hash of its voxel, so that it is
    the same in every round (Teschner et al., Optimized spatial hashing for collision detection, 2003)."""
    x, y, z = anchor_q.to(torch.int64).unbind(1)
    return (((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) >> 8) % PRUNING_ROUNDS


def least(harm: Tensor, share: float) -> Tensor:
    """bool [N]: the anchors of least harm, `share` at most together. harm: float64 [N] >= 0, may be infinite."""
    order = harm.argsort(stable=True)
    found = torch.zeros(len(harm), dtype=torch.bool, device=harm.device)
    found[order[harm[order].cumsum(0) <= share]] = True
    return found


@torch.no_grad()
def _leave_level_0(model: Model, rows: Tensor) -> None:
    """The anchors `rows` (bool [N]) are there from level 1 on only; their masks at levels 1 and 2 stay."""
    masks = torch.stack([model.masks(level) for level in range(3)], dim=1)[rows]
    masks[:, 0] = GONE
    logits = torch.from_numpy(mask_logits(masks.cpu().numpy()))
    model.mask_logits[rows] = logits.to(model.mask_logits)
