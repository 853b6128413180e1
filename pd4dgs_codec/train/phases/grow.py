"""Growing and pruning of anchors as in Scaffold-GS: grow where image gradients are large, prune transparent ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import Picture
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train import workers
from pd4dgs_codec.train.initialise import fresh_mask_logits, near_box
from pd4dgs_codec.train.phases import Phase
from pd4dgs_codec.train.state import TrainState, fresh_statistics

#: Cell sizes of the growing levels, in voxels, coarse to fine; the gradient threshold doubles from one to the next.
CELLS = (16, 4, 1)
#: An anchor is pruned when its mean summed opacity per visit is below this ...
MIN_MEAN_OPACITY = 0.005
#: ... over at least MIN_ANCHOR_VISITS; a Gaussian's gradient counts after at least MIN_SLOT_VISITS.
MIN_ANCHOR_VISITS = 40
MIN_SLOT_VISITS = 10


class Grow(Phase):
    """Collects statistics from every picture of the first half of a run, and grows and prunes anchors at intervals."""

    def due(self, state: TrainState) -> bool:
        """At the positions of `Schedule.grow`, but not if one long step of a timed run ends behind all phases that know
        the anchors by number."""
        return state.position < state.schedule.rounding and any(map(state.reached, state.schedule.grow))

    @torch.no_grad()
    def observe(self, state: TrainState, pictures: Sequence[Picture]) -> None:
        """Adds the statistics of a step's pictures, of all workers, after the backward passes."""
        if state.schedule.iterations is None or state.position > state.schedule.grow.stop:
            return
        found = state.statistics
        if workers.count() > 1:
            found = fresh_statistics(*found["pull"].shape)
        for picture in pictures:
            _add(found, picture, state.config.views_per_step)
        if workers.count() > 1:
            workers.add_up(list(found.values()))
            state.statistics = {name: value + found[name] for name, value in state.statistics.items()}

    @torch.no_grad()
    def apply(self, state: TrainState, record: dict[str, Any]) -> None:
        """Prunes and grows anchors, and resets the statistics that decided it."""
        model, statistics = state.model, state.statistics
        most = state.size.max_anchors
        visited = statistics["anchor_visits"] >= MIN_ANCHOR_VISITS
        keep = torch.arange(len(model.anchor_q))
        if state.position >= state.schedule.moving:
            keep = _opaque(model, statistics, visited)
        sizes = CELLS if len(model.anchor_q) < most else ()
        cells = _new_cells(model, statistics, sizes, state.config.grow_threshold, state.generator)
        record["pruned"] = len(model.anchor_q) - len(keep)
        added = _anchors(model, *(part[: max(most - len(keep), 0)] for part in cells))
        used = statistics["visits"] >= MIN_SLOT_VISITS
        for name, where in (("opacity", visited), ("anchor_visits", visited), ("pull", used), ("visits", used)):
            statistics[name][where] = 0
        state.replace_anchors(keep.to(state.device), added)
        record["grown"] = len(added["anchor_q"])


def _add(statistics: dict[str, Tensor], picture: Picture, views: int) -> None:
    """Adds the statistics of a picture, whose loss was divided by `views`."""
    gradient, gaussians = picture.meta["means2d"].grad, picture.gaussians
    if gradient is None or not len(gaussians.slots):
        return
    drawn = (picture.meta["radii"][0] > 0).all(-1)
    height, width = picture.alpha.shape
    scale = gradient.new_tensor([0.5 * width, 0.5 * height])  # the threshold is in normalised image units
    pull = (gradient[0] * views * scale).norm(dim=1)
    slots = gaussians.slots[drawn].cpu()
    statistics["pull"].view(-1).index_add_(0, slots, pull[drawn].cpu())
    statistics["visits"].view(-1).index_add_(0, slots, torch.ones(len(slots)))
    rows = gaussians.anchors.cpu()
    statistics["opacity"].index_add_(0, rows, gaussians.raw_opacity.clamp(min=0).sum(1).cpu())
    statistics["anchor_visits"].index_add_(0, rows, torch.ones(len(rows)))


