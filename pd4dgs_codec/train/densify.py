"""Growing and pruning of anchors, after Scaffold-GS: grow where the loss pulls at Gaussians, prune what never shows."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pd4dgs_codec.model.model import Gaussians, Model
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train.initialise import fresh_mask_logits
from pd4dgs_codec.train.optimiser import Optimiser

#: Cell sizes of the growing levels, in voxels, coarse to fine; the gradient threshold doubles from one to the next.
CELLS = (16, 4, 1)
#: An anchor is pruned when its mean summed opacity per visit is below this ...
MIN_MEAN_OPACITY = 0.005
#: ... over at least so many visits; a Gaussian's pull is judged after at least so many.
MIN_ANCHOR_VISITS = 40
MIN_SLOT_VISITS = 10


class Densifier:
    """Gathers how strongly the loss pulls at each Gaussian's image position, then grows and prunes."""

    def __init__(self, model: Model, threshold: float, max_anchors: int):
        self.threshold, self.max_anchors = threshold, max_anchors
        n, slots = len(model.anchor_q), model.widths.slots
        self.pull = torch.zeros(n, slots)
        self.visits = torch.zeros(n, slots)
        self.opacity = torch.zeros(n)
        self.anchor_visits = torch.zeros(n)

    @torch.no_grad()
    def observe(self, gaussians: Gaussians, means2d_grad: Tensor, drawn: Tensor, width: int, height: int) -> None:
        """After a backward pass. means2d_grad [K, 2] per pixel; drawn bool [K]."""
        scale = means2d_grad.new_tensor([0.5 * width, 0.5 * height])  # the threshold is in normalised image units
        pull = (means2d_grad * scale).norm(dim=1)
        slots = gaussians.slots[drawn].cpu()
        self.pull.view(-1).index_add_(0, slots, pull[drawn].cpu())
        self.visits.view(-1).index_add_(0, slots, torch.ones(len(slots)))
        rows = gaussians.anchors.cpu()
        self.opacity.index_add_(0, rows, gaussians.raw_opacity.clamp(min=0).sum(1).cpu())
        self.anchor_visits.index_add_(0, rows, torch.ones(len(rows)))

    @torch.no_grad()
    def adjust(
        self, model: Model, optimiser: Optimiser, generator: torch.Generator, *, grow: bool, prune: bool
    ) -> tuple[int, int]:
        """Prunes and grows as told; forgets the statistics that were judged. Returns (pruned, grown)."""
        masks = model.masks(2).cpu()
        visited = self.anchor_visits >= MIN_ANCHOR_VISITS
        faint = visited & (self.opacity < MIN_MEAN_OPACITY * self.anchor_visits)
        keep = (~faint & (masks > MASK_THRESHOLD)).nonzero()[:, 0]
        if not prune or len(keep) == 0:  # if nothing shows: better a bad model than none
            keep = torch.arange(len(masks))
        cells, feature = self._new_cells(model, generator) if grow else (None, None)
        room = self.max_anchors - len(keep)
        if cells is None or feature is None or room <= 0:
            cells = torch.zeros(0, 4, dtype=torch.int64)
            feature = torch.zeros(0, model.feature.shape[1])
        cells, feature = cells[:room], feature[:room]
        device = model.feature.device
        n = len(cells)
        size = (cells[:, 3].double() * model.info.voxel_size).float()
        pruned = len(masks) - len(keep)
        optimiser.replace_anchors(
            keep.to(device),
            {
                "anchor_q": cells[:, :3].to(torch.int32).to(device),
                "feature": feature.to(device),
                "scaling_log": size.log()[:, None].repeat(1, 6).to(device),
                "offset": torch.zeros(n, *model.offset.shape[1:], device=device),
                "mask_logits": fresh_mask_logits(n, model.level).to(device),
            },
        )
        self._forget_judged(visited, keep, n)
        return pruned, n

    def _forget_judged(self, visited: Tensor, keep: Tensor, added: int) -> None:
        self.opacity[visited] = 0
        self.anchor_visits[visited] = 0
        judged = self.visits >= MIN_SLOT_VISITS
        self.pull[judged] = 0
        self.visits[judged] = 0
        self.keep(keep, added)

    def keep(self, rows: Tensor, added: int = 0) -> None:
        """The anchors `rows` (int64) stay, the others have gone; `added` new ones follow."""
        for name, value in self.state().items():
            setattr(self, name, torch.cat([value[rows.cpu()], value.new_zeros(added, *value.shape[1:])]))

    def _new_cells(self, model: Model, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """(int64 [n, 4] voxel cell and cell size, float [n, D] feature) of free cells, the strongest pull first."""
        mean_pull = (self.pull / self.visits.clamp(min=1)).flatten()
        seen = self.visits.flatten() >= MIN_SLOT_VISITS
        anchor_q, scaling = model.anchor_q.cpu(), model.scaling_log.detach().cpu().exp()
        feature, offset = model.feature.detach().cpu(), model.offset.detach().cpu()
        low, high = (torch.from_numpy(model.info.box[i]).double() / model.info.voxel_size for i in (0, 1))
        reach = 0.5 * (high - low).max()
        taken = anchor_q.to(torch.int64)
        found: list[Tensor] = []
        features: list[Tensor] = []
        strengths: list[Tensor] = []
        for i, size in enumerate(CELLS):
            wanted = seen & (mean_pull >= self.threshold * 2**i)
            wanted &= torch.rand(len(wanted), generator=generator) < 1 - 0.5 ** (i + 1)
            slots = wanted.nonzero()[:, 0]
            if len(slots) == 0:
                continue
            rows = slots // offset.shape[1]
            shift = offset.view(-1, 3)[slots] * scaling[rows, :3]
            position = anchor_q[rows].double() + shift.double() / model.info.voxel_size
            inside = ((position > low - reach) & (position < high + reach)).all(1)
            slots, rows, position = slots[inside], rows[inside], position[inside]
            if len(slots) == 0:
                continue
            cells = torch.round(position / size).to(torch.int64) * size
            unique, where = torch.unique(cells, dim=0, return_inverse=True)
            strength = torch.zeros(len(unique)).scatter_reduce_(0, where, mean_pull[slots], "amax")
            grown = torch.full((len(unique), feature.shape[1]), -math.inf)
            grown.scatter_reduce_(0, where[:, None].expand(-1, feature.shape[1]), feature[rows], "amax")
            occupied = torch.div(taken + size // 2, size, rounding_mode="floor")
            free = ~_contained(torch.div(unique, size, rounding_mode="floor"), occupied)
            found.append(torch.cat([unique[free], torch.full((int(free.sum()), 1), size)], dim=1))
            features.append(grown[free])
            strengths.append(strength[free])
            taken = torch.cat([taken, unique[free]])
        if not found:
            return torch.zeros(0, 4, dtype=torch.int64), feature[:0]
        order = torch.argsort(torch.cat(strengths), descending=True, stable=True)
        return torch.cat(found)[order], torch.cat(features)[order]

    def state(self) -> dict[str, Tensor]:
        """What resuming needs."""
        return {name: getattr(self, name) for name in ("pull", "visits", "opacity", "anchor_visits")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Back to what `state` returned."""
        for name, value in state.items():
            setattr(self, name, value)


def _contained(rows: Tensor, among: Tensor) -> Tensor:
    """bool [n]: which int64 rows [n, 3] occur among `among` [m, 3]."""
    _, index = torch.unique(torch.cat([rows, among]), dim=0, return_inverse=True)
    return torch.isin(index[: len(rows)], index[len(rows) :])
