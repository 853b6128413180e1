"""Render_level of a decoded scene through a camera: the arithmetic of `model.Model`, in numpy and kernels.

The two agree to rounding: both sum in binary32, in other orders.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pd4dgs_codec.draw import slot_kernels
from pd4dgs_codec.draw.networks import Field, Layers
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.draw.slot_kernels import GAUSSIAN_WIDTH
from pd4dgs_codec.draw.visibility import FRUSTUM_MARGIN, MIN_OPACITY, OFFSET_REACH, SIGMA_REACH, check_time, near_plane
from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS, MASK_STEP, MASK_THRESHOLD, Camera, Network, Scene


@dataclass(frozen=True, eq=False)
class Gaussians:
    """What the rasteriser takes, float32; K Gaussians, activated and gated."""

    means: np.ndarray  #: [K, 3] world
    quats: np.ndarray  #: [K, 4] wxyz, unit
    scales: np.ndarray  #: [K, 3] scene units
    opacities: np.ndarray  #: [K] 0..1
    colors: np.ndarray  #: [K, 3] 0..1
    slots: np.ndarray  #: int64 [K], anchor * G + offset, of G slots


class Player:
    """Draws the highest level of a decoded scene.

    The residuals at one time are kept for the anchors that were evaluated: a second view at that time asks for the
    others only. Not for several threads at once.
    """

    def __init__(self, scene: Scene):
        self.info, self.level = scene.info, scene.level
        codes = scene.mask[-1]
        self._mask = codes.astype(np.float32) * MASK_STEP
        self._anchor = np.ascontiguousarray(scene.anchor[: len(codes)], np.float32)
        self.slots = scene.widths.slots  #: Gaussians of an anchor
        # what an anchor holds side by side, as the kernels take it and as the heads of the global deformation move it
        self._table = np.concatenate(
            [self._anchor, scene.feature, scene.offset.reshape(len(codes), 3 * self.slots), scene.scaling_log], axis=1
        )
        ends = np.cumsum([*scene.widths.global_heads.values()]).tolist()
        self._columns = {head: slice(*bounds) for head, bounds in zip(GLOBAL_HEADS, pairwise([0, *ends]), strict=True)}
        extent = np.exp(scene.scaling_log)
        self._radius = OFFSET_REACH * extent[:, :3].max(axis=1) + SIGMA_REACH * extent[:, 3:].max(axis=1)
        box = scene.info.box
        fields = (scene.global_deformation, scene.widths.global_heads), (scene.local_deformation, LOCAL_HEADS)
        self._global, self._local = (None if field is None else Field(field, box, heads) for field, heads in fields)
        self._opacity = Layers(scene.networks["opacity"])
        self._covariance = _SlotNetwork(scene.networks["covariance"], self.slots)
        self._color = _SlotNetwork(scene.networks["color"], self.slots)
        self._time: float | None = None
        self._moved = self._table if self._global is None else np.empty_like(self._table)  # at self._time
        self._known = np.full(len(codes), self._global is None)  # the rows of it that are there

    @property
    def active(self) -> np.ndarray:
        """int64 [n]: the anchors active at this level, ascending."""
        return np.flatnonzero(self._mask > MASK_THRESHOLD)

    @property
    def positions(self) -> np.ndarray:
        """float32 [N, 3]: all anchors at rest, world."""
        return self._anchor

    def picture(self, camera: Camera, t: float) -> np.ndarray:
        """float32 [H, W, 3] in 0..1 at normalised time t in 0..1. Raises RenderError unless t is finite."""
        check_time(t)
        g = self.gaussians(camera, t)
        finite = np.isfinite(g.colors).all(axis=1)  # a colour that overflowed hides its Gaussian
        image, _ = draw(
            g.means,
            g.quats,
            g.scales,
            np.where(finite, g.opacities, np.float32(0)),
            np.nan_to_num(g.colors),
            camera,
            self.info.background,
            near_plane=near_plane(self.info),
        )
        picture: np.ndarray = np.clip(image, 0, 1)
        return picture

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        """The Gaussians at normalised time t in 0..1 as the camera meets them."""
        with np.errstate(all="ignore"):
            return self._gaussians(camera, t)

    def _gaussians(self, camera: Camera, t: float) -> Gaussians:
        rows = self._visible(camera)
        mask, anchors = self._mask[rows], self._anchors(rows, t)
        viewmat = np.asarray(camera.viewmat, np.float32)
        inputs = self._inputs(anchors, -viewmat[:3, :3].T @ viewmat[:3, 3])
        raw_opacity = np.tanh(self._opacity(inputs))
        keep = np.flatnonzero(raw_opacity * mask[:, None] >= np.float32(MIN_OPACITY))
        return self._grown(rows, anchors, inputs, raw_opacity, mask, keep, t)

    def gaussians_of_eyes(self, rows: np.ndarray, t: float, eyes: np.ndarray) -> Gaussians:
        """The Gaussians of the anchors `rows` int64 [n] that any of E eyes, float32 [E, 3] world, would see, at
        normalised time t: those of the first eye, then as many of the second, and so on, slot by slot.

        An eye that does not see one meets it with opacity 0. Frusta do not matter here.
        """
        with np.errstate(all="ignore"):
            anchors = self._anchors(rows, t)
            inputs = np.concatenate([self._inputs(anchors, eye) for eye in eyes])
            mask = np.tile(self._mask[rows], len(eyes))
            raw_opacity = np.tanh(self._opacity(inputs))
            shown = (raw_opacity * mask[:, None] >= np.float32(MIN_OPACITY)).reshape(len(eyes), -1)
            slots = np.flatnonzero(shown.any(axis=0))
            keep = (np.arange(len(eyes))[:, None] * shown.shape[1] + slots).ravel()
            repeated = np.tile(rows, len(eyes)), np.tile(anchors, (len(eyes), 1))
            grown = self._grown(*repeated, inputs, raw_opacity, mask, keep, t, len(eyes))
        return replace(grown, opacities=np.where(shown[:, slots].ravel(), grown.opacities, np.float32(0)))

    def _anchors(self, rows: np.ndarray, t: float) -> np.ndarray:
        """float32 [n, D + 3 G + 9]: the anchors `rows` where the global deformation takes them."""
        if self._global is not None:
            if self._time != t:
                self._time = t
                self._known[:] = False
            missing = rows[~self._known[rows]]
            if missing.size:
                moved = self._table.take(missing, axis=0)
                self._global.move(moved, self._anchor.take(missing, axis=0), t)
                self._moved[missing] = moved
                self._known[missing] = True
        found: np.ndarray = self._moved.take(rows, axis=0)
        return found

    def _inputs(self, anchors: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """float32 [n, D + 3]: what the networks take, features and directions from the eye [3]."""
        return np.concatenate([anchors[:, self._columns["feature"]], _unit(anchors[:, :3] - eye)], axis=1)

    def _grown(
        self,
        rows: np.ndarray,
        anchors: np.ndarray,
        inputs: np.ndarray,
        raw_opacity: np.ndarray,
        mask: np.ndarray,
        keep: np.ndarray,
        t: float,
        copies: int = 1,
    ) -> Gaussians:
        """The Gaussians of the slots `keep`, which are `copies` times the same means."""
        shape = self._covariance(inputs, keep)
        colors = _sigmoid(self._color(inputs, keep))
        extent = np.exp(anchors[:, self._columns["scaling"]])
        made, gate = np.empty((len(keep), GAUSSIAN_WIDTH), np.float32), np.empty(len(keep), np.float32)
        slot_kernels.assemble(made, gate, keep, anchors, extent, raw_opacity, mask, shape, _sigmoid(shape), colors)
        loose = self._local is not None
        if self._local is not None:
            once = made[: len(made) // copies]
            points = np.ascontiguousarray(once[:, :3])
            if copies == 1:
                self._local.move(made, points, t)
            else:
                residuals = np.zeros_like(once)
                self._local.move(residuals, points, t)
                made += np.tile(residuals, (copies, 1))
        means, quats, scales, opacities, colors = (
            np.empty((len(keep), *width), np.float32) for width in ((3,), (4,), (3,), (), (3,))
        )
        slot_kernels.finish(means, quats, scales, opacities, colors, made, gate, loose)
        slots = rows[keep // self.slots] * self.slots + keep % self.slots
        return Gaussians(means, quats, scales, opacities, colors, slots)

    def _visible(self, camera: Camera) -> np.ndarray:
        """int64 [n]: active anchors that may reach the image, ascending; see `Model.visible`."""
        viewmat, K = np.asarray(camera.viewmat, np.float32), np.asarray(camera.K, np.float32)
        x, y, depth = viewmat[:3, :3] @ self._anchor.T + viewmat[:3, 3:]
        z = np.maximum(depth, np.float32(self.info.near))
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        width, height, radius = camera.width, camera.height, self._radius
        margin = max(K[0, 0], K[1, 1]) * radius / z + np.float32(FRUSTUM_MARGIN * max(width, height))
        inside = (u > -margin) & (u < width + margin) & (v > -margin) & (v < height + margin)
        return np.flatnonzero(inside & (depth + radius > 0) & (self._mask > MASK_THRESHOLD))


class _SlotNetwork:
    """A network with outputs per Gaussian of an anchor, for those Gaussians alone that are kept."""

    def __init__(self, network: Network, slots: int):
        weight, bias = network[-1]
        self._width = len(bias) // slots
        self._weight, self._bias = slot_kernels.by_slot(weight, bias, slots)
        self._inputs = self._weight.shape[1]  # the kernel's rows; the padding is 0
        self._hidden = Layers(network[:-1], relu_last=True) if len(network) > 1 else None

    def __call__(self, x: np.ndarray, keep: np.ndarray) -> np.ndarray:
        """float32 [K, width] of x float32 [n, inputs] for the slots keep int64 [K]."""
        if self._hidden is not None:
            hidden = self._hidden(x, self._inputs)
        else:
            hidden = np.zeros((len(x), self._inputs), np.float32)
            hidden[:, : x.shape[1]] = x
        out = np.empty((len(keep), self._width), np.float32)
        slot_kernels.linear(out, keep, hidden, 0, self._weight, self._bias)
        return out


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Rows [n, d] divided by their length, or by MIN_NORM where they are shorter."""
    length = np.sqrt(np.einsum("nd,nd->n", vectors, vectors))
    unit: np.ndarray = vectors / np.maximum(length, np.float32(slot_kernels.MIN_NORM))[:, None]
    return unit


def _sigmoid(x: np.ndarray) -> np.ndarray:
    sigmoid: np.ndarray = 1 / (1 + np.exp(-x))
    return sigmoid
