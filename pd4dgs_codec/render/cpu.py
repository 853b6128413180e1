"""The CPU backend: a torch autograd function around the numba kernels (project, bin, composite)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from pd4dgs_codec.errors import RenderError
from pd4dgs_codec.render import threads

threads.choose_layer()  # before numba reads its environment
import numba  # noqa: E402

from pd4dgs_codec.render import binning, kernels, projection  # noqa: E402

CHANNELS = 3  #: colour channels drawn per pass
TILES_PER_TASK = 2  #: small tasks, so that a thread with empty tiles helps the others
CHUNKS_PER_THREAD = 4  #: of the depth order while binning
_TILE = (kernels.TILE_WIDTH, kernels.TILE_HEIGHT)


@dataclass(frozen=True)
class Settings:
    """What does not take part in differentiation. depth: append each Gaussian's depth as a last colour channel."""

    width: int
    height: int
    near: float
    far: float
    eps2d: float
    radius_clip: float
    depth: bool


@dataclass
class _Meta:
    """Per camera and Gaussian, filled by the forward pass; means2d is the leaf that receives dL/d(pixel position)."""

    means2d: torch.Tensor
    radii: torch.Tensor
    depths: torch.Tensor
    conics: torch.Tensor


@dataclass
class _View:
    """One camera's projected and binned Gaussians; the shapes are those of the kernels."""

    camera: np.ndarray
    geom: np.ndarray
    first: np.ndarray
    items: np.ndarray
    slot_of: np.ndarray
    starts: np.ndarray
    colors: np.ndarray = field(init=False)  #: [N, D padded to a multiple of CHANNELS]


