"""HexPlane: a 4-D feature field as a product of six 2-D planes per scale.

Per scale, the planes xy, xz, xt, yz, yt, zt are sampled bilinearly (align corners, border clamp) and multiplied;
the scales are concatenated. A multi-resolution factor scales x, y, z and never t. On CPU with one time for all points
a fused numba kernel does it (`hexplane_kernels.py`); otherwise `sample_reference` does, with torch's `grid_sample`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pd4dgs_codec.draw import hexplane_kernels as kernels
from pd4dgs_codec.draw.plane_layout import TIME_AXIS, PlaneLayout
from pd4dgs_codec.draw.simd import LANES
from pd4dgs_codec.errors import DataError, TrainError
from pd4dgs_codec.model.rounding import round_straight_through
from pd4dgs_codec.scene import PLANES
from pd4dgs_codec.threads import kernel_threads

Corners = np.ndarray | Sequence[Sequence[float]]  #: [2, 3], lower and upper corner of a box, scene units


def sample(
    grid: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float, step: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """`sample_reference` at one time with rounding folded in, by the kernels; CPU, channels a multiple of LANES. After
    the features what `sample_gradient` takes: the spatial planes as used, and the time planes' rows."""
    tables = (layout.reso, layout.start, layout.rows)
    spatial = grid[: layout.n_spatial]
    if step is not None:
        spatial = torch.div(spatial, step).round_().mul_(step)
    rows = grid.new_empty(layout.n_rows, grid.shape[1])
    kernels.collapse(rows.numpy(), grid.numpy(), *tables, t, 0.0 if step is None else step)
    out = grid.new_empty(len(points), len(layout.reso) * grid.shape[1])
    kernels.sample(out.numpy(), spatial.numpy(), rows.numpy(), *tables, points.numpy(), box.numpy())
    return out, spatial, rows


def sample_gradient(
    g: Tensor, spatial: Tensor, rows: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float
) -> tuple[Tensor, Tensor]:
    """Gradients by the grid [cells, C] and by the points [N, 3] from that of the features, g."""
    channels, tables = spatial.shape[1], (layout.reso, layout.start, layout.rows)
    # scales fill the threads first; only then are points split, which costs a buffer per part
    parts = max(1, kernel_threads() // len(layout.reso))
    grad = g.new_zeros(layout.n_cells, channels)
    extra = g.new_zeros(parts - 1, layout.n_spatial, channels)
    grad_rows = g.new_zeros(parts, layout.n_rows, channels)
    grad_points = g.new_empty(len(layout.reso), len(points), 3)
    results = [x.numpy() for x in (grad, extra, grad_rows, grad_points)]
    inputs = [x.numpy() for x in (g, spatial, rows)]
    kernels.sample_backward(*[*results, *inputs, *tables, points.numpy(), box.numpy()])
    for part in extra:
        grad[: layout.n_spatial] += part
    kernels.collapse_backward(grad.numpy(), grad_rows.numpy().sum(0), *tables, t)
    return grad, grad_points.sum(0)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, grid: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float, step: float | None
    ) -> Tensor:
        out, spatial, rows = sample(grid, layout, box, points, t, step)
        ctx.layout, ctx.t = layout, t
        ctx.save_for_backward(spatial, rows, box, points)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        spatial, rows, box, points = ctx.saved_tensors
        grad, grad_points = sample_gradient(g.contiguous(), spatial, rows, ctx.layout, box, points, ctx.t)
        return grad, None, None, grad_points, None, None


def sample_reference(grid: Tensor, layout: PlaneLayout, box: Tensor, points: Tensor, t: float | Tensor) -> Tensor:
    """The plain torch form of `HexPlane.forward` (same arguments, shapes and result); any device, t float or [N]."""
    unit = (points - box[0]) / (box[1] - box[0])
    time = torch.as_tensor(t, dtype=unit.dtype, device=unit.device).expand(len(unit))
    coords = torch.cat([unit, time[:, None]], 1) * 2 - 1
    # NaN goes to the lower border; infinities are clamped here because grid_sample's own clamp multiplies them first.
    coords = torch.nan_to_num(coords, nan=-1.0, posinf=2.0, neginf=-2.0).clamp(-2.0, 2.0)
    features = []
    for scale in layout.views(grid):
        product = torch.ones((), dtype=unit.dtype, device=unit.device)
        for name, a, b in PLANES:
            plane = scale[name].permute(2, 0, 1)[None]
            at = coords[:, [a, b]][None, None]
            value = F.grid_sample(plane, at, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0].T
            product = product * value
        features.append(product)
    return torch.cat(features, 1)


#: Between these a spatial plane's start values are drawn.
START = (0.5, 1.5)


