"""A level of a scene as explicit Gaussians at one instant after another, and what that costs in pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.data.view import View
from pd4dgs_codec.draw.gaussians import near_plane
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.interchange.bake import Eyes, bake
from pd4dgs_codec.interchange.refine import Target, logits, refine
from pd4dgs_codec.interchange.splats import Splats, picture, unit
from pd4dgs_codec.quality.frames import shrunk
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.scene import Camera

#: Pictures to match are a whole share of the eyes' pictures' size, with no more pixels than this.
TARGET_PIXELS = 1 << 17
#: A later instant starts from what the one before it learnt and takes this share of the steps.
LATER = 0.25


@dataclass(frozen=True, eq=False)
class Export:
    """How a scene becomes explicit Gaussians. degree: of the harmonics, 0 to 3; steps: of refinement, 0 for none."""

    player: Player
    eyes: Eyes
    degree: int
    steps: int

    def splats(
        self,
        t: float,
        turn: np.ndarray | None = None,
        before: Learnt | None = None,
        step: Callable[[], None] = lambda: None,
    ) -> tuple[Splats, Learnt]:
        """The Gaussians at normalised time t, of the world turned by `turn` [3, 3] if given. before: what another
        instant of the same world learnt."""
        baked, slots = bake(self.player, t, self.eyes, self.degree, turn)
        started = baked if before is None else before.applied(baked, slots)
        steps = self.steps if before is None else int(np.ceil(LATER * self.steps))
        refined = self._refined(started, t, turn, steps, step) if steps and len(slots) else started
        return refined, Learnt(slots, baked, refined)

    def _refined(
        self, splats: Splats, t: float, turn: np.ndarray | None, steps: int, step: Callable[[], None]
    ) -> Splats:
        weights = self.eyes.weights / self.eyes.weights.sum()
        order = np.random.default_rng(0).choice(len(weights), steps, p=weights)
        targets = {}
        for i in set(order.tolist()):
            camera = self.eyes.cameras[i]
            camera = shrunk(camera, int(np.ceil(np.sqrt(camera.width * camera.height / TARGET_PIXELS))))
            targets[i] = Target(turned_camera(camera, turn), self.player.picture(camera, t))
        info = self.player.info
        return refine(splats, targets, order.tolist(), info.background, near_plane(self.player.info), step)


@dataclass(frozen=True, eq=False)
class Learnt:
    """What refinement changed at an instant, Gaussian by Gaussian: slots int64 [N], and the Gaussians before and
    after."""

    slots: np.ndarray
    baked: Splats
    refined: Splats

    def applied(self, splats: Splats, slots: np.ndarray) -> Splats:
        """The same changes to the Gaussians of another instant, where it has the same slots; not to their sizes and
        rotations, whose axes have no names."""
        _, here, there = np.intersect1d(slots, self.slots, assume_unique=True, return_indices=True)
        old, new = self.baked.taken(there), self.refined.taken(there)
        parts = {name: values.copy() for name, values in vars(splats).items()}
        parts["means"][here] += new.means - old.means
        gained = logits(new.opacities) - logits(old.opacities)
        parts["opacities"][here] = 1 / (1 + np.exp(-logits(parts["opacities"][here]) - gained))
        parts["sh"][here] += new.sh - old.sh
        return Splats(**parts)


def upright(up: Sequence[float]) -> np.ndarray:
    """float64 [3, 3]: the shortest turn that carries the direction `up` to +y."""
    a, b = unit(np.asarray(up, np.float64)), np.array([0.0, 1.0, 0.0])
    cross, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = cross
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: np.ndarray = np.eye(3) + skew + skew @ skew / (1 + cosine)  # Rodrigues
    return turn


def turned_camera(camera: Camera, turn: np.ndarray | None) -> Camera:
    """The camera that sees the turned world as this one sees the world."""
    if turn is None:
        return camera
    viewmat = camera.viewmat.astype(np.float64)
    viewmat[:3, :3] = viewmat[:3, :3] @ turn.T
    return replace(camera, viewmat=viewmat.astype(np.float32))


@dataclass(frozen=True)
class Cost:
    """Means over held-out views, dB: of direct pictures and of the exported Gaussians against the truth, and of the
    second against the first."""

    views: int
    direct_mpsnr: float
    exported_mpsnr: float
    exported_to_direct_psnr: float


def cost(export: Export, views: Sequence[View], step: Callable[[], None] = lambda: None) -> Cost:
    """What exporting costs: each view's instant is exported by itself and drawn from the view's camera."""
    rows = []
    background = export.player.info.background
    for view in views:
        direct = export.player.picture(view.camera, view.time)
        splats, _ = export.splats(view.time)
        image = picture(splats, view.camera, background, near_plane(export.player.info))
        error = float(np.square(image.astype(np.float64) - direct).mean())
        to_direct = -10 * np.log10(max(error, np.finfo(float).tiny))
        rows.append((mpsnr(direct, view.image, view.mask), mpsnr(image, view.image, view.mask), to_direct))
        step()
    direct_mean, exported_mean, to_direct_mean = np.mean(rows, axis=0)
    return Cost(len(views), float(direct_mean), float(exported_mean), float(to_direct_mean))