def _use_threads() -> None:
    numba.set_num_threads(min(threads.kernel_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


def _pack_camera(viewmat: np.ndarray, K: np.ndarray, s: Settings) -> np.ndarray:
    """float64 [20]: R, t, fx, fy, cx, cy and the range of x/z, y/z inside J (gsplat: 1.3 x the field of view)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * s.width / fx, 0.15 * s.height / fy
    limits = [-cx / fx - margin_x, (s.width - cx) / fx + margin_x, -cy / fy - margin_y, (s.height - cy) / fy + margin_y]
    return np.array([*viewmat[:3, :3].ravel(), *viewmat[:3, 3], fx, fy, cx, cy, *limits], np.float64)


def _prepare(arrays, camera: np.ndarray, meta, s: Settings) -> _View:
    """Project and bin one camera. meta: its radii, means2d, depths, conics (numpy), which are filled."""
    n = arrays[0].shape[0]
    visible, geom, rects = np.empty(n, np.bool_), np.empty((n, projection.GEOM_COLUMNS)), np.empty((n, 4), np.int32)
    limits = (s.near, s.far, s.eps2d, s.radius_clip)
    projection.project(*arrays, camera, (s.width, s.height), limits, _TILE, visible, geom, rects, *meta)
    order = binning.sort(visible, meta[2])
    columns, rows = -(-s.width // _TILE[0]), -(-s.height // _TILE[1])
    counts = np.empty((CHUNKS_PER_THREAD * numba.get_num_threads(), columns * rows), np.int64)
    starts, first = np.empty(columns * rows + 1, np.int64), np.empty(n + 1, np.int64)
    binning.count_tiles(order, rects, columns, counts)
    binning.offsets(rects, counts, starts, first)
    if starts[-1] >= 2**31:
        raise RenderError(f"{starts[-1]} pairs of a Gaussian and a tile, expected fewer than 2^31")
    items, slot_of = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    binning.fill_tiles(order, rects, columns, counts, first, items, slot_of)
    return _View(camera, geom, first, items, slot_of, starts)


def _pad_channels(colors: np.ndarray, depths: np.ndarray | None) -> np.ndarray:
    """Colours (and depth) as float32 [N, D'], D' a multiple of CHANNELS; the input itself if nothing is to be added."""
    n, channels = colors.shape
    total = channels + (depths is not None)
    padded = -(-total // CHANNELS) * CHANNELS
    if padded == channels:
        return colors
    result = np.zeros((n, padded), np.float32)
    result[:, :channels] = colors
    if depths is not None:
        result[:, channels] = depths
    return result


def _camera_slice(array, c: int):
    """Camera c's [N, D] of colours that are shared, [N, D], or per camera, [C, N, D]."""
    return array if array.ndim == 2 else array[c]


class _Rasterize(torch.autograd.Function):
    """(..., meta, settings) -> (colors [C, H, W, D], alphas [C, H, W]). All tensors float32 and contiguous."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, backgrounds, means2d, viewmats, Ks, meta, settings):
        _use_threads()
        count, channels = viewmats.shape[0], colors.shape[-1] + settings.depth
        out = torch.empty((count, settings.height, settings.width, channels))
        behind = torch.empty((count, settings.height, settings.width))
        pictures, transmittances = out.numpy(), behind.numpy()
        arrays = [a.detach().numpy() for a in (means, quats, scales, opacities)]
        color_array = colors.detach().numpy()
        filled = [t.detach().numpy() for t in (meta.radii, means2d, meta.depths, meta.conics)]
        ctx.views = []
        for c in range(count):
            camera = _pack_camera(viewmats[c], Ks[c], settings)
            view = _prepare(arrays, camera, [f[c] for f in filled], settings)
            view.colors = _pad_channels(_camera_slice(color_array, c), filled[2][c] if settings.depth else None)
            background = np.zeros(view.colors.shape[1], np.float32)
            if backgrounds is not None:
                background[: backgrounds.shape[1]] = backgrounds[c].detach().numpy()
            for channel in range(0, channels, CHANNELS):
                with numba.parallel_chunksize(TILES_PER_TASK):
                    kernels.composite(
                        view.items,
                        view.starts,
                        view.geom,
                        view.colors,
                        channel,
                        background,
                        pictures[c],
                        transmittances[c],
                    )
            ctx.views.append(view)
        ctx.settings = settings
        ctx.background_channels = 0 if backgrounds is None else backgrounds.shape[1]
        ctx.save_for_backward(means, quats, scales, opacities, colors, out, behind)
        return out, 1.0 - behind

    @staticmethod
    @once_differentiable
    def backward(ctx, g_out, g_alphas):
        _use_threads()
        *inputs, colors, out, behind = ctx.saved_tensors
        inputs = [a.detach().numpy() for a in inputs]
        gradients = [torch.zeros(a.shape) for a in (*inputs, colors)]
        g_means2d = torch.zeros((len(ctx.views), inputs[0].shape[0], 2))
        pictures = [t.contiguous().numpy() for t in (out, behind, g_out, g_alphas)]
        g_arrays = [g.numpy() for g in gradients]
        depth_column = projection.SLOT_GEOMETRY + colors.shape[-1] if ctx.settings.depth else -1
        for c, view in enumerate(ctx.views):
            slots = np.empty((view.items.size, projection.SLOT_GEOMETRY + view.colors.shape[1]), np.float32)
            for channel in range(0, out.shape[-1], CHANNELS):
                with numba.parallel_chunksize(TILES_PER_TASK):
                    kernels.composite_backward(
                        view.items, view.slot_of, view.starts, view.geom, view.colors, channel,
                        *[p[c] for p in pictures], slots,
                    )  # fmt: skip
            projection.project_backward(
                *inputs, view.camera, view.geom, view.first, slots, depth_column,
                *g_arrays[:4], _camera_slice(g_arrays[4], c), g_means2d[c].numpy(),
            )  # fmt: skip
        g_backgrounds = None
        if ctx.background_channels and ctx.needs_input_grad[5]:
            g_backgrounds = torch.einsum("chwd,chw->cd", g_out[..., : ctx.background_channels], behind)
        return (*gradients, g_backgrounds, g_means2d, None, None, None, None)


def rasterize(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, **options):
    """The CPU backend of `rasterization`, which checks the arguments; options: the fields of Settings."""
    count, n = viewmats.shape[0], means.shape[0]
    if n >= 2**31:
        raise RenderError(f"{n} Gaussians, expected fewer than 2^31")
    tensors = [t.to(torch.float32).contiguous() for t in (means, quats, scales, opacities, colors)]
    backgrounds = None if backgrounds is None else backgrounds.to(torch.float32)
    needs_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    means2d = torch.zeros((count, n, 2), requires_grad=needs_gradient)
    radii, depths = torch.empty((count, n, 2), dtype=torch.int32), torch.empty((count, n))
    meta = _Meta(means2d, radii, depths, torch.empty((count, n, 3)))
    cameras = [t.detach().to(torch.float64).numpy() for t in (viewmats, Ks)]
    out, alphas = _Rasterize.apply(*tensors, backgrounds, means2d, *cameras, meta, Settings(**options))
    return out, alphas[..., None], dict(vars(meta))
