"""Draws decoded scenes without torch, with the arithmetic and the kernels of `model.Model`.

Pictures of the two agree up to rounding: activations differ in the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pd4dgs_codec.draw.gaussians import (
    COLOR,
    GAUSSIAN_WIDTH,
    OFFSET_REACH,
    SIGMA_REACH,
    Decoders,
    check_time,
    finished,
    in_view,
    near_plane,
    seen,
)
from pd4dgs_codec.draw.hexplane import Field
from pd4dgs_codec.draw.rasteriser import draw
from pd4dgs_codec.draw.simd import LANES
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.kinds.splats import Moving, Splats, SplatScene
from pd4dgs_codec.scene import (
    MASK_STEP,
    MASK_THRESHOLD,
    MIN_OPACITY,
    PLANES,
    SCAFFOLD_NETWORKS,
    TRUNK,
    Camera,
    Deformation,
    Gaussians,
    Network,
    Scene,
    SceneInfo,
    Steps,
    Widths,
)


class Drawer:
    """Draws the highest level of a decoded scene of any kind. Not thread-safe."""

    def __init__(self, scene: AnyScene):
        self.scene, self.info, self.level, self.background = scene, scene.info, scene.level, scene.background()
        self.active = scene.active  #: int64 [n]: the anchors active at this level, ascending
        self.still = scene.still  #: whether all times look alike

    def at(self, t: float) -> tuple[Drawer, float]:
        """Returns (what draws normalised time t, the time in its own range): of a scene in parts, the part."""
        return self, t

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        """Returns the Gaussians that the camera may see at normalised time t, clamped to 0..1."""
        return self.scene.gaussians(min(max(t, 0.0), 1.0), eye=camera.eye)

    def picture(self, camera: Camera, t: float) -> np.ndarray:
        """Draws float32 [H, W, 3] in 0..1 at normalised time t in 0..1. Raises RenderError unless t is finite."""
        picture: np.ndarray = np.clip(self.drawn(camera, t)[0], 0, 1)
        return picture

    def drawn(self, camera: Camera, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns (`picture` before it is clipped, its alpha float32 [H, W])."""
        check_time(t)
        g = self.gaussians(camera, t)
        finite = np.isfinite(g.colors).all(axis=1)  # a colour that overflowed hides its Gaussian
        opacities, colors = np.where(finite, g.opacities, np.float32(0)), np.nan_to_num(g.colors)
        near = near_plane(self.info)
        return draw(g.means, g.quats, g.scales, opacities, colors, camera, self.background, near_plane=near)


def drawer(scene: AnyScene) -> Drawer:
    """Returns what draws a scene fastest."""
    if isinstance(scene, Scene):
        return Player(scene)
    return SplatPlayer(scene) if isinstance(scene, SplatScene) else Drawer(scene)


class SplatPlayer(Drawer):
    """Draws splats. The Gaussians without their colours are kept until the time changes."""

    def __init__(self, scene: SplatScene):
        super().__init__(scene)
        self._moving = Moving(scene)
        self._time, self._latest = 0.0, self._moving.at(0.0)

    def splats(self, t: float) -> tuple[Splats, np.ndarray]:
        """Returns (the visible Gaussians at normalised time t, clamped to 0..1, their anchors int64 [K])."""
        t = min(max(t, 0.0), 1.0)
        if t != self._time:
            self._time, self._latest = t, self._moving.at(t)
        return self._latest

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        splats, rows = self.splats(t)
        with np.errstate(all="ignore"):
            return splats.seen_from(camera.eye, rows)


