"""Exports a level of a scene as explicit Gaussians, and measures the loss of quality.

Splats are explicit already. The decoders of a scaffold take the view direction, so opacity, size, rotation and colour
of a Gaussian depend on it. Baking evaluates them from a set of eyes, each with a weight per anchor. Opacity is the
weighted mean over the eyes; an eye that does not see the Gaussian counts as 0. The weights of covariance and colour are
multiplied by opacity. Covariance is a mean; colours are harmonics fitted by least squares, with a ridge that keeps
unseen directions near the mean colour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pd4dgs_codec.data.view import View, rotation_matrix
from pd4dgs_codec.draw.gaussians import LEAST_NEAR, near_plane
from pd4dgs_codec.draw.player import Drawer, Player, SplatPlayer
from pd4dgs_codec.interchange.splats import (
    evenly,
    finite_rows,
    looking,
    picture,
    principal_axes,
    quaternions,
    sphere,
)
from pd4dgs_codec.kinds.splats import Splats, harmonics, product, unit
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.scene import MIN_OPACITY, Camera

UNTURNED = np.eye(3)
#: Eyes of a bake; more of them change held-out PSNR by less than 0.01 dB.
EYES = 48
#: Anchors baked at a time, which bounds memory to EYES times their Gaussians.
CHUNK = 1024
#: Factor of an eye's weight for anchors outside its picture and margin.
OUTSIDE = 1e-3
#: The ridge on coefficients of degree l is RIDGE times l (l + 1), where the eyes' weights sum to 1.
RIDGE = 1e-4
PIXELS = 400  #: width and height of the pictures of a file without a camera
#: `eyes_of_scene` weighs an eye at the angle a from the file's camera by exp(CONCENTRATION (cos a - 1)).
CONCENTRATION = 2.0


# -- eyes and baking ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Eyes:
    """E cameras that see the scene, and their weights, float64 [E] > 0."""

    cameras: tuple[Camera, ...]
    weights: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """float32 [E, 3], world."""
        return np.stack([camera.eye for camera in self.cameras])


def eyes_of_cameras(cameras: Sequence[Camera]) -> Eyes:
    """Picks EYES cameras, evenly spaced in their order, or all if there are fewer. Their weights are equal."""
    chosen = evenly(cameras, EYES)
    return Eyes(chosen, np.ones(len(chosen)))


def eyes_of_scene(player: Player, count: int = EYES) -> Eyes:
    """Places `count` cameras on a sphere around the median of the anchors that the file's camera sees.

    They look at the centre with the distance and intrinsics of that camera; the nearer to it, the higher their weight.
    If the file has no camera, the radius is twice the distance of the farthest active anchor, and weights are equal.
    """
    info, camera = player.info, player.info.camera
    positions = player.positions[player.active].astype(np.float64)
    if camera is not None and len(positions) and (seen := _inside(camera, positions)).any():
        positions = positions[seen]
    middle = np.median(positions, axis=0) if len(positions) else np.zeros(3)
    places = sphere(count)
    if camera is None:
        distance = 2 * float(np.linalg.norm(positions - middle, axis=1).max(initial=LEAST_NEAR))
        K = np.array([[PIXELS, 0, PIXELS / 2], [0, PIXELS, PIXELS / 2], [0, 0, 1]], np.float32)
        like, weights = Camera(np.eye(4, dtype=np.float32), K, PIXELS, PIXELS), np.ones(count)
    else:
        away = camera.eye - middle
        distance = max(float(np.linalg.norm(away)), LEAST_NEAR)
        like, weights = camera, np.exp(CONCENTRATION * (places @ (away / distance) - 1))
    up = np.asarray(info.up, np.float64)
    return Eyes(tuple(looking(middle + distance * d, -d, up, like) for d in places), weights)


def exported(
    player: Drawer, t: float, eyes: Eyes | None, degree: int, turn: np.ndarray = UNTURNED
) -> tuple[Splats, np.ndarray]:
    """Returns (Gaussians at normalised time t in 0..1, their slots int64 [N]), without Gaussians too faint to be drawn.

    eyes: from which a scaffold is baked; None for splats, which stay as they are. degree: of the harmonics, at most.
    turn: rotation of the world, [3, 3].
    """
    player, t = player.at(t)
    if isinstance(player, SplatPlayer):
        splats, slots = player.splats(t)
        if not (finite := finite_rows(vars(splats))).all():
            splats, slots = splats.taken(finite), slots[finite]
        return _turned(replace(splats, sh=splats.sh[:, : (degree + 1) ** 2]), turn), slots
    assert isinstance(player, Player) and eyes
    return bake(player, t, eyes, degree, turn)


def _turned(splats: Splats, turn: np.ndarray) -> Splats:
    """Returns the Gaussians in a world that is rotated by `turn` [3, 3]."""
    if turn is UNTURNED:
        return splats
    directions = sphere(4 * splats.sh.shape[1])  # harmonics of a degree span what they are turned to
    own, turned = harmonics(directions, splats.degree), harmonics(directions @ turn.T, splats.degree)
    return Splats(
        means=(splats.means @ turn.T).astype(np.float32),
        quats=product(quaternions(turn[None]), splats.quats).astype(np.float32),
        scales=splats.scales,
        opacities=splats.opacities,
        sh=np.einsum("jk,nkc->njc", np.linalg.lstsq(turned, own, rcond=None)[0], splats.sh).astype(np.float32),
    )


def bake(player: Player, t: float, eyes: Eyes, degree: int, turn: np.ndarray = UNTURNED) -> tuple[Splats, np.ndarray]:
    """Returns (Gaussians at normalised time t in 0..1, their slots int64 [N]), without Gaussians too faint to be drawn.

    degree: of the harmonics, 0 to 3. turn: rotation of the world, [3, 3].
    """
    rows, parts, slots = player.active, [], []
    for start in range(0, len(rows), CHUNK):
        chunk = rows[start : start + CHUNK]
        splats, found = _bake(player, chunk, t, eyes, degree, turn)
        keep = np.flatnonzero(splats.opacities >= MIN_OPACITY)
        parts.append(splats.taken(keep))
        slots.append(found[keep])
    if not parts:
        empty = (np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3)))
        return Splats(*empty), np.zeros(0, np.int64)
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0]))
    return Splats(*joined), np.concatenate(slots)


def _inside(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """Returns bool [n]: whether positions [n, 3] project into the picture or a margin of half its size."""
    viewmat, K = camera.viewmat.astype(np.float64), camera.K.astype(np.float64)
    x, y, depth = viewmat[:3, :3] @ positions.T.astype(np.float64) + viewmat[:3, 3:]
    z = np.maximum(depth, LEAST_NEAR)
    u, v = (K[0, 0] * x / z + K[0, 2]) / camera.width, (K[1, 1] * y / z + K[1, 2]) / camera.height
    return np.asarray((depth > 0) & (np.abs(u - 0.5) < 1) & (np.abs(v - 0.5) < 1))


def _bake(
    player: Player, rows: np.ndarray, t: float, eyes: Eyes, degree: int, turn: np.ndarray
) -> tuple[Splats, np.ndarray]:
    g = player.gaussians_of_eyes(rows, t, eyes.places)
    count = len(eyes.places)
    means, slots = g.means.reshape(count, -1, 3)[0], g.slots.reshape(count, -1)[0]
    opacities = g.opacities.reshape(count, -1).astype(np.float64)
    finite = np.isfinite(g.colors).all(axis=1).reshape(count, -1)  # as in Player.picture
    opacities = np.where(finite, opacities, 0)
    colors = np.nan_to_num(g.colors).reshape(count, -1, 3)
    inside = np.stack([_inside(camera, player.positions[rows]) for camera in eyes.cameras])
    prior = eyes.weights[:, None] * np.where(inside, 1.0, OUTSIDE)
    prior = prior[:, np.searchsorted(rows, slots // player.slots)]
    prior /= prior.sum(axis=0)
    weights = prior * opacities
    opacity = weights.sum(axis=0)
    weights /= np.maximum(opacity, np.finfo(np.float64).tiny)
    factor = rotation_matrix(g.quats) * g.scales[:, None, :]
    covariances = (factor @ factor.transpose(0, 2, 1)).reshape(count, -1, 3, 3)
    covariance = np.einsum("ek,ekij->kij", weights, covariances)
    scales, axes = principal_axes(turn @ covariance @ turn.T)
    places = eyes.places.astype(np.float64)
    directions = unit(means[None].astype(np.float64) - places[:, None]) @ turn.T
    splats = Splats(
        means=(means @ turn.T).astype(np.float32),
        quats=quaternions(axes).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=np.minimum(opacity, 1).astype(np.float32),
        sh=_fitted(harmonics(directions, degree), colors, weights).astype(np.float32),
    )
    finite = np.isfinite(splats.means).all(axis=1) & np.isfinite(splats.scales).all(axis=1) & (opacity > 0)
    return splats.taken(finite), slots[finite]


def _fitted(basis: np.ndarray, colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fits coefficients float64 [K, J, 3] of basis [E, K, J] to colors [E, K, 3] - 0.5 by least squares with weights
    [E, K], whose sum over the eyes is 1."""
    degrees = np.floor(np.sqrt(np.arange(basis.shape[2])))
    weighted = (basis * weights[..., None]).transpose(1, 2, 0)
    normal = weighted @ basis.transpose(1, 0, 2) + np.diag(RIDGE * degrees * (degrees + 1))
    seen = weights.sum(axis=0) > 0
    normal[~seen] = np.eye(basis.shape[2])
    return np.asarray(np.linalg.solve(normal, weighted @ (colors.transpose(1, 0, 2) - 0.5)))


