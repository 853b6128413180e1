"""HexPlanes: the layout of all planes in one table, numba kernels that sample them at one time for all points, and the
evaluation of a decoded deformation without torch.

At one time t each time plane is a single row, the blend of two of its rows, so a point costs three bilinear and three
linear lookups per scale. Channels are the last axis and are processed `LANES` at a time. The backward pass splits
scales over threads first and points second; each part owns its gradient buffers, which the caller adds in order.
Results are bitwise reproducible for a fixed number of parts, and with one part for any number of threads.

Arguments of the kernels, all floats of one dtype: grid [cells, C], C a multiple of LANES (sampling reads only its
spatial planes); rows [n_rows, C], the time planes at time t; reso [S, 4], start [S, 6], row_start [S, 3] of
`PlaneLayout`; points [N, 3] and box [2, 3] in scene units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pd4dgs_codec.draw.layers import Layers, whole
from pd4dgs_codec.draw.simd import LANES, Array, Tasks, Vector, fma, fnma, kernel, load, parallel, splat, store, total
from pd4dgs_codec.scene import LENGTH_HEADS, PLANES, TRUNK, Deformation, Network, deformation_unit, instant, plane_sides

TIME_AXIS = 3
SPATIAL = tuple(p for p in PLANES if TIME_AXIS not in p[1:])
TEMPORAL = tuple(p for p in PLANES if TIME_AXIS in p[1:])


@dataclass(frozen=True, eq=False)
class PlaneLayout:
    """Where each plane lies in one table [cells, C]: the spatial planes of all scales, then the time planes.

    With one table the optimiser, the rounding and the kernels make one pass instead of one per plane.

    reso: int64 [S, 4] cells along x, y, z, t.
    start: int64 [S, 6] first cell of each plane, in the order of `PLANES`; cell (j, i) of plane (a, b) is
    start + j * reso[a] + i.
    rows: int64 [S, 3] first row of xt, yt, zt in the [n_rows, C] table of the time planes at one time.
    lines: int64 [R, 5], for each row of each plane: the plane's first cell, height and width, the row, 1 if spatial.
    """

    reso: Array
    start: Array
    rows: Array
    lines: Array
    n_spatial: int
    n_cells: int
    n_rows: int

    @classmethod
    def build(cls, resolutions: Sequence[Sequence[int]]) -> PlaneLayout:
        """Lays out planes of the given resolutions: per scale, cells along x, y, z, t."""
        reso = np.array(resolutions, np.int64)
        start = np.zeros((len(reso), len(PLANES)), np.int64)
        lines = []
        cell = 0
        for temporal in (False, True):
            for s in range(len(reso)):
                for k, (_, a, b) in enumerate(PLANES):
                    if (b == TIME_AXIS) == temporal:
                        start[s, k] = cell
                        lines += [(cell, reso[s, b], reso[s, a], j, not temporal) for j in range(reso[s, b])]
                        cell += int(reso[s, a] * reso[s, b])
            if not temporal:
                n_spatial = cell
        rows = (np.cumsum(reso[:, :3]) - reso[:, :3].ravel()).reshape(-1, 3)
        return cls(reso, start, rows, np.array(lines, np.int64), n_spatial, cell, int(reso[:, :3].sum()))

    def views(self, grid: Any) -> tuple[dict[str, Any], ...]:
        """Returns per scale: plane name -> view [reso[b], reso[a], C] of `grid` [cells, C], an array or a tensor."""
        return tuple(
            {
                name: grid[first : first + r[a] * r[b]].reshape(r[b], r[a], -1)
                for first, (name, a, b) in zip(starts, PLANES, strict=True)
            }
            for r, starts in zip(self.reso.tolist(), self.start.tolist(), strict=True)
        )


XY, XZ, XT, YZ, YT, ZT = range(6)

Six = tuple[int, int, int, int, int, int]
Three = tuple[float, float, float]


@kernel(inline=True)
def _locate(p: float, lower: float, upper: float, n: int) -> tuple[int, float, float]:
    """Returns first cell, fraction and slope d(cell coordinate)/dp of p on an axis of n cells; slope 0 if clamped."""
    unit = (np.float64(p) - lower) / (np.float64(upper) - lower)
    if not (unit > 0):  # NaN too
        return 0, 0.0, 0.0
    first = max(n - 2, 0)
    if unit >= 1:
        return first, float(n - 1 - first), 0.0
    at = unit * (n - 1)
    cell = min(int(at), first)
    return cell, at - cell, (n - 1) / (np.float64(upper) - lower)


@kernel(inline=True)
def _linear(table: Array, i: int, step: int, f: Vector) -> tuple[Vector, Vector]:
    """Returns (sample, d sample / df) between the lanes at flat offset i and the lanes `step` further."""
    a = load(table, i)
    d = load(table, i + step) - a
    return fma(d, f, a), d


@kernel(inline=True)
def _bilinear(table: Array, i: int, step_u: int, step_v: int, fu: Vector, fv: Vector) -> tuple[Vector, Vector, Vector]:
    """Returns (sample, d sample / dfu, d sample / dfv)."""
    a, da = _linear(table, i, step_u, fu)
    b, db = _linear(table, i + step_v, step_u, fu)
    return fma(b - a, fv, a), fma(db - da, fv, da), b - a


@kernel(inline=True)
def _add_linear(table: Array, i: int, step: int, f: Vector, g: Vector) -> None:
    """The transpose of `_linear`: adds (1 - f) g and f g."""
    store(table, i, load(table, i) + fnma(g, f, g))
    store(table, i + step, fma(g, f, load(table, i + step)))


@kernel(inline=True)
def _add_bilinear(table: Array, i: int, step_u: int, step_v: int, fu: Vector, fv: Vector, g: Vector) -> None:
    gv = g * fv
    _add_linear(table, i, step_u, fu, g - gv)
    _add_linear(table, i + step_v, step_u, fu, gv)


@kernel(inline=True)
def _address(
    s: int, point: Array, reso: Array, start: Array, row_start: Array, box: Array, channels: int
) -> tuple[Six, Six, Three, Three]:
    """Returns flat offsets of one point's six lookups at one scale, steps to the next cells, fractions and slopes.

    Offsets: xy, xz, yz in the grid, then x, y, z in the rows. Steps: along x, y, z as an inner axis (0 on an axis of
    one cell), then along the outer axes of xy, xz, yz.
    """
    nx, ny, nz = reso[s, 0], reso[s, 1], reso[s, 2]
    x, fx, sx = _locate(point[0], box[0, 0], box[1, 0], nx)
    y, fy, sy = _locate(point[1], box[0, 1], box[1, 1], ny)
    z, fz, sz = _locate(point[2], box[0, 2], box[1, 2], nz)
    xy, xz, yz = start[s, XY] + y * nx + x, start[s, XZ] + z * nx + x, start[s, YZ] + z * ny + y
    rx, ry, rz = row_start[s, 0] + x, row_start[s, 1] + y, row_start[s, 2] + z
    offsets = (xy * channels, xz * channels, yz * channels, rx * channels, ry * channels, rz * channels)
    dx, dy, dz = min(nx - 1, 1) * channels, min(ny - 1, 1) * channels, min(nz - 1, 1) * channels
    return offsets, (dx, dy, dz, dy * nx, dz * nx, dz * ny), (fx, fy, fz), (sx, sy, sz)


@parallel(lambda out, *_: len(out))
def sample(
    tasks: Tasks,
    out: Array,
    grid: Array,
    rows: Array,
    reso: Array,
    start: Array,
    row_start: Array,
    points: Array,
    box: Array,
) -> None:
    """Fills out [N, S * C] with the product of the six planes at `points`, per scale."""
    channels = grid.shape[1]
    real = grid.dtype.type
    for n in range(tasks[0], tasks[1]):
        for s in range(len(reso)):
            (xy, xz, yz, rx, ry, rz), (dx, dy, dz, xy_y, xz_z, yz_z), (fx, fy, fz), _ = _address(
                s, points[n], reso, start, row_start, box, channels
            )
            u, v, w = splat(real(fx)), splat(real(fy)), splat(real(fz))
            for c in range(0, channels, LANES):
                a = _bilinear(grid, xy + c, dx, xy_y, u, v)[0]
                b = _bilinear(grid, xz + c, dx, xz_z, u, w)[0]
                d = _bilinear(grid, yz + c, dy, yz_z, v, w)[0]
                e = _linear(rows, rx + c, dx, u)[0] * _linear(rows, ry + c, dy, v)[0] * _linear(rows, rz + c, dz, w)[0]
                store(out, n * out.shape[1] + s * channels + c, a * b * d * e)


@kernel(inline=True)
def _point_gradient(
    grad: Array,
    grad_rows: Array,
    g: Array,
    g_offset: int,
    grid: Array,
    rows: Array,
    channels: int,
    offsets: Six,
    steps: Six,
    fractions: Three,
    slopes: Three,
    out: Array,
    out_offset: int,
) -> None:
    """Adds one point's gradient at one scale to `grad` and `grad_rows`; stores dL/d(point) to flat `out`."""
    xy, xz, yz, rx, ry, rz = offsets
    dx, dy, dz, xy_y, xz_z, yz_z = steps
    real = grid.dtype.type
    u, v, w = splat(real(fractions[0])), splat(real(fractions[1])), splat(real(fractions[2]))
    gx = gy = gz = splat(real(0))
    for c in range(0, channels, LANES):
        a, a_u, a_v = _bilinear(grid, xy + c, dx, xy_y, u, v)
        b, b_u, b_w = _bilinear(grid, xz + c, dx, xz_z, u, w)
        d, d_v, d_w = _bilinear(grid, yz + c, dy, yz_z, v, w)
        e, e_u = _linear(rows, rx + c, dx, u)
        f, f_v = _linear(rows, ry + c, dy, v)
        h, h_w = _linear(rows, rz + c, dz, w)
        # each factor's gradient is the product of the others: prefixes from the left times suffixes from the right
        suffix_h = load(g, g_offset + c)
        suffix_f = suffix_h * h
        suffix_e = suffix_f * f
        suffix_d = suffix_e * e
        suffix_b = suffix_d * d
        g_a, g_b = suffix_b * b, suffix_b * a
        prefix = a * b
        g_d = suffix_d * prefix
        prefix = prefix * d
        g_e = suffix_e * prefix
        prefix = prefix * e
        g_f = suffix_f * prefix
        g_h = suffix_h * (prefix * f)
        gx = fma(g_e, e_u, fma(g_b, b_u, fma(g_a, a_u, gx)))
        gy = fma(g_f, f_v, fma(g_d, d_v, fma(g_a, a_v, gy)))
        gz = fma(g_h, h_w, fma(g_d, d_w, fma(g_b, b_w, gz)))
        _add_bilinear(grad, xy + c, dx, xy_y, u, v, g_a)
        _add_bilinear(grad, xz + c, dx, xz_z, u, w, g_b)
        _add_bilinear(grad, yz + c, dy, yz_z, v, w, g_d)
        _add_linear(grad_rows, rx + c, dx, u, g_e)
        _add_linear(grad_rows, ry + c, dy, v, g_f)
        _add_linear(grad_rows, rz + c, dz, w, g_h)
    out[out_offset] = total(gx) * real(slopes[0])
    out[out_offset + 1] = total(gy) * real(slopes[1])
    out[out_offset + 2] = total(gz) * real(slopes[2])