class Player(Drawer):
    """Draws a scaffold. Not thread-safe.

    Results that do not depend on the eye are kept until the time changes: the anchors' residuals and, if opacity and
    covariance do not take the view direction, the Gaussians without colours (from the second view on). Further views at
    the same time evaluate only new anchors, and colours.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        codes = scene.mask[-1]
        self._mask = codes.astype(np.float32) * MASK_STEP
        self._anchor = np.ascontiguousarray(scene.anchor[: len(codes)], np.float32)
        self.slots = scene.widths.slots  #: Gaussians of an anchor
        #: float32 [N, 9 + D + 3 G]: rows of the kernels, to which the deformation adds
        flat = [scene.attributes[name].reshape(-1, math.prod(shape)) for name, shape in scene.widths.attributes.items()]
        flat[1] = flat[1] + np.repeat(np.log(np.array([1, scene.spread()], np.float32)), 3)
        self._table = np.concatenate([self._anchor, *flat], axis=1)
        extent = np.exp(flat[1])
        self._radius = OFFSET_REACH * extent[:, :3].max(axis=1) + SIGMA_REACH * extent[:, 3:].max(axis=1)
        motion = scene.motion(scene.level)
        self._field = None if motion is None else Field(motion, scene.info.box, scene.widths.head_columns)
        widths = scene.widths
        self._decoders = Decoders([scene.networks[name] for name in SCAFFOLD_NETWORKS], widths.feature)
        self.shapes_are_blind = widths.shapes_are_blind  #: whether only colours depend on the eye
        self._time: float | None = None
        self._moved = self._table  # at self._time
        if self._field is not None:
            self._table, self._moved = self._field.rest(self._table, self._anchor), np.empty_like(self._table)
        self._known = np.full(len(codes), self._field is None)  # the valid rows of _moved
        self._count = np.full(len(codes), -1)  # of each anchor's Gaussians in _grown; -1: not evaluated
        self._first = np.zeros(len(codes), np.int64)  # the index of the first one
        self._slots, self._grown = np.zeros(0, np.int64), np.zeros((0, GAUSSIAN_WIDTH), np.float32)  # with colours of 0

    @property
    def positions(self) -> np.ndarray:
        """float32 [N, 3]: positions of all anchors, undeformed, world."""
        return self._anchor

    def gaussians(self, camera: Camera, t: float) -> Gaussians:
        viewmat = np.asarray(camera.viewmat, np.float32)
        with np.errstate(all="ignore"):
            near = in_view(camera, viewmat, self._anchor, self._radius, self.info.near)
            rows = np.flatnonzero(near & (self._mask > MASK_THRESHOLD))
            return self._of_eyes(rows, t, [camera.eye])

    def gaussians_of_eyes(self, rows: np.ndarray, t: float, eyes: np.ndarray) -> Gaussians:
        """Returns the Gaussians of the anchors `rows` (int64 [n]) at normalised time t for all `eyes` (float32 [E, 3],
        world), one eye after the other. View frusta are ignored.

        Each eye has the same slots, all that any eye sees; opacity is 0 where the eye itself does not see the Gaussian.
        """
        with np.errstate(all="ignore"):
            return self._of_eyes(rows, t, list(eyes))

    def _of_eyes(self, rows: np.ndarray, t: float, eyes: list[np.ndarray]) -> Gaussians:
        again = t == self._time
        if not again:
            self._time, self._known[:], self._count[:] = t, self._field is None, -1
            self._slots, self._grown = self._slots[:0], self._grown[:0]
        if self.shapes_are_blind and (again or len(eyes) > 1):
            return self._of_colors(rows, t, eyes)
        mask, anchors = self._mask[rows], self._anchors(rows, t)
        looks = [self._decoders.look(anchors, eye) for eye in eyes]
        shown = [seen(look.opacity, mask, MIN_OPACITY) for look in looks]
        keep = shown[0] if len(eyes) == 1 else np.unique(np.concatenate(shown))
        slots = rows[keep // self.slots] * self.slots + keep % self.slots
        found = []
        for look, own in zip(looks, shown, strict=True):
            made = self._decoders.make(anchors, mask, look, keep)
            means, quats, scales, opacities, colors = finished(made.gaussians, made.gates)
            if len(own) < len(keep):
                opacities[~np.isin(keep, own, assume_unique=True)] = 0
            found.append((means, quats, scales, opacities, colors, slots))
        return _joined(found)

    def _of_colors(self, rows: np.ndarray, t: float, eyes: list[np.ndarray]) -> Gaussians:
        """`_of_eyes` if only colours depend on the eye."""
        anchors = self._anchors(rows, t)
        self._grow(rows, anchors)
        count = self._count[rows]
        before = np.cumsum(count) - count
        entries = np.repeat(self._first[rows] - before, count) + np.arange(count.sum())
        slots, gates = self._slots.take(entries), np.repeat(self._mask[rows], count)
        keep, found = slots + np.repeat((np.arange(len(rows)) - rows) * self.slots, count), []
        for eye in eyes:
            gaussians = self._grown.take(entries, axis=0)
            gaussians[:, COLOR:] += self._decoders.colors(anchors, eye, keep)
            found.append((*finished(gaussians, gates), slots))
        return _joined(found)

    def _grow(self, rows: np.ndarray, anchors: np.ndarray) -> None:
        """Evaluates the anchors `rows` that are not in _grown yet, and appends their Gaussians to it."""
        missing = self._count[rows] < 0
        own, anchors, slots = rows[missing], anchors[missing], self.slots
        if not own.size:
            return
        mask, look = self._mask[own], self._decoders.look(anchors, np.zeros(3, np.float32))
        keep = seen(look.opacity, mask, MIN_OPACITY)
        gaussians = self._decoders.make(anchors, mask, look, keep).gaussians
        gaussians[:, COLOR:] = 0
        count = np.bincount(keep // slots, minlength=len(own))
        self._count[own], self._first[own] = count, len(self._slots) + np.cumsum(count) - count
        self._slots = np.concatenate([self._slots, own[keep // slots] * slots + keep % slots])
        self._grown = np.concatenate([self._grown, gaussians])

    def _anchors(self, rows: np.ndarray, t: float) -> np.ndarray:
        """Returns float32 [n, 9 + D + 3 G]: the rows of the anchors `rows` with the deformation's residuals."""
        if self._field is not None:
            missing = rows[~self._known[rows]]
            if missing.size:
                moved = self._table.take(missing, axis=0)
                self._field.move(moved, self._anchor.take(missing, axis=0), t)
                self._moved[missing] = moved
                self._known[missing] = True
        found: np.ndarray = self._moved.take(rows, axis=0)
        return found


