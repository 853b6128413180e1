"""HexPlane: a 4-D feature field as a product of six 2-D planes per scale.

Per scale, the planes xy, xz, xt, yz, yt, zt are sampled bilinearly (align corners, border clamp) and multiplied; the
scales are concatenated. A numba kernel samples on the CPU (`draw/hexplane.py`), else `sample_reference` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import hexplane as kernels
from pd4dgs_codec.draw.hexplane import SPATIAL, TEMPORAL, PlaneLayout
from pd4dgs_codec.draw.simd import LANES
from pd4dgs_codec.model import plane_terms
from pd4dgs_codec.model.config import DeformationConfig
from pd4dgs_codec.model.networks import round_straight_through, rounded
from pd4dgs_codec.scene import PLANES, Planes, plane_shapes, plane_sides
from pd4dgs_codec.tensors.planes import rate_bits
from pd4dgs_codec.tensors.quantise import quantise
from pd4dgs_codec.threads import kernel_threads

#: Range of the start values of spatial planes.
START = (0.5, 1.5)
#: Cells between independent draws of start values.
SPACING = 4


class _Sample(torch.autograd.Function):
    """`sample_reference` with rounding to `step`, by the kernels. CPU, channels a multiple of LANES."""

    @staticmethod
    def forward(
        ctx: Any, grid: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float, step: float | None
    ) -> Tensor:
        tables = (layout.reso, layout.start, layout.rows)
        spatial = rounded(grid[: layout.n_spatial], step)
        rows = grid.new_empty(layout.n_rows, grid.shape[1])
        kernels.collapse(rows.numpy(), grid.numpy(), *tables, t, 0.0 if step is None else step)
        out = grid.new_empty(len(points), len(layout.reso) * grid.shape[1])
        kernels.sample(out.numpy(), spatial.numpy(), rows.numpy(), *tables, points.numpy(), box.numpy())
        ctx.layout, ctx.t = layout, t
        ctx.save_for_backward(spatial, rows, box, points)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        spatial, rows, box, points = ctx.saved_tensors
        layout, channels = ctx.layout, spatial.shape[1]
        tables = (layout.reso, layout.start, layout.rows)
        # scales fill the threads first; only then are points split, which costs a buffer per part
        parts = max(1, kernel_threads() // len(layout.reso))
        grad = g.new_zeros(layout.n_cells, channels)
        extra = g.new_zeros(parts - 1, layout.n_spatial, channels)
        grad_rows = g.new_zeros(parts, layout.n_rows, channels)
        grad_points = g.new_empty(len(layout.reso), len(points), 3)
        results = [x.numpy() for x in (grad, extra, grad_rows, grad_points)]
        given = [x.numpy() for x in (g.contiguous(), spatial, rows)]
        kernels.sample_backward(*[*results, *given, *tables, points.numpy(), box.numpy()])
        for part in extra:
            grad[: layout.n_spatial] += part
        kernels.collapse_backward(grad.numpy(), grad_rows.numpy().sum(0), *tables, ctx.t)
        return grad, None, None, grad_points.sum(0), None, None


def sample_reference(grid: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float) -> Tensor:
    """The plain torch form of `HexPlane.forward`: grid [cells, C] sampled at points [N, 3]; any device.

    All planes of all scales in one lookup: a GPU takes longer to start an operation than to perform it.
    """
    if not len(points):  # embedding_bag refuses them
        return torch.cat([points[:, :0], grid[:0].repeat(1, len(layout.reso))], 1)
    sides, first, corners, axes = _tables(layout, grid.device)
    unit = torch.cat([(points - box[0]) / (box[1] - box[0]), points.new_full((len(points), 1), t)], 1)
    unit = torch.nan_to_num(unit, nan=0.0, posinf=1.0, neginf=0.0).clamp(0, 1)
    at = unit[:, None] * (sides - 1)  # [N, S, 4]
    low = torch.minimum(at.detach().long(), (sides - 2).clamp(min=0))
    u, v = ((at - low).index_select(2, axis) for axis in axes)  # [N, S, 6]
    i, j = (low.index_select(2, axis) for axis in axes)
    cells = (first + j * sides.index_select(1, axes[0]) + i)[..., None] + corners
    weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], -1)
    found = F.embedding_bag(cells.view(-1, 4), grid, per_sample_weights=weights.view(-1, 4), mode="sum")
    xy, xz, xt, yz, yt, zt = found.view(*u.shape, -1).unbind(2)
    return (xy * xz * xt * yz * yt * zt).flatten(1)


@lru_cache
def _tables(layout: PlaneLayout, device: torch.device) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Returns int64 tensors: `reso` and `start` of the layout; [S, 6, 4] the distances in cells from the lower corner
    of a bilinear sample to all four; and the first and the second axis of each plane, [6] each."""
    first, second = ([axes[k] for _, *axes in PLANES] for k in (0, 1))
    right, up = (layout.reso[:, first] > 1).astype(np.int64), layout.reso[:, first] * (layout.reso[:, second] > 1)
    corners = np.stack([np.zeros_like(up), right, up, right + up], -1)
    arrays = (layout.reso, layout.start, corners, np.array(first), np.array(second))
    reso, start, offsets, *axes = (torch.as_tensor(array, device=device) for array in arrays)
    return reso, start, offsets, (axes[0], axes[1])