def _start(shape: Sequence[int], spacing: int | None, step: float, generator: torch.Generator | None) -> Tensor:
    """Start values [H, W, C] of a spatial plane, see HexPlane."""
    height, width, channels = shape
    if spacing is None:
        draw = torch.empty(channels).uniform_(*START, generator=generator)
        dither = torch.empty(height, width, channels).uniform_(-0.45, 0.45, generator=generator)
        return (torch.round(draw / step) + dither) * step
    draws = torch.empty(1, channels, -(-height // spacing), -(-width // spacing)).uniform_(*START, generator=generator)
    field = F.interpolate(draws, size=(height, width), mode="bilinear", align_corners=True)
    return field[0].permute(1, 2, 0)


class HexPlane(nn.Module):
    """A learnable HexPlane.

    box: [2, 3] lower and upper corner, scene units; points are normalised by it and clamped to it. On an axis where
    the corners are equal, points up to it fall on the first cell and those above it on the last.
    resolution: cells along x, y, z, t of the base scale, each >= 1. multires: factor on x, y, z per scale.
    The parameter `grid` is [cells, C]; `layout` says which cells are which plane.

    Start values: time planes 1, spatial planes random in START. Their products are then of the size of 1, and so are
    the steps that the optimiser takes in them; from 0.1..0.5, as public code starts, features of some 0.03 told places
    and times apart so slowly that some runs never began to move. Draws are independent every `spacing` cells and
    linear in between, so that cells that no anchor reaches cost few bits. With spacing None a plane has one draw per
    channel, a multiple of the quantisation step `step`, dithered within the rounding interval of each cell: dither is
    free where no anchor comes, and elsewhere keeps the rounding errors of neighbours independent.
    """

    def __init__(
        self,
        box: Corners,
        resolution: Sequence[int],
        channels: int = 16,
        multires: Sequence[int] = (1, 2),
        generator: torch.Generator | None = None,
        spacing: int | None = 1,
        step: float = 1.0,
    ):
        super().__init__()
        sizes = [*resolution, channels, *multires]
        if len(resolution) != 4 or not multires or any(int(v) != v or v < 1 for v in sizes):
            raise TrainError(
                "HexPlane needs 4 resolutions, >= 1 scale and positive integers, found "
                f"resolution {tuple(resolution)}, channels {channels}, multires {tuple(multires)}"
            )
        x, y, z, t = (int(r) for r in resolution)
        self._setup(box, [(x * m, y * m, z * m, t) for m in map(int, multires)], int(channels))
        with torch.no_grad():
            for scale in self.layout.views(self.grid):
                for name, _, b in PLANES:
                    if b != TIME_AXIS:
                        scale[name].copy_(_start(scale[name].shape, spacing, step, generator))

    def _setup(self, box: Corners, resolutions: Sequence[Sequence[int]], channels: int) -> None:
        corners = torch.as_tensor(np.array(box, np.float32))
        if corners.shape != (2, 3) or not torch.isfinite(corners).all() or not (corners[1] >= corners[0]).all():
            raise DataError(f"HexPlane box must be [2, 3], finite, lower <= upper, found {corners.tolist()}")
        self.box: Tensor
        self.register_buffer("box", corners)
        self.layout = PlaneLayout.build(resolutions)
        self.grid = nn.Parameter(torch.ones(self.layout.n_cells, channels))

    def forward(self, points: Tensor, t: float | Tensor, step: float | None = None) -> Tensor:
        """Features [N, C * scales].

        points: [N, 3], scene units; outside the box they are clamped to it, NaN goes to the lower border.
        t: normalised time, 0..1 and clamped to it: one float for all points (fast), or [N].
        step: if given, the planes are rounded to multiples of it; the gradient passes straight through.
        """
        if points.dim() != 2 or points.shape[1] != 3:
            raise TrainError(f"HexPlane points must be [N, 3], found {tuple(points.shape)}")
        points = points.to(self.grid.dtype)
        if isinstance(t, Tensor) and t.dim() == 0:
            t = float(t)
        one_time = not isinstance(t, Tensor)
        if one_time and self.grid.device.type == "cpu" and self.grid.shape[1] % LANES == 0:
            box = self.box.to(self.grid.dtype)
            arguments = (self.grid, self.layout, box, points.contiguous(), float(t), step)
            features: Tensor = _Sample.apply(*arguments)  # type: ignore[no-untyped-call]
            return features
        return sample_reference(round_straight_through(self.grid, step), self.layout, self.box, points, t)

    @torch.no_grad()
    def plane_arrays(self) -> tuple[dict[str, np.ndarray], ...]:
        """Per scale, plane name -> float32 [C, reso[b], reso[a]], as `scene.Deformation` holds them."""
        views = self.layout.views(self.grid.detach().float().cpu())
        return tuple({n: np.ascontiguousarray(p.permute(2, 0, 1).numpy()) for n, p in s.items()} for s in views)

    @torch.no_grad()
    def load_plane_arrays(self, planes: Sequence[dict[str, np.ndarray]]) -> None:
        """Sets every plane from `plane_arrays`-shaped arrays; DataError where a plane is missing or misshapen."""
        if len(planes) != len(self.layout.reso):
            raise DataError(f"HexPlane has {len(self.layout.reso)} scales, found planes of {len(planes)}")
        for s, (views, arrays) in enumerate(zip(self.layout.views(self.grid), planes, strict=True)):
            for name, view in views.items():
                expected = tuple(view.permute(2, 0, 1).shape)
                found = arrays[name].shape if name in arrays else None
                if found != expected:
                    raise DataError(f"plane {name} of scale {s}: expected shape {expected}, found {found}")
                view.copy_(torch.from_numpy(np.array(arrays[name], np.float32)).permute(1, 2, 0))

    @classmethod
    def from_plane_arrays(cls, box: np.ndarray, planes: Sequence[dict[str, np.ndarray]]) -> HexPlane:
        """A HexPlane with the resolutions and values of `planes` (`plane_arrays`-shaped)."""
        names = [name for name, _, _ in PLANES]
        bad = [(s, n) for s, p in enumerate(planes) for n in names if n not in p or p[n].ndim != 3 or 0 in p[n].shape]
        if bad or not planes:
            where = "no scale" if not bad else f"plane {bad[0][1]} of scale {bad[0][0]} missing or not so"
            raise DataError(f"HexPlane needs per scale the planes {', '.join(names)}, [C, H, W], not empty: {where}")
        first = planes[0]["xy"]
        self = cls.__new__(cls)
        nn.Module.__init__(self)
        reso = [(*p["xy"].shape[:0:-1], *p["xz"].shape[1:2], *p["xt"].shape[1:2]) for p in planes]
        self._setup(box, reso, first.shape[0])
        self.load_plane_arrays(planes)
        return self