def _opaque(model: Model, statistics: dict[str, Tensor], visited: Tensor) -> Tensor:
    """int64 [n]: the anchors that are neither transparent nor masked out; all if there are none."""
    faint = visited & (statistics["opacity"] < MIN_MEAN_OPACITY * statistics["anchor_visits"])
    faint[: model.frozen] = False
    keep = (~faint & (model.masks(2).cpu() > MASK_THRESHOLD)).nonzero()[:, 0]
    return keep if len(keep) else torch.arange(len(faint))


def _anchors(model: Model, cells: Tensor, feature: Tensor) -> dict[str, Tensor]:
    """The attributes of new anchors, by name. cells, feature: from `_new_cells`."""
    device, n = model.feature.device, len(cells)
    size = (cells[:, 3].double() * model.info.voxel_size).float()
    found = {
        "anchor_q": cells[:, :3].to(torch.int32),
        "feature": feature,
        "scaling_log": size.log()[:, None].repeat(1, 6),
        "offset": torch.zeros(n, *model.offset.shape[1:]),
        "mask_logits": fresh_mask_logits(n, model.level),
    }
    return {name: value.to(device) for name, value in found.items()}


def _new_cells(
    model: Model, statistics: dict[str, Tensor], sizes: Sequence[int], threshold: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Free cells of `sizes` where Gaussians have large gradients, the largest first: int64 [n, 4] voxel cell and cell
    size; float [n, D] feature."""
    mean_pull = (statistics["pull"] / statistics["visits"].clamp(min=1)).flatten()
    seen = statistics["visits"].flatten() >= MIN_SLOT_VISITS
    anchor_q, feature = model.anchor_q.cpu(), model.feature.detach().cpu()
    taken = anchor_q.to(torch.int64)
    found = [(torch.zeros(0, 4, dtype=torch.int64), feature[:0], torch.zeros(0))]
    for i, size in enumerate(sizes):
        wanted = seen & (mean_pull >= threshold * 2**i)
        wanted &= torch.rand(len(wanted), generator=generator) < 1 - 0.5 ** (i + 1)
        slots, rows, position = _inside(model, wanted.nonzero()[:, 0])
        if len(slots) == 0:
            continue
        cells = torch.round(position / size).to(torch.int64) * size
        unique, where = torch.unique(cells, dim=0, return_inverse=True)
        strength = torch.zeros(len(unique)).scatter_reduce_(0, where, mean_pull[slots], "amax")
        grown = torch.full((len(unique), feature.shape[1]), -math.inf)
        grown.scatter_reduce_(0, where[:, None].expand(-1, feature.shape[1]), feature[rows], "amax")
        occupied = torch.div(taken + size // 2, size, rounding_mode="floor")
        free = ~contained(torch.div(unique, size, rounding_mode="floor"), occupied)
        sized = torch.cat([unique[free], torch.full((int(free.sum()), 1), size)], dim=1)
        found.append((sized, grown[free], strength[free]))
        taken = torch.cat([taken, unique[free]])
    cells, features, strengths = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(strengths, descending=True, stable=True)
    return cells[order], features[order]


def _inside(model: Model, slots: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(slots, their anchors, float64 [n, 3] their positions in voxels) of the Gaussians that lie near the box."""
    anchor_q, scaling = model.anchor_q.cpu(), model.scaling_log.detach().cpu().exp()
    rows = slots // model.widths.slots
    shift = model.offset.detach().cpu().view(-1, 3)[slots] * scaling[rows, :3]
    position = anchor_q[rows].double() + shift.double() / model.info.voxel_size
    inside = near_box(position, torch.from_numpy(model.info.box).double() / model.info.voxel_size)
    return slots[inside], rows[inside], position[inside]


def contained(rows: Tensor, among: Tensor) -> Tensor:
    """bool [n]: which int64 rows [n, 3] occur in `among` [m, 3]."""
    _, index = torch.unique(torch.cat([rows, among]), dim=0, return_inverse=True)
    return torch.isin(index[: len(rows)], index[len(rows) :])