@parallel(lambda grad, extra, grad_rows, grad_points, *_: len(grad_points) * len(grad_rows))
def sample_backward(
    tasks: Tasks,
    grad: Array,
    extra: Array,
    grad_rows: Array,
    grad_points: Array,
    g: Array,
    grid: Array,
    rows: Array,
    reso: Array,
    start: Array,
    row_start: Array,
    points: Array,
    box: Array,
) -> None:
    """The transpose of `sample`. g: [N, S * C]. Fills arrays that, except grad_points, are given zeroed:

    grad [cells, C], its spatial planes, by the first part; extra [parts - 1, n_spatial, C], by the other parts;
    grad_rows [parts, n_rows, C]; grad_points [S, N, 3], per scale.
    """
    channels, parts, n_points = grid.shape[1], len(grad_rows), len(points)
    for task in range(tasks[0], tasks[1]):
        s, part = task // parts, task % parts
        own = grad if part == 0 else extra[part - 1]
        flat = grad_points[s].reshape(-1)
        for n in range(n_points * part // parts, n_points * (part + 1) // parts):
            offsets, steps, fractions, slopes = _address(s, points[n], reso, start, row_start, box, channels)
            at = n * g.shape[1] + s * channels
            _point_gradient(
                own, grad_rows[part], g, at, grid, rows, channels, offsets, steps, fractions, slopes, flat, 3 * n
            )


@kernel()  # exact arithmetic: the rounding must equal the codec's quantiser's
def collapse(rows: Array, grid: Array, reso: Array, start: Array, row_start: Array, t: float, step: float) -> None:
    """Fills rows [n_rows, C] with the time planes of `grid` at time t, rounded to multiples of `step` if step > 0."""
    real = grid.dtype.type
    for s in range(len(reso)):
        first, f, _ = _locate(t, 0.0, 1.0, reso[s, 3])
        step_t = min(reso[s, 3] - 1, 1)
        for axis, plane in enumerate((XT, YT, ZT)):
            n = reso[s, axis]
            for i in range(n):
                cell = start[s, plane] + first * n + i
                for c in range(grid.shape[1]):
                    a, b = grid[cell, c], grid[cell + step_t * n, c]
                    if step > 0:
                        a, b = np.rint(a / real(step)) * real(step), np.rint(b / real(step)) * real(step)
                    rows[row_start[s, axis] + i, c] = a + (b - a) * real(f)


@kernel()
def collapse_backward(grad: Array, grad_rows: Array, reso: Array, start: Array, row_start: Array, t: float) -> None:
    """The transpose of `collapse` (rounding passes the gradient): adds to the time planes of grad [cells, C]."""
    real = grad.dtype.type
    for s in range(len(reso)):
        first, f, _ = _locate(t, 0.0, 1.0, reso[s, 3])
        step_t = min(reso[s, 3] - 1, 1)
        for axis, plane in enumerate((XT, YT, ZT)):
            n = reso[s, axis]
            for i in range(n):
                cell = start[s, plane] + first * n + i
                for c in range(grad.shape[1]):
                    value = grad_rows[row_start[s, axis] + i, c]
                    grad[cell, c] += value * real(1 - f)
                    grad[cell + step_t * n, c] += value * real(f)


# -- decoded deformations ----------------------------------------------------------------------------------------------


class Field:
    """Adds a deformation's residuals to rows of anchors, whose columns are those of all heads of the registry. Another
    kind of deformation changes only this class in `draw`."""

    def __init__(self, deformation: Deformation, box: np.ndarray, columns: dict[str, slice]):
        """box: float32 [2, 3], see SceneInfo. columns: see `Widths.head_columns`."""
        self._box = np.ascontiguousarray(box, np.float32)
        self._layout = PlaneLayout.build([plane_sides(scale) for scale in deformation.planes])
        channels = deformation.planes[0]["xy"].shape[0]
        self._channels = whole(channels, LANES)  # padded channels and their products are 0
        self._grid = np.zeros((self._layout.n_cells, self._channels), np.float32)
        for views, scale in zip(self._layout.views(self._grid), deformation.planes, strict=True):
            for name, _, _ in PLANES:
                views[name][:, :, :channels] = scale[name].transpose(1, 2, 0)
        self._rows: tuple[float, np.ndarray] | None = None
        trunk = _with_padded_inputs(deformation.networks[TRUNK], channels, self._channels)
        self._key = deformation.key
        unit, networks = deformation_unit(box), deformation.networks
        heads = {
            n: _scaled(networks[n], unit if n in LENGTH_HEADS else np.float32(1)) for n in columns if n in networks
        }
        self._trunk: Layers | None = None
        if all(len(network) == 1 for network in heads.values()):  # one product for all heads
            self._heads = [(slice(None), Layers((*trunk, _joined(heads, columns, len(trunk[-1][1])))))]
        else:
            self._trunk = Layers(trunk, relu_last=True)
            self._heads = [(columns[n], Layers(network)) for n, network in heads.items()]

    def rest(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Returns values - F(x, t*) if there is a key instant t*, else `values`: the rows to which `move` adds F(x, t)
        at any time t. Arguments as for `move`."""
        if self._key is None:
            return values
        still = np.zeros_like(values)
        self.move(still, points, instant(self._key))
        moved: np.ndarray = values - still
        return moved

    def move(self, values: np.ndarray, points: np.ndarray, t: float) -> None:
        """Adds F(x, t) at points x float32 [n, 3] and normalised time t to values float32 [n, columns],
        C-contiguous; lengths in scene units."""
        layout = self._layout
        tables = layout.reso, layout.start, layout.rows
        if self._rows is None or self._rows[0] != t:
            rows = np.empty((layout.n_rows, self._channels), np.float32)
            collapse(rows, self._grid, *tables, t, 0.0)
            self._rows = t, rows
        features = np.empty((len(points), len(layout.reso) * self._channels), np.float32)
        spatial = self._grid[: layout.n_spatial]
        sample(features, spatial, self._rows[1], *tables, np.ascontiguousarray(points), self._box)
        if self._trunk is None:
            ((_, together),) = self._heads
            together.add(values, features)
            return
        hidden = self._trunk(features)
        for own, head in self._heads:
            values[:, own] += head(hidden)


def _with_padded_inputs(network: Network, channels: int, padded: int) -> Network:
    """Returns the network for features that are padded from `channels` to `padded` channels per scale."""
    (weight, bias), *rest = network
    scales = weight.shape[1] // channels
    wide = np.zeros((len(weight), scales, padded), np.float32)
    wide[:, :, :channels] = weight.reshape(len(weight), scales, channels)
    return ((wide.reshape(len(weight), -1), bias), *rest)


def _joined(heads: dict[str, Network], columns: dict[str, slice], inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Joins heads of one layer each into one layer whose outputs are all columns; those without a head are 0."""
    outputs = max(own.stop for own in columns.values())
    weight, bias = np.zeros((outputs, inputs), np.float32), np.zeros(outputs, np.float32)
    for name, ((of_head, shift),) in heads.items():
        weight[columns[name]] += of_head
        bias[columns[name]] += shift
    return weight, bias


def _scaled(network: Network, unit: np.float32) -> Network:
    """Returns the network with its outputs multiplied by `unit`."""
    *rest, (weight, bias) = network
    return (*rest, (weight * unit, bias * unit))