def _joined(eyes: Sequence[tuple[np.ndarray, ...]]) -> Gaussians:
    """Concatenates the Gaussians of all eyes."""
    return Gaussians(*(eyes[0] if len(eyes) == 1 else map(np.concatenate, zip(*eyes, strict=True))))


# -- warming up --------------------------------------------------------------------------------------------------------


def warm_up() -> None:
    """Loads the kernels, or compiles them if none are cached, by drawing one anchor with both deformations. A viewer
    imports this module and calls this function in a thread while it receives the first layer."""
    widths, box = Widths(), np.array([[-1, -1, 1], [1, 1, 3]], np.float32)
    camera = Camera(np.eye(4, dtype=np.float32), np.array([[16, 0, 8], [0, 16, 8], [0, 0, 1]], np.float32), 16, 16)
    planes = {name: np.ones((LANES, 2, 2), np.float32) for name, _, _ in PLANES}
    still = Deformation((planes,), {TRUNK: _constant(LANES, LANES), "position": _constant(LANES, 3)})  # residuals of 0
    scene = Scene(
        info=SceneInfo(1.0, box, (0.0, 1.0), (0.0, 0.0, 0.0), 0.1, 100.0, (0.0, -1.0, 0.0), 0.0, camera),
        steps=Steps(),
        layers=(0, 1, 2),
        rows=(1, 1, 1),
        anchor_q=np.array([[0, 0, 2]], np.int32),
        feature=np.zeros((1, widths.feature), np.float32),
        scaling_log=np.full((1, *widths.attributes["scaling_log"]), -2, np.float32),
        offset=np.zeros((1, widths.slots, 3), np.float32),
        mask=(np.full(1, 255, np.uint8),) * 3,
        networks={name: _constant(widths.inputs[name], n, 0.5) for name, n in widths.networks.items()},
        global_deformation=still,
        local_deformation=still,
    )
    Player(scene).picture(camera, 0.5)


def _constant(inputs: int, outputs: int, value: float = 0.0) -> Network:
    """Returns a network of one layer whose outputs are all `value`."""
    return ((np.zeros((outputs, inputs), np.float32), np.full(outputs, value, np.float32)),)