class HexPlane(nn.Module):
    """Learnable planes, all in one parameter `grid` [cells, C]; `layout` maps planes to cells.

    box: [2, 3] lower and upper corner, scene units; points are normalised by it and clamped to it. On an axis where
    the corners are equal, points up to it fall on the first cell and points above it on the last.
    resolutions: per scale, cells along x, y, z, t.
    """

    box: Tensor

    def __init__(self, box: np.ndarray, resolutions: Sequence[Sequence[int]], channels: int):
        super().__init__()
        self.register_buffer("box", torch.as_tensor(np.array(box, np.float32)))
        self.layout = PlaneLayout.build(resolutions)
        self.grid = nn.Parameter(torch.ones(self.layout.n_cells, channels))

    @classmethod
    def fresh(cls, config: DeformationConfig, box: np.ndarray) -> HexPlane:
        """Returns untrained planes of the sizes in `config`, see `start`."""
        planes = cls(box, [(side, side, side, times) for side, times in config.scales], config.channels)
        planes.start()
        return planes

    @torch.no_grad()
    def start(self) -> None:
        """Draws start values from the global generator: time planes 1, spatial planes random in START.

        Features, products of planes, then start near 1. The range 0.1..0.5 of public code gives features of about 0.03,
        which separate places and times so slowly that some runs never learn motion. Draws are independent every SPACING
        cells and linear in between, so that cells that no anchor reaches cost few bits.
        """
        for scale in self.layout.views(self.grid.fill_(1)):
            for plane in (scale[name] for name, *_ in SPATIAL):
                height, width, channels = plane.shape
                draws = torch.empty(1, channels, -(-height // SPACING), -(-width // SPACING)).uniform_(*START)
                field = F.interpolate(draws, size=(height, width), mode="bilinear", align_corners=True)
                plane.copy_(field[0].permute(1, 2, 0))

    @property
    def fusible(self) -> bool:
        """Whether the kernels can sample the planes."""
        return self.grid.device.type == "cpu" and self.grid.shape[1] % LANES == 0

    def forward(self, points: Tensor, t: float, step: float | None = None) -> Tensor:
        """Samples features [N, C * scales].

        points: [N, 3], scene units; outside the box they are clamped to it, NaN goes to the lower border.
        t: normalised time, clamped to 0..1.
        step: if given, the planes are rounded to multiples of it; the gradient passes straight through.
        """
        points, box = points.to(self.grid.dtype), self.box.to(self.grid.dtype)
        if self.fusible:
            features: Tensor = _Sample.apply(  # type: ignore[no-untyped-call]
                self.grid, self.layout, box, points.contiguous(), t, step
            )
            return features
        return sample_reference(round_straight_through(self.grid, step), self.layout, box, points, t)

    def confine(self, instants: int) -> None:
        """Replaces the time planes by the nearest ones that are linear between `instants` evenly spaced instants."""
        self._mix_times(self.grid, instants, 0)

    def spread_gradients(self, instants: int) -> None:
        """Replaces the gradients of the time planes, if any, by sums per instant, spread over the cells as a change of
        the instant's value would be."""
        if self.grid.grad is not None:
            self._mix_times(self.grid.grad, instants, 1)

    @torch.no_grad()
    def _mix_times(self, cells: Tensor, instants: int, which: int) -> None:
        """Multiplies time planes of more than `instants` cells, along time, by matrix `which` of `_mixtures`."""
        for scale in self.layout.views(cells):
            for plane in (scale[name] for name, *_ in TEMPORAL if len(scale[name]) > instants):
                mixture = _mixtures(len(plane), instants)[which].to(plane)
                plane.copy_((mixture @ plane.flatten(1)).view_as(plane))

    def regularisers(self, grid: Tensor) -> dict[str, Tensor]:
        """Returns the regularisers, unweighted, by name. grid: the planes' own, or another of the same shape."""
        return plane_terms.regularisers(grid, self.layout)

    def rate(self, grid: Tensor, step: float) -> Tensor:
        """Returns a differentiable proxy for the bits of `grid`, as in `regularisers`, at a quantisation step."""
        return plane_terms.proxy_bits(grid, self.layout, step)

    def bits(self, step: float) -> float:
        """Returns the sum of R(a) over the planes' coded residuals at a quantisation step, with one Gaussian prior per
        channel of a plane, as with `--priors gauss`."""
        return sum(rate_bits(quantise(plane, step, name)) for scale in self.arrays() for name, plane in scale.items())

    @torch.no_grad()
    def arrays(self) -> Planes:
        """Returns per scale: plane name -> float32 [C, reso[b], reso[a]], as `scene.Deformation` holds them."""
        views = self.layout.views(self.grid.detach().float().cpu())
        return tuple({n: np.ascontiguousarray(p.permute(2, 0, 1).numpy()) for n, p in s.items()} for s in views)

    @classmethod
    @torch.no_grad()
    def from_arrays(cls, box: np.ndarray, planes: Planes) -> HexPlane:
        """The inverse of `arrays`."""
        found = cls(box, [plane_sides(scale) for scale in planes], planes[0]["xy"].shape[0])
        for views, scale in zip(found.layout.views(found.grid), planes, strict=True):
            for name, view in views.items():
                view.copy_(torch.from_numpy(np.array(scale[name], np.float32)).permute(1, 2, 0))
        return found

    def shape(self) -> dict[str, Any]:
        """Returns the values that `arrays_of_state` needs besides the grid."""
        return {"resolutions": self.layout.reso.tolist()}

    @staticmethod
    def arrays_of_state(shape: dict[str, Any], grid: np.ndarray) -> Planes:
        """Returns arrays of the shapes of planes, all 0, from their `shape` and grid [cells, C]. Raises ValueError if
        the two do not match."""
        n_cells, channels = grid.shape
        resolutions = shape["resolutions"]
        shapes = [plane_shapes(channels, sides) for sides in resolutions]
        needed = sum(height * width for scale in shapes for _, height, width in scale.values())
        if needed != n_cells:  # checked before planes of that size are allocated
            raise ValueError(f"planes of {n_cells} cells, expected {needed} for the resolutions {resolutions}")
        return tuple({name: np.zeros(shape, np.float32) for name, shape in scale.items()} for scale in shapes)


@lru_cache
def _mixtures(cells: int, instants: int) -> tuple[Tensor, Tensor]:
    """Returns two matrices [cells, cells]: H H^+, and H H^T scaled so that its rows sum to 1 on average, where H
    [cells, instants] interpolates evenly spaced values linearly."""
    place = torch.linspace(0, instants - 1, cells, dtype=torch.float64)
    hats = (1 - (place[:, None] - torch.arange(instants)).abs()).clamp(min=0)
    products = hats @ hats.T
    return hats @ torch.linalg.pinv(hats), products / products.sum(1).mean()