# -- axes and loss -----------------------------------------------------------------------------------------------------


def upright(up: Sequence[float]) -> np.ndarray:
    """Returns float64 [3, 3]: the smallest rotation that carries the direction `up` to +y."""
    a, b = unit(np.asarray(up, np.float64)), np.array([0.0, 1.0, 0.0])
    if a @ b < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # reflections along a and a + b: the first turns a round, the second carries -a to b
    return np.asarray(np.eye(3) + 2 * np.outer(b, a) - np.outer(a + b, a + b) / (1 + a @ b))


def cost(
    player: Drawer, eyes: Eyes | None, degree: int, views: Sequence[View], step: Callable[[], None] = lambda: None
) -> dict[str, float]:
    """Measures the loss by export: each view's time is exported by itself and drawn from the view's camera.

    Returns the number of views and means over them in dB: direct_mpsnr (direct picture against the truth),
    exported_mpsnr (exported against the truth) and exported_to_direct_psnr (exported against direct).
    """
    rows, info = [], player.info
    for view in views:
        direct = player.picture(view.camera, view.time)
        splats, _ = exported(player, view.time, eyes, degree)
        image = picture(splats, view.camera, player.background, near_plane(info))
        error = float(np.square(image.astype(np.float64) - direct).mean())
        to_direct = -10 * np.log10(max(error, np.finfo(float).tiny))
        rows.append((mpsnr(direct, view.image, view.mask), mpsnr(image, view.image, view.mask), to_direct))
        step()
    names = ("direct_mpsnr", "exported_mpsnr", "exported_to_direct_psnr")
    return {"views": len(views), **dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))}
